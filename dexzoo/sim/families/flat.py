"""Prisms over outlines of every kind, and flat thin things with relief. Lengths in millimeters."""

from __future__ import annotations

import numpy as np
from manifold3d import CrossSection, JoinType

from dexzoo.sim.families.drawing import Generator, ellipsoid, log_uniform
from dexzoo.sim.families.outline import (
    Layer,
    blob,
    disc,
    fitted,
    layered,
    pierced,
    polygon,
    rectangle,
    rounded,
    size,
    star,
    strokes,
)
from dexzoo.sim.shapes.shell import sheet
from dexzoo.sim.shapes.solid import Solid, union


def extruded(rng: Generator) -> Solid:
    """Prisms, straight or tapered, over polygons, stars, blobs, letters, rings and arcs, some with holes or a foot.

    Args:
        rng: Draws kind, dimensions and details.

    Returns:
        The object, in millimeters; `make_shape` stands it up.
    """
    width = log_uniform(rng, 30, 140)
    outline = _outline(rng)
    depth = width * float(np.clip(np.divide(*size(outline)[::-1]) * log_uniform(rng, 0.5, 1.5), 0.25, 1.5))
    outline = fitted(outline, width, depth)
    height = float(np.clip(width * log_uniform(rng, 0.15, 2.5), 10, 250))
    if rng.random() < 0.4:
        outline = pierced(rng, outline)
    taper = rng.uniform(0.35, 1) if rng.random() < 0.4 else 1.0
    layers = [Layer(outline, 0.1, height, taper)]
    if rng.random() < 0.2:  # a foot or a flange
        wide = rounded(outline.hull().offset(rng.uniform(3, 12), JoinType.Miter), 2)
        layers.append(Layer(wide, 0, rng.uniform(0.06, 0.3) * height))
    return layered(*layers)


def relief(rng: Generator) -> Solid:
    """Flat thin things: plaques, tiles and tags with raised or sunk figures, keys, combs, and curved shells.

    Args:
        rng: Draws kind, dimensions and details.

    Returns:
        The object, in millimeters; `make_shape` stands it up.
    """
    if rng.random() < 0.2:
        return _curved(rng)
    width = log_uniform(rng, 45, 230)
    plate = _plate(rng, width)
    thick = log_uniform(rng, 3, 16)
    low_x, low_y, high_x, high_y = plate.bounds()
    inside = plate.offset(-rng.uniform(3, 0.1 * width + 3.5), JoinType.Round, circular_segments=16)
    if rng.random() < 0.35:  # a hole to hang it by
        plate -= disc(rng.uniform(3, 6), 16).translate((low_x + 0.12 * (high_x - low_x), (low_y + high_y) / 2))
    figure = _figure(rng, 0.8 * (high_x - low_x), 0.7 * (high_y - low_y)).translate(
        ((low_x + high_x) / 2, (low_y + high_y) / 2)
    )
    figure = figure ^ (inside if inside.area() > 0 else plate)
    rise = min(rng.uniform(2.5, 9), 1.5 * thick)
    if thick > 5.5 and rng.random() < 0.4:
        return layered(Layer(plate, 0, thick - min(rise, thick - 3)), Layer(plate - figure, 0.1, thick))
    if rng.random() < 0.2:
        studs = [
            ellipsoid([r, r, rise], rng.uniform(0.5, 1.2), 1).moved((x, y, thick))
            for x, y, r in _spots(rng, 0.7 * (high_x - low_x), 0.6 * (high_y - low_y))
        ]
        return union(layered(Layer(plate, 0, thick)), *studs)
    return layered(Layer(plate, 0, thick), Layer(figure, 0.5 * thick, thick + rise, rng.uniform(0.9, 1)))


def _outline(rng: Generator) -> CrossSection:
    """An outline of any kind and of any size."""
    kind = rng.choice(
        ["polygon", "star", "blob", "letter", "ring", "slab", "arc"], p=[0.2, 0.16, 0.16, 0.2, 0.1, 0.1, 0.08]
    )
    if kind == "polygon":
        return _softened(rng, polygon(rng, int(rng.integers(3, 10)), rng.uniform(0.2, 0.75)).scale((50, 50)))
    if kind == "star":
        points = int(rng.integers(3, 9))
        return _softened(rng, star(rng, points, rng.uniform(0.35, 0.85)).scale((50, 50)))
    if kind == "blob":
        return blob(rng, int(rng.integers(1, 5)), rng.uniform(0.15, 0.5))
    if kind == "letter":
        return strokes(rng, int(rng.integers(2, 6)), rng.uniform(0.25, 0.6))
    if kind == "ring":
        outer = rounded(polygon(rng, int(rng.integers(4, 9)), 0.3).hull().scale((50, 50)), rng.uniform(2, 25))
        return outer - outer.scale((s := rng.uniform(0.4, 0.8), s))
    if kind == "slab":
        return rounded(rectangle(100, 100), rng.uniform(3, 40))
    sweep = rng.uniform(1.8, 5.4)
    angle = np.linspace(0, sweep, 30)
    round_ = np.column_stack((np.cos(angle), np.sin(angle)))
    outline = np.concatenate((round_, rng.uniform(0.45, 0.8) * round_[::-1]))
    return CrossSection([outline.tolist()])


def _softened(rng: Generator, outline: CrossSection) -> CrossSection:
    if rng.random() < 0.4:
        return outline
    radius = rng.uniform(1, 6)
    soft = rounded(outline, radius, radius)
    return soft if len(soft.decompose()) == 1 else outline


def _plate(rng: Generator, width: float) -> CrossSection:
    """The outline of a plate: round, square, oval, wavy, shield-like, with a neck or with teeth."""
    depth = float(np.clip(width * log_uniform(rng, 0.25, 1), 25, 160))
    kind = rng.choice(["square", "round", "wavy", "cut", "necked", "toothed"], p=[0.25, 0.18, 0.17, 0.15, 0.15, 0.1])
    if kind == "square":
        return rounded(rectangle(width, depth), rng.uniform(0.02, 0.45) * depth)
    if kind == "round":
        return fitted(disc(50, 48), width, depth)
    if kind == "wavy":
        return fitted(blob(rng, 4, 0.35), width, depth)
    if kind == "cut":
        return fitted(rounded(polygon(rng, int(rng.integers(3, 8)), 0.5).scale((50, 50)), 3), width, depth)
    if kind == "necked":
        head = fitted(disc(50, 36) if rng.random() < 0.5 else rounded(rectangle(50, 50), 6), 0.45 * width, depth)
        neck = rectangle(0.7 * width, rng.uniform(0.2, 0.5) * depth).translate((0.45 * width, 0))
        for x in np.linspace(0.5, 0.75, int(rng.integers(0, 4))):
            neck -= rectangle(rng.uniform(4, 8), 0.2 * depth).translate((x * width, 0.18 * depth))
        return head + neck
    plate = rectangle(width, depth)
    num = int(rng.integers(3, 10))
    gap = width / (2 * num + 1)
    for tooth in range(num):
        cut = rectangle(gap, depth).translate(((2 * tooth + 1.5) * gap - width / 2, depth * rng.uniform(0.5, 0.6)))
        plate -= cut
    return plate


def _figure(rng: Generator, width: float, depth: float) -> CrossSection:
    """What stands out of a plate or is sunk into it."""
    kind = rng.choice(["letter", "star", "bars", "ring", "spots", "blob"])
    if kind == "letter":
        return fitted(strokes(rng, int(rng.integers(2, 6)), rng.uniform(0.3, 0.55)), min(width, depth), depth)
    if kind == "star":
        return fitted(star(rng, int(rng.integers(3, 7)), rng.uniform(0.35, 0.7)), min(width, depth), depth)
    if kind == "bars":
        num = int(rng.integers(2, 7))
        bars = [
            rectangle(0.5 * width / num, depth * rng.uniform(0.5, 1)).translate(
                ((i + 0.5) / num * width - width / 2, 0)
            )
            for i in range(num)
        ]
        return CrossSection.compose(bars)
    if kind == "ring":
        outer = fitted(disc(50, 40), width, depth)
        return outer - outer.scale((s := rng.uniform(0.55, 0.85), s))
    if kind == "spots":
        figure = CrossSection()
        for x, y, r in _spots(rng, width, depth):
            figure += disc(r, 16).translate((x, y))
        return figure
    return fitted(blob(rng, 3, 0.4), width, depth)


def _spots(rng: Generator, width: float, depth: float) -> list[tuple[float, float, float]]:
    """Centers and radii of two to eight discs in rows."""
    columns, rows = int(rng.integers(2, 5)), int(rng.integers(1, 3))
    radius = rng.uniform(0.25, 0.45) * min(width / columns, depth / rows)
    grid = [((i + 0.5) / columns - 0.5, (j + 0.5) / rows - 0.5) for i in range(columns) for j in range(rows)]
    return [(x * width, y * depth, radius) for x, y in grid]


def _curved(rng: Generator) -> Solid:
    """A thin sheet, arched or dished, over an outline that narrows to its ends: leaves, tiles, shells, shoehorns."""
    width, depth = log_uniform(rng, 60, 230), log_uniform(rng, 40, 110)
    thick, rise, sag = rng.uniform(2.5, 5), rng.uniform(-0.25, 0.25), rng.uniform(0.05, 0.35)
    x, across = np.linspace(-1, 1, 21), np.linspace(-1, 1, 17)
    waist = 1 - rng.uniform(0, 0.85) * np.abs(x) ** rng.uniform(1.5, 5) + rng.uniform(-0.25, 0.25) * x
    lower = np.empty((21, 17, 3))
    lower[..., 0] = width / 2 * x[:, None]
    lower[..., 1] = depth / 2 * waist[:, None] * across
    lower[..., 2] = rise * depth * x[:, None] ** 2 - sag * depth * waist[:, None] * (1 - across**2)
    return sheet(lower + np.array([0, 0, thick]), lower, (5, 4))

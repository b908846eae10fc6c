"""Long things: bars and tubes, and tools with a head. Lengths in millimeters."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from manifold3d import CrossSection

from dexzoo.sim.families.drawing import Generator, bent, ellipsoid, log_uniform, loop, profile, swept
from dexzoo.sim.families.outline import Layer, blob, disc, fitted, layered, polygon, rectangle, rounded, star
from dexzoo.sim.shapes.curves import Array, Number, ellipse
from dexzoo.sim.shapes.handles import grip
from dexzoo.sim.shapes.shell import sheet, vessel
from dexzoo.sim.shapes.solid import Solid, loft, skin, turned, union


def bar(rng: Generator) -> Solid:
    """Bars and tubes: straight, bent, hooked, coiled, twisted and tapered, of one section or several.

    Args:
        rng: Draws kind, dimensions and details.

    Returns:
        The object, in millimeters; `make_shape` stands it up.
    """
    length = log_uniform(rng, 60, 270)
    thick = float(np.clip(length * log_uniform(rng, 0.05, 0.28), 7, 34))
    path = _path(rng, length, thick)
    share = np.linspace(0, 1, len(path))
    knots = np.clip(rng.normal(1, rng.uniform(0, 0.35), int(rng.integers(2, 6))), 0.35, 1.7)
    size = np.interp(share, np.linspace(0, 1, len(knots)), knots)
    if rng.random() < 0.35:
        size = size * np.interp(share, [0, 1], [1, rng.uniform(0.25, 0.8)])
    size = np.convolve(np.pad(size, 2, mode="edge"), np.ones(5) / 5, mode="valid") * thick
    points = loop(rng, 24) * [1, rng.choice([1.0, rng.uniform(0.35, 0.9)])]
    twist = rng.uniform(0.4, 1.6) * np.pi * rng.choice([-1, 1]) if rng.random() < 0.3 else 0.0
    if thick > 12 and rng.random() < 0.3:
        return _tube(rng, path, size)
    other = loop(rng, 24) if len(points) == 24 and rng.random() < 0.3 else points
    if len(other) != len(points):
        other = points
    blend = np.clip((share - 0.35) / 0.3, 0, 1)[:, None, None]
    loops = ((1 - blend) * points + blend * other) * size[:, None, None]
    return loft(swept(path, loops, twist))


def _tube(rng: Generator, path: Array, size: Array) -> Solid:
    """A hollow bar that is open at both ends."""
    wall = rng.uniform(2.5, 0.4 * float(size.min()) + 1.5)
    around = ellipse(rng.uniform(2, 4), 24)
    outer = swept(path, around * size[:, None, None])
    inner = swept(path, around * (size - wall)[:, None, None])
    grids = [np.concatenate((grid, grid[:, :1]), 1) for grid in (inner, outer)]
    mesh = skin(np.concatenate((outer, inner[::-1])), closed=True)
    return Solid(mesh, sheet(grids[1], grids[0], (3, 8)).parts)


def _path(rng: Generator, length: float, thick: float) -> Array:
    """A path (station, 3): straight, bowed, an angle, a hook, a crank, a wave or a coil."""
    kind = rng.choice(
        ["straight", "bow", "angle", "hook", "crank", "wave", "coil"], p=[0.26, 0.18, 0.15, 0.12, 0.13, 0.1, 0.06]
    )
    if kind == "straight":
        return np.linspace((0, 0, 0), (length, 0, 0), 25)
    if kind in ("bow", "hook"):
        turn = rng.uniform(0.5, 1.6) if kind == "bow" else rng.uniform(2.4, 4.6)
        radius = max(length / turn, 1.6 * thick)
        angle = np.linspace(0, turn, 33)
        arc = np.column_stack((radius * np.sin(angle), radius * (1 - np.cos(angle)), 0 * angle))
        if kind == "hook":
            shank = rng.uniform(0.3, 1) * length
            arc = np.concatenate((np.linspace((-shank, 0, 0), (0, 0, 0), 12, endpoint=False), arc))
        return arc
    if kind == "angle":
        bend = rng.uniform(0.6, 2.0)
        first = length * rng.uniform(0.35, 0.65)
        end = (first + (length - first) * np.cos(bend), (length - first) * np.sin(bend), 0)
        return bent([(0, 0, 0), (first, 0, 0), end], 1.5 * thick + rng.uniform(0, 20))
    if kind == "crank":
        a, b = length * rng.uniform(0.3, 0.45), length * rng.uniform(0.2, 0.4)
        rise = rng.choice([0.0, rng.uniform(-0.4, 0.4) * length])
        knots = [(0, 0, 0), (a, 0, 0), (a, b, 0), (a + rng.choice([-1, 1]) * a, b, rise)]
        return bent(knots, 1.3 * thick + rng.uniform(0, 15))
    if kind == "wave":
        along = np.linspace(-0.5, 0.5, 41) * length
        swing = rng.uniform(0.08, 0.22) * length * np.sin(2 * np.pi * rng.uniform(0.8, 1.6) * along / length)
        return np.column_stack((along, swing, rng.uniform(-0.5, 0.5) * along**2 / length))
    turn = rng.uniform(1.5, 3) * np.pi
    angle = np.linspace(0, turn, 60)
    radii = max(length / turn, 1.8 * thick) * np.linspace(1, rng.uniform(0.6, 1), 60)
    rise = 2.5 * thick * angle / (2 * np.pi)
    return np.column_stack((radii * np.cos(angle), radii * np.sin(angle), rise))


def tool(rng: Generator) -> Solid:
    """A long handle along x with a head: hammers, brushes, paddles, ladles, rakes, wrenches, keys, wands, plungers.

    Args:
        rng: Draws kind, dimensions and details.

    Returns:
        The object, in millimeters; `make_shape` stands it up.
    """
    length, width = log_uniform(rng, 70, 210), rng.uniform(5, 14)
    thick = width * rng.uniform(0.55, 1.1)
    bow = rng.uniform(-0.15, 0.15) * length
    swell = rng.uniform(0.6, 1.25, 5)
    path: list[tuple[Number, ...]] = [(5, 0), (-0.45 * length, bow, 60), (-length, 0.4 * bow)]
    handle = grip(path, (width * swell).tolist(), (thick * swell[::-1]).tolist(), rng.uniform(2, 4.5))
    head = _HEADS[int(rng.integers(len(_HEADS)))](rng, min(length, 150.0), float(thick))
    extra = []
    if rng.random() < 0.3:
        size = 1.3 * width * swell[-1]
        extra.append(ellipsoid([size, size, size], rng.uniform(0.3, 1), 1).moved((-length, 0, 0.4 * bow)))
    return union(handle, head, *extra)


def _mallet(rng: Generator, length: float, thick: float) -> Solid:
    """A head across the handle."""
    reach, half = length * rng.uniform(0.15, 0.35), length * rng.uniform(0.08, 0.2)
    side = profile(rng, half, 2 * reach, int(rng.integers(1, 4)), 0.4, start=-reach)
    head = loft(turned(side, loop(rng)))
    return head.moved(degrees=int(rng.choice([0, 90])), axis="x").moved((half, 0, rng.uniform(-0.5, 0.5) * half))


def _paddle(rng: Generator, length: float, thick: float) -> Solid:
    """A flat head in line with the handle, pierced in some."""
    wide, long = length * rng.uniform(0.2, 0.55), length * rng.uniform(0.3, 0.8)
    kinds: list[CrossSection] = [
        rounded(rectangle(50, 50), rng.uniform(2, 20)),
        disc(50, 40),
        blob(rng, 3, 0.3),
        rounded(polygon(rng, int(rng.integers(3, 7)), 0.4).scale((50, 50)), 3),
    ]
    outline = fitted(kinds[int(rng.integers(4))], long, wide)
    if rng.random() < 0.35:
        for x in np.linspace(-0.25, 0.25, int(rng.integers(1, 4))):
            outline -= rectangle(0.08 * long + 3, 0.5 * wide).translate((x * long, 0))
    half = rng.uniform(1.5, 0.8 * thick + 1.5)
    return layered(Layer(outline.translate((long / 2 - 2, 0)), -half, half))


def _brush(rng: Generator, length: float, thick: float) -> Solid:
    """A block with a tapered tuft below or in front."""
    long, wide, high = length * rng.uniform(0.25, 0.6), rng.uniform(1.3, 4) * thick, rng.uniform(1, 2.2) * thick
    block = rounded(rectangle(long, wide), rng.uniform(1, 0.45 * min(long, wide))).translate((long / 2, 0))
    tuft = block.offset(-1.5)
    low = -high - rng.uniform(8, 30)
    return layered(Layer(block, -high, high), Layer(tuft, low, -high + 1, rng.uniform(0.9, 1)))


def _scoop(rng: Generator, length: float, thick: float) -> Solid:
    """A cup or a dish at the end."""
    radius, depth = rng.uniform(18, 42), rng.uniform(12, 45)
    side = np.array([(3, 0), (radius * rng.uniform(0.5, 0.95), 0), (radius, 0.5 * depth), (radius, depth)])
    cup = vessel(side, rng.uniform(2.2, 3.5), 18)
    return cup.moved((radius, 0, -depth + thick * 0.6))


def _prongs(rng: Generator, length: float, thick: float) -> Solid:
    """A cross piece with two to five prongs, straight on or turned down."""
    num, reach = int(rng.integers(2, 6)), length * rng.uniform(0.2, 0.5)
    half, size = rng.uniform(14, 40), rng.uniform(2.2, 4)
    across = grip([(-half, 0), (half, 0)], [1.3 * size], [1.3 * size]).moved(degrees=90)
    drop = rng.uniform(0, 1) * reach
    prong = grip([(-1, 0), (0.4 * reach, 0, 15), (reach, -drop)], [size, size, 0.6 * size], [size, size, 0.6 * size])
    spread = np.linspace(-half + size, half - size, num)
    return union(across, *(prong.moved((0, float(y), 0)) for y in spread)).moved((3, 0, 0))


def _jaw(rng: Generator, length: float, thick: float) -> Solid:
    """An open jaw, a ring, or a cogged disc."""
    radius = length * rng.uniform(0.14, 0.28)
    kind = rng.choice(["jaw", "ring", "cog"])
    if kind == "cog":
        outline = star(rng, int(rng.integers(4, 8)), rng.uniform(0.6, 0.85)).scale((radius, radius))
    else:
        outline = disc(radius, 36) - disc(radius * rng.uniform(0.45, 0.7), 6 if kind == "jaw" else 30)
        if kind == "jaw":
            outline -= rectangle(2 * radius, radius * rng.uniform(0.6, 1)).translate((1.1 * radius, 0))
    half = rng.uniform(0.5, 1) * thick
    return layered(Layer(outline.translate((0.9 * radius, 0)), -half, half))


def _ball(rng: Generator, length: float, thick: float) -> Solid:
    """A rounded head, long or flat, with a collar."""
    half = length * rng.uniform(0.1, 0.32, 3)
    half = np.clip(half, 10, 45)
    head = ellipsoid(half, rng.uniform(0.25, 1.5), rng.uniform(0.25, 1.5), 19).moved((0.8 * half[0], 0, 0))
    size = np.clip(half[1:].min() * 0.8, thick, None)
    collar = ellipsoid([0.4 * size, size, size], 0.4, 1).moved((0.1 * size, 0, 0))
    return union(head, collar)


def _blade(rng: Generator, length: float, thick: float) -> Solid:
    """A blade that narrows to its tip and to its edge, straight or curved."""
    long, wide, bow = length * rng.uniform(0.5, 1), rng.uniform(10, 30), rng.uniform(-0.15, 0.15)
    x = np.linspace(-4, long, 14)
    share = np.clip(x / long, 0, 1)
    half = wide * (1 - rng.uniform(0.2, 0.95) * share ** rng.uniform(1, 4)) / 2
    y = bow * long * share**2
    sharp = rng.uniform(0.25, 1)
    loop_ = np.array([(1, -1), (1, 1), (-1, sharp), (-1, -sharp)])
    across = half[:, None] * loop_[:, 0] + y[:, None]
    up = np.broadcast_to(rng.uniform(1.3, 3) * loop_[:, 1], across.shape)
    return loft(np.stack((np.broadcast_to(x[:, None], across.shape), across, up), -1))


_HEADS: list[Callable[[Generator, float, float], Solid]] = [
    _mallet,
    _paddle,
    _brush,
    _scoop,
    _prongs,
    _jaw,
    _ball,
    _blade,
]

"""Bodies of revolution, solid or hollow, and open containers. Lengths in millimeters."""

from __future__ import annotations

import numpy as np
from manifold3d import CrossSection, JoinType

from dexzoo.sim.families.drawing import Generator, log_uniform, loop, profile
from dexzoo.sim.families.outline import Layer, fitted, layered, polygon, rectangle, rounded, section
from dexzoo.sim.shapes import curves
from dexzoo.sim.shapes.curves import ellipse
from dexzoo.sim.shapes.handles import ear, knob, radius_at
from dexzoo.sim.shapes.shell import pipe, vessel
from dexzoo.sim.shapes.solid import Solid, loft, turned, union


def revolved(rng: Generator) -> Solid:
    """Turned pieces: vases, spindles, jars with a lid, wheels, rings, bells and hollow pipes.

    Args:
        rng: Draws kind, dimensions and details.

    Returns:
        The object, in millimeters; `make_shape` stands it up.
    """
    kind = rng.choice(["turned", "lidded", "wheel", "ring", "vase", "pipe"], p=[0.4, 0.15, 0.12, 0.09, 0.16, 0.08])
    radius = log_uniform(rng, 17, 62)
    height = float(np.clip(radius * log_uniform(rng, 0.5, 6), 18, 270))
    if kind == "turned":
        return loft(turned(profile(rng, radius, height, int(rng.integers(1, 7))), loop(rng)))
    if kind == "lidded":
        side = profile(rng, radius, height, int(rng.integers(1, 4)), 0.35)
        lid = rng.uniform(0.85, 1.1) * float(side[-2, 0])
        dome = profile(rng, lid, rng.uniform(0.1, 0.5) * lid, 2, 0.5, start=height - 1)
        top = knob(max(0.28 * lid, 5), float(dome[-1, 1]) - 1, rng.uniform(0.4, 0.8))
        return union(loft(turned(side)), loft(turned(dome)), top)
    if kind == "wheel":
        width = radius * rng.uniform(0.15, 0.6)
        rim = profile(rng, radius, width, int(rng.integers(1, 4)), 0.25)
        hub = profile(rng, radius * rng.uniform(0.15, 0.5), width * rng.uniform(1.2, 3.5), 2, 0.4)
        hub[:, 1] -= (hub[-1, 1] - width) / 2
        return union(loft(turned(rim)), loft(turned(hub, loop(rng))))
    if kind == "ring":
        thick = np.array([rng.uniform(0.12, 0.33), rng.uniform(0.12, 0.45)]) * radius
        points = loop(rng, 16) * thick + [radius - thick[0], 0]
        angle = 2 * np.pi * np.arange(36) / 36
        around = np.column_stack((np.cos(angle), np.sin(angle))) * [1, rng.uniform(0.7, 1)]
        flat = around[:, None] * points[None, :, :1]
        return loft(np.concatenate((flat, np.broadcast_to(points[:, 1:], (36, len(points), 1))), -1), closed=True)
    side = profile(rng, radius, height, int(rng.integers(1, 4)), 0.45)
    wall = rng.uniform(2.5, 5)
    if kind == "vase":
        return vessel(side[:-1], wall, 24, rng.uniform(3, 12))
    return pipe(side[1:-1], wall, 24)


def container(rng: Generator) -> Solid:
    """Open containers: bowls, beakers and dishes; boxes, trays and troughs of many outlines, some with a handle.

    Args:
        rng: Draws kind, dimensions and details.

    Returns:
        The object, in millimeters; `make_shape` stands it up.
    """
    return _round_container(rng) if rng.random() < 0.45 else _walled_container(rng)


def _round_container(rng: Generator) -> Solid:
    """A vessel of revolution with one or two handles or none."""
    radius = log_uniform(rng, 24, 95)
    height = float(np.clip(radius * log_uniform(rng, 0.3, 3.2), 15, 210))
    foot = radius * rng.uniform(0.35, 1)
    belly = radius * rng.uniform(0.75, 1.15)
    middle = [(belly, height * rng.uniform(0.25, 0.7), rng.uniform(5, 40))] if rng.random() < 0.7 else []
    stand = [(foot, 0, 1), (foot, 0.12 * height, 2)] if rng.random() < 0.25 else [(foot, 0, rng.uniform(1, 12))]
    side = curves.rounded([(5, 0), *stand, *middle, (radius, height)])
    wall = rng.uniform(2, 5)
    handles: list[Solid] = []
    if height > 40 and rng.random() < 0.4:
        high, low = rng.uniform(0.7, 0.88) * height, rng.uniform(0.15, 0.4) * height
        ends = [(radius_at(side[1:], z) - wall / 2, z) for z in (high, low)]
        reach = rng.uniform(16, 40)
        handle = ear(ends[0], ends[1], reach, rng.uniform(3.5, 8), rng.uniform(3, 5.5), rng.uniform(8, 45))
        handles = [handle, handle.moved(degrees=180)][: 1 if rng.random() < 0.7 else 2]
    budget = 24 - sum(len(handle.parts) for handle in handles)
    pot = vessel(side, wall, budget, rng.uniform(1, 3) * wall)
    return union(pot, *handles) if handles else pot


def _walled_container(rng: Generator) -> Solid:
    """A floor with a wall around it, upright or slanted; compartments, and lugs at the rim in some."""
    width = log_uniform(rng, 36, 230)
    depth = float(np.clip(width * log_uniform(rng, 0.3, 1), 32, 160))
    height = float(np.clip(depth * log_uniform(rng, 0.2, 1.6), 14, 180))
    wall, bottom = rng.uniform(2.5, 6), 1.0 if rng.random() < 0.4 else rng.uniform(0.6, 1)
    floor = rng.uniform(1, 2.5) * wall
    rim = fitted(_rim(rng), width, depth)
    pockets = rim.offset(-wall, JoinType.Miter)
    num = int(rng.integers(1, 4)) if rng.random() < 0.3 else 0
    for x in np.linspace(-0.5, 0.5, num + 2)[1:-1]:
        pockets -= rectangle(wall, 2 * depth).translate((x * width, 0))
    level = bottom + (1 - bottom) * floor / height  # size of a section at the top of the floor
    inside = rim.offset(-wall / 2, JoinType.Miter).scale((bottom, bottom))
    layers = [
        Layer((rim - pockets).scale((bottom, bottom)), 0, height, 1 / bottom),
        Layer(inside, 0.1, floor, level / bottom),
    ]
    if rng.random() < 0.3:
        lug = rounded(rectangle(rng.uniform(0.12, 0.25) * width + 14, min(rng.uniform(20, 70), 0.6 * depth)), 4)
        for side in (-1, 1)[: int(rng.integers(1, 3))]:
            outside = lug.translate((side * width / 2, 0)) - rim.offset(-wall / 2, JoinType.Miter)
            layers.append(Layer(outside, height - rng.uniform(4, 7), height - 0.1))
    return layered(*layers)


def _rim(rng: Generator) -> CrossSection:
    """The outline of a walled container, of any size."""
    kind = rng.choice(["box", "round box", "corners", "oval", "concave"], p=[0.22, 0.22, 0.2, 0.16, 0.2])
    if kind == "box":
        return rectangle(1, 1)
    if kind == "round box":
        return rounded(rectangle(100, 100), rng.uniform(8, 30))
    if kind == "corners":
        return polygon(rng, int(rng.integers(3, 9)), 0.15).hull()
    if kind == "oval":
        return section(ellipse(rng.uniform(2, 3.5), 32))
    return rounded(polygon(rng, int(rng.integers(5, 9)), 0.6).scale((50, 50)), 3)

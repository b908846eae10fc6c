"""Bodies put together from others: unions and cuts of solids, and bodies with handles. Lengths in millimeters."""

from __future__ import annotations

import numpy as np
from manifold3d import CrossSection, Manifold

from dexzoo.sim.families.decomposition import decompose, to_manifold, to_mesh
from dexzoo.sim.families.drawing import Generator, ellipsoid, log_uniform, loop, profile
from dexzoo.sim.families.outline import Layer, disc, fitted, layered, pierced, polygon, rounded
from dexzoo.sim.shapes.curves import Array, ellipse
from dexzoo.sim.shapes.handles import ear, grip, knob, radius_at, spout
from dexzoo.sim.shapes.solid import Solid, loft, turned, union

_ATTEMPTS = 6


def carved(rng: Generator) -> Solid:
    """Two to six blocks, wedges, cylinders, prisms and balls, joined and cut from each other: steps, slots, holes.

    Args:
        rng: Draws kind, dimensions and details.

    Returns:
        The object, in millimeters; `make_shape` stands it up.
    """
    num = int(rng.integers(2, 7))
    half = np.array([log_uniform(rng, 16, 75) for _ in range(3)])
    solid = _block(rng, half, [0.4, 0.2, 0.25, 0.15, 0.0])
    for _ in range(num - 1):
        for _ in range(_ATTEMPTS):
            changed = _changed(rng, solid, half)
            pieces = changed.decompose()
            largest = max(pieces, key=lambda piece: piece.volume(), default=changed)
            if 0.06 < abs(largest.volume() / solid.volume() - 1) < 0.6:
                solid = largest
                break
    mesh = to_mesh(solid)
    return Solid(mesh, decompose(mesh))


def _changed(rng: Generator, solid: Manifold, half: Array) -> Manifold:
    """A solid with another one joined to it or cut from it."""
    place = rng.uniform(-0.9, 0.9, 3) * (rng.random(3) < 0.7)
    size = half * rng.uniform(0.2, 0.75, 3)
    if rng.random() < 0.65:
        if rng.random() < 0.55:
            size[rng.integers(3)] = 2.5 * half.max()  # all through
        other = _block(rng, np.maximum(size, 5), [0.45, 0.15, 0.22, 0.13, 0.05])
        if rng.random() < 0.25:
            other = other.rotate((rng.uniform(-45, 45, 3) * (rng.random(3) < 0.5)).tolist())
        if rng.random() < 0.7:
            place[rng.integers(3)] = rng.choice([-1, 1])  # at a face
        return solid - other.translate((place * half).tolist())
    other = _block(rng, np.maximum(size, 8), [0.35, 0.2, 0.22, 0.13, 0.1])
    if rng.random() < 0.25:
        other = other.rotate((rng.uniform(-45, 45, 3) * (rng.random(3) < 0.5)).tolist())
    axis = int(rng.integers(3))
    place[axis] = rng.choice([-1, 1]) * (1 + 0.5 * size[axis] / half[axis])
    return solid + other.translate((place * half).tolist())


def _block(rng: Generator, half: Array, odds: list[float]) -> Manifold:
    """A simple convex solid of these half sizes.

    odds: probabilities of a box, a cylinder, a prism, a wedge and a ball.
    """
    kind = rng.choice(["box", "cylinder", "prism", "wedge", "ball"], p=odds)
    if kind == "box":
        return Manifold.cube((2 * half).tolist(), center=True)
    if kind == "ball":
        return to_manifold(ellipsoid(half, rows=13).mesh)
    taper = rng.uniform(0.1, 0.6) if kind == "wedge" else 1.0
    base = disc(1, 28) if kind == "cylinder" else polygon(rng, int(rng.integers(3, 7)), 0.05).hull()
    axis = int(rng.integers(3))
    width, depth = np.roll(2 * half, -axis - 1)[:2]
    height = 2 * half[axis]
    upright = fitted(base, width, depth).extrude(height, scale_top=(taper, taper)).translate((0, 0, -height / 2))
    onto = np.roll(np.eye(3), axis + 1, axis=0)  # the z axis to the one drawn, the others in turn
    return upright.transform(np.hstack((onto, np.zeros((3, 1)))))


def body(rng: Generator) -> Solid:
    """Closed bodies with things put onto them: loops, long grips, spouts, knobs, feet, fins and eyelets.

    Args:
        rng: Draws kind, dimensions and details.

    Returns:
        The object, in millimeters; `make_shape` stands it up.
    """
    radius = log_uniform(rng, 20, 62)
    height = float(np.clip(radius * log_uniform(rng, 0.8, 4), 30, 210))
    side = profile(rng, radius, height, int(rng.integers(1, 5)), 0.4)
    section = ellipse(2, 40) if rng.random() < 0.5 else loop(rng)
    flat = rng.uniform(0.55, 1) if rng.random() < 0.4 else 1.0
    solids = [loft(turned(side, section) * [1, flat, 1])]
    if rng.random() < 0.35:
        solids = [_prism(rng, radius, height)]
        side = np.array([(radius, 0), (radius, height)])
    on = rng.random(6) < [0.55, 0.2, 0.4, 0.45, 0.2, 0.3]
    if not on[:4].any():
        on[rng.integers(4)] = True
    if on[0]:
        solids += _loops(rng, side, height)
    if on[1]:
        solids.append(_long_grip(rng, side, height))
    if on[2]:
        low, high = rng.uniform(0.25, 0.7) * height, rng.uniform(0.8, 1.15) * height
        root = rng.uniform(8, 15)
        tip = (radius + rng.uniform(18, 60), high)
        beak = spout((_wall(side, low) - 6, low), tip, root, rng.uniform(0.35, 0.8) * root, rng.uniform(0, 10))
        solids.append(beak)
    if on[3]:
        top = float(side[-2, 0])
        size = float(np.clip(rng.uniform(0.25, 0.8) * top, 5, 22))
        solids.append(knob(size, height - 0.5, rng.uniform(0.35, 0.8)))
    foot, ring = float(np.clip(0.22 * radius, 4, 12)), 0.7 * float(side[1, 0])
    if on[4] and ring * flat > 1.6 * foot:
        num = int(rng.integers(3, 5))
        for angle in 2 * np.pi * (np.arange(num) + 0.5) / num:
            at = (ring * np.cos(angle), ring * np.sin(angle) * flat, -0.5 * foot)
            solids.append(ellipsoid([foot, foot, 1.6 * foot]).moved(at))
    if on[5]:
        solids += _fins(rng, radius, height)
    return union(*solids) if len(solids) > 1 else solids[0]


def _wall(side: Array, height: float) -> float:
    """The radius of the body's side at a height, its caps left out."""
    return radius_at(side[1:-1] if len(side) > 3 else side, height)


def _prism(rng: Generator, radius: float, height: float) -> Solid:
    """A body that is a superellipsoid, or a prism with or without holes."""
    if rng.random() < 0.5:
        half = [radius, radius * rng.uniform(0.5, 1), height / 2]
        return ellipsoid(half, rng.uniform(0.3, 1), rng.uniform(0.3, 1), 21).moved((0, 0, height / 2))
    outline = polygon(rng, int(rng.integers(3, 8)), 0.3).scale((50, 50))
    outline = fitted(rounded(outline.hull(), 4), 2 * radius, 2 * radius * rng.uniform(0.5, 1))
    if rng.random() < 0.6:
        outline = pierced(rng, outline)
    return layered(Layer(outline, 0, height, rng.uniform(0.6, 1)))


def _loops(rng: Generator, side: Array, height: float) -> list[Solid]:
    """One or two ears at the side, or a bail over the top."""
    size = rng.uniform(3.5, 8), rng.uniform(3, 6)
    if rng.random() < 0.25:  # a bail
        reach, up = _wall(side, 0.8 * height) - 3, rng.uniform(25, 60)
        knots = [(-reach, 0.8 * height), (-reach, height + up, 60), (reach, height + up, 60), (reach, 0.8 * height)]
        return [grip(knots, [size[0]], [size[1]], 2.3)]
    high, low = rng.uniform(0.65, 0.9) * height, rng.uniform(0.1, 0.4) * height
    ends = [(_wall(side, z) - 3, z) for z in (high, low)]
    handle = ear(ends[0], ends[1], rng.uniform(18, 45), *size, rng.uniform(6, 45), rng.uniform(0.6, 1.1))
    return [handle, handle.moved(degrees=int(rng.choice([90, 120, 180])))][: 1 if rng.random() < 0.65 else 2]


def _long_grip(rng: Generator, side: Array, height: float) -> Solid:
    """A grip that stands off to one side."""
    z = rng.uniform(0.3, 0.85) * height
    root, length, rise = _wall(side, z) - 5, rng.uniform(60, 130), rng.uniform(-0.2, 0.5) * height
    width, thick = rng.uniform(6, 13), rng.uniform(5, 10)
    path = [(root, z), (root + 0.4 * length, z + 0.3 * rise, 25), (root + length, z + rise)]
    grip_ = grip(path, [0.7 * width, width, width], [0.7 * thick, thick, thick], rng.uniform(2, 4))
    return grip_.moved(degrees=int(rng.choice([0, 90, 180])))


def _fins(rng: Generator, radius: float, height: float) -> list[Solid]:
    """Flat fins around the body, or rings to hang it by."""
    num = int(rng.integers(2, 5))
    thick, reach = rng.uniform(3, 7), rng.uniform(8, 30)
    low, high = sorted(rng.uniform(0, 1, 2) * height)
    high = max(high, low + 12)
    fins = []
    for turn in range(num):
        points = np.array([(0.4 * radius, low), (radius + reach, low), (radius + reach * rng.uniform(0, 1), high)])
        points = np.concatenate((points, [[0.4 * radius, high]]))
        outline = CrossSection([points.tolist()]).hull()
        fin = layered(Layer(outline, -thick / 2, thick / 2)).moved(degrees=90, axis="x")
        fins.append(fin.moved(degrees=360 / num * turn))
    return fins

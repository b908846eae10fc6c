"""Open vessels: bowls, cups, mugs, teacups, jugs, plates, pans and funnels. Lengths in millimeters."""

from __future__ import annotations

import numpy as np

from dexzoo.sim.shapes.curves import Array, Number, rounded
from dexzoo.sim.shapes.handles import ear, grip, radius_at
from dexzoo.sim.shapes.shell import pipe, vessel
from dexzoo.sim.shapes.solid import Solid, loft, turned, union


def bowl(rng: np.random.Generator, style: int) -> Solid:
    """Cereal, noodle, mixing and deep bowls, and straight ramekins.

    Args:
        rng: Draws the dimensions.
        style: Number of the object, which chooses the style.
    """
    u = rng.uniform
    kind = ("cereal", "noodle", "mixing", "deep", "ramekin")[style % 5]
    if kind == "cereal":
        r, h, foot = u(58, 68), u(46, 56), u(26, 31)
        return vessel(
            rounded([(5, 0), (foot, 0, 1), (foot + 2, 4, 2), (0.88 * r, 0.35 * h, 30), (r, h)]), u(3, 4), 24, 7
        )
    if kind == "noodle":
        r, h, foot = u(60, 74), u(52, 64), u(25, 30)
        return vessel(rounded([(5, 0), (foot, 0, 1), (foot, 6, 1), (0.6 * r, 0.3 * h, 12), (r, h)]), u(3, 4), 24, 10)
    if kind == "mixing":
        r, h, foot = u(60, 70), u(50, 60), u(34, 38)
        return vessel(rounded([(5, 0), (foot, 0, 3), (0.82 * r, 0.35 * h, 12), (r, h)]), u(2.8, 3.4), 24)
    if kind == "deep":
        r, h, foot = u(47, 55), u(58, 70), u(28, 33)
        return vessel(
            rounded([(5, 0), (foot, 0, 1), (foot, 4, 2), (0.98 * r, 0.3 * h, 24), (r, h)]), u(3.5, 4.5), 24, 8
        )
    r, h = u(38, 48), u(38, 50)
    return vessel(rounded([(5, 0), (0.9 * r, 0, 4), (r, h)]), u(4, 5), 24)


def cup(rng: np.random.Generator, style: int) -> Solid:
    """Cups without a handle: tumblers, paper cups, beakers with a rim, shot glasses, goblets and wine glasses.

    Args:
        rng: Draws the dimensions.
        style: Number of the object, which chooses the style.
    """
    u = rng.uniform
    kind = ("tumbler", "paper", "beaker", "wine", "goblet", "barrel")[style % 6]
    if kind == "tumbler":
        r, h = u(32, 40), u(85, 130)
        return vessel(rounded([(5, 0), (u(0.82, 1) * r, 0, 4), (r, h)]), u(2.5, 3.5), 22, u(5, 10))
    if kind == "paper":
        r, h = u(36, 42), u(90, 120)
        return vessel(rounded([(5, 0), (0.68 * r, 0), (r, h - 3), (r + 1.2, h)]), 2.2, 24)
    if kind == "beaker":
        r, h = u(35, 41), u(80, 110)
        return vessel(rounded([(5, 0), (0.8 * r, 0, 6), (0.92 * r, 0.7 * h, 10), (r, h)]), 2.5, 24)
    if kind == "barrel":
        r, h = u(30, 35), u(60, 85)
        return vessel(rounded([(5, 0), (0.82 * r, 0, 3), (1.04 * r, 0.5 * h, 50), (0.92 * r, h)]), u(3, 4), 24, 6)
    foot, stem = u(28, 33), u(45, 70) if kind == "wine" else u(25, 35)
    r, h = u(32, 37), u(60, 75)
    thick = u(3.5, 4.5) if kind == "wine" else u(6, 8)
    base = [(0.8 * foot, 0), (foot, 0, 1), (foot, 3, 1), (2 * thick, 7, 10), (thick, 20, 12), (thick, stem - 3)]
    side = [(1.12 * r, stem + 0.3 * h, 30), (0.9 * r, stem + h)] if kind == "wine" else [(r, stem + h)]
    start = [(6, stem), (0.55 * r, stem + 2, 8)] if kind == "wine" else [(6, stem), (0.7 * r, stem, 5)]
    glass = vessel(rounded([*start, *side]), 2.6, 21, 8 if kind == "wine" else 4)
    return union(loft(turned(rounded([*base, (thick + 1, stem + 2)]))), glass)


def mug(rng: np.random.Generator, style: int) -> Solid:
    """Straight, barrel, tapered, flared and camping mugs with one handle.

    Args:
        rng: Draws the dimensions.
        style: Number of the object, which chooses the style.
    """
    u = rng.uniform
    kind = ("straight", "tapered", "barrel", "camping", "waisted")[style % 5]
    r, h, wall = u(36, 42), u(82, 108), u(3, 4.5)
    side = {
        "straight": [(r, 0, 4), (r, h)],
        "tapered": [(0.8 * r, 0, 5), (r, h)],
        "barrel": [(0.88 * r, 0, 5), (1.03 * r, 0.5 * h, 50), (0.93 * r, h)],
        "camping": [(r, 0, 7), (r, 0.8 * h - 3), (r + 2.5, 0.8 * h)],
        "waisted": [(0.98 * r, 0, 4), (0.88 * r, 0.5 * h, 50), (r, h)],
    }[kind]
    profile = rounded([(5, 0), *side])
    top = profile[-1, 1]
    high, low = u(0.76, 0.84) * top, u(0.16, 0.26) * top
    loop = _loop(profile, wall, high, low, u(26, 34), (u(5.5, 8), u(3.5, 5)), u(10, 45), u(0.75, 1.05))
    return union(vessel(profile, wall, 24 - len(loop.parts)), loop)


def teacup(rng: np.random.Generator, style: int) -> Solid:
    """Low wide cups with a small handle: hemispherical, flared, conical and upright.

    Args:
        rng: Draws the dimensions.
        style: Number of the object, which chooses the style.
    """
    u = rng.uniform
    kind = ("round", "flared", "cone", "upright")[style % 4]
    r, h, wall = u(39, 45), u(50, 62), u(2.6, 3.2)
    foot = u(18, 22)
    side = {
        "round": [(foot, 0, 1), (foot, 4, 1), (0.95 * r, 0.3 * h, 25), (r, h)],
        "flared": [(foot, 0, 1), (foot, 4, 1), (0.8 * r, 0.35 * h, 14), (r, h)],
        "cone": [(foot + 2, 0, 2), (0.66 * r, 0.25 * h, 12), (r, h)],
        "upright": [(0.8 * r, 0, 9), (0.92 * r, h)],
    }[kind]
    profile = rounded([(5, 0), *side])
    high, low = 0.84 * h, 0.34 * h
    loop = _loop(profile, wall, high, low, u(20, 26), (u(3.5, 5), u(2.8, 3.6)), u(10, 30), 0.9)
    return union(vessel(profile, wall, 24 - len(loop.parts), 6 if len(side) > 3 else None), loop)


def jug(rng: np.random.Generator, style: int) -> Solid:
    """Measuring jugs, pitchers, creamers and water jugs, with a lip and a handle.

    Args:
        rng: Draws the dimensions.
        style: Number of the object, which chooses the style.
    """
    u = rng.uniform
    kind = ("measuring", "pitcher", "creamer", "water")[style % 4]
    r, h = {
        "measuring": (u(43, 50), u(90, 115)),
        "creamer": (u(33, 38), u(68, 85)),
        "pitcher": (u(35, 39), u(115, 135)),
    }.get(kind, (u(40, 44), u(125, 155)))
    side = {
        "measuring": [(0.82 * r, 0, 5), (r, h)],
        "pitcher": [(0.84 * r, 0, 4), (r, 0.38 * h, 14), (0.8 * r, h)],
        "creamer": [(0.85 * r, 0, 4), (r, 0.42 * h, 15), (0.8 * r, h)],
        "water": [(r, 0, 5), (0.8 * r, h)],
    }[kind]
    profile, wall = rounded([(5, 0), *side]), u(3, 3.8)
    reach = u(0.5, 0.62) * r if kind == "creamer" else u(32, 42)
    loop = _loop(profile, wall, 0.84 * h, 0.22 * h, reach, (u(6, 8), u(4, 5.5)), u(14, 45), u(0.75, 1.0))
    return union(vessel(profile, wall, 24 - len(loop.parts), lip=u(6, 8)), loop)


def plate(rng: np.random.Generator, style: int) -> Solid:
    """Dinner and side plates, soup plates, and flat ones with an upright edge.

    Args:
        rng: Draws the dimensions.
        style: Number of the object, which chooses the style.
    """
    u = rng.uniform
    kind = ("dinner", "soup", "flat")[style % 3]
    r = u(75, 105)
    if kind == "dinner":
        side = [(0.6 * r, 0, 2), (0.68 * r, 5, 5), (r, u(13, 18))]
    elif kind == "soup":
        side = [(0.52 * r, 0, 2), (0.68 * r, 16, 8), (r, u(22, 27))]
    else:
        side = [(0.88 * r, 0, 4), (0.96 * r, u(12, 18))]
    return vessel(rounded([(5, 0), *side]), u(3, 4), 24)


def pan(rng: np.random.Generator, style: int) -> Solid:
    """Frying, crepe, saute and sauce pans with a long handle.

    Args:
        rng: Draws the dimensions.
        style: Number of the object, which chooses the style.
    """
    u = rng.uniform
    kind = ("frying", "sauce", "crepe", "saute")[style % 4]
    r = {"frying": u(78, 98), "sauce": u(58, 72), "crepe": u(80, 100), "saute": u(76, 92)}[kind]
    h = {"frying": u(34, 44), "sauce": u(60, 80), "crepe": u(18, 24), "saute": u(44, 56)}[kind]
    side = {
        "frying": [(0.76 * r, 0, 4), (r, h)],
        "sauce": [(0.97 * r, 0, 5), (r, h)],
        "crepe": [(0.86 * r, 0, 4), (r, h)],
        "saute": [(0.95 * r, 0, 5), (r, h)],
    }[kind]
    profile, wall = rounded([(5, 0), *side]), u(2.8, 3.6)
    z = h - u(8, 12)
    length, rise = u(120, 165), u(8, 30)
    root = radius_at(profile, z) - wall / 2
    path = [(root, z), (root + 35, z + 0.2 * rise, 25), (root + 60, z + 0.5 * rise, 20), (root + length, z + rise)]
    handle = grip(path, [9, 8, u(8, 10), u(10, 13), u(10, 13)], [3.2, 4, u(6, 8), u(6, 9), u(6, 8)])
    return union(vessel(profile, wall, 24 - len(handle.parts), 4), handle)


def funnel(rng: np.random.Generator, style: int) -> Solid:
    """Funnels standing on their mouth: wide and slim ones, some with a straight collar.

    Args:
        rng: Draws the dimensions.
        style: Number of the object, which chooses the style.
    """
    u = rng.uniform
    r, h, stem = u(38, 55), u(40, 60), u(30, 60)
    neck = u(6.5, 10)
    collar = [(r, 0), (r, u(8, 16), 2)] if style % 2 else [(r, 0)]
    start = collar[-1][1]
    return pipe(rounded([*collar, (neck, start + h, 3), (0.7 * neck, start + h + stem)]), u(2, 2.6), 24)


def _loop(
    profile: Array,
    wall: Number,
    high: Number,
    low: Number,
    reach: Number,
    size: tuple[Number, Number],
    bend: Number,
    taper: Number,
) -> Solid:
    """A handle whose ends lie inside of the wall."""
    a, b = (radius_at(profile[1:], z) - wall / 2 for z in (high, low))
    return ear((a, high), (b, low), reach, *size, bend, taper)

"""Long flat things, lying along x: forks, spoons, knives, spatulas, scissors, a dustpan. Lengths in millimeters."""

from __future__ import annotations

import numpy as np

from dexzoo.sim.shapes.curves import Array, Number, divided, ellipse, rounded
from dexzoo.sim.shapes.handles import grip
from dexzoo.sim.shapes.shell import sheet
from dexzoo.sim.shapes.solid import Solid, loft, swept, turned, union


def fork(rng: np.random.Generator, style: int) -> Solid:
    """Dinner forks of three and four tines, dessert and serving forks, and carving forks of two.

    Args:
        rng: Draws the dimensions.
        style: Number of the object, which chooses the style.
    """
    u = rng.uniform
    tines, width, reach = ((4, 12.5, 46.0), (3, 11.5, 42.0), (4, 15.0, 52.0), (2, 9.0, 58.0))[style % 4]
    width, reach, thick = width * u(0.94, 1.06), reach * u(0.92, 1.08), u(1.1, 1.4)
    length, rise = u(110, 135), u(10, 15)
    root = 0.34 * reach  # where the tines part

    def spine(x: Array) -> Array:
        return rise * (1 - np.clip(x / reach, 0, 1.2) ** 0.9) + 0.28 * rise * np.clip(x / reach, 0, 1) ** 4 + thick

    half = 0.3 * width * (2 / tines if tines < 4 else 0.62)
    gap = 2 * (width - half) / (tines - 1)
    parts = [_neck(length, rise + thick, thick, u(8, 11), u(2.4, 3.2), style // 4 % 2 == 0)]
    along = np.linspace(-4, root + 2, 9)
    spread = np.interp(along, [-4, 2, 0.8 * root, root + 2], [3.2, 5, width, width])
    parts.append(loft(swept(np.column_stack((along, spine(along))), spread, thick, 5)))
    x = np.linspace(root, reach, 9)
    taper = half * np.sqrt(np.clip(1.15 - ((x - root) / (reach - root)) ** 3, 0.25, 1))
    for k in range(tines):
        parts.append(loft(swept(np.column_stack((x, spine(x))), taper, thick, 4)).moved((0, k * gap - width + half, 0)))
    return union(*parts)


def spoon(rng: np.random.Generator, style: int) -> Solid:
    """Table, soup, tea and serving spoons, and wooden ones.

    Args:
        rng: Draws the dimensions.
        style: Number of the object, which chooses the style.
    """
    u = rng.uniform
    kind = ("table", "soup", "serving", "tea", "wooden")[style % 5]
    long, wide, depth = {
        "table": (u(30, 34), u(19, 22), u(7, 9)),
        "soup": (u(25, 28), u(23, 26), u(8, 10)),
        "serving": (u(36, 42), u(26, 31), u(9, 11)),
        "tea": (u(22, 25), u(14, 16), u(5.5, 7)),
        "wooden": (u(32, 38), u(22, 27), u(6, 8)),
    }[kind]
    wood = kind == "wooden"
    thick = u(3.5, 4.5) if wood else u(2, 2.4)
    length = u(190, 230) if wood else 3.9 * long if kind != "serving" else 4.2 * long
    dish = _dish(long, wide, depth, thick, egg=0.0 if kind == "soup" else u(0.1, 0.22))
    top = depth + thick
    if wood:
        path = [(-long + 2, top - 4), (-long - 30, top + 2, 25), (-long - length, u(6, 8))]
        handle = grip(path, [4, 5, 5.5, 6, 7], [2.2, 4, 5, 5.5, 6], 2.0)
    else:
        flare = u(7, 10.5) * (0.75 if kind == "tea" else 1)
        handle = _neck(length, top - thick / 2, thick / 2, flare, u(2.4, 3.2), style // 5 % 2 == 0).moved(
            (-long + 4, 0, 0)
        )
    return union(dish, handle)


def knife(rng: np.random.Generator, style: int) -> Solid:
    """Chef's, table, bread, paring, butcher's and butter knives.

    Args:
        rng: Draws the dimensions.
        style: Number of the object, which chooses the style.
    """
    u = rng.uniform
    kind = ("chef", "table", "bread", "paring", "cleaver", "butter")[style % 6]
    if kind in ("table", "butter"):
        return _table_knife(rng, kind == "butter")
    length, width, grip_length = {
        "chef": (u(150, 185), u(36, 44), u(105, 120)),
        "bread": (u(170, 200), u(26, 32), u(105, 120)),
        "paring": (u(75, 100), u(18, 23), u(90, 105)),
        "cleaver": (u(130, 155), u(62, 75), u(105, 120)),
    }[kind]
    x = np.linspace(0, 1, 15)
    edge = {
        "chef": -width * (1 - 0.76 * x**2.6),
        "bread": -width * (1 - 0.75 * np.clip((x - 0.8) / 0.2, 0, 1) ** 2),
        "paring": -width * (1 - 0.95 * x**2),
        "cleaver": -width * (1 - 0.06 * x),
    }[kind]
    spine = np.zeros(15) - (0.18 * width * x**3 if kind == "chef" else 0)
    spine = np.minimum(spine, 0.0)
    edge = np.minimum(edge, spine - 0.06 * width)
    thick, handle = u(1.1, 1.5), u(7, 9)
    blade = _blade(np.column_stack((length * x, spine, edge)), thick).moved((0, 0, handle))
    middle = -0.5 * min(width, 26)
    half = 0.5 * min(width, 26)
    bolster = [0.75 * half, 0.9 * half, u(0.7, 0.85) * half, half, u(0.95, 1.15) * half]
    heft = grip([(6, handle), (-grip_length, handle)], bolster, [handle - 2, handle, handle, handle, handle - 1], 2.8)
    return union(blade, heft.moved((0, middle, 0)))


def spatula(rng: np.random.Generator, style: int) -> Solid:
    """Turners with a bent neck, dough scrapers of rubber, and wooden and fish turners.

    Args:
        rng: Draws the dimensions.
        style: Number of the object, which chooses the style.
    """
    u = rng.uniform
    kind = ("turner", "rubber", "wooden", "fish")[style % 4]
    if kind == "rubber":
        long, wide, thick = u(75, 95), u(24, 30), u(2.2, 3)
        path = np.column_stack((np.linspace(0, long, 13), np.full(13, thick)))
        tip = np.sqrt(np.clip(1 - ((path[:, 0] / long - 0.8) / 0.205).clip(0, 1) ** 2, 0.12, 1))
        blade = loft(swept(path, wide * np.interp(path[:, 0], [0, 12], [0.6, 1]) * tip, thick, 5))
        handle = grip([(8, thick + 1), (-40, 6, 30), (-u(170, 200), 6)], [6, 5, 6, 9, 9], [thick, 4, 5, 6, 5.5], 3)
        return union(blade, handle)
    long, wide, thick = {
        "turner": (u(80, 100), u(34, 42), u(1.1, 1.4)),
        "wooden": (u(85, 105), u(25, 32), u(2, 2.6)),
        "fish": (u(120, 145), u(28, 36), u(1.1, 1.3)),
    }[kind]
    path = np.column_stack((np.linspace(0, long, 11), np.full(11, thick)))
    share = path[:, 0] / long
    blade = loft(swept(path, wide * np.interp(share, [0, 0.18, 1], [0.55, 0.86, 1]), thick, 8, 28))
    rise, length = (u(14, 22), u(150, 175)) if kind == "wooden" else (u(24, 36), u(165, 205))
    corners = [(4, thick), (-6, thick, 4), (-0.2 * length, rise, 20), (-length, u(7, 9))]
    sizes = (
        ([9.0, 8, 8, 9, 9], [thick, 4, 5, 6, 5])
        if kind == "wooden"
        else ([9.0, 5, 5, 11, 11, 10], [thick, 2, 2.5, 6, 7, 5])
    )
    return union(blade, grip(corners, *sizes))


def scissors(rng: np.random.Generator, style: int) -> Solid:
    """Paper, sewing, children's and kitchen scissors, from closed to a third open.

    Args:
        rng: Draws the dimensions.
        style: Number of the object, which chooses the style.
    """
    u = rng.uniform
    blade, rings = ((90.0, 1.0), (75.0, 0.95), (55.0, 0.9), (85.0, 1.15))[style % 4]
    blade, open_angle = blade * u(0.92, 1.08), (3.0, 12.0, 20.0)[style % 3] * u(0.8, 1.2)
    thick, width, shank = u(1.3, 1.6), u(7, 9), u(34, 46)
    halves = []
    for side, level in ((1, 4.0 - 0.75 * thick), (-1, 4.0 + 0.75 * thick)):
        x = np.linspace(-10, blade, 9)
        share = np.clip(x / blade, 0, 1)
        edge = np.column_stack(
            (x, side * (0.9 * width * (1 - 0.75 * share**1.6)), -side * np.interp(x, [-10, 0, blade], [5, 5, 0.6]))
        )
        half = [_blade(edge, thick, 0.8).moved((0, 0, level))]
        long, wide, tube = 17 * rings * u(0.95, 1.15), 12.5 * rings, u(3.2, 4)
        middle = (-shank - long, -side * (wide + 4.5))
        arm = _bar(
            [(0, -side * 1.0), (-0.4 * shank, -side * 4), (middle[0] + 0.8 * long, middle[1])], 4.5, 0, level, thick
        )
        half += [arm, _ring(middle, (long, wide), tube)]
        halves.append(union(*half).moved((0, 0, 0), side * open_angle / 2))
    pivot = loft(
        turned(rounded([(3, 4 - 2.6 * thick), (3.6, 4 + 2.6 * thick, 1), (0.5, 4 + 2.8 * thick)]), ellipse(2, 20))
    )
    return union(*halves, pivot)


def dustpan(rng: np.random.Generator, style: int) -> Solid:
    """A hand dustpan: a tray open in front, with a low back wall and a handle behind.

    Args:
        rng: Draws the dimensions.
        style: Number of the object, which chooses the style.
    """
    u = rng.uniform
    x, y, wall, h = u(78, 84), u(82, 90), 3.0, u(38, 44)
    floor = hull_prism([(-x, 0), (-x, wall), (x - 20, wall), (x, 0.6), (x, 0)], -y, y)
    sides = [
        hull_prism([(-x, 0), (-x, h), (-x + 30, h), (x, 4), (x, 0)], s * y - wall / 2, s * y + wall / 2)
        for s in (-1, 1)
    ]
    back = hull_prism([(-x - 1, 0), (-x - 1, h), (-x + 2, h), (-x + 2, 0)], -y, y)
    path = [(-x + 1, h - 6), (-x - 30, h - 3, 20), (-x - u(105, 125), h + 4)]
    handle = grip(path, [20, 13, 12, 14, 13], [5, 5.5, 6.5, 7, 6])
    return union(floor, *sides, back, handle)


def hull_prism(outline: list[tuple[Number, Number]], start: Number, end: Number) -> Solid:
    """A prism along y over a convex outline.

    Args:
        outline: Corners (x, z).
        start: Least y.
        end: Largest y.
    """
    loop = np.array(outline)
    return loft(np.stack([np.insert(loop, 1, y, axis=1) for y in (start, end)]))


def _neck(length: Number, height: Number, thick: Number, flare: Number, neck: Number, pointed: bool) -> Solid:
    """The handle of fork and spoon, from the head at x = 0 and this height back and down to the table."""
    path = rounded(
        [(3, height), (-0.12 * length, height + 3.5, 12), (-0.55 * length, 0.8 * height, 40), (-length, thick + 0.2)],
        6.0,
    )
    share = (path[0, 0] - path[:, 0]) / np.ptp(path[:, 0])
    end = np.sqrt(np.clip(1 - ((share - 0.9) / 0.102).clip(0, 1) ** (1.2 if pointed else 2), 0.08, 1))
    width = np.interp(share, [0, 0.15, 0.45, 0.9, 1], [neck + 0.6, neck, 0.5 * flare, flare, flare]) * end
    return loft(swept(path, width, np.interp(share, [0, 0.2, 1], [thick, 1.35 * thick, thick]), 3.2))


def _dish(long: Number, wide: Number, depth: Number, thick: Number, egg: Number) -> Solid:
    """The bowl of a spoon: a sheet over an egg-shaped outline, its rim level, its lowest point at z = 0."""
    angle = np.linspace(0.09 * np.pi, 0.93 * np.pi, 21)
    x = -np.cos(angle)
    half = wide * np.sin(angle) * (1 - egg * x)
    across = np.sin(np.linspace(-np.pi / 2, np.pi / 2, 17))
    dip = depth * (1 - np.abs(x[:, None]) ** 2.4) * (1 - np.abs(across) ** 2.4)
    lower = np.empty((len(x), len(across), 3))
    lower[..., 0] = long * x[:, None]
    lower[..., 1] = half[:, None] * across
    lower[..., 2] = depth - dip
    upper = lower + np.array([0, 0, thick])
    return sheet(upper, lower, (5, 3))


def _table_knife(rng: np.random.Generator, butter: bool) -> Solid:
    u = rng.uniform
    length, blade, width = u(190, 225) * (0.8 if butter else 1), 0.46, u(9, 11) * (1.1 if butter else 1)
    share = np.concatenate((np.linspace(0, blade - 0.02, 14), np.linspace(blade + 0.02, 1, 12)))
    tip = np.sqrt(np.clip(1 - ((0.12 - share) / 0.12).clip(0, 1) ** 2, 0.1, 1))
    end = np.sqrt(np.clip(1 - ((share - 0.95) / 0.055).clip(0, 1) ** 2, 0.2, 1))
    outline = np.interp(share, [0, 0.3, blade, blade + 0.04, 1], [width, width, 0.8 * width, 0.55 * width, u(8, 10)])
    thick = np.interp(share, [0, blade - 0.02, blade + 0.03, 0.75, 1], [0.9, 1.4, 3.2, u(3.5, 4.5), u(3, 4)])
    path = np.column_stack((length * (0.5 - share), np.full(len(share), 4.5)))
    return loft(swept(path, outline * tip * end, thick, 2.8))


def _blade(stations: Array, thick: Number, sharp: Number = 0.35) -> Solid:
    """A blade over stations (x, spine y, edge y): half as thick as `thick` says at the spine, thin at the edge."""
    loop = []
    for x, spine, edge in stations:
        y = spine + (edge - spine) * np.array([0, 0, 0.45, 1, 1, 0.45])
        z = thick * np.array([-1, 1, 0.95, sharp, -sharp, -0.95])
        loop.append(np.column_stack((np.full(6, x), y, z)))
    return loft(np.array(loop))


def _bar(points: list[tuple[Number, Number]], start: Number, end: Number, level: Number, thick: Number) -> Solid:
    """A flat bar in the xy plane, of half width `start`."""
    path = divided(np.array(points), 12.0)
    bar = loft(swept(path, thick, start, 4))
    return bar.moved(degrees=-90, axis="x").moved((0, 0, level)) if end == 0 else bar


def _ring(middle: tuple[Number, Number], half: tuple[Number, Number], tube: Number) -> Solid:
    """An oval finger ring, lying on the table."""
    angle = 2 * np.pi * np.arange(40) / 40
    center = np.column_stack((half[0] * np.cos(angle), half[1] * np.sin(angle)))
    normal = np.column_stack((half[1] * np.cos(angle), half[0] * np.sin(angle)))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    loop = tube * ellipse(2.4, 14)
    sections = np.empty((40, 14, 3))
    sections[..., :2] = center[:, None] + normal[:, None] * loop[None, :, :1] + np.array(middle)
    sections[..., 2] = tube + loop[None, :, 1]
    return loft(sections, closed=True)

"""Closed containers and balls: bottles, boxes, cans, shakers, teapots. Lengths in millimeters."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh

from dexzoo.sim.shapes.curves import Number, ellipse, rectangle, rounded
from dexzoo.sim.shapes.handles import ear, knob, radius_at, spout
from dexzoo.sim.shapes.solid import Solid, hull, loft, turned, union

Corners = Sequence[tuple[Number, ...]]


def body(corners: Corners, square: Number = 2, until: Number = np.inf, flat: Number = 1, blend: Number = 30) -> Solid:
    """A solid of revolution.

    Args:
        corners: Corners (radius, height, cut) of its profile.
        square: Exponent of its section up to the height `until`.
        until: Height above which it turns round.
        flat: Depth over width.
        blend: Height within which it turns round.
    """
    profile = rounded(corners, 10 if np.isfinite(until) else None)
    share = np.clip((profile[:, 1] - until) / blend, 0, 1)
    if np.isinf(until):
        share = 0 * profile[:, 1]
    sections = turned(profile, exponent=square + (2 - square) * share)
    sections[..., 1] *= (flat + (1 - flat) * share)[:, None]
    return loft(sections)


def bottle(rng: np.random.Generator, style: int) -> Solid:
    """Wine, water, beer, medicine, whisky, squeeze, soap and milk bottles, closed.

    Args:
        rng: Draws the dimensions.
        style: Number of the object, which chooses the style.
    """
    u = rng.uniform
    kind = ("wine", "water", "beer", "medicine", "whisky", "squeeze", "soap", "milk")[style % 8]
    if kind == "wine":
        r, h, neck = u(29, 37), u(125, 155), u(12, 14)
        top = h + u(85, 105)
        lip = [(neck, top - 12), (neck + 2, top - 12), (neck + 2, top, 1.5), (6, top)]
        return body([(0.5 * r, 0), (r, 0, 5), (r, h, u(20, 40)), (neck, h + u(35, 50), 30), *lip])
    if kind == "water":
        r, h, cap = u(28, 34), u(120, 150), u(13, 15)
        waist = r - u(2.5, 5)
        lower = [(0.6 * r, 0), (r, 0, 9), (r, 0.32 * h, 12), (waist, 0.45 * h, 12), (waist, 0.5 * h, 12)]
        upper = [(r, 0.65 * h, 12), (r, h, 25), (cap - 1, h + 38, 10), (cap - 1, h + 42)]
        return body([*lower, *upper, (cap, h + 42), (cap, h + 57, 2), (5, h + 57)])
    if kind == "beer":
        r, h = u(28, 32), u(105, 125)
        top = h + u(75, 90)
        lip = [(11.5, top - 10), (13.5, top - 10), (13.5, top, 1.5), (6, top)]
        return body([(0.5 * r, 0), (r, 0, 5), (r, h, 25), (15, h + 40, 35), *lip])
    if kind == "medicine":
        r, h = u(24, 38), u(55, 90)
        cap = u(0.55, 0.8) * r
        top = h + u(26, 34)
        shoulder = [(r, h, 10), (cap - 2, h + 9, 3), (cap - 2, h + 12), (cap, h + 12), (cap, top, 2)]
        return body([(0.5 * r, 0), (r, 0, 4), *shoulder, (5, top)])
    if kind == "whisky":
        r, h, cap = u(28, 36), u(105, 140), u(13, 16)
        upper = [(r, h, 9), (cap - 2, h + 16, 8), (cap - 2, h + 34), (cap, h + 34), (cap, h + 54, 2), (5, h + 54)]
        return body([(0.6 * r, 0), (r, 0, 5), *upper], square=u(4, 7), until=h - 4, flat=u(0.65, 1))
    if kind == "squeeze":
        r, h = u(34, 42), u(110, 140)
        cone = [(13, h + 14, 6), (13, h + 24), (11, h + 26), (5, h + u(48, 60), 2), (2, h + 60)]
        return body([(0.6 * r, 0), (r, 0, 8), (u(0.8, 1) * r, h, 25), *cone], until=h - 14, flat=u(0.6, 0.8))
    if kind == "soap":
        r, h, cap = u(32, 38), u(130, 165), u(11, 14)
        side = [(r, 0, 8), (r, 0.3 * h, 40), (0.78 * r, 0.55 * h, 40), (0.95 * r, 0.82 * h, 30), (0.7 * r, h, 25)]
        pump = [(cap - 1, h + 14, 8), (cap - 1, h + 18), (cap, h + 18), (cap, h + 40, 2), (5, h + 40)]
        return body([(0.6 * r, 0), *side, *pump], square=2.4, until=h - 14, flat=u(0.58, 0.8))
    r, h, a = u(34, 41), u(95, 125), u(17, 21)  # milk: a wide neck with a broad lip
    upper = [(r, h, 30), (a, h + 40, 30), (a, h + 62), (a + 4, h + 62), (a + 4, h + 74, 2), (8, h + 74)]
    return body([(0.5 * r, 0), (r, 0, 6), *upper])


def can(rng: np.random.Generator, style: int) -> Solid:
    """Soup, drink, tuna, spray and paint cans, and tubes with a lid.

    Args:
        rng: Draws the dimensions.
        style: Number of the object, which chooses the style.
    """
    u = rng.uniform
    kind = ("soup", "drink", "spray", "tuna", "coffee", "tube")[style % 6]
    if kind == "soup":
        r, h = u(30, 42), u(80, 118)
        bead = [(r + 1.2, 0), (r + 1.2, 3, 0.8), (r, 4.5)]
        return body(
            [(0.8 * r, 0), *bead, (r, h - 4.5), (r + 1.2, h - 3, 0.8), (r + 1.2, h), (r - 1, h), (r - 2, h - 1.5)]
        )
    if kind == "drink":
        r, h = u(26, 33), u(115, 165)
        foot, neck = 0.78 * r, 0.82 * r
        top = [(r, h - 14, 4), (neck, h - 3, 2), (neck + 1, h - 2), (neck + 1, h), (neck - 1, h), (neck - 3, h - 1.5)]
        return body([(0.8 * foot, 0), (foot, 0, 1), (r, 9, 4), *top])
    if kind == "spray":
        r, h = u(22, 33), u(110, 160)
        dome = [(r, h), (r + 1, h), (r + 1, h + 3, 1), (0.75 * r, h + 14, 8), (0.62 * r, h + 15)]
        cap = [(0.66 * r, h + 15), (0.62 * r, h + u(36, 48), 3), (4, h + 42)]
        return body([(0.8 * r, 0), (r + 1, 0), (r + 1, 3, 1), (r, 4), *dome, *cap])
    if kind == "tuna":
        r, h = u(34, 42), u(28, 48)
        return body(
            [(0.8 * r, 0), (r, 0, 3), (r, h - 2), (r + 1.2, h - 2), (r + 1.2, h, 0.8), (r - 2, h), (r - 3, h - 1.5)]
        )
    if kind == "coffee":
        r, h = u(35, 42), u(90, 130)
        lid = [(r, h - 14), (r + 1.5, h - 14), (r + 1.5, h, 1.5), (0.6 * r, h)]
        return body([(0.8 * r, 0), (r + 1, 0), (r + 1, 3, 1), (r, 4.5), *lid])
    r, h = u(31, 39), u(160, 215)  # tube
    return body([(0.8 * r, 0), (r, 0, 1), (r, h - 12), (r + 1.2, h - 12), (r + 1.2, h, 2), (0.5 * r, h)])


def box(rng: np.random.Generator, style: int) -> Solid:
    """Cereal, gelatine, tea and long boxes, cubes, milk cartons, prisms and gift boxes with a lid.

    Args:
        rng: Draws the dimensions.
        style: Number of the object, which chooses the style.
    """
    u = rng.uniform
    kind = ("cereal", "gelatine", "tea", "cube", "carton", "long", "gift", "prism")[style % 8]
    if kind == "gift":
        x, y, h = u(32, 40), u(32, 40), u(50, 90)
        return union(brick(x, y, h - 1), brick(x + 2, y + 2, u(18, 26)).moved((0, 0, h - 20)))
    if kind == "carton":
        a, h, ridge = u(30, 38), u(90, 130), u(26, 34)
        roof = np.array(
            [[x, y, z] for x, y, z in _sides(a, h)] + [[s * a, t, h + ridge] for s in (-1, 1) for t in (-1.2, 1.2)]
        )
        fin = np.array([[s * a, t, z] for s in (-1, 1) for t in (-1.5, 1.5) for z in (h + ridge - 3, h + ridge + 11)])
        parts = [hull(roof), hull(fin)]
        return union(brick(a, a, h + 0.5, 1.0), *(Solid(part, [part]) for part in parts))
    if kind == "prism":
        side, length = u(38, 52), u(120, 190)
        angle = np.pi / 2 + 2 * np.pi / 3 * np.arange(3)
        radius = side / np.sqrt(3) - 3
        corners = np.column_stack((np.zeros(3), radius * np.cos(angle), radius * np.sin(angle)))
        section = np.concatenate([c + 3 * np.insert(ellipse(2, 12), 0, 0, axis=1) for c in corners])
        ends = [section + np.array([x, 0, radius / 2 + 3]) for x in (-length / 2, length / 2)]
        part = hull(np.concatenate(ends))
        return Solid(part, [part])
    low, high = {
        "cereal": ((68, 24, 150), (92, 34, 215)),
        "gelatine": ((36, 14, 70), (46, 20, 95)),
        "tea": ((55, 32, 60), (75, 38, 80)),
        "cube": ((28, 28, 50), (38, 38, 80)),
        "long": ((16, 20, 36), (26, 30, 56)),
    }[kind]
    x, y, h = u(low, high)
    if kind == "long":
        return brick(u(75, 105), y, h)
    if kind == "cube":
        y, h = x, 2 * x
    return brick(x, y, h, u(1, 3))


def brick(x: Number, y: Number, height: Number, corner: Number = 1.5) -> Solid:
    """A block with rounded edges, from z = 0 up.

    Args:
        x: Half width along x.
        y: Half width along y.
        height: Height.
        corner: Radius of the edges.
    """
    rise = corner * np.array([0, 0.29, 1])
    inset = corner * np.array([0.6, 0.1, 0])
    levels = zip([*rise, *(height - rise[::-1])], [*inset, *inset[::-1]], strict=True)
    return loft(np.stack([np.insert(rectangle(x - i, y - i, 1.2 * corner - i, 24), 2, z, axis=1) for z, i in levels]))


def _sides(half: Number, height: Number) -> list[tuple[float, float, float]]:
    return [(sx * half, sy * half, z) for sx in (-1, 1) for sy in (-1, 1) for z in (height - 1, height)]


def ball(rng: np.random.Generator, style: int) -> Solid:
    """A tennis ball and a smaller one. Its part has flat faces, some 8 mm wide, on which it comes to rest.

    Args:
        rng: Draws the dimensions.
        style: Number of the object, which chooses the style.
    """
    radius = (33.0, 26.0)[style % 2] * rng.uniform(0.97, 1.03)
    coarse = trimesh.creation.icosphere(2, radius)
    coarse.apply_scale(2 * radius / (radius + np.linalg.norm(coarse.triangles_center, axis=1).min()))
    return Solid(trimesh.creation.icosphere(4, radius), [coarse])


def shaker(rng: np.random.Generator, style: int) -> Solid:
    """Salt and pepper shakers, pepper mills, glass shakers with a metal cap, cocktail shakers, sugar pourers.

    Args:
        rng: Draws the dimensions.
        style: Number of the object, which chooses the style.
    """
    u = rng.uniform
    kind = ("salt", "mill", "glass", "cocktail", "figure", "pourer")[style % 6]
    if kind == "salt":
        r, h = u(20, 27), u(55, 80)
        cap = [(0.85 * r, h - 2), (0.9 * r, h - 2), (0.9 * r, h + 8, 4), (0.5 * r, h + 17, 8), (3, h + 18)]
        return body([(0.6 * r, 0), (r, 0, 3), (0.85 * r, h - 3), *cap])
    if kind == "mill":
        r, h, waist = u(23, 29), u(110, 180), u(0.5, 0.65)
        lower = [(r, 0, 3), (r, 0.1 * h, 8), (waist * r, 0.42 * h, 25), (0.9 * r, 0.72 * h, 15), (0.75 * r, 0.76 * h)]
        head = [
            (0.85 * r, 0.77 * h),
            (r, 0.86 * h, 9),
            (0.6 * r, h, 9),
            (0.25 * r, h),
            (0.3 * r, h + 8, 4),
            (2, h + 12),
        ]
        return body([(0.6 * r, 0), *lower, *head])
    if kind == "glass":
        r, h = u(19, 25), u(50, 75)
        cap = [(0.86 * r, h), (0.95 * r, h), (0.95 * r, h + 13, 3), (0.6 * r, h + 21, 6), (3, h + 22)]
        return body([(0.6 * r, 0), (r, 0, 4), (0.9 * r, h, 4), *cap], square=u(4, 7), until=h - 14, blend=14)
    if kind == "cocktail":
        r, h = u(33, 39), u(125, 150)
        lid = [(r + 1.5, h), (r + 1.5, h + 4, 1), (0.62 * r, h + 34, 18), (0.55 * r, h + 38)]
        cap = [(0.6 * r, h + 38), (0.5 * r, h + 62, 6), (4, h + 64)]
        return body([(0.5 * r, 0), (0.72 * r, 0, 4), (r, h), *lid, *cap])
    if kind == "figure":
        r, h = u(20, 27), u(70, 100)
        side = [
            (r, 0, 6),
            (r, 0.3 * h, 18),
            (0.55 * r, 0.62 * h, 12),
            (0.72 * r, 0.8 * h, 10),
            (0.5 * r, h, 8),
            (3, h + 1),
        ]
        return body([(0.6 * r, 0), *side])
    r, h = u(27, 34), u(85, 115)  # pourer, with a handle
    cap = [(r + 1.5, h), (r + 1.5, h + 12, 2), (0.55 * r, h + 26, 8), (0.3 * r, h + 28)]
    pot = body([(0.6 * r, 0), (r, 0, 4), (r, h), *cap, (0.28 * r, h + 40, 2), (3, h + 40)])
    return union(pot, ear((r - 4, 0.82 * h), (r - 4, 0.2 * h), u(24, 30), u(5, 7), u(3, 4), u(12, 40)))


def teapot(rng: np.random.Generator, style: int) -> Solid:
    """Teapots with their lid on: round, squat, pear-shaped, straight, and tall coffee pots.

    Args:
        rng: Draws the dimensions.
        style: Number of the object, which chooses the style.
    """
    u = rng.uniform
    kind = ("round", "squat", "pear", "straight", "coffee")[style % 5]
    r = {"round": u(46, 56), "squat": u(52, 62), "pear": u(45, 54), "straight": u(40, 50), "coffee": u(38, 46)}[kind]
    h = {"round": 1.5, "squat": 1.15, "pear": 1.75, "straight": 1.8, "coffee": 3.0}[kind] * r * u(0.93, 1.07)
    sides: dict[str, Corners] = {
        "round": [(0.6 * r, 0), (0.6 * r, 3), (1.13 * r, 0.18 * h, 60), (1.13 * r, 0.82 * h, 60)],
        "squat": [(0.65 * r, 0), (0.65 * r, 3), (1.15 * r, 0.25 * h, 60), (1.05 * r, 0.85 * h, 60)],
        "pear": [(0.7 * r, 0), (0.7 * r, 4), (1.18 * r, 0.2 * h, 60), (0.75 * r, 0.75 * h, 60)],
        "straight": [(r, 0, 5), (0.88 * r, h - 6, 8)],
        "coffee": [(r, 0, 6), (1.05 * r, 0.25 * h, 60), (0.68 * r, 0.8 * h, 60)],
    }
    lid = {"round": 0.55, "squat": 0.5, "pear": 0.52, "straight": 0.62, "coffee": 0.55}[kind] * r
    dome = u(0.12, 0.22) * r
    top = [(lid, h, 3), (lid + 2.5, h), (lid + 2.5, h + 3, 1), (0.6 * lid, h + 3 + dome, 0.5 * lid), (4, h + 4 + dome)]
    corners = [(0.5 * r, 0.0), *sides[kind], *top]
    profile = rounded(corners)
    pot = body(corners)
    a, b = radius_at(profile, 0.78 * h) - 4, radius_at(profile, 0.25 * h) - 4
    loop = ear((a, 0.78 * h), (b, 0.25 * h), u(34, 44), u(5, 7.5), u(4, 5.5), u(18, 45), u(0.85, 1.1))
    low = (0.3 if kind != "coffee" else 0.45) * h
    root = radius_at(profile, low) - 6
    tip = (r + u(32, 44), h * u(0.88, 1.0))
    beak = spout((root, low), tip, u(11, 14), u(5, 6.5), u(0, 9))
    return union(pot, loop, beak, knob(u(8, 11), h + 3 + dome))

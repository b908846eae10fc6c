"""Plane outlines drawn at random, and solids that are layers of such outlines. Lengths in millimeters.

An outline is a manifold3d CrossSection: one or more closed contours, holes among them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from manifold3d import CrossSection, FillRule, JoinType, Manifold, OpType, triangulate

from dexzoo.sim.families.decomposition import to_mesh
from dexzoo.sim.shapes.curves import Array, Number
from dexzoo.sim.shapes.solid import Solid, hull

TOLERANCE = 1.3
"""How far a convex piece may stand out over its outline."""
_EDGE = 0.5  # mm2 of a hull beyond the tolerance that is noise


@dataclass(frozen=True)
class Layer:
    """An outline drawn upwards from one height to another, its top `taper` times as large as its bottom."""

    outline: CrossSection
    bottom: Number
    top: Number
    taper: Number = 1.0


def section(points: Array) -> CrossSection:
    """The outline through points (n, 2), whichever way they turn.

    Args:
        points: The corners in order.

    Returns:
        The outline.
    """
    return CrossSection([points.tolist()], FillRule.NonZero if _area(points) > 0 else FillRule.Negative)


def rectangle(width: Number, depth: Number) -> CrossSection:
    """A rectangle about the origin.

    Args:
        width: Extent along x.
        depth: Extent along y.

    Returns:
        The outline.
    """
    return CrossSection.square((width, depth), center=True)


def disc(radius: Number, count: int = 40) -> CrossSection:
    """A circle about the origin.

    Args:
        radius: Radius.
        count: Number of its corners.

    Returns:
        The outline.
    """
    return CrossSection.circle(radius, count)


def rounded(outline: CrossSection, radius: Number, inner: Number = 0.0) -> CrossSection:
    """The outline with its corners rounded, and those that look inwards too if `inner` is given.

    Args:
        outline: The outline.
        radius: Radius of the corners that look outwards.
        inner: Radius of the corners that look inwards.

    Returns:
        The rounded outline, without the places narrower than twice the radius.
    """
    outline = outline.offset(-radius, JoinType.Round, circular_segments=24)
    outline = outline.offset(radius + inner, JoinType.Round, circular_segments=24)
    return outline.offset(-inner, JoinType.Round, circular_segments=24).simplify(0.05)


def size(outline: CrossSection) -> Array:
    """Width and depth (2,) of an outline.

    Args:
        outline: The outline.

    Returns:
        Extents along x and y.
    """
    low_x, low_y, high_x, high_y = outline.bounds()
    return np.array([high_x - low_x, high_y - low_y])


def fitted(outline: CrossSection, width: Number, depth: Number) -> CrossSection:
    """The outline moved about the origin and stretched to a width and a depth.

    Args:
        outline: The outline.
        width: New extent along x.
        depth: New extent along y.

    Returns:
        The outline with the middle of its bounds at the origin.
    """
    low_x, low_y, high_x, high_y = outline.bounds()
    moved = outline.translate((-(low_x + high_x) / 2, -(low_y + high_y) / 2))
    return moved.scale((width / (high_x - low_x), depth / (high_y - low_y)))


def layered(*layers: Layer) -> Solid:
    """A solid of layers, those above each other joined; parts are prisms over the convex pieces of each outline.

    Layers must overlap in height by a little to be one, and none may begin or end at the height of another: flaps
    would
    hang where their faces lie in one plane.

    Args:
        layers: The layers.

    Returns:
        The solid.
    """
    solids = [
        layer.outline.extrude(layer.top - layer.bottom, scale_top=(layer.taper, layer.taper)).translate(
            (0, 0, layer.bottom)
        )
        for layer in layers
    ]
    mesh = to_mesh(Manifold.batch_boolean(solids, OpType.Add))
    parts = []
    for layer in layers:
        for piece in convex_pieces(layer.outline):
            low, high = np.full((len(piece), 1), layer.bottom), np.full((len(piece), 1), layer.top)
            parts.append(hull(np.concatenate((np.hstack((piece, low)), np.hstack((layer.taper * piece, high))))))
    return Solid(mesh, parts)


def convex_pieces(outline: CrossSection, tolerance: Number = TOLERANCE) -> list[Array]:
    """Convex polygons (n, 2) that together are the outline within a tolerance.

    Triangles are joined two by two, those first that waste the least, as long as their hull stays near the outline.

    Args:
        outline: The outline, with or without holes.
        tolerance: How far a piece may stand out over the outline.

    Returns:
        The pieces.
    """
    polygons = outline.to_polygons()
    points = np.concatenate(polygons)
    allowed = outline.offset(tolerance, JoinType.Round, circular_segments=24)
    corners = {index: set(triangle) for index, triangle in enumerate(triangulate(polygons).tolist())}
    areas = {index: abs(_area(points[sorted(corner)])) for index, corner in corners.items()}
    waste: dict[tuple[int, int], float] = {}
    fresh = set(corners)
    while True:
        for pair in combinations(corners, 2):
            a, b = pair
            if (a in fresh or b in fresh) and len(corners[a] & corners[b]) >= 2:
                whole = CrossSection.hull_points(points[sorted(corners[a] | corners[b])].tolist())
                if (whole - allowed).area() < _EDGE:
                    waste[pair] = whole.area() - areas[a] - areas[b]
        if not waste:
            break
        a, b = min(waste, key=lambda pair: (round(waste[pair], 6), pair))
        new = max(corners) + 1
        areas[new] = waste[a, b] + areas[a] + areas[b]
        corners[new] = corners.pop(a) | corners.pop(b)
        waste = {pair: value for pair, value in waste.items() if not {a, b} & set(pair)}
        fresh = {new}
    hulls = [CrossSection.hull_points(points[sorted(corner)].tolist()) for corner in corners.values()]
    return [np.asarray(each.to_polygons()[0], np.float64) for each in hulls if each.area() > _EDGE]


def blob(rng: np.random.Generator, waves: int = 4, depth: float = 0.3, count: int = 60) -> CrossSection:
    """A smooth outline of about radius one, wavy and lobed.

    Args:
        rng: Draws the waves.
        waves: Number of waves, each of one more period than the one before, from two on.
        depth: Size of the waves.
        count: Number of corners.

    Returns:
        The outline.
    """
    angle = 2 * np.pi * np.arange(count) / count
    radius = np.ones(count)
    for wave in range(2, 2 + waves):
        radius += depth * rng.normal() / wave**0.8 * np.cos(wave * angle + rng.uniform(0, 2 * np.pi))
    return section(np.clip(radius, 0.35, 2)[:, None] * np.column_stack((np.cos(angle), np.sin(angle))))


def star(rng: np.random.Generator, points: int, inner: Number) -> CrossSection:
    """A star, gear or cross of radius one: two radii in turn, with pointed or blunt tips.

    Args:
        rng: Draws how blunt the tips are.
        points: Number of tips.
        inner: Radius between the tips.

    Returns:
        The outline.
    """
    blunt = rng.uniform(0, 0.45)
    step = 2 * np.pi / points
    angle = (step * np.arange(points)[:, None] + step / 2 * np.array([-blunt, blunt, 1 - blunt, 1 + blunt])).ravel()
    radius = np.tile([1, 1, inner, inner], points)
    return section(radius[:, None] * np.column_stack((np.cos(angle), np.sin(angle))))


def polygon(rng: np.random.Generator, corners: int, depth: float = 0.5) -> CrossSection:
    """A random polygon of about radius one, concave in most cases.

    Args:
        rng: Draws radii and angles.
        corners: Number of corners.
        depth: How far a corner may be inside of the unit circle.

    Returns:
        The outline.
    """
    gaps = rng.uniform(0.6, 1.4, corners)
    angle = 2 * np.pi * np.cumsum(gaps) / gaps.sum()
    radius = rng.uniform(1 - depth, 1, corners)
    return section(radius[:, None] * np.column_stack((np.cos(angle), np.sin(angle))))


def strokes(rng: np.random.Generator, num: int, thickness: Number) -> CrossSection:
    """A letter-like outline about two high: straight strokes and arcs between the points of a grid.

    Args:
        rng: Draws the strokes.
        num: Number of strokes.
        thickness: Of each stroke.

    Returns:
        The outline.
    """
    grid = np.array([(x, y) for x in (-0.7, 0.0, 0.7) for y in (-1.0, 0.0, 1.0)])
    outline = CrossSection()
    at = int(rng.integers(9))
    for _ in range(num):
        others = [i for i in range(9) if i != at and np.linalg.norm(grid[i] - grid[at]) < 2.1]
        to = int(rng.choice(others))
        outline += stroke(grid[at], grid[to], thickness)
        at = to if rng.random() < 0.75 else at
    return outline


def pierced(rng: np.random.Generator, outline: CrossSection) -> CrossSection:
    """The outline with one to three holes well inside of it, where there is room.

    Args:
        rng: Draws the holes.
        outline: The outline, in millimeters: a wall of 4 remains around each hole.

    Returns:
        The outline with its holes.
    """
    inside = outline.offset(-4, JoinType.Round, circular_segments=16)
    low_x, low_y, high_x, high_y = outline.bounds()
    for _ in range(int(rng.integers(1, 4))):
        radius = rng.uniform(0.06, 0.3) * min(size(outline))
        hole = disc(radius, 20) if rng.random() < 0.5 else polygon(rng, 4, 0.2).scale((radius, radius))
        hole = hole.translate((rng.uniform(low_x, high_x), rng.uniform(low_y, high_y)))
        if (hole - inside).area() < 0.01:
            outline -= hole
            inside -= hole.offset(4, JoinType.Round, circular_segments=16)
    return outline


def stroke(start: Array, end: Array, thickness: Number) -> CrossSection:
    """A straight line with round ends.

    Args:
        start: Its first end (2,).
        end: Its other end (2,).
        thickness: Twice the radius of its ends.

    Returns:
        The outline.
    """
    ends = [disc(thickness / 2, 16).translate(point.tolist()) for point in (start, end)]
    return CrossSection.batch_hull(ends)


def _area(points: Array) -> float:
    x, y = points.T
    return float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2)

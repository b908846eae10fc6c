"""What all families draw: sizes, profiles, sections and swept bars. Lengths in millimeters."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dexzoo.sim.shapes.curves import Array, Number, divided, ellipse, rounded
from dexzoo.sim.shapes.solid import Solid, loft, turned

Generator = np.random.Generator


def log_uniform(rng: Generator, low: Number, high: Number) -> float:
    """A number between two, as likely to be doubled as halved.

    Args:
        rng: Draws the number.
        low: The least value, above zero.
        high: The greatest value.

    Returns:
        The number.
    """
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def loop(rng: Generator, count: int = 40) -> Array:
    """A convex loop (point, 2) of about radius one: round, squarish, an oval or a polygon.

    Args:
        rng: Draws the kind of loop and its dimensions.
        count: Points of a round one.

    Returns:
        The loop; a polygon has three points a corner.
    """
    kind = rng.random()
    if kind < 0.4:
        return ellipse(2, count)
    if kind < 0.65:
        return ellipse(rng.uniform(2.3, 8), count)
    if kind < 0.8:
        return ellipse(rng.uniform(1.9, 4), count) * [1, rng.uniform(0.5, 0.9)]
    return corners(int(rng.integers(3, 9)), rng.uniform(0.08, 0.25))


def corners(num: int, cut: Number) -> Array:
    """A regular polygon of radius one whose corners are cut by a share of each side.

    Args:
        num: Number of corners.
        cut: Share of each side that a cut takes, below 0.5.

    Returns:
        The loop (3 * num, 2).
    """
    angle = 2 * np.pi * np.arange(num) / num + np.pi / num
    tips = np.column_stack((np.cos(angle), np.sin(angle)))
    before, after = np.roll(tips, 1, axis=0), np.roll(tips, -1, axis=0)
    bevel = np.stack((tips + cut * (before - tips), tips + 0.3 * cut * (before + after - 2 * tips)), 1)
    bevel = np.concatenate((bevel, (tips + cut * (after - tips))[:, None]), 1)
    return bevel.reshape(-1, 2)


def profile(rng: Generator, radius: Number, height: Number, num: int, depth: float = 0.6, start: Number = 0) -> Array:
    """A profile (row, 2) of radii and rising heights: `num` random radii, curves and steps between them.

    Args:
        rng: Draws radii, curves and steps.
        radius: The greatest radius.
        height: From the lowest row to the highest.
        num: Number of stretches between the random radii.
        depth: How far a radius may fall below the greatest, as a share of it.
        start: Height of the lowest row.

    Returns:
        The profile, closed at both ends.
    """
    heights = np.cumsum(rng.uniform(0.4, 1.6, num + 1))
    heights = start + height * (heights - heights[0]) / (heights[-1] - heights[0])
    radii = radius * rng.uniform(1 - depth, 1, num + 1)
    radii[rng.integers(num + 1)] = radius
    sharp = rng.random() < 0.3
    points: list[tuple[Number, ...]] = []
    for r, z in zip(radii.tolist(), heights.tolist(), strict=True):
        cut = rng.uniform(0.5, 3) if sharp else rng.uniform(0.15, 0.5) * height / num
        if points and rng.random() < 0.25:  # a step
            points.append((points[-1][0], z - 0.02 * height, 0.5))
        points.append((r, z, cut))
    return rounded([(0.3 * points[0][0], start), *points, (0.3 * points[-1][0], start + height)])


def ellipsoid(half: Array | Sequence[Number], across: Number = 1.0, along: Number = 1.0, rows: int = 15) -> Solid:
    """A superellipsoid of exponents 2/across in its level sections and 2/along upwards; one convex part if both <= 2.

    Args:
        half: Half sizes (3,) along x, y and z.
        across: Shape of its level sections: 0 a rectangle, 1 an ellipse, 2 a rhombus.
        along: Shape of its upright sections, in the same measure.
        rows: Number of level sections.

    Returns:
        The solid.
    """
    angle = np.linspace(-np.pi / 2, np.pi / 2, rows)
    radius = np.maximum(np.abs(np.cos(angle)) ** along, 0.02)
    height = np.sign(angle) * np.abs(np.sin(angle)) ** along
    sections = turned(np.column_stack((radius, height)), ellipse(2 / across, 40))
    return loft(sections * np.asarray(half, float))


def swept(path: Array, loops: Array, twist: Number = 0.0) -> Array:
    """Sections (station, point, 3) of loops (station, point, 2) carried along a path (station, 3) without rolling.

    Args:
        path: Points along the bar.
        loops: The section at each of them.
        twist: Angle in rad by which sections turn from end to end.

    Returns:
        The sections.
    """
    tangents = np.gradient(path, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    first = np.cross(tangents[0], np.eye(3)[np.abs(tangents[0]).argmin()])
    sections = []
    for at, tangent, points, angle in zip(path, tangents, loops, np.linspace(0, twist, len(path)), strict=True):
        first = first - (first @ tangent) * tangent
        first /= np.linalg.norm(first)
        second = np.cross(tangent, first)
        x = np.cos(angle) * points[:, :1] - np.sin(angle) * points[:, 1:]
        y = np.sin(angle) * points[:, :1] + np.cos(angle) * points[:, 1:]
        sections.append(at + x * first + y * second)
    return np.array(sections)


def bent(knots: Sequence[Sequence[Number]], cut: Number, spacing: Number = 6.0) -> Array:
    """A path (station, 3) through knots, its corners replaced by curves that begin `cut` before them.

    Args:
        knots: Points (knot, 3) that the path leads through, its corners among them.
        cut: Distance from a corner at which its curve begins, at most half of the shorter side.
        spacing: Distance between two stations.

    Returns:
        The path.
    """
    points = np.asarray(knots, float)
    path = [points[0]]
    for before, corner, after in zip(points[:-2], points[1:-1], points[2:], strict=True):
        arms = [before - corner, after - corner]
        lengths = [float(np.linalg.norm(arm)) for arm in arms]
        reach = min(cut, 0.49 * min(lengths))
        start, end = (corner + reach / length * arm for arm, length in zip(arms, lengths, strict=True))
        t = np.linspace(0, 1, 9)[:, None]
        path += list((1 - t) ** 2 * start + 2 * t * (1 - t) * corner + t**2 * end)
    return divided(np.array([*path, points[-1]]), spacing)

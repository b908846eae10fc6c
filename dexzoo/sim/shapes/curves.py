"""Plane curves that shapes are made of: profiles with rounded corners, and closed sections. Lengths in millimeters."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Number = float | int
"""Written out, since the tests check types as they run, where an int is no float."""
_STEP = 0.2  # rad that a rounded corner turns from point to point


def rounded(corners: Sequence[tuple[Number, ...]], spacing: Number | None = None) -> Array:
    """A polyline (point, 2) through corners, with a parabola instead of each cut corner.

    Args:
        corners: Corners (x, y) or (x, y, cut); the parabola begins and ends `cut` before and behind the corner,
            at most half of a side.
        spacing: Straight lines are divided into pieces no longer than this.
    """
    at = np.array([corner[:2] for corner in corners], float)
    cuts = [corner[2] if len(corner) > 2 else 0.0 for corner in corners]
    points = [at[0]]
    for before, corner, after, cut in zip(at[:-2], at[1:-1], at[2:], cuts[1:-1], strict=True):
        sides = before - corner, after - corner
        lengths = [float(np.linalg.norm(side)) for side in sides]
        cut = min(cut, *(0.499 * length for length in lengths))
        if cut == 0:
            points.append(corner)
            continue
        first, last = (corner + cut / length * side for side, length in zip(sides, lengths, strict=True))
        turn = np.pi - np.arccos(np.clip(sides[0] @ sides[1] / np.prod(lengths), -1, 1))
        t = np.linspace(0, 1, max(3, int(np.ceil(turn / _STEP)) + 1))[:, None]
        points += list((1 - t) ** 2 * first + 2 * t * (1 - t) * corner + t**2 * last)
    return divided(np.array([*points, at[-1]]), spacing)


def divided(points: Array, spacing: Number | None) -> Array:
    """A polyline with points put in, so that none are further apart than `spacing`.

    Args:
        points: The polyline, (point, n).
        spacing: Largest distance; None leaves it as it is.
    """
    if spacing is None:
        return points
    pieces = [
        np.linspace(a, b, max(1, int(np.ceil(np.linalg.norm(b - a) / spacing))), endpoint=False)
        for a, b in pairwise(points)
    ]
    return np.concatenate([*pieces, points[-1:]])


def normals(points: Array) -> Array:
    """Unit normals (point, 2) of a polyline, to the right of its direction.

    Args:
        points: The polyline, (point, 2).
    """
    tangent = np.gradient(points, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return np.column_stack((tangent[:, 1], -tangent[:, 0]))


def ellipse(exponent: Number = 2, count: int = 48) -> Array:
    """A closed superellipse (count, 2) between -1 and 1.

    Args:
        exponent: 2 is a circle, more goes towards a square.
        count: Number of points.
    """
    angle = 2 * np.pi * np.arange(count) / count
    circle = np.column_stack((np.cos(angle), np.sin(angle)))
    return np.asarray(np.sign(circle) * np.abs(circle) ** (2 / exponent), np.float64)


def rectangle(half_x: Number, half_y: Number, corner: Number, count: int = 48) -> Array:
    """A closed rectangle (count, 2) with round corners.

    Args:
        half_x: Half width along x.
        half_y: Half width along y.
        corner: Radius of the corners.
        count: Number of points.
    """
    angle = 2 * np.pi * (np.arange(count) + 0.5) / count
    circle = np.column_stack((np.cos(angle), np.sin(angle)))
    return np.asarray(corner * circle + np.sign(circle) * (np.array([half_x, half_y]) - corner), np.float64)

"""Thin walls: open vessels of revolution, and curved sheets such as the bowl of a spoon. Lengths in millimetres.

A wall is cut into flat-backed convex blocks. A block's inner face is a chord, which would stand into the cavity by its
sagitta; moved outwards by half of that, it is wrong by as much on both sides.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
from scipy.spatial import ConvexHull

from dexzoo.sim.objects import Mesh
from dexzoo.sim.shapes.curves import Array, Number, divided, normals
from dexzoo.sim.shapes.solid import Solid, convex_parts, hull, skin

Warp = Callable[[Array], Array]
_FEWEST = 4
_GOAL = 1.1
"""Deviation below which a wall is not cut any finer."""
_THINNEST = 0.7
_COLUMNS = 48
_SPACING = 6.0
_RIM = np.sqrt(1 - np.array([0.5, 0.85, 0.985]) ** 2)


@dataclass(frozen=True)
class Wall:
    """A wall of revolution: profiles (row, 2) of radii and heights, outside and inside, row by row across from it.

    warp: moves points (..., 3) of the round wall, for instance to form a lip.
    """

    outer: Array
    inner: Array
    warp: Warp

    @classmethod
    def along(cls, profile: Array, thickness: Number, warp: Warp = lambda points: points) -> Wall:
        """The wall whose outer side is the profile, its rim rounded."""
        aside = normals(profile)
        inner = profile - thickness * aside
        along = np.array([-aside[-1, 1], aside[-1, 0]]) * thickness / 2
        middle = (profile[-1] + inner[-1]) / 2
        rise = np.sqrt(1 - _RIM**2)[:, None] * along
        half = _RIM[:, None] * aside[-1] * thickness / 2
        return cls(np.concatenate((profile, middle + half + rise)), np.concatenate((inner, middle - half + rise)), warp)

    def cut(self, height: Number) -> tuple[Wall, int]:
        """The wall with a row whose inner side is at that height, above which it does not come back; and the row."""
        row = int(np.flatnonzero(self.inner[:, 1] < height)[-1])
        share = (height - self.inner[row, 1]) / (self.inner[row + 1, 1] - self.inner[row, 1])
        outer, inner = (
            np.insert(side, row + 1, (1 - share) * side[row] + share * side[row + 1], axis=0)
            for side in (self.outer, self.inner)
        )
        return Wall(outer, inner, self.warp), row + 1

    def sides(self, angles: Array, rows: slice = slice(None)) -> tuple[Array, Array]:
        """Points (row, angle, 3) outside and inside."""
        directions = np.column_stack((np.cos(angles), np.sin(angles)))

        def surface(profile: Array) -> Array:
            points = np.empty((len(profile), len(angles), 3))
            points[..., :2] = profile[:, None, :1] * directions
            points[..., 2] = profile[:, None, 1]
            return self.warp(points)

        return surface(self.outer[rows]), surface(self.inner[rows])


def vessel(
    profile: Array, thickness: Number, budget: int, floor: Number | None = None, warp: Warp | None = None
) -> Solid:
    """An open vessel of revolution around z.

    profile: radii and heights (row, 2) of its outer side, upwards. floor: thickness of its bottom, by default that of
    the wall. budget: number of parts at most.
    """
    wall = Wall.along(divided(profile, _SPACING), thickness, warp or (lambda points: points))
    level = wall.outer[0, 1] + (thickness if floor is None else floor)
    wall, first = wall.cut(level + 0.3)
    wall.inner[first, 1] = level
    outer, inner = wall.sides(2 * np.pi * np.arange(_COLUMNS) / _COLUMNS)
    mesh = skin(np.concatenate((outer, inner[first:][::-1])))
    bottom = convex_parts(np.concatenate((outer[: first + 1], inner[first : first + 1])))
    return Solid(mesh, bottom + _sectors(wall, first, budget - len(bottom)))


def pipe(profile: Array, thickness: Number, budget: int) -> Solid:
    """A wall of revolution that is open at both ends."""
    wall = Wall.along(divided(profile, _SPACING), thickness)
    outer, inner = wall.sides(2 * np.pi * np.arange(_COLUMNS) / _COLUMNS)
    return Solid(skin(np.concatenate((outer, inner[::-1])), closed=True), _sectors(wall, 0, budget))


def sheet(upper: Array, lower: Array, pieces: tuple[int, int]) -> Solid:
    """A sheet between two grids of points (row, column, 3); pieces: number of convex parts along rows and columns."""
    mesh = skin(np.concatenate((lower, upper[:, ::-1]), 1))
    cuts = [np.linspace(0, n - 1, k + 1).round().astype(int) for n, k in zip(lower.shape, pieces, strict=False)]
    parts = [
        _block(lower[a : b + 1, c : d + 1], upper[a : b + 1, c : d + 1])[0]
        for a, b in pairwise(cuts[0])
        for c, d in pairwise(cuts[1])
    ]
    return Solid(mesh, parts)


def _block(outer: Array, inner: Array) -> tuple[Mesh, float]:
    """A convex block between two grids (..., 3), and by how much it misses them."""
    across = outer - inner
    thickness = np.linalg.norm(across, axis=-1, keepdims=True)
    across = across / thickness
    out, within = _sagitta(outer, inner, across)
    room = max(float(thickness.max()) - _THINNEST, 1e-3)
    share = min(1.0, 2 * room / max(out + within, 1e-9)) / 2
    part = hull(np.stack((outer - share * out * across, inner + share * within * across)))
    return part, (1 - share) * max(out, within)


def _sagitta(outer: Array, inner: Array, across: Array) -> tuple[float, float]:
    """How far the hull of both grids stands out beyond each, along the direction across."""
    planes = ConvexHull(np.concatenate((outer.reshape(-1, 3), inner.reshape(-1, 3)))).equations
    away = []
    for points, direction in ((outer, across), (inner, -across)):
        height = -(points.reshape(-1, 3) @ planes[:, :3].T + planes[:, 3])
        speed = direction.reshape(-1, 3) @ planes[:, :3].T
        leave = np.where(speed > 1e-6, height / np.maximum(speed, 1e-6), np.inf)
        away.append(max(0.0, float(leave.min(1).max())))
    return away[0], away[1]


def _sectors(wall: Wall, first: int, budget: int) -> list[Mesh]:
    """The wall from a row on, cut into at most so many blocks: bands one above the other, sectors around."""
    cuts, counts = _layout(wall, first, budget)
    parts = []
    for (low, high), count in zip(pairwise(cuts), counts, strict=True):
        for start in 2 * np.pi * np.arange(count) / count:
            angles = start + np.linspace(0, 2 * np.pi / count, 5)
            parts.append(_block(*wall.sides(angles, slice(low, high + 1)))[0])
    return parts


def _layout(wall: Wall, first: int, budget: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Rows to cut at and numbers of sectors between them, for the least sagitta that the budget allows."""
    inner, last = wall.inner, len(wall.inner) - 1
    across = wall.outer - inner
    girth = inner[:, 0] * np.abs(across[:, 0]) / np.linalg.norm(across, axis=1)
    sag = {(a, b): _bend(inner[a : b + 1]) for a, b in combinations(range(first, last + 1), 2)}
    choices = [(first, *between, last) for num in range(3) for between in combinations(range(first + 1, last - 3), num)]
    bends = np.array([[sag.get(band, 0.0) for band in _bands(cuts)] for cuts in choices])
    girths = np.array([[girth[a : b + 1].max() if b > a else 0.0 for a, b in _bands(cuts)] for cuts in choices])
    for allowed in np.arange(2 * _GOAL, 20, 0.1):
        room = np.clip((allowed - bends) / np.maximum(girths, 1e-9), 1e-6, 1 - np.cos(np.pi / _FEWEST))
        counts = np.where(girths > 0, np.ceil(np.pi / np.arccos(1 - room)), 0).astype(int)
        total = counts.sum(1)
        if total.min() <= budget:
            best = int(total.argmin())
            return choices[best], tuple(counts[best][: len(choices[best]) - 1].tolist())
    raise ValueError(f"a wall cannot be cut into {budget} convex parts; give it a simpler profile or more parts")


def _bands(cuts: tuple[int, ...]) -> list[tuple[int, int]]:
    """Pairs of rows, padded to three with empty ones."""
    return [*pairwise(cuts), *[(cuts[-1], cuts[-1])] * (4 - len(cuts))]


def _bend(points: Array) -> float:
    """Largest distance of a polyline (point, 2) from its chord."""
    chord = points[-1] - points[0]
    away = points - points[0]
    return float(np.abs(away[:, 0] * chord[1] - away[:, 1] * chord[0]).max() / max(np.linalg.norm(chord), 1e-9))

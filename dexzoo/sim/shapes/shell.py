"""Thin walls: open vessels of revolution, and curved sheets such as the bowl of a spoon. Lengths in millimeters.

A wall is cut into flat-backed convex blocks. A block's inner face is a chord, which would stand into the cavity by its
sagitta; moved outwards by half of that, it is wrong by as much on both sides.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np

from dexzoo.sim.objects import Mesh
from dexzoo.sim.shapes.curves import Array, Number, divided, ellipse, normals
from dexzoo.sim.shapes.solid import Solid, convex_parts, exit_distance, hull, skin, turned

_FEWEST = 4
_GOAL = 1.1
"""Deviation below which a wall is not cut any finer."""
_THINNEST = 0.7
_COLUMNS = 48
_SPACING = 10.0
_SHARP = 0.8
"""Rounding between wall and floor that is left out inside: a wall's block could not follow it."""
_RIM = np.sqrt(1 - np.array([0.5, 0.85, 0.985]) ** 2)


@dataclass(frozen=True)
class Wall:
    """A wall of revolution.

    Attributes:
        outer: Profile outside: radii and heights, (row, 2).
        inner: Profile inside, row by row across from it.
        lip: How far it is drawn out along -x at its rim.
        lip_width: Angle on each side of -x over which it is.
    """

    outer: Array
    inner: Array
    lip: Number = 0
    lip_width: float = 1.0

    @classmethod
    def along(cls, profile: Array, thickness: Number, lip: Number = 0) -> Wall:
        """The wall whose outer side is the profile, its rim rounded.

        Args:
            profile: Profile of the outer side, (row, 2).
            thickness: Thickness of the wall.
            lip: How far the rim is drawn out along -x.
        """
        aside = normals(profile)
        inner = profile - thickness * aside
        along = np.array([-aside[-1, 1], aside[-1, 0]]) * thickness / 2
        middle = (profile[-1] + inner[-1]) / 2
        rise = np.sqrt(1 - _RIM**2)[:, None] * along
        half = _RIM[:, None] * aside[-1] * thickness / 2
        return cls(np.concatenate((profile, middle + half + rise)), np.concatenate((inner, middle - half + rise)), lip)

    def cut(self, height: Number) -> tuple[Wall, int]:
        """The wall with a row whose inner side is at that height, above which it does not come back; and the row.

        Args:
            height: The height.
        """
        row = int(np.flatnonzero(self.inner[:, 1] < height)[-1])
        share = (height - self.inner[row, 1]) / (self.inner[row + 1, 1] - self.inner[row, 1])
        outer, inner = (
            np.insert(side, row + 1, (1 - share) * side[row] + share * side[row + 1], axis=0)
            for side in (self.outer, self.inner)
        )
        return replace(self, outer=outer, inner=inner), row + 1

    def sides(self, angles: Array, rows: slice = slice(None)) -> tuple[Array, Array]:
        """Points (row, angle, 3) outside and inside.

        Args:
            angles: Angles about z, radians.
            rows: Rows of the profiles.
        """
        directions = np.column_stack((np.cos(angles), np.sin(angles)))

        def surface(profile: Array) -> Array:
            points = np.empty((len(profile), len(angles), 3))
            points[..., :2] = profile[:, None, :1] * directions
            points[..., 2] = profile[:, None, 1]
            points[..., 0] -= self.lip * aside * rise[:, None]
            return points

        away = np.abs(np.mod(angles, 2 * np.pi) - np.pi)
        aside = np.clip(1 - away / self.lip_width, 0, 1)
        base, top = self.lip_base, self.outer[-1, 1]
        rise = np.clip((self.outer[rows, 1] - base) / (top - base), 0, 1)
        return surface(self.outer[rows]), surface(self.inner[rows])

    @property
    def lip_base(self) -> float:
        """The height from which on the lip is drawn out."""
        low, high = self.outer[[0, -1], 1]
        return float(low + 0.6 * (high - low))


def vessel(profile: Array, thickness: Number, budget: int, floor: Number | None = None, lip: Number = 0) -> Solid:
    """An open vessel of revolution around z.

    Args:
        profile: Radii and heights (row, 2) of its outer side, upwards.
        thickness: Thickness of the wall.
        budget: Most parts.
        floor: Thickness of its bottom; by default that of the wall.
        lip: How far the rim is drawn out along -x, for pouring.
    """
    wall = Wall.along(divided(profile, _SPACING), thickness, lip)
    level = wall.outer[0, 1] + (thickness if floor is None else floor)
    wall, first = wall.cut(level + _SHARP)
    wall.inner[first, 1] = level
    below = np.concatenate((wall.outer[: first + 1], wall.inner[first : first + 1]))
    bottom = convex_parts(turned(below, ellipse(count=_COLUMNS)))
    room = budget - len(bottom) - (2 if lip else 0)
    cuts, counts = _layout(wall, first, room)
    wall = replace(wall, lip_width=2 * np.pi / counts[-1])
    outer, inner = wall.sides(2 * np.pi * np.arange(_COLUMNS) / _COLUMNS)
    return Solid(skin(np.concatenate((outer, inner[first:][::-1]))), bottom + _sectors(wall, cuts, counts))


def pipe(profile: Array, thickness: Number, budget: int) -> Solid:
    """A wall of revolution that is open at both ends.

    Args:
        profile: Radii and heights (row, 2) of its outer side, upwards.
        thickness: Thickness of the wall.
        budget: Most parts.
    """
    wall = Wall.along(divided(profile, _SPACING), thickness)
    outer, inner = wall.sides(2 * np.pi * np.arange(_COLUMNS) / _COLUMNS)
    return Solid(skin(np.concatenate((outer, inner[::-1])), closed=True), _sectors(wall, *_layout(wall, 0, budget)))


def sheet(upper: Array, lower: Array, pieces: tuple[int, int]) -> Solid:
    """A sheet between two grids of points (row, column, 3).

    Args:
        upper: Upper grid.
        lower: Lower grid.
        pieces: Number of convex parts along rows and columns.
    """
    mesh = skin(np.concatenate((lower, upper[:, ::-1]), 1))
    cuts = [np.linspace(0, n - 1, k + 1).round().astype(int) for n, k in zip(lower.shape, pieces, strict=False)]
    parts = [
        _block(lower[a : b + 1, c : d + 1], upper[a : b + 1, c : d + 1])
        for a, b in pairwise(cuts[0])
        for c, d in pairwise(cuts[1])
    ]
    return Solid(mesh, parts)


def _block(outer: Array, inner: Array) -> Mesh:
    """A convex block between two grids (..., 3)."""
    across = outer - inner
    thickness = np.linalg.norm(across, axis=-1, keepdims=True)
    across = across / thickness
    out, within = _sagitta(outer, inner, across)
    room = max(float(thickness.max()) - _THINNEST, 1e-3)
    share = min(1.0, 2 * room / max(out + within, 1e-9)) / 2
    return hull(np.stack((outer - share * out * across, inner + share * within * across)))


def _sagitta(outer: Array, inner: Array, across: Array) -> tuple[float, float]:
    """How far the hull of both grids stands out beyond each, along the direction across."""
    outer, inner, across = (grid.reshape(-1, 3) for grid in (outer, inner, across))
    cloud = np.concatenate((outer, inner))
    return float(exit_distance(cloud, outer, across).max()), float(exit_distance(cloud, inner, -across).max())


def _sectors(wall: Wall, cuts: tuple[int, ...], counts: tuple[int, ...]) -> list[Mesh]:
    """The wall cut into blocks: bands between rows, so many sectors around each, two of which meet at a lip's tip.

    The lip is cut at its base, too.
    """
    base = int(np.searchsorted(wall.outer[:, 1], wall.lip_base))
    parts = []
    for (low, high), count in zip(pairwise(cuts), counts, strict=True):
        for sector in range(count):
            angles = np.pi + 2 * np.pi / count * (sector + np.linspace(0, 1, 5))
            split = wall.lip and sector in (0, count - 1) and low < base < high
            for rows in pairwise((low, base, high) if split else (low, high)):
                parts.append(_block(*wall.sides(angles, slice(rows[0], rows[1] + 1))))
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

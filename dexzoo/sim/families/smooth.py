"""Smooth closed bodies: superquadrics and blobs. Lengths in millimeters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, log

import numpy as np
from manifold3d import Manifold

from dexzoo.sim.families.decomposition import MAX_PARTS, decompose, to_manifold, to_mesh
from dexzoo.sim.families.drawing import Generator, ellipsoid, log_uniform
from dexzoo.sim.objects import Mesh
from dexzoo.sim.shapes.curves import Array, Number
from dexzoo.sim.shapes.solid import Solid, hull, union

_EDGE = 0.034  # of the largest extent, between the points where a field is looked at
_SMOOTH, _COARSE = 0.06, 0.3  # mm by which the surface is simplified to be seen, and to be cut into parts
_ROUNDING = 1.45  # mm by which parts may miss the coarse surface, so that they are near the fine one


def superquadric(rng: Generator) -> Solid:
    """One to four superellipsoids, from boxes over balls to double cones, grown into each other.

    Args:
        rng: Draws kind, dimensions and details.

    Returns:
        The object, in millimeters; `make_shape` stands it up.
    """
    num = int(rng.choice([1, 2, 3, 4], p=[0.25, 0.3, 0.25, 0.2]))
    half = np.array([log_uniform(rng, 14, 60 if num > 1 else 95) for _ in range(3)])
    half[2] = min(half[2], 2.2 * half[:2].max())
    solids = [_superellipsoid(rng, half)]
    middle = np.zeros(3)
    for _ in range(num - 1):
        direction = rng.normal(size=3) if rng.random() < 0.35 else np.eye(3)[rng.integers(3)] * rng.choice([-1, 1])
        direction /= np.linalg.norm(direction)
        reach = 1 / np.linalg.norm(direction / half)
        at = middle + direction * reach * rng.uniform(0.6, 1.0)
        small = np.clip(half * rng.uniform(0.35, 1.0, 3), 8, None)
        degrees = rng.uniform(0, 90) if rng.random() < 0.5 else 0.0
        solids.append(_superellipsoid(rng, small).moved(at.tolist(), degrees, "xyz"[rng.integers(3)]))
        if rng.random() < 0.5:  # the next one grows out of this one, else out of the first one again
            middle, half = at, small
    return union(*solids) if num > 1 else solids[0]


def _superellipsoid(rng: Generator, half: Array) -> Solid:
    across, along = (
        float(rng.choice([rng.uniform(0.15, 0.7), 1.0, rng.uniform(1, 1.8)], p=[0.5, 0.3, 0.2])) for _ in range(2)
    )
    return ellipsoid(half, across, along, 21)


def blob(rng: Generator) -> Solid:
    """Balls of many sizes melted into one: fruit, pebbles, bones, toy animals, figures and shoes.

    Args:
        rng: Draws kind, dimensions and details.

    Returns:
        The object, in millimeters; `make_shape` stands it up.
    """
    kind = str(rng.choice(["fruit", "chain", "cluster", "animal", "shoe"], p=[0.2, 0.18, 0.17, 0.27, 0.18]))
    balls = {"fruit": _fruit, "chain": _chain, "cluster": _cluster, "animal": _animal, "shoe": _shoe}[kind](rng)
    low, high = balls.bounds()
    scale = log_uniform(rng, 50, 230 if kind == "shoe" else 170) / float((high - low).max())
    balls = _Balls(scale * (balls.centers - (low + high) / 2), scale * balls.halves)
    seam = rng.uniform(1.6, 4 if kind in ("fruit", "shoe") else 2.6)
    melted = balls.melted(float(np.clip(np.log(2) / 2 * balls.halves.mean() / seam, 1.6, 12)))
    base = rng.uniform(0.72, 0.95) if kind == "shoe" or rng.random() < 0.3 else 1.1  # a flat one if less than one
    solid = to_manifold(melted).trim_by_plane((0, 0, 1), base * melted.bounds[0, 2])
    solid = max(solid.decompose(), key=lambda piece: piece.volume())
    return Solid(to_mesh(solid.simplify(_SMOOTH)), balls.parts(solid.simplify(_COARSE)))


@dataclass(frozen=True)
class _Balls:
    """Ellipsoids (ball, 3) by their centers and half axes; the surface of a field at zero melts them into one."""

    centers: Array
    halves: Array

    def bounds(self) -> tuple[Array, Array]:
        """The lowest and the highest corner around all balls."""
        return (self.centers - self.halves).min(0), (self.centers + self.halves).max(0)

    def melted(self, stiff: float) -> Mesh:
        """The surface of the largest piece.

        stiff: how fast the field of a ball falls off. In a seam of two balls of radius r the surface stands out by
        about r log(2) / (2 stiff).
        """
        low, high = (self.centers - 1.45 * self.halves).min(0), (self.centers + 1.45 * self.halves).max(0)
        step = _EDGE * float((high - low).max())
        # plain numbers, since the field is asked point by point
        rows = np.hstack((self.centers, self.halves**-2.0)).tolist()

        def field(x: float, y: float, z: float) -> float:
            total = 1e-30
            for a, b, c, u, v, w in rows:
                total += exp(stiff * (1 - u * (x - a) ** 2 - v * (y - b) ** 2 - w * (z - c) ** 2))
            return log(total)

        pieces = Manifold.level_set(field, [*low, *high], step).decompose()
        mesh = to_mesh(max(pieces, key=lambda piece: piece.volume()))
        mesh.vertices = self._onto(np.asarray(mesh.vertices), stiff, 0.3 * step)
        return mesh

    def parts(self, solid: Manifold) -> list[Mesh]:
        """Convex parts: the region of the solid nearest to each ball, cut if need be; neighbors meet in the seams."""
        mesh = to_mesh(solid)
        away = mesh.vertices[:, None] - self.centers
        nearest = ((away / self.halves) ** 2).sum(-1).argmin(1)
        parts: list[Mesh] = []
        for ball in range(len(self.centers)):
            faces = mesh.faces[(nearest[mesh.faces] == ball).any(1)]
            if len(faces) > 3:
                cell = solid ^ to_manifold(hull(mesh.vertices[np.unique(faces)]))
                parts += decompose(to_mesh(cell), MAX_PARTS - len(parts), _ROUNDING)
        return parts

    def _onto(self, points: Array, stiff: float, most: float) -> Array:
        """Points (n, 3) near the surface moved onto it, by no more than `most` a step (Newton's method)."""
        for _ in range(3):
            away = points[:, None] - self.centers
            share = np.exp(stiff * (1 - ((away / self.halves) ** 2).sum(-1)))
            total = share.sum(1)
            slope = -2 * stiff * (share[..., None] * away / self.halves**2).sum(1) / total[:, None]
            step = -np.log(total)[:, None] * slope / (slope**2).sum(1, keepdims=True)
            length = np.linalg.norm(step, axis=1, keepdims=True)
            points = points + step * np.minimum(1, most / np.maximum(length, 1e-12))
        return points


def _balls(rows: Sequence[tuple[Number, ...]]) -> _Balls:
    """From rows of a center and three half axes."""
    table = np.array(rows, float)
    return _Balls(table[:, :3], table[:, 3:])


def _fruit(rng: Generator) -> _Balls:
    """One to three balls close together: apples, pears, potatoes, beans."""
    rows: list[tuple[Number, ...]] = [(0, 0, 0, *rng.uniform(0.6, 1.2, 3))]
    for _ in range(int(rng.integers(0, 3))):
        rows.append((*rng.normal(0, 0.55, 3), *rng.uniform(0.45, 0.95, 3)))
    return _balls(rows)


def _chain(rng: Generator) -> _Balls:
    """Balls in a bent row: bones, dumb-bells, worms, bananas."""
    num = int(rng.integers(3, 8))
    sizes = rng.uniform(0.45, 1, num)
    if rng.random() < 0.4:
        sizes[1:-1] *= 0.6
    at, angle, turn = np.zeros(2), 0.0, rng.uniform(-0.6, 0.6)
    rows: list[tuple[Number, ...]] = []
    for i, size in enumerate(sizes):
        if i:
            at = at + 0.72 * (size + sizes[i - 1]) * np.array([np.cos(angle), np.sin(angle)])
            angle += turn + rng.normal(0, 0.15)
        rows.append((*at, rng.normal(0, 0.1), size, size, size * rng.uniform(0.8, 1.1)))
    return _balls(rows)


def _cluster(rng: Generator) -> _Balls:
    """Balls that grow out of each other anywhere."""
    rows: list[tuple[Number, ...]] = [(0, 0, 0, *rng.uniform(0.7, 1.2, 3))]
    for _ in range(int(rng.integers(2, 6))):
        near = np.array(rows[rng.integers(len(rows))])
        step = rng.normal(size=3)
        half = rng.uniform(0.35, 0.9) * rng.uniform(0.75, 1.25, 3)
        at = near[:3] + step / np.linalg.norm(step) * 0.6 * (near[3:].mean() + half.mean())
        rows.append((*at, *half))
    return _balls(rows)


def _animal(rng: Generator) -> _Balls:
    """A body on two to four legs with a head, alike on both sides: toy animals, figures, birds."""
    u = rng.uniform
    long, wide, high = u(0.8, 1.6), u(0.5, 0.8), u(0.5, 1)
    rows: list[tuple[Number, ...]] = [(0, 0, 0, long, wide, high)]
    head = u(0.35, 0.7)
    neck = u(0.2, 0.9)
    at = (long * u(0.7, 1.1), 0, high * u(0.3, 0.8) + neck)
    rows.append((*at, head * u(0.9, 1.5), head, head))
    if neck > 0.5:
        rows.append((0.85 * at[0], 0, 0.5 * at[2], 0.4 * head + 0.12, 0.35 * head + 0.1, 0.5 * neck + 0.15))
    leg, reach = u(0.22, 0.36), u(0.35, 0.9)
    for x in (-0.65, 0.65) if u() < 0.7 else (u(-0.2, 0.3),):
        for side in (-1, 1):
            rows.append((x * long, side * 0.65 * wide, -high - 0.3 * reach, leg * u(1, 1.4), leg, reach))
    if u() < 0.5:
        rows.append((-long * u(0.9, 1.1), 0, high * u(0, 0.6), u(0.3, 0.6), 0.22, u(0.2, 0.45)))
    if u() < 0.5:
        ear = u(0.15, 0.28)
        rows += [(at[0], side * 0.7 * head, at[2] + head * u(0.8, 1), ear, ear, u(0.2, 0.5)) for side in (-1, 1)]
    return _balls(rows)


def _shoe(rng: Generator) -> _Balls:
    """A row of balls along a sole, higher at the heel: shoes, mice, cars, soaps."""
    num = int(rng.integers(3, 6))
    x = np.linspace(-1.3, 1.3, num)
    waist = 0.6 + 0.25 * np.cos(np.pi * np.linspace(0, 1, num) * rng.uniform(1.5, 2.5)) * rng.uniform(0, 1)
    high = np.interp(x, [-1.3, 1.3], [rng.uniform(0.6, 1.4), rng.uniform(0.35, 0.7)]) * rng.uniform(0.8, 1.2, num)
    bow = rng.uniform(-0.15, 0.15) * x**2
    rows = [
        (a, b, 0.35 * c, 1.8 / num, w * rng.uniform(0.85, 1.1), c)
        for a, b, c, w in zip(x.tolist(), bow.tolist(), high.tolist(), waist.tolist(), strict=True)
    ]
    return _balls(rows)

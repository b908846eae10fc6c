"""Distances between rounded boxes, points and each other. A capsule is a rounded box with one half size alone.

All are exact, differentiable, and batched over leading dimensions; lengths in metres.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dexzoo.hand_spec import Primitive

_SEARCH_STEPS = {torch.float32: 36, torch.float64: 64}
_SHRINK = (5**0.5 - 1) / 2  # of the interval by each step of the golden section search


def capsule_distance(local: Tensor, half: Tensor, radius: Tensor) -> Tensor:
    """Signed distances of points (..., 3, point) to a capsule of half length `half` along x."""
    x, y, z = local.unbind(-2)
    beyond = (x.abs() - half).clamp_min(0)
    square = torch.addcmul(torch.addcmul(z * z, y, y), beyond, beyond)
    return square.clamp_min(1e-16).sqrt() - radius  # the root has no gradient at zero


def box_distance(local: Tensor, half: Tensor, radius: Tensor) -> Tensor:
    """Signed distances of points (..., 3, point) to a box of half sizes `half` (..., 3) rounded by `radius`."""
    outside = local.abs() - half[..., None]
    square = outside.clamp_min(0).square().sum(-2)
    positive = square > 0  # the root has no gradient at zero
    distance = torch.where(positive, torch.where(positive, square, 1.0).sqrt(), 0.0)
    return distance + outside.amax(-2).clamp_max(0) - radius


@dataclass(frozen=True)
class SegmentPairs:
    """Segments of some primitives against the boxes of others: what has to be looked at for pairs of links.

    A capsule is its segment; two boxes meet at an edge of one of them, or a vertex, which ends an edge.
    first, second: (segment,) primitives; start, end: (segment, 3) in the first's frame; pair: (segment,) the pair of
    links it counts for.
    """

    first: list[int]
    second: list[int]
    start: Tensor
    end: Tensor
    pair: Tensor

    @classmethod
    def between(
        cls, shapes: Sequence[Primitive], groups: Sequence[tuple[Sequence[int], Sequence[int]]]
    ) -> SegmentPairs:
        """For each pair of links, given as the primitives of the one and of the other."""
        rows: list[tuple[int, int, np.ndarray, int]] = []
        for pair, (ones, others) in enumerate(groups):
            for a, b in itertools.product(ones, others):
                for first, second in (
                    [(a, b)] if shapes[a].is_capsule else [(b, a)] if shapes[b].is_capsule else [(a, b), (b, a)]
                ):
                    rows += [(first, second, segment, pair) for segment in _segments(shapes[first])]
        ends = torch.tensor(np.stack([row[2] for row in rows])) if rows else torch.zeros(0, 2, 3, dtype=torch.float64)
        return cls(
            [row[0] for row in rows],
            [row[1] for row in rows],
            ends[:, 0],
            ends[:, 1],
            torch.tensor([row[3] for row in rows], dtype=torch.long),
        )

    def distance(self, poses: Tensor, half: Tensor, radius: Tensor, num_pairs: int) -> Tensor:
        """(*batch, pair) smallest distances, negative by how deep the deepest point of a segment's core lies.

        poses: (*batch, shape, 4, 4); half: (shape, 3); radius: (shape,). The distance of a point that runs along a
        segment to a convex body is convex, so a golden section search finds its minimum; the gradient is that of the
        point found (envelope theorem).
        """
        turn, origin = poses[..., self.second, :3, :3], poses[..., self.second, :3, 3]
        first = poses[..., self.first, :, :]

        def seen(point: Tensor) -> Tensor:
            world = (first[..., :3, :3] @ point.to(poses)[..., None]).squeeze(-1) + first[..., :3, 3]
            return ((world - origin)[..., None, :] @ turn).squeeze(-2)

        start, end = seen(self.start), seen(self.end)
        box, gap = half[self.second], radius[self.first] + radius[self.second]

        def along(t: Tensor) -> Tensor:
            point = start + t[..., None] * (end - start)
            return box_distance(point[..., None], box, gap[:, None]).squeeze(-1)

        with torch.no_grad():
            low, high = torch.zeros_like(start[..., 0]), torch.ones_like(start[..., 0])
            for _ in range(_SEARCH_STEPS[poses.dtype]):
                step = _SHRINK * (high - low)
                left, right = high - step, low + step
                falls = along(left) > along(right)
                low, high = torch.where(falls, left, low), torch.where(falls, high, right)
            t = (low + high) / 2
        found = along(t)
        far = found.new_full((*found.shape[:-1], num_pairs), torch.inf)
        return far.scatter_reduce(-1, self.pair.expand_as(found), found, "amin")


def _segments(shape: Primitive) -> list[np.ndarray]:
    """The core of a capsule, or the twelve edges of a box, (2, 3) each."""
    if shape.is_capsule:
        return [np.array([[-shape.half[0], 0, 0], [shape.half[0], 0, 0]])]
    edges = []
    for axis in range(3):
        others = [i for i in range(3) if i != axis]
        for signs in itertools.product((-1, 1), repeat=2):
            ends = np.zeros((2, 3))
            ends[:, axis] = [-shape.half[axis], shape.half[axis]]
            ends[:, others] = np.array(signs) * shape.half[others]
            edges.append(ends)
    return edges

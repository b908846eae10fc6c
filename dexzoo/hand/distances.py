"""Distances between rounded boxes, and from them to points. A capsule is a rounded box with one half size alone.

All are exact, batched, and differentiable once; lengths in meters. Coordinates come first, as planes (3, ...), so that
operations run along memory.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from dexzoo.hand.tables import Primitive

_CHUNK = 2**19  # coordinates handled at once, so that they stay in cache
_HALVINGS = {torch.float32: 18, torch.float64: 42}
"""Of a segment in search of its nearest point; with more, rounding would hide on which face either end lies."""


def box_distance(local: Tensor, half: Tensor, radius: Tensor) -> Tensor:
    """Signed distances of points to rounded boxes.

    Args:
        local: Points in the boxes' frames, (3, *batch).
        half: Half sizes, (3, *batch).
        radius: Radii that the boxes are rounded by, (*batch).
    """
    outside = local.abs() - half
    square = outside.clamp_min(0).square().sum(0)
    positive = square > 0  # the root has no gradient at zero
    distance = torch.where(positive, torch.where(positive, square, 1.0).sqrt(), 0.0)
    return distance + outside.amax(0).clamp_max(0) - radius


def box_slope(local: Tensor, half: Tensor) -> Tensor:
    """Gradient of `box_distance` by the points; that of one face if faces are equally near from inside.

    Args:
        local: Points in the boxes' frames, (3, *batch).
        half: Half sizes, (3, *batch).
    """
    outside = local.abs() - half
    slope = outside.clamp_min(0)
    length = slope.square().sum(0).sqrt_()
    inside = length == 0
    place = inside.nonzero(as_tuple=True)
    slope[(outside[:, inside].argmax(0), *place)] = 1
    length[inside] = 1
    return slope.mul_(local.sign()).div_(length)


class PointDistance(torch.autograd.Function):
    """Signed distances (batch, group, point) of points to groups of rounded boxes; in each group the nearest counts.

    Between points and result lie many times their size of coordinates. None are kept: the gradient computes them anew,
    a few postures at a time.
    """

    @staticmethod
    def forward(
        ctx: Any,  # noqa: ANN401, torch's own type is untyped
        transform: Tensor,
        points: Tensor,
        half: Tensor,
        radius: Tensor,
        groups: Sequence[slice],
    ) -> Tensor:
        """Distances; keeps the arguments.

        Args:
            ctx: Context of torch.
            transform: From the frame of the points to that of each shape, (batch, shape, 3, 4).
            points: Points, (point, 3) or (batch, point, 3).
            half: Half sizes, (shape, 3).
            radius: Radii, (shape,).
            groups: Consecutive shapes.
        """
        half, radius = half.T[:, None, :, None], radius[:, None]
        ctx.save_for_backward(transform, points, half, radius)
        ctx.groups = groups
        nearest = transform.new_empty(len(transform), len(groups), points.shape[-2])
        for part, rows, columns in _chunks(transform, points):
            distance = box_distance(rows @ columns, half, radius)
            for i, group in enumerate(groups):
                nearest[part, i] = distance[:, group].amin(1)
        return nearest

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None, None, None, None]:  # noqa: ANN401
        """A transform's rows are pushed along the slope of its distance, weighed by the points.

        Args:
            ctx: Context of torch.
            gradient: Gradient by the distances, (batch, group, point).
        """
        transform, points, half, radius = ctx.saved_tensors
        by_transform = torch.empty_like(transform) if ctx.needs_input_grad[0] else None
        by_points = torch.zeros_like(points) if ctx.needs_input_grad[1] else None
        for part, rows, columns in _chunks(transform, points):
            local = rows @ columns
            share = torch.empty_like(local[0])
            for i, group in enumerate(ctx.groups):
                share[:, group] = gradient[part, i, None]
                if group.stop - group.start > 1:
                    distance = box_distance(local[:, :, group], half[:, :, group], radius[group])
                    nearest = distance == distance.amin(1, keepdim=True)
                    share[:, group] *= nearest / nearest.sum(1, keepdim=True)
            push = box_slope(local, half).mul_(share)
            if by_transform is not None:
                by_transform[part] = (push @ columns.mT).movedim(0, -2)
            if by_points is not None:
                along = (rows[..., :3].mT @ push).sum(0).mT
                if points.ndim == 2:
                    by_points += along.sum(0)
                else:
                    by_points[part] = along
        return by_transform, by_points, None, None, None


def _chunks(transform: Tensor, points: Tensor) -> Iterator[tuple[slice, Tensor, Tensor]]:
    """Parts of the batch: which, transforms as planes (3, part, shape, 4), homogeneous points ([part], 4, point)."""
    planes = transform.movedim(-2, 0)
    columns = torch.cat((points, torch.ones_like(points[..., :1])), -1).mT.contiguous()
    size = max(1, _CHUNK // max(1, 3 * transform.shape[1] * points.shape[-2]))
    for start in range(0, len(transform), size):
        part = slice(start, start + size)
        yield part, planes[:, part], columns if points.ndim == 2 else columns[part]


@dataclass(frozen=True)
class SegmentPairs:
    """Segments of some primitives against the boxes of others, as needed for the distances of pairs of links.

    A capsule is its segment; two boxes meet at an edge of one of them, or a vertex, which ends an edge.

    Attributes:
        first: Primitive of each segment, (segment,).
        second: Primitive that it is measured to.
        start: Start of the segment in the first's frame, (segment, 3).
        end: End of the segment.
        pair: Pair of links that it counts for.
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
        """Segments for pairs of links.

        Args:
            shapes: All primitives.
            groups: For each pair of links, the primitives of the one and of the other.
        """
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
        """Smallest distances, negative by the depth of the deepest point of a segment in the box, (batch, pair).

        Args:
            poses: Poses of the primitives, (batch, shape, 4, 4).
            half: Half sizes, (shape, 3).
            radius: Radii, (shape,).
            num_pairs: Number of pairs.
        """
        first, second = poses[:, self.first], poses[:, self.second]
        gap = radius[self.first] + radius[self.second]
        found = _segment_distance(first, second, self.start, self.end, half[self.second].T[:, None], gap)
        far = found.new_full((len(found), num_pairs), torch.inf)
        return far.scatter_reduce(-1, self.pair.to(found.device).expand_as(found), found, "amin")

    def overlap(self, poses: Tensor, half: Tensor, radius: Tensor, num_pairs: int) -> Tensor:
        """Depth of overlap, 0 without any, (batch, pair); only pairs that can meet are looked at.

        Args:
            poses: Poses of the primitives, (batch, shape, 4, 4).
            half: Half sizes, (shape, 3).
            radius: Radii, (shape,).
            num_pairs: Number of pairs.
        """
        indices = self.first, self.second, self.pair
        first, second, pair = (torch.as_tensor(index, device=poses.device) for index in indices)
        center, reach = poses.detach()[..., :3, 3], half.norm(dim=-1) + radius
        apart = (center[:, first] - center[:, second]).norm(dim=-1)
        row, segment = (apart < reach[first] + reach[second]).nonzero(as_tuple=True)
        first, second = first[segment], second[segment]
        start, end = self.start.to(poses)[segment], self.end.to(poses)[segment]
        gap = radius[first] + radius[second]
        found = _segment_distance(poses[row, first], poses[row, second], start, end, half[second].T, gap)
        none = found.new_zeros(len(poses) * num_pairs)
        deepest = none.scatter_reduce(0, row * num_pairs + pair[segment], (-found).clamp_min(0), "amax")
        return deepest.view(len(poses), num_pairs)


def _segment_distance(first: Tensor, second: Tensor, start: Tensor, end: Tensor, half: Tensor, gap: Tensor) -> Tensor:
    """(...) distances of segments to boxes, less `gap`; negative by how deep their deepest points lie.

    first, second: (..., 4, 4) poses of segments and boxes; start, end: (..., 3) in the segments' frames;
    half: (3, ...) of the boxes. The distance of a point that runs along a segment to a convex body is convex, so its
    slope is halved down to the minimum. From inside, the deepest point is as near to one face as to another: the ends
    of what is left of the segment lie on either side, and the gradient is that of both, in the shares with which their
    slopes along the segment cancel.
    """
    turn = second[..., :3, :3]
    offset = first[..., :3, 3] - second[..., :3, 3]

    def seen(point: Tensor) -> Tensor:
        relative = (first[..., :3, :3] @ point.to(first)[..., None]).squeeze(-1) + offset
        return (relative[..., None, :] @ turn).squeeze(-2).movedim(-1, 0)

    start, end = seen(start), seen(end)

    with torch.no_grad():
        along = end - start

        def rise(t: Tensor) -> Tensor:
            return _rise(start + t * along, along, half)

        low, high = torch.zeros_like(start[0]), torch.ones_like(start[0])
        for _ in range(_HALVINGS[first.dtype]):
            t = (low + high) / 2
            rises = rise(t) > 0
            low, high = torch.where(rises, low, t), torch.where(rises, t, high)
        fall, climb = -rise(low), rise(high)
        share = (fall / (fall + climb).clamp_min(torch.finfo(fall.dtype).tiny)).clamp(0, 1)
    before, after = (box_distance(torch.lerp(start, end, t), half, gap) for t in (low, high))
    return torch.lerp(before, after, share)


def _rise(point: Tensor, along: Tensor, half: Tensor) -> Tensor:
    """Slope of `box_distance` up to a positive factor, as points (3, ...) move along a direction (3, ...)."""
    outside = point.abs() - half
    away = point.sign() * along
    deepest = outside.amax(0)
    inside = torch.where(outside[0] == deepest, away[0], torch.where(outside[1] == deepest, away[1], away[2]))
    return torch.where(deepest > 0, (outside.clamp_min(0) * away).sum(0), inside)


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

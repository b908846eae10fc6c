"""Other things on the table, as points that the hand keeps clear of."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dexzoo.perception.observation import Observation
from dexzoo.perception.segmentation import MIN_HEIGHT
from dexzoo.perception.table import MAX_DEPTH

SPACING = 0.007
"""Meters between the points, closer than a fingertip is thick."""
MIN_CARRIED = 0.015
"""Meters over the table from which on an object does not stand on it by itself."""
BESIDE = 0.015
"""Meters from the object within which a seen thing may carry it."""
LEAST_BREADTH = 0.03
"""Least length in meters of a support under the object."""


def obstacles(observation: Observation) -> Tensor:
    """Seen points above the table besides the object, one in each cube of 7 mm.

    Args:
        observation: The view.

    Returns:
        Points in the world frame, meters.
    """
    other = (observation.height > MIN_HEIGHT) & (observation.depth < MAX_DEPTH) & ~observation.mask
    cloud = observation.camera.directions()[other] * observation.depth[other][:, None]
    T = observation.T_world_camera
    points = cloud @ T[:3, :3].T + T[:3, 3]
    return _thinned(points)


class _Footprint:
    """The smallest upright rectangle around points, seen from above."""

    def __init__(self, points: Tensor) -> None:
        center, extents, angle = cv2.minAreaRect(points[:, :2].contiguous().numpy())
        turn = np.deg2rad(angle)
        self.center, self.extents = points.new_tensor(center), points.new_tensor(extents)
        self.axes = points.new_tensor([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])

    def holds(self, points: Tensor, center: Tensor, half: Tensor) -> Tensor:
        """(n,) whether points are within half extents of a center along the rectangle's sides."""
        return (((points[:, :2] - center) @ self.axes.T).abs() <= half).all(-1)


def underneath(surface: Tensor, share: float = 0.5) -> Tensor:
    """A guess of the support of an object that lies clear of the table: its middle is filled down to it.

    Whatever it is, a camera above hardly sees it, and the center of mass is over it.

    Args:
        surface: Points of the object in the world frame, meters, (point, 3).
        share: Share of both sides' lengths that is filled.

    Returns:
        Points in the world frame; none if the object stands on the table.
    """
    if not _is_carried(surface):
        return surface[:0]
    foot = _Footprint(surface)
    carried = surface[foot.holds(surface, surface[:, :2].mean(0), share / 2 * foot.extents)].numpy()
    if not len(carried):
        return surface[:0]
    cells = np.floor(carried[:, :2] / SPACING).astype(int)
    corner = cells.min(0)
    filled = np.zeros(np.ptp(cells, 0) + 1, np.uint8)
    filled[*(cells - corner).T] = 1
    block = np.ones((3, 3), np.uint8)
    filled = cv2.erode(cv2.dilate(filled, block), block)
    edge = filled - cv2.erode(filled, block, borderValue=0)
    levels = np.arange(np.median(carried[:, 2]) - SPACING / 2, 0, -SPACING)
    layers = [filled] + [edge] * (len(levels) - 1)  # nothing gets inside
    points = np.concatenate(
        [
            np.insert((np.argwhere(layer) + corner + 0.5) * SPACING, 2, level, axis=1)
            for layer, level in zip(layers, levels, strict=True)
        ]
    )
    return torch.tensor(points, dtype=torch.float32)


def beyond(surface: Tensor, seen: Tensor, camera: Tensor) -> Tensor:
    """A guess of the hidden part of a support: its seen part, continued.

    It continues under the object, level, away from the camera, to the far side of the object or as far as the object is
    broad.

    Args:
        surface: Points of the object in the world frame, meters, (point, 3).
        seen: Points of other things on the table, (point, 3).
        camera: Place of the camera, (3,).

    Returns:
        Points in the world frame; none if the object stands on the table.
    """
    if not _is_carried(surface):
        return surface[:0]
    foot = _Footprint(surface)
    half = foot.extents / 2
    start = seen[foot.holds(seen, foot.center, half + BESIDE) & (seen[:, 2] < surface[:, 2].median())]
    away = torch.nn.functional.normalize(foot.center - camera[:2], dim=0)
    steps = SPACING * torch.arange(1, int(max(float(foot.extents.min()), LEAST_BREADTH) / SPACING) + 1)
    swept = start.repeat(len(steps), 1)
    swept[:, :2] += (steps[:, None] * away).repeat_interleave(len(start), 0)
    return _thinned(swept[foot.holds(swept, foot.center, half)].numpy())


def _is_carried(surface: Tensor) -> bool:
    return float(surface[:, 2].quantile(0.01)) >= MIN_CARRIED


def _thinned(points: NDArray[np.floating]) -> Tensor:
    """The first point in each cube."""
    _, first = np.unique(np.floor(points / SPACING), axis=0, return_index=True)
    return torch.tensor(points[first], dtype=torch.float32)

"""What stands on the table besides the object, as points that the hand keeps clear of."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

from dexzoo.camera import Observation
from dexzoo.segmentation import MAX_DEPTH, MIN_HEIGHT

SPACING = 0.007
"""Metres between the points, closer than a fingertip is thick."""
MIN_CARRIED = 0.015
"""Metres over the table from which on an object does not stand on it by itself."""


def obstacles(observation: Observation) -> Tensor:
    """(n, 3) what is seen above the table besides the object, in the world frame, one point in each cube of 7 mm."""
    other = (observation.height > MIN_HEIGHT) & (observation.depth < MAX_DEPTH) & ~observation.mask
    cloud = observation.camera.directions()[other] * observation.depth[other][:, None]
    T = observation.T_world_camera
    points = cloud @ T[:3, :3].T + T[:3, 3]
    _, first = np.unique(np.floor(points / SPACING), axis=0, return_index=True)
    return torch.tensor(points[first], dtype=torch.float32)


def underneath(surface: Tensor) -> Tensor:
    """(n, 3) a guess of what carries an object that lies clear of the table: its middle half is filled down to it.

    Whatever it is, a camera above hardly sees it, and the centre of mass is over it.
    """
    if surface[:, 2].quantile(0.01) < MIN_CARRIED:
        return surface[:0]
    _, extents, angle = cv2.minAreaRect(surface[:, :2].contiguous().numpy())
    turn = np.deg2rad(angle)
    axes = surface.new_tensor([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    within = (surface[:, :2] - surface[:, :2].mean(0)) @ axes.T
    carried = surface[(within.abs() <= surface.new_tensor(extents) / 4).all(-1)].numpy()
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

"""The object that stands on the table in a depth image."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dexzoo.perception.table import MAX_DEPTH, MIN_POINTS

MIN_HEIGHT = 0.008
"""Points lower than this above the table, in meters, are taken as table."""
MAX_HEIGHT = 0.45
ON_TABLE, MIN_TABLE = 0.02, 0.1
"""At least such a share of the readings must lie within so many meters of the table: else it is where nothing is."""


def segment(cloud: NDArray[np.floating[Any]], height: NDArray[np.floating[Any]]) -> NDArray[np.bool_]:
    """The pixels of the one object: those above the table and connected in the image, large and near its middle.

    Args:
        cloud: Point of each pixel in the camera frame, meters, 0 without a reading, (height, width, 3).
        height: Height over the table in meters, (height, width).

    Returns:
        The object's pixels, (height, width).

    Raises:
        ValueError: Hardly a reading lies on the table, or nothing of at least 50 pixels stands on it.
    """
    depth = cloud[..., 2]
    read = (depth > 0) & (depth < MAX_DEPTH)
    if read.any() and (np.abs(height[read]) < ON_TABLE).mean() < MIN_TABLE:
        raise ValueError(
            "hardly a reading lies on the table; T_world_camera must be of a world whose table top is z = 0, "
            "table_plane in the camera frame; without them the table is fitted, or give the object's mask"
        )
    above = read & (height > MIN_HEIGHT) & (height < MAX_HEIGHT)
    # closing lets a component reach over a line of lost readings
    closed = cv2.morphologyEx(above.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    count, labels, stats, centers = cv2.connectedComponentsWithStats(closed, connectivity=8)
    labels[~above] = 0
    rows, columns = depth.shape
    best, best_value = 0, 0.0
    for label in range(1, count):
        area = stats[label, cv2.CC_STAT_AREA]
        offset = np.hypot(centers[label][0] / columns - 0.5, centers[label][1] / rows - 0.5)
        value = area * np.exp(-0.5 * (offset / 0.2) ** 2)
        if area >= MIN_POINTS and value > best_value:
            best, best_value = label, value
    if best == 0:
        raise ValueError(
            "no object is seen above the table within 1.4 m; check the depth, its scale and the table plane"
        )
    # parts of one object may be cut apart by a shadow: add parts within 2 cm of its box
    main = labels == best
    low, high = cloud[main].min(0) - 0.02, cloud[main].max(0) + 0.02
    near = above & ((cloud >= low) & (cloud <= high)).all(-1)
    joined = np.unique(labels[near])
    within = [label for label in joined if label and (near & (labels == label)).sum() > 0.9 * stats[label, 4]]
    return np.asarray(main | np.isin(labels, within))

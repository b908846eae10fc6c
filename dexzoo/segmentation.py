"""The table in a depth image, and the object that stands on it."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

MAX_DEPTH = 1.4
"""Readings beyond this many metres count as none (the range of the thesis' sensor)."""
MIN_HEIGHT = 0.008
"""Points lower than this above the table, in metres, are taken as table."""
MAX_HEIGHT = 0.45
ON_TABLE, MIN_TABLE = 0.02, 0.1
"""At least such a share of the readings must lie within so many metres of the table: else it is where nothing is."""
MIN_POINTS = 50
"""Fewest object points that anything can be inferred from (Kopicki's generator asks as many)."""


def fit_table(points: NDArray[np.floating[Any]], seed: int = 0) -> NDArray[np.float64]:
    """The largest plane within 1.4 m, (4,), by RANSAC with a least-squares finish; its normal faces the camera.

    points: (num_points, 3) in the camera frame. The plane is normal . p + offset = height over the table.
    Raises ValueError when fewer than a tenth of the readings lie on one plane.
    """
    rng = np.random.default_rng(seed)
    cloud = points[points[:, 2] < MAX_DEPTH]  # a wall behind the table may be larger than it
    if len(cloud) < MIN_POINTS:
        raise ValueError(f"fewer than {MIN_POINTS} readings within {MAX_DEPTH} m; check the depth and its scale")
    sample = cloud[rng.permutation(len(cloud))[:20_000]]
    triples = sample[rng.integers(len(sample), size=(500, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals = normals[length > 1e-8] / length[length > 1e-8, None]
    offsets = -(normals * triples[length > 1e-8, 0]).sum(1)
    probe = sample[:2_000]
    counts = (np.abs(probe @ normals.T + offsets) < 0.006).sum(0)
    if not counts.size or counts.max() < len(probe) / 10:
        raise ValueError("no table plane is seen; give table_plane or T_world_camera in the camera file")
    plane = np.append(normals[counts.argmax()], offsets[counts.argmax()])
    for _ in range(3):
        near = sample[np.abs(sample @ plane[:3] + plane[3]) < 0.004]
        centre = near.mean(0)
        normal = np.linalg.svd(near - centre, full_matrices=False)[2][2]
        plane = np.append(normal, -normal @ centre)
    return plane if plane[3] > 0 else -plane


def segment(cloud: NDArray[np.floating[Any]], height: NDArray[np.floating[Any]]) -> NDArray[np.bool_]:
    """The pixels of the one object: those above the table and connected in the image, large and near its middle.

    cloud: (height, width, 3) each pixel's point in the camera frame, 0 where there is no reading.
    height: (height, width) metres over the table.
    Raises ValueError when hardly a reading lies on the table, or nothing of at least 50 pixels stands on it.
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
    count, labels, stats, centres = cv2.connectedComponentsWithStats(closed, connectivity=8)
    labels[~above] = 0
    rows, columns = depth.shape
    best, best_value = 0, 0.0
    for label in range(1, count):
        area = stats[label, cv2.CC_STAT_AREA]
        offset = np.hypot(centres[label][0] / columns - 0.5, centres[label][1] / rows - 0.5)
        value = area * np.exp(-0.5 * (offset / 0.2) ** 2)
        if area >= MIN_POINTS and value > best_value:
            best, best_value = label, value
    if best == 0:
        raise ValueError(
            "no object is seen above the table within 1.4 m; check the depth, its scale and the table plane"
        )
    # parts of one object may be cut apart by a shadow: take in what lies within 2 cm of its box
    main = labels == best
    low, high = cloud[main].min(0) - 0.02, cloud[main].max(0) + 0.02
    near = above & ((cloud >= low) & (cloud <= high)).all(-1)
    joined = np.unique(labels[near])
    within = [label for label in joined if label and (near & (labels == label)).sum() > 0.9 * stats[label, 4]]
    return np.asarray(main | np.isin(labels, within))

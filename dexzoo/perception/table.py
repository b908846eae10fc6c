"""The table in a depth image: the largest plane."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

MAX_DEPTH = 1.4
"""Readings beyond this many meters count as none (the range of the thesis' sensor)."""
MIN_POINTS = 50
"""Fewest points that anything can be inferred from (Kopicki's generator asks as many)."""


NUM_TRIPLES = 500
"""Planes that are tried, each through three points."""
INLIER_DISTANCE, FINISH_DISTANCE = 0.006, 0.004
"""Meters from a tried plane, and from the fitted one, within which a point lies on it."""
MIN_SHARE = 0.1
"""Least share of the points that lie on the table's plane."""


def fit_table(points: NDArray[np.floating[Any]], seed: int = 0) -> NDArray[np.float64]:
    """The largest plane within 1.4 m, (4,), by RANSAC with a least-squares finish; its normal faces the camera.

    Args:
        points: Points in the camera frame, meters, (point, 3).
        seed: Seed of the search.

    Returns:
        Normal and offset: normal . p + offset = height over the table.

    Raises:
        ValueError: Fewer than a tenth of the readings lie on one plane.
    """
    rng = np.random.default_rng(seed)
    cloud = points[points[:, 2] < MAX_DEPTH]  # a wall behind the table may be larger than it
    if len(cloud) < MIN_POINTS:
        raise ValueError(f"fewer than {MIN_POINTS} readings within {MAX_DEPTH} m; check the depth and its scale")
    sample = cloud[rng.permutation(len(cloud))[:20_000]]
    triples = sample[rng.integers(len(sample), size=(NUM_TRIPLES, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals = normals[length > 1e-8] / length[length > 1e-8, None]
    offsets = -(normals * triples[length > 1e-8, 0]).sum(1)
    probe = sample[:2_000]
    counts = (np.abs(probe @ normals.T + offsets) < INLIER_DISTANCE).sum(0)
    if not counts.size or counts.max() < MIN_SHARE * len(probe):
        raise ValueError("no table plane is seen; give table_plane or T_world_camera in the camera file")
    plane = np.append(normals[counts.argmax()], offsets[counts.argmax()])
    for _ in range(3):
        near = sample[np.abs(sample @ plane[:3] + plane[3]) < FINISH_DISTANCE]
        center = near.mean(0)
        normal = np.linalg.svd(near - center, full_matrices=False)[2][2]
        plane = np.append(normal, -normal @ center)
    return plane if plane[3] > 0 else -plane

"""The depth sensor: what it reads of a depth image known exactly."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dexzoo.camera import Camera
from dexzoo.segmentation import MAX_DEPTH


def add_sensor_noise(
    depth: NDArray[np.float64], camera: Camera, rng: np.random.Generator, normals: NDArray[np.float64] | None = None
) -> NDArray[np.float32]:
    """Depth as a structured-light sensor of 75 mm baseline would read it.

    Gaussian disparity noise of 0.075 pixel on a grid 1.5 times coarser, disparity in steps of 1/8 pixel (the
    simulator behind the thesis); holes at depth edges and where the surface is seen at less than 12 degrees.
    normals: (height, width, 3) surface normals in the camera frame, if known.
    """
    baseline = 0.075
    height, width = depth.shape
    coarse = rng.normal(0, 0.075, (int(height / 1.5), int(width / 1.5))).astype(np.float32)
    noise = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    valid = depth > 0
    disparity = camera.fx * baseline / np.where(valid, depth, 1.0)
    disparity = np.round((disparity + noise) * 8) / 8
    noisy = camera.fx * baseline / np.maximum(disparity, 1e-3)
    metres = np.where(valid, depth, MAX_DEPTH).astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    edge = cv2.dilate(metres, kernel) - cv2.erode(metres, kernel) > 0.03
    valid &= ~(edge & (rng.random(depth.shape) < 0.5))
    if normals is not None:
        rays = camera.directions()
        cosine = np.abs((normals * rays).sum(-1)) / np.linalg.norm(rays, axis=-1)
        valid &= cosine > np.sin(np.deg2rad(12))
    return np.where(valid, noisy, 0).astype(np.float32)

"""The depth sensor: what it reads of a depth image known exactly."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dexzoo.camera import Camera
from dexzoo.segmentation import MAX_DEPTH

BASELINE = 0.075
"""Metres from the camera to the projector, along the camera's x."""


def read_depth(
    depth: NDArray[np.float64], lit: NDArray[np.bool_], camera: Camera, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Depth as a structured-light sensor of 75 mm baseline would read it."""
    height, width = depth.shape
    coarse = rng.normal(0, 0.075, (int(height / 1.5), int(width / 1.5))).astype(np.float32)
    noise = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    valid = (depth > 0) & lit
    disparity = camera.fx * BASELINE / np.where(valid, depth, 1.0)
    disparity = np.round((disparity + noise) * 8) / 8
    noisy = camera.fx * BASELINE / np.maximum(disparity, 1e-3)
    metres = np.where(valid, depth, MAX_DEPTH).astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    edge = cv2.dilate(metres, kernel) - cv2.erode(metres, kernel) > 0.03
    valid &= ~(edge & (rng.random(depth.shape) < 0.5))
    return np.where(valid, noisy, 0).astype(np.float32)

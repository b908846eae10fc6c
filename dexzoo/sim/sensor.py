"""The depth sensor: the reading of a structured-light camera of a scene whose depth is known exactly.

The figures are those of the simulator behind the thesis (the Kinect simulation of Bohg and of BlenSor), except where a
constant says that it is ours, fitted to real frames by `benchmarks/sensor.py`.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dexzoo.perception.camera import Camera

BASELINE = 0.075
"""Meters from the camera to the projector, along the camera's x: shadows fall on the left of things."""
DISPARITY_NOISE = 0.075
"""Standard deviation in pixels, drawn on a grid 1.5 times coarser than the image."""
DISPARITY_STEP = 1 / 8
"""Pixels."""
WINDOW = 9
"""Width in pixels of the window whose dots are matched with the projector's."""
MAX_DISTURBED = 1 / 3
"""Share of the window's dots that may be missing or of a nearer surface, before the pixel is lost."""
DOT_DENSITY = 1 / 9
"""Dots a pixel; ours. So few dots make edges ragged."""
SURFACE_STEP = 1.5
"""Pixels of disparity by which a dot must be nearer to be of another surface; ours."""
MAX_SLOPE = 1.0
"""Pixels of disparity from one pixel to the next, beyond which a surface's dots are torn too far apart; ours.

So steep is a surface 0.6 m away that is seen at less than 7 degrees."""


def read_depth(
    depth: NDArray[np.float64], lit: NDArray[np.bool_], camera: Camera, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Depth that the sensor reads.

    Only pixels whose point the projector reaches have a reading. Those are lost in whose window more than a third of
    the dots are unlit, or nearer by more than 1.5 pixels of disparity: the farther side of depth edges, and rims of
    shadows. Dots of a farther surface do not disturb (ours: real frames lose hardly any pixel on the nearer side of an
    edge). Surfaces seen at a grazing angle are lost too. The readings have Gaussian noise and steps in their disparity.

    Args:
        depth: Exact depth in meters, 0 without a surface, (height, width).
        lit: Pixels whose point the projector reaches, (height, width).
        camera: The camera.
        rng: Source of randomness.

    Returns:
        Depth in meters, 0 without a reading, (height, width).
    """
    height, width = depth.shape
    there = depth > 0
    disparity = np.zeros(depth.shape, np.float32)
    disparity[there] = camera.fx * BASELINE / depth[there]
    coarse = (max(1, round(width / 1.5)), max(1, round(height / 1.5)))
    noise = rng.standard_normal(coarse[::-1], np.float32) * np.float32(DISPARITY_NOISE)
    dots = rng.random(depth.shape, np.float32) < DOT_DENSITY
    noisy = disparity + cv2.resize(noise, (width, height), interpolation=cv2.INTER_NEAREST)
    noisy = np.maximum(np.round(noisy / DISPARITY_STEP) * DISPARITY_STEP, DISPARITY_STEP)
    read = there & lit & ~_disturbed(disparity, there & ~lit, dots) & (_slope(disparity) < MAX_SLOPE)
    return np.where(read, camera.fx * BASELINE / noisy, 0).astype(np.float32)


def _slope(disparity: NDArray[np.float32]) -> NDArray[np.float32]:
    """Its change from pixel to pixel, by the flatter side of each, so that an edge is none."""
    padded = np.pad(disparity, 1, mode="reflect" if min(disparity.shape) > 1 else "edge")
    x, y = np.abs(np.diff(padded[1:-1], axis=1)), np.abs(np.diff(padded[:, 1:-1], axis=0))
    return np.hypot(np.minimum(x[:, 1:], x[:, :-1]), np.minimum(y[1:], y[:-1]))


def _disturbed(disparity: NDArray[np.float32], unlit: NDArray[np.bool_], dots: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The pixels whose window matches too few dots."""
    kernel = np.ones((WINDOW, WINDOW), np.uint8)
    nearest = cv2.dilate(disparity, kernel)
    doubtful = (nearest - disparity > SURFACE_STEP) | (cv2.dilate(unlit.astype(np.uint8), kernel) > 0)
    rows, columns = np.nonzero(doubtful & (disparity > 0) & ~unlit)
    # only those few are counted dot by dot; outside the image there are no dots
    reach = WINDOW // 2
    padded, dark, seen = (np.pad(image, reach) for image in (disparity, unlit, dots))
    width = padded.shape[1]
    taps = (np.arange(WINDOW)[:, None] * width + np.arange(WINDOW)).ravel()
    window = (rows * width + columns)[:, None] + taps
    nearer = padded.ravel()[window] - disparity[rows, columns, None]
    wrong = (nearer > SURFACE_STEP) | (dark.ravel()[window] & (nearer > -SURFACE_STEP))
    counted = seen.ravel()[window]
    share = (wrong & counted).sum(1) / np.maximum(counted.sum(1), 1)
    disturbed = np.zeros(disparity.shape, bool)
    disturbed[rows, columns] = share > MAX_DISTURBED
    return disturbed

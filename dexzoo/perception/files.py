"""Depth images and camera files on disk."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def read_json(path: str | Path) -> dict[str, Any]:
    """Read a camera file.

    Args:
        path: JSON file.

    Returns:
        Its mapping.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file holds no JSON mapping.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"camera file {path} does not exist")
    try:
        values = json.loads(path.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"camera file {path} is not JSON: {error}") from None
    if not isinstance(values, dict):
        raise ValueError(f"camera file {path} holds no mapping; it needs width, height, fx, fy, cx, cy")
    return values


def read_depth(path: Path, scale: object, camera: Path) -> NDArray[np.float32]:
    """Read a depth image.

    Args:
        path: A .npy file, or an image that OpenCV reads.
        scale: Meters per unit; needed for integers.
        camera: Camera file that gave the scale, for errors.

    Returns:
        Depth in meters, (height, width).

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file is no depth image, or the scale is missing or cannot be.
    """
    if not path.is_file():
        raise FileNotFoundError(f"depth image {path} does not exist")
    if path.suffix == ".npy":
        try:
            image = np.load(path, allow_pickle=False)
        except (ValueError, EOFError, OSError) as error:
            raise ValueError(f"depth image {path} cannot be read: {error}") from None
    else:
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise ValueError(f"depth image {path} cannot be read; give a 16-bit PNG or a .npy file in meters")
    if image.ndim != 2:
        raise ValueError(f"depth image {path} has {image.ndim} dimensions, expected one channel of depth")
    if scale is None and image.dtype.kind in "iu":
        raise ValueError(f"{camera} has no depth_scale (meters per unit, 0.001 for millimeters), which {path} needs")
    if scale is not None and (isinstance(scale, bool) or not isinstance(scale, (int, float)) or not 0 < scale < np.inf):
        raise ValueError(f"{camera}: depth_scale is {scale!r}, expected meters per unit, a positive number")
    return np.asarray(image * (1.0 if scale is None else scale), np.float32)

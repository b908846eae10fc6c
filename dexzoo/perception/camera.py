"""Pinhole cameras, and poses that look at something."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexzoo.perception.files import read_json

IMAGE_SIZE = 224
"""Width and height in pixels of the image that evaluators see."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion; x right, y down, z forward.

    Attributes:
        width: Width of the image in pixels.
        height: Height of the image in pixels.
        fx: Focal length along x in pixels.
        fy: Focal length along y in pixels.
        cx: Principal point along x in pixels.
        cy: Principal point along y in pixels.
    """

    width: int = 640
    height: int = 480
    fx: float = 574.0
    fy: float = 574.0
    cx: float = 320.0
    cy: float = 240.0

    @classmethod
    def load(cls, path: str | Path) -> Camera:
        """Read a camera file.

        Args:
            path: JSON file with width, height, fx, fy, cx, cy.

        Raises:
            FileNotFoundError: The file does not exist.
            ValueError: The file is no JSON, or a number is missing or cannot be.
        """
        return cls.from_dict(read_json(path), str(path))

    @classmethod
    def from_dict(cls, values: dict[str, Any], where: str = "camera") -> Camera:
        """Make a camera of a mapping.

        Args:
            values: width, height, fx, fy, cx, cy; other entries are ignored.
            where: Origin of the values, for errors.

        Raises:
            ValueError: A number is missing or cannot be.
        """
        names = ("width", "height", "fx", "fy", "cx", "cy")
        for name in names:
            if name not in values:
                raise ValueError(f"{where} has no {name}; it needs {', '.join(names)}")
            value = values[name]
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(value):
                raise ValueError(f"{where}: {name} is {value!r}, expected a number")
            if name in ("width", "height", "fx", "fy") and value <= 0:
                raise ValueError(f"{where}: {name} is {value}, expected a positive number")
        return cls(int(values["width"]), int(values["height"]), *(float(values[name]) for name in names[2:]))

    @classmethod
    def aimed(cls, size: int = IMAGE_SIZE) -> Camera:
        """The camera of an aimed view: 460 pixels of f = 574, shrunk (the thesis' crop, section 3.3).

        Args:
            size: Width and height in pixels.
        """
        focal, middle = 574 * size / 460, (size - 1) / 2
        return cls(size, size, focal, focal, middle, middle)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """(3, 3) intrinsic matrix."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])

    def directions(self) -> NDArray[np.float64]:
        """(height, width, 3) viewing directions with z = 1, camera frame; not to be written to."""
        return _directions(self)

    def project(self, points: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """Project points.

        Args:
            points: Points in the camera frame, meters, (*batch, 3).

        Returns:
            Pixel coordinates, (*batch, 2).
        """
        homogeneous = np.asarray(points, np.float64) @ self.matrix.T
        return homogeneous[..., :2] / homogeneous[..., 2:]


@lru_cache(maxsize=4)
def _directions(camera: Camera) -> NDArray[np.float64]:
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack(((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)), axis=-1)
    rays.setflags(write=False)
    return rays


def upright(forward: NDArray[np.float64], up: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) axes of an upright camera that looks along `forward`: its x level, its y down, its z forward.

    If it looks straight along `up`, its x is that of the frame in which both are given.

    Args:
        forward: Direction of view, (3,).
        up: Unit vector, (3,).
    """
    z = forward / np.linalg.norm(forward)
    x = np.cross(z, up)
    if np.linalg.norm(x) < 1e-3:
        x = np.array([1.0, 0, 0]) - z[0] * z
    x /= np.linalg.norm(x)
    return np.column_stack((x, np.cross(z, x), z))


def look_at(target: NDArray[np.float64], distance: float, azimuth: float, elevation: float) -> NDArray[np.float64]:
    """Pose of an upright camera that looks at a target.

    Args:
        target: Point in the world frame, meters, (3,).
        distance: Meters from the target.
        azimuth: Angle about the vertical, radians.
        elevation: Angle over the horizontal, radians.

    Returns:
        T_world_camera, (4, 4).
    """
    back = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    pose = np.eye(4)
    pose[:3, :3] = upright(-back, np.array([0, 0, 1.0]))
    pose[:3, 3] = np.asarray(target) + distance * back
    return pose

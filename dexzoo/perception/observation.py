"""One depth image, where it was taken from, the table, and the object in it."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from dexzoo import rotation
from dexzoo.perception.camera import IMAGE_SIZE, Camera, upright
from dexzoo.perception.files import read_depth, read_json
from dexzoo.perception.segmentation import segment
from dexzoo.perception.table import fit_table

MAX_TILT, MAX_RISE = np.deg2rad(10), 0.05
"""Radians and meters by which a camera's pose may contradict the table that it sees."""


class Observation:
    """One depth image with its camera, the table, and the object in it.

    Args:
        depth: Depth along z in meters, 0 or NaN for no reading, (height, width).
        camera: The camera.
        T_world_camera: Pose of the camera in a world whose table top is z = 0, (4, 4). Without it, the world is laid
            into the table: z up, origin below the camera, x along the camera's.
        table: Plane of the table in the camera frame, normal . p + offset = height, (4,). Without it, it follows from
            T_world_camera, or is fitted to the image. If both are given, the pose is leveled: height and tilt of a
            camera are known better from the table that it sees than from its calibration.
        mask: The object's pixels, bool, (height, width). Without it, the object is segmented.

    Raises:
        ValueError: The image, the pose, the table or the mask cannot be used.
    """

    def __init__(
        self,
        depth: NDArray[Any],
        camera: Camera,
        T_world_camera: NDArray[Any] | None = None,
        table: NDArray[Any] | None = None,
        mask: NDArray[Any] | None = None,
    ) -> None:
        self.camera = camera
        self.depth = _check_depth(depth, camera)
        self.T_world_camera: NDArray[np.float64]
        self.table: NDArray[np.float64]
        if T_world_camera is not None:
            pose = rotation.check_pose(T_world_camera, "T_world_camera").numpy()
            self.table = pose[2].copy() if table is None else _check_table(table)
            self.T_world_camera = pose if table is None else _level(pose, self.table)
        else:
            self.table = fit_table(self._cloud[self.depth > 0]) if table is None else _check_table(table)
            self.T_world_camera = _pose_over_table(self.table)
        if mask is not None and mask.shape != self.depth.shape:
            raise ValueError(f"mask has shape {mask.shape}, expected that of the depth, {self.depth.shape}")
        self._mask = None if mask is None else np.asarray(mask, bool)

    @classmethod
    def load(cls, depth: str | Path, camera: str | Path) -> Observation:
        """Read a depth image and a camera file.

        Args:
            depth: A .png with depth_scale in the camera file, or a .npy in meters.
            camera: JSON with width, height, fx, fy, cx, cy, and if known depth_scale (meters per unit), table_plane
                {normal, offset} in the camera frame, T_world_camera (4 x 4).

        Raises:
            FileNotFoundError: A file does not exist.
            ValueError: A file cannot be used.
        """
        config = read_json(camera)
        intrinsics = Camera.from_dict(config, str(camera))
        image = read_depth(Path(depth), config.get("depth_scale"), Path(camera))
        pose = config.get("T_world_camera")
        plane = config.get("table_plane")
        try:
            pose = None if pose is None else rotation.check_pose(pose, "T_world_camera").numpy()
            table = None if plane is None else _check_table(np.array([*plane["normal"], plane["offset"]], np.float64))
        except (KeyError, TypeError):
            raise ValueError(
                f"{camera}: table_plane must be {{normal: [x, y, z], offset: d}}, T_world_camera 4 rows of 4 numbers"
            ) from None
        except ValueError as error:
            raise ValueError(f"{camera}: {error}") from None
        try:
            return cls(image, intrinsics, pose, table)
        except ValueError as error:
            raise ValueError(f"{depth}: {error}") from None

    @property
    def _cloud(self) -> NDArray[np.float64]:
        """(height, width, 3) the point at each pixel in the camera frame; 0 without a reading."""
        return self.camera.directions() * self.depth[..., None]

    @cached_property
    def height(self) -> NDArray[np.float32]:
        """(height, width) meters over the table at each pixel; 0 without a reading."""
        rays = self.camera.directions() @ self.table[:3]
        return np.where(self.depth > 0, self.depth * rays + self.table[3], 0).astype(np.float32)

    @cached_property
    def mask(self) -> NDArray[np.bool_]:
        """(height, width) pixels of the object: the largest connected thing on the table, preferring the center.

        Raises ValueError when nothing stands on the table, or a given mask holds no reading.
        """
        if self._mask is None:
            return segment(self._cloud, self.height)
        seen: NDArray[np.bool_] = self._mask & (self.depth > 0)
        if not seen.any():
            raise ValueError("the object's mask holds no depth reading; check that it belongs to this image")
        return seen

    @cached_property
    def points(self) -> NDArray[np.float32]:
        """(num_points, 3) the object's points in the camera frame."""
        cloud = self.camera.directions()[self.mask] * self.depth[self.mask][:, None]
        return cloud.astype(np.float32)

    @cached_property
    def points_world(self) -> NDArray[np.float32]:
        """(num_points, 3) the object's points in the world frame."""
        T = self.T_world_camera
        return (self.points @ T[:3, :3].T + T[:3, 3]).astype(np.float32)

    def would_see(self, points_world: NDArray[np.floating[Any]], margin: float = 0.005) -> NDArray[np.bool_]:
        """Which points would lie in plain view, in front of the observed surface: no part of the scene can be there.

        Args:
            points_world: Points in the world frame, meters, (point, 3).
            margin: Meters by which they must lie in front.

        Returns:
            Whether each would be seen, (point,).
        """
        T = np.linalg.inv(self.T_world_camera)
        points = points_world @ T[:3, :3].T + T[:3, 3]
        column, row = np.round(self.camera.project(points)).astype(int).T
        inside = (column >= 0) & (row >= 0) & (column < self.camera.width) & (row < self.camera.height)
        seen = np.zeros(len(points))
        seen[inside] = self.depth[row[inside], column[inside]]
        return np.asarray((seen > 0) & (points[:, 2] < seen - margin))

    def aimed(self, size: int = IMAGE_SIZE) -> Observation:
        """The view of a camera in the same place that looks at the object's center, upright.

        Its camera is `Camera.aimed(size)`. Turning a camera about its center loses nothing but pixels.

        Args:
            size: Width and height in pixels.
        """
        virtual = Camera.aimed(size)
        turn = upright(self.points.mean(0, dtype=np.float64), self.table[:3])  # T_camera_virtual, rotation only
        pixels = virtual.directions() @ turn.T @ self.camera.matrix.T
        source = (pixels[..., :2] / np.maximum(pixels[..., 2:], 1e-6)).astype(np.float32)
        # a turn does not change the range along a ray
        rays = self.camera.directions()
        distance = (self.depth * np.linalg.norm(rays, axis=-1)).astype(np.float32)
        seen = cv2.remap(distance, source[..., 0], source[..., 1], cv2.INTER_NEAREST, borderValue=0)
        mask = cv2.remap(self.mask.astype(np.uint8), source[..., 0], source[..., 1], cv2.INTER_NEAREST, borderValue=0)
        depth = seen / np.linalg.norm(virtual.directions(), axis=-1)
        T = self.T_world_camera.copy()
        T[:3, :3] = T[:3, :3] @ turn
        table = np.append(self.table[:3] @ turn, self.table[3])
        return Observation(depth, virtual, T, table, mask)

    def image(self) -> Float[Tensor, "2 224 224"]:
        """The image that evaluators see: the object's depth and its height over the table, meters; 0 elsewhere.

        Call it on an `aimed` observation.
        """
        return torch.from_numpy(np.where(self.mask, np.stack((self.depth, self.height)), 0).astype(np.float32))


def _check_depth(depth: NDArray[Any], camera: Camera) -> NDArray[np.float32]:
    image = np.asarray(depth)
    if image.shape != (camera.height, camera.width):
        size = " x ".join(str(n) for n in image.shape[::-1])
        raise ValueError(f"depth is {size} pixels, but the camera is {camera.width} x {camera.height}")
    if image.dtype.kind not in "fiu":
        raise ValueError(f"depth has the type {image.dtype}, expected meters as floating-point numbers")
    image = image.astype(np.float32)
    image = np.where(np.isfinite(image) & (image > 0), image, 0).astype(np.float32)
    readings = image[image > 0]
    if not readings.size:
        raise ValueError("depth holds no reading: every pixel is zero, negative, NaN or infinite")
    if np.median(readings) > 20:
        raise ValueError(
            f"depth has a median of {np.median(readings):.0f} and looks like millimeters; give meters (divide by 1000) "
            "or a depth_scale in the camera file"
        )
    return image


def _check_table(table: NDArray[Any]) -> NDArray[np.float64]:
    """The plane with a unit normal."""
    plane = np.asarray(table, np.float64)
    if plane.shape != (4,) or not np.isfinite(plane).all() or not plane[:3].any():
        raise ValueError(f"table plane is {plane.tolist()}, expected four numbers: a normal and an offset in meters")
    if plane[3] <= 0:
        raise ValueError("table plane lies above the camera: normal . p + offset must be a height over the table")
    return np.asarray(plane / np.linalg.norm(plane[:3]))


def _level(pose: NDArray[np.float64], table: NDArray[np.float64]) -> NDArray[np.float64]:
    """T_world_camera turned and raised by the least that lays the table into z = 0."""
    up = pose[:3, :3] @ table[:3]
    tilt, rise = np.arccos(min(up[2], 1.0)), table[3] - pose[2, 3]
    if tilt > MAX_TILT or abs(rise) > MAX_RISE:
        raise ValueError(
            f"T_world_camera and the table plane contradict each other by {np.rad2deg(tilt):.1f} degrees and "
            f"{1000 * rise:.0f} mm; give the pose in a world whose table top is z = 0, or leave one of them out"
        )
    if tilt < 1e-6 and abs(rise) < 1e-9:
        return pose  # to the bit
    leveled = pose.copy()
    leveled[:3, :3] = _turn_between(up, np.array([0, 0, 1.0])) @ pose[:3, :3]
    leveled[2, 3] = table[3]
    return leveled


def _turn_between(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) least rotation that takes unit vector a to b, which must not be opposite."""
    axis = np.cross(a, b)
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turn: NDArray[np.float64] = np.eye(3) + K + K @ K / (1 + a @ b)
    return turn


def _pose_over_table(plane: NDArray[np.float64]) -> NDArray[np.float64]:
    """T_world_camera for a table plane given in the camera frame."""
    up = plane[:3]
    right = np.array([1.0, 0, 0]) - up[0] * up
    if np.linalg.norm(right) < 1e-3:  # the camera lies on its side: its own down will do
        right = np.array([0, 1.0, 0]) - up[1] * up
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack((right, np.cross(up, right), up))
    T[2, 3] = plane[3]
    return T

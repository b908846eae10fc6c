"""Cameras and observations: one depth image, where it was taken from, the table, and the object in it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from dexzoo import rotation
from dexzoo.segmentation import fit_table, segment

IMAGE_SIZE = 224
MAX_TILT, MAX_RISE = np.deg2rad(10), 0.05
"""Radians and metres by which a camera's pose may contradict the table that it sees."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion; pixel units, x right, y down, z forward."""

    width: int = 640
    height: int = 480
    fx: float = 574.0
    fy: float = 574.0
    cx: float = 320.0
    cy: float = 240.0

    @classmethod
    def load(cls, path: str | Path) -> Camera:
        """Read width, height, fx, fy, cx, cy from a JSON file; ValueError names what is missing."""
        return cls.from_dict(_read_json(path), str(path))

    @classmethod
    def from_dict(cls, values: dict[str, Any], where: str = "camera") -> Camera:
        """From a mapping with the six numbers; others are ignored."""
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
        """That of an aimed view: 460 pixels of f = 574, shrunk to `size` (the thesis' crop, section 3.3)."""
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
        """Pixel coordinates (*batch, 2) of points (*batch, 3) in the camera frame."""
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

    Looking straight along `up` (a unit vector) its x is that of the frame in which both are given.
    """
    z = forward / np.linalg.norm(forward)
    x = np.cross(z, up)
    if np.linalg.norm(x) < 1e-3:
        x = np.array([1.0, 0, 0]) - z[0] * z
    x /= np.linalg.norm(x)
    return np.column_stack((x, np.cross(z, x), z))


def look_at(target: NDArray[np.float64], distance: float, azimuth: float, elevation: float) -> NDArray[np.float64]:
    """T_world_camera of an upright camera `distance` metres from a target (3,); angles in radians."""
    back = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    pose = np.eye(4)
    pose[:3, :3] = upright(-back, np.array([0, 0, 1.0]))
    pose[:3, 3] = np.asarray(target) + distance * back
    return pose


class Observation:
    """One depth image and all that follows from it.

    depth: (height, width) metres along z; 0 or NaN = no reading.
    T_world_camera: (4, 4) pose of the camera in the world, whose table top is z = 0. Without it, the world is laid
    into the table: z up, origin below the camera, x along the camera's.
    table: (4,) plane in the camera frame, normal . p + offset = height over the table. Without it, it follows from
    T_world_camera, or is fitted to the image. Given with it, the pose is levelled: the table that is seen tells height
    and tilt of a camera better than its calibration.
    mask: (height, width) bool, the object's pixels. Without it, the object is segmented.

    Raises ValueError that says what is wrong with the image or that no object is seen.
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
        """Read a depth image (.png with depth_scale in the camera file, or .npy in metres) and a camera file.

        The camera file is JSON with width, height, fx, fy, cx, cy, and where known depth_scale (metres per unit),
        table_plane {normal, offset} in the camera frame, T_world_camera (4 x 4).
        """
        config = _read_json(camera)
        intrinsics = Camera.from_dict(config, str(camera))
        image = _read_depth(Path(depth), config.get("depth_scale"), Path(camera))
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
        """(height, width, 3) the point at each pixel in the camera frame; 0 where there is no reading."""
        return self.camera.directions() * self.depth[..., None]

    @cached_property
    def height(self) -> NDArray[np.float32]:
        """(height, width) metres over the table at each pixel; 0 where there is no reading."""
        rays = self.camera.directions() @ self.table[:3]
        return np.where(self.depth > 0, self.depth * rays + self.table[3], 0).astype(np.float32)

    @cached_property
    def mask(self) -> NDArray[np.bool_]:
        """(height, width) pixels of the object: the largest connected thing on the table, preferring the centre.

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
        """(num_points,) which points of the world would lie in plain view, by `margin` metres in front of what is seen.

        No part of the scene can be there.
        """
        T = np.linalg.inv(self.T_world_camera)
        points = points_world @ T[:3, :3].T + T[:3, 3]
        column, row = np.round(self.camera.project(points)).astype(int).T
        inside = (column >= 0) & (row >= 0) & (column < self.camera.width) & (row < self.camera.height)
        seen = np.zeros(len(points))
        seen[inside] = self.depth[row[inside], column[inside]]
        return np.asarray((seen > 0) & (points[:, 2] < seen - margin))

    def aimed(self, size: int = IMAGE_SIZE) -> Observation:
        """The view of a camera in the same place that looks at the object's centre, upright.

        Its camera is `Camera.aimed(size)`. Turning a camera about its centre loses nothing but pixels.
        """
        virtual = Camera.aimed(size)
        turn = upright(self.points.mean(0, dtype=np.float64), self.table[:3])  # T_camera_virtual, rotation only
        pixels = virtual.directions() @ turn.T @ self.camera.matrix.T
        source = (pixels[..., :2] / np.maximum(pixels[..., 2:], 1e-6)).astype(np.float32)
        # range along the ray is what a turn leaves as it is
        rays = self.camera.directions()
        distance = (self.depth * np.linalg.norm(rays, axis=-1)).astype(np.float32)
        seen = cv2.remap(distance, source[..., 0], source[..., 1], cv2.INTER_NEAREST, borderValue=0)
        mask = cv2.remap(self.mask.astype(np.uint8), source[..., 0], source[..., 1], cv2.INTER_NEAREST, borderValue=0)
        depth = seen / np.linalg.norm(virtual.directions(), axis=-1)
        T = self.T_world_camera.copy()
        T[:3, :3] = T[:3, :3] @ turn
        table = np.append(self.table[:3] @ turn, self.table[3])
        return Observation(depth, virtual, T, table, mask)

    def image(self, keep_table: bool = False) -> Float[Tensor, "2 224 224"]:
        """What an evaluator sees: the object's depth and its height over the table, metres; 0 at all other pixels.

        Call it on an `aimed` observation. keep_table: keep all pixels that have a reading; the shipped evaluators
        were trained without.
        """
        shown = self.depth > 0 if keep_table else self.mask
        return torch.from_numpy(np.where(shown, np.stack((self.depth, self.height)), 0).astype(np.float32))


def colourise(depth: Float[Tensor, "view height width"]) -> Float[Tensor, "view 3 height width"]:
    """Depth, mean curvature g_xx + g_yy and Gaussian curvature g_xx g_yy - g_xy^2 (thesis, eqs 3.3 to 3.6).

    Derivatives are central differences over 1 x 3 windows, in metres per pixel; zero where the window leaves the
    object (depth 0). Square and signed roots bring the curvatures to the scale of the depth's own changes.
    """
    g = torch.nn.functional.pad(depth[:, None], (1, 1, 1, 1))[:, 0]
    seen = torch.nn.functional.max_pool2d((g == 0).float()[:, None], 3, 1)[:, 0] == 0
    middle = g[:, 1:-1, 1:-1]
    g_xx = g[:, 1:-1, 2:] - 2 * middle + g[:, 1:-1, :-2]
    g_yy = g[:, 2:, 1:-1] - 2 * middle + g[:, :-2, 1:-1]
    g_xy = (g[:, 2:, 2:] - g[:, 2:, :-2] - g[:, :-2, 2:] + g[:, :-2, :-2]) / 4
    mean = torch.where(seen, g_xx + g_yy, 0.0)
    gaussian = torch.where(seen, g_xx * g_yy - g_xy * g_xy, 0.0)

    def compress(value: Tensor) -> Tensor:
        return value.sign() * value.abs().sqrt()

    return torch.stack((depth, compress(mean), compress(compress(gaussian))), dim=1)


def _check_depth(depth: NDArray[Any], camera: Camera) -> NDArray[np.float32]:
    image = np.asarray(depth)
    if image.shape != (camera.height, camera.width):
        size = " x ".join(str(n) for n in image.shape[::-1])
        raise ValueError(f"depth is {size} pixels, but the camera is {camera.width} x {camera.height}")
    if image.dtype.kind not in "fiu":
        raise ValueError(f"depth has the type {image.dtype}, expected metres as floating-point numbers")
    image = image.astype(np.float32)
    image = np.where(np.isfinite(image) & (image > 0), image, 0).astype(np.float32)
    readings = image[image > 0]
    if not readings.size:
        raise ValueError("depth holds no reading: every pixel is zero, negative, NaN or infinite")
    if np.median(readings) > 20:
        raise ValueError(
            f"depth has a median of {np.median(readings):.0f} and looks like millimetres; give metres (divide by 1000) "
            "or a depth_scale in the camera file"
        )
    return image


def _check_table(table: NDArray[Any]) -> NDArray[np.float64]:
    """The plane with a unit normal."""
    plane = np.asarray(table, np.float64)
    if plane.shape != (4,) or not np.isfinite(plane).all() or not plane[:3].any():
        raise ValueError(f"table plane is {plane.tolist()}, expected four numbers: a normal and an offset in metres")
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
    levelled = pose.copy()
    levelled[:3, :3] = _turn_between(up, np.array([0, 0, 1.0])) @ pose[:3, :3]
    levelled[2, 3] = table[3]
    return levelled


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


def _read_json(path: str | Path) -> dict[str, Any]:
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


def _read_depth(path: Path, scale: object, camera: Path) -> NDArray[np.float32]:
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
            raise ValueError(f"depth image {path} cannot be read; give a 16-bit PNG or a .npy file in metres")
    if image.ndim != 2:
        raise ValueError(f"depth image {path} has {image.ndim} dimensions, expected one channel of depth")
    if scale is None and image.dtype.kind in "iu":
        raise ValueError(f"{camera} has no depth_scale (metres per unit, 0.001 for millimetres), which {path} needs")
    if scale is not None and (isinstance(scale, bool) or not isinstance(scale, (int, float)) or not 0 < scale < np.inf):
        raise ValueError(f"{camera}: depth_scale is {scale!r}, expected metres per unit, a positive number")
    return np.asarray(image * (1.0 if scale is None else scale), np.float32)

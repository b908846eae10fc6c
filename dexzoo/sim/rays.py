"""Depth images of a scene by casting rays (Embree, through trimesh); no graphics card is needed."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from dexzoo.perception.camera import Camera
from dexzoo.perception.table import MAX_DEPTH
from dexzoo.sim.objects import Mesh

_TOUCH = 2e-3  # share of a ray's length by which a hit may miss the point it was cast at


class RayCaster:
    """Casts rays at an object and its support over the table z = 0; all in the world frame.

    Args:
        obj: Mesh of the object.
        support: Mesh of the block that it lies on, if any.
    """

    def __init__(self, obj: Mesh, support: Mesh | None) -> None:
        joined = obj if support is None else trimesh.util.concatenate([obj, support])
        assert isinstance(joined, Mesh)  # what meshes alone make
        self._mesh = joined
        self._num_faces = len(obj.faces)
        self._normals = self._mesh.face_normals
        self._offsets = (self._normals * self._mesh.triangles[:, 0]).sum(1)

    def depth(self, camera: Camera, pose: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Exact depth image.

        Args:
            camera: The camera.
            pose: T_world_camera, (4, 4).

        Returns:
            Depth in meters, 0 beyond 1.4 m, and the pixels that see the object, both (height, width).
        """
        rays = camera.directions()
        with np.errstate(divide="ignore"):
            depth = -pose[2, 3] / (rays @ pose[2, :3])  # of the table
        depth[depth < 0] = np.inf
        window = _window(np.asarray(self._mesh.vertices), camera, pose)
        distance, face = self._first(pose[:3, 3], rays[window] @ pose[:3, :3].T)
        nearer = distance < depth[window]
        depth[window] = np.minimum(distance, depth[window])
        depth[depth > MAX_DEPTH] = 0
        on_object = np.zeros(depth.shape, bool)
        on_object[window] = nearer & (face < self._num_faces)
        return depth, on_object & (depth > 0)

    def lit(
        self, depth: NDArray[np.float64], camera: Camera, pose: NDArray[np.float64], projector: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Pixels that show a point which a projector reaches, (height, width).

        Args:
            depth: Exact depth in meters, (height, width).
            camera: The camera.
            pose: T_world_camera, (4, 4).
            projector: Place of the projector in the world frame, (3,).
        """
        vertices = np.asarray(self._mesh.vertices)
        # shadows fall on the object, its support and the table: no farther than those of the vertices
        drop = np.maximum(projector[2] - vertices[:, 2], 0.01)
        shadows = projector + (vertices - projector) * (projector[2] / drop)[:, None]
        window = _window(np.concatenate((vertices, shadows)), camera, pose)
        points = (camera.directions()[window] * depth[window][..., None]) @ pose[:3, :3].T + pose[:3, 3]
        distance, _ = self._first(projector, points - projector)
        lit = np.ones(depth.shape, bool)
        lit[window] = distance > 1 - _TOUCH
        return lit

    def _first(
        self, origin: NDArray[np.float64], directions: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """How many lengths of each direction (*batch, 3) away it first hits a face, inf for none, and which face."""
        flat = directions.reshape(-1, 3)
        face = np.asarray(self._mesh.ray.intersects_first(np.broadcast_to(origin, flat.shape), flat), np.int64)
        hit = np.flatnonzero(face >= 0)
        normal = self._normals[face[hit]]
        distance = np.full(len(flat), np.inf)
        with np.errstate(divide="ignore", invalid="ignore"):
            distance[hit] = (self._offsets[face[hit]] - normal @ origin) / (normal * flat[hit]).sum(1)
        distance[~(distance > 0)] = np.inf
        return distance.reshape(directions.shape[:-1]), face.reshape(directions.shape[:-1])


def _window(points: NDArray[Any], camera: Camera, pose: NDArray[np.float64]) -> tuple[slice, slice]:
    """The rows and columns of an image that can show points (num_points, 3) of the world."""
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    if (local[:, 2] < 0.01).any():  # behind the camera, or about to be
        return slice(None), slice(None)
    pixels = camera.project(local)
    low, high = np.floor(pixels.min(0)).astype(int), np.ceil(pixels.max(0)).astype(int) + 1
    return slice(max(low[1], 0), max(high[1], 0)), slice(max(low[0], 0), max(high[0], 0))

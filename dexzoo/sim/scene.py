"""A scene: one object at rest on the table, and the camera that looks at it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import mujoco
import numpy as np
from numpy.typing import NDArray

from dexzoo import rotation
from dexzoo.camera import Camera, Observation
from dexzoo.hand import HandSpec
from dexzoo.segmentation import MAX_DEPTH
from dexzoo.sensor import add_sensor_noise
from dexzoo.sim.objects import ObjectModel
from dexzoo.sim.robot import add_hand, to_quaternion
from dexzoo.sim.world import WORKING, Physics, make_world

SETTLE_TIME = 4.0
MIN_PIXELS = 250
_VISUAL_GROUP = 3
_STILL = 0.01  # m/s and rad/s, for 25 steps together
_STAYS = 5e-4  # m, or half radians, over the last quarter of the time


@dataclass
class Scene:
    """An object that lies still on the table (z = 0 of the world).

    T_world_object: (4, 4). T_world_camera: the pose of the latest observation, in whose frame grasps in the camera
    frame are understood; None before the first.
    """

    object: ObjectModel
    T_world_object: NDArray[np.float64]
    T_world_camera: NDArray[np.float64] | None = field(default=None, repr=False)

    @classmethod
    def place(cls, obj: ObjectModel, seed: int = 0) -> Scene:
        """Drop the object from 5 mm with a random yaw and let it settle, as it stands in its own frame.

        Raises ValueError when it does not come to rest near the origin in three tries.
        """
        rng = np.random.default_rng(seed)
        model = make_world(obj, WORKING).compile()
        data = mujoco.MjData(model)
        low = obj.mesh.bounds[0][2]
        for _ in range(3):
            mujoco.mj_resetData(model, data)
            yaw = rng.uniform(0, 2 * np.pi)
            center = obj.inertia[0]
            data.qpos[:2] = -np.array(
                [np.cos(yaw) * center[0] - np.sin(yaw) * center[1], np.sin(yaw) * center[0] + np.cos(yaw) * center[1]]
            )
            data.qpos[2] = 0.005 - low
            data.qpos[3:] = [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
            still = 0
            late = data.qpos.copy()
            for step in range(int(SETTLE_TIME / WORKING.timestep)):
                mujoco.mj_step(model, data)
                data.qvel[:] *= 0.98  # air, without which a ball would roll for ever
                still = still + 1 if np.abs(data.qvel).max() < _STILL else 0
                if still >= 25:
                    break
                if step == int(0.75 * SETTLE_TIME / WORKING.timestep):
                    late = data.qpos.copy()
            # what rocks on three points trembles for ever, but stays where it is
            stays = still >= 25 or np.abs(data.qpos - late).max() < _STAYS
            pose = np.eye(4)
            pose[:3, :3] = data.xmat[1].reshape(3, 3)
            pose[:3, 3] = data.xpos[1]
            if stays and np.linalg.norm(data.xipos[1][:2]) < 0.1:
                return cls(obj, pose)
        raise ValueError(f"object {obj.name} does not come to rest on the table; check its mesh, convex parts and size")

    def model(self, hand: HandSpec, physics: Physics = WORKING) -> mujoco.MjModel:
        """The world of a trial: table, object and hand. The object's free joint is `object`, the wrist's `wrist`."""
        world = make_world(self.object, physics)
        add_hand(world, hand)
        return world.compile()

    @cached_property
    def _visual(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        world = mujoco.MjSpec()
        world.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[2, 2, 0.1], group=_VISUAL_GROUP)
        mesh = self.object.mesh
        world.add_mesh(
            name="object",
            uservert=mesh.vertices.astype(np.float32).ravel(),
            userface=mesh.faces.astype(np.int32).ravel(),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        )
        pose = self.T_world_object
        body = world.worldbody.add_body(pos=pose[:3, 3], quat=to_quaternion(pose[:3, :3]))
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="object", group=_VISUAL_GROUP)
        model = world.compile()
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        return model, data

    def observe(
        self,
        seed: int = 0,
        camera: Camera | None = None,
        T_world_camera: NDArray[np.float64] | None = None,
        ideal: bool = False,
    ) -> Observation:
        """One depth image, from a given pose or from one drawn as in the grasp set.

        A drawn camera stands at an elevation of 30 to 57 degrees and any azimuth, 0.40 to 0.75 m away, and looks within
        3 cm of the object's centre. ideal: exact depth instead of the sensor's.
        Raises ValueError when the object cannot be seen from there.
        """
        rng = np.random.default_rng(seed)
        camera = camera or Camera()
        if T_world_camera is None:
            pose = _draw_pose(rng, self._center())
        else:
            pose = rotation.check_pose(T_world_camera, "T_world_camera").numpy()
        depth, normals, on_object = self._cast(camera, pose)
        if on_object.sum() < MIN_PIXELS:
            raise ValueError(f"object {self.object.name} covers {on_object.sum()} pixels, fewer than {MIN_PIXELS}")
        seen = depth if ideal else add_sensor_noise(depth, camera, rng, normals)
        observation = Observation(seen, camera, pose)
        self.T_world_camera = pose
        return observation

    def _center(self) -> NDArray[np.float64]:
        middle: NDArray[np.float64] = self.object.mesh.bounds.mean(0)
        return self.T_world_object[:3, :3] @ middle + self.T_world_object[:3, 3]

    def _cast(
        self, camera: Camera, pose: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """Exact depth (m), normals in the camera frame, and the pixels that hit the object."""
        model, data = self._visual
        rays = camera.directions()
        length = np.linalg.norm(rays, axis=-1)
        directions = (rays / length[..., None]) @ pose[:3, :3].T
        count = length.size
        geom, distance, normal = np.zeros(count, np.int32), np.zeros(count), np.zeros(3 * count)
        groups = np.zeros(6, np.uint8)
        groups[_VISUAL_GROUP] = 1
        mujoco.mj_multiRay(
            model, data, pose[:3, 3], directions.reshape(-1), groups, True, -1, geom, distance, normal, count, 3.0
        )
        depth = np.where(distance > 0, distance, 0).reshape(length.shape) / length
        depth[depth > MAX_DEPTH] = 0
        normals = normal.reshape(*length.shape, 3) @ pose[:3, :3]
        return depth, normals, geom.reshape(length.shape) == 1


def _draw_pose(rng: np.random.Generator, center: NDArray[np.float64]) -> NDArray[np.float64]:
    """A camera pose of the grasp set's distribution (thesis, section 3.5.1), upright."""
    elevation, azimuth = np.deg2rad(rng.uniform(30, 57)), rng.uniform(0, 2 * np.pi)
    gaze = center + rng.uniform(-0.03, 0.03, 3)
    back = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    forward = -back
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack((right, np.cross(forward, right), forward))
    pose[:3, 3] = gaze + rng.uniform(0.40, 0.75) * back
    return pose

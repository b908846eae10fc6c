"""A scene: one object at rest on the table, and the camera that looks at it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from dexzoo import rotation
from dexzoo.camera import Camera, Observation, look_at
from dexzoo.hand import HandSpec
from dexzoo.sensor import BASELINE, read_depth
from dexzoo.sim.objects import ObjectModel
from dexzoo.sim.placement import place
from dexzoo.sim.rays import RayCaster
from dexzoo.sim.robot import add_hand
from dexzoo.sim.world import WORKING, Physics, Support, make_world

MIN_PIXELS = 250
CALIBRATION_ERROR = 0.004
"""Standard deviation in metres, on each axis, of where the camera stands from where its observation believes it."""


@dataclass
class Scene:
    """An object that lies still on the table (z = 0 of the world), or on a block that stands on it.

    T_world_object: (4, 4). support: the block, or None. These and the object are all that a scene is made of again.
    T_world_camera: the pose of the latest observation, in whose frame grasps in the camera frame are understood; None
    before the first.
    """

    object: ObjectModel
    T_world_object: NDArray[np.float64]
    support: Support | None = None
    T_world_camera: NDArray[np.float64] | None = field(default=None, repr=False)

    @classmethod
    def place(cls, obj: ObjectModel, seed: int = 0) -> Scene:
        """Drop the object with a random yaw, or tumbled, on the table or on a block, and let it settle.

        What lies on a block or tumbles is said in `placement`, by category; all else stands as in its own frame.
        Raises ValueError when it is too large, or does not come to rest near the origin in three tries.
        """
        return cls(obj, *place(obj, seed))

    def model(self, hand: HandSpec, physics: Physics = WORKING) -> mujoco.MjModel:
        """The world of a trial: all things and the hand. The object's free joint is `object`, the wrist's `wrist`."""
        world = make_world(self.object, physics, self.support)
        add_hand(world, hand)
        return world.compile()

    @cached_property
    def _rays(self) -> RayCaster:
        mesh = self.object.mesh.copy().apply_transform(self.T_world_object)
        return RayCaster(mesh, None if self.support is None else self.support.mesh)

    def observe(
        self,
        seed: int = 0,
        camera: Camera | None = None,
        T_world_camera: NDArray[np.float64] | None = None,
        ideal: bool = False,
    ) -> Observation:
        """One depth image, from a given pose or from one drawn as in the grasp set.

        A drawn camera stands at an elevation of 30 to 57 degrees and any azimuth, 0.40 to 0.75 m away, and looks within
        3 cm of the object's centre. ideal: exact depth instead of the sensor's, from exactly this pose.

        Otherwise the camera really stands N(0, 4 mm) beside this pose on each axis, as one whose calibration is off:
        the observation, and so the grasps that come of it, are off against the scene by that much along the table.
        Its height over the table is that in the image, since who looks at a table can fit it.
        An object on a block is told from it by the rays; on real images such a mask must be given. On the table the
        object is segmented as on real images.
        Raises ValueError when the object cannot be seen from there.
        """
        rng = np.random.default_rng(seed)
        camera = camera or Camera()
        if T_world_camera is None:
            pose = _draw_pose(rng, self._center())
        else:
            pose = rotation.check_pose(T_world_camera, "T_world_camera").numpy()
        true = pose.copy()
        if not ideal:
            true[:3, 3] += rng.normal(0, CALIBRATION_ERROR, 3)
        depth, on_object = self._rays.depth(camera, true)
        if on_object.sum() < MIN_PIXELS:
            raise ValueError(f"object {self.object.name} covers {on_object.sum()} pixels, fewer than {MIN_PIXELS}")
        seen: NDArray[np.floating[Any]] = depth
        if not ideal:
            lit = self._rays.lit(depth, camera, true, true[:3, 3] + BASELINE * true[:3, 0])
            seen = read_depth(depth, lit, camera, rng)
        mask = None if self.support is None else on_object
        observation = Observation(seen, camera, pose, true[2], mask)
        self.T_world_camera = observation.T_world_camera
        return observation

    def _center(self) -> NDArray[np.float64]:
        middle: NDArray[np.float64] = self.object.mesh.bounds.mean(0)
        return self.T_world_object[:3, :3] @ middle + self.T_world_object[:3, 3]


def _draw_pose(rng: np.random.Generator, center: NDArray[np.float64]) -> NDArray[np.float64]:
    """A camera pose of the grasp set's distribution (thesis, section 3.5.1), upright."""
    elevation, azimuth = np.deg2rad(rng.uniform(30, 57)), rng.uniform(0, 2 * np.pi)
    gaze = center + rng.uniform(-0.03, 0.03, 3)
    return look_at(gaze, rng.uniform(0.40, 0.75), azimuth, elevation)

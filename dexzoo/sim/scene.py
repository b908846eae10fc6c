"""A scene: one object at rest on the table, and the camera that looks at it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from dexzoo import rotation
from dexzoo.hand import HandSpec
from dexzoo.perception.camera import Camera, look_at
from dexzoo.perception.observation import Observation
from dexzoo.sim.objects import ObjectModel
from dexzoo.sim.placement import place
from dexzoo.sim.rays import RayCaster
from dexzoo.sim.robot import add_hand
from dexzoo.sim.sensor import BASELINE, read_depth
from dexzoo.sim.world import WORKING, Physics, Support, make_world

MIN_PIXELS = 250
CALIBRATION_ERROR = 0.004
"""Standard deviation in meters, on each axis, of where the camera stands from where its observation believes it."""


@dataclass
class Scene:
    """An object that lies still on the table (z = 0 of the world), or on a block that stands on it.

    Attributes:
        object: The object.
        T_world_object: Its pose, (4, 4).
        support: The block that it lies on, or None.
    """

    object: ObjectModel
    T_world_object: NDArray[np.float64]
    support: Support | None = None

    @classmethod
    def place(cls, obj: ObjectModel, seed: int = 0) -> Scene:
        """Drop the object with a random yaw, or tumbled, on the table or on a block, and let it settle.

        `placement` says by category which objects lie on a block or tumble; all others stand as in their own frame.

        Args:
            obj: The object.
            seed: Seed of the yaw or the tumbling.

        Returns:
            The scene.

        Raises:
            ValueError: The object is too large, or does not come to rest near the origin in three tries.
        """
        return cls(obj, *place(obj, seed))

    def model(self, hand: HandSpec, physics: Physics = WORKING) -> mujoco.MjModel:
        """The world of a trial with the hand. The object's free joint is `object`, the wrist's `wrist`.

        Args:
            hand: Tables of the hand.
            physics: How finely it is simulated.
        """
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
        """Take one depth image, from a given pose or from one drawn as in the grasp set; the scene stays as it is.

        A drawn camera stands at an elevation of 30 to 57 degrees and any azimuth, 0.40 to 0.75 m away, and looks within
        3 cm of the object's center. Unless the view is ideal, the camera really stands N(0, 4 mm) beside its pose on
        each axis, as with a calibration that is off: the observation, and the grasps planned on it, are off against the
        scene by that much along the table. The camera's height over the table is right, since the table is seen.
        The rays separate an object from the block that it lies on; on real images such a mask must be given. On the
        table the object is segmented as on real images.

        Args:
            seed: Seed of the pose, its error and the sensor's noise.
            camera: The camera; by default the grasp set's.
            T_world_camera: Pose of the camera, (4, 4); drawn if not given.
            ideal: Exact depth from exactly this pose, instead of the sensor's.

        Returns:
            The observation, in the world frame of the scene.

        Raises:
            ValueError: The object cannot be seen from there.
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
        return Observation(seen, camera, pose, true[2], mask)

    def _center(self) -> NDArray[np.float64]:
        middle: NDArray[np.float64] = self.object.mesh.bounds.mean(0)
        return self.T_world_object[:3, :3] @ middle + self.T_world_object[:3, 3]


def _draw_pose(rng: np.random.Generator, center: NDArray[np.float64]) -> NDArray[np.float64]:
    """A camera pose of the grasp set's distribution (thesis, section 3.5.1), upright."""
    elevation, azimuth = np.deg2rad(rng.uniform(30, 57)), rng.uniform(0, 2 * np.pi)
    gaze = center + rng.uniform(-0.03, 0.03, 3)
    return look_at(gaze, rng.uniform(0.40, 0.75), azimuth, elevation)

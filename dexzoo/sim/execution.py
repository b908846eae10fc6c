"""Execution of grasps in MuJoCo: many copies of one scene that each follow a motion of their own."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from numpy.typing import NDArray

from dexzoo import rotation
from dexzoo.grasp import Grasps
from dexzoo.sim.protocol import LIFT_START, Motion
from dexzoo.sim.robot import to_quaternion
from dexzoo.sim.scene import Scene
from dexzoo.sim.world import Physics

_INSIDE = 0.002  # meters that the hand may overlap the object before it sets out
_AWAY = 10.0  # meters up, out of the way
Ids = NDArray[np.int64]


@dataclass(frozen=True)
class Variation:
    """Properties of the object that differ from trial to trial of one scene.

    Attributes:
        mass: Masses in kilograms, (grasp,).
        friction: Friction coefficients, (grasp,).
    """

    mass: NDArray[np.float64]
    friction: NDArray[np.float64]

    def __getitem__(self, index: Ids) -> Variation:
        return Variation(self.mass[index], self.friction[index])


class Execution:
    """Grasps in execution on copies of one scene; poses are read from the state of the batch.

    Args:
        scene: The scene.
        grasps: Grasps in its world frame.
        model: The scene's model with the hand.
        physics: How finely it is simulated.
        num_threads: Threads; 0 uses all cores.
        variation: Mass and friction of each copy; None leaves the scene's object as it is.
    """

    def __init__(
        self,
        scene: Scene,
        grasps: Grasps,
        model: mujoco.MjModel,
        physics: Physics,
        num_threads: int = 0,
        variation: Variation | None = None,
    ) -> None:
        self.motion = Motion(grasps)
        self.everyone = np.arange(len(grasps))
        self.physics = physics
        self.time = 0.0
        self.batch = Batch(model, len(grasps), num_threads)
        self.qpos, self.qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self.wrist_at, self.object_at = model.joint("wrist").qposadr[0], model.joint("object").qposadr[0]
        self.object_dof, self.object_body = model.joint("object").dofadr[0], model.body("object").id
        self.finger_at = [model.joint(name).qposadr[0] for name in grasps.hand.joint_names]
        self.order = [grasps.hand.joint_names.index(model.actuator(i).name) for i in range(model.nu)]
        self.center, self.radius = scene.object.inertia[0], scene.object.radius
        if variation is not None:
            self._vary(variation, scene)
        self.qpos[:, self.object_at : self.object_at + 3] = scene.T_world_object[:3, 3]
        self.qpos[:, self.object_at + 3 : self.object_at + 7] = to_quaternion(scene.T_world_object[:3, :3])
        wrist, turn, joints = (part[:, 0] for part in self.motion.at(np.zeros(1), self.everyone))
        self.qpos[:, self.wrist_at : self.wrist_at + 7] = np.concatenate((wrist, turn), axis=1)
        self.qpos[:, self.finger_at] = joints

    def _vary(self, variation: Variation, scene: Scene) -> None:
        """Masses and frictions of each copy's own."""
        body = self.object_body
        mass, inertia = self.batch.expand("body_mass"), self.batch.expand("body_inertia")
        inertia[:, body] *= (variation.mass / mass[:, body])[:, None]
        mass[:, body] = variation.mass
        friction = self.batch.expand("geom_friction")
        geoms = np.flatnonzero(self.batch.model.geom_bodyid == body)
        friction[:, geoms] *= (variation.friction / scene.object.friction)[:, None, None]
        self.batch.set_const()

    def advance(self, ids: Ids, until: float) -> None:
        """Follow the motion up to a time; to pass the start of the lift takes two calls, since time steps differ.

        Args:
            ids: Grasps, by their place.
            until: Seconds since the start.
        """
        physics, carries = self.physics, self.time > LIFT_START - 1e-6
        step = physics.carry_timestep if carries else physics.timestep
        times = self.time + step * np.arange(1, round((until - self.time) / step) + 1, dtype=np.float64)
        if not len(times):
            return
        self.batch.expand("opt.timestep")[:] = step
        sweeps = physics.carry_noslip_iterations if carries else physics.noslip_iterations
        self.batch.expand("opt.noslip_iterations")[:] = sweeps
        wrist, turn, angles = self.motion.at(times, ids)
        state = mujoco.mjtState
        spec = state.mjSTATE_CTRL | state.mjSTATE_MOCAP_POS | state.mjSTATE_MOCAP_QUAT
        commands = np.concatenate((angles[..., self.order], wrist, turn), axis=-1)
        self.batch.rollout(len(times), commands, int(spec), record=(), ids=ids)
        self.time = float(times[-1])

    def broken(self, ids: Ids) -> NDArray[np.bool_]:
        """Whether the solver has warned or diverged, (n,).

        Args:
            ids: Grasps, by their place.
        """
        warned = self.batch.warning[ids, :, 1].sum(-1) > 0
        return np.asarray(warned | ~np.isfinite(self.qpos[ids]).all(-1))

    def wrist(self, ids: Ids) -> NDArray[np.float64]:
        """Poses of the wrist, position and quaternion, (n, 7).

        Args:
            ids: Grasps, by their place.
        """
        return np.asarray(self.qpos[ids, self.wrist_at : self.wrist_at + 7])

    def object(self, ids: Ids) -> NDArray[np.float64]:
        """Poses of the object, its center of mass and its quaternion, (n, 7).

        Args:
            ids: Grasps, by their place.
        """
        pose = np.array(self.qpos[ids, self.object_at : self.object_at + 7])
        pose[:, :3] += rotation.rotate(torch.tensor(pose[:, 3:]), torch.tensor(self.center)).numpy()
        return pose

    def in_palm(self, ids: Ids) -> NDArray[np.float64]:
        """Poses of the object in the palm frame, (n, 7).

        Args:
            ids: Grasps, by their place.
        """
        wrist, pose = torch.tensor(self.wrist(ids)), torch.tensor(self.object(ids))
        inverse = rotation.conjugate(wrist[:, 3:])
        offset = rotation.rotate(inverse, pose[:, :3] - wrist[:, :3])
        return torch.cat((offset, rotation.normalize(rotation.multiply(inverse, pose[:, 3:]))), -1).numpy()

    def obstructed(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Whether the commanded path to the grip meets the table or a block, and whether it starts in the object."""
        model, data = self.batch.model, mujoco.MjData(self.batch.model)
        collided, inside = np.zeros(len(self.everyone), bool), np.zeros(len(self.everyone), bool)
        wrist, turn, joints = self.motion.closing()
        for i, key in np.ndindex(wrist.shape[:2]):
            data.qpos[:] = self.qpos[i]
            data.qpos[self.object_at + 2] += _AWAY if key else 0  # on its way the hand may move the object
            data.qpos[self.wrist_at : self.wrist_at + 7] = np.concatenate((wrist[i, key], turn[i, key]))
            data.qpos[self.finger_at] = joints[i, key]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            body, distance = model.geom_bodyid[data.contact.geom], data.contact.dist
            on_object = (body == self.object_body).any(1)
            collided[i] |= bool(((body == 0).any(1) & ~on_object & (distance < 0)).any())
            inside[i] |= bool(((body > 0).all(1) & on_object & (distance < -_INSIDE)).any())
        return collided, inside

    def contact_force(self, ids: Ids) -> NDArray[np.float64]:
        """Sums of the normal forces between hand and object in newtons, (n,).

        Args:
            ids: Grasps, by their place.
        """
        force, wrench = np.zeros(len(ids)), np.zeros(6)
        data = mujoco.MjData(self.batch.model)
        for i, sim in enumerate(ids):
            model = self.batch.get_model(int(sim))
            self.batch.get_data(int(sim), data)
            mujoco.mj_forward(model, data)
            body = model.geom_bodyid[data.contact.geom]
            for contact in np.flatnonzero((body == self.object_body).any(1) & (body > 0).all(1)):
                mujoco.mj_contactForce(model, data, int(contact), wrench)
                force[i] += wrench[0]
        return force

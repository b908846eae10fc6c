"""The trial: a grasp is executed in the simulator, and what becomes of the object is its outcome."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from numpy.typing import NDArray

from dexzoo import rotation
from dexzoo.grasp import Grasps, pose_matrix
from dexzoo.hand import Hand
from dexzoo.sim.motion import END, HOLD, LIFT, LIFT_START, Motion
from dexzoo.sim.robot import to_quaternion
from dexzoo.sim.scene import Scene
from dexzoo.sim.world import REFERENCE, WORKING, Physics

_LOOK = 0.1  # seconds between looks at who has lost the object
_LOST = 0.1  # metres, besides the object's radius, that it may stay behind the hand
_PUSHED = 0.3  # metres, besides these, that it may be off to the side
_FALLING = 0.2  # m/s of the object at the end, when the hand stands still
_INSIDE = 0.002  # metres that the hand may overlap the object before it sets out
_BATCH = 1024  # trials under way at once
Ids = NDArray[np.int64]


@dataclass(frozen=True)
class Outcomes:
    """What became of each grasp; all arrays (num_grasps,).

    success: the object hung in the hand to the end.
    collided: the commanded path to the grip meets the table; such a grasp is not executed.
    starts_inside: the hand would stand in the object before it sets out, where no arm can bring it; not executed.
    unstable: the solver diverged, at the reference setting too. None of these three is a success, nor the failure of a
    grasp that was tried.
    closing_shift, closing_rotation: how far the object's centre of mass moved, in metres, and the object turned, in
    radians, in the world until the lift began; NaN where it had been lost by then.
    shift, rotation: the same in the hand, from the start of the lift to the end; NaN where it was lost.
    lost_at: seconds after the start of the lift; NaN where it was not.
    contact_force: sum of the normal forces between hand and object at the end, in newtons; NaN where it was lost.
    success_rate: share of the trials that held; that of one trial is success.
    """

    success: NDArray[np.bool_]
    collided: NDArray[np.bool_]
    starts_inside: NDArray[np.bool_]
    unstable: NDArray[np.bool_]
    closing_shift: NDArray[np.float32]
    closing_rotation: NDArray[np.float32]
    shift: NDArray[np.float32]
    rotation: NDArray[np.float32]
    lost_at: NDArray[np.float32]
    contact_force: NDArray[np.float32]
    success_rate: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.success)

    @classmethod
    def none(cls, count: int) -> Outcomes:
        """Outcomes of grasps that were not executed."""
        arrays = {}
        for field in fields(cls):
            is_flag = "bool" in str(field.type)
            arrays[field.name] = np.zeros(count, bool) if is_flag else np.full(count, np.nan, np.float32)
        return cls(**arrays | {"success_rate": np.zeros(count, np.float32)})

    @classmethod
    def concatenate(cls, parts: list[Outcomes]) -> Outcomes:
        """All outcomes in order."""
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))

    def __getitem__(self, index: Ids | NDArray[np.bool_] | slice) -> Outcomes:
        return Outcomes(*(getattr(self, field.name)[index] for field in fields(self)))

    def __setitem__(self, index: Ids | NDArray[np.bool_] | slice, values: Outcomes) -> None:
        for field in fields(self):
            getattr(self, field.name)[index] = getattr(values, field.name)


@dataclass(frozen=True)
class Variation:
    """What differs from trial to trial of one scene: mass in kg and friction of the object, each (num_grasps,)."""

    mass: NDArray[np.float64]
    friction: NDArray[np.float64]

    def __getitem__(self, index: Ids) -> Variation:
        return Variation(self.mass[index], self.friction[index])


def run(
    scene: Scene,
    grasps: Grasps,
    hand: Hand,
    num_threads: int = 0,
    physics: Physics = WORKING,
    variation: Variation | None = None,
) -> Outcomes:
    """Execute grasps in the world frame, each from the scene's state at rest, many at once.

    num_threads: 0 uses all cores; the outcomes do not depend on it. variation: None gives all the scene's object as it
    is. A trial that the solver diverges in is repeated at the reference setting.
    """
    outcomes = Outcomes.none(len(grasps))
    outcomes.collided[:] = Motion(grasps, hand).touches_table(hand)
    free = np.flatnonzero(~outcomes.collided)
    model = scene.model(hand.spec, physics)
    with _without_log():
        for chunk in np.array_split(free, -(-len(free) // _BATCH)) if len(free) else []:
            some = None if variation is None else variation[chunk]
            execution = Execution(scene, grasps[chunk], hand, model, physics, num_threads, some)
            outcomes[chunk] = _judge(execution, physics)
    again = np.flatnonzero(outcomes.unstable)
    if len(again) and physics != REFERENCE:
        some = None if variation is None else variation[again]
        outcomes[again] = run(scene, grasps[again], hand, num_threads, REFERENCE, some)
    return outcomes


@contextmanager
def _without_log() -> Iterator[None]:
    """Keep MuJoCo from writing its warnings to MUJOCO_LOG.TXT in the working folder: `unstable` tells of them."""
    before, quiet = mujoco.MjLogConfig.get(), mujoco.MjLogConfig.get()
    quiet.logfile, quiet.logto_console = "", False
    quiet.set()
    try:
        yield
    finally:
        before.set()


class Execution:
    """Grasps under way on copies of one scene; poses are read from the state of the batch."""

    def __init__(
        self,
        scene: Scene,
        grasps: Grasps,
        hand: Hand,
        model: mujoco.MjModel,
        physics: Physics,
        num_threads: int,
        variation: Variation | None = None,
    ) -> None:
        self.motion = Motion(grasps, hand)
        self.physics = physics
        self.time = 0.0
        self.batch = Batch(model, max(len(grasps), 1), num_threads)
        self.qpos, self.qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self.wrist_at, self.object_at = model.joint("wrist").qposadr[0], model.joint("object").qposadr[0]
        self.object_dof, self.object_body = model.joint("object").dofadr[0], model.body("object").id
        self.finger_at = [model.joint(name).qposadr[0] for name in hand.joint_names]
        self.order = [hand.joint_names.index(model.actuator(i).name) for i in range(model.nu)]
        self.center, self.radius = scene.object.inertia[0], scene.object.radius
        if variation is not None:
            self._vary(variation, scene)
        at = self.object_at
        self.qpos[:, at : at + 3] = scene.T_world_object[:3, 3]
        self.qpos[:, at + 3 : at + 7] = to_quaternion(scene.T_world_object[:3, :3])
        self.everyone = np.arange(len(grasps))
        wrist, turn, joints = (part[:, 0] for part in self.motion.at(np.zeros(1), self.everyone))
        at = self.wrist_at
        self.qpos[: len(grasps), at : at + 7] = np.concatenate((wrist, turn), axis=1)
        self.qpos[: len(grasps), self.finger_at] = joints

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
        """Follow the motion up to a time since the start, which must not lie beyond the start of the lift before it."""
        step = self.physics.timestep if self.time < LIFT_START - 1e-6 else self.physics.carry_timestep
        times = self.time + step * np.arange(1, round((until - self.time) / step) + 1)
        if not len(times):
            return
        self.batch.expand("opt.timestep")[:] = step
        wrist, turn, angles = self.motion.at(times, ids)
        state = mujoco.mjtState
        spec = state.mjSTATE_CTRL | state.mjSTATE_MOCAP_POS | state.mjSTATE_MOCAP_QUAT
        commands = np.concatenate((angles[..., self.order], wrist, turn), axis=-1)
        self.batch.rollout(len(times), commands, int(spec), record=(), ids=ids)
        self.time = float(times[-1])

    def broken(self, ids: Ids) -> NDArray[np.bool_]:
        """Whose solver has warned or diverged."""
        warned = self.batch.warning[ids, :, 1].sum(-1) > 0
        return np.asarray(warned | ~np.isfinite(self.qpos[ids]).all(-1))

    def wrist(self, ids: Ids) -> NDArray[np.float64]:
        """(n, 7) poses of the wrist: position and quaternion."""
        return np.asarray(self.qpos[ids, self.wrist_at : self.wrist_at + 7])

    def object(self, ids: Ids) -> NDArray[np.float64]:
        """(n, 7) poses of the object: its centre of mass and its quaternion."""
        pose = self.qpos[ids, self.object_at : self.object_at + 7].copy()
        pose[:, :3] += rotation.rotate(torch.tensor(pose[:, 3:]), torch.tensor(self.center)).numpy()
        return pose

    def in_palm(self, ids: Ids) -> NDArray[np.float64]:
        """(n, 7) poses of the object in the palm frame."""
        wrist, pose = torch.tensor(self.wrist(ids)), torch.tensor(self.object(ids))
        inverse = rotation.conjugate(wrist[:, 3:])
        offset = rotation.rotate(inverse, pose[:, :3] - wrist[:, :3])
        return torch.cat((offset, rotation.normalize(rotation.multiply(inverse, pose[:, 3:]))), -1).numpy()

    def touch(self, ids: Ids) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Of the contacts between hand and object: deepest overlap in m and sum of normal forces in N, each (n,)."""
        overlap, force = np.zeros(len(ids)), np.zeros(len(ids))
        data, wrench = mujoco.MjData(self.batch.model), np.zeros(6)
        for i, sim in enumerate(ids):
            model = self.batch.get_model(int(sim))
            self.batch.get_data(int(sim), data)
            mujoco.mj_forward(model, data)
            bodies = model.geom_bodyid[data.contact.geom]
            for contact in np.flatnonzero((bodies == self.object_body).any(-1) & (bodies > 0).all(-1)):
                mujoco.mj_contactForce(model, data, int(contact), wrench)
                overlap[i] = max(overlap[i], -data.contact.dist[contact])
                force[i] += wrench[0]
        return overlap, force


def _judge(execution: Execution, physics: Physics) -> Outcomes:
    """Execute and watch."""
    everyone = execution.everyone
    out = Outcomes.none(len(everyone))
    out.starts_inside[:] = execution.touch(everyone)[0] > _INSIDE
    alive = everyone[~out.starts_inside]
    rest, gripped = execution.object(everyone), np.zeros((len(everyone), 7))
    wrist_height = np.zeros(len(everyone))
    limit = _LOST + execution.radius
    for look in range(1, round(END / _LOOK) + 1):
        time = look * _LOOK
        execution.advance(alive, time)
        broken = execution.broken(alive)
        out.unstable[alive[broken]] = True
        alive = alive[~broken]
        wrist, pose = execution.wrist(alive), execution.object(alive)
        away = np.linalg.norm(pose[:, :2] - wrist[:, :2], axis=1) > limit + _PUSHED
        if look > round(LIFT_START / _LOOK):
            away |= wrist[:, 2] - wrist_height[alive] - (pose[:, 2] - rest[alive, 2]) > limit
        if physics.stops_early or look == round(END / _LOOK):
            out.lost_at[alive[away]] = time - LIFT_START
            alive = alive[~away]
        if look == round(LIFT_START / _LOOK):
            wrist_height[alive] = execution.wrist(alive)[:, 2]
            gripped[alive] = execution.in_palm(alive)
            _measure(out.closing_shift, out.closing_rotation, alive, execution.object(alive), rest[alive])
        if not len(alive):
            break
    speed = np.linalg.norm(execution.qvel[alive, execution.object_dof : execution.object_dof + 3], axis=1)
    out.lost_at[alive[speed > _FALLING]] = LIFT + HOLD
    alive = alive[speed <= _FALLING]
    out.success[alive] = True
    out.success_rate[alive] = 1
    out.contact_force[alive] = execution.touch(alive)[1]
    _measure(out.shift, out.rotation, alive, execution.in_palm(alive), gripped[alive])
    return out


def _measure(
    shift: NDArray[np.float32], turned: NDArray[np.float32], ids: Ids, now: NDArray[np.float64], then: NDArray[np.float64]
) -> None:
    """Write how far poses (n, 7) have moved and turned."""
    shift[ids] = np.linalg.norm(now[:, :3] - then[:, :3], axis=1)
    turned[ids] = rotation.angle(torch.tensor(now[:, 3:]), torch.tensor(then[:, 3:])).numpy()


class Moment(NamedTuple):
    """What a picture of a trial needs: the hand as a waypoint (28,), and T_world_object."""

    waypoint: torch.Tensor
    T_world_object: NDArray[np.float64]


def replay(scene: Scene, grasp: Grasps, hand: Hand, seconds: list[float]) -> list[Moment]:
    """Execute one grasp, in the world frame, again and tell where all stood at the given times, ascending.

    Times count from the start of the lift; negative ones lie before it.
    """
    execution = Execution(scene, grasp, hand, scene.model(hand.spec), WORKING, 1)
    moments = []
    for second in seconds:
        time = min(max(LIFT_START + second, 0.0), END)
        for until in (min(time, LIFT_START), time):
            execution.advance(execution.everyone, until)
        state = torch.tensor(execution.qpos[0])
        fingers, kind = state[execution.finger_at], grasp.waypoints[0, 0, 27:].double()
        waypoint = torch.cat((torch.tensor(execution.wrist(execution.everyone)[0]), fingers, kind))
        pose = state[execution.object_at : execution.object_at + 7]
        moments.append(Moment(waypoint, pose_matrix(pose[:3], pose[3:]).numpy()))
    return moments

"""The trial: approach, close along the ten waypoints, squeeze, lift one metre, hold for two seconds."""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import pairwise
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from numpy.typing import NDArray

from dexzoo import rotation
from dexzoo.grasp import GRIP, JOINTS, POSITION, PREGRASP, QUATERNION, SQUEEZE, Grasps, pose_matrix
from dexzoo.hand import Hand
from dexzoo.sim.robot import to_quaternion
from dexzoo.sim.scene import Scene
from dexzoo.sim.world import REFERENCE, WORKING, Physics

APPROACH_DISTANCE = 0.05
APPROACH, CLOSE, SQUEEZE_TIME, PAUSE, LIFT, HOLD = 0.2, 0.9, 0.4, 0.1, 2.0, 2.0
"""Seconds: to the pre-grasp, to the grip, to the squeeze, before the lift, up one metre, held there."""
LIFT_HEIGHT = 1.0
_LOOK = 0.1  # seconds between looks at who has lost the object
_LOST = 0.1  # metres, besides the object's radius, that it may stay behind the hand
_FALLING = 0.2  # m/s of the object at the end, when the hand stands still
_BATCH = 256  # trials whose trajectories are in memory at once


@dataclass(frozen=True)
class Outcomes:
    """What became of each grasp; all arrays (num_grasps,).

    success: the object hung in the hand to the end, and the hand did not touch the table on its way to the grip.
    collided: the commanded path to the grip meets the table; such a grasp is not executed.
    unstable: the solver diverged, at the reference setting too; not counted as success.
    shift, rotation: how far the object moved in the hand between the end of the squeeze and the end of the hold, in
    metres and radians; NaN where it was lost. lost_at: seconds after the start of the lift; NaN where it was not.
    success_rate: share of the trials that held; that of one trial is success.
    """

    success: NDArray[np.bool_]
    collided: NDArray[np.bool_]
    unstable: NDArray[np.bool_]
    shift: NDArray[np.float32]
    rotation: NDArray[np.float32]
    lost_at: NDArray[np.float32]
    success_rate: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.success)

    @classmethod
    def concatenate(cls, parts: list[Outcomes]) -> Outcomes:
        """All outcomes in order."""
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))


def run(scene: Scene, grasps: Grasps, hand: Hand, num_threads: int = 0, physics: Physics = WORKING) -> Outcomes:
    """Execute grasps in the world frame, each from the scene's state at rest, many at once.

    num_threads: 0 uses all cores; the outcomes do not depend on it. A trial that the solver diverges in is repeated at
    the reference setting.
    """
    collided = touches_table(grasps, hand)
    free = np.flatnonzero(~collided)
    model = scene.model(hand.spec, physics)
    parts = [
        _run_batch(model, scene, grasps[chunk], hand, num_threads, physics)
        for chunk in np.array_split(free, max(1, -(-len(free) // _BATCH)))
    ]
    outcomes = _scatter(Outcomes.concatenate(parts), free, collided)
    again = np.flatnonzero(outcomes.unstable)
    if len(again) and physics != REFERENCE:
        finer = run(scene, grasps[again], hand, num_threads, REFERENCE)
        for field in fields(Outcomes):
            getattr(outcomes, field.name)[again] = getattr(finer, field.name)
    return outcomes


def touches_table(grasps: Grasps, hand: Hand, steps: int = 4) -> NDArray[np.bool_]:
    """Whether the commanded path from the approach to the grip meets the table (z = 0), by the hand's own geometry."""
    position, quaternion, joints = _path(grasps)
    keys = torch.arange(0, GRIP + 1 + 1e-6, 1 / steps, dtype=torch.float64) + 1  # 0 is the approach
    keys = torch.cat((torch.zeros(1, dtype=torch.float64), keys))
    wrist, turn, angles = _interpolate(position, quaternion, joints, keys)
    links = hand.forward_kinematics(angles)
    table = torch.tensor([0.0, 0, 1, 0], dtype=torch.float64)
    low = hand.clearance(pose_matrix(wrist, turn)[:, :, None] @ links, table).amin((-1, -2))
    return np.asarray((low < 0).numpy())


def trajectory(
    grasps: Grasps, hand: Hand, timestep: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Commands at every simulation step: wrist position, wrist quaternion (wxyz) and joint targets."""
    position, quaternion, joints = _path(grasps)
    durations = [APPROACH] + [CLOSE / GRIP] * GRIP + [SQUEEZE_TIME / (SQUEEZE - GRIP)] * (SQUEEZE - GRIP)
    times = np.concatenate(([0], np.cumsum(durations)))
    end = times[-1] + PAUSE + LIFT + HOLD
    steps = np.arange(1, round(end / timestep) + 1) * timestep
    keys = torch.tensor(np.interp(steps, times, np.arange(len(times))))
    wrist, turn, angles = _interpolate(position, quaternion, joints, keys)
    rise = np.clip((steps - times[-1] - PAUSE) / LIFT, 0, 1)
    wrist[..., 2] += torch.tensor(LIFT_HEIGHT * rise**2 * (3 - 2 * rise))
    return wrist.numpy(), turn.numpy(), hand.clamp(angles).numpy()


def lift_start(timestep: float) -> int:
    """The step at which the lift begins."""
    return round((APPROACH + CLOSE + SQUEEZE_TIME + PAUSE) / timestep)


def _scatter(done: Outcomes, index: NDArray[np.int64], collided: NDArray[np.bool_]) -> Outcomes:
    count = len(collided)

    def flags(values: NDArray[np.bool_]) -> NDArray[np.bool_]:
        out = np.zeros(count, bool)
        out[index] = values
        return out

    def numbers(values: NDArray[np.float32]) -> NDArray[np.float32]:
        out = np.full(count, np.nan, np.float32)
        out[index] = values
        return out

    return Outcomes(
        flags(done.success),
        collided,
        flags(done.unstable),
        numbers(done.shift),
        numbers(done.rotation),
        numbers(done.lost_at),
        flags(done.success).astype(np.float32),
    )


def _path(grasps: Grasps) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The approach and the ten waypoints: the hand comes straight along its palm's normal, then from above."""
    waypoints = grasps.waypoints.detach().double()
    position, quaternion, joints = (waypoints[..., part] for part in (POSITION, QUATERNION, JOINTS))
    back = rotation.rotate(quaternion[:, PREGRASP], position.new_tensor([-APPROACH_DISTANCE, 0, 0]))
    back[:, 2] = back[:, 2].clamp_min(0)
    return (
        torch.cat((position[:, :1] + back[:, None], position), 1),
        torch.cat((quaternion[:, :1], quaternion), 1),
        torch.cat((joints[:, :1], joints), 1),
    )


def _interpolate(
    position: torch.Tensor, quaternion: torch.Tensor, joints: torch.Tensor, keys: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The path at fractional waypoint indices."""
    index = keys.floor().long().clamp_max(position.shape[1] - 2)
    t = keys - index
    wrist = torch.lerp(position[:, index], position[:, index + 1], t[:, None])
    angles = torch.lerp(joints[:, index], joints[:, index + 1], t[:, None])
    turn = rotation.slerp(quaternion[:, index], quaternion[:, index + 1], t.expand(len(position), -1))
    return wrist, turn, angles


class _Execution:
    """Many grasps under way on copies of one scene; poses are read from the state of the batch."""

    def __init__(self, scene: Scene, grasps: Grasps, hand: Hand, model: mujoco.MjModel, num_threads: int) -> None:
        self.wrist, self.turn, self.angles = trajectory(grasps, hand, model.opt.timestep)
        self.num_steps = self.wrist.shape[1]
        self.batch = Batch(model, max(len(grasps), 1), num_threads)
        self.qpos = self.batch.bind("qpos")
        self.qvel = self.batch.bind("qvel")
        self.wrist_at, self.object_at = model.joint("wrist").qposadr[0], model.joint("object").qposadr[0]
        self.object_dof = model.joint("object").dofadr[0]
        self.finger_at = [model.joint(name).qposadr[0] for name in hand.joint_names]
        self.order = [hand.joint_names.index(model.actuator(i).name) for i in range(model.nu)]
        self.center = scene.object.inertia[0]
        at = self.object_at
        self.qpos[:, at : at + 3] = scene.T_world_object[:3, 3]
        self.qpos[:, at + 3 : at + 7] = to_quaternion(scene.T_world_object[:3, :3])
        position, turn, joints = (part[:, 0].numpy() for part in _path(grasps))
        at = self.wrist_at
        self.qpos[: len(grasps), at : at + 7] = np.concatenate((position, turn), axis=1)
        self.qpos[: len(grasps), self.finger_at] = joints

    def advance(self, ids: NDArray[np.int64], begin: int, end: int) -> None:
        """Follow the trajectory from step `begin` to `end`."""
        parts = (self.angles[ids, begin:end][..., self.order], self.wrist[ids, begin:end], self.turn[ids, begin:end])
        state = mujoco.mjtState
        spec = state.mjSTATE_CTRL | state.mjSTATE_MOCAP_POS | state.mjSTATE_MOCAP_QUAT
        self.batch.rollout(end - begin, np.concatenate(parts, axis=-1), int(spec), record=(), ids=ids)

    def broken(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whose solver has warned or diverged."""
        warned = self.batch.warning[ids, :, 1].sum(-1) > 0
        return np.asarray(warned | ~np.isfinite(self.qpos[ids]).all(-1))

    def object_center(self, ids: NDArray[np.int64]) -> NDArray[np.float64]:
        """(n, 3) centres of mass of the object."""
        pose = self.qpos[ids, self.object_at : self.object_at + 7]
        return np.asarray(pose[:, :3] + rotation.rotate(torch.tensor(pose[:, 3:]), torch.tensor(self.center)).numpy())

    def in_palm(self, ids: NDArray[np.int64]) -> NDArray[np.float64]:
        """(n, 7) poses of the object in the palm frame."""
        wrist = torch.tensor(self.qpos[ids, self.wrist_at : self.wrist_at + 7])
        pose = torch.tensor(self.qpos[ids, self.object_at : self.object_at + 7])
        inverse = rotation.conjugate(wrist[:, 3:])
        offset = rotation.rotate(inverse, pose[:, :3] - wrist[:, :3])
        return torch.cat((offset, rotation.normalize(rotation.multiply(inverse, pose[:, 3:]))), -1).numpy()


def _run_batch(
    model: mujoco.MjModel, scene: Scene, grasps: Grasps, hand: Hand, num_threads: int, physics: Physics
) -> Outcomes:
    count = len(grasps)
    run = _Execution(scene, grasps, hand, model, num_threads)
    limit = _LOST + scene.object.radius
    alive = np.arange(count)
    unstable = np.zeros(count, bool)
    lost_at = np.full(count, np.nan, np.float32)
    gripped = np.full((count, 7), np.nan)
    rest_height = run.object_center(np.zeros(1, np.int64))[0, 2]
    lifted = lift_start(physics.timestep)
    stops = sorted({*range(0, run.num_steps, round(_LOOK / physics.timestep)), lifted, run.num_steps})
    for begin, end in pairwise(stops):
        if not len(alive):
            break
        run.advance(alive, begin, end)
        broken = run.broken(alive)
        unstable[alive[broken]] = True
        alive = alive[~broken]
        center = run.object_center(alive)
        away = np.linalg.norm(center[:, :2] - run.wrist[alive, end - 1, :2], axis=1) > limit + 0.3
        if end >= lifted:
            rise = run.wrist[alive, end - 1, 2] - run.wrist[alive, lifted - 1, 2]
            away |= rise - (center[:, 2] - rest_height) > limit
        if physics.stops_early or end == run.num_steps:
            lost_at[alive[away]] = (end - lifted) * physics.timestep
            alive = alive[~away]
        if end == lifted:
            gripped[alive] = run.in_palm(alive)
    speed = np.linalg.norm(run.qvel[alive, run.object_dof : run.object_dof + 3], axis=1)
    lost_at[alive[speed > _FALLING]] = LIFT + HOLD
    alive = alive[speed <= _FALLING]
    success = np.zeros(count, bool)
    shift, turned = np.full(count, np.nan, np.float32), np.full(count, np.nan, np.float32)
    success[alive] = True
    now = run.in_palm(alive)
    shift[alive] = np.linalg.norm(now[:, :3] - gripped[alive, :3], axis=1)
    turned[alive] = rotation.angle(torch.tensor(now[:, 3:]), torch.tensor(gripped[alive, 3:])).numpy()
    return Outcomes(success, np.zeros(count, bool), unstable, shift, turned, lost_at, success.astype(np.float32))


class Moment(NamedTuple):
    """What a picture of a trial needs: the hand as a waypoint (28,), and T_world_object."""

    waypoint: torch.Tensor
    T_world_object: NDArray[np.float64]


def replay(scene: Scene, grasp: Grasps, hand: Hand, seconds: list[float]) -> list[Moment]:
    """Execute one grasp, in the world frame, again and tell where all stood at the given times, ascending.

    Times count from the start of the lift; negative ones lie before it.
    """
    run = _Execution(scene, grasp, hand, scene.model(hand.spec), 1)
    only = np.zeros(1, np.int64)
    moments, begin = [], 0
    for time in seconds:
        end = min(max(lift_start(WORKING.timestep) + round(time / WORKING.timestep), begin + 1), run.num_steps)
        run.advance(only, begin, end)
        begin = end
        state = torch.tensor(run.qpos[0])
        wrist = state[run.wrist_at : run.wrist_at + 7]
        waypoint = torch.cat((wrist, state[run.finger_at], grasp.waypoints[0, 0, 27:].double()))
        pose = state[run.object_at : run.object_at + 7]
        moments.append(Moment(waypoint, pose_matrix(pose[:3], pose[3:]).numpy()))
    return moments

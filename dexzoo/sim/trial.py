"""The trial: approach, close along the ten waypoints, squeeze, lift one metre, hold for two seconds."""

from __future__ import annotations

from dataclasses import dataclass, fields

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from numpy.typing import NDArray

from dexzoo import rotation
from dexzoo.grasp import GRIP, JOINTS, POSITION, PREGRASP, QUATERNION, SQUEEZE, Grasps
from dexzoo.hand import Hand
from dexzoo.sim.scene import TIMESTEP, Scene

APPROACH_DISTANCE = 0.05
APPROACH, CLOSE, SQUEEZE_TIME, PAUSE, LIFT, HOLD = 0.2, 0.9, 0.4, 0.1, 2.0, 2.0
"""Seconds: to the pre-grasp, to the grip, to the squeeze, before the lift, up one metre, held there."""
LIFT_HEIGHT = 1.0
_CHUNK = 25  # steps between looks at who has lost the object
_LOST = 0.1  # metres, besides the object's radius, that it may stay behind the hand
_FALLING = 0.2  # m/s of the object at the end, when the hand stands still
_BATCH = 256  # trials whose trajectories are in memory at once


@dataclass(frozen=True)
class Outcomes:
    """What became of each grasp; all arrays (num_grasps,).

    success: the object hung in the hand to the end, and the hand did not touch the table on its way to the grip.
    collided: the commanded path to the grip meets the table; such a grasp is not executed.
    unstable: the solver diverged; not counted as success.
    shift, rotation: how far the object moved in the hand between the end of the squeeze and the end of the hold, in
    metres and radians; NaN where it was lost. lost_at: seconds after the start of the lift; NaN where it was not.
    """

    success: NDArray[np.bool_]
    collided: NDArray[np.bool_]
    unstable: NDArray[np.bool_]
    shift: NDArray[np.float32]
    rotation: NDArray[np.float32]
    lost_at: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.success)

    @classmethod
    def concatenate(cls, parts: list[Outcomes]) -> Outcomes:
        """All outcomes in order."""
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))


def run(scene: Scene, grasps: Grasps, hand: Hand, num_threads: int = 0) -> Outcomes:
    """Execute grasps in the world frame, each from the scene's state at rest, many at once.

    num_threads: 0 uses all cores; the outcomes do not depend on it.
    """
    collided = touches_table(grasps, hand)
    free = np.flatnonzero(~collided)
    model = scene.model(hand.spec)
    parts = [_run_batch(model, scene, grasps[chunk], hand, num_threads) for chunk in np.array_split(free, _parts(free))]
    return _scatter(Outcomes.concatenate(parts), free, collided)


def touches_table(grasps: Grasps, hand: Hand, steps: int = 4) -> NDArray[np.bool_]:
    """Whether the commanded path from the approach to the grip meets the table (z = 0), by the hand's own geometry."""
    position, quaternion, joints = _path(grasps)
    keys = torch.arange(0, GRIP + 1 + 1e-6, 1 / steps, dtype=torch.float64) + 1  # 0 is the approach
    keys = torch.cat((torch.zeros(1, dtype=torch.float64), keys))
    wrist, turn, angles = _interpolate(position, quaternion, joints, keys)
    links = hand.forward_kinematics(angles)
    poses = torch.eye(4, dtype=torch.float64).repeat(*wrist.shape[:2], 1, 1)
    poses[..., :3, :3], poses[..., :3, 3] = rotation.to_matrix(turn), wrist
    table = torch.tensor([0.0, 0, 1, 0], dtype=torch.float64)
    low = hand.clearance(poses[:, :, None] @ links, table).amin((-1, -2))
    return np.asarray((low < 0).numpy())


def trajectory(grasps: Grasps, hand: Hand) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Commands at every simulation step: wrist position, wrist quaternion (wxyz) and joint targets."""
    position, quaternion, joints = _path(grasps)
    durations = [APPROACH] + [CLOSE / GRIP] * GRIP + [SQUEEZE_TIME / (SQUEEZE - GRIP)] * (SQUEEZE - GRIP)
    times = np.concatenate(([0], np.cumsum(durations)))
    end = times[-1] + PAUSE + LIFT + HOLD
    steps = np.arange(1, round(end / TIMESTEP) + 1) * TIMESTEP
    keys = torch.tensor(np.interp(steps, times, np.arange(len(times))))
    wrist, turn, angles = _interpolate(position, quaternion, joints, keys)
    rise = np.clip((steps - times[-1] - PAUSE) / LIFT, 0, 1)
    wrist[..., 2] += torch.tensor(LIFT_HEIGHT * rise**2 * (3 - 2 * rise))
    limited = torch.minimum(torch.maximum(angles, hand.lower.double()), hand.upper.double())
    return wrist.numpy(), turn.numpy(), limited.numpy()


def lift_start() -> int:
    """The step at which the lift begins."""
    return round((APPROACH + CLOSE + SQUEEZE_TIME + PAUSE) / TIMESTEP)


def _parts(free: NDArray[np.int64]) -> int:
    return max(1, -(-len(free) // _BATCH))


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


def _run_batch(model: mujoco.MjModel, scene: Scene, grasps: Grasps, hand: Hand, num_threads: int) -> Outcomes:
    count = len(grasps)
    wrist, turn, angles = trajectory(grasps, hand)
    batch = Batch(model, max(count, 1), num_threads)
    start = initial_state(model, scene, hand)
    qpos = batch.bind("qpos")
    qpos[:] = start
    wrist_at = model.joint("wrist").qposadr[0]
    finger_at = [model.joint(name).qposadr[0] for name in hand.joint_names]
    first = _path(grasps)
    qpos[:count, wrist_at : wrist_at + 3] = first[0][:, 0].numpy()
    qpos[:count, wrist_at + 3 : wrist_at + 7] = first[1][:, 0].numpy()
    qpos[:count, finger_at] = first[2][:, 0].numpy()

    order = [hand.joint_names.index(model.actuator(i).name) for i in range(model.nu)]
    spec = mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_MOCAP_POS | mujoco.mjtState.mjSTATE_MOCAP_QUAT
    object_at = model.joint("object").qposadr[0]
    center = scene.object.inertia[0]
    limit = _LOST + scene.object.radius

    def object_center(ids: NDArray[np.int64]) -> NDArray[np.float64]:
        return qpos[ids, object_at : object_at + 3] + _turn(qpos[ids, object_at + 3 : object_at + 7], center)

    alive = np.arange(count)
    unstable = np.zeros(count, bool)
    lost_at = np.full(count, np.nan, np.float32)
    grip_pose = np.full((count, 7), np.nan)
    lifted = lift_start()
    rest_height = float(object_center(np.zeros(1, np.int64))[0, 2]) if count else 0.0
    steps = wrist.shape[1]
    stops = sorted({*range(0, steps, _CHUNK), lifted, steps})
    for begin, end in zip(stops[:-1], stops[1:], strict=True):
        if not len(alive):
            break
        control = np.concatenate(
            (angles[alive, begin:end][..., order], wrist[alive, begin:end], turn[alive, begin:end]), axis=-1
        )
        batch.rollout(end - begin, control, int(spec), record=(), ids=alive)
        broken = (batch.warning[alive, :, 1].sum(-1) > 0) | ~np.isfinite(qpos[alive]).all(-1)
        unstable[alive[broken]] = True
        alive = alive[~broken]
        height = object_center(alive)
        away = np.linalg.norm(height[:, :2] - wrist[alive, end - 1, :2], axis=1) > limit + 0.3
        if end >= lifted:
            rise = wrist[alive, end - 1, 2] - wrist[alive, lifted - 1, 2]
            away |= rise - (height[:, 2] - rest_height) > limit
        lost_at[alive[away]] = (end - lifted) * TIMESTEP
        alive = alive[~away]
        if end == lifted:
            grip_pose[alive] = _relative(qpos[alive], wrist_at, object_at)
    velocity_at = model.joint("object").dofadr[0]
    falling = np.linalg.norm(batch.bind("qvel")[alive, velocity_at : velocity_at + 3], axis=1) > _FALLING
    lost_at[alive[falling]] = LIFT + HOLD
    alive = alive[~falling]
    success = np.zeros(count, bool)
    shift, turned = np.full(count, np.nan, np.float32), np.full(count, np.nan, np.float32)
    success[alive] = True
    now = _relative(qpos[alive], wrist_at, object_at)
    shift[alive] = np.linalg.norm(now[:, :3] - grip_pose[alive, :3], axis=1)
    turned[alive] = rotation.angle(torch.tensor(now[:, 3:]), torch.tensor(grip_pose[alive, 3:])).numpy()
    return Outcomes(success, np.zeros(count, bool), unstable, shift, turned, lost_at)


def initial_state(model: mujoco.MjModel, scene: Scene, hand: Hand) -> NDArray[np.float64]:
    """qpos with the object at rest in the scene."""
    qpos = model.qpos0.copy()
    at = model.joint("object").qposadr[0]
    qpos[at : at + 3] = scene.T_world_object[:3, 3]
    mujoco.mju_mat2Quat(qpos[at + 3 : at + 7], scene.T_world_object[:3, :3].ravel())
    return qpos


def _turn(quaternion: NDArray[np.float64], vector: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(rotation.rotate(torch.tensor(quaternion), torch.tensor(vector)).numpy())


def _relative(qpos: NDArray[np.float64], wrist_at: int, object_at: int) -> NDArray[np.float64]:
    """(n, 7) pose of the object in the palm frame."""
    inverse = rotation.conjugate(torch.tensor(qpos[:, wrist_at + 3 : wrist_at + 7]))
    offset = torch.tensor(qpos[:, object_at : object_at + 3] - qpos[:, wrist_at : wrist_at + 3])
    turn = rotation.multiply(inverse, torch.tensor(qpos[:, object_at + 3 : object_at + 7]))
    return torch.cat((rotation.rotate(inverse, offset), rotation.normalize(turn)), -1).numpy()

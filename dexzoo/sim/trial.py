"""The trial: a grasp is executed in the simulator, and what becomes of the object is its outcome."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray

from dexzoo import rotation
from dexzoo.grasp import Grasps, pose_matrix
from dexzoo.hand import Hand
from dexzoo.sim.execution import Execution, Ids, Variation
from dexzoo.sim.motion import END, HOLD, LIFT, LIFT_START
from dexzoo.sim.scene import Scene
from dexzoo.sim.world import REFERENCE, WORKING, Physics

_LOOK = 0.1  # seconds between looks at who has lost the object
_LOST = 0.1  # metres, besides the object's radius, that it may stay behind the hand
_PUSHED = 0.3  # metres, besides these, that it may be off to the side
_FALLING = 0.2  # m/s of the object at the end, when the hand stands still
_BATCH = 1024  # trials under way at once


@dataclass(frozen=True)
class Outcomes:
    """What became of each grasp; all arrays (num_grasps,).

    success: the object hung in the hand to the end.
    collided: the commanded path to the grip meets the table, or a block that stands on it; not executed.
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

        def flag() -> NDArray[np.bool_]:
            return np.zeros(count, bool)

        def number(value: float = np.nan) -> NDArray[np.float32]:
            return np.full(count, value, np.float32)

        flags = flag(), flag(), flag(), flag()
        return cls(*flags, number(), number(), number(), number(), number(), number(), number(0.0))

    @classmethod
    def concatenate(cls, parts: list[Outcomes]) -> Outcomes:
        """All outcomes in order."""
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))

    def __getitem__(self, index: Ids | NDArray[np.bool_] | slice) -> Outcomes:
        return Outcomes(*(getattr(self, field.name)[index] for field in fields(self)))

    def __setitem__(self, index: Ids | NDArray[np.bool_] | slice, values: Outcomes) -> None:
        for field in fields(self):
            getattr(self, field.name)[index] = getattr(values, field.name)


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
    if not len(grasps):
        return Outcomes.none(0)
    model = scene.model(hand.spec, physics)
    parts = []
    with _without_log():
        for chunk in np.array_split(np.arange(len(grasps)), -(-len(grasps) // _BATCH)):
            some = None if variation is None else variation[chunk]
            parts.append(_judge(Execution(scene, grasps[chunk], hand, model, physics, num_threads, some)))
    outcomes = Outcomes.concatenate(parts)
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


def _judge(execution: Execution) -> Outcomes:
    """Execute, look every tenth of a second what has become of each object, and go on with those that may hold."""
    everyone, stops_early = execution.everyone, execution.physics.stops_early
    out = Outcomes.none(len(everyone))
    out.collided[:], out.starts_inside[:] = execution.obstructed()
    alive = everyone[~out.collided & ~out.starts_inside]
    rest, gripped = execution.object(everyone), np.zeros((len(everyone), 7))
    wrist_height = np.zeros(len(everyone))
    limit = _LOST + execution.radius
    for look in range(1, round(END / _LOOK) + 1):
        if not len(alive):
            break
        time = look * _LOOK
        execution.advance(alive, time)
        broken = execution.broken(alive)
        out.unstable[alive[broken]] = True
        alive = alive[~broken]
        wrist, pose = execution.wrist(alive), execution.object(alive)
        away = np.linalg.norm(pose[:, :2] - wrist[:, :2], axis=1) > limit + _PUSHED
        if look > round(LIFT_START / _LOOK):
            away |= wrist[:, 2] - wrist_height[alive] - (pose[:, 2] - rest[alive, 2]) > limit
        if stops_early or look == round(END / _LOOK):
            out.lost_at[alive[away]] = time - LIFT_START
            alive = alive[~away]
        if look == round(LIFT_START / _LOOK):
            wrist_height[alive] = execution.wrist(alive)[:, 2]
            gripped[alive] = execution.in_palm(alive)
            _measure(out.closing_shift, out.closing_rotation, alive, execution.object(alive), rest[alive])
    speed = np.linalg.norm(execution.qvel[alive, execution.object_dof : execution.object_dof + 3], axis=1)
    out.lost_at[alive[speed > _FALLING]] = LIFT + HOLD
    alive = alive[speed <= _FALLING]
    out.success[alive] = True
    out.success_rate[alive] = 1
    out.contact_force[alive] = execution.contact_force(alive)
    _measure(out.shift, out.rotation, alive, execution.in_palm(alive), gripped[alive])
    return out


def _measure(
    shift: NDArray[np.float32],
    turned: NDArray[np.float32],
    ids: Ids,
    now: NDArray[np.float64],
    then: NDArray[np.float64],
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

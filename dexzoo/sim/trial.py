"""The trial: a grasp is executed in the simulator, and the object's motion decides its outcome."""

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
from dexzoo.grasp import Grasps
from dexzoo.rotation import pose_matrix
from dexzoo.sim.execution import Execution, Ids, Variation
from dexzoo.sim.protocol import END, HOLD_TIME, LIFT_START, LIFT_TIME
from dexzoo.sim.scene import Scene
from dexzoo.sim.world import REFERENCE, WORKING, Physics

_LOOK = 0.1  # seconds between looks at who has lost the object
_LOST = 0.1  # meters, besides the object's radius, that it may stay behind the hand
_PUSHED = 0.3  # meters, besides these, that it may be off to the side
_FALLING = 0.2  # m/s of the object at the end, when the hand stands still
_BATCH = 1024  # trials under way at once


@dataclass(frozen=True)
class Outcomes:
    """Outcome of each grasp; all arrays are (grasp,).

    A grasp that collided, started inside or is unstable is neither a success nor the failure of a grasp that was tried.

    Attributes:
        success: Whether the object hung in the hand to the end.
        collided: Whether the commanded path to the grip meets the table, or a block that stands on it; not executed.
        starts_inside: Whether the hand would stand in the object before it sets out; not executed.
        unstable: Whether the solver diverged, at the reference setting too.
        closing_shift: Meters that the object's center of mass moved in the world until the lift began; NaN if the
            object had been lost by then.
        closing_rotation: Radians that the object turned in the world until the lift began; NaN as above.
        shift: Meters that its center of mass moved in the hand from the start of the lift to the end; NaN if lost.
        rotation: Radians that it turned in the hand meanwhile; NaN if lost.
        lost_at: Seconds from the start of the lift to the loss; NaN if not lost.
        contact_force: Sum of the normal forces between hand and object at the end in newtons; NaN if lost.
        success_rate: Share of the trials that held; for one trial it is `success`.
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
        """Outcomes of grasps that were not executed.

        Args:
            count: Number of grasps.
        """

        def flag() -> NDArray[np.bool_]:
            return np.zeros(count, bool)

        def number(value: float = np.nan) -> NDArray[np.float32]:
            return np.full(count, value, np.float32)

        flags = flag(), flag(), flag(), flag()
        return cls(*flags, number(), number(), number(), number(), number(), number(), number(0.0))

    @classmethod
    def concatenate(cls, parts: list[Outcomes]) -> Outcomes:
        """All outcomes in order.

        Args:
            parts: Outcomes; at least one part.
        """
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))

    def __getitem__(self, index: Ids | NDArray[np.bool_] | slice) -> Outcomes:
        return Outcomes(*(getattr(self, field.name)[index] for field in fields(self)))

    def __setitem__(self, index: Ids | NDArray[np.bool_] | slice, values: Outcomes) -> None:
        for field in fields(self):
            getattr(self, field.name)[index] = getattr(values, field.name)


def run(
    scene: Scene,
    grasps: Grasps,
    num_threads: int = 0,
    physics: Physics = WORKING,
    variation: Variation | None = None,
) -> Outcomes:
    """Execute grasps, each from the scene's state at rest, many at once.

    A trial in which the solver diverges is repeated at the reference setting.

    Args:
        scene: The scene.
        grasps: Grasps in its world frame.
        num_threads: Threads; 0 uses all cores. The outcomes do not depend on it.
        physics: How finely the trials are simulated.
        variation: Mass and friction of the object for each grasp; None leaves it as it is.

    Returns:
        The outcome of each grasp.
    """
    if not len(grasps):
        return Outcomes.none(0)
    model = scene.model(grasps.hand.spec, physics)
    parts = []
    with _without_log():
        for chunk in np.array_split(np.arange(len(grasps)), -(-len(grasps) // _BATCH)):
            some = None if variation is None else variation[chunk]
            parts.append(_judge(Execution(scene, grasps[chunk], model, physics, num_threads, some)))
    outcomes = Outcomes.concatenate(parts)
    again = np.flatnonzero(outcomes.unstable)
    if len(again) and physics != REFERENCE:
        some = None if variation is None else variation[again]
        outcomes[again] = run(scene, grasps[again], num_threads, REFERENCE, some)
    return outcomes


@contextmanager
def _without_log() -> Iterator[None]:
    """Keep MuJoCo from writing its warnings to MUJOCO_LOG.TXT in the working folder: `unstable` reports them."""
    before, quiet = mujoco.MjLogConfig.get(), mujoco.MjLogConfig.get()
    quiet.logfile, quiet.logto_console = "", False
    quiet.set()
    try:
        yield
    finally:
        before.set()


def _judge(execution: Execution) -> Outcomes:
    """Execute, look at each object every tenth of a second, and go on with the grasps that may hold."""
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
    out.lost_at[alive[speed > _FALLING]] = LIFT_TIME + HOLD_TIME
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
    """The state of a trial at one time, as a picture needs it.

    Attributes:
        wrist: Wrist pose in the world frame, position and quaternion, (7,).
        joints: Joint angles in radians, (joint,).
        T_world_object: Pose of the object, (4, 4).
    """

    wrist: torch.Tensor
    joints: torch.Tensor
    T_world_object: NDArray[np.float64]


def replay(scene: Scene, grasp: Grasps, seconds: list[float]) -> list[Moment]:
    """Execute one grasp again and record the state at some times.

    Args:
        scene: The scene.
        grasp: One grasp in its world frame.
        seconds: Ascending times in seconds from the start of the lift; negative ones lie before it.

    Returns:
        The state at each time.
    """
    execution = Execution(scene, grasp, scene.model(grasp.hand.spec), WORKING, 1)
    moments = []
    for second in seconds:
        time = min(max(LIFT_START + second, 0.0), END)
        for until in (min(time, LIFT_START), time):
            execution.advance(execution.everyone, until)
        state = torch.tensor(execution.qpos[0])
        pose = state[execution.object_at : execution.object_at + 7]
        wrist = torch.tensor(execution.wrist(execution.everyone)[0])
        moments.append(Moment(wrist, state[execution.finger_at], pose_matrix(pose[:3], pose[3:]).numpy()))
    return moments

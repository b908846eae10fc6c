"""The thesis' refinement (chapter 4), a baseline to be compared with: it made grasps worse.

Plain gradient ascent of the log-odds on the numbers of a grasp, those of the wrist and the joints at all ten waypoints,
in the world frame; the wrist is kept in a cube of 1 cm. Every grasp is replaced by the result. Quaternions are made
unit and joints brought within their limits after each step, without which nothing could be executed; steps are taken in
standardized numbers, as the thesis' network had them. Its step size is not known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from dexzoo import rotation
from dexzoo.grasp import NUM_WAYPOINTS, Grasps, Trajectory
from dexzoo.hand import Hand
from dexzoo.models.evaluator import EncodedView, GraspEvaluator
from dexzoo.models.zoo import load
from dexzoo.perception import Camera, Observation, View
from dexzoo.refinement.climb import CHUNK
from dexzoo.refinement.refinement import Refinement, check_gradient, checked, log_odds, replaced

HALF_CUBE = 0.005
"""Meters along each axis that a wrist may move."""
STEP_SIZE = 0.01
POSITION_SPREAD, QUATERNION_SPREAD, JOINT_SPREAD = 0.05, 0.3, 0.3
"""What stands in for the standard deviations of the numbers: meters, quaternion, radians."""


@dataclass(frozen=True)
class Group:
    """One of the thesis' experiments.

    Attributes:
        num_steps: How many steps are taken.
        first: The waypoint from which on the numbers move.
    """

    num_steps: int
    first: int


GROUPS = {"A": Group(2, 0), "B": Group(2, NUM_WAYPOINTS - 3), "C": Group(20, NUM_WAYPOINTS - 3)}
"""The three groups of Tables 4.1 to 4.6."""


def ascend(
    grasps: Grasps,
    observation: NDArray[np.floating] | Observation | View,
    evaluator: str | GraspEvaluator = "em_fk",
    camera: Camera | None = None,
    group: str = "A",
    step_size: float = STEP_SIZE,
) -> Refinement:
    """Refine as the thesis did.

    Args:
        grasps: As in `dexzoo.refine`.
        observation: As there.
        evaluator: As there.
        camera: As there.
        group: A name in `GROUPS`.
        step_size: Standardized numbers by which a slope of 1 moves.

    Returns:
        The refined grasps. One whose log-odds or gradient are no finite number on the way has failed, and is at its
        last state that has log-odds.

    Raises:
        ValueError: The group is unknown, the step size is no positive number, or as in `dexzoo.refine`.
    """
    if group not in GROUPS:
        raise ValueError(f"group {group!r} is unknown, use one of {', '.join(GROUPS)}")
    if not 0 < step_size < torch.inf:
        raise ValueError(f"step_size is {step_size}, expected a positive number")
    view = View.of(observation, camera)
    given = checked(grasps, view)
    model = load(evaluator) if isinstance(evaluator, str) else evaluator
    model.check_hand(grasps.hand)
    if not len(given):
        value, flag = torch.zeros(0), torch.zeros(0, dtype=torch.bool)
        return Refinement(grasps, value, value, flag, flag, {})
    encoded = model.prepare(view)
    check_gradient(encoded, given[:1])
    parts = [_ascend(encoded, part, grasps.hand, GROUPS[group], step_size) for part in given.split(CHUNK)]
    after, failed = (torch.cat(values) for values in zip(*parts, strict=True))
    accepted = (after != _numbers(given)).flatten(1).any(1)
    found = _trajectory(after, given.grasp_type)
    first, last = (model.probability(log_odds(encoded, one)) for one in (given, found))
    return Refinement(replaced(grasps, found, accepted), first, last, accepted, failed, {})


def _ascend(
    encoded: EncodedView, given: Trajectory, hand: Hand, group: Group, step_size: float
) -> tuple[Float[Tensor, "grasp waypoint number"], Bool[Tensor, " grasp"]]:
    """Numbers after the last good step, and which grasps failed."""
    start = _numbers(given)
    now, good, failed = start, start, torch.zeros(len(start), dtype=torch.bool)
    joints = [JOINT_SPREAD] * given.joints.shape[-1]
    spread = torch.tensor([POSITION_SPREAD] * 3 + [QUATERNION_SPREAD] * 4 + joints)
    scale = (torch.arange(NUM_WAYPOINTS) >= group.first)[:, None] * spread.square()
    for _ in range(group.num_steps + 1):  # the last only looks at where the steps have led
        free = now.clone().requires_grad_()
        with torch.enable_grad():
            logit = encoded.logit(_trajectory(free, given.grasp_type))
            (gradient,) = torch.autograd.grad(logit.sum(), free)
        known = torch.isfinite(logit.detach())
        failed |= ~(known & torch.isfinite(gradient).flatten(1).all(1))
        good = torch.where(known[:, None, None], now, good)
        moved = now + step_size * scale * gradient
        position = start[..., :3] + (moved[..., :3] - start[..., :3]).clamp(-HALF_CUBE, HALF_CUBE)
        moved = torch.cat((position, rotation.normalize(moved[..., 3:7]), hand.clamp(moved[..., 7:])), -1)
        now = torch.where(failed[:, None, None], good, moved)
    return good, failed


def _numbers(grasps: Trajectory) -> Float[Tensor, "grasp waypoint number"]:
    """Position, quaternion and joints of each waypoint as one row."""
    return torch.cat((grasps.wrist, grasps.joints), -1)


def _trajectory(numbers: Float[Tensor, "grasp waypoint number"], grasp_type: Int[Tensor, " grasp"]) -> Trajectory:
    return Trajectory(numbers[..., :7], numbers[..., 7:], grasp_type)

"""The thesis' refinement (chapter 4), to be compared with: it made grasps worse.

Plain gradient ascent of the log-odds on the 280 numbers of a grasp, the wrist kept in a cube of 1 cm. Every grasp is
replaced by what came of it. Quaternions are made unit and joints brought within their limits after each step, without
which nothing could be executed; steps are taken in standardised numbers, as the thesis' network had them. Its step size
is not known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dexzoo import rotation
from dexzoo.camera import Camera, Observation
from dexzoo.grasp import JOINTS, NUM_WAYPOINTS, POSITION, QUATERNION, TYPE, Grasps
from dexzoo.hand import default_hand
from dexzoo.models.evaluator import GraspEvaluator, PreparedView
from dexzoo.models.zoo import load
from dexzoo.refinement.climb import CHUNK
from dexzoo.refinement.method import Refinement, as_observation, check_gradient, checked_in_world, log_odds, replaced

HALF_CUBE = 0.005
"""Metres along each axis that a wrist may move."""
STEP_SIZE = 0.01
_SPREAD = torch.tensor([0.05] * 3 + [0.3] * 4 + [0.3] * 20 + [0.0])
"""What stands in for the standard deviations of position, quaternion and joints; the grasp type stays."""


@dataclass(frozen=True)
class Group:
    """How many steps are taken, and from which waypoint on the numbers move."""

    num_steps: int
    first: int


GROUPS = {"A": Group(2, 0), "B": Group(2, NUM_WAYPOINTS - 3), "C": Group(20, NUM_WAYPOINTS - 3)}
"""The three groups of Tables 4.1 to 4.6."""


def ascend(
    grasps: Grasps,
    depth: NDArray[np.floating] | Observation,
    evaluator: str | GraspEvaluator = "em_fk",
    camera: Camera | None = None,
    group: str = "A",
    step_size: float = STEP_SIZE,
) -> Refinement:
    """Refine as one of the `GROUPS` was; the arguments are those of `dexzoo.refine`.

    A grasp whose log-odds or gradient are no finite number on the way is at its last state that has log-odds. Raises
    ValueError for a group that there is not, a step size that is no positive number, and what `dexzoo.refine` raises.
    """
    if group not in GROUPS:
        raise ValueError(f"group {group!r} is unknown, use one of {', '.join(GROUPS)}")
    if not 0 < step_size < torch.inf:
        raise ValueError(f"step_size is {step_size}, expected a positive number")
    observation = as_observation(depth, camera)
    world = checked_in_world(grasps, observation)
    model = load(evaluator) if isinstance(evaluator, str) else evaluator
    view = model.prepare(observation)
    if len(world):
        check_gradient(view, world[:1])
    parts = [_ascend(view, part, GROUPS[group], step_size) for part in world.split(CHUNK)]
    after, failed = (torch.cat(values) for values in zip(*parts, strict=True))
    accepted = (after != world).flatten(1).any(1)
    before, then = (model.probability(log_odds(view, way)) for way in (world, after))
    return Refinement(replaced(grasps, after, accepted, observation), before, then, accepted, failed, {})


def _ascend(view: PreparedView, start: Tensor, group: Group, step_size: float) -> tuple[Tensor, Tensor]:
    """Waypoints (grasp, 10, 28) after the last good step, and which grasps failed."""
    hand = default_hand()
    now, good, failed = start, start, torch.zeros(len(start), dtype=torch.bool)
    scale = (torch.arange(NUM_WAYPOINTS) >= group.first)[:, None] * _SPREAD.square()
    for _ in range(group.num_steps + 1):  # the last only looks at where the steps have led
        free = now.clone().requires_grad_()
        with torch.enable_grad():
            logit = view.logit(free)
            (gradient,) = torch.autograd.grad(logit.sum(), free)
        known = torch.isfinite(logit.detach())
        failed |= ~(known & torch.isfinite(gradient).flatten(1).all(1))
        good = torch.where(known[:, None, None], now, good)
        moved = now + step_size * scale * gradient
        position = start[..., POSITION] + (moved[..., POSITION] - start[..., POSITION]).clamp(-HALF_CUBE, HALF_CUBE)
        quaternion = rotation.normalize(moved[..., QUATERNION])
        moved = torch.cat((position, quaternion, hand.clamp(moved[..., JOINTS]), start[..., TYPE:]), -1)
        now = torch.where(failed[:, None, None], good, moved)
    return good, failed

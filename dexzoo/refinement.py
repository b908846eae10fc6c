"""Improve grasps by gradient through evaluator and hand.

Three sets of variables:
- "grip": the wrist (6 numbers in the tangent space of SE(3) at the grip) and the 15 joint freedoms, each within a trust
  region by construction; all waypoints follow. Table, cloud penetration and joint limits are penalised.
- "waypoints" and "last3": the thesis' ascent (chapter 4) on the numbers of all ten waypoints or the last three, the
  wrist kept in a cube of 1 cm, no penalty. It is here to be compared with: it made grasps worse.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from dexzoo import rotation
from dexzoo.camera import Camera, Observation
from dexzoo.grasp import (
    GRIP,
    JOINTS,
    NUM_WAYPOINTS,
    POSITION,
    QUATERNION,
    Grasps,
    pose_matrix,
    step_pose,
    transform_waypoints,
)
from dexzoo.hand import Hand, default_hand
from dexzoo.models.evaluator import GraspEvaluator, PreparedView
from dexzoo.models.zoo import load

Variables = Literal["grip", "waypoints", "last3"]

WRIST_REGION, TURN_REGION, JOINT_REGION = 0.005, 0.05, 0.1
"""Trust region of "grip": metres, radians of the wrist, radians of each joint."""
CUBE = 0.005
"""Half side in metres of the cube that the thesis kept the wrist in."""
WEIGHTS = {"table": 300.0, "penetration": 300.0, "limits": 30.0}
"""Log-odds that a metre (a radian for limits) of each penalty costs."""
MIN_RISE = 1e-4
"""Log-odds by which the objective must rise; less may be rounding."""
_PENALISED = (0, 2, 4, GRIP)  # waypoints at which table and penetration are looked at
_NUM_POINTS = 256
_CHUNK = 128
# of position, quaternion and joints: the spread that stands in for the thesis' standardised inputs
_SPREAD = torch.tensor([0.05] * 3 + [0.3] * 4 + [0.3] * 20 + [0.0])


@dataclass(frozen=True)
class Refinement:
    """What became of each grasp; tensors (num_grasps,).

    grasps: the refined grasp where accepted, else the one given; same order and frame as given. The log-likelihood
    stays that of the grasp that was proposed.
    score_before, score_after: probability of success of the given and of the returned grasps.
    accepted: whether the objective rose: for "grip" the log-odds less weighted penalties, else the log-odds.
    penalties: of the returned grasps: "table", deepest metres below the table; "penetration", deepest metres of an
    observed point in a link before the squeeze; "limits", radians beyond the joint limits.
    """

    grasps: Grasps
    score_before: Tensor
    score_after: Tensor
    accepted: Tensor
    penalties: dict[str, Tensor]


def refine(
    grasps: Grasps,
    depth: NDArray[np.floating] | Observation,
    evaluator: str | GraspEvaluator = "em2",
    camera: Camera | None = None,
    variables: Variables = "grip",
    num_steps: int = 20,
    learning_rate: float = 0.2,
    on_step: Callable[[int, Tensor], None] | None = None,
) -> Refinement:
    """Improve grasps on one depth image.

    grasps: in the frame of the depth image's camera, or of its world. depth: (height, width) metres with its camera, or
    an Observation. evaluator: a model, or what `dexzoo.load` takes. learning_rate: step of Adam within the trust region
    ("grip"), or of the ascent in standardised inputs (the others). on_step: called with the step and the objective
    (num_grasps,) of the grasps in work.
    A grasp whose objective becomes NaN or does not rise is returned as it was given.
    Raises ValueError for arguments that do not fit together or joints outside their limits.
    """
    if variables not in ("grip", "waypoints", "last3"):
        raise ValueError(f'variables {variables!r} is unknown, use "grip", "waypoints" or "last3"')
    if num_steps < 0 or learning_rate <= 0:
        raise ValueError(f"refine needs num_steps >= 0 and learning_rate > 0, got {num_steps} and {learning_rate}")
    observation = _observation(depth, camera)
    hand = default_hand()
    hand.check(grasps.joints)
    model = load(evaluator) if isinstance(evaluator, str) else evaluator
    world = grasps.to_frame("world", observation.T_world_camera)
    objective = Objective(model.eval().prepare(observation), hand, _sample(observation.points_world))
    parts = []
    for chunk in world.waypoints.detach().split(_CHUNK):
        if variables == "grip":
            parts.append(_ascend_grip(chunk, objective, hand, num_steps, learning_rate, on_step))
        else:
            first = 0 if variables == "waypoints" else NUM_WAYPOINTS - 3
            parts.append(_ascend_waypoints(chunk, objective, hand, num_steps, learning_rate, first, on_step))
    proposed = torch.cat(parts)
    before, value_before, penalties_before = objective.judge(world.waypoints)
    after, value_after, penalties_after = objective.judge(proposed)
    rise = value_after - value_before if variables == "grip" else after - before
    accepted = (rise > MIN_RISE) & torch.isfinite(proposed).flatten(1).all(1)
    chosen = torch.where(accepted[:, None, None], proposed, world.waypoints)
    refined = Grasps(chosen, "world").to_frame(grasps.frame, observation.T_world_camera).waypoints
    # what is not accepted is handed back itself, not by way of the world frame and its rounding
    refined = torch.where(accepted[:, None, None], refined, grasps.waypoints.detach())
    return Refinement(
        Grasps(refined, grasps.frame, grasps.log_likelihood),
        model.probability(before),
        model.probability(torch.where(accepted, after, before)),
        accepted,
        {name: torch.where(accepted, penalties_after[name], penalties_before[name]) for name in WEIGHTS},
    )


class Objective:
    """Log-odds of success less weighted penalties, of waypoints in the world frame; differentiable."""

    def __init__(self, view: PreparedView, hand: Hand, points: Float[Tensor, "point 3"]) -> None:
        self.view, self.hand, self.points = view, hand, points

    def __call__(self, waypoints: Float[Tensor, "grasp 10 28"]) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """Log-odds, objective and penalties, each (num_grasps,)."""
        logit = self.view.logit(waypoints)
        penalties = self.penalties(waypoints)
        return logit, logit - sum(WEIGHTS[name] * value for name, value in penalties.items()), penalties

    @torch.no_grad()
    def judge(self, waypoints: Float[Tensor, "grasp 10 28"]) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """The same without gradients, piece by piece, so that memory is bounded."""
        parts = [self(chunk) for chunk in waypoints.split(_CHUNK)]
        penalties = {name: torch.cat([part[2][name] for part in parts]) for name in WEIGHTS}
        return torch.cat([part[0] for part in parts]), torch.cat([part[1] for part in parts]), penalties

    def penalties(self, waypoints: Float[Tensor, "grasp 10 28"]) -> dict[str, Float[Tensor, " grasp"]]:
        """Deepest reach below the table and into the observed cloud before the squeeze; excess over joint limits."""
        way = waypoints[:, _PENALISED]
        wrist = pose_matrix(way[..., POSITION], way[..., QUATERNION])
        links = wrist[:, :, None] @ self.hand.forward_kinematics(way[..., JOINTS])
        table = self.hand.clearance(links, links.new_tensor([0.0, 0, 1, 0]))
        cloud = self.hand.signed_distance(links, self.points)
        joints = waypoints[..., JOINTS]
        excess = (joints - self.hand.upper).clamp_min(0) + (self.hand.lower - joints).clamp_min(0)
        return {
            "table": (-table).clamp_min(0).amax((-1, -2)),
            "penetration": (-cloud).clamp_min(0).amax((-1, -2, -3)),
            "limits": excess.amax((-1, -2)),
        }


def move(waypoints: Tensor, wrist: Float[Tensor, "grasp 6"], freedoms: Float[Tensor, "grasp 15"], hand: Hand) -> Tensor:
    """Waypoints with the grip's wrist moved and its joints changed; differentiable.

    wrist: translation in metres and rotation vector in radians, in the frame of the grip's palm; the whole path is
    carried along rigidly. freedoms: change of the free joints at the grip; none at the pre-grasp, growing linearly to
    the grip, the same from there to the squeeze. Joints stay within their limits.
    """
    T = pose_matrix(waypoints[:, GRIP, POSITION], waypoints[:, GRIP, QUATERNION])
    carried = transform_waypoints(step_pose(T, wrist) @ torch.linalg.inv(T), waypoints)
    share = torch.linspace(0, NUM_WAYPOINTS - 1, NUM_WAYPOINTS).div(GRIP).clamp_max(1)
    free = hand.reduce(waypoints[..., JOINTS]) + share[:, None] * freedoms[:, None]
    joints = hand.expand(hand.clamp(free))
    return torch.cat((carried[..., :7], joints, waypoints[..., 27:]), dim=-1)


def _observation(depth: NDArray[np.floating] | Observation, camera: Camera | None) -> Observation:
    if isinstance(depth, Observation):
        if camera is not None:
            raise ValueError("give a camera with a depth array only; an Observation has its own")
        return depth
    if camera is None:
        raise ValueError("a depth array needs its camera: refine(grasps, depth, camera=camera)")
    return Observation(depth, camera)


def _sample(points: NDArray[np.float32]) -> Tensor:
    """A fixed even choice of the observed points."""
    step = max(1, len(points) // _NUM_POINTS)
    return torch.from_numpy(points[::step][:_NUM_POINTS].copy())


def _ascend_grip(
    start: Tensor,
    objective: Objective,
    hand: Hand,
    num_steps: int,
    learning_rate: float,
    on_step: Callable[[int, Tensor], None] | None,
) -> Tensor:
    """Adam on what tanh maps into the trust region; returns the best state of each grasp."""
    region = torch.tensor([WRIST_REGION] * 3 + [TURN_REGION] * 3 + [JOINT_REGION] * len(hand.freedoms))
    free = torch.zeros(len(start), len(region), requires_grad=True)
    optimiser = torch.optim.Adam([free], lr=learning_rate)
    best, best_value = start.clone(), torch.full((len(start),), -torch.inf)
    for step in range(num_steps + 1):
        change = region * torch.tanh(free)
        waypoints = move(start, change[:, :6], change[:, 6:], hand)
        _, value, _ = objective(waypoints)
        better = value.detach() > best_value  # never true for NaN, so the last good state stays
        best = torch.where(better[:, None, None], waypoints.detach(), best)
        best_value = torch.where(better, value.detach(), best_value)
        if on_step is not None:
            on_step(step, value.detach())
        if step < num_steps:
            (gradient,) = torch.autograd.grad(-value.sum(), free)
            free.grad = gradient.nan_to_num(0.0, 0.0, 0.0)
            optimiser.step()
    return best


def _ascend_waypoints(
    start: Tensor,
    objective: Objective,
    hand: Hand,
    num_steps: int,
    learning_rate: float,
    first: int,
    on_step: Callable[[int, Tensor], None] | None,
) -> Tensor:
    """The thesis' ascent of the log-odds on the numbers of waypoints `first` to 9, projected after each step."""
    waypoints = start.clone()
    mask = (torch.arange(NUM_WAYPOINTS) >= first)[:, None] * _SPREAD**2
    for step in range(num_steps):
        free = waypoints.clone().requires_grad_()
        logit = objective.view.logit(free)
        (gradient,) = torch.autograd.grad(logit.sum(), free)
        waypoints = waypoints + learning_rate * mask * gradient.nan_to_num(0.0, 0.0, 0.0)
        position = start[..., POSITION] + (waypoints[..., POSITION] - start[..., POSITION]).clamp(-CUBE, CUBE)
        quaternion = rotation.normalize(waypoints[..., QUATERNION])
        joints = hand.clamp(waypoints[..., JOINTS])
        waypoints = torch.cat((position, quaternion, joints, start[..., 27:]), dim=-1)
        if on_step is not None:
            on_step(step, logit.detach())
    return waypoints

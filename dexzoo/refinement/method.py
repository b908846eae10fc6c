"""Refinement: propose by climbing an objective, accept if it rose, and another evaluator, if asked, agrees."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from dexzoo.camera import Camera, Observation
from dexzoo.generators import default_generator
from dexzoo.generators.density import GraspDensity
from dexzoo.generators.generator import MIN_CLEARANCE
from dexzoo.grasp import GRIP, Grasps, transform_waypoints
from dexzoo.hand import default_hand
from dexzoo.models.evaluator import GraspEvaluator, PreparedView
from dexzoo.models.zoo import load
from dexzoo.refinement.climb import CHUNK, OnStep, Settings, Trace, climb
from dexzoo.refinement.objective import Objective, Terms, Weights
from dexzoo.refinement.optimisers import BY_GRADIENT
from dexzoo.refinement.penalties import AROUND, MIDDLE, SHADOW_DEPTHS, Posed
from dexzoo.refinement.variables import Region

NUM_STEPS, STEP_SIZE = 30, 0.2
MIN_RISE = 1e-4
"""Log-odds by which the objective must rise; less may be rounding."""
MAX_LACK = 0.001
"""Metres by which what links lack of their clearance, summed over links and waypoints to the grip, may grow."""
MAX_DISTANCE = 0.1
"""Metres between hand and object at the grip beyond which nothing is grasped: the grasps are in another frame than they
say. The 35,000 grasps of 150 scenes that were looked at, in two views each, stay below 0.04; in the wrong frame, with
the camera 0.4 m away, nine in ten are beyond."""


def default_settings() -> dict[str, Any]:
    """What is set where no argument is given, and the lengths that terms and acceptance go by: for a record."""
    return {
        "region": asdict(Region()),
        "weights": asdict(Weights()),
        "num_steps": NUM_STEPS,
        "step_size": STEP_SIZE,
        "clearance": {"table": MIN_CLEARANCE, "around": AROUND, "middle": MIDDLE, "lack": MAX_LACK},
        "shadow": list(SHADOW_DEPTHS),
    }


@dataclass(frozen=True)
class Refinement:
    """What became of each grasp; tensors (num_grasps,).

    grasps: the refined grasp where accepted, else the one given; same order and frame as given. The log-likelihood
    stays that of the grasp that was proposed.
    score_before, score_after: probability of success of the given and of the returned grasps.
    accepted: whether the grasp was replaced. failed: whether the objective was no finite number on the way; such a
    grasp is at its last good state, or as given.
    penalties: of the returned grasps, the terms of `Weights` that had a weight, "prior" and "spread" among them.
    judge_before, judge_after: the judge's probabilities, None without a judge. trace: None unless asked for.
    """

    grasps: Grasps
    score_before: Float[Tensor, " grasp"]
    score_after: Float[Tensor, " grasp"]
    accepted: Bool[Tensor, " grasp"]
    failed: Bool[Tensor, " grasp"]
    penalties: Terms
    judge_before: Float[Tensor, " grasp"] | None = None
    judge_after: Float[Tensor, " grasp"] | None = None
    trace: Trace | None = None


def refine(
    grasps: Grasps,
    depth: NDArray[np.floating] | Observation,
    evaluator: str | GraspEvaluator = "em_fk",
    camera: Camera | None = None,
    *,
    judge: str | GraspEvaluator | None = None,
    margin: float = 0.0,
    optimiser: Literal["adam", "lbfgs", "metropolis", "random"] = "adam",
    num_steps: int = NUM_STEPS,
    step_size: float = STEP_SIZE,
    variables: Literal["grip", "uncoupled", "waypoints"] = "grip",
    region: Region | None = None,
    weights: Weights | None = None,
    density: GraspDensity | None = None,
    seed: int = 0,
    keep_trace: bool = False,
    on_step: OnStep | None = None,
) -> Refinement:
    """Improve grasps on one depth image.

    grasps: in the frame of the depth image's camera, or of its world. depth: (height, width) metres with its camera, or
    an Observation. evaluator: what guides: a model, or what `dexzoo.load` takes.
    judge: another such, which does not guide, but must find the log-odds of a refined grasp, before calibration, higher
    by more than `margin` for it to be accepted. With or without one, the objective must rise, and, where the table has
    a weight, the whole way to the grip must lack at most a millimetre more of its clearance than before.
    optimiser, num_steps, step_size: how many states are evaluated besides the first of each half; a step moves a number
    by about `step_size` of its half of the trust region. The first half of the steps moves the wrist, the second the
    fingers.
    variables: what is moved, see `dexzoo.refinement.variables`. region: how far. weights: what counts how much.
    density: `KopickiGenerator.density` of the view, where it is at hand; it is made if the prior has a weight.
    seed: of the random optimisers. keep_trace: whether all states are handed back. on_step: called with the step, from
    0, and the objective of some 50 of the grasps, such parts in no order, from one thread or another but never from two
    at once; whose it is tells the trace.
    Raises ValueError in one line for arguments that do not fit together, an evaluator without gradients, a judge that
    guides, grasps that cannot be in the frame that they say, and joints outside their limits.
    """
    if math.isnan(margin):
        raise ValueError("margin is nan, expected a number of log-odds")
    settings = Settings(optimiser, variables, region or Region(), num_steps, step_size)
    weights = weights or Weights()
    observation = as_observation(depth, camera)
    world = checked_in_world(grasps, observation)
    model = load(evaluator) if isinstance(evaluator, str) else evaluator
    second = load(judge) if isinstance(judge, str) else judge
    if second is not None:
        check_judge(model, second)
    if not len(grasps):
        trace = Trace(torch.zeros(num_steps + 1, 0, 10, 28), torch.zeros(num_steps + 1, 0)) if keep_trace else None
        return _of_none(grasps, weights, second is not None, trace)
    view = model.prepare(observation)
    if optimiser in BY_GRADIENT:
        check_gradient(view, world[:1])
    if weights.prior and density is None:
        density = default_generator().density(observation)
    objective = Objective(view, observation, default_hand(), weights, density)
    with model.without_dropout():
        found = climb(objective, world, settings, seed, keep_trace, on_step)

    accepted = found.rise > MIN_RISE  # never of NaN
    accepted &= objective.lacks(found.waypoints) < objective.lacks(world) + MAX_LACK
    opinion = None
    if second is not None:
        other = second.prepare(observation)
        opinion = log_odds(other, world), log_odds(other, found.waypoints)
        accepted &= opinion[1] - opinion[0] > margin

    def kept(before: Tensor, after: Tensor) -> Tensor:
        return torch.where(accepted, after, before)

    judged: tuple[Tensor | None, Tensor | None] = None, None
    if second is not None and opinion is not None:
        judged = second.probability(opinion[0]), second.probability(kept(*opinion))
    before, after = found.before["log_odds"], found.after["log_odds"]
    return Refinement(
        replaced(grasps, found.waypoints, accepted, observation),
        model.probability(before),
        model.probability(kept(before, after)),
        accepted,
        found.failed,
        {name: kept(found.before[name], found.after[name]) for name in found.before if name != "log_odds"},
        *judged,
        None if found.trace is None else _trace_in_frame(found.trace, grasps, observation),
    )


def check_judge(evaluator: GraspEvaluator, judge: GraspEvaluator) -> None:
    """ValueError for a judge that is the evaluator which guides, or shares a trained member with it."""
    if judge is evaluator or any(_same_weights(a, b) for a in evaluator.parts for b in judge.parts):
        raise ValueError("the judge is, or shares a member with, what guides, and cannot but agree; give another one")


def _same_weights(a: GraspEvaluator, b: GraspEvaluator) -> bool:
    """Whether all that was trained is the same, whatever the calibration; nothing was in an ensemble itself."""
    mine, theirs = dict(a.named_parameters()), dict(b.named_parameters())
    return (
        bool(mine) and mine.keys() == theirs.keys() and all(torch.equal(mine[k].cpu(), theirs[k].cpu()) for k in mine)
    )


def as_observation(depth: NDArray[np.floating] | Observation, camera: Camera | None) -> Observation:
    """The view that a depth array or an Observation is. ValueError unless the camera is given with an array only."""
    if isinstance(depth, Observation):
        if camera is not None:
            raise ValueError("give a camera with a depth array only; an Observation has its own")
        return depth
    if camera is None:
        raise ValueError("a depth array needs its camera: refine(grasps, depth, camera=camera)")
    return Observation(depth, camera)


def checked_in_world(grasps: Grasps, observation: Observation) -> Float[Tensor, "grasp 10 28"]:
    """Waypoints in the world frame, float32. ValueError for joints beyond their limits or hands far from the object."""
    hand = default_hand()
    hand.check(grasps.joints)
    world = grasps.to_frame("world", observation.T_world_camera).waypoints.detach().float().cpu()
    points = torch.from_numpy(observation.points_world[:: len(observation.points_world) // 500 + 1].copy())
    far = torch.cat([Posed(hand, part, (GRIP,)).closest(points).amin((-1, -2)) for part in world.split(CHUNK)])
    if len(far) and far.max() > MAX_DISTANCE:
        row = int(far.argmax())
        raise ValueError(
            f"the hand of grasp {row} is {float(far[row]):.2f} m from the object at the grip, out of reach; are the "
            f"grasps of this view, and in the {grasps.frame} frame as they say?"
        )
    return world


def replaced(grasps: Grasps, world: Tensor, accepted: Tensor, observation: Observation) -> Grasps:
    """The grasps, those accepted replaced by waypoints in the world frame, the others the same to the bit."""
    waypoints = grasps.waypoints.detach().clone()
    new = Grasps(world[accepted], "world").to_frame(grasps.frame, observation.T_world_camera)
    waypoints[accepted] = new.waypoints.to(waypoints)
    return Grasps(waypoints, grasps.frame, grasps.log_likelihood)


@torch.no_grad()
def log_odds(view: PreparedView, waypoints: Float[Tensor, "grasp 10 28"]) -> Float[Tensor, " grasp"]:
    """Log-odds of waypoints in the world frame, a chunk at a time."""
    return torch.cat([view.logit(part) for part in waypoints.split(CHUNK)])


def check_gradient(view: PreparedView, waypoints: Float[Tensor, "grasp 10 28"]) -> None:
    """ValueError for an evaluator whose log-odds have no gradient in waypoints in the world frame."""
    free = waypoints.clone().requires_grad_()
    with torch.enable_grad():
        logit = view.logit(free)
    known = logit.requires_grad and torch.autograd.grad(logit.sum(), free, allow_unused=True)[0] is not None
    if not known:
        raise ValueError(
            f"evaluator {view.evaluator.architecture} has no gradient in the grasps; use the optimiser metropolis or "
            "random of dexzoo.refine, or another evaluator"
        )


def _trace_in_frame(trace: Trace, grasps: Grasps, observation: Observation) -> Trace:
    if grasps.frame == "world":
        return trace
    T = torch.linalg.inv(torch.from_numpy(observation.T_world_camera)).to(trace.waypoints)
    waypoints = transform_waypoints(T, trace.waypoints)
    waypoints[0] = grasps.waypoints.detach()
    return Trace(waypoints, trace.objective)


def _of_none(grasps: Grasps, weights: Weights, judged: bool, trace: Trace | None) -> Refinement:
    value, flag = torch.zeros(0), torch.zeros(0, dtype=torch.bool)
    opinion: tuple[Tensor | None, Tensor | None] = (value, value) if judged else (None, None)
    penalties = {name: value for name, weight in asdict(weights).items() if weight}
    return Refinement(grasps, value, value, flag, flag, penalties, *opinion, trace)

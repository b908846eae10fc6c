"""Refinement: climb an objective, accept a grasp whose objective rose, if no term and no second evaluator objects."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from dexzoo.generators import GraspDensity, make_generator
from dexzoo.generators.generator import MIN_CLEARANCE
from dexzoo.grasp import GRIP, Grasps, Trajectory
from dexzoo.models.evaluator import EncodedView, GraspEvaluator
from dexzoo.models.zoo import load
from dexzoo.perception import Camera, Observation, View
from dexzoo.perception.view import SHADOW_DEPTHS, SUPPORT_SHARE
from dexzoo.refinement.climb import CHUNK, OnStep, Settings, Trace, climb
from dexzoo.refinement.objective import Objective, Values
from dexzoo.refinement.optimizers import BY_GRADIENT
from dexzoo.refinement.posed_hand import PosedHand
from dexzoo.refinement.terms import AROUND, MAX_LACK, WEIGHTS, Term, default_terms
from dexzoo.refinement.trust_region import TrustRegion
from dexzoo.refinement.variables import GripVariables, MakeVariables

NUM_STEPS, STEP_SIZE = 30, 0.2
MIN_RISE = 1e-4
"""Log-odds by which the objective must rise; less may be rounding."""
MAX_DISTANCE = 0.1
"""Meters between hand and object at the grip beyond which nothing is grasped: the grasps are of another view. The
35,000 grasps of 150 scenes that were looked at, in two views each, stay below 0.04; in a wrong frame, with the camera
0.4 m away, nine in ten are beyond."""


def default_settings() -> dict[str, Any]:
    """Default settings of refinement, and the lengths that terms and acceptance use, for a record."""
    return {
        "terms": dict(WEIGHTS),
        "trust_region": asdict(TrustRegion()),
        "num_steps": NUM_STEPS,
        "step_size": STEP_SIZE,
        "clearance": {"table": MIN_CLEARANCE, "around": AROUND, "support": SUPPORT_SHARE, "lack": MAX_LACK},
        "shadow": list(SHADOW_DEPTHS),
    }


@dataclass(frozen=True)
class Refinement:
    """The result of refining some grasps; tensors are (grasp,).

    Attributes:
        grasps: The refined grasp where accepted, else the one given, in the order given. The log-likelihood stays that
            of the grasp that was proposed.
        score_before: Probability of success of the given grasps.
        score_after: Probability of success of the returned grasps.
        accepted: Whether the grasp was replaced.
        failed: Whether the objective was no finite number on the way; such a grasp is at its last good state.
        penalties: Values of the other terms of the objective for the returned grasps, by name.
        judge_before: The judge's probability for the given grasps; None without a judge.
        judge_after: The judge's probability for the returned grasps; None without a judge.
        trace: All states that were tried; None unless asked for.
    """

    grasps: Grasps
    score_before: Float[Tensor, " grasp"]
    score_after: Float[Tensor, " grasp"]
    accepted: Bool[Tensor, " grasp"]
    failed: Bool[Tensor, " grasp"]
    penalties: Values
    judge_before: Float[Tensor, " grasp"] | None = None
    judge_after: Float[Tensor, " grasp"] | None = None
    trace: Trace | None = None


def refine(
    grasps: Grasps,
    observation: NDArray[np.floating] | Observation | View,
    evaluator: str | GraspEvaluator = "em_fk",
    camera: Camera | None = None,
    *,
    prior: GraspDensity | Literal["kopicki"] | None = "kopicki",
    terms: Sequence[Term] | None = None,
    judge: str | GraspEvaluator | None = None,
    margin: float = 0.0,
    optimizer: Literal["adam", "lbfgs", "metropolis", "random"] = "adam",
    num_steps: int = NUM_STEPS,
    step_size: float = STEP_SIZE,
    trust_region: TrustRegion | None = None,
    variables: MakeVariables = GripVariables,
    seed: int = 0,
    keep_trace: bool = False,
    on_step: OnStep | None = None,
) -> Refinement:
    """Improve grasps on one depth image.

    The first half of the steps moves the wrist, the second the fingers. The simulator is not asked.

    Args:
        grasps: Grasps in the world frame of the observation.
        observation: An observation or a view; or a depth image (height, width) in meters with its camera.
        evaluator: Predicts success and guides: a model, or its name for `dexzoo.load`.
        camera: Camera of a depth image; nothing else takes one.
        prior: Density of the generator that proposed the grasps, see `GraspGenerator.density`; "kopicki" makes that of
            Kopicki's generator; None does without a prior. Not used if `terms` are given.
        terms: Terms of the objective; by default `default_terms(evaluator, prior)`.
        judge: Another evaluator, which does not guide, but must find a refined grasp better for it to be accepted.
        margin: Log-odds, before calibration, by which the judge must find it better.
        optimizer: How the objective is climbed.
        num_steps: States that are evaluated besides the first of each half.
        step_size: Share of half the trust region by which a step moves a number, about.
        trust_region: How far grasps may move.
        variables: The numbers that are moved.
        seed: Seed of the random optimizers.
        keep_trace: Whether all states are returned.
        on_step: Called with the step, from 0, and the objective of some 50 of the grasps. Such parts come in no order,
            from one thread or another, but never from two at once.

    Returns:
        The refined grasps, their scores, and the values of the terms.

    Raises:
        ValueError: Arguments do not fit together, the evaluator has no gradient or does not know the hand, the judge
            guides, the grasps cannot be of this observation, or joints are outside their limits.
    """
    if math.isnan(margin):
        raise ValueError("margin is nan, expected a number of log-odds")
    if isinstance(prior, str) and prior != "kopicki":
        raise ValueError(f"prior {prior!r} is unknown, use kopicki, a density or None")
    settings = Settings(optimizer, variables, trust_region or TrustRegion(), num_steps, step_size)
    view = View.of(observation, camera)
    given = checked(grasps, view)
    model = load(evaluator) if isinstance(evaluator, str) else evaluator
    second = load(judge) if isinstance(judge, str) else judge
    for one in (model, *([] if second is None else [second])):
        one.check_hand(grasps.hand)
    if second is not None:
        check_judge(model, second)
    if terms is None:
        if isinstance(prior, str):
            prior = make_generator(prior, grasps.hand).density(view)
        terms = default_terms(model, prior)
    objective = Objective(terms, view, grasps.hand)
    if not len(grasps):
        return _of_none(grasps, objective, second is not None, num_steps if keep_trace else None)
    encoded = model.prepare(view)
    if optimizer in BY_GRADIENT:
        check_gradient(encoded, given[:1])
    with model.without_dropout():
        found = climb(objective, given, settings, seed, keep_trace, on_step)

    accepted = (found.rise > MIN_RISE) & objective.accepts(given, found.grasps)  # a rise of NaN is none
    opinion = None
    if second is not None:
        other = second.prepare(view)
        opinion = log_odds(other, given), log_odds(other, found.grasps)
        accepted &= opinion[1] - opinion[0] > margin

    def kept(before: Tensor, after: Tensor) -> Tensor:
        return torch.where(accepted, after, before)

    judged: tuple[Tensor | None, Tensor | None] = None, None
    if second is not None and opinion is not None:
        judged = second.probability(opinion[0]), second.probability(kept(*opinion))
    if "log_odds" in found.before:
        before, after = found.before["log_odds"], found.after["log_odds"]
    else:
        before, after = log_odds(encoded, given), log_odds(encoded, found.grasps)
    return Refinement(
        replaced(grasps, found.grasps, accepted),
        model.probability(before),
        model.probability(kept(before, after)),
        accepted,
        found.failed,
        {name: kept(found.before[name], found.after[name]) for name in found.before if name != "log_odds"},
        *judged,
        found.trace,
    )


def check_judge(evaluator: GraspEvaluator, judge: GraspEvaluator) -> None:
    """Refuse a judge that cannot but agree.

    Args:
        evaluator: The evaluator that guides.
        judge: The judge.

    Raises:
        ValueError: The judge is the evaluator that guides, or shares a trained member with it.
    """
    if judge is evaluator or any(_same_weights(a, b) for a in evaluator.parts for b in judge.parts):
        raise ValueError("the judge is, or shares a member with, what guides, and cannot but agree; give another one")


def _same_weights(a: GraspEvaluator, b: GraspEvaluator) -> bool:
    """Whether all that was trained is the same, whatever the calibration; nothing was in an ensemble itself."""
    mine, theirs = dict(a.named_parameters()), dict(b.named_parameters())
    return (
        bool(mine) and mine.keys() == theirs.keys() and all(torch.equal(mine[k].cpu(), theirs[k].cpu()) for k in mine)
    )


def checked(grasps: Grasps, view: View) -> Trajectory:
    """Check that grasps can be executed and can be of a view.

    Args:
        grasps: Grasps in the world frame.
        view: The view of the object.

    Returns:
        Their motion, float32, on the CPU, without gradient.

    Raises:
        ValueError: A joint is beyond its limits, or a hand is far from the object at the grip.
    """
    grasps.hand.check(grasps.joints)
    given = grasps.trajectory.detach().to("cpu", torch.float32)
    points = view.points[:: len(view.points) // 500 + 1].clone()
    hands = (PosedHand(grasps.hand, part, (GRIP,)) for part in given.split(CHUNK))
    far = torch.cat([hand.closest(points).amin((-1, -2)) for hand in hands])
    if len(far) and far.max() > MAX_DISTANCE:
        row = int(far.argmax())
        raise ValueError(
            f"the hand of grasp {row} is {float(far[row]):.2f} m from the object at the grip, out of reach; "
            "grasps must be in the world frame of the observation that they are for"
        )
    return given


def replaced(grasps: Grasps, found: Trajectory, accepted: Bool[Tensor, " grasp"]) -> Grasps:
    """Grasps with those accepted replaced, the others the same to the bit.

    Args:
        grasps: The given grasps.
        found: Their replacements, row by row.
        accepted: Which are.
    """
    mask = accepted.to(grasps.wrist.device)[:, None, None]
    wrist = torch.where(mask, found.wrist.to(grasps.wrist), grasps.wrist.detach())
    joints = torch.where(mask, found.joints.to(grasps.joints), grasps.joints.detach())
    return replace(grasps, wrist=wrist, joints=joints)


@torch.no_grad()
def log_odds(encoded: EncodedView, grasps: Trajectory) -> Float[Tensor, " grasp"]:
    """Log-odds of grasps, a chunk at a time.

    Args:
        encoded: A view, encoded by an evaluator.
        grasps: Grasps in the world frame.
    """
    return torch.cat([encoded.logit(part) for part in grasps.split(CHUNK)])


def check_gradient(encoded: EncodedView, grasps: Trajectory) -> None:
    """Refuse an evaluator without a gradient in the grasps.

    Args:
        encoded: A view, encoded by the evaluator.
        grasps: One grasp in the world frame.

    Raises:
        ValueError: There is no gradient.
    """
    wrist, joints = (value.clone().requires_grad_() for value in (grasps.wrist, grasps.joints))
    with torch.enable_grad():
        logit = encoded.logit(Trajectory(wrist, joints, grasps.grasp_type))
    known = logit.requires_grad and any(
        slope is not None for slope in torch.autograd.grad(logit.sum(), (wrist, joints), allow_unused=True)
    )
    if not known:
        raise ValueError(
            f"evaluator {encoded.evaluator.architecture} has no gradient in the grasps; use the optimizer metropolis "
            "or random of dexzoo.refine, or another evaluator"
        )


def _of_none(grasps: Grasps, objective: Objective, judged: bool, num_steps: int | None) -> Refinement:
    value, flag = torch.zeros(0), torch.zeros(0, dtype=torch.bool)
    opinion: tuple[Tensor | None, Tensor | None] = (value, value) if judged else (None, None)
    trace = None
    if num_steps is not None:
        trace = Trace(Trajectory.stack([grasps] * (num_steps + 1)), torch.zeros(num_steps + 1, 0))
    penalties = {term.name: value for term in objective.terms if term.name != "log_odds"}
    return Refinement(grasps, value, value, flag, flag, penalties, *opinion, trace)

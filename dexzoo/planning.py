"""From one observation to ranked grasps: generate, score, refine, choose. No simulator is needed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dexzoo.generators import GraspGenerator, make_generator
from dexzoo.grasp import Grasps
from dexzoo.hand import Hand
from dexzoo.models.evaluator import GraspEvaluator
from dexzoo.models.zoo import load
from dexzoo.perception import Observation, View
from dexzoo.refinement.ranking import best_first, check_ranking, rank
from dexzoo.refinement.refinement import check_judge, refine


@dataclass(frozen=True)
class Plan:
    """Ranked grasps of one observation; tensors are (grasp,).

    Attributes:
        grasps: Grasps in the world frame of the observation, best first.
        given: The same grasps before refinement.
        score: Probability of success as generated.
        refined_score: Probability of success after refinement; equal to `score` where a grasp was not refined.
        generator_rank: Place in the generator's own order, 0 the best.
    """

    grasps: Grasps
    given: Grasps
    score: Float[Tensor, " grasp"]
    refined_score: Float[Tensor, " grasp"]
    generator_rank: Int[Tensor, " grasp"]


def generate(
    observation: Observation | View,
    num_grasps: int = 100,
    seed: int = 0,
    generator: str | GraspGenerator = "kopicki",
    hand: str | Path | Hand = "dlr2",
) -> Grasps:
    """Propose grasps.

    Args:
        observation: The view of the object.
        num_grasps: Most grasps to propose.
        seed: The same seed gives the same grasps.
        generator: "kopicki", "heuristic", a folder of demonstrations that Kopicki's learns from, or a generator.
        hand: The hand, or its name in robots/; a given generator has its own.

    Returns:
        Grasps in the world frame of the observation, best first.

    Raises:
        ValueError: Too little of the object is seen, or the generator is unknown.
        RuntimeError: No feasible grasp is found.
    """
    return _generator(generator, hand).generate(observation, num_grasps, seed)


def plan(
    observation: Observation | View,
    evaluator: str | GraspEvaluator = "em_fk",
    num_grasps: int = 100,
    num_refined: int = 0,
    seed: int = 0,
    generator: str | GraspGenerator = "kopicki",
    judge: str | GraspEvaluator | None = None,
    ranking: str = "before",
    hand: str | Path | Hand = "dlr2",
) -> Plan:
    """Generate grasps, rank them by an evaluator and refine the best, which stay ahead of the others.

    Args:
        observation: The view of the object.
        evaluator: Predicts success: a model, or its name for `dexzoo.load`.
        num_grasps: Most grasps to generate.
        num_refined: How many of the best are refined.
        seed: The same seed gives the same plan.
        generator: As in `generate`; its density is the prior of refinement, if it has one.
        judge: A second evaluator that must agree before a grasp is replaced.
        ranking: Order of the refined grasps, a name in `dexzoo.refinement.RANKINGS`. "before" keeps that of the scores
            as generated: ranking by refined scores picks the grasps whose score inflated most (thesis, Table 4.6).
        hand: As in `generate`.

    Returns:
        The plan.

    Raises:
        ValueError: As in `generate` and `dexzoo.refine`, or the ranking is unknown.
        RuntimeError: No feasible grasp is found.
        FileNotFoundError: A model cannot be loaded.
    """
    model = load(evaluator) if isinstance(evaluator, str) else evaluator
    second = load(judge) if isinstance(judge, str) else judge
    check_ranking(ranking, second is not None)
    if second is not None:
        check_judge(model, second)
    view, chosen = View.of(observation), _generator(generator, hand)
    model.check_hand(chosen.hand)
    generated = chosen.generate(view, num_grasps, seed)
    score = model.score(generated, view)
    order = best_first(score)
    if num_refined <= 0:
        return Plan(generated[order], generated[order], score[order], score[order], order)
    prior = chosen.density(view, seed)
    result = refine(generated[order[:num_refined]], view, model, judge=second, prior=prior)
    place, rest = rank(result, ranking), order[num_refined:]
    order = torch.cat((order[:num_refined][place], rest))
    grasps = Grasps.concatenate([result.grasps[place], generated[rest]])
    return Plan(grasps, generated[order], score[order], torch.cat((result.score_after[place], score[rest])), order)


def _generator(generator: str | GraspGenerator, hand: str | Path | Hand) -> GraspGenerator:
    if isinstance(generator, GraspGenerator):
        return generator
    return make_generator(generator, hand if isinstance(hand, Hand) else Hand.load(hand))

"""From one observation to ranked grasps: generate, score, refine, choose. No simulator is needed."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dexzoo.camera import Observation
from dexzoo.generators import make_generator
from dexzoo.generators.generator import GraspGenerator
from dexzoo.generators.kopicki import KopickiGenerator
from dexzoo.grasp import Grasps
from dexzoo.models.evaluator import GraspEvaluator
from dexzoo.models.zoo import load
from dexzoo.refinement import Weights, rank, refine
from dexzoo.refinement.method import check_judge
from dexzoo.refinement.ranking import best_first, check


@dataclass(frozen=True)
class Plan:
    """Grasps in the camera frame, best first, and what is known of each.

    given: the same grasps before refinement. All others (num_grasps,). score: probability of success as generated.
    refined_score: after refinement; equal to score where none was asked for or accepted. generator_rank: place in the
    generator's own order, 0 the best.
    """

    grasps: Grasps
    given: Grasps
    score: Tensor
    refined_score: Tensor
    generator_rank: Tensor


def generate(
    observation: Observation, num_grasps: int = 100, seed: int = 0, generator: str | GraspGenerator = "kopicki"
) -> Grasps:
    """At most `num_grasps` grasps in the camera frame, best first; the same for the same seed.

    generator: "kopicki", "heuristic", a folder of demonstrations that Kopicki's learns from, or an object.
    Raises ValueError when too little of the object is seen, RuntimeError when no feasible grasp is found.
    """
    chosen = make_generator(generator) if isinstance(generator, str) else generator
    return chosen.generate(observation, num_grasps, seed)


def plan(
    observation: Observation,
    evaluator: str | GraspEvaluator = "em_fk",
    num_grasps: int = 100,
    num_refined: int = 0,
    seed: int = 0,
    generator: str | GraspGenerator = "kopicki",
    judge: str | GraspEvaluator | None = None,
    ranking: str = "before",
) -> Plan:
    """Generate grasps, rank them by the evaluator and refine the best `num_refined`, which stay ahead of the others.

    generator: as in `generate`; Kopicki's is the prior of refinement too, with others there is none.
    judge: a second evaluator, without whose consent no grasp is replaced. ranking: the order of the refined, a name in
    `dexzoo.refinement.RANKINGS`; "before" leaves that of the scores as generated: ranking by refined scores picks the
    grasps whose score inflated most (thesis, Table 4.6).
    Raises what `generate`, `dexzoo.refine` and `dexzoo.load` raise.
    """
    model = load(evaluator) if isinstance(evaluator, str) else evaluator
    second = load(judge) if isinstance(judge, str) else judge
    check(ranking, second is not None)
    if second is not None:
        check_judge(model, second)
    chosen = make_generator(generator) if isinstance(generator, str) else generator
    density, weights = None, Weights(prior=0.0)
    if isinstance(chosen, KopickiGenerator):
        density, weights = chosen.density(observation, seed), Weights()
        generated = chosen.generate(observation, num_grasps, seed, density)
    else:
        generated = chosen.generate(observation, num_grasps, seed)
    score = model.score(observation, generated)
    order = best_first(score)
    if num_refined <= 0:
        return Plan(generated[order], generated[order], score[order], score[order], order)
    best = generated[order[:num_refined]]
    result = refine(best, observation, model, judge=second, weights=weights, density=density)
    place, rest = rank(result, ranking), order[num_refined:]
    order = torch.cat((order[:num_refined][place], rest))
    grasps = Grasps.concatenate([result.grasps[place], generated[rest]])
    return Plan(grasps, generated[order], score[order], torch.cat((result.score_after[place], score[rest])), order)

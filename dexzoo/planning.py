"""From one observation to ranked grasps: generate, score, refine, choose. No simulator is needed."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dexzoo.camera import Observation
from dexzoo.generators import make_generator
from dexzoo.generators.generator import GraspGenerator
from dexzoo.grasp import Grasps
from dexzoo.models.evaluator import GraspEvaluator
from dexzoo.models.zoo import load
from dexzoo.refinement import refine


@dataclass(frozen=True)
class Plan:
    """Grasps in the camera frame, best first, and what is known of each.

    All (num_grasps,). score: probability of success as generated, which ranks them. refined_score: after refinement;
    equal to score where none was asked for or accepted. generator_rank: place in the generator's own order, 0 the best.
    """

    grasps: Grasps
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
    evaluator: str | GraspEvaluator = "em2",
    num_grasps: int = 100,
    num_refined: int = 0,
    seed: int = 0,
    generator: str | GraspGenerator = "kopicki",
) -> Plan:
    """Generate grasps, rank them by the evaluator and refine the best `num_refined`.

    The order is that of the scores before refinement: ranking by refined scores picks the grasps whose score inflated
    most (thesis, Table 4.6).
    Raises what `generate` and `dexzoo.load` raise.
    """
    model = load(evaluator) if isinstance(evaluator, str) else evaluator
    generated = generate(observation, num_grasps, seed, generator)
    score = model.score(observation, generated)
    order = score.argsort(descending=True, stable=True)
    grasps, score = generated[order], score[order]
    refined_score = score
    if num_refined > 0:
        result = refine(grasps[:num_refined], observation, model)
        grasps = Grasps.concatenate([result.grasps, grasps[num_refined:]])
        refined_score = torch.cat((result.score_after, score[num_refined:]))
    return Plan(grasps, score, refined_score, order)

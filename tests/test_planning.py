"""Plans: the order of the scores, and a way back to the generator's own order."""

from typing import Any

import pytest
import torch
from torch import Tensor

from dexzoo import planning
from dexzoo.camera import Observation
from dexzoo.generators.demonstration import load_demonstrations
from dexzoo.generators.density import GraspDensity
from dexzoo.generators.generator import GraspGenerator
from dexzoo.generators.kopicki import KopickiGenerator
from dexzoo.grasp import GRIP, Grasps
from dexzoo.models.evaluator import GraspEvaluator, Scene
from dexzoo.refinement import Refinement, refine


class NearIsGood(GraspEvaluator):
    """Log-odds that fall with the distance of the grip's wrist from the camera."""

    architecture = "near"

    def encode(self, images: Tensor) -> Scene:
        return {"views": torch.zeros(len(images))}

    def logit(self, scene: Scene, grasps: Tensor) -> Tensor:
        return -10 * grasps[..., GRIP, :3].norm(dim=-1)


@pytest.fixture(autouse=True)
def generated(can_grasps: Grasps, monkeypatch: pytest.MonkeyPatch) -> Grasps:
    """What the generator gives is known beforehand."""

    class Given(GraspGenerator):
        def generate(self, observation: Observation, num_grasps: int = 100, seed: int = 0) -> Grasps:
            return can_grasps[:num_grasps]

    monkeypatch.setattr(planning, "make_generator", lambda name: Given())
    return can_grasps


def test_grasps_are_in_the_order_of_their_scores(can_view: Observation, generated: Grasps) -> None:
    plan = planning.plan(can_view, NearIsGood())
    assert len(plan.grasps) == len(generated)
    assert (plan.score.diff() <= 0).all()
    torch.testing.assert_close(plan.score, NearIsGood().score(can_view, plan.grasps))
    assert plan.grasps.frame == "camera"
    assert torch.equal(plan.refined_score, plan.score)


def test_the_generators_order_can_be_told(can_view: Observation, generated: Grasps) -> None:
    plan = planning.plan(can_view, NearIsGood(), num_grasps=20)
    assert sorted(plan.generator_rank.tolist()) == list(range(20))
    assert torch.equal(plan.grasps.waypoints, generated.waypoints[plan.generator_rank])
    assert plan.grasps.log_likelihood is not None
    assert generated.log_likelihood is not None
    assert torch.equal(plan.grasps.log_likelihood, generated.log_likelihood[plan.generator_rank])


def test_only_the_best_are_refined_and_the_order_stays(can_view: Observation) -> None:
    plain = planning.plan(can_view, NearIsGood(), num_grasps=20)
    plan = planning.plan(can_view, NearIsGood(), num_grasps=20, num_refined=5)
    assert torch.equal(plan.score, plain.score)
    assert torch.equal(plan.generator_rank, plain.generator_rank)
    assert torch.equal(plan.refined_score[5:], plan.score[5:])
    assert torch.equal(plan.grasps.waypoints[5:], plain.grasps.waypoints[5:])
    assert (plan.refined_score[:5] != plan.score[:5]).any()
    assert not torch.equal(plan.grasps.waypoints[:5], plain.grasps.waypoints[:5])
    torch.testing.assert_close(plan.refined_score, NearIsGood().score(can_view, plan.grasps), atol=1e-5, rtol=1e-4)


def test_a_judge_that_never_agrees_leaves_the_plan_as_it_was(can_view: Observation) -> None:
    class AllIsOne(NearIsGood):
        def logit(self, scene: Scene, grasps: Tensor) -> Tensor:
            return 0 * super().logit(scene, grasps)

    plain = planning.plan(can_view, NearIsGood(), num_grasps=10)
    plan = planning.plan(can_view, NearIsGood(), num_grasps=10, num_refined=5, judge=AllIsOne())
    assert torch.equal(plan.grasps.waypoints, plain.grasps.waypoints)
    assert torch.equal(plan.refined_score, plan.score)


def test_the_refined_may_be_ranked_anew_and_stay_ahead(can_view: Observation, generated: Grasps) -> None:
    plan = planning.plan(can_view, NearIsGood(), num_grasps=20, num_refined=8, ranking="after")
    assert (plan.refined_score[:8].diff() <= 0).all()
    assert (plan.refined_score[8:].diff() <= 0).all()
    assert torch.equal(plan.given.waypoints, generated.waypoints[plan.generator_rank])
    torch.testing.assert_close(plan.score, NearIsGood().score(can_view, plan.given))
    torch.testing.assert_close(plan.refined_score, NearIsGood().score(can_view, plan.grasps), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize(
    ("ranking", "message"), [("best", "ranking 'best' is unknown"), ("judge", "needs a refinement")]
)
def test_a_ranking_that_cannot_be_is_told_before_any_work(
    can_view: Observation, monkeypatch: pytest.MonkeyPatch, ranking: str, message: str
) -> None:
    monkeypatch.setattr(planning, "make_generator", lambda name: pytest.fail("the generator was made"))
    with pytest.raises(ValueError, match=message):
        planning.plan(can_view, NearIsGood(), num_refined=5, ranking=ranking)


def test_more_may_be_refined_than_there_are(can_view: Observation) -> None:
    assert len(planning.plan(can_view, NearIsGood(), num_grasps=3, num_refined=20).grasps) == 3


def test_a_model_that_is_not_known_is_named_before_any_work(
    can_view: Observation, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(planning, "make_generator", lambda name: pytest.fail("the generator was made"))
    with pytest.raises(ValueError, match="model 'em22' is unknown, did you mean em2"):
        planning.plan(can_view, "em22")


def test_scores_that_are_none_come_last(can_view: Observation, generated: Grasps) -> None:
    class Doubtful(NearIsGood):
        def logit(self, scene: Scene, grasps: Tensor) -> Tensor:
            there = grasps[..., 0, 27] == generated.grasp_type[0]
            return torch.where(there, torch.nan, super().logit(scene, grasps))

    plan = planning.plan(can_view, Doubtful(), num_refined=5)
    known = torch.isfinite(plan.score)
    assert 5 < int(known.sum()) < len(generated)
    assert (known.int().diff() <= 0).all()


def test_a_judge_that_guides_is_told_before_any_work(can_view: Observation, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planning, "make_generator", lambda name: pytest.fail("the generator was made"))
    model = NearIsGood()
    with pytest.raises(ValueError, match="the judge is, or shares a member with, what guides"):
        planning.plan(can_view, model, num_refined=5, judge=model)


def test_the_prior_is_that_of_the_generator(can_view: Observation, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a Kopicki generator its own density, made once; of another, none."""
    made: list[GraspDensity] = []

    class Counting(KopickiGenerator):
        def density(self, observation: Observation, seed: int = 0) -> GraspDensity:
            made.append(super().density(observation, seed))
            return made[-1]

    asked: list[dict[str, Any]] = []

    def noting(*args: Any, **options: Any) -> Refinement:  # noqa: ANN401
        asked.append(options)
        return refine(*args, **options, num_steps=2)

    monkeypatch.setattr(planning, "refine", noting)
    learnt = Counting(load_demonstrations()[:2], num_samples=200, num_kernels=1000)
    plan = planning.plan(can_view, NearIsGood(), num_grasps=5, num_refined=2, generator=learnt)
    assert torch.equal(plan.given.waypoints, learnt.generate(can_view, 5)[plan.generator_rank].waypoints)
    planning.plan(can_view, NearIsGood(), num_grasps=5, num_refined=2, generator="heuristic")
    kopicki, other = asked
    assert kopicki["density"] is made[0]
    assert len(made) == 2  # the second by the test itself
    assert kopicki["weights"].prior > 0
    assert (other["density"], other["weights"].prior) == (None, 0)

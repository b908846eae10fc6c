"""Plans: the order of the scores, and a way back to the generator's own order."""

import pytest
import torch
from torch import Tensor

from dexzoo import planning
from dexzoo.camera import Observation
from dexzoo.grasp import GRIP, Grasps
from dexzoo.models.evaluator import GraspEvaluator, Scene


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
    monkeypatch.setattr(planning, "generate", lambda observation, num_grasps, seed, generator: can_grasps[:num_grasps])
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
    monkeypatch.setattr(planning, "generate", lambda *_: pytest.fail("the generator has run"))
    with pytest.raises(ValueError, match=message):
        planning.plan(can_view, NearIsGood(), num_refined=5, ranking=ranking)


def test_more_may_be_refined_than_there_are(can_view: Observation) -> None:
    assert len(planning.plan(can_view, NearIsGood(), num_grasps=3, num_refined=20).grasps) == 3


def test_a_model_that_is_not_known_is_named_before_any_work(
    can_view: Observation, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(planning, "generate", lambda *_: pytest.fail("the generator has run"))
    with pytest.raises(ValueError, match="model 'em22' is unknown, did you mean em2"):
        planning.plan(can_view, "em22")

"""Plans: the order of the scores, and a way back to the generator's own order."""

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from dexzoo import planning
from dexzoo.generators.contact_density import ContactDensity
from dexzoo.generators.demonstration import load_demonstrations
from dexzoo.generators.generator import GraspGenerator
from dexzoo.generators.kopicki import KopickiGenerator
from dexzoo.grasp import GRIP, Grasps, Trajectory
from dexzoo.hand import Hand
from dexzoo.models.batch import Encoding
from dexzoo.models.evaluator import GraspEvaluator
from dexzoo.perception import Observation, View
from dexzoo.refinement import Refinement, refine


class NearIsGood(GraspEvaluator):
    """Log-odds that fall with the distance of the grip's wrist from the camera."""

    architecture = "near"

    def encode(self, images: Tensor) -> Encoding:
        return {"views": torch.zeros(len(images))}

    def logit(self, encoding: Encoding, grasps: Trajectory) -> Tensor:
        return -10 * grasps.position[..., GRIP, :].norm(dim=-1)


class Given(GraspGenerator):
    """Proposes grasps that are known beforehand."""

    def __init__(self, grasps: Grasps) -> None:
        self.grasps, self.hand = grasps, grasps.hand

    def generate(self, observation: Observation | View, num_grasps: int = 100, seed: int = 0) -> Grasps:
        return self.grasps[:num_grasps]


@pytest.fixture(autouse=True)
def generated(can_grasps: Grasps, monkeypatch: pytest.MonkeyPatch) -> Grasps:
    monkeypatch.setattr(planning, "make_generator", lambda name, hand: Given(can_grasps))
    return can_grasps


@pytest.fixture
def no_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is generated."""
    monkeypatch.setattr(Given, "generate", lambda *_: pytest.fail("grasps were generated"))


def equal(a: Grasps, b: Grasps) -> bool:
    return torch.equal(a.wrist, b.wrist) and torch.equal(a.joints, b.joints)


def test_grasps_are_in_the_order_of_their_scores(can_view: Observation, generated: Grasps) -> None:
    plan = planning.plan(can_view, NearIsGood())
    assert len(plan.grasps) == len(generated)
    assert (plan.score.diff() <= 0).all()
    torch.testing.assert_close(plan.score, NearIsGood().score(plan.grasps, can_view))
    assert torch.equal(plan.refined_score, plan.score)
    assert equal(planning.plan(View(can_view), NearIsGood()).grasps, plan.grasps)


def test_the_generators_order_can_be_told(can_view: Observation, generated: Grasps) -> None:
    plan = planning.plan(can_view, NearIsGood(), num_grasps=20)
    assert sorted(plan.generator_rank.tolist()) == list(range(20))
    assert equal(plan.grasps, generated[plan.generator_rank])
    assert plan.grasps.log_likelihood is not None
    assert generated.log_likelihood is not None
    assert torch.equal(plan.grasps.log_likelihood, generated.log_likelihood[plan.generator_rank])


def test_only_the_best_are_refined_and_the_order_stays(can_view: Observation) -> None:
    plain = planning.plan(can_view, NearIsGood(), num_grasps=20)
    plan = planning.plan(can_view, NearIsGood(), num_grasps=20, num_refined=5)
    assert torch.equal(plan.score, plain.score)
    assert torch.equal(plan.generator_rank, plain.generator_rank)
    assert torch.equal(plan.refined_score[5:], plan.score[5:])
    assert equal(plan.grasps[5:], plain.grasps[5:])
    assert (plan.refined_score[:5] != plan.score[:5]).any()
    assert not equal(plan.grasps[:5], plain.grasps[:5])
    torch.testing.assert_close(plan.refined_score, NearIsGood().score(plan.grasps, can_view), atol=1e-5, rtol=1e-4)


def test_a_judge_that_never_agrees_leaves_the_plan_as_it_was(can_view: Observation) -> None:
    class AllIsOne(NearIsGood):
        def logit(self, encoding: Encoding, grasps: Trajectory) -> Tensor:
            return 0 * super().logit(encoding, grasps)

    plain = planning.plan(can_view, NearIsGood(), num_grasps=10)
    plan = planning.plan(can_view, NearIsGood(), num_grasps=10, num_refined=5, judge=AllIsOne())
    assert equal(plan.grasps, plain.grasps)
    assert torch.equal(plan.refined_score, plan.score)


def test_the_refined_may_be_ranked_anew_and_stay_ahead(can_view: Observation, generated: Grasps) -> None:
    plan = planning.plan(can_view, NearIsGood(), num_grasps=20, num_refined=8, ranking="after")
    assert (plan.refined_score[:8].diff() <= 0).all()
    assert (plan.refined_score[8:].diff() <= 0).all()
    assert equal(plan.given, generated[plan.generator_rank])
    torch.testing.assert_close(plan.score, NearIsGood().score(plan.given, can_view))
    torch.testing.assert_close(plan.refined_score, NearIsGood().score(plan.grasps, can_view), atol=1e-5, rtol=1e-4)


@pytest.mark.usefixtures("no_work")
@pytest.mark.parametrize(
    ("ranking", "message"), [("best", "ranking 'best' is unknown"), ("judge", "needs a refinement")]
)
def test_a_ranking_that_cannot_be_is_told_before_any_work(can_view: Observation, ranking: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        planning.plan(can_view, NearIsGood(), num_refined=5, ranking=ranking)


def test_more_may_be_refined_than_there_are(can_view: Observation) -> None:
    assert len(planning.plan(can_view, NearIsGood(), num_grasps=3, num_refined=20).grasps) == 3


@pytest.mark.usefixtures("no_work")
def test_a_model_that_is_not_known_is_named_before_any_work(can_view: Observation) -> None:
    with pytest.raises(ValueError, match="model 'em22' is unknown, did you mean em2"):
        planning.plan(can_view, "em22")


@pytest.mark.usefixtures("no_work")
def test_a_hand_that_is_not_known_is_named_before_any_work(can_view: Observation, generated: Grasps) -> None:
    with pytest.raises(FileNotFoundError, match="dlr3"):
        planning.plan(can_view, NearIsGood(), hand="dlr3")
    left = Given(Grasps.of(generated.trajectory, Hand.load(side="left")))
    with pytest.raises(ValueError, match=r"evaluator near knows the hand dlr2 \(right\), not dlr2 \(left\)"):
        planning.plan(can_view, NearIsGood(), generator=left)


def test_a_plan_is_of_the_hand_that_is_asked_for(
    can_view: Observation, generated: Grasps, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether it is given, named, or found in a folder."""
    asked: list[tuple[str, Hand]] = []

    def noting(name: str, hand: Hand) -> Given:
        asked.append((name, hand))
        return Given(generated)

    monkeypatch.setattr(planning, "make_generator", noting)
    right, left = Hand.load(), Hand.load(side="left")
    for hand in (left, "dlr2", Path(__file__).parents[1] / "robots/dlr2"):
        planning.generate(can_view, 5, generator="heuristic", hand=hand)
    assert asked == [("heuristic", left), ("heuristic", right), ("heuristic", right)]


def test_scores_that_are_none_come_last(can_view: Observation, generated: Grasps) -> None:
    class Doubtful(NearIsGood):
        def logit(self, encoding: Encoding, grasps: Trajectory) -> Tensor:
            there = grasps.grasp_type == generated.grasp_type[0]
            return torch.where(there, torch.nan, super().logit(encoding, grasps))

    plan = planning.plan(can_view, Doubtful(), num_refined=5)
    known = torch.isfinite(plan.score)
    assert 5 < int(known.sum()) < len(generated)
    assert (known.int().diff() <= 0).all()


@pytest.mark.usefixtures("no_work")
def test_a_judge_that_guides_is_told_before_any_work(can_view: Observation) -> None:
    model = NearIsGood()
    with pytest.raises(ValueError, match="the judge is, or shares a member with, what guides"):
        planning.plan(can_view, model, num_refined=5, judge=model)


def test_the_prior_is_that_of_the_generator(can_view: Observation, hand: Hand, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a Kopicki generator its own density, of which there is one for each view; of another, none."""
    made: list[ContactDensity] = []

    class Counting(KopickiGenerator):
        def density(self, observation: Observation | View, seed: int = 0) -> ContactDensity:
            made.append(super().density(observation, seed))
            return made[-1]

    asked: list[Any] = []

    def noting(*args: Any, **options: Any) -> Refinement:  # noqa: ANN401
        asked.append(options["prior"])
        return refine(*args, **options, num_steps=2)

    monkeypatch.setattr(planning, "refine", noting)
    learned = Counting(load_demonstrations(hand)[:2], num_samples=200, num_kernels=1000)
    plan = planning.plan(can_view, NearIsGood(), num_grasps=5, num_refined=2, generator=learned)
    planning.plan(can_view, NearIsGood(), num_grasps=5, num_refined=2, generator="heuristic")
    assert asked == [made[0], None]
    assert len(made) == 2  # once to generate, once as the prior,
    assert made[1] is made[0]  # and the view has kept it
    assert equal(plan.given, learned.generate(can_view, 5)[plan.generator_rank])

"""Refinement on evaluators whose best grasp is known: what rises, what is accepted, and what stays."""

from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import synthetic
import torch
from torch import Tensor

from dexzoo.camera import Observation, look_at
from dexzoo.grasp import GRIP, Frame, Grasps
from dexzoo.hand import Hand
from dexzoo.models.em_fk import EMFK
from dexzoo.models.ensemble import Ensemble
from dexzoo.models.evaluator import GraspEvaluator, Scene
from dexzoo.models.zoo import load
from dexzoo.refinement import OPTIMISERS, RANKINGS, Refinement, Region, Weights, climb, method, rank, refine
from dexzoo.refinement.penalties import Posed
from dexzoo.refinement.thesis import GROUPS, HALF_CUBE, ascend


class Known(GraspEvaluator):
    """Log-odds as a given function of the waypoints (grasp, 10, 28) in the frame of the aimed camera."""

    architecture = "known"

    def __init__(self, function: Callable[[Tensor], Tensor], spread: Callable[[Tensor], Tensor] | None = None) -> None:
        super().__init__()
        self.function, self.spread = function, spread

    def encode(self, images: Tensor) -> Scene:
        return {"views": torch.zeros(len(images))}

    def logit(self, scene: Scene, grasps: Tensor) -> Tensor:
        return self.function(grasps.flatten(0, 1)).unflatten(0, grasps.shape[:2])

    def logit_and_spread(self, scene: Scene, grasps: Tensor) -> tuple[Tensor, Tensor]:
        logit = self.logit(scene, grasps)
        if self.spread is None:
            return logit, torch.zeros_like(logit)
        return logit, self.spread(grasps.flatten(0, 1)).unflatten(0, grasps.shape[:2])


TARGET = torch.tensor([0.0, 0.0, 0.3])
"""On the aimed camera's axis, on this side of the object."""
NOTHING = Weights(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
PENALTIES = Weights(prior=0.0)


def nearness(waypoints: Tensor) -> Tensor:
    """Minus the squared distance, in decimetres, of the grip's wrist from the target."""
    return -100 * (waypoints[:, GRIP, :3] - TARGET).square().sum(-1)


def indifferent(waypoints: Tensor) -> Tensor:
    return 0 * waypoints.sum((1, 2))


@pytest.fixture(scope="module")
def grasps(can_grasps: Grasps) -> Grasps:
    return can_grasps[:12]


@pytest.fixture(scope="module")
def improved(grasps: Grasps, can_view: Observation) -> Refinement:
    return refine(grasps, can_view, Known(nearness), weights=PENALTIES)


def lowered(grasps: Grasps, view: Observation, hand: Hand, depth: float) -> Grasps:
    """Each grasp moved straight down, as a whole, until its grip reaches `depth` metres below the table."""
    world = grasps.to_frame("world", view.T_world_camera)
    links = world.wrist_pose[:, GRIP, None] @ hand.forward_kinematics(world.joints[:, GRIP])
    waypoints = world.waypoints.clone()
    waypoints[..., 2] -= (hand.clearance(links, torch.tensor([0.0, 0, 1, 0])).amin(-1) + depth)[:, None]
    return Grasps(waypoints, "world")


# what rises


def test_the_objective_rises(improved: Refinement, grasps: Grasps, can_view: Observation) -> None:
    assert improved.accepted.float().mean() > 0.8
    assert (improved.score_after > improved.score_before)[improved.accepted].float().mean() > 0.7
    evaluator = Known(nearness)
    torch.testing.assert_close(improved.score_before, evaluator.score(can_view, grasps), atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(improved.score_after, evaluator.score(can_view, improved.grasps), atol=1e-6, rtol=1e-5)
    assert improved.penalties.keys() == {"spread", "penetration", "shadow", "table", "self_collision"}
    given = refine(grasps, can_view, evaluator, weights=PENALTIES, num_steps=0).penalties
    fall = sum(getattr(PENALTIES, name) * (given[name] - left) for name, left in improved.penalties.items())
    rise = improved.score_after.logit() - improved.score_before.logit() + fall
    assert (rise[improved.accepted] > 0).all()
    assert improved.judge_after is improved.trace is None
    assert not improved.failed.any()


@pytest.mark.parametrize(("optimiser", "share"), [("adam", 0.9), ("lbfgs", 0.95), ("metropolis", 0.3), ("random", 0.3)])
def test_a_top_beyond_the_region_is_approached_to_its_border(
    can_view: Observation, grasps: Grasps, optimiser: str, share: float
) -> None:
    """The steepest way leads to the wrist's corner: 5 mm along each axis of the palm."""
    world = grasps.to_frame("world", can_view.T_world_camera)
    evaluator = Known(lambda w: 1000 * w[:, GRIP, 0])
    result = refine(
        world, can_view, evaluator, weights=NOTHING, optimiser=optimiser, num_steps=40, region=Region(wrist=0.005)
    )
    T_aimed = can_view.aimed().T_world_camera
    direction = torch.tensor(T_aimed[:3, 0], dtype=torch.float32)
    step = result.grasps.position[:, GRIP] - world.position[:, GRIP]
    most = 0.005 * (world.wrist_pose[:, GRIP, :3, :3].mT @ direction).abs().sum(-1)
    assert result.accepted.all()
    assert ((step @ direction) / most > share).all()
    assert ((step @ direction) / most < 1.001).all()


@pytest.mark.parametrize("optimiser", ["adam", "lbfgs"])
def test_a_top_within_the_region_is_found(can_view: Observation, grasps: Grasps, optimiser: str) -> None:
    given = grasps.to_frame("world", can_view.T_world_camera).waypoints
    T = torch.tensor(can_view.aimed().T_world_camera, dtype=torch.float32)
    top = given[:, GRIP, :3] + torch.tensor([0.001, -0.002, 0.001])

    def nearer(waypoints: Tensor) -> Tensor:
        world = waypoints[:, GRIP, :3] @ T[:3, :3].T + T[:3, 3]
        return -1e5 * (world - top[: len(world)]).square().sum(-1)

    world = Grasps(given, "world")
    result = refine(world, can_view, Known(nearer), weights=NOTHING, optimiser=optimiser, num_steps=60, step_size=0.1)
    left = (result.grasps.position[:, GRIP] - top).norm(dim=-1)
    assert float(left.max()) < 0.0003


def test_penalties_lift_a_grasp_out_of_the_table(can_view: Observation, grasps: Grasps, hand: Hand) -> None:
    low = lowered(grasps, can_view, hand, 0.003)
    given = refine(low, can_view, Known(indifferent), weights=PENALTIES, num_steps=0).penalties["table"]
    assert float(given.min()) > 0.0045
    result = refine(low, can_view, Known(indifferent), weights=PENALTIES)
    assert result.accepted.all()
    assert (result.penalties["table"] < 0.7 * given).float().mean() > 0.7
    torch.testing.assert_close(result.score_after, torch.full((12,), 0.5))


def test_the_spread_of_an_ensemble_is_avoided(can_view: Observation, grasps: Grasps) -> None:
    doubted = Known(lambda w: 30 * w[:, GRIP, 0], lambda w: 45 * w[:, GRIP, 0])
    left, right = (refine(grasps, can_view, doubted, weights=replace(NOTHING, spread=weight)) for weight in (0.0, 1.0))
    assert "spread" not in left.penalties
    assert (left.score_after > left.score_before).all()
    assert (right.score_after < right.score_before).all()  # less likely to hold, but surer
    assert right.accepted.all()


def test_the_prior_draws_towards_the_demonstrations(can_view: Observation, grasps: Grasps) -> None:
    generator = method.default_generator()
    density = generator.density(can_view)
    weights = replace(NOTHING, prior=1.0)
    result = refine(grasps, can_view, Known(indifferent), weights=weights, density=density)
    before, after = (density.log_density(g.to_frame("world", can_view.T_world_camera)) for g in (grasps, result.grasps))
    known = torch.isfinite(before)
    assert result.accepted[known].all()
    assert (after - before)[known].median() > 1
    torch.testing.assert_close(result.penalties["prior"][known], after[known], atol=1e-2, rtol=1e-3)
    made = refine(grasps[:2], can_view, Known(indifferent), weights=weights, num_steps=2)  # makes the density itself
    given = refine(grasps[:2], can_view, Known(indifferent), weights=weights, num_steps=2, density=density)
    assert torch.equal(made.grasps.waypoints, given.grasps.waypoints)


def test_terms_without_weight_are_not_looked_at(
    can_view: Observation, grasps: Grasps, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("penetration", "table", "self_collision", "nearest"):
        monkeypatch.setattr(Posed, name, lambda *_, name=name, **__: pytest.fail(f"{name} was looked at"))
    monkeypatch.setattr(method, "default_generator", lambda: pytest.fail("a density was made"))
    monkeypatch.setattr(Known, "logit_and_spread", lambda *_: pytest.fail("the spread was asked for"))
    result = refine(grasps, can_view, Known(nearness), weights=NOTHING, num_steps=4)
    assert result.penalties == {}
    assert result.accepted.all()


# what is accepted


def test_a_judge_that_disagrees_keeps_the_grasps(can_view: Observation, grasps: Grasps) -> None:
    result = refine(grasps, can_view, Known(nearness), judge=Known(lambda w: -nearness(w)), weights=NOTHING)
    assert not result.accepted.any()
    assert torch.equal(result.grasps.waypoints, grasps.waypoints)
    assert torch.equal(result.score_after, result.score_before)
    assert result.judge_before is not None
    assert result.judge_after is not None
    assert torch.equal(result.judge_after, result.judge_before)


def test_a_judge_decides_grasp_by_grasp_and_by_its_margin(can_view: Observation, grasps: Grasps) -> None:
    alone = refine(grasps, can_view, Known(nearness), weights=NOTHING)
    assert alone.accepted.all()
    judge = Known(lambda w: 100 * w[:, GRIP, 1])
    opinion = [torch.logit(judge.score(can_view, g).double(), 1e-9) for g in (grasps, alone.grasps)]
    rise = opinion[1] - opinion[0]
    assert 0 < int((rise > 0).sum()) < len(grasps)
    for margin in (0.0, float(rise.sort().values[-3:-1].mean())):
        result = refine(grasps, can_view, Known(nearness), judge=judge, margin=margin, weights=NOTHING)
        assert torch.equal(result.accepted, rise > margin)
        for chosen, source in ((result.accepted, alone.grasps), (~result.accepted, grasps)):
            assert torch.equal(result.grasps.waypoints[chosen], source.waypoints[chosen])
        assert result.judge_after is not None
        torch.testing.assert_close(result.judge_after, judge.score(can_view, result.grasps), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("optimiser", OPTIMISERS)
def test_nothing_changes_without_steps(can_view: Observation, grasps: Grasps, optimiser: str) -> None:
    result = refine(grasps, can_view, Known(nearness), weights=PENALTIES, optimiser=optimiser, num_steps=0)
    assert torch.equal(result.grasps.waypoints, grasps.waypoints)
    assert not result.accepted.any()
    assert torch.equal(result.score_after, result.score_before)


@pytest.mark.parametrize("asked", [True, False])
def test_a_way_into_the_table_is_not_accepted(can_view: Observation, grasps: Grasps, hand: Hand, asked: bool) -> None:
    """The evaluator wants the hand lower, by more than there is room for; the climb itself hardly minds the table."""
    given = lowered(grasps, can_view, hand, -0.005)
    down = torch.tensor(can_view.aimed().T_world_camera[2, :3], dtype=torch.float32)
    low = Known(lambda w: -1000 * (w[:, GRIP, :3] @ down))
    result = refine(given, can_view, low, weights=replace(NOTHING, table=1e-9 if asked else 0.0))
    way = slice(0, GRIP + 1)

    def lowest(grasps: Grasps) -> Tensor:
        links = grasps.wrist_pose[:, way, None] @ hand.forward_kinematics(grasps.joints[:, way])
        return hand.clearance(links, torch.tensor([0.0, 0, 1, 0])).amin((-1, -2))

    assert (lowest(given) > 0.004).all()
    if asked:
        assert not result.accepted.all()
        assert (lowest(result.grasps) > 0.0).all()
    else:
        assert result.accepted.all()
        assert (lowest(result.grasps) < 0.0).any()


def test_what_is_not_accepted_is_handed_back_itself(can_view: Observation, grasps: Grasps) -> None:
    """The gradient points away from what is better."""
    result = refine(grasps, can_view, Known(lambda w: 2 * nearness(w).detach() - nearness(w)), weights=NOTHING)
    assert not result.accepted.any()
    assert torch.equal(result.grasps.waypoints, grasps.waypoints)
    assert result.grasps.log_likelihood is not None
    assert grasps.log_likelihood is not None
    assert torch.equal(result.grasps.log_likelihood, grasps.log_likelihood)


# numbers that are none


@pytest.mark.parametrize("optimiser", OPTIMISERS)
def test_a_grasp_without_a_score_is_as_given(can_view: Observation, grasps: Grasps, optimiser: str) -> None:
    bad = grasps.grasp_type == grasps.grasp_type[0]

    def broken(waypoints: Tensor) -> Tensor:
        return nearness(waypoints) + torch.where(waypoints[:, 0, 27] == grasps.grasp_type[0], torch.nan, 0.0)

    result = refine(grasps, can_view, Known(broken), weights=PENALTIES, optimiser=optimiser, num_steps=6)
    assert 0 < int(bad.sum()) < len(grasps)
    assert torch.equal(result.failed, bad)
    assert not result.accepted[bad].any()
    assert result.accepted[~bad].any()
    assert torch.equal(result.grasps.waypoints[bad], grasps.waypoints[bad])


@pytest.mark.parametrize("optimiser", OPTIMISERS)
def test_a_score_that_breaks_down_in_mid_run_leaves_the_last_good_state(
    can_view: Observation, grasps: Grasps, optimiser: str
) -> None:
    start = grasps.to_frame("world", can_view.T_world_camera).to_frame("camera", can_view.aimed().T_world_camera)
    first = start.position[:, GRIP]

    def broken(waypoints: Tensor) -> Tensor:
        there = waypoints[:, GRIP, :3]
        gone = (there[:, None] - first).norm(dim=-1).amin(-1)
        return torch.where(gone > 0.002, torch.nan, nearness(waypoints))

    result = refine(
        grasps, can_view, Known(broken), weights=NOTHING, optimiser=optimiser, region=Region(wrist=0.005, turn=0.05)
    )
    assert result.failed.float().mean() > 0.5
    assert result.accepted.any()
    moved = (result.grasps.position[:, GRIP] - grasps.position[:, GRIP]).norm(dim=-1)
    assert float(moved.max()) < 0.00201
    assert torch.isfinite(result.score_after).all()
    assert (result.score_after >= result.score_before).all()


def test_a_gradient_that_is_no_number_does_no_harm(can_view: Observation, grasps: Grasps) -> None:
    def kinked(waypoints: Tensor) -> Tensor:
        """Zero, with a gradient that is infinite times zero."""
        return (0 * waypoints[..., :7]).abs().sum((1, 2)).sqrt()

    result = refine(grasps, can_view, Known(kinked), weights=NOTHING, num_steps=3)
    assert result.failed.all()
    assert torch.equal(result.grasps.waypoints, grasps.waypoints)


# form


def test_the_trace_starts_with_grasps_that_are_not_of_key_frames(can_view: Observation, grasps: Grasps) -> None:
    waypoints = grasps.waypoints.clone()
    waypoints[:, 3, :3] += 0.003
    for given in (Grasps(waypoints, "camera"), Grasps(waypoints, "camera").to_frame("world", can_view.T_world_camera)):
        result = refine(given, can_view, Known(nearness), weights=NOTHING, num_steps=2, keep_trace=True)
        assert result.trace is not None
        assert torch.equal(result.trace.waypoints[0], given.waypoints)


def test_double_precision_serves_as_well(can_view: Observation, grasps: Grasps) -> None:
    torch.manual_seed(0)
    model = EMFK(width=16, num_blocks=1, image=False)
    double = Grasps(grasps.waypoints.double(), "camera")
    torch.testing.assert_close(model.score(can_view, double), model.score(can_view, grasps))
    for run in (partial(refine, weights=PENALTIES, num_steps=4, keep_trace=True), ascend):
        single, result = (run(g, can_view, model) for g in (grasps, double))
        assert result.grasps.waypoints.dtype == torch.float64
        assert torch.equal(result.accepted, single.accepted)
        torch.testing.assert_close(result.grasps.waypoints.float(), single.grasps.waypoints, atol=1e-4, rtol=0)


@pytest.mark.parametrize("judge", [None, Known(nearness)])
def test_no_grasps(can_view: Observation, judge: Known | None) -> None:
    none = Grasps(torch.zeros(0, 10, 28), "camera")
    result = refine(none, can_view, Known(nearness), judge=judge)
    assert len(result.grasps) == 0
    assert result.grasps.frame == "camera"
    assert result.accepted.shape == result.score_after.shape == result.failed.shape == (0,)
    assert (result.judge_after is None) == (judge is None)
    assert set(result.penalties) == set(asdict(Weights()))
    assert all(value.shape == (0,) for value in result.penalties.values())
    assert len(rank(result)) == 0
    assert result.trace is None
    trace = refine(none, can_view, Known(nearness), num_steps=3, keep_trace=True).trace
    assert trace is not None
    assert trace.waypoints.shape == (4, 0, 10, 28)
    assert trace.objective.shape == (4, 0)


def test_both_frames_give_the_same(improved: Refinement, grasps: Grasps, can_view: Observation) -> None:
    given = grasps.to_frame("world", can_view.T_world_camera)
    world = refine(given, can_view, Known(nearness), weights=PENALTIES)
    assert improved.grasps.frame == "camera"
    assert world.grasps.frame == "world"
    back = world.grasps.to_frame("camera", can_view.T_world_camera)
    torch.testing.assert_close(back.waypoints, improved.grasps.waypoints, atol=1e-3, rtol=0)


@pytest.mark.parametrize("optimiser", OPTIMISERS)
def test_the_result_does_not_depend_on_the_company(grasps: Grasps, can_view: Observation, optimiser: str) -> None:
    how = {"weights": PENALTIES, "optimiser": optimiser, "num_steps": 5}
    together = refine(grasps, can_view, Known(nearness), **how)
    few = refine(grasps[:5], can_view, Known(nearness), **how)
    torch.testing.assert_close(few.grasps.waypoints, together.grasps.waypoints[:5], atol=1e-5, rtol=0)
    assert torch.equal(few.accepted, together.accepted[:5])
    again = refine(grasps, can_view, Known(nearness), **how)
    assert torch.equal(again.grasps.waypoints, together.grasps.waypoints)
    other = refine(grasps, can_view, Known(nearness), seed=1, **how)
    assert torch.equal(other.grasps.waypoints, together.grasps.waypoints) == (optimiser in ("adam", "lbfgs"))


def test_many_grasps_are_refined_in_pieces(
    grasps: Grasps, can_view: Observation, monkeypatch: pytest.MonkeyPatch
) -> None:
    together = refine(grasps, can_view, Known(nearness), weights=PENALTIES, num_steps=4, keep_trace=True)
    monkeypatch.setattr(climb, "CHUNK", 5)
    sizes: list[int] = []
    threads = torch.get_num_threads()
    pieces = refine(
        grasps, can_view, Known(nearness), weights=PENALTIES, num_steps=4, keep_trace=True,
        on_step=lambda _, value: sizes.append(len(value)),
    )  # fmt: skip
    torch.testing.assert_close(pieces.grasps.waypoints, together.grasps.waypoints, atol=1e-5, rtol=0)
    assert together.trace is not None
    assert pieces.trace is not None
    torch.testing.assert_close(pieces.trace.objective, together.trace.objective, atol=1e-4, rtol=1e-4)
    assert sizes == [4] * 15
    assert torch.get_num_threads() == threads


def test_progress_is_told_and_the_whole_way_kept(can_view: Observation, grasps: Grasps) -> None:
    told: list[tuple[int, Tensor]] = []
    result = refine(
        grasps, can_view, Known(nearness), weights=NOTHING, num_steps=7, keep_trace=True,
        on_step=lambda step, value: told.append((step, value)),
    )  # fmt: skip
    assert [step for step, _ in told] == list(range(8))
    assert result.trace is not None
    assert result.trace.waypoints.shape == (8, 12, 10, 28)
    assert torch.equal(result.trace.objective, torch.stack([value for _, value in told]))
    assert torch.equal(result.trace.waypoints[0], grasps.waypoints)
    best = result.trace.objective.argmax(0)
    way = result.trace.waypoints[best, torch.arange(12)]
    torch.testing.assert_close(way, result.grasps.waypoints, atol=1e-5, rtol=0)
    still = result.trace.waypoints[1:5, :, GRIP, 7:27]
    torch.testing.assert_close(still, still[:1].expand_as(still))  # the wrist goes first
    assert (result.trace.waypoints[-1, :, GRIP, 7:27] == still[0]).all()  # here the fingers have nothing to gain


def test_an_array_with_its_camera_is_an_observation(can_view: Observation, grasps: Grasps) -> None:
    """The table is fitted then, so the world differs; what happens in the camera frame is nearly the same."""
    how = {"weights": PENALTIES, "num_steps": 4}
    array = refine(grasps[:3], can_view.depth, Known(nearness), camera=can_view.camera, **how)
    given = refine(grasps[:3], can_view, Known(nearness), **how)
    torch.testing.assert_close(array.score_after, given.score_after, atol=0.05, rtol=0)
    assert array.grasps.frame == "camera"


# ranking


def test_grasps_are_ranked_by_each_rule() -> None:
    grasps, flag = Grasps(torch.eye(28)[3].expand(3, 10, 28), "world"), torch.ones(3, dtype=torch.bool)
    first, then, judged = torch.tensor([[0.5, 0.4, 0.3], [0.6, 0.9, 0.2], [0.1, 0.3, 0.95]])
    result = Refinement(grasps, first, then, flag, ~flag, {}, first, judged)
    assert {name: rank(result, name).tolist() for name in RANKINGS} == {
        "before": [0, 1, 2],
        "after": [1, 0, 2],
        "lesser": [0, 1, 2],
        "judge": [2, 1, 0],
        "mean": [2, 1, 0],
    }
    nowhere = replace(result, score_after=torch.tensor([torch.nan, 0.4, 0.5]))
    assert {name: rank(nowhere, name).tolist() for name in ("after", "lesser", "mean")} == {
        "after": [2, 1, 0],
        "lesser": [1, 2, 0],
        "mean": [2, 1, 0],
    }
    alone = replace(result, judge_before=None, judge_after=None)
    assert rank(alone, "mean").tolist() == [1, 0, 2]
    with pytest.raises(ValueError, match='ranking by "judge" needs a refinement with a judge'):
        rank(alone, "judge")
    with pytest.raises(ValueError, match="ranking 'best' is unknown, use one of before, after, lesser, judge, mean"):
        rank(alone, "best")


# the thesis' groups


@pytest.mark.parametrize(("group", "first"), [("A", 0), ("B", 7), ("C", 7)])
def test_the_thesis_ascent_moves_only_what_it_may(
    can_view: Observation, grasps: Grasps, hand: Hand, group: str, first: int
) -> None:
    evaluator = Known(lambda w: -10 * (w[..., :3] - TARGET).square().sum((1, 2)) + 0.05 * w[..., 7:27].sum((1, 2)))
    result = ascend(grasps, can_view, evaluator, group=group)
    assert result.accepted.all()
    assert (result.score_after > result.score_before).all()
    before, after = (g.to_frame("world", can_view.T_world_camera) for g in (grasps, result.grasps))
    torch.testing.assert_close(after.waypoints[:, :first], before.waypoints[:, :first], atol=1e-6, rtol=0)
    moved = (after.position - before.position).abs()
    assert 0 < float(moved.max()) <= HALF_CUBE + 1e-6 == pytest.approx(0.005, abs=1e-5)
    hand.check(after.joints, tolerance=1e-6)
    assert torch.equal(after.grasp_type, before.grasp_type)
    assert [GROUPS[name].num_steps for name in "ABC"] == [2, 2, 20]


def test_one_step_of_the_thesis_is_along_the_gradient(can_view: Observation, grasps: Grasps, hand: Hand) -> None:
    """Of joint angles that are standardised by 0.3 rad, by 0.01 of the gradient in these units, twice."""
    slope = torch.linspace(-1, 1, 20)
    result = ascend(grasps, can_view, Known(lambda w: (w[..., 7:27] * slope).sum((1, 2))), group="A")
    expected = hand.clamp(hand.clamp(grasps.joints + 0.01 * 0.09 * slope) + 0.01 * 0.09 * slope)
    torch.testing.assert_close(result.grasps.joints, expected, atol=1e-5, rtol=0)


def test_the_thesis_ascent_survives_what_is_no_number(can_view: Observation, grasps: Grasps) -> None:
    bad = grasps.grasp_type == grasps.grasp_type[0]

    def broken(waypoints: Tensor) -> Tensor:
        return nearness(waypoints) + torch.where(waypoints[:, 0, 27] == grasps.grasp_type[0], torch.nan, 0.0)

    result = ascend(grasps, can_view, Known(broken), group="A")
    assert torch.equal(result.failed, bad)
    assert torch.equal(result.accepted, ~bad)
    assert torch.equal(result.grasps.waypoints[bad], grasps.waypoints[bad])
    with pytest.raises(ValueError, match="group 'D' is unknown, use one of A, B, C"):
        ascend(grasps, can_view, Known(nearness), group="D")
    assert len(ascend(grasps[:0], can_view, Known(nearness)).grasps) == 0
    for step_size in (0.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match=f"step_size is {step_size}, expected a positive number"):
            ascend(grasps, can_view, Known(nearness), step_size=step_size)
    with pytest.raises(ValueError, match="evaluator known has no gradient in the grasps"):
        ascend(grasps, can_view, Known(lambda w: nearness(w.detach())))


@pytest.mark.parametrize(("group", "slope"), [("A", 30.0), ("C", 30.0), ("A", 3e4)])
def test_the_thesis_ascent_stays_where_there_was_a_number(
    can_view: Observation, grasps: Grasps, group: str, slope: float
) -> None:
    """The score breaks down a tenth of a millimetre on; a step is of thrice as many hundredths, or beyond at once."""
    start = grasps.to_frame("world", can_view.T_world_camera).to_frame("camera", can_view.aimed().T_world_camera)
    first = start.position[:, 9]

    def broken(waypoints: Tensor) -> Tensor:
        gone = (waypoints[:, 9, None, :3] - first).norm(dim=-1).amin(-1)
        return torch.where(gone > 1e-4, torch.nan, slope * waypoints[:, 9, 0] / 25)

    result = ascend(grasps, can_view, Known(broken), group=group)
    moved = (result.grasps.position[:, 9] - grasps.position[:, 9]).norm(dim=-1)
    assert torch.isfinite(result.score_after).all()
    assert float(moved.max()) < 1.01e-4
    assert result.failed.all() == (group == "C" or slope > 30)
    assert result.accepted.all() == (slope == 30)
    assert result.accepted.any() == (slope == 30)


# wrong calls


@pytest.mark.usefixtures("as_users_run_it")
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"variables": "wrist"}, "variables 'wrist' is unknown, use one of grip, uncoupled, waypoints"),
        ({"optimiser": "sgd"}, "optimiser 'sgd' is unknown, use one of adam, lbfgs, metropolis, random"),
        ({"num_steps": -1}, "num_steps is -1, expected a whole number, 0 or more"),
        ({"num_steps": 2.5}, r"num_steps is 2\.5, expected a whole number, 0 or more"),
        ({"margin": float("nan")}, "margin is nan, expected a number of log-odds"),
        ({"step_size": 1.5}, "a step_size of 1.5 leaves the trust region; give a share of it, above 0 and at most 1"),
        ({"step_size": 0.0}, "above 0 and at most 1"),
        ({"step_size": float("nan")}, "above 0 and at most 1"),
        ({"depth": np.ones((480, 640))}, "a depth array needs its camera"),
        ({"camera": "given"}, "give a camera with a depth array only; an Observation has its own"),
        ({"evaluator": "em22"}, "model 'em22' is unknown, did you mean em2"),
        ({"judge": "em22"}, "model 'em22' is unknown, did you mean em2"),
    ],
)
def test_wrong_calls_are_explained(
    grasps: Grasps, can_view: Observation, arguments: dict[str, object], message: str
) -> None:
    values = {"depth": can_view, "evaluator": Known(nearness), **arguments}
    if "camera" in arguments:
        values["camera"] = can_view.camera
    with pytest.raises(ValueError, match=message):
        refine(grasps, **values)


def test_wrong_weights_and_regions_are_explained() -> None:
    with pytest.raises(ValueError, match=r"the weight of table is -1\.0, expected 0 or more"):
        Weights(table=-1.0)
    with pytest.raises(ValueError, match=r"the trust region's wrist is inf, expected a positive number"):
        Region(wrist=float("inf"))


def test_joints_beyond_their_limits_are_refused(grasps: Grasps, can_view: Observation) -> None:
    waypoints = grasps.waypoints.clone()
    waypoints[0, 9, 8] = 3.0
    with pytest.raises(ValueError, match=r"joint thumb_mcp is at 3\.000 rad, outside its limits"):
        refine(Grasps(waypoints, "camera"), can_view, Known(nearness))


@pytest.mark.parametrize("said", ["world", "camera"])
def test_grasps_in_another_frame_than_they_say_are_refused(grasps: Grasps, can_view: Observation, said: str) -> None:
    other = {"world": "camera", "camera": "world"}[said]
    wrong = Grasps(grasps.to_frame(other, can_view.T_world_camera).waypoints, said)
    message = rf"the hand of grasp \d+ is 0\.\d\d m from the object at the grip, out of reach; .* in the {said} frame"
    with pytest.raises(ValueError, match=message):
        refine(wrong, can_view, Known(nearness))


@pytest.mark.parametrize("distance", [0.4, 0.45])
@pytest.mark.parametrize("said", ["world", "camera"])
def test_a_near_camera_does_not_hide_another_frame(distance: float, said: Frame) -> None:
    centre = np.array([0.0, 0.0, 0.04])
    view = synthetic.render("ball", np.full(3, 0.04), centre, look_at(centre, distance, 0.3, 0.8))
    given = synthetic.draw_grasps(centre, 12, np.random.default_rng(0))[0]
    for right in (given, given.to_frame("camera", view.T_world_camera)):
        assert not refine(right, view, Known(nearness), weights=NOTHING, num_steps=0).failed.any()
        if right.frame != said:
            with pytest.raises(ValueError, match=f"from the object at the grip, out of reach; .* in the {said} frame"):
                refine(Grasps(right.waypoints, said), view, Known(nearness), weights=NOTHING, num_steps=0)


def test_a_judge_that_guides_is_refused(grasps: Grasps, can_view: Observation, tmp_path: Path) -> None:
    first, second, third = (
        str(EMFK(width=16, num_blocks=1, image=False).save(tmp_path / f"{i}.safetensors")) for i in range(3)
    )
    some = Ensemble(members=[first, second])
    guided, recalibrated = Known(nearness), load(first)
    recalibrated.temperature.fill_(2.0)
    for evaluator, judge in (
        (guided, guided), (first, first), (first, recalibrated), (some, second), (first, some)
    ):  # fmt: skip
        with pytest.raises(ValueError, match="the judge is, or shares a member with, what guides"):
            refine(grasps, can_view, evaluator, judge=judge)
    refine(grasps[:2], can_view, some, judge=Ensemble(members=[third]), weights=NOTHING, num_steps=2)


def test_an_evaluator_without_gradients_serves_those_who_need_none(grasps: Grasps, can_view: Observation) -> None:
    blind = Known(lambda w: nearness(w.detach()))
    with pytest.raises(ValueError, match="evaluator known has no gradient in the grasps; use the optimiser metropolis"):
        refine(grasps, can_view, blind, weights=NOTHING)
    assert refine(grasps, can_view, blind, weights=NOTHING, optimiser="random").accepted.any()
    weight = torch.ones((), requires_grad=True)  # its own weights have a slope, the grasps have none
    with pytest.raises(ValueError, match="evaluator known has no gradient in the grasps"):
        refine(grasps, can_view, Known(lambda w: weight * nearness(w.detach())), weights=NOTHING)

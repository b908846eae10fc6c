"""Refinement on evaluators whose best grasp is known: what rises, what is accepted, and what stays."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import synthetic
import torch
from torch import Tensor

from dexzoo.generators import make_generator
from dexzoo.grasp import GRIP, Grasps, Trajectory
from dexzoo.hand import Hand
from dexzoo.models.batch import Encoding
from dexzoo.models.em_fk import EMFK
from dexzoo.models.ensemble import Ensemble
from dexzoo.models.evaluator import GraspEvaluator
from dexzoo.models.zoo import load
from dexzoo.perception import Observation, View
from dexzoo.perception.camera import look_at
from dexzoo.refinement import (
    OPTIMIZERS,
    RANKINGS,
    Refinement,
    Trace,
    TrustRegion,
    climb,
    rank,
    refine,
    refinement,
    terms,
)
from dexzoo.refinement.posed_hand import PosedHand
from dexzoo.refinement.terms import LogOdds, Penetration, Prior, Spread, Table, Term
from experiments.thesis_ascent import GROUPS, HALF_CUBE, ascend

Function = Callable[[Trajectory], Tensor]


class Known(GraspEvaluator):
    """Log-odds as a given function of trajectories (*batch,) in the frame of the aimed camera."""

    architecture = "known"

    def __init__(self, function: Function, spread: Function | None = None) -> None:
        super().__init__()
        self.function, self.spread = function, spread

    def encode(self, images: Tensor) -> Encoding:
        return {"views": torch.zeros(len(images))}

    def logit(self, encoding: Encoding, grasps: Trajectory) -> Tensor:
        return self.function(grasps)

    def logit_and_spread(self, encoding: Encoding, grasps: Trajectory) -> tuple[Tensor, Tensor]:
        logit = self.logit(encoding, grasps)
        return logit, torch.zeros_like(logit) if self.spread is None else self.spread(grasps)


TARGET = torch.tensor([0.0, 0.0, 0.3])
"""On the aimed camera's axis, on this side of the object."""


def grip(grasps: Trajectory) -> Tensor:
    """Places of the wrist at the grip."""
    return grasps.position[..., GRIP, :]


def nearness(grasps: Trajectory) -> Tensor:
    """Minus the squared distance, in decimeters, of the grip's wrist from the target."""
    return -100 * (grip(grasps) - TARGET).square().sum(-1)


def indifferent(grasps: Trajectory) -> Tensor:
    return 0 * grip(grasps).sum(-1)


def without_gradient(grasps: Trajectory) -> Tensor:
    return nearness(grasps.detach())


def refine_alone(grasps: Grasps, view: Observation, evaluator: GraspEvaluator, **options: object) -> Refinement:
    """Log-odds are the only term."""
    return refine(grasps, view, evaluator, terms=[LogOdds(evaluator)], **options)


def equal(a: Trajectory, b: Trajectory) -> bool:
    """Whether wrist, joints and type are the same to the bit."""
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in ("wrist", "joints", "grasp_type"))


def assert_close(a: Trajectory, b: Trajectory, tolerance: float) -> None:
    torch.testing.assert_close(a.wrist, b.wrist, atol=tolerance, rtol=0)
    torch.testing.assert_close(a.joints, b.joints, atol=tolerance, rtol=0)
    assert torch.equal(a.grasp_type, b.grasp_type)


def in_camera_frame(grasps: Grasps, view: Observation) -> Grasps:
    return grasps.transformed(np.linalg.inv(view.T_world_camera))


def in_aimed_frame(grasps: Grasps, view: Observation) -> Grasps:
    return in_camera_frame(grasps, view.aimed())


@pytest.fixture(scope="module")
def grasps(can_grasps: Grasps) -> Grasps:
    return can_grasps[:12]


@pytest.fixture(scope="module")
def improved(grasps: Grasps, can_view: Observation) -> Refinement:
    return refine(grasps, can_view, Known(nearness), prior=None)


def moved_up(grasps: Grasps, distance: Tensor) -> Grasps:
    """Each grasp moved as a whole."""
    wrist = grasps.wrist.clone()
    wrist[..., 2] += distance[:, None]
    return replace(grasps, wrist=wrist)


def lowered(grasps: Grasps, depth: float) -> Grasps:
    """Each grasp moved straight down, as a whole, until its grip reaches `depth` meters below the table."""
    links = grasps.wrist_pose[:, GRIP, None] @ grasps.hand.forward_kinematics(grasps.joints[:, GRIP])
    return moved_up(grasps, -grasps.hand.clearance(links, torch.tensor([0.0, 0, 1, 0])).amin(-1) - depth)


# what rises


def test_the_objective_rises(improved: Refinement, grasps: Grasps, can_view: Observation) -> None:
    assert improved.accepted.float().mean() > 0.8
    assert (improved.score_after > improved.score_before)[improved.accepted].float().mean() > 0.7
    evaluator = Known(nearness)
    torch.testing.assert_close(improved.score_before, evaluator.score(grasps, can_view), atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(improved.score_after, evaluator.score(improved.grasps, can_view), atol=1e-6, rtol=1e-5)
    assert improved.penalties.keys() == {"spread", "penetration", "shadow", "table", "self_collision"}
    given = refine(grasps, can_view, evaluator, prior=None, num_steps=0).penalties
    weight = {"spread": -1.0, "penetration": -50.0, "shadow": -15.0, "table": -300.0, "self_collision": -50.0}
    rise = improved.score_after.logit() - improved.score_before.logit()
    rise += sum(weight[name] * (left - given[name]) for name, left in improved.penalties.items())
    assert (rise[improved.accepted] > 0).all()
    assert improved.judge_after is improved.trace is None
    assert not improved.failed.any()


@pytest.mark.parametrize(("optimizer", "share"), [("adam", 0.9), ("lbfgs", 0.95), ("metropolis", 0.3), ("random", 0.3)])
def test_a_top_beyond_the_region_is_approached_to_its_border(
    can_view: Observation, grasps: Grasps, optimizer: str, share: float
) -> None:
    """The steepest way leads to the wrist's corner: 5 mm along each axis of the palm."""
    evaluator = Known(lambda g: 1000 * grip(g)[..., 0])
    region = TrustRegion(wrist=0.005)
    result = refine_alone(grasps, can_view, evaluator, optimizer=optimizer, num_steps=40, trust_region=region)
    direction = torch.tensor(can_view.aimed().T_world_camera[:3, 0], dtype=torch.float32)
    step = grip(result.grasps) - grip(grasps)
    most = 0.005 * (grasps.wrist_pose[:, GRIP, :3, :3].mT @ direction).abs().sum(-1)
    assert result.accepted.all()
    assert ((step @ direction) / most > share).all()
    assert ((step @ direction) / most < 1.001).all()


@pytest.mark.parametrize("optimizer", ["adam", "lbfgs"])
def test_a_top_within_the_region_is_found(can_view: Observation, grasps: Grasps, optimizer: str) -> None:
    T = torch.tensor(can_view.aimed().T_world_camera, dtype=torch.float32)
    top = grip(grasps) + torch.tensor([0.001, -0.002, 0.001])

    def nearer(aimed: Trajectory) -> Tensor:
        world = grip(aimed) @ T[:3, :3].T + T[:3, 3]
        return -1e5 * (world - top[: world.shape[-2]]).square().sum(-1)

    result = refine_alone(grasps, can_view, Known(nearer), optimizer=optimizer, num_steps=60, step_size=0.1)
    assert float((grip(result.grasps) - top).norm(dim=-1).max()) < 0.0003


def test_penalties_lift_a_grasp_out_of_the_table(can_view: Observation, grasps: Grasps) -> None:
    low = lowered(grasps, 0.003)
    given = refine(low, can_view, Known(indifferent), prior=None, num_steps=0).penalties["table"]
    assert float(given.min()) > 0.0045
    result = refine(low, can_view, Known(indifferent), prior=None)
    assert result.accepted.all()
    assert (result.penalties["table"] < 0.7 * given).float().mean() > 0.7
    torch.testing.assert_close(result.score_after, torch.full((12,), 0.5))


def test_the_spread_of_an_ensemble_is_avoided(can_view: Observation, grasps: Grasps) -> None:
    doubted = Known(lambda g: 30 * grip(g)[..., 0], lambda g: 45 * grip(g)[..., 0])
    left = refine_alone(grasps, can_view, doubted)
    right = refine(grasps, can_view, doubted, terms=[LogOdds(doubted), Spread(doubted)])
    assert "spread" not in left.penalties
    assert (left.score_after > left.score_before).all()
    assert (right.score_after < right.score_before).all()  # less likely to hold, but surer
    assert right.accepted.all()


def test_the_prior_draws_towards_the_demonstrations(can_view: Observation, grasps: Grasps, hand: Hand) -> None:
    view, evaluator = View(can_view), Known(indifferent)
    density = make_generator("kopicki", hand).density(view)
    assert density is not None
    result = refine(grasps, view, evaluator, terms=[LogOdds(evaluator), Prior(density, weight=1.0)])
    before, after = density.log_density(grasps), density.log_density(result.grasps)
    known = torch.isfinite(before)
    assert result.accepted[known].all()
    assert (after - before)[known].median() > 1
    torch.testing.assert_close(result.penalties["prior"][known], after[known], atol=1e-2, rtol=1e-3)
    made = refine(grasps[:2], view, evaluator, num_steps=2)  # makes the density itself
    given = refine(grasps[:2], view, evaluator, num_steps=2, prior=density)
    assert "prior" in made.penalties
    assert equal(made.grasps, given.grasps)


def test_terms_that_are_not_given_are_not_computed(
    can_view: Observation, grasps: Grasps, monkeypatch: pytest.MonkeyPatch
) -> None:
    for place, name in (
        (PosedHand, "nearest"), (Hand, "self_overlap"), (terms, "_lack_of_clearance"), (refinement, "make_generator"),
    ):  # fmt: skip
        monkeypatch.setattr(place, name, lambda *_, name=name, **__: pytest.fail(f"{name} was called"))
    result = refine_alone(grasps, can_view, Known(nearness), num_steps=4)
    assert result.penalties == {}
    assert result.accepted.all()


class Height(Term):
    """A term of one's own: height of the wrist at the grip, which may end below some bound only."""

    name = "height"

    def __init__(self, weight: float, most: float = np.inf) -> None:
        super().__init__(weight)
        self.most = most

    def near(self, view: View, hands: PosedHand) -> Callable[[PosedHand], Tensor]:
        return lambda moved: grip(moved.grasps)[:, 2]

    def accepts(self, view: View, hand: Hand, before: Trajectory, after: Trajectory) -> Tensor:
        return grip(after)[:, 2] < self.most


def test_a_term_of_ones_own_is_climbed_and_may_object(can_view: Observation, grasps: Grasps) -> None:
    evaluator = Known(nearness)
    higher = refine(grasps, can_view, evaluator, terms=[Height(5.0)])  # no other term, not even log-odds
    assert higher.accepted.all()
    assert (grip(higher.grasps) > grip(grasps))[:, 2].all()
    torch.testing.assert_close(higher.penalties["height"], grip(higher.grasps)[:, 2])
    torch.testing.assert_close(higher.score_after, evaluator.score(higher.grasps, can_view))
    lower = refine(grasps, can_view, evaluator, terms=[Height(-5.0)])
    assert (grip(lower.grasps) < grip(grasps))[:, 2].all()
    most = float(grip(higher.grasps)[:, 2].median())
    bounded = refine(grasps, can_view, evaluator, terms=[Height(5.0, most)])
    assert torch.equal(bounded.accepted, grip(higher.grasps)[:, 2] < most)
    assert equal(bounded.grasps[~bounded.accepted], grasps[~bounded.accepted])


# what is accepted


def test_a_judge_that_disagrees_keeps_the_grasps(can_view: Observation, grasps: Grasps) -> None:
    result = refine_alone(grasps, can_view, Known(nearness), judge=Known(lambda g: -nearness(g)))
    assert not result.accepted.any()
    assert equal(result.grasps, grasps)
    assert torch.equal(result.score_after, result.score_before)
    assert result.judge_before is not None
    assert result.judge_after is not None
    assert torch.equal(result.judge_after, result.judge_before)


def test_a_judge_decides_grasp_by_grasp_and_by_its_margin(can_view: Observation, grasps: Grasps) -> None:
    alone = refine_alone(grasps, can_view, Known(nearness))
    assert alone.accepted.all()
    judge = Known(lambda g: 100 * grip(g)[..., 1])
    opinion = [torch.logit(judge.score(g, can_view).double(), 1e-9) for g in (grasps, alone.grasps)]
    rise = opinion[1] - opinion[0]
    assert 0 < int((rise > 0).sum()) < len(grasps)
    for margin in (0.0, float(rise.sort().values[-3:-1].mean())):
        result = refine_alone(grasps, can_view, Known(nearness), judge=judge, margin=margin)
        assert torch.equal(result.accepted, rise > margin)
        for chosen, source in ((result.accepted, alone.grasps), (~result.accepted, grasps)):
            assert equal(result.grasps[chosen], source[chosen])
        assert result.judge_after is not None
        torch.testing.assert_close(result.judge_after, judge.score(result.grasps, can_view), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_nothing_changes_without_steps(can_view: Observation, grasps: Grasps, optimizer: str) -> None:
    result = refine(grasps, can_view, Known(nearness), prior=None, optimizer=optimizer, num_steps=0)
    assert equal(result.grasps, grasps)
    assert not result.accepted.any()
    assert torch.equal(result.score_after, result.score_before)


@pytest.mark.parametrize("asked", [True, False])
def test_a_way_into_the_table_is_not_accepted(can_view: Observation, grasps: Grasps, hand: Hand, asked: bool) -> None:
    """The evaluator wants the hand lower, by more than there is room for; the climb itself hardly minds the table."""
    given = lowered(grasps, -0.005)
    down = torch.tensor(can_view.aimed().T_world_camera[2, :3], dtype=torch.float32)
    low = Known(lambda g: -1000 * (grip(g) @ down))
    result = refine(given, can_view, low, terms=[LogOdds(low), *([Table(weight=-1e-9)] if asked else [])])
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
    result = refine_alone(grasps, can_view, Known(lambda g: 2 * nearness(g.detach()) - nearness(g)))
    assert not result.accepted.any()
    assert equal(result.grasps, grasps)
    assert result.grasps.log_likelihood is not None
    assert grasps.log_likelihood is not None
    assert torch.equal(result.grasps.log_likelihood, grasps.log_likelihood)


# numbers that are none


def broken_for(grasp_type: Tensor) -> Known:
    """Nearness, but NaN for one type of grasp."""
    return Known(lambda g: nearness(g) + torch.where(g.grasp_type == grasp_type, torch.nan, 0.0))


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_a_grasp_without_a_score_is_as_given(can_view: Observation, grasps: Grasps, optimizer: str) -> None:
    bad = grasps.grasp_type == grasps.grasp_type[0]
    broken = broken_for(grasps.grasp_type[0])
    result = refine(grasps, can_view, broken, prior=None, optimizer=optimizer, num_steps=6)
    assert 0 < int(bad.sum()) < len(grasps)
    assert torch.equal(result.failed, bad)
    assert not result.accepted[bad].any()
    assert result.accepted[~bad].any()
    assert equal(result.grasps[bad], grasps[bad])


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_a_score_that_breaks_down_in_mid_run_leaves_the_last_good_state(
    can_view: Observation, grasps: Grasps, optimizer: str
) -> None:
    first = grip(in_aimed_frame(grasps, can_view))

    def broken(aimed: Trajectory) -> Tensor:
        gone = (grip(aimed)[..., None, :] - first).norm(dim=-1).amin(-1)
        return torch.where(gone > 0.002, torch.nan, nearness(aimed))

    region = TrustRegion(wrist=0.005, turn=0.05)
    result = refine_alone(grasps, can_view, Known(broken), optimizer=optimizer, trust_region=region)
    assert result.failed.float().mean() > 0.5
    assert result.accepted.any()
    assert float((grip(result.grasps) - grip(grasps)).norm(dim=-1).max()) < 0.00201
    assert torch.isfinite(result.score_after).all()
    assert (result.score_after >= result.score_before).all()


def test_a_gradient_that_is_no_number_does_no_harm(can_view: Observation, grasps: Grasps) -> None:
    def kinked(aimed: Trajectory) -> Tensor:
        """Zero, with a gradient that is infinite times zero."""
        return (0 * aimed.wrist).abs().sum((-1, -2)).sqrt()

    result = refine_alone(grasps, can_view, Known(kinked), num_steps=3)
    assert result.failed.all()
    assert equal(result.grasps, grasps)


# form


def state(trace: Trace, step: int | Tensor) -> Trajectory:
    """The grasps at one step, or each at a step of its own."""
    place = step, torch.arange(trace.objective.shape[1])
    return Trajectory(trace.grasps.wrist[place], trace.grasps.joints[place], trace.grasps.grasp_type[place])


def test_the_trace_starts_with_grasps_that_are_not_of_keyframes(can_view: Observation, grasps: Grasps) -> None:
    wrist = grasps.wrist.clone()
    wrist[:, 3, :3] += 0.003
    given = replace(grasps, wrist=wrist)
    result = refine_alone(given, can_view, Known(nearness), num_steps=2, keep_trace=True)
    assert result.trace is not None
    assert equal(state(result.trace, 0), given)


def test_double_precision_serves_as_well(can_view: Observation, grasps: Grasps) -> None:
    torch.manual_seed(0)
    model = EMFK(width=16, num_blocks=1, image=False)
    double = grasps.to(torch.float64)
    torch.testing.assert_close(model.score(double, can_view), model.score(grasps, can_view))
    for run in (partial(refine, prior=None, num_steps=4, keep_trace=True), ascend):
        single, result = (run(g, can_view, model) for g in (grasps, double))
        assert result.grasps.wrist.dtype == result.grasps.joints.dtype == torch.float64
        assert torch.equal(result.accepted, single.accepted)
        assert_close(result.grasps.to(torch.float32), single.grasps, 1e-4)


@pytest.mark.parametrize("judge", [None, Known(nearness)])
def test_no_grasps(can_view: Observation, hand: Hand, judge: Known | None) -> None:
    none = Grasps.none(hand)
    result = refine(none, can_view, Known(nearness), judge=judge)
    assert len(result.grasps) == 0
    assert result.grasps.hand == hand
    assert result.accepted.shape == result.score_after.shape == result.failed.shape == (0,)
    assert (result.judge_after is None) == (judge is None)
    assert set(result.penalties) == {"spread", "prior", "penetration", "shadow", "table", "self_collision"}
    assert all(value.shape == (0,) for value in result.penalties.values())
    assert len(rank(result)) == 0
    assert result.trace is None
    trace = refine(none, can_view, Known(nearness), prior=None, num_steps=3, keep_trace=True).trace
    assert trace is not None
    assert trace.grasps.wrist.shape == (4, 0, 10, 7)
    assert trace.objective.shape == (4, 0)


def test_where_the_world_has_its_origin_makes_no_difference(grasps: Grasps, can_view: Observation) -> None:
    T_other_world = np.array([[0.8, -0.6, 0, 0.3], [0.6, 0.8, 0, -0.2], [0, 0, 1, 0], [0, 0, 0, 1]])
    T_other_camera = T_other_world @ can_view.T_world_camera
    other = Observation(can_view.depth, can_view.camera, T_other_camera, mask=can_view.mask)
    run = partial(refine, evaluator=Known(nearness), prior=None, num_steps=8)
    here, there = run(grasps, can_view), run(grasps.transformed(T_other_world), other)
    assert here.accepted.any()
    assert_close(there.grasps.transformed(np.linalg.inv(T_other_world)), here.grasps, 1e-4)


def test_an_observation_may_be_prepared_beforehand(grasps: Grasps, can_view: Observation) -> None:
    run = partial(refine, grasps, evaluator=Known(nearness), prior=None, num_steps=4)
    given, view = run(observation=can_view), View(can_view)
    for _ in range(2):  # what the view has kept changes nothing
        assert equal(run(observation=view).grasps, given.grasps)


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_the_result_does_not_depend_on_the_company(grasps: Grasps, can_view: Observation, optimizer: str) -> None:
    run = partial(refine, evaluator=Known(nearness), prior=None, optimizer=optimizer, num_steps=5)
    together, few = run(grasps, can_view), run(grasps[:5], can_view)
    assert_close(few.grasps, together.grasps[:5], 1e-5)
    assert torch.equal(few.accepted, together.accepted[:5])
    assert equal(run(grasps, can_view).grasps, together.grasps)
    assert equal(run(grasps, can_view, seed=1).grasps, together.grasps) == (optimizer in ("adam", "lbfgs"))


def test_many_grasps_are_refined_in_pieces(
    grasps: Grasps, can_view: Observation, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = partial(refine, grasps, can_view, Known(nearness), prior=None, num_steps=4, keep_trace=True)
    together = run()
    monkeypatch.setattr(climb, "CHUNK", 5)
    sizes: list[int] = []
    threads = torch.get_num_threads()
    pieces = run(on_step=lambda _, value: sizes.append(len(value)))
    assert_close(pieces.grasps, together.grasps, 1e-5)
    assert together.trace is not None
    assert pieces.trace is not None
    torch.testing.assert_close(pieces.trace.objective, together.trace.objective, atol=1e-4, rtol=1e-4)
    assert sizes == [4] * 15
    assert torch.get_num_threads() == threads


def test_progress_is_told_and_the_whole_way_kept(can_view: Observation, grasps: Grasps) -> None:
    told: list[tuple[int, Tensor]] = []
    result = refine_alone(
        grasps, can_view, Known(nearness), num_steps=7, keep_trace=True,
        on_step=lambda step, value: told.append((step, value)),
    )  # fmt: skip
    assert [step for step, _ in told] == list(range(8))
    assert result.trace is not None
    states = result.trace.grasps
    assert states.wrist.shape == (8, 12, 10, 7)
    assert states.joints.shape == (8, 12, 10, 20)
    assert torch.equal(result.trace.objective, torch.stack([value for _, value in told]))
    assert equal(state(result.trace, 0), grasps)
    assert_close(state(result.trace, result.trace.objective.argmax(0)), result.grasps, 1e-5)
    still = states.joints[1:5, :, GRIP]
    torch.testing.assert_close(still, still[:1].expand_as(still))  # the wrist goes first
    assert (states.joints[-1, :, GRIP] == still[0]).all()  # here the fingers have nothing to gain


def test_an_array_with_its_camera_is_an_observation(can_view: Observation, grasps: Grasps) -> None:
    """The table is fitted then, so the world differs; the grasps are nearly the same in the camera's frame."""
    fitted = Observation(can_view.depth, can_view.camera)
    there = in_camera_frame(grasps[:3], can_view).transformed(fitted.T_world_camera)
    run = partial(refine, evaluator=Known(nearness), prior=None, num_steps=4)
    array, given = run(there, can_view.depth, camera=can_view.camera), run(grasps[:3], can_view)
    torch.testing.assert_close(array.score_after, given.score_after, atol=0.05, rtol=0)
    assert equal(array.grasps, run(there, fitted).grasps)


# ranking


def test_grasps_are_ranked_by_each_rule(grasps: Grasps) -> None:
    flag = torch.ones(3, dtype=torch.bool)
    first, then, judged = torch.tensor([[0.5, 0.4, 0.3], [0.6, 0.9, 0.2], [0.1, 0.3, 0.95]])
    result = Refinement(grasps[:3], first, then, flag, ~flag, {}, first, judged)
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
    def slope(aimed: Trajectory) -> Tensor:
        return -10 * (aimed.position - TARGET).square().sum((-1, -2)) + 0.05 * aimed.joints.sum((-1, -2))

    result = ascend(grasps, can_view, Known(slope), group=group)
    assert result.accepted.all()
    assert (result.score_after > result.score_before).all()
    still = range(first)
    assert_close(result.grasps.trajectory.waypoint(still), grasps.trajectory.waypoint(still), 1e-6)
    moved = (result.grasps.position - grasps.position).abs()
    assert 0 < float(moved.max()) <= HALF_CUBE + 1e-6 == pytest.approx(0.005, abs=1e-5)
    hand.check(result.grasps.joints, tolerance=1e-6)
    assert torch.equal(result.grasps.grasp_type, grasps.grasp_type)
    assert [GROUPS[name].num_steps for name in "ABC"] == [2, 2, 20]


def test_one_step_of_the_thesis_is_along_the_gradient(can_view: Observation, grasps: Grasps, hand: Hand) -> None:
    """Of joint angles that are standardized by 0.3 rad, by 0.01 of the gradient in these units, twice."""
    slope = torch.linspace(-1, 1, 20)
    result = ascend(grasps, can_view, Known(lambda g: (g.joints * slope).sum((-1, -2))), group="A")
    expected = hand.clamp(hand.clamp(grasps.joints + 0.01 * 0.09 * slope) + 0.01 * 0.09 * slope)
    torch.testing.assert_close(result.grasps.joints, expected, atol=1e-5, rtol=0)


def test_the_thesis_ascent_survives_what_is_no_number(can_view: Observation, grasps: Grasps) -> None:
    bad = grasps.grasp_type == grasps.grasp_type[0]
    result = ascend(grasps, can_view, broken_for(grasps.grasp_type[0]), group="A")
    assert torch.equal(result.failed, bad)
    assert torch.equal(result.accepted, ~bad)
    assert equal(result.grasps[bad], grasps[bad])
    with pytest.raises(ValueError, match="group 'D' is unknown, use one of A, B, C"):
        ascend(grasps, can_view, Known(nearness), group="D")
    assert len(ascend(grasps[:0], can_view, Known(nearness)).grasps) == 0
    for step_size in (0.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match=f"step_size is {step_size}, expected a positive number"):
            ascend(grasps, can_view, Known(nearness), step_size=step_size)
    with pytest.raises(ValueError, match="evaluator known has no gradient in the grasps"):
        ascend(grasps, can_view, Known(without_gradient))


@pytest.mark.parametrize(("group", "slope"), [("A", 30.0), ("C", 30.0), ("A", 3e4)])
def test_the_thesis_ascent_stays_where_there_was_a_number(
    can_view: Observation, grasps: Grasps, group: str, slope: float
) -> None:
    """The score breaks down a tenth of a millimeter on; a step is of thrice as many hundredths, or beyond at once."""
    first = in_aimed_frame(grasps, can_view).position[:, 9]

    def broken(aimed: Trajectory) -> Tensor:
        there = aimed.position[..., 9, :]
        gone = (there[..., None, :] - first).norm(dim=-1).amin(-1)
        return torch.where(gone > 1e-4, torch.nan, slope * there[..., 0] / 25)

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
        ({"prior": "kopiki"}, "prior 'kopiki' is unknown, use kopicki, a density or None"),
        ({"optimizer": "sgd"}, "optimizer 'sgd' is unknown, use one of adam, lbfgs, metropolis, random"),
        ({"num_steps": -1}, "num_steps is -1, expected a whole number, 0 or more"),
        ({"num_steps": 2.5}, r"num_steps is 2\.5, expected a whole number, 0 or more"),
        ({"margin": float("nan")}, "margin is nan, expected a number of log-odds"),
        ({"step_size": 1.5}, "a step_size of 1.5 leaves the trust region; give a share of it, above 0 and at most 1"),
        ({"step_size": 0.0}, "above 0 and at most 1"),
        ({"step_size": float("nan")}, "above 0 and at most 1"),
        ({"observation": np.ones((480, 640))}, "a depth array needs its camera"),
        ({"camera": "given"}, "give a camera with a depth array only; an Observation has its own"),
        ({"evaluator": "em22"}, "model 'em22' is unknown, did you mean em2"),
        ({"judge": "em22"}, "model 'em22' is unknown, did you mean em2"),
        ({"terms": []}, "the terms are none; give at least one, each with a name of its own"),
        ({"terms": [Penetration(), Penetration()]}, "the terms are penetration, penetration; give at least one"),
    ],
)
def test_wrong_calls_are_explained(
    grasps: Grasps, can_view: Observation, arguments: dict[str, object], message: str
) -> None:
    values = {"observation": can_view, "evaluator": Known(nearness), **arguments}
    if "camera" in arguments:
        values["camera"] = can_view.camera
    with pytest.raises(ValueError, match=message):
        refine(grasps, **values)


def test_wrong_weights_and_regions_are_explained() -> None:
    for weight in (float("nan"), float("inf")):
        with pytest.raises(ValueError, match=f"the weight of table is {weight}, expected a finite number"):
            Table(weight)
    with pytest.raises(ValueError, match=r"the trust region's wrist is inf, expected a positive number"):
        TrustRegion(wrist=float("inf"))


def test_joints_beyond_their_limits_are_refused(grasps: Grasps, can_view: Observation) -> None:
    joints = grasps.joints.clone()
    joints[0, 9, 1] = 3.0
    with pytest.raises(ValueError, match=r"joint thumb_mcp is at 3\.000 rad, outside its limits"):
        refine(replace(grasps, joints=joints), can_view, Known(nearness))


def test_grasps_in_the_frame_of_the_camera_are_refused(grasps: Grasps, can_view: Observation) -> None:
    message = (
        r"the hand of grasp \d+ is 0\.\d\d m from the object at the grip, out of reach; grasps must be in the world"
    )
    with pytest.raises(ValueError, match=message):
        refine(in_camera_frame(grasps, can_view), can_view, Known(nearness))


@pytest.mark.parametrize("distance", [0.4, 0.45])
def test_a_near_camera_does_not_hide_another_frame(distance: float) -> None:
    center = np.array([0.0, 0.0, 0.04])
    view = synthetic.render("ball", np.full(3, 0.04), center, look_at(center, distance, 0.3, 0.8))
    given = synthetic.draw_grasps(center, 12, np.random.default_rng(0))[0]
    assert not refine_alone(given, view, Known(nearness), num_steps=0).failed.any()
    with pytest.raises(ValueError, match=r"from the object at the grip, out of reach; .* in the world frame"):
        refine_alone(in_camera_frame(given, view), view, Known(nearness), num_steps=0)


def test_a_hand_that_an_evaluator_does_not_know_is_refused(grasps: Grasps, can_view: Observation) -> None:
    left = Grasps.of(grasps.trajectory, Hand.load(side="left"))
    message = r"evaluator known knows the hand dlr2 \(right\), not dlr2 \(left\)"
    for run in (refine, ascend):
        with pytest.raises(ValueError, match=message):
            run(left, can_view, Known(nearness))
    ambidextrous = Known(nearness)
    ambidextrous.known_hands.append(left.hand)
    with pytest.raises(ValueError, match=message):
        refine(left, can_view, ambidextrous, judge=Known(nearness))
    result = refine(left, can_view, ambidextrous, prior=None, num_steps=2)
    assert result.grasps.hand == left.hand
    assert result.accepted.any()


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
    refine_alone(grasps[:2], can_view, some, judge=Ensemble(members=[third]), num_steps=2)


def test_an_evaluator_without_gradients_serves_those_who_need_none(grasps: Grasps, can_view: Observation) -> None:
    blind = Known(without_gradient)
    with pytest.raises(ValueError, match="evaluator known has no gradient in the grasps; use the optimizer metropolis"):
        refine_alone(grasps, can_view, blind)
    assert refine_alone(grasps, can_view, blind, optimizer="random").accepted.any()
    weight = torch.ones((), requires_grad=True)  # its own weights have a slope, the grasps have none
    with pytest.raises(ValueError, match="evaluator known has no gradient in the grasps"):
        refine_alone(grasps, can_view, Known(lambda g: weight * without_gradient(g)))

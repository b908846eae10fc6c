"""Refinement on evaluators whose best grasp is known: what rises, what may move, and what stays."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from dexzoo import refinement, rotation
from dexzoo.camera import Observation
from dexzoo.grasp import GRIP, PREGRASP, SQUEEZE, Grasps
from dexzoo.hand import Hand
from dexzoo.models.evaluator import GraspEvaluator, Scene
from dexzoo.refinement import CUBE, JOINT_REGION, TURN_REGION, WEIGHTS, WRIST_REGION, Refinement, move, refine


class Known(GraspEvaluator):
    """Log-odds as a given function of the waypoints (grasp, 10, 28) in the frame of the aimed camera."""

    architecture = "known"

    def __init__(self, function: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.function = function

    def encode(self, images: Tensor) -> Scene:
        return {"views": torch.zeros(len(images))}

    def logit(self, scene: Scene, grasps: Tensor) -> Tensor:
        return self.function(grasps.flatten(0, 1)).unflatten(0, grasps.shape[:2])


TARGET = torch.tensor([0.0, 0.0, 0.3])
"""On the aimed camera's axis, on this side of the object."""


def nearness(waypoints: Tensor) -> Tensor:
    """Minus the squared distance, in decimetres, of the grip's wrist from the target."""
    return -100 * (waypoints[:, GRIP, :3] - TARGET).square().sum(-1)


def indifferent(waypoints: Tensor) -> Tensor:
    return 0 * waypoints.sum((1, 2))


@pytest.fixture(scope="module")
def grasps(can_grasps: Grasps) -> Grasps:
    return can_grasps[:12]


@pytest.fixture(scope="module")
def by_grip(grasps: Grasps, can_view: Observation) -> Refinement:
    return refine(grasps, can_view, Known(nearness))


def lowered(grasps: Grasps, view: Observation, hand: Hand, depth: float) -> Grasps:
    """Each grasp moved straight down, as a whole, until its grip reaches `depth` metres below the table."""
    world = grasps.to_frame("world", view.T_world_camera)
    table = torch.tensor([0.0, 0.0, 1.0, 0.0])
    links = world.wrist_pose[:, GRIP, None] @ hand.forward_kinematics(world.joints[:, GRIP])
    waypoints = world.waypoints.clone()
    waypoints[..., 2] -= (hand.clearance(links, table).amin(-1) + depth)[:, None]
    return Grasps(waypoints, "world")


# the grip's own freedoms


def test_the_score_rises(by_grip: Refinement, grasps: Grasps, can_view: Observation) -> None:
    assert by_grip.accepted.float().mean() > 0.8
    # here and there some of the score is paid for less penetration
    assert (by_grip.score_after > by_grip.score_before)[by_grip.accepted].float().mean() > 0.7
    before = refine(grasps, can_view, Known(nearness), num_steps=0).penalties
    fall = sum(WEIGHTS[name] * (before[name] - after) for name, after in by_grip.penalties.items())
    assert (by_grip.score_after.logit() - by_grip.score_before.logit() + fall)[by_grip.accepted].gt(0).all()
    evaluator = Known(nearness)
    torch.testing.assert_close(by_grip.score_before, evaluator.score(can_view, grasps), atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(by_grip.score_after, evaluator.score(can_view, by_grip.grasps), atol=1e-6, rtol=1e-5)


def test_a_free_grasp_goes_to_the_corner_of_its_region(can_view: Observation, grasps: Grasps) -> None:
    """Without penalties at stake the steepest way is taken: nearer by almost the whole 5 mm along each axis."""
    world = grasps.to_frame("world", can_view.T_world_camera)
    waypoints = world.waypoints.clone()
    waypoints[..., 2] += 0.5  # far above all that could be hit
    result = refine(Grasps(waypoints, "world"), can_view, Known(lambda w: 1000 * w[:, GRIP, 0]))
    step = (result.grasps.position[:, GRIP] - waypoints[:, GRIP, :3]).norm(dim=-1)
    assert result.accepted.all()
    assert float(step.min()) > 0.004
    torch.testing.assert_close(result.penalties["table"], torch.zeros(len(grasps)))


def test_the_grip_stays_in_its_trust_region(
    by_grip: Refinement, grasps: Grasps, hand: Hand, can_view: Observation
) -> None:
    before, after = (g.to_frame("world", can_view.T_world_camera) for g in (grasps, by_grip.grasps))
    inverse = rotation.conjugate(before.quaternion[:, GRIP])
    moved = rotation.rotate(inverse, after.position[:, GRIP] - before.position[:, GRIP])
    turned = rotation.log(rotation.multiply(inverse, after.quaternion[:, GRIP]))
    assert float(moved.abs().max()) <= WRIST_REGION + 1e-6 == pytest.approx(0.005, abs=1e-5)
    assert float(turned.abs().max()) <= TURN_REGION + 1e-5 == pytest.approx(0.05, abs=1e-4)
    change = after.joints - before.joints
    assert float(change.abs().max()) <= JOINT_REGION + 1e-6 == pytest.approx(0.1, abs=1e-5)
    assert float(moved.abs().max()) > 1e-3
    torch.testing.assert_close(after.joints[:, PREGRASP], before.joints[:, PREGRASP])
    torch.testing.assert_close(change[:, GRIP], change[:, SQUEEZE], atol=0.1, rtol=0)
    hand.check(after.joints, tolerance=1e-6)
    torch.testing.assert_close(after.joints, hand.expand(hand.reduce(after.joints)))
    torch.testing.assert_close(after.quaternion.norm(dim=-1), torch.ones(len(grasps), 10))
    assert torch.equal(after.grasp_type, before.grasp_type)


def test_the_whole_path_is_carried_rigidly(by_grip: Refinement, grasps: Grasps) -> None:
    step = by_grip.grasps.wrist_pose.double() @ torch.linalg.inv(grasps.wrist_pose.double())
    torch.testing.assert_close(step, step[:, GRIP, None].expand_as(step), atol=2e-6, rtol=0)


def test_move_is_differentiable(grasps: Grasps, hand: Hand) -> None:
    waypoints = grasps[:2].waypoints.double()
    # away from the limits, where the joints are clamped
    middle = hand.expand((hand.reduce(hand.lower) + hand.reduce(hand.upper)).double() / 2)
    waypoints[..., 7:27] = middle
    generator = torch.Generator().manual_seed(0)
    wrist = (0.01 * torch.randn(2, 6, generator=generator, dtype=torch.float64)).requires_grad_()
    freedoms = (0.01 * torch.randn(2, 15, generator=generator, dtype=torch.float64)).requires_grad_()
    assert gradcheck(lambda a, b: move(waypoints, a, b, hand), (wrist, freedoms))


def test_move_by_nothing_changes_nothing(grasps: Grasps, hand: Hand) -> None:
    still = move(grasps.waypoints, torch.zeros(12, 6), torch.zeros(12, 15), hand)
    torch.testing.assert_close(still, grasps.waypoints, atol=1e-6, rtol=0)


def test_joints_stop_at_their_limits(grasps: Grasps, hand: Hand) -> None:
    far = move(grasps.waypoints, torch.zeros(12, 6), torch.full((12, 15), 10.0), hand)
    upper = hand.expand(hand.reduce(hand.upper))
    torch.testing.assert_close(far[:, GRIP:, 7:27], upper.expand(12, 4, 20))


# penalties


def test_penalties_lift_a_grasp_out_of_the_table(can_view: Observation, grasps: Grasps, hand: Hand) -> None:
    low = lowered(grasps, can_view, hand, 0.003)
    given = refine(low, can_view, Known(indifferent), num_steps=0).penalties["table"]
    assert float(given.min()) > 0.0025
    result = refine(low, can_view, Known(indifferent))
    assert result.accepted.all()
    assert (result.penalties["table"] < given - 1e-3).float().mean() > 0.7
    torch.testing.assert_close(result.score_after, torch.full((12,), 0.5))


def test_penalties_measure_metres_and_radians(can_view: Observation, grasps: Grasps, hand: Hand) -> None:
    waypoints = lowered(grasps, can_view, hand, 0.007).waypoints.clone()
    waypoints[:, 9, 8] = hand.upper[1] + 0.0005  # within the tolerance of what is refused
    given = Grasps(waypoints, "world")
    penalties = refine(given, can_view, Known(indifferent), variables="last3", num_steps=0).penalties
    assert penalties.keys() == {"table", "penetration", "limits"}
    assert (penalties["table"] >= 0.007 - 1e-5).all()
    torch.testing.assert_close(penalties["limits"], torch.full((12,), 0.0005), atol=1e-6, rtol=0)
    assert all(value.shape == (12,) for value in penalties.values())


def test_penetration_is_the_depth_of_a_point_in_the_hand(can_view: Observation, grasps: Grasps, hand: Hand) -> None:
    """The palm is set on the can: the deepest of all points, computed in float64 with one link at a time."""
    world = grasps.to_frame("world", can_view.T_world_camera)
    waypoints = world.waypoints.clone()
    waypoints[..., :3] = torch.from_numpy(can_view.points_world).mean(0)
    inside = Grasps(waypoints, "world")
    found = refine(inside, can_view, Known(indifferent), num_steps=0).penalties["penetration"]
    points = torch.from_numpy(can_view.points_world).double()
    links = inside.wrist_pose[:, :7:2, None].double() @ hand.forward_kinematics(inside.joints[:, :7:2].double())
    deepest = -torch.stack([torch.stack([hand.signed_distance(p, points).amin() for p in poses]) for poses in links])
    assert (found < deepest.amax(1) + 1e-6).all()
    assert (found > deepest[:, -1] - 0.006).all()  # one point in 34 is looked at
    assert (found > 0.01).all()


# the thesis' ascent


@pytest.mark.parametrize(("variables", "first"), [("waypoints", 0), ("last3", 7)])
def test_the_ascent_moves_only_what_it_may(
    can_view: Observation, grasps: Grasps, hand: Hand, variables: str, first: int
) -> None:
    evaluator = Known(lambda w: -10 * (w[..., :3] - TARGET).square().sum((1, 2)))
    result = refine(grasps, can_view, evaluator, variables=variables, num_steps=10)
    assert result.accepted.all()
    assert (result.score_after > result.score_before).all()
    before, after = (g.to_frame("world", can_view.T_world_camera) for g in (grasps, result.grasps))
    torch.testing.assert_close(after.waypoints[:, :first], before.waypoints[:, :first], atol=1e-6, rtol=0)
    moved = (after.position - before.position).abs()
    assert float(moved.max()) <= CUBE + 1e-6 == pytest.approx(0.005, abs=1e-5)
    assert (moved[:, first:].amax((1, 2)) > 1e-3).all()
    torch.testing.assert_close(after.quaternion.norm(dim=-1), torch.ones(len(grasps), 10))
    hand.check(after.joints, tolerance=1e-6)
    assert torch.equal(after.grasp_type, before.grasp_type)


def test_the_ascent_keeps_joints_within_their_limits(can_view: Observation, grasps: Grasps, hand: Hand) -> None:
    result = refine(grasps, can_view, Known(lambda w: w[..., 7:27].sum((1, 2))), variables="waypoints", num_steps=99)
    torch.testing.assert_close(result.grasps.joints, hand.upper.expand(12, 10, 20))


# what is handed back


@pytest.mark.parametrize("variables", ["grip", "waypoints", "last3"])
def test_nothing_changes_without_steps(can_view: Observation, grasps: Grasps, variables: str) -> None:
    result = refine(grasps, can_view, Known(nearness), variables=variables, num_steps=0)
    assert torch.equal(result.grasps.waypoints, grasps.waypoints)
    assert not result.accepted.any()
    assert torch.equal(result.score_after, result.score_before)


@pytest.mark.parametrize("variables", ["grip", "waypoints"])
def test_a_nan_score_leaves_its_grasp_as_given(can_view: Observation, grasps: Grasps, variables: str) -> None:
    def broken(waypoints: Tensor) -> Tensor:
        return nearness(waypoints) + torch.where(waypoints[:, 0, 27] == grasps.grasp_type[0], torch.nan, 0.0)

    result = refine(grasps, can_view, Known(broken), variables=variables, num_steps=5)
    bad = grasps.grasp_type == grasps.grasp_type[0]
    assert 0 < int(bad.sum()) < len(grasps)
    assert not result.accepted[bad].any()
    assert result.accepted[~bad].any()
    assert torch.equal(result.grasps.waypoints[bad], grasps.waypoints[bad])


@pytest.mark.parametrize("variables", ["grip", "waypoints"])
def test_a_nan_or_infinite_gradient_does_no_harm(can_view: Observation, grasps: Grasps, variables: str) -> None:
    def kinked(waypoints: Tensor) -> Tensor:
        """Zero, with a gradient that is infinite times zero."""
        return (0 * waypoints[..., :7]).abs().sum((1, 2)).sqrt()

    result = refine(grasps, can_view, Known(kinked), variables=variables, num_steps=3)
    kept = ~result.accepted
    assert torch.equal(result.grasps.waypoints[kept], grasps.waypoints[kept])
    assert torch.isfinite(result.grasps.waypoints).all()


def test_what_is_not_accepted_is_handed_back_itself(can_view: Observation, grasps: Grasps) -> None:
    """The gradient points away from what is better."""
    result = refine(
        grasps,
        can_view,
        Known(lambda w: nearness(w).detach() - nearness(w) + nearness(w).detach()),
        variables="waypoints",
        num_steps=3,
    )
    assert not result.accepted.any()
    assert torch.equal(result.grasps.waypoints, grasps.waypoints)
    assert torch.equal(result.score_after, result.score_before)
    assert result.grasps.log_likelihood is not None
    assert torch.equal(result.grasps.log_likelihood, grasps.log_likelihood)


@pytest.mark.parametrize("variables", ["grip", "last3"])
def test_no_grasps(can_view: Observation, variables: str) -> None:
    none = Grasps(torch.zeros(0, 10, 28), "camera")
    result = refine(none, can_view, Known(nearness), variables=variables)
    assert len(result.grasps) == 0
    assert result.grasps.frame == "camera"
    assert result.accepted.shape == result.score_after.shape == result.penalties["table"].shape == (0,)


def test_both_frames_give_the_same(by_grip: Refinement, grasps: Grasps, can_view: Observation) -> None:
    world = refine(grasps.to_frame("world", can_view.T_world_camera), can_view, Known(nearness))
    assert by_grip.grasps.frame == "camera"
    assert world.grasps.frame == "world"
    back = world.grasps.to_frame("camera", can_view.T_world_camera)
    torch.testing.assert_close(back.waypoints, by_grip.grasps.waypoints, atol=1e-3, rtol=0)
    torch.testing.assert_close(world.score_after, by_grip.score_after, atol=1e-3, rtol=0)


@pytest.mark.parametrize("variables", ["grip", "waypoints"])
def test_the_result_does_not_depend_on_the_company(
    grasps: Grasps, can_view: Observation, variables: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    together = refine(grasps, can_view, Known(nearness), variables=variables, num_steps=5)
    monkeypatch.setattr(refinement, "_CHUNK", 5)
    pieces = refine(grasps, can_view, Known(nearness), variables=variables, num_steps=5)
    alone = refine(grasps[3], can_view, Known(nearness), variables=variables, num_steps=5)
    for other, rows in ((pieces, slice(None)), (alone, slice(3, 4))):
        torch.testing.assert_close(other.grasps.waypoints, together.grasps.waypoints[rows], atol=1e-6, rtol=0)
        torch.testing.assert_close(other.score_after, together.score_after[rows])
        assert torch.equal(other.accepted, together.accepted[rows])


def test_progress_is_told(can_view: Observation, grasps: Grasps) -> None:
    told: list[tuple[int, Tensor]] = []
    refine(grasps, can_view, Known(nearness), num_steps=4, on_step=lambda step, value: told.append((step, value)))
    assert [step for step, _ in told] == [0, 1, 2, 3, 4]
    assert all(value.shape == (12,) for _, value in told)
    assert (torch.stack([value for _, value in told]).amax(0) > told[0][1]).float().mean() > 0.5


def test_an_array_with_its_camera_is_an_observation(can_view: Observation, grasps: Grasps) -> None:
    """The table is fitted then, so the world differs; what happens in the camera frame is nearly the same."""
    array = refine(grasps[:3], can_view.depth, Known(nearness), camera=can_view.camera, num_steps=3)
    given = refine(grasps[:3], can_view, Known(nearness), num_steps=3)
    torch.testing.assert_close(array.score_after, given.score_after, atol=0.05, rtol=0)
    assert array.grasps.frame == "camera"


# wrong calls


@pytest.mark.usefixtures("as_users_run_it")
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"variables": "wrist"}, 'variables \'wrist\' is unknown, use "grip", "waypoints" or "last3"'),
        ({"num_steps": -1}, "num_steps >= 0 and learning_rate > 0, got -1 and 0.2"),
        ({"learning_rate": 0.0}, "learning_rate > 0, got 20 and 0.0"),
        ({"depth": np.ones((480, 640))}, "a depth array needs its camera"),
        ({"camera": "given"}, "give a camera with a depth array only; an Observation has its own"),
        ({"evaluator": "em22"}, "model 'em22' is unknown, did you mean em2"),
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


def test_joints_beyond_their_limits_are_refused(grasps: Grasps, can_view: Observation) -> None:
    waypoints = grasps.waypoints.clone()
    waypoints[0, 9, 8] = 3.0
    with pytest.raises(ValueError, match=r"joint thumb_mcp is at 3\.000 rad, outside its limits"):
        refine(Grasps(waypoints, "camera"), can_view, Known(nearness))

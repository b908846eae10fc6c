"""The heuristic generator: what it promises of every grasp, against the cloud it has not seen in the making."""

import numpy as np
import pytest
import torch
import trimesh

from dexzoo import planning
from dexzoo.generators.generator import spread
from dexzoo.generators.heuristic import HeuristicGenerator, complete
from dexzoo.grasp import GRASP_TYPES, GRIP, PREGRASP, SQUEEZE, Grasps
from dexzoo.hand import Hand
from dexzoo.perception import Camera, Observation, View
from dexzoo.perception.camera import look_at
from dexzoo.sim import ObjectModel, Outcomes, Scene
from dexzoo.sim.shapes import make_object
from dexzoo.verification import verify

TABLE = torch.tensor([0.0, 0.0, 1.0, 0.0])


@pytest.fixture(scope="module")
def box_scene() -> Scene:
    return Scene.place(make_object("box_03"), seed=0)


@pytest.fixture(scope="module")
def box_view(box_scene: Scene) -> Observation:
    return box_scene.observe(seed=1)


@pytest.fixture(scope="module")
def box_grasps(box_view: Observation, hand: Hand) -> Grasps:
    return HeuristicGenerator(hand, num_samples=800).generate(box_view, 50, seed=0)


@pytest.fixture(scope="module", params=["can", "box"])
def case(request: pytest.FixtureRequest) -> tuple[Observation, Grasps]:
    """An observation and its grasps."""
    view: Observation = request.getfixturevalue(f"{request.param}_view")
    grasps: Grasps = request.getfixturevalue(f"{request.param}_grasps")
    return view, grasps


def links(grasps: Grasps, waypoint: int, hand: Hand) -> torch.Tensor:
    return grasps.wrist_pose[:, waypoint, None] @ hand.forward_kinematics(grasps.joints[:, waypoint])


# what every grasp fulfils


def test_grasps_come_ranked_with_their_hand(can_grasps: Grasps, box_grasps: Grasps, hand: Hand) -> None:
    for grasps in (can_grasps, box_grasps):
        assert grasps.hand is hand
        assert 0 < len(grasps) <= 50
        likelihood = grasps.log_likelihood
        assert likelihood is not None
        assert (likelihood.diff() <= 0).all()


def test_joints_keep_their_limits_and_their_coupling(case: tuple[Observation, Grasps], hand: Hand) -> None:
    joints = case[1].joints
    hand.check(joints, tolerance=1e-6)
    torch.testing.assert_close(joints, hand.expand(hand.reduce(joints)))


def test_the_squeeze_closes_further_than_the_grip(case: tuple[Observation, Grasps]) -> None:
    step = case[1].joints[:, SQUEEZE] - case[1].joints[:, GRIP]
    assert (step >= -1e-6).all()
    assert (step.amax(1) > 0.05).all()


def test_nothing_is_below_the_table(case: tuple[Observation, Grasps], hand: Hand) -> None:
    for waypoint in (PREGRASP, GRIP):
        assert float(hand.clearance(links(case[1], waypoint, hand), TABLE).amin()) > 0


def test_the_palm_is_near_the_object(case: tuple[Observation, Grasps]) -> None:
    view, grasps = case
    distance = torch.cdist(grasps.position[:, GRIP], torch.from_numpy(view.points_world)).amin(1)
    assert float(distance.max()) < 0.25


def test_the_pregrasp_leaves_the_observed_cloud_alone(case: tuple[Observation, Grasps], hand: Hand) -> None:
    view, grasps = case
    points = torch.from_numpy(view.points_world[::10].copy())
    depth = -hand.signed_distance(links(grasps, PREGRASP, hand), points).amin((-1, -2))
    assert float(depth.max()) < 0.01


def test_thumb_and_fingers_touch_the_object_at_the_grip(case: tuple[Observation, Grasps], hand: Hand) -> None:
    """The object is what is seen and its guessed hidden side."""
    view, grasps = case
    cloud, _ = complete(view, np.random.default_rng(0))
    distance = hand.signed_distance(links(grasps, GRIP, hand), torch.from_numpy(cloud)).amin(-1)
    thumb = torch.tensor([name.startswith("thumb") for name in hand.solid_names])
    fingers = torch.tensor([name.split("_")[0] not in ("thumb", "palm") for name in hand.solid_names])
    for part in (thumb, fingers):
        assert (distance[:, part].amin(1) < 0.0015).all()


def test_several_types_are_offered(case: tuple[Observation, Grasps]) -> None:
    kinds = {GRASP_TYPES[kind] for kind in case[1].grasp_type.tolist()}
    assert len(kinds) >= 3
    assert kinds <= {"power", "top", "tripod", "pinch"}


def test_some_grasps_hold(can_outcomes: Outcomes, box_grasps: Grasps, box_scene: Scene) -> None:
    assert can_outcomes.success.any()
    assert verify(box_grasps[:15], box_scene).success.any()


# the same seed, the number asked for


def test_the_same_seed_gives_the_same_grasps(can_view: Observation, hand: Hand) -> None:
    generator = HeuristicGenerator(hand, num_samples=300)
    first = generator.generate(can_view, 10, seed=5)
    again = generator.generate(View(can_view), 10, seed=5)
    assert torch.equal(first.wrist, again.wrist)
    assert torch.equal(first.joints, again.joints)
    assert torch.equal(first.grasp_type, again.grasp_type)
    assert first.log_likelihood is not None
    assert again.log_likelihood is not None
    assert torch.equal(first.log_likelihood, again.log_likelihood)
    other = generator.generate(can_view, 10, seed=6)
    assert other.wrist.shape != first.wrist.shape or not torch.equal(other.wrist, first.wrist)


def test_fewer_grasps_are_the_best_of_more(can_view: Observation, hand: Hand) -> None:
    generator = HeuristicGenerator(hand, num_samples=300)
    few, many = (generator.generate(can_view, num, seed=5) for num in (3, 10))
    assert len(few) == 3
    assert torch.equal(few.wrist, many.wrist[:3])
    assert torch.equal(few.joints, many.joints[:3])


def test_the_spread_passes_over_near_copies(can_grasps: Grasps) -> None:
    twice = Grasps.concatenate([can_grasps[:5], can_grasps[:5]])
    score = torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5] * 2)
    assert spread(twice, score, 10).tolist() == [4, 3, 2, 1, 0]
    assert spread(twice, score, 2).tolist() == [4, 3]


def test_the_hidden_side_is_guessed(can_scene: Scene) -> None:
    """What is turned round the vertical axis lies near the can's other side, with normals outwards.

    Seen without the camera's calibration error, by which all of it would be off.
    """
    can_view = can_scene.observe(seed=1, ideal=True)
    cloud, normals = complete(can_view, np.random.default_rng(0))
    mesh = can_scene.object.mesh.copy().apply_transform(can_scene.T_world_object)
    surface, distance, triangle = trimesh.proximity.closest_point(mesh, cloud)
    assert np.quantile(distance, 0.9) < 0.012
    assert ((mesh.face_normals[triangle] * normals).sum(1) > 0).mean() > 0.9
    middle = surface[:, :2].mean(0)
    way = can_view.T_world_camera[:2, 3] - middle
    toward = (cloud[:, :2] - middle) @ (way / np.linalg.norm(way))
    assert (toward > 0.01).any()
    assert (toward < -0.01).any()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)


# what cannot be grasped


def test_too_few_points_are_refused(can_view: Observation, hand: Hand) -> None:
    mask = np.zeros_like(can_view.mask)
    rows, columns = np.nonzero(can_view.mask)
    mask[rows[:30], columns[:30]] = True
    view = Observation(can_view.depth, can_view.camera, can_view.T_world_camera, mask=mask)
    with pytest.raises(ValueError, match="the object has 30 points, fewer than the 50 a grasp can be planned on"):
        HeuristicGenerator(hand, num_samples=100).generate(view)


@pytest.mark.parametrize("num_grasps", [0, -1])
def test_no_grasps_cannot_be_asked_for(can_view: Observation, num_grasps: int) -> None:
    with pytest.raises(ValueError, match=f"num_grasps is {num_grasps}, expected at least 1"):
        planning.generate(can_view, num_grasps)


def test_a_thing_larger_than_the_hand_has_no_grasp(hand: Hand) -> None:
    slab = trimesh.creation.box([0.3, 0.3, 0.15])
    scene = Scene.place(ObjectModel.from_mesh(slab, hulls=[slab]))
    pose = look_at(np.array([0.0, 0.0, 0.05]), 0.7, 0.4, 0.8)
    view = scene.observe(camera=Camera(320, 240, 287.0, 287.0, 160.0, 120.0), T_world_camera=pose)
    with pytest.raises(RuntimeError, match="no feasible grasp is found: the object may be too large, too flat or out"):
        HeuristicGenerator(hand, num_samples=400).generate(view)

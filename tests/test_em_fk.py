"""EM-FK: where the hand's points are, what they are told of the view, and that nothing breaks at the edges."""

from dataclasses import replace

import numpy as np
import pytest
import synthetic
import torch

from dexzoo import rotation
from dexzoo.comparison.scores import one_view
from dexzoo.grasp import Grasps, Trajectory
from dexzoo.hand import Hand
from dexzoo.hand.surface_points import surface_points
from dexzoo.models import em_fk
from dexzoo.models.em_fk import EMFK
from dexzoo.models.view_geometry import cloud, table_plane, upright_axes, view_geometry
from dexzoo.perception.camera import look_at
from dexzoo.perception.observation import Observation

RADIUS = 0.05
CENTER = np.array([0.1, -0.2, RADIUS])


def ball(azimuth: float, distance: float = 0.5, elevation: float = 0.8) -> Observation:
    return synthetic.render("ball", np.full(3, RADIUS), CENTER, look_at(CENTER, distance, azimuth, elevation))


@pytest.fixture(scope="module")
def model() -> EMFK:
    torch.manual_seed(0)
    return EMFK().eval()


@pytest.fixture(scope="module")
def grasps() -> Grasps:
    return synthetic.draw_grasps(CENTER, 12, np.random.default_rng(0))[0]


def camera_grasps(grasps: Grasps, view: Observation) -> Trajectory:
    return one_view(grasps.trajectory.transformed(np.linalg.inv(view.T_world_camera)))


# the hand's points


def test_points_lie_on_the_hand_and_face_what_is_grasped(hand: Hand) -> None:
    points, normals = surface_points(hand, 6)
    assert points.shape == (len(hand.shapes), 6, 3)
    links = hand.forward_kinematics(torch.zeros(20, dtype=torch.float64))
    poses = hand.shape_poses(links)
    own = torch.tensor([hand.solid_names.index(shape.link) for shape in hand.shapes])
    for lift in (0.0, 1e-3):  # on the surface; and a millimeter along the normal is a millimeter away from it
        placed = (points + lift * normals) @ poses[:, :3, :3].mT + poses[:, None, :3, 3]
        distance = hand.signed_distance(links, placed.reshape(-1, 3)).reshape(len(hand.solid_names), -1, 6)
        nearest = distance[own, torch.arange(len(own))]
        torch.testing.assert_close(nearest, torch.full_like(nearest, lift), atol=1e-5, rtol=0)
    spread = torch.cdist(points, points) + torch.eye(6)
    assert (spread > 0.003).all()
    # fingers bend towards the palm's front, +x, when all joints are 0, but for the thumb, which opposes them
    facing = (normals @ poses[:, :3, :3].mT)[[not s.link.startswith("thumb") for s in hand.shapes]][..., 0]
    assert (facing > 0).all()
    assert torch.equal(surface_points(hand, 6)[0], points)


# the view's geometry


def test_the_table_is_found_in_the_image_again() -> None:
    for shape, half in (("ball", [0.03] * 3), ("box", [0.06, 0.04, 0.002]), ("box", [0.02, 0.02, 0.1])):
        for azimuth, elevation in ((0.3, 0.55), (2.0, 1.0), (4.0, 1.4)):
            center = np.array([0.0, 0.1, half[2]])
            view = synthetic.render(shape, np.array(half), center, look_at(center, 0.6, azimuth, elevation)).aimed()
            found = table_plane(view.image()[None])[0].double().numpy()
            assert np.linalg.norm(found[:3]) == pytest.approx(1)
            assert np.rad2deg(np.arccos(min(1, found[:3] @ view.table[:3]))) < 0.5
            assert view.points.mean(0) @ (found[:3] - view.table[:3]) + found[3] - view.table[3] == pytest.approx(
                0, abs=1e-5
            )


def test_surface_normals_and_cloud_are_those_of_a_ball() -> None:
    view = ball(1.0).aimed()
    geometry = view_geometry(view.image()[None])
    T = torch.linalg.inv(torch.tensor(view.T_world_camera))
    middle = (T[:3, :3] @ torch.tensor(CENTER) + T[:3, 3]).float()
    seen = cloud(geometry, 256)[0]
    out = seen[:, :3] - middle
    torch.testing.assert_close(out.norm(dim=1), torch.full((256,), RADIUS), atol=2e-3, rtol=0)
    turned = (torch.nn.functional.normalize(out, dim=1) * seen[:, 3:]).sum(1)
    assert turned.median() > 0.99
    assert turned.min() > 0.6  # the rim is seen at a grazing angle
    gap = (torch.cdist(seen[:, :3], seen[:, :3]) + torch.eye(256)).amin(1)
    assert gap.min() > 0.001
    assert gap.max() < 0.02
    # beside the object the rays end on the table
    points = geometry.points[0][geometry.mask[0] == 0]
    height = points @ torch.tensor(view.table[:3], dtype=torch.float32) + view.table[3]
    assert height.abs().max() < 1e-3
    axes = upright_axes(geometry.table)[0]
    torch.testing.assert_close(axes @ axes.T, torch.eye(3), atol=1e-5, rtol=0)
    assert torch.linalg.det(axes) == pytest.approx(1, abs=1e-5)


def test_points_are_told_how_far_before_and_from_the_surface_they_are() -> None:
    view = ball(1.0).aimed()
    geometry = view_geometry(view.image()[None])
    maps = torch.cat((geometry.depth[:, None], geometry.mask[:, None], geometry.normals), 1)
    row, column = (index[::50] for index in torch.nonzero(geometry.mask[0] == 1, as_tuple=True))
    on = geometry.points[0, row, column]
    normal = geometry.normals[0, :, row, column].T
    scale = on / on[:, 2:]
    for lift in (-0.008, 0.0, 0.004):  # towards the camera is a positive gap
        p = (on - lift * scale)[None]
        seen = em_fk.sample(maps, em_fk.project(p))
        told = em_fk.before_surface(p[..., 2:], scale[None], -normal[None], seen)[0]
        torch.testing.assert_close(told[:, 0], torch.full((len(on),), np.tanh(lift / em_fk.NEAR)), atol=0.02, rtol=0)
        assert (told[:, 3] == 1).all()
        assert (told[:, 4] < -0.99).all()
        away = (on + lift * normal)[None]
        far = em_fk.nearest(away, -normal[None], torch.cat((on, normal), 1)[None])[0]
        torch.testing.assert_close(far[:, 0], torch.full((len(on),), np.tanh(abs(lift) / 0.01)), atol=0.011, rtol=0)
        torch.testing.assert_close(far[:, 3], torch.full((len(on),), np.tanh(lift / 0.01)), atol=1e-4, rtol=0)


def test_the_nearest_is_the_nearest_in_every_part() -> None:
    generator = torch.Generator().manual_seed(0)
    p = torch.randn(2, 2500, 3, generator=generator)  # more than are looked for at once
    seen = torch.randn(2, 40, 6, generator=generator)
    told = em_fk.nearest(p, torch.zeros_like(p), seen)
    expected = torch.cdist(p.double(), seen[..., :3].double()).amin(-1)
    torch.testing.assert_close(told[..., 1], torch.tanh(expected / em_fk.FAR).float(), atol=1e-5, rtol=0)


# the whole


def test_turning_camera_and_grasps_about_a_ball_changes_nothing(model: EMFK, grasps: Grasps) -> None:
    scores = []
    for azimuth in (0.0, 1.0, 3.0):
        turn = torch.eye(4, dtype=torch.float64)
        turn[:3, :3] = rotation.to_matrix(rotation.exp(torch.tensor([0, 0, azimuth], dtype=torch.float64)))
        turn[:3, 3] = torch.tensor(CENTER) - turn[:3, :3] @ torch.tensor(CENTER)
        scores.append(model.score(grasps.transformed(turn), ball(azimuth)))
    torch.testing.assert_close(scores[1], scores[0], atol=1e-3, rtol=0)
    torch.testing.assert_close(scores[2], scores[0], atol=1e-3, rtol=0)


def test_batches_change_nothing(model: EMFK, grasps: Grasps) -> None:
    views = [ball(azimuth) for azimuth in (0.0, 2.0)]
    encoding = model.encode(torch.stack([view.image() for view in views]))
    whole = model.logit(encoding, Trajectory.cat([camera_grasps(grasps, view) for view in views]))
    for i, view in enumerate(views):
        alone = model.encode(view.image()[None])
        for j in range(len(grasps)):
            one = model.logit(alone, camera_grasps(grasps[j], view))
            torch.testing.assert_close(one[0, 0], whole[i, j], atol=1e-5, rtol=0)


@pytest.mark.parametrize("shift", [(0, 0, -0.9), (0, 0, 0), (0, 0, 5.0), (3.0, 0, 0.5), (0, -50.0, 1e-3)])
def test_anywhere_before_or_behind_the_camera_all_is_finite(
    model: EMFK, grasps: Grasps, shift: tuple[float, float, float]
) -> None:
    view = ball(0.0)
    encoding = model.encode(view.image()[None])
    seen = camera_grasps(grasps, view)
    wrist, joints = seen.wrist.clone(), seen.joints.requires_grad_()
    wrist[..., :3] = torch.tensor(shift)
    wrist.requires_grad_()
    logit = model.logit(encoding, replace(seen, wrist=wrist))
    assert torch.isfinite(logit).all()
    for slope in torch.autograd.grad(logit.sum(), (wrist, joints)):
        assert torch.isfinite(slope).all()
        assert slope.abs().max() < 1e4


def test_a_point_of_the_hand_on_a_point_of_the_cloud_has_a_slope(model: EMFK) -> None:
    seen = torch.randn(1, 20, 6, generator=torch.Generator().manual_seed(0))
    p = seen[..., :3].clone().requires_grad_()
    told = em_fk.nearest(p, torch.ones_like(p), seen)
    (slope,) = torch.autograd.grad(told.sum(), p)
    assert torch.isfinite(slope).all()
    assert torch.isfinite(told).all()


def test_what_points_are_told_follows_the_grasp_in_double_precision(model: EMFK, grasps: Grasps) -> None:
    exact = EMFK().double().eval()
    exact.load_state_dict(model.state_dict())
    view = ball(0.0)
    encoding = {name: value.double() for name, value in model.encode(view.image()[None]).items()}
    seen = camera_grasps(grasps[:3], view).to(torch.float64)
    parts = (seen.wrist.requires_grad_(), seen.joints.requires_grad_())
    weight = torch.randn(53, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    generator = torch.Generator().manual_seed(2)
    ways = [torch.randn(part.shape, generator=generator, dtype=torch.float64) for part in parts]

    def told(step: float) -> torch.Tensor:
        wrist, joints = (part + step * way for part, way in zip(parts, ways, strict=True))
        features = exact.look(encoding, Trajectory(wrist, joints, seen.grasp_type))
        return (features * weight).sum((0, 2, 3, 4, 5))  # one number for each grasp

    slopes = torch.autograd.grad(told(0.0).sum(), parts)
    with torch.no_grad():
        rise = (told(1e-8) - told(-1e-8)) / 2e-8
    # at 1e-8 m no point crosses from one pixel, or nearest point, to the next but by rare chance
    expected = sum((slope * way).sum((0, 2, 3)) for slope, way in zip(slopes, ways, strict=True))
    torch.testing.assert_close(expected, rise, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("without", ["image", "depth", "cloud", "table", "motion", "attention"])
def test_each_ingredient_can_be_left_out(without: str, grasps: Grasps) -> None:
    torch.manual_seed(0)
    model = EMFK(**{without: False}).eval()
    assert model.arguments[without] is False
    view = ball(0.0)
    size = 53 - em_fk.FEATURES.get(without, 0)
    encoding = model.encode(view.image()[None])
    shape = (1, 12, 1 if without == "motion" else 4, 19, 6, size)
    assert model.look(encoding, camera_grasps(grasps, view)).shape == shape
    assert model.score(grasps, view).shape == (12,)
    model.logit(model.encode(view.image()[None]), camera_grasps(grasps, view)).sum().backward()
    assert not [name for name, parameter in model.named_parameters() if parameter.grad is None]  # which ddp refuses


def test_it_is_small() -> None:
    assert sum(parameter.numel() for parameter in EMFK().parameters()) < 1_000_000

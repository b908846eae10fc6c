"""Features of surfaces whose normals and curvatures are known in closed form."""

import numpy as np
import pytest
import torch
import trimesh

from dexzoo import rotation
from dexzoo.perception.observation import Observation
from dexzoo.perception.surface import SurfaceFeatures

RADIUS = 0.04


def of_mesh(mesh: trimesh.Trimesh) -> SurfaceFeatures:
    points, faces = trimesh.sample.sample_surface(mesh, 20_000, seed=0)
    chosen = np.arange(len(points)) % 40 == 0
    return SurfaceFeatures.of_surface(np.array(points), mesh.face_normals[faces], chosen)


def test_a_sphere_is_curved_alike_everywhere() -> None:
    features = of_mesh(trimesh.creation.icosphere(5, RADIUS))
    assert torch.allclose(features.normals, features.points / RADIUS, atol=0.03)
    torch.testing.assert_close(features.curvature, torch.full_like(features.curvature, 1 / RADIUS), rtol=0.12, atol=0)


def test_a_cylinder_is_curved_around_and_straight_along() -> None:
    features = of_mesh(trimesh.creation.cylinder(RADIUS, 0.3, sections=200))
    features = features[features.points[:, 2].abs() < 0.12]
    assert torch.allclose(features.curvature[:, 0], torch.tensor(1 / RADIUS), rtol=0.12)
    assert features.curvature[:, 1].abs().max() < 0.1 / RADIUS
    first = rotation.rotate(features.quaternion, torch.tensor([1.0, 0, 0]))
    assert first[:, 2].abs().max() < 0.1, "the first principal direction runs around"


def test_the_inside_of_a_pipe_is_concave_and_its_outside_left_alone() -> None:
    pipe = trimesh.creation.annulus(RADIUS - 0.003, RADIUS, 0.3, sections=200)
    features = of_mesh(pipe)
    features = features[features.points[:, 2].abs() < 0.12]
    distance = features.points[:, :2].norm(dim=-1)
    inside, outside = distance < RADIUS - 0.002, distance > RADIUS - 0.001
    assert inside.any()
    assert outside.any()
    assert (features.curvature[outside, 0] > 0.8 / RADIUS).all()
    assert (features.curvature[inside, 1] < -0.8 / RADIUS).all()
    radial = features.points * torch.tensor([1.0, 1, 0])
    facing = (features.normals * radial).sum(-1)
    assert (facing[outside] > 0).all()
    assert (facing[inside] < 0).all()


def test_frames_may_turn_by_half_a_turn_where_curvatures_differ_and_by_any_where_they_do_not() -> None:
    generator = torch.Generator().manual_seed(0)
    points, quaternion = torch.zeros(4000, 3), torch.tensor([1.0, 0, 0, 0]).repeat(4000, 1)
    ridge = SurfaceFeatures(points, quaternion, torch.tensor([25.0, 0.0]).repeat(4000, 1))
    turned = rotation.rotate(ridge.ambiguous_turn(generator), torch.tensor([1.0, 0, 0]))
    assert turned[:, 0].abs().min() > 0.99
    assert (turned[:, 0] > 0).float().mean() == pytest.approx(0.5, abs=0.04)
    ball = SurfaceFeatures(points, quaternion, torch.tensor([25.0, 25.0]).repeat(4000, 1))
    turned = rotation.rotate(ball.ambiguous_turn(generator), torch.tensor([1.0, 0, 0]))
    assert turned[:, 0].abs().mean() == pytest.approx(2 / np.pi, abs=0.05), "as for an even distribution of directions"


def test_a_view_gives_the_near_side_and_its_completion_the_far_one(can_view: Observation) -> None:
    features = SurfaceFeatures.of_view(can_view, 500, np.random.default_rng(0))
    camera = torch.tensor(can_view.T_world_camera[:3, 3], dtype=torch.float32)
    assert ((features.normals * (camera - features.points)).sum(-1) > 0).all()
    whole = features.completed(can_view)
    side = whole[whole.normals[:, 2].abs() < 0.2]
    direction = torch.atan2(side.normals[:, 1], side.normals[:, 0])
    counts = torch.histc(direction, bins=8, min=-torch.pi, max=torch.pi)
    assert counts.min() > 0, "the can's side is there all around"


def test_too_few_points_are_refused(can_view: Observation) -> None:
    rows, columns = np.nonzero(can_view.mask)
    mask = np.zeros_like(can_view.mask)
    mask[rows[::400], columns[::400]] = True
    sparse = Observation(can_view.depth, can_view.camera, can_view.T_world_camera, mask=mask)
    with pytest.raises(ValueError, match="points besides noise, fewer than the 50"):
        SurfaceFeatures.of_view(sparse, 500, np.random.default_rng(0))

"""Kopicki's densities against plain sums over all kernels, finite differences, and the demonstration itself."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dexzoo import rotation
from dexzoo.generators.contact_density import ContactDensity, Grips
from dexzoo.generators.contact_models import Bandwidths, contact_models
from dexzoo.generators.demonstration import Demonstration, load_demonstrations
from dexzoo.grasp import GRIP, PREGRASP, Grasps
from dexzoo.hand import Hand
from dexzoo.rotation import step_pose


@pytest.fixture(scope="module")
def shown(hand: Hand) -> list[Demonstration]:
    return [one for one in load_demonstrations(hand) if one.object == "box_09"][:2]


@pytest.fixture(scope="module")
def density(shown: list[Demonstration], hand: Hand) -> ContactDensity:
    """Of the surface that the first demonstration itself was given on."""
    models = [contact_models(one, hand, Bandwidths()) for one in shown]
    return ContactDensity(shown, models, shown[0].surface, hand, num_kernels=800)


@pytest.fixture
def grips(density: ContactDensity) -> Grips:
    return density.sample(20, torch.Generator().manual_seed(1))


def test_contact_models_lead_back_to_the_links(shown: list[Demonstration], hand: Hand) -> None:
    grasp, surface = shown[0].grasp, shown[0].surface
    links = grasp.wrist_pose[0, GRIP] @ hand.forward_kinematics(grasp.joints[0, GRIP])
    for model in contact_models(shown[0], hand, Bandwidths()):
        # some feature of the surface is the one that the kernel was seen from
        places = surface.points + rotation.rotate(surface.quaternion, model.position[0].expand(len(surface), 3))
        turns = rotation.multiply(surface.quaternion, model.quaternion[0].expand(len(surface), 4))
        apart = (places - links[model.link, :3, 3]).norm(dim=-1)
        apart += (rotation.to_matrix(turns) - links[model.link, :3, :3]).abs().amax((-1, -2))
        assert apart.min() < 1e-4


def test_likelihood_is_the_product_over_all_kernels(density: ContactDensity, grips: Grips, hand: Hand) -> None:
    links = grips.wrist[:, None] @ hand.forward_kinematics(hand.expand(grips.joints))
    expected = []
    for row, demo in enumerate(grips.demo.tolist()):
        total = 0.0
        columns = density.active[demo].nonzero().squeeze(-1).tolist()
        for column in columns:
            pose = links[row, density.links[demo, column]].double().numpy()
            q = rotation.from_matrix(torch.tensor(pose[:3, :3])).numpy()
            apart = ((density.kernel_position[demo, column].double().numpy() - pose[:3, 3]) ** 2).sum(-1) / 0.005**2
            cosine = np.abs(density.kernel_quaternion[demo, column].double().numpy() @ q)
            weight = density.log_weight[demo, column].double().exp().numpy()
            link = (weight * np.exp(-apart - 200 * (1 - cosine))).sum()
            total += np.log((link + density.floor) / (1 + link) / density.floor)
        expected.append(total / len(columns) ** 0.75)
    contact = density.log_likelihood(grips, density.neighbors(grips, num=800)) - density.log_posture(grips)
    np.testing.assert_allclose(contact.numpy(), expected, atol=5e-3)
    near = density.log_likelihood(grips) - density.log_posture(grips)
    np.testing.assert_allclose(near.numpy(), expected, atol=0.5, err_msg="a few neighbors nearly make up the sum")


def test_posture_counts_the_way_along_the_path_and_the_distance_from_it(density: ContactDensity, hand: Hand) -> None:
    joints = density.demonstrations[0].grasp.joints[0]
    demo = torch.zeros(3, dtype=torch.long)
    off = joints[GRIP].clone()
    off[1] += 0.015708 * 2
    postures = hand.reduce(torch.stack((joints[GRIP], joints[PREGRASP], off)))
    value = density.log_posture(Grips(demo, torch.eye(4).repeat(3, 1, 1), postures))
    assert value[0] == pytest.approx(0, abs=1e-4)
    assert value[1] == pytest.approx(-1, abs=1e-4)
    assert -4.5 < value[2] < -2, "two bandwidths off one joint, part of it along the path"


def test_gradient_agrees_with_finite_differences(density: ContactDensity, grips: Grips) -> None:
    near = density.neighbors(grips)
    tangent = torch.zeros(len(grips.demo), 6, requires_grad=True)
    moved = Grips(grips.demo, step_pose(grips.wrist, tangent), grips.joints)
    density.log_likelihood(moved, near).sum().backward()
    step = 1e-4
    for axis in range(6):
        values = []
        for sign in (1, -1):
            change = torch.zeros(len(grips.demo), 6)
            change[:, axis] = sign * step
            values.append(density.log_likelihood(Grips(grips.demo, step_pose(grips.wrist, change), grips.joints), near))
        slope = (values[0] - values[1]) / (2 * step)
        scale = slope.abs().max().clamp_min(1.0)
        assert ((tangent.grad[:, axis] - slope).abs() / scale).max() < 0.05


def test_a_demonstration_is_likelier_on_its_own_surface_than_moved_off_it(density: ContactDensity) -> None:
    grasp = density.demonstrations[0].grasp
    off = torch.eye(4)
    off[:3, 3] = torch.tensor([0.0, 0.0, 0.05])
    both = Grasps.concatenate([grasp, grasp.transformed(off)])
    here, there = density.log_density(both)
    assert here > there + 15


def test_log_density_knows_only_demonstrated_types(density: ContactDensity) -> None:
    grasp = density.demonstrations[0].grasp
    unknown = next(k for k in range(10) if k not in {d.grasp_type for d in density.demonstrations})
    other = replace(grasp, grasp_type=torch.tensor([unknown]))
    assert density.log_density(other).item() == -torch.inf
    both = Grasps.concatenate([grasp, other])
    near = density.near(both)(both)
    torch.testing.assert_close(near[0], density.log_density(grasp)[0])
    assert near[1] == 0
    assert density.near(other)(other).tolist() == [0]


def test_near_some_grasps_the_density_is_followed_with_its_gradient(density: ContactDensity) -> None:
    grasp = density.demonstrations[0].grasp.trajectory
    wrist = grasp.wrist.clone().requires_grad_()
    moved = replace(grasp, wrist=wrist + torch.tensor([0.0005, 0, 0, 0, 0, 0, 0]))
    value = density.near(grasp)(moved)
    torch.testing.assert_close(value, density.log_density(moved), atol=0.05, rtol=0)
    slope = torch.autograd.grad(value.sum(), wrist)[0]
    assert slope[:, GRIP].abs().max() > 1
    assert (slope[:, :GRIP] == 0).all(), "the grip alone counts"


def test_samples_lie_by_a_kernel_of_one_of_their_links(density: ContactDensity, grips: Grips) -> None:
    best = []
    position, turn, _ = density.neighbors(grips, 1)
    at, how = density._link_poses(grips)
    apart = (position[:, :, 0] - at).norm(dim=-1)
    cosine = (((turn[:, :, 0] * how).sum(-1) + 1) / 4).clamp_min(0).sqrt()
    near = (apart < 0.02) & (cosine > 0.95) & density.active[grips.demo]
    best = near.any(-1)
    assert best.float().mean() > 0.9


def test_the_same_generator_draws_the_same(density: ContactDensity) -> None:
    first, second = (density.sample(5, torch.Generator().manual_seed(3)) for _ in range(2))
    assert torch.equal(first.wrist, second.wrist)
    assert torch.equal(first.joints, second.joints)

"""Rotations against SciPy, their axioms, and their gradients."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp
from torch.autograd import gradcheck

from dexzoo import rotation

unit_interval = st.floats(-1, 1, allow_subnormal=False)
axes = st.tuples(unit_interval, unit_interval, unit_interval).filter(lambda v: np.linalg.norm(v) > 0.1)


@pytest.fixture
def pairs() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return rotation.random(200, generator).double(), rotation.random(200, generator).double()


def scipy(quaternion: torch.Tensor) -> Rotation:
    return Rotation.from_quat(quaternion.numpy(), scalar_first=True)


def assert_same(ours: torch.Tensor, theirs: Rotation, tolerance: float = 1e-6) -> None:
    """Equal as rotations, and in the half of the sphere that we use."""
    assert (ours[..., 0] >= 0).all()
    assert (scipy(ours).inv() * theirs).magnitude().max() < tolerance


def test_product_inverse_and_matrix_agree_with_scipy(pairs: tuple[torch.Tensor, torch.Tensor]) -> None:
    a, b = (rotation.normalize(q) for q in pairs)
    assert_same(rotation.normalize(rotation.multiply(a, b)), scipy(a) * scipy(b))
    assert_same(rotation.conjugate(a), scipy(a).inv())
    np.testing.assert_allclose(rotation.to_matrix(a), scipy(a).as_matrix(), atol=1e-9)
    np.testing.assert_allclose(rotation.angle(a, b), (scipy(a).inv() * scipy(b)).magnitude(), atol=1e-7)


def test_rotate_agrees_with_scipy_and_broadcasts(pairs: tuple[torch.Tensor, torch.Tensor]) -> None:
    q, vector = rotation.normalize(pairs[0]), torch.randn(200, 3, dtype=torch.float64)
    np.testing.assert_allclose(rotation.rotate(q, vector), scipy(q).apply(vector.numpy()), atol=1e-12)
    many = rotation.rotate(q[:, None], vector[:7])
    assert many.shape == (200, 7, 3)
    torch.testing.assert_close(many[5, 3], rotation.rotate(q[5], vector[3]))


def test_exp_and_log_agree_with_scipy(pairs: tuple[torch.Tensor, torch.Tensor]) -> None:
    tangent = torch.randn(200, 3, dtype=torch.float64) * 2
    assert_same(rotation.exp(tangent), Rotation.from_rotvec(tangent.numpy()))
    q = rotation.normalize(pairs[0])
    np.testing.assert_allclose(rotation.log(q), scipy(q).as_rotvec(), atol=1e-9)


def test_xyzw_is_scipys_order(pairs: tuple[torch.Tensor, torch.Tensor]) -> None:
    q = rotation.normalize(pairs[0])
    assert_same(rotation.from_xyzw(rotation.to_xyzw(q)), Rotation.from_quat(rotation.to_xyzw(q).numpy()))
    torch.testing.assert_close(rotation.from_xyzw(torch.tensor([0.0, 0, 0, -1])), torch.tensor([1.0, 0, 0, 0]))


def test_group_axioms(pairs: tuple[torch.Tensor, torch.Tensor]) -> None:
    a, b = (rotation.normalize(q) for q in pairs)
    c = a.roll(1, 0)
    one = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
    torch.testing.assert_close(rotation.multiply(a, one), a)
    torch.testing.assert_close(rotation.multiply(a, rotation.conjugate(a)), one.expand(200, 4))
    left = rotation.multiply(rotation.multiply(a, b), c)
    torch.testing.assert_close(left, rotation.multiply(a, rotation.multiply(b, c)))
    product = rotation.to_matrix(a) @ rotation.to_matrix(b)
    torch.testing.assert_close(rotation.to_matrix(rotation.multiply(a, b)), product)


@given(axis=axes, radians=st.floats(0, math.pi - 1e-6))
def test_log_undoes_exp(axis: tuple[float, float, float], radians: float) -> None:
    direction = torch.nn.functional.normalize(torch.tensor(axis, dtype=torch.float64), dim=0)
    tangent = direction * radians
    torch.testing.assert_close(rotation.log(rotation.exp(tangent)), tangent, atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize("radians", [0.0, 1e-9, 1e-6, 1e-4, 1e-3, 1.0, 3.1, math.pi - 1e-3, math.pi])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-9), (torch.float32, 2e-6)])
def test_exp_is_exact_near_zero_and_pi(radians: float, dtype: torch.dtype, tolerance: float) -> None:
    axis = torch.tensor([0.6, 0.0, 0.8], dtype=dtype)
    q = rotation.from_axis_angle(axis, torch.tensor(radians, dtype=dtype))
    expected = torch.cat((torch.tensor([math.cos(radians / 2)], dtype=dtype), math.sin(radians / 2) * axis))
    difference = min((q - expected).abs().max(), (q + expected).abs().max())  # at pi either sign is right
    assert difference < tolerance * 1e-3 + 2 * torch.finfo(dtype).eps
    assert abs(float(rotation.log(q).norm()) - radians) < tolerance


def test_log_takes_the_shortest_way() -> None:
    long = rotation.exp(torch.tensor([0, 0, 1.5 * math.pi], dtype=torch.float64))
    torch.testing.assert_close(rotation.log(long), torch.tensor([0, 0, -0.5 * math.pi], dtype=torch.float64))


@pytest.mark.parametrize("scale", [0.0, 1e-6, 1e-3, 1.0, 2.5])
def test_gradients(scale: float) -> None:
    generator = torch.Generator().manual_seed(1)
    tangent = torch.randn(5, 3, generator=generator, dtype=torch.float64)
    tangent = (scale * tangent / tangent.norm(dim=-1, keepdim=True)).requires_grad_()
    vector = torch.randn(5, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    assert gradcheck(rotation.exp, tangent)
    assert gradcheck(rotation.log, rotation.exp(tangent).detach().requires_grad_())
    assert gradcheck(lambda t, v: rotation.rotate(rotation.exp(t), v), (tangent, vector))
    assert gradcheck(lambda t: rotation.from_matrix(rotation.to_matrix(rotation.exp(t))), tangent)


def test_slerp_agrees_with_scipy_and_turns_at_constant_speed(pairs: tuple[torch.Tensor, torch.Tensor]) -> None:
    a, b = (rotation.normalize(q[0]) for q in pairs)
    t = torch.linspace(0, 1, 11, dtype=torch.float64)
    path = rotation.slerp(a, b, t)
    assert_same(path, Slerp([0, 1], Rotation.concatenate([scipy(a), scipy(b)]))(t.numpy()))
    assert_same(path[[0, -1]], scipy(torch.stack((a, b))))
    steps = rotation.angle(path[:-1], path[1:])
    torch.testing.assert_close(steps, (rotation.angle(a, b) / 10).expand(10))


def test_slerp_takes_the_shortest_way_between_either_signs(pairs: tuple[torch.Tensor, torch.Tensor]) -> None:
    a, b = pairs
    half = torch.tensor(0.5, dtype=torch.float64)
    torch.testing.assert_close(rotation.slerp(a, b, half), rotation.slerp(a, -b, half))


BRANCHES = {"w": [0.9, 0.2, 0.3, 0.1], "x": [0.1, 0.9, 0.2, 0.3], "y": [0.1, 0.2, 0.9, 0.3], "z": [0.1, 0.3, 0.2, 0.9]}


@pytest.mark.parametrize("largest", BRANCHES)
def test_from_matrix_undoes_to_matrix_on_each_branch(largest: str) -> None:
    q = rotation.normalize(torch.tensor(BRANCHES[largest]).double())
    torch.testing.assert_close(rotation.from_matrix(rotation.to_matrix(q)), q)


def test_from_matrix_of_half_turns() -> None:
    for i in range(3):
        half_turn = torch.diag(2 * torch.eye(3)[i] - 1)
        assert rotation.from_matrix(half_turn)[1 + i].abs() == 1


def test_random_is_uniform_and_repeats_with_the_seed() -> None:
    first, second = (rotation.random(4000, torch.Generator().manual_seed(3)) for _ in range(2))
    assert torch.equal(first, second)
    # the mean of uniformly turned vectors vanishes as 1/sqrt(n)
    assert rotation.rotate(first, torch.tensor([1.0, 0, 0])).mean(0).norm() < 0.06


def test_a_pose_steps_in_its_own_frame_and_stays_in_its_box() -> None:
    pose = rotation.pose_matrix(
        torch.tensor([0.1, 0.2, 0.3]), rotation.from_axis_angle(torch.tensor([0.0, 0, 1]), torch.tensor(0.5))
    )
    ahead = rotation.step_pose(pose, torch.tensor([0.01, 0, 0, 0, 0, 0.2]))
    assert torch.allclose(ahead[:3, 3] - pose[:3, 3], 0.01 * pose[:3, 0], atol=1e-6)
    turn = rotation.log(rotation.from_matrix(pose[:3, :3].T @ ahead[:3, :3]))
    assert torch.allclose(turn, torch.tensor([0.0, 0, 0.2]), atol=1e-5)
    box = torch.tensor([0.005] * 3 + [0.05] * 3)
    far = torch.linalg.inv(pose) @ rotation.step_pose(pose, torch.full((6,), 9.0), box)
    assert (far[:3, 3].abs() <= 0.005 + 1e-6).all()
    assert torch.allclose(
        rotation.step_pose(pose, 1e-5 * torch.ones(6), box), rotation.step_pose(pose, 1e-5 * torch.ones(6)), atol=1e-7
    )

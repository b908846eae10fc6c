"""Kinematics against a plain composition of transforms, on trees of any shape; Jacobians, pads, steps within limits."""

import itertools
from collections.abc import Callable

import numpy as np
import pytest
import scipy.optimize
import torch
from scipy.spatial.transform import Rotation
from torch.autograd import gradcheck

from dexzoo.hand import Hand, HandSpec, Joint
from dexzoo.hand.kinematics import KinematicTree, LinkPoses, build_chain
from dexzoo.perception.camera import Camera
from dexzoo.perception.observation import Observation

FINGERS = ("thumb", "index", "middle", "ring", "little")


@pytest.fixture(scope="module")
def left() -> Hand:
    return Hand.load("dlr2", side="left")


def random_tree(seed: int, num_links: int) -> HandSpec:
    """Links that branch anywhere; a third of the joints fixed; origins and axes along no coordinate axis."""
    rng = np.random.default_rng(seed)
    names = ["root", *(f"link_{i}" for i in range(num_links - 1))]
    joints = []
    for i in range(1, num_links):
        origin = np.eye(4)
        origin[:3, :3] = Rotation.random(random_state=rng).as_matrix()
        origin[:3, 3] = rng.normal(size=3)
        axis = rng.normal(size=3)
        fixed = i > 1 and rng.random() < 0.33
        joints.append(
            Joint(
                name=f"joint_{i}",
                parent=names[rng.integers(i)],
                child=names[i],
                origin=origin,
                axis=None if fixed else axis / np.linalg.norm(axis),
                lower=-1.0,
                upper=1.0,
                effort=1.0,
                damping=0.0,
                mimic=None,
                multiplier=1.0,
                offset=0.0,
            )
        )
    moving = [joint.name for joint in joints if joint.axis is not None]
    return HandSpec(
        "tree", "right", "root", tuple(joints), tuple(rng.permutation(moving)), tuple(names), {}, (), {}, ()
    )


def plain_kinematics(spec: HandSpec, q: torch.Tensor) -> torch.Tensor:
    """Link poses by one product of matrices a joint, each the exponential of its axis."""
    poses = {spec.palm: torch.eye(4, dtype=q.dtype).expand(len(q), 4, 4)}
    for joint in spec.joints:
        pose = poses[joint.parent] @ torch.tensor(joint.origin, dtype=q.dtype)
        if joint.axis is not None:
            x, y, z = joint.axis
            twist = torch.tensor([[0, -z, y, 0], [z, 0, -x, 0], [-y, x, 0, 0], [0, 0, 0, 0]], dtype=q.dtype)
            pose = pose @ torch.linalg.matrix_exp(q[:, spec.joint_names.index(joint.name), None, None] * twist)
        poses[joint.child] = pose
    return torch.stack([poses[link] for link in spec.link_names], 1)


def postures(hand: Hand, num: int, seed: int = 0) -> torch.Tensor:
    """All joints anywhere within their limits, float64."""
    generator = torch.Generator().manual_seed(seed)
    share = torch.rand(num, len(hand.joint_names), generator=generator, dtype=torch.float64)
    return hand.lower.double() + share * (hand.upper - hand.lower).double()


# --- forward kinematics ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("seed", "num_links"), [(0, 2), (1, 7), (2, 15), (3, 30)])
def test_any_tree_agrees_with_plain_products(seed: int, num_links: int) -> None:
    spec = random_tree(seed, num_links)
    tree = KinematicTree(build_chain(spec), spec.link_names, spec.joint_names, torch.float64, torch.device("cpu"))
    generator = torch.Generator().manual_seed(seed)
    q = torch.randn(5, len(spec.joint_names), generator=generator, dtype=torch.float64).requires_grad_()
    ours, theirs = LinkPoses.apply(q, tree), plain_kinematics(spec, q)
    torch.testing.assert_close(ours, theirs, atol=1e-12, rtol=0)
    # the last row of a pose is constant, so what is asked of it changes nothing
    weight = torch.randn(ours.shape, generator=generator, dtype=torch.float64)
    mine, reference = (torch.autograd.grad((poses * weight).sum(), q)[0] for poses in (ours, theirs))
    torch.testing.assert_close(mine, reference, atol=1e-10, rtol=0)
    assert gradcheck(lambda q: LinkPoses.apply(q, tree), q)


def test_gradient_of_the_hand_is_that_of_plain_products(hand: Hand) -> None:
    q = postures(hand, 20).requires_grad_()
    ours, theirs = hand.forward_kinematics(q), plain_kinematics(hand.spec, q)
    weight = torch.randn(ours.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    mine, reference = (torch.autograd.grad((poses * weight).sum(), q)[0] for poses in (ours, theirs))
    torch.testing.assert_close(mine, reference, atol=1e-12, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (1,), (3,), (2, 3), (2, 1, 3), (0,), (4, 0)])
@pytest.mark.parametrize("side", ["right", "left"])
def test_any_batch_and_precision(hand: Hand, left: Hand, side: str, batch: tuple[int, ...], dtype: torch.dtype) -> None:
    hand = hand if side == "right" else left
    q15 = torch.rand(*batch, 15, generator=torch.Generator().manual_seed(0)).to(dtype).requires_grad_()
    links = hand.forward_kinematics(hand.expand(q15))
    assert links.shape == (*batch, len(hand.link_names), 4, 4)
    assert links.dtype == dtype
    links.sum().backward()
    assert q15.grad is not None
    assert q15.grad.shape == q15.shape
    flat = plain_kinematics(hand.spec, hand.expand(q15).reshape(-1, 20).double())
    torch.testing.assert_close(links.double().reshape(flat.shape), flat, atol=1e-6, rtol=0)


def test_neither_layout_nor_dtype_of_the_argument_matters(hand: Hand) -> None:
    q = postures(hand, 12)
    across = q.T.contiguous().T
    assert not across.is_contiguous()
    torch.testing.assert_close(hand.forward_kinematics(across), hand.forward_kinematics(q))
    torch.testing.assert_close(hand.forward_kinematics(q[0].expand(4, 20))[3], hand.forward_kinematics(q[0]))


# --- Jacobian and pads -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("link", ["palm", "thumb_tip", "index_distal", "ring_proximal", "little_base"])
@pytest.mark.parametrize("point", [None, [0.01, -0.02, 0.03]])
def test_jacobian_is_the_derivative_of_a_point_and_of_its_turn(
    hand: Hand, left: Hand, link: str, point: list[float] | None
) -> None:
    at = torch.tensor([*(point or [0.0, 0, 0]), 1], dtype=torch.float64)
    for side in (hand, left):
        q = postures(side, 1, seed=3)[0]

        def pose(q: torch.Tensor, side: Hand = side) -> torch.Tensor:
            return side.forward_kinematics(q)[side.link_index(link)]

        jacobian = side.jacobian(q, link, None if point is None else at[:3])
        assert jacobian.shape == (6, 20)
        linear = torch.autograd.functional.jacobian(lambda q, pose=pose: (pose(q) @ at)[:3], q)
        torch.testing.assert_close(jacobian[:3], linear, atol=1e-12, rtol=0)
        step = 1e-6
        for joint in range(20):
            nudge = torch.zeros(20, dtype=torch.float64)
            nudge[joint] = step
            # dR R^T is the cross product matrix of the angular velocity
            spin = (pose(q + nudge)[:3, :3] - pose(q - nudge)[:3, :3]) / (2 * step) @ pose(q)[:3, :3].T
            angular = torch.stack((spin[2, 1], spin[0, 2], spin[1, 0]))
            torch.testing.assert_close(jacobian[3:, joint], angular, atol=1e-8, rtol=0)


def test_jacobian_is_batched_and_knows_what_a_joint_moves(hand: Hand) -> None:
    q = postures(hand, 6).reshape(2, 3, 20)
    jacobian = hand.jacobian(q, "index_tip")
    assert jacobian.shape == (2, 3, 6, 20)
    torch.testing.assert_close(jacobian[1, 2], hand.jacobian(q[1, 2], "index_tip"))
    index = slice(4, 8)
    torch.testing.assert_close(jacobian[..., 3:, index].norm(dim=-2), torch.ones(2, 3, 4, dtype=torch.float64))
    assert not jacobian[..., :4].any()
    assert not jacobian[..., 8:].any()


def test_unknown_link_names_the_nearest(hand: Hand) -> None:
    with pytest.raises(ValueError, match=r"hand dlr2 has no link 'index_tipp', did you mean index_tip\?"):
        hand.jacobian(torch.zeros(20), "index_tipp")
    with pytest.raises(ValueError, match=r"hand dlr2 has no link 'xyz'$"):
        hand.link_index("xyz")


def test_pads_are_carried_by_their_links(hand: Hand, left: Hand) -> None:
    for side in (hand, left):
        links = side.forward_kinematics(postures(side, 4))
        points, normals = side.pads(links)
        assert points.shape == normals.shape == (4, 5, 3)
        assert side.pad_names == list(FINGERS)
        for i, finger in enumerate(FINGERS):
            pose = links[:, side.link_names.index(f"{finger}_distal")]
            point, normal = ([0.017, 0.010, 0, 1], [0.0, 1, 0, 0])  # as hand.yaml has them; z is mirrored, and is zero
            torch.testing.assert_close(points[:, i], (pose @ torch.tensor(point, dtype=torch.float64))[:, :3])
            torch.testing.assert_close(normals[:, i], (pose @ torch.tensor(normal, dtype=torch.float64))[:, :3])
        # a pad lies on the surface of its link and points out of it
        distal = [side.solid_names.index(f"{finger}_distal") for finger in FINGERS]
        for step in (0.0, 0.002):
            distance = side.signed_distance(links, points + step * normals)[:, distal, range(5)]
            torch.testing.assert_close(distance, torch.full_like(distance, step), atol=1e-9, rtol=0)


@pytest.mark.parametrize(("finger", "degrees"), [("index", 18), ("middle", 23)])
def test_pads_oppose(hand: Hand, finger: str, degrees: float) -> None:
    """How squarely thumb and finger can hold what is 20 mm wide, by sequential quadratic programming from 16 starts."""
    other = FINGERS.index(finger)
    lower, upper = (limit.numpy() for limit in limits(hand, 15))
    used = [*range(3), *range(3 * other, 3 * other + 3)]

    def pinch(q: torch.Tensor) -> torch.Tensor:
        points, normals = hand.pads(hand.forward_kinematics(hand.expand(q)))
        line = points[other] - points[0]
        gap = line.norm()
        return torch.stack((100 * (gap - 0.02), normals[0] @ line / gap, -normals[other] @ line / gap))

    def value(x: np.ndarray) -> np.ndarray:
        return pinch(torch.tensor(x[:15])).numpy() - np.array([0, x[15], x[15]])

    def slope(x: np.ndarray) -> np.ndarray:
        by_joint = torch.autograd.functional.jacobian(pinch, torch.tensor(x[:15])).numpy()
        return np.column_stack((by_joint, [0, -1, -1]))

    rng = np.random.default_rng(0)
    best = np.zeros(16)
    for _ in range(16):  # the last variable is the smaller of both cosines
        start = np.zeros(16)
        start[used] = rng.uniform(lower, upper)[used]
        found = scipy.optimize.minimize(
            lambda x: -x[15],
            start,
            jac=lambda x: -np.eye(16)[15],
            bounds=[*zip(lower, upper, strict=True), (-1, 1)],
            constraints=[
                {"type": "eq", "fun": lambda x: value(x)[:1], "jac": lambda x: slope(x)[:1]},
                {"type": "ineq", "fun": lambda x: value(x)[1:], "jac": lambda x: slope(x)[1:]},
            ],
            method="SLSQP",
        )
        if found.success and found.x[15] > best[15]:
            best = found.x
    q20 = hand.expand(torch.tensor(best[:15]))
    hand.check(q20)
    assert (hand.self_distance(hand.forward_kinematics(q20)) > 0).all()
    points, _ = hand.pads(hand.forward_kinematics(q20))
    assert (points[other] - points[0]).norm().item() == pytest.approx(0.02, abs=1e-5)
    assert np.rad2deg(np.arccos(best[15])) == pytest.approx(degrees, abs=0.5)


# --- limits ----------------------------------------------------------------------------------------------------------


def limits(hand: Hand, size: int) -> tuple[torch.Tensor, torch.Tensor]:
    lower, upper = hand.lower.double(), hand.upper.double()
    return (lower, upper) if size == 20 else (hand.reduce(lower), hand.reduce(upper))


@pytest.mark.parametrize("size", [15, 20])
@pytest.mark.parametrize("name", ["clamp", "reflect", "squash"])
def test_steps_end_within_the_limits(hand: Hand, name: str, size: int) -> None:
    lower, upper = limits(hand, size)
    anywhere = 20 * torch.randn(3, 50, size, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    inside = getattr(hand, name)(anywhere)
    assert inside.shape == anywhere.shape
    assert (inside >= lower - 1e-12).all()
    assert (inside <= upper + 1e-12).all()


@pytest.mark.parametrize("size", [15, 20])
@pytest.mark.parametrize("name", ["clamp", "reflect"])
def test_what_is_inside_stays(hand: Hand, name: str, size: int) -> None:
    lower, upper = limits(hand, size)
    q = lower + (upper - lower) * torch.rand(20, size, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    torch.testing.assert_close(getattr(hand, name)(q), q, atol=1e-12, rtol=0)
    assert gradcheck(getattr(hand, name), q[:2].requires_grad_())


@pytest.mark.parametrize("size", [15, 20])
def test_clamp_is_the_nearest_and_reflect_the_mirror_image(hand: Hand, size: int) -> None:
    lower, upper = limits(hand, size)
    beyond = upper + 0.1
    torch.testing.assert_close(hand.clamp(beyond), upper)
    torch.testing.assert_close(hand.reflect(beyond), upper - 0.1)
    torch.testing.assert_close(hand.reflect(lower - 0.1), lower + 0.1)
    beyond.requires_grad_()
    hand.reflect(beyond).sum().backward()
    torch.testing.assert_close(beyond.grad, -torch.ones(size, dtype=torch.float64))


@pytest.mark.parametrize("size", [15, 20])
def test_squash_is_smooth_and_starts_in_the_middle(hand: Hand, size: int) -> None:
    lower, upper = limits(hand, size)
    torch.testing.assert_close(hand.squash(torch.zeros(size, dtype=torch.float64)), (lower + upper) / 2)
    z = torch.linspace(-6, 6, size, dtype=torch.float64)
    assert gradcheck(hand.squash, z.clone().requires_grad_())
    assert (hand.squash(z + 0.1) > hand.squash(z)).all()


@pytest.mark.parametrize("name", ["clamp", "reflect", "squash"])
def test_other_numbers_of_angles_are_refused(hand: Hand, name: str) -> None:
    with pytest.raises(ValueError, match="20 joint angles, got 19"):
        getattr(hand, name)(torch.zeros(19))


def draw(hand: Hand, num: int, seed: int) -> torch.Tensor:
    return hand.random(num, torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("num", [0, 1, 7, 300])
def test_random_postures(hand: Hand, left: Hand, num: int) -> None:
    for side in (hand, left):
        q = draw(side, num, seed=5)
        assert q.shape == (num, 20)
        side.check(q, tolerance=1e-6)
        torch.testing.assert_close(q, side.expand(side.reduce(q)))
        assert (side.self_distance(side.forward_kinematics(q)) > 0).all()
        assert torch.equal(q, draw(side, num, seed=5))
    if num == 300:
        assert not torch.equal(q, draw(left, num, seed=6))
        share = (q - left.lower) / (left.upper - left.lower)
        assert (share.amin(0) < 0.05).all()
        assert (share.amax(0) > 0.6).all()  # the thumb's mcp comes no further without touching the palm


def test_a_hand_that_always_touches_itself_is_named(hand: Hand, monkeypatch: pytest.MonkeyPatch) -> None:
    touching: Callable[[torch.Tensor], torch.Tensor] = lambda links: -torch.ones(len(links), 1)  # noqa: E731
    monkeypatch.setattr(hand, "self_distance", touching)
    with pytest.raises(RuntimeError, match="hand dlr2 touches itself in almost every posture"):
        draw(hand, 1, seed=0)


# --- bad input -------------------------------------------------------------------------------------------------------


def test_free_joints_given_as_a_posture_are_explained(hand: Hand) -> None:
    calls: list[Callable[[torch.Tensor], object]] = [
        hand.forward_kinematics,
        hand.check,
        lambda q: hand.jacobian(q, "palm"),
    ]
    for call, batch in itertools.product(calls, [(), (3,)]):
        with pytest.raises(ValueError, match=r"a posture has 20 joint angles, got 15; use hand\.expand first"):
            call(torch.zeros(*batch, 15))
    with pytest.raises(ValueError, match=r"a posture has 20 joint angles, got 7$"):
        hand.forward_kinematics(torch.zeros(7))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_an_angle_that_is_not_finite_is_named(hand: Hand, value: float) -> None:
    q = torch.zeros(2, 10, 20)
    q[1, 4, 9] = value
    q[1, 5, 3] = 9.0
    with pytest.raises(ValueError, match=f"joint middle_mcp is at {value} rad, which is not finite"):
        hand.check(q)


def test_an_angle_beyond_its_limit_is_named(hand: Hand) -> None:
    q = torch.zeros(2, 20, dtype=torch.float64)
    q[1, 2] = -0.3
    with pytest.raises(ValueError, match=r"joint thumb_pip is at -0\.300 rad, outside its limits 0\.000 to 1\.134"):
        hand.check(q)
    hand.check(q.clamp_min(-5e-4))  # rounding is no error
    hand.check(q[:0])


@pytest.mark.parametrize("turn", [1.01 * np.eye(3), np.diag([1.0, 1, -1]), np.full((3, 3), np.nan)])
def test_a_pose_that_is_no_rotation_is_refused(turn: np.ndarray) -> None:
    pose = np.eye(4)
    pose[:3, :3] = turn
    with pytest.raises(
        ValueError, match=r"T_world_camera('s rotation is not orthonormal| must be a finite 4 x 4 matrix)"
    ):
        Observation(np.ones((480, 640), np.float32), Camera(), pose)

"""Distances against plain autograd, sampled surfaces, exact least squares and MuJoCo's contacts."""

import itertools

import mujoco
import numpy as np
import pytest
import torch
from scipy.optimize import lsq_linear
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch.autograd import gradcheck

from dexzoo import rotation
from dexzoo.hand import Hand, Primitive, distances
from dexzoo.hand.distances import PointDistance, SegmentPairs, box_distance, box_slope
from dexzoo.sim.robot import add_hand


def postures(hand: Hand, num: int, seed: int = 0) -> torch.Tensor:
    """Coupled, anywhere within the limits, whether or not the hand touches itself; float64."""
    generator = torch.Generator().manual_seed(seed)
    lower, upper = hand.reduce(hand.lower).double(), hand.reduce(hand.upper).double()
    return hand.expand(lower + (upper - lower) * torch.rand(num, len(lower), generator=generator, dtype=torch.float64))


def random_poses(num: int, seed: int, spread: float) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (num, 1, 1))
    poses[:, :3, :3] = Rotation.random(num, random_state=rng).as_matrix()
    poses[:, :3, 3] = rng.uniform(-spread, spread, (num, 3))
    return torch.tensor(poses)


# --- points ----------------------------------------------------------------------------------------------------------

HALF = torch.tensor([[0.03, 0.02, 0.01], [0.02, 0, 0], [0.01, 0.04, 0.02], [0.05, 0, 0]], dtype=torch.float64)
RADIUS = torch.tensor([0.0, 0.01, 0.0, 0.008], dtype=torch.float64)
GROUPS = [slice(0, 1), slice(1, 4)]


def plain_distance(transform: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """The same by autograd alone, all at once."""
    columns = torch.cat((points, torch.ones_like(points[..., :1])), -1).mT
    local = (transform @ columns[..., None, :, :]).movedim(-2, 0)
    distance = box_distance(local, HALF.T[:, None, :, None], RADIUS[:, None])
    return torch.stack([distance[:, group].amin(1) for group in GROUPS], 1)


def random_transforms(num: int) -> torch.Tensor:
    return random_poses(4 * num, 0, 0.03).reshape(num, 4, 4, 4)[:, :, :3]


def random_points(*shape: int) -> torch.Tensor:
    return torch.rand(*shape, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 0.1 - 0.05


@pytest.mark.parametrize("chunk", [2**19, 100], ids=["all at once", "one by one"])
@pytest.mark.parametrize("each", [False, True], ids=["one cloud", "a cloud for each"])
def test_point_distances_and_their_gradients_are_those_of_autograd(
    each: bool, chunk: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(distances, "_CHUNK", chunk)
    transform = random_transforms(7).requires_grad_()
    points = random_points(7, 40) if each else random_points(40)
    points.requires_grad_()
    ours = PointDistance.apply(transform, points, HALF, RADIUS, GROUPS)
    theirs = plain_distance(transform, points)
    torch.testing.assert_close(ours, theirs, atol=1e-15, rtol=0)
    assert (ours < 0).any(-1).double().mean() > 0.5  # inside many
    weight = torch.randn(ours.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    mine = torch.autograd.grad((ours * weight).sum(), (transform, points))
    reference = torch.autograd.grad((theirs * weight).sum(), (transform, points))
    torch.testing.assert_close(mine, reference, atol=1e-12, rtol=0)
    held = PointDistance.apply(transform.detach(), points, HALF, RADIUS, GROUPS)
    torch.testing.assert_close(torch.autograd.grad((held * weight).sum(), points)[0], mine[1])
    held = PointDistance.apply(transform, points.detach(), HALF, RADIUS, GROUPS)
    torch.testing.assert_close(torch.autograd.grad((held * weight).sum(), transform)[0], mine[0])


def test_point_distances_pass_gradcheck() -> None:
    transform, points = random_transforms(2).requires_grad_(), random_points(5).requires_grad_()
    assert gradcheck(lambda t, p: PointDistance.apply(t, p, HALF, RADIUS, GROUPS), (transform, points))
    each = random_points(2, 5).requires_grad_()
    assert gradcheck(lambda t, p: PointDistance.apply(t, p, HALF, RADIUS, GROUPS), (transform, each))


def test_slopes_where_there_is_a_kink() -> None:
    capsule, box = torch.tensor([[0.02], [0], [0]]).double(), torch.tensor([[0.03], [0.02], [0.01]]).double()
    on_axis = box_slope(torch.tensor([[0.01, -0.01], [0, 0], [0, 0]], dtype=torch.float64), capsule)
    torch.testing.assert_close(on_axis, torch.zeros(3, 2, dtype=torch.float64))
    points = torch.tensor([[0, 0.03, 0.025], [0, 0, 0.015], [0, 0, 0]], dtype=torch.float64)
    slopes = box_slope(points, box)  # at the center, on a face, and as deep below one face as below another
    torch.testing.assert_close(slopes, torch.tensor([[0.0, 1, 1], [0, 0, 0], [0, 0, 0]], dtype=torch.float64))
    # as far from two equal shapes: half of the gradient each
    twice = random_transforms(1)[:, :1].expand(1, 2, 3, 4).clone().requires_grad_()
    points = random_points(6)
    arguments = (HALF[:1].expand(2, 3), RADIUS[:1].expand(2), [slice(0, 2)])
    PointDistance.apply(twice, points, *arguments).sum().backward()
    torch.testing.assert_close(twice.grad[:, 0], twice.grad[:, 1])
    once = twice.detach()[:, :1].requires_grad_()
    PointDistance.apply(once, points, HALF[:1], RADIUS[:1], [slice(0, 1)]).sum().backward()
    torch.testing.assert_close(twice.grad.sum(1), once.grad[:, 0])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("poses", "clouds", "both"),
    [((), (), ()), ((3,), (), (3,)), ((), (3,), (3,)), ((2, 1), (1, 4), (2, 4)), ((0,), (), (0,)), ((2,), (2,), (2,))],
)
def test_signed_distance_broadcasts(
    hand: Hand, poses: tuple[int, ...], clouds: tuple[int, ...], both: tuple[int, ...], dtype: torch.dtype
) -> None:
    q = postures(hand, 12)[: int(np.prod(poses))].reshape(*poses, 20).to(dtype).requires_grad_()
    points = random_points(*clouds, 9).to(dtype).requires_grad_()
    distance = hand.signed_distance(hand.forward_kinematics(q), points)
    assert distance.shape == (*both, len(hand.solid_names), 9)
    assert distance.dtype == dtype
    distance.sum().backward()
    assert q.grad.shape == q.shape
    assert points.grad.shape == points.shape
    for index in np.ndindex(*both):
        pose = q.detach().expand(*both, 20)[index]
        cloud = points.detach().expand(*both, 9, 3)[index]
        torch.testing.assert_close(distance[index], hand.signed_distance(hand.forward_kinematics(pose), cloud))


def test_no_points_no_distances(hand: Hand) -> None:
    links = hand.forward_kinematics(postures(hand, 3))
    assert hand.signed_distance(links, torch.zeros(0, 3, dtype=torch.float64)).shape == (3, 16, 0)


# --- links against each other ----------------------------------------------------------------------------------------


def surface(shape: Primitive, spacing: float) -> np.ndarray:
    """Points on a primitive in the frame of its link, no further apart than `spacing`."""
    if shape.is_capsule:
        half, radius = shape.half[0], shape.radius
        around = np.linspace(0, 2 * np.pi, int(2 * np.pi * radius / spacing) + 1)
        tilt = np.linspace(0, np.pi / 2, int(np.pi / 2 * radius / spacing) + 1)
        length = np.linspace(-half, half, int(2 * half / spacing) + 2)
        along = np.concatenate((-half - radius * np.sin(tilt), length, half + radius * np.sin(tilt)))
        out = np.concatenate((radius * np.cos(tilt), np.full(len(length), radius), radius * np.cos(tilt)))
        rings = (np.outer(out, np.cos(around)), np.outer(out, np.sin(around)))
        local = np.stack((np.broadcast_to(along[:, None], rings[0].shape), *rings), -1).reshape(-1, 3)
    else:
        sides = [np.linspace(-h, h, int(2 * h / spacing) + 2) for h in shape.half]
        faces = []
        for axis in range(3):
            ends = [sides[i] if i != axis else shape.half[[axis, axis]] * [-1, 1] for i in range(3)]
            faces.append(np.stack(np.meshgrid(*ends, indexing="ij"), -1).reshape(-1, 3))
        local = np.concatenate(faces)
    return local @ shape.pose[:3, :3].T + shape.pose[:3, 3]


def test_self_distance_agrees_with_sampled_surfaces(hand: Hand) -> None:
    clouds = {
        link: np.concatenate([surface(shape, 0.001) for shape in hand.shapes if shape.link == link])
        for link in hand.solid_names
    }
    compared = 0
    for q in postures(hand, 2, seed=7):
        links = hand.forward_kinematics(q)
        ours = hand.self_distance(links).numpy()
        pose = dict(zip(hand.link_names, links.numpy(), strict=True))
        trees = {link: cKDTree(clouds[link] @ pose[link][:3, :3].T + pose[link][:3, 3]) for link in clouds}
        for (a, b), distance in zip(hand.self_pairs, ours, strict=True):
            if 0.003 < distance < 0.06:
                sampled = trees[a].query(trees[b].data)[0].min()
                assert distance - 1e-9 <= sampled <= distance + 3e-4, (a, b)  # half a step aside on either surface
                compared += 1
    assert compared > 100


def test_self_distance_agrees_with_contacts_of_the_simulator(hand: Hand) -> None:
    world = mujoco.MjSpec()
    world.compiler.degree = False
    add_hand(world, hand.spec)
    model = world.compile()
    margin = 0.004
    model.geom_margin[:] = margin
    data = mujoco.MjData(model)
    address = [model.joint(name).qposadr[0] for name in hand.joint_names]
    q = postures(hand, 300)
    ours = hand.self_distance(hand.forward_kinematics(q)).numpy()
    number = {frozenset(pair): i for i, pair in enumerate(hand.self_pairs)}
    boxed = {shape.link for shape in hand.shapes if not shape.is_capsule}
    touching = deep = 0
    for posture, distance in zip(q.numpy(), ours, strict=True):
        data.qpos[address] = posture
        mujoco.mj_forward(model, data)
        theirs = np.full(len(number), margin)
        for contact in data.contact:
            bodies = frozenset(model.body(model.geom_bodyid[geom]).name for geom in (contact.geom1, contact.geom2))
            theirs[number[bodies]] = min(theirs[number[bodies]], contact.dist)  # no pair that we leave out
        np.testing.assert_array_equal(theirs < 0, distance < 0)
        # a core inside a box is as deep as its deepest point, for MuJoCo as deep as the way out of the whole capsule
        inside = np.array([bool(boxed & set(pair)) for pair in hand.self_pairs]) & (distance < -0.0095)
        np.testing.assert_allclose(theirs[~inside], distance.clip(max=margin)[~inside], atol=1e-5)
        touching += (distance < 0).sum()
        deep += inside.sum()
    assert touching > 300
    assert deep > 10


def test_self_distance_gradients(hand: Hand) -> None:
    """Also where a core is deep within a box, from which two faces are equally near."""
    q = postures(hand, 400, seed=3)
    distance = hand.self_distance(hand.forward_kinematics(q))
    core = torch.tensor([("palm" in pair) for pair in hand.self_pairs])
    deep = ((distance < -0.0115) & core).any(-1)
    assert deep.sum() >= 4
    chosen = torch.cat((q[deep][:4], q[~deep][:2])).requires_grad_()
    assert gradcheck(lambda q: hand.self_distance(hand.forward_kinematics(q)), chosen, atol=1e-6)


@pytest.mark.parametrize("batch", [(), (0,), (2, 3)])
def test_self_distance_takes_any_batch_and_precision(hand: Hand, batch: tuple[int, ...]) -> None:
    q = postures(hand, int(np.prod(batch))).reshape(*batch, 20).requires_grad_()
    distance = hand.self_distance(hand.forward_kinematics(q))
    assert distance.shape == (*batch, len(hand.self_pairs))
    distance.sum().backward()
    assert torch.isfinite(q.grad).all()
    single = hand.self_distance(hand.forward_kinematics(q.float()))
    torch.testing.assert_close(single.double(), distance, atol=2e-6, rtol=0)


def test_overlap_is_what_the_distance_is_below_zero(hand: Hand) -> None:
    draw = torch.rand(300, len(hand.joint_names), generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    q = (hand.lower + draw * (hand.upper - hand.lower)).requires_grad_()
    overlap = hand.self_overlap(hand.forward_kinematics(q))
    expected = (-hand.self_distance(hand.forward_kinematics(q))).clamp_min(0)
    assert (expected > 0.002).any(-1).sum() > 20
    torch.testing.assert_close(overlap, expected)
    (theirs,) = torch.autograd.grad(expected.sum(), q)
    torch.testing.assert_close(torch.autograd.grad(overlap.sum(), q)[0], theirs)
    assert hand.self_overlap(hand.forward_kinematics(q[:0])).shape == (0, len(hand.self_pairs))


def test_which_links_can_meet(hand: Hand) -> None:
    pairs = {frozenset(pair) for pair in hand.self_pairs}
    assert len(pairs) == len(hand.self_pairs) == 16 * 15 / 2 - 5 - 10  # palm-proximal, and neighbors along a finger
    assert frozenset(("thumb_distal", "palm")) in pairs
    assert frozenset(("index_proximal", "index_distal")) in pairs
    assert frozenset(("index_proximal", "index_middle")) not in pairs


# --- boxes against boxes ---------------------------------------------------------------------------------------------


def two_boxes(sizes: list[list[float]]) -> tuple[list[Primitive], SegmentPairs]:
    shapes = [Primitive(name, np.eye(4), np.array(half), 0.0) for name, half in zip("ab", sizes, strict=True)]
    return shapes, SegmentPairs.between(shapes, [([0], [1])])


def pair_distance(pairs: SegmentPairs, shapes: list[Primitive], poses: torch.Tensor) -> torch.Tensor:
    half = torch.tensor(np.stack([shape.half for shape in shapes])).to(poses)
    return pairs.distance(poses, half, torch.zeros(2).to(poses), 1)[:, 0]


def edge_depth(half_a: np.ndarray, a: np.ndarray, half_b: np.ndarray, b: np.ndarray) -> float:
    """Signed distance to box b of the deepest point among many on the edges of box a."""
    corners = [half_a * np.array(signs) for signs in itertools.product((-1, 1), repeat=3)]
    edges = [(p, q) for p, q in itertools.combinations(corners, 2) if (p != q).sum() == 1]
    t = np.linspace(0, 1, 4001)[:, None]
    points = np.concatenate([p + t * (q - p) for p, q in edges]) @ a[:3, :3].T + a[:3, 3]
    outside = np.abs((points - b[:3, 3]) @ b[:3, :3]) - half_b
    return float((np.linalg.norm(outside.clip(0), axis=1) + outside.max(1).clip(max=0)).min())


@pytest.mark.parametrize("sizes", [[[0.03, 0.02, 0.01]] * 2, [[0.05, 0.004, 0.004], [0.02, 0.03, 0.002]]])
def test_boxes_against_boxes(sizes: list[list[float]]) -> None:
    shapes, pairs = two_boxes(sizes)
    poses = random_poses(400, 5, 0.035).reshape(200, 2, 4, 4)
    ours = pair_distance(pairs, shapes, poses).numpy()
    assert 20 < (ours < 0).sum() < 180
    half = np.concatenate([shape.half for shape in shapes])
    for (a, b), distance in zip(poses.numpy(), ours, strict=True):
        # a point of each box, as close together as can be
        nearest = lsq_linear(np.hstack((a[:3, :3], -b[:3, :3])), b[:3, 3] - a[:3, 3], (-half, half), method="bvls")
        apart = np.sqrt(2 * nearest.cost)
        if distance < 0:
            assert apart < 1e-7
            deepest = min(edge_depth(half[:3], a, half[3:], b), edge_depth(half[3:], b, half[:3], a))
            assert deepest - 2e-5 < distance <= deepest + 1e-9
        else:
            assert distance == pytest.approx(apart, abs=1e-7)


def test_gradients_of_boxes_against_boxes() -> None:
    shapes, pairs = two_boxes([[0.03, 0.02, 0.01]] * 2)
    poses = random_poses(24, 6, 0.03).reshape(12, 2, 4, 4)
    distance = pair_distance(pairs, shapes, poses)
    assert (distance < -0.001).sum() >= 3
    assert (distance > 0.001).sum() >= 3

    def moved(step: torch.Tensor) -> torch.Tensor:
        turn = rotation.to_matrix(rotation.exp(step[..., 3:])) @ poses[..., :3, :3]
        top = torch.cat((turn, (poses[..., :3, 3] + step[..., :3])[..., None]), -1)
        return pair_distance(pairs, shapes, torch.cat((top, poses[..., 3:, :]), -2))

    assert gradcheck(moved, torch.zeros(12, 2, 6, dtype=torch.float64, requires_grad=True), atol=1e-6)


# --- planes ----------------------------------------------------------------------------------------------------------


def test_clearance_gradients_and_batches(hand: Hand) -> None:
    q = postures(hand, 6).reshape(2, 3, 20).requires_grad_()
    plane = torch.tensor([[0.0, 0.6, 0.8, 0.02], [0.48, 0.6, 0.64, 0.1]], dtype=torch.float64)[:, None].requires_grad_()
    height = hand.clearance(hand.forward_kinematics(q), plane)
    assert height.shape == (2, 3, len(hand.solid_names))
    assert gradcheck(lambda q, plane: hand.clearance(hand.forward_kinematics(q), plane), (q, plane))
    assert hand.clearance(hand.forward_kinematics(q[:0]), plane[0, 0]).shape == (0, 3, 16)
    assert hand.clearance(hand.forward_kinematics(q.float()), plane.float()).dtype == torch.float32

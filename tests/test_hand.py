"""The hand against yourdfpy, MuJoCo, pytorch_kinematics, the maker's geometry, and sampled surfaces."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest
import pytorch_kinematics
import torch
import trimesh
import yourdfpy
from torch.autograd import gradcheck

from dexzoo import rotation
from dexzoo.hand import Hand, HandSpec, Primitive
from dexzoo.resources import resource
from dexzoo.rotation import pose_matrix

URDF = resource("robots") / "dlr2" / "dlr2.urdf"
GOLDEN = json.loads((Path(__file__).parent / "golden" / "dlr2_fingertips.json").read_text())
FINGERS = ("thumb", "index", "middle", "ring", "little")


@pytest.fixture(scope="module")
def hand() -> Hand:
    return Hand.load("dlr2")


@pytest.fixture(scope="module")
def left() -> Hand:
    return Hand.load("dlr2", side="left")


def postures(hand: Hand, num: int, seed: int = 0) -> torch.Tensor:
    """All 20 joints anywhere within their limits, float64."""
    generator = torch.Generator().manual_seed(seed)
    share = torch.rand(num, len(hand.joint_names), generator=generator, dtype=torch.float64)
    return hand.lower.double() + share * (hand.upper - hand.lower).double()


def tips(hand: Hand, q20: torch.Tensor) -> torch.Tensor:
    links = hand.forward_kinematics(q20)
    return links[..., [hand.link_names.index(f"{finger}_tip") for finger in FINGERS], :3, 3]


# --- kinematics ------------------------------------------------------------------------------------------------------


def poses_of_yourdfpy(hand: Hand, q20: torch.Tensor) -> np.ndarray:
    robot = yourdfpy.URDF.load(str(URDF), load_meshes=False, build_scene_graph=True)
    for joint in robot.robot.joints:  # all 20 angles are given, coupled or not
        joint.mimic = None
    robot = yourdfpy.URDF(robot.robot, build_scene_graph=True, load_meshes=False)
    order = [hand.joint_names.index(name) for name in robot.actuated_joint_names]
    poses = []
    for q in q20.numpy():
        robot.update_cfg(q[order])
        poses.append([robot.get_transform(link, "palm") for link in hand.link_names])
    return np.array(poses)


def poses_of_mujoco(hand: Hand, q20: torch.Tensor) -> np.ndarray:
    spec = mujoco.MjSpec.from_string(URDF.read_text())
    spec.compiler.fusestatic = False
    model = spec.compile()
    data = mujoco.MjData(model)
    address = [model.joint(name).qposadr[0] for name in hand.joint_names]
    # the palm is MuJoCo's world body
    bodies = [model.body(name).id if name != "palm" else 0 for name in hand.link_names]
    poses = np.tile(np.eye(4), (len(q20), len(bodies), 1, 1))
    for pose, q in zip(poses, q20.numpy(), strict=True):
        data.qpos[address] = q
        mujoco.mj_kinematics(model, data)
        pose[:, :3, :3] = data.xmat[bodies].reshape(-1, 3, 3)
        pose[:, :3, 3] = data.xpos[bodies]
    return poses


def poses_of_pytorch_kinematics(hand: Hand, q20: torch.Tensor) -> np.ndarray:
    text = URDF.read_text().split("?>", 1)[1]
    chain = pytorch_kinematics.build_chain_from_urdf(text).to(dtype=torch.float64)
    return poses_of_chain(chain, hand, q20).numpy()


def poses_of_chain(chain: pytorch_kinematics.Chain, hand: Hand, q20: torch.Tensor) -> torch.Tensor:
    order = [hand.joint_names.index(name) for name in chain.get_joint_parameter_names()]
    poses = chain.forward_kinematics(q20[:, order])
    return torch.stack([poses[link].get_matrix().expand(len(q20), 4, 4) for link in hand.link_names], 1)


@pytest.mark.parametrize("reference", [poses_of_yourdfpy, poses_of_mujoco, poses_of_pytorch_kinematics])
def test_kinematics_agree_with_others(hand: Hand, reference: Callable[[Hand, torch.Tensor], np.ndarray]) -> None:
    q20 = postures(hand, 1000)
    theirs = reference(hand, q20)
    # rotations are held to the same figure, on links of at most 0.1 m
    np.testing.assert_allclose(hand.forward_kinematics(q20), theirs, atol=1e-6, rtol=0)
    np.testing.assert_allclose(hand.forward_kinematics(q20.float()), theirs, atol=1e-6, rtol=0)


def test_kinematics_are_those_of_the_chain(hand: Hand, left: Hand) -> None:
    for side in (hand, left):
        q20 = postures(side, 200, seed=8)
        theirs = poses_of_chain(side.chain, side, q20)
        assert theirs.dtype == torch.float64
        torch.testing.assert_close(side.forward_kinematics(q20), theirs, atol=1e-12, rtol=0)


@pytest.mark.parametrize("posture", GOLDEN["postures"], ids=lambda posture: posture["name"])
def test_fingertips_of_the_makers_sheet(hand: Hand, posture: dict[str, object]) -> None:
    q20 = torch.tensor(np.deg2rad(posture["degrees"] * 5))
    expected = torch.tensor([posture["tips_mm"][finger] for finger in FINGERS], dtype=torch.float64) / 1000
    # the golden values are rounded to 0.01 mm
    torch.testing.assert_close(tips(hand, q20), expected, atol=1e-5, rtol=0)


def test_batch_shapes(hand: Hand) -> None:
    q20 = postures(hand, 6)
    links = hand.forward_kinematics(q20)
    assert links.shape == (6, len(hand.link_names), 4, 4)
    torch.testing.assert_close(hand.forward_kinematics(q20.reshape(2, 3, 20)), links.reshape(2, 3, -1, 4, 4))
    torch.testing.assert_close(hand.forward_kinematics(q20[0]), links[0])


def test_kinematics_have_gradients(hand: Hand) -> None:
    assert gradcheck(hand.forward_kinematics, postures(hand, 2).requires_grad_())


def test_a_first_call_in_inference_mode_does_not_bar_gradients_later() -> None:
    hand = Hand.load("dlr2")
    with torch.inference_mode():
        hand.forward_kinematics(torch.zeros(1, 20))
    q = torch.zeros(1, 20, requires_grad=True)
    hand.forward_kinematics(q).sum().backward()
    assert q.grad is not None


def test_link_names(hand: Hand) -> None:
    parts = ("base", "proximal", "middle", "distal", "tip")
    assert hand.link_names == ["palm", *(f"{finger}_{part}" for finger in FINGERS for part in parts)]


# --- coupling, limits, mass ------------------------------------------------------------------------------------------


def test_coupling_and_limits(hand: Hand) -> None:
    q15 = torch.rand(4, 3, 15)
    q20 = hand.expand(q15)
    assert q20.shape == (4, 3, 20)
    assert torch.equal(hand.reduce(q20), q15)
    assert torch.equal(q20[..., 3::4], q20[..., 2::4])
    assert hand.freedoms == [name for name in hand.joint_names if not name.endswith("dip")]
    limits = np.rad2deg(np.stack((hand.lower, hand.upper), 1)).reshape(5, 4, 2)
    np.testing.assert_allclose(limits, np.tile([(-15, 15), (0, 85), (0, 65), (0, 65)], (5, 1, 1)), atol=1e-4)


def test_total_mass(hand: Hand, left: Hand) -> None:
    for side in (hand, left):
        assert sum(inertia.mass for inertia in side.spec.inertias.values()) == pytest.approx(1.5, abs=1e-6)


def test_inertias_agree_with_mujoco(hand: Hand) -> None:
    spec = mujoco.MjSpec.from_string(URDF.read_text())
    spec.compiler.fusestatic = False
    model = spec.compile()
    for link, inertia in hand.spec.inertias.items():
        if link == "palm":  # the world body of MuJoCo has no mass
            continue
        body = model.body(link)
        assert inertia.mass == pytest.approx(body.mass[0])
        np.testing.assert_allclose(inertia.center, body.ipos, atol=1e-9)
        principal = np.sort(np.linalg.eigvalsh(inertia.matrix))
        np.testing.assert_allclose(principal, np.sort(body.inertia), rtol=1e-6)


def test_each_number_of_the_tables_is_a_number(hand: Hand) -> None:
    for joint in hand.spec.joints:
        for value in (joint.lower, joint.upper, joint.effort, joint.damping, joint.multiplier, joint.offset):
            assert isinstance(value, float)


@pytest.mark.parametrize("finger", ["index", "middle"])
def test_thumb_opposes(hand: Hand, finger: str) -> None:
    """Some posture within the limits brings the two tip frames together: free joints through a sigmoid, Adam."""
    pair = [FINGERS.index("thumb"), FINGERS.index(finger)]
    lower, upper = hand.reduce(hand.lower), hand.reduce(hand.upper)
    free = torch.zeros(15, requires_grad=True)
    optimizer = torch.optim.Adam([free], lr=0.1)
    for _ in range(300):
        thumb, other = tips(hand, hand.expand(lower + torch.sigmoid(free) * (upper - lower)))[pair]
        gap = (thumb - other).norm()
        optimizer.zero_grad()
        gap.backward()
        optimizer.step()
        if gap < 5e-4:
            break
    assert gap < 1e-3


@pytest.mark.parametrize("finger", ["index", "middle"])
def test_pads_face_each_other(hand: Hand, finger: str) -> None:
    """Pads 20 mm apart within 25 degrees of the line that joins them, as a friction cone of 0.5 asks for."""
    pair = [hand.pad_names.index("thumb"), hand.pad_names.index(finger)]
    free = 2 * torch.randn(128, 15, generator=torch.Generator().manual_seed(0))
    optimizer = torch.optim.Adam([free.requires_grad_()], lr=0.1)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 800)
    for _ in range(800):
        points, normals = hand.pads(hand.forward_kinematics(hand.expand(hand.squash(free))))
        line = points[:, pair[1]] - points[:, pair[0]]
        gap = line.norm(dim=-1)
        cosine = ((normals[:, pair] * torch.stack((line, -line), 1)).sum(-1) / gap[:, None]).amin(-1)
        loss = ((gap - 0.02) / 0.002).square() - 300 * cosine
        optimizer.zero_grad()
        loss.sum().backward()
        optimizer.step()
        schedule.step()
    angle = torch.rad2deg(torch.acos(cosine.detach().clamp(-1, 1)))
    best = angle[(gap - 0.02).abs() < 1e-3].min()
    assert best < 25


# --- the left hand ---------------------------------------------------------------------------------------------------


def mirrored(q20: torch.Tensor) -> torch.Tensor:
    """The posture of the other side: abduction is about the palm's normal, so it changes its sign."""
    flipped = q20.clone()
    flipped[..., 0::4] *= -1
    return flipped


def test_left_hand_is_the_mirror_image(hand: Hand, left: Hand) -> None:
    assert left.spec.side == "left"
    assert torch.equal(left.lower, hand.lower)
    assert torch.equal(left.upper, hand.upper)
    q20 = postures(hand, 50)
    flip = torch.tensor([1.0, -1, 1], dtype=torch.float64)
    torch.testing.assert_close(tips(left, mirrored(q20)), tips(hand, q20) * flip)
    links = left.forward_kinematics(mirrored(q20))
    assert (torch.linalg.det(links[..., :3, :3]) - 1).abs().max() < 1e-6


def test_left_shapes_and_masses_are_mirrored(hand: Hand, left: Hand) -> None:
    q20 = postures(hand, 5)
    links, left_links = hand.forward_kinematics(q20), left.forward_kinematics(mirrored(q20))
    flip = torch.tensor([1.0, -1, 1], dtype=torch.float64)
    points = torch.rand(5, 200, 3, dtype=torch.float64) * 0.4 - 0.2 + torch.tensor([0, 0, 0.1])
    torch.testing.assert_close(left.signed_distance(left_links, points * flip), hand.signed_distance(links, points))
    for link, inertia in hand.spec.inertias.items():
        index = hand.link_names.index(link)
        turn, left_turn = links[:, index, :3, :3].numpy(), left_links[:, index, :3, :3].numpy()
        center = turn @ inertia.center + links[:, index, :3, 3].numpy()
        left_center = left_turn @ left.spec.inertias[link].center + left_links[:, index, :3, 3].numpy()
        np.testing.assert_allclose(left_center, center * flip.numpy(), atol=1e-8)
        world = turn @ inertia.matrix @ turn.swapaxes(-1, -2)
        left_world = left_turn @ left.spec.inertias[link].matrix @ left_turn.swapaxes(-1, -2)
        np.testing.assert_allclose(left_world, world * np.outer(flip, flip), atol=1e-9)


# --- distances -------------------------------------------------------------------------------------------------------


def solid(shape: Primitive) -> trimesh.Trimesh:
    """A mesh of a primitive, in the frame of its link; a capsule's lies within 0.05 mm of it."""
    if shape.radius == 0:
        return trimesh.creation.box(extents=2 * shape.half, transform=shape.pose)
    mesh = trimesh.creation.capsule(height=2 * shape.half[0], radius=shape.radius, count=[40, 40])
    along_x = trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0])
    middle = trimesh.transformations.translation_matrix(-mesh.bounds.mean(0))
    return mesh.apply_transform(shape.pose @ along_x @ middle)


@pytest.fixture(scope="module")
def meshes(hand: Hand) -> dict[str, list[trimesh.Trimesh]]:
    return {link: [solid(shape) for shape in hand.spec.primitives if shape.link == link] for link in hand.solid_names}


def test_signed_distance_agrees_with_meshes(hand: Hand, meshes: dict[str, list[trimesh.Trimesh]]) -> None:
    links = hand.forward_kinematics(postures(hand, 1, seed=2)[0])
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.1, -0.15, -0.05], [0.15, 0.15, 0.25], (150, 3))
    ours = hand.signed_distance(links, torch.tensor(points)).numpy()
    assert (ours < 0).any()
    for link, distance in zip(hand.solid_names, ours, strict=True):
        T = links[hand.link_names.index(link)].numpy()
        local = (points - T[:3, 3]) @ T[:3, :3]
        each = [-trimesh.proximity.signed_distance(mesh, local) for mesh in meshes[link]]
        np.testing.assert_allclose(distance, np.min(each, axis=0), atol=1e-4)


def test_signed_distance_is_zero_on_the_surface(hand: Hand, meshes: dict[str, list[trimesh.Trimesh]]) -> None:
    links = hand.forward_kinematics(torch.zeros(20, dtype=torch.float64))
    for i, link in enumerate(hand.solid_names):
        T = links[hand.link_names.index(link)].numpy()
        for mesh in meshes[link]:
            surface = mesh.sample(100, seed=0) @ T[:3, :3].T + T[:3, 3]
            distance = hand.signed_distance(links, torch.tensor(surface))[i]
            assert distance.max() < 1e-4  # below zero only where another primitive of the link covers it
            if len(meshes[link]) == 1:
                assert distance.min() > -1e-4


def wrist_poses(num: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(4)
    position = torch.rand(num, 3, generator=generator, dtype=torch.float64) * 0.2
    return pose_matrix(position, rotation.random(num, generator).double())


def test_clearance_is_that_of_the_lowest_surface_point(hand: Hand, meshes: dict[str, list[trimesh.Trimesh]]) -> None:
    links = wrist_poses(4)[:, None] @ hand.forward_kinematics(postures(hand, 4))
    plane = torch.tensor([0.48, 0.6, 0.64, 0.03], dtype=torch.float64)
    ours = hand.clearance(links, plane)
    assert ours.shape == (4, len(hand.solid_names))
    for i, link in enumerate(hand.solid_names):
        corners = np.concatenate([mesh.vertices for mesh in meshes[link]])
        T = links[:, hand.link_names.index(link)].numpy()
        surface = corners @ T[:, :3, :3].swapaxes(-1, -2) + T[:, None, :3, 3]
        lowest = (surface @ plane[:3].numpy() + float(plane[3])).min(-1)
        np.testing.assert_allclose(ours[:, i], lowest, atol=1e-4)


def test_distances_broadcast(hand: Hand) -> None:
    links = wrist_poses(3)[:, None] @ hand.forward_kinematics(postures(hand, 3))
    cloud = torch.rand(7, 3, dtype=torch.float64)
    one_cloud = hand.signed_distance(links, cloud)
    assert one_cloud.shape == (3, len(hand.solid_names), 7)
    torch.testing.assert_close(one_cloud, hand.signed_distance(links, cloud.expand(3, 7, 3)))
    planes = torch.tensor([[0, 0, 1.0, 0], [0, 1, 0, 0.1], [1, 0, 0, 0.2]], dtype=torch.float64)
    torch.testing.assert_close(hand.clearance(links, planes)[1], hand.clearance(links[1], planes[1]))


def test_the_closest_point_of_each_link(hand: Hand) -> None:
    q20 = postures(hand, 4).requires_grad_()
    points = torch.rand(2, 1, 9, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64) * 0.2
    points.requires_grad_()
    ours = hand.closest_distance(hand.forward_kinematics(q20), points)
    every = hand.signed_distance(hand.forward_kinematics(q20), points).amin(-1)
    assert ours.shape == (2, 4, len(hand.solid_names))
    torch.testing.assert_close(ours, every)
    theirs = torch.autograd.grad(every.sin().sum(), (q20, points))
    torch.testing.assert_close(torch.autograd.grad(ours.sin().sum(), (q20, points)), theirs)
    assert (hand.closest_distance(hand.forward_kinematics(q20), points[..., :0, :]) == torch.inf).all()


def test_distances_have_gradients(hand: Hand) -> None:
    q20 = postures(hand, 1)[0].requires_grad_()
    generator = torch.Generator().manual_seed(5)
    points = torch.rand(6, 3, generator=generator, dtype=torch.float64) * 0.2
    plane = torch.tensor([0, 0.6, 0.8, 0.02], dtype=torch.float64)
    assert gradcheck(lambda q: hand.signed_distance(hand.forward_kinematics(q), points), q20)
    assert gradcheck(lambda p: hand.signed_distance(hand.forward_kinematics(q20.detach()), p), points.requires_grad_())
    assert gradcheck(lambda q: hand.clearance(hand.forward_kinematics(q), plane), q20)


def test_gradient_is_finite_where_the_distance_has_a_kink(hand: Hand) -> None:
    """On the axis of a capsule and on the faces of a box."""
    links = hand.forward_kinematics(torch.zeros(20, dtype=torch.float64))
    axis = links[hand.link_names.index("index_distal"), :3, 3] + 0
    face = torch.tensor([0.033, -0.02, 0.02], dtype=torch.float64)
    points = torch.stack((axis, face)).requires_grad_()
    hand.signed_distance(links, points).sum().backward()
    assert torch.isfinite(points.grad).all()


# --- errors ----------------------------------------------------------------------------------------------------------


def test_wrong_number_of_angles_is_explained(hand: Hand) -> None:
    with pytest.raises(ValueError, match=r"20 joint angles, got 15; use hand\.expand first"):
        hand.forward_kinematics(torch.zeros(2, 15))
    with pytest.raises(ValueError, match="15 free joints, got 20 angles"):
        hand.expand(torch.zeros(20))


def test_check_names_joint_value_and_limits(hand: Hand) -> None:
    q20 = torch.zeros(3, 2, 20)
    hand.check(q20)
    hand.check(hand.upper)
    q20[1, 0, 9] = 1.6
    with pytest.raises(ValueError, match=r"joint middle_mcp is at 1\.600 rad, outside its limits 0\.000 to 1\.484"):
        hand.check(q20)
    q20[1, 0, 9] = float("nan")
    with pytest.raises(ValueError, match="not finite"):
        hand.check(q20)


@pytest.mark.usefixtures("as_users_run_it")
def test_unknown_hand_and_side() -> None:
    with pytest.raises(FileNotFoundError, match=r"hand 'shadow' has no hand\.yaml; known hands: .*dlr2"):
        Hand.load("shadow")
    with pytest.raises(ValueError, match="side 'top' is unknown"):
        HandSpec.load("dlr2", side="top")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return Path(shutil.copytree(URDF.parent, tmp_path / "copy"))


def rewrite(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_a_hand_loads_from_a_folder(folder: Path, hand: Hand) -> None:
    other = Hand.load(folder)
    assert other.link_names == hand.link_names
    assert other.spec.name == "copy"


def test_equal_hands_have_equal_digests(folder: Path, hand: Hand, left: Hand) -> None:
    renamed = folder.rename(folder.with_name("another_name"))
    for side in (hand, left):
        for same in (Hand.load("dlr2", side.spec.side), Hand.load(renamed, side.spec.side)):
            assert same.digest == side.digest
            assert same == side
            assert hash(same) == hash(side)
    assert left.digest != hand.digest
    assert left != hand


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [("hand.yaml", "radius: 0.011", "radius: 0.012"), ("dlr2.urdf", '<mass value="', '<mass value="1')],
)
def test_a_changed_hand_has_another_digest(folder: Path, hand: Hand, file: str, old: str, new: str) -> None:
    rewrite(folder / file, old, new)
    assert Hand.load(folder).digest != hand.digest
    assert Hand.load(folder) != hand


def test_a_folder_of_the_same_name_does_not_hide_a_hand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "dlr2").mkdir()
    monkeypatch.chdir(tmp_path)
    assert len(Hand.load("dlr2").joint_names) == 20


BAD_FILES = [
    (
        "dlr2.urdf",
        '<mimic joint="thumb_pip"',
        '<mimic joint="thumb_knuckle"',
        "coupled to thumb_knuckle, which does not",
    ),
    (
        "dlr2.urdf",
        '<mimic joint="thumb_pip"',
        '<mimic joint="index_dip"',
        "coupled to index_dip, which is coupled itself",
    ),
    (
        "dlr2.urdf",
        '<parent link="thumb_base"/>',
        '<parent link="thumb_root"/>',
        "thumb_mcp.* not reached from the palm",
    ),
    ("dlr2.urdf", "</robot>", "", "is not a URDF"),
    (
        "hand.yaml",
        "link: thumb_distal,",
        "link: thumb_dista,",
        "link thumb_dista is not in the URDF, did you mean thumb_distal",
    ),
    ("hand.yaml", "thumb_abd, ", "", "differ in thumb_abd"),
    ("hand.yaml", "palm: palm ", "palms: palm ", "lacks the entry 'palm'"),
    ("hand.yaml", "radius: 0.011", "r: 0.011", "lacks the entry 'radius'"),
    ("hand.yaml", "{capsule:", "{cone:", "is cone; use capsule or box"),
    ("hand.yaml", "exclude:", "exclude: [", "is not YAML"),
    ("hand.yaml", "urdf: dlr2.urdf", "urdf: none.urdf", r"none\.urdf does not exist"),
]


@pytest.mark.parametrize(("file", "old", "new", "message"), BAD_FILES)
def test_bad_files_are_refused_in_one_line(folder: Path, file: str, old: str, new: str, message: str) -> None:
    rewrite(folder / file, old, new)
    with pytest.raises((ValueError, FileNotFoundError), match=message) as caught:
        Hand.load(folder)
    assert "\n" not in str(caught.value)


def test_a_hand_without_mirror_has_one_side(folder: Path) -> None:
    rewrite(folder / "hand.yaml", "mirror:", "other:")
    assert Hand.load(folder).spec.side == "right"
    with pytest.raises(ValueError, match="has no left side"):
        Hand.load(folder, side="left")

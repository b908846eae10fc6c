"""Hands of another side and another build: the left one, and the three fingers of boxes in docs/your-hand.md."""

import re
from itertools import combinations
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest
import torch
import trimesh
from torch.autograd import gradcheck

from dexzoo.cli.main import main
from dexzoo.grasp import Grasps
from dexzoo.hand import Hand, Side
from dexzoo.resources import resource
from dexzoo.sim import Outcomes, Scene
from dexzoo.sim.robot import add_hand
from dexzoo.sim.trial import run
from dexzoo.viewing.hand_page import view_hand

PAGE = Path(__file__).parent.parent / "docs" / "your-hand.md"


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE.read_text(), re.S)


# --- the left hand ---------------------------------------------------------------------------------------------------


def mirrored(grasps: Grasps, hand: Hand) -> Grasps:
    """The same by some hand on the other side of the plane y = 0 of the world."""
    wrist, joints = grasps.wrist.clone(), grasps.joints.clone()
    wrist[..., [1, 4, 6]] *= -1  # y; x and z of the quaternion
    joints[..., 0::4] *= -1  # abduction
    return Grasps(wrist, joints, grasps.grasp_type, hand)


def test_the_left_hand_holds_what_the_right_one_holds(
    can_scene: Scene, can_grasps: Grasps, can_outcomes: Outcomes
) -> None:
    grasps = can_grasps[can_outcomes.success]
    flip = np.diag([1.0, -1, 1, 1])
    scene = Scene(can_scene.object, flip @ can_scene.T_world_object @ flip)  # the can is its own mirror image
    # near the edge a trial is chaotic, and masses are mirrored only to rounding
    assert run(scene, mirrored(grasps, Hand.load("dlr2", side="left"))).success.mean() > 0.7
    assert run(scene, mirrored(grasps, Hand.load("dlr2"))).success.mean() < 0.3


# --- a hand of three fingers -----------------------------------------------------------------------------------------


def box_link(name: str, mass: float, center: tuple[float, ...], half: tuple[float, ...]) -> str:
    moments = [mass / 3 * (half[(i + 1) % 3] ** 2 + half[(i + 2) % 3] ** 2) for i in range(3)]
    return (
        f'<link name="{name}"><inertial><origin xyz="{" ".join(map(str, center))}"/><mass value="{mass}"/>'
        f'<inertia ixx="{moments[0]}" iyy="{moments[1]}" izz="{moments[2]}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    )


def joint(
    name: str,
    parent: str,
    child: str,
    xyz: str,
    axis: str = "",
    limits: tuple[float, float] = (0, 0),
    mimic: tuple[str, float, float] | None = None,
    rpy: str = "0 0 0",
) -> str:
    text = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}" rpy="{rpy}"/>'
    if not axis:
        return f'<joint name="{name}" type="fixed">{text}</joint>'
    text += f'<axis xyz="{axis}"/><limit lower="{limits[0]}" upper="{limits[1]}" effort="0.8" velocity="6"/>'
    if mimic is not None:
        text += f'<mimic joint="{mimic[0]}" multiplier="{mimic[1]}" offset="{mimic[2]}"/>'
    return f'<joint name="{name}" type="revolute">{text}<dynamics damping="0.02"/></joint>'


FLEX, CURL = (-0.3, 1.2), (-0.1, 1.1)
TRIPOD = [
    box_link("base", 0.4, (0, 0, 0), (0.045, 0.045, 0.015)),
    '<link name="left_mount"/><link name="right_mount"/><link name="thumb_tip"/>',
    *(box_link(f"{side}_knuckle", 0.01, (0, 0, 0.005), (0.008, 0.008, 0.005)) for side in ("left", "right")),
    *(box_link(f"{f}_lower", 0.03, (0, 0, 0.03), (0.008, 0.010, 0.026)) for f in ("thumb", "left", "right")),
    *(box_link(f"{f}_upper", 0.02, (0, 0, 0.022), (0.007, 0.009, 0.020)) for f in ("thumb", "left", "right")),
    joint("left_root", "base", "left_mount", "0.04 0.03 0.002", rpy="0 0 0.3"),
    joint("right_root", "base", "right_mount", "0.04 -0.03 0.002", rpy="0 0 -0.3"),
    joint("thumb_flex", "base", "thumb_lower", "-0.05 0 0.02", "0 1 0", FLEX),
    joint("thumb_curl", "thumb_lower", "thumb_upper", "0 0 0.06", "0 1 0", CURL, ("thumb_flex", 0.7, 0.2)),
    joint("thumb_end", "thumb_upper", "thumb_tip", "0 0 0.043"),
    joint("left_spread", "left_mount", "left_knuckle", "0.01 0 0.014", "0 0 1", (-0.3, 0.3)),
    joint("left_flex", "left_knuckle", "left_lower", "0 0 0.006", "0 -2 0", FLEX),
    joint("left_curl", "left_lower", "left_upper", "0 0 0.06", "0 -1 0", CURL, ("left_flex", 0.7, 0.2)),
    joint("right_spread", "right_mount", "right_knuckle", "0.01 0 0.014", "0 0 1", (-0.3, 0.3), ("left_spread", -1, 0)),
    joint("right_flex", "right_knuckle", "right_lower", "0 0 0.006", "0 -1 0", FLEX),
    joint("right_curl", "right_lower", "right_upper", "0 0 0.06", "0 -1 0", CURL, ("right_flex", 0.5, 0.3)),
]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The hand of the page, as anyone would write it."""
    if not PAGE.exists():
        pytest.skip("docs/your-hand.md is not beside the tests")
    tripod = tmp_path / "tripod"
    tripod.mkdir()
    (tripod / "tripod.urdf").write_text('<?xml version="1.0"?>\n<robot name="tripod">' + "\n".join(TRIPOD) + "</robot>")
    (tripod / "hand.yaml").write_text(blocks("yaml")[0])
    return tripod


@pytest.fixture
def tripod(folder: Path) -> Hand:
    return Hand.load(folder)


def postures(hand: Hand, num: int, coupled: bool = True) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    size = len(hand.freedoms if coupled else hand.joint_names)
    lower, upper = (hand.reduce(limit) if coupled else limit for limit in (hand.lower.double(), hand.upper.double()))
    q = lower + (upper - lower) * torch.rand(num, size, generator=generator, dtype=torch.float64)
    return hand.expand(q) if coupled else q


def twin(hand: Hand) -> tuple[mujoco.MjModel, mujoco.MjData]:
    world = mujoco.MjSpec()
    world.compiler.degree = False
    add_hand(world, hand.spec)
    model = world.compile()
    return model, mujoco.MjData(model)


def test_a_hand_is_named_as_its_folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    assert Hand.load(".").spec.name == Hand.load(folder).spec.name == "tripod"


def test_tables(tripod: Hand) -> None:
    assert tripod.freedoms == ["thumb_flex", "left_spread", "left_flex", "right_flex"]
    assert tripod.link_names[0] == "base"
    assert tripod.pad_names == ["thumb", "left", "right"]
    assert len(tripod.solid_names) == 9
    assert tripod.spec.joint("left_flex").axis.tolist() == [0, -1, 0]
    q = tripod.expand(torch.tensor([0.5, 0.1, 0.4, -0.2]))
    expected = [0.5, 0.7 * 0.5 + 0.2, 0.1, 0.4, 0.7 * 0.4 + 0.2, -0.1, -0.2, 0.5 * -0.2 + 0.3]
    torch.testing.assert_close(q, torch.tensor(expected))
    torch.testing.assert_close(tripod.reduce(q), torch.tensor([0.5, 0.1, 0.4, -0.2]))
    with pytest.raises(ValueError, match=r"a posture has 8 joint angles, got 4; use hand\.expand first"):
        tripod.forward_kinematics(torch.zeros(4))


def test_kinematics_agree_with_mujoco(tripod: Hand, folder: Path) -> None:
    spec = mujoco.MjSpec.from_string((folder / "tripod.urdf").read_text())
    spec.compiler.fusestatic = False
    model = spec.compile()
    data = mujoco.MjData(model)
    address = [model.joint(name).qposadr[0] for name in tripod.joint_names]
    bodies = [0 if name == "base" else model.body(name).id for name in tripod.link_names]
    q = postures(tripod, 200, coupled=False)
    for posture, links in zip(q.numpy(), tripod.forward_kinematics(q).numpy(), strict=True):
        data.qpos[address] = posture
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(links[:, :3, 3], data.xpos[bodies], atol=1e-6)
        np.testing.assert_allclose(links[:, :3, :3].reshape(-1, 9), data.xmat[bodies], atol=1e-6)
    assert gradcheck(tripod.forward_kinematics, q[:2].requires_grad_())


def test_limits_hold_for_coupled_joints_too(tripod: Hand) -> None:
    for limit in (tripod.lower, tripod.upper):
        tripod.check(tripod.expand(tripod.reduce(limit)))
    wide = torch.linspace(-9, 9, 4)
    for step in (tripod.clamp, tripod.reflect, tripod.squash):
        tripod.check(tripod.expand(step(wide)))
        assert step(wide.repeat(2)).shape == (8,)
    q = tripod.random(50, torch.Generator().manual_seed(0))
    tripod.check(q)
    torch.testing.assert_close(q, tripod.expand(tripod.reduce(q)))
    assert (tripod.self_distance(tripod.forward_kinematics(q)) > 0).all()


def test_distances_agree_with_meshes(tripod: Hand) -> None:
    links = tripod.forward_kinematics(postures(tripod, 1)[0])
    poses = tripod.shape_poses(links).numpy()
    meshes = [shape.mesh().apply_transform(pose) for shape, pose in zip(tripod.shapes, poses, strict=True)]
    points = np.random.default_rng(0).uniform([-0.1, -0.1, -0.05], [0.1, 0.1, 0.15], (150, 3))
    by_shape = -np.array([trimesh.proximity.signed_distance(mesh, points) for mesh in meshes])
    expected = [by_shape[[shape.link == name for shape in tripod.shapes]].min(0) for name in tripod.solid_names]
    tolerance = 3e-4  # by which the mesh of a capsule is flatter
    np.testing.assert_allclose(tripod.signed_distance(links, torch.tensor(points)), expected, atol=tolerance)
    plane = torch.tensor([0.48, 0.6, 0.64, 0.03], dtype=torch.float64)
    heights = np.array([(mesh.vertices @ plane[:3].numpy() + 0.03).min() for mesh in meshes])
    lowest = [heights[[shape.link == name for shape in tripod.shapes]].min() for name in tripod.solid_names]
    np.testing.assert_allclose(tripod.clearance(links, plane), lowest, atol=tolerance)


def test_links_of_boxes_meet_where_the_simulator_says(tripod: Hand) -> None:
    model, data = twin(tripod)
    address = [model.joint(name).qposadr[0] for name in tripod.joint_names]
    q = postures(tripod, 300)
    ours = tripod.self_distance(tripod.forward_kinematics(q)).numpy()
    touched = set()
    for posture, distance in zip(q.numpy(), ours, strict=True):
        data.qpos[address] = posture
        mujoco.mj_forward(model, data)
        theirs = {
            frozenset(model.body(model.geom_bodyid[geom]).name for geom in (contact.geom1, contact.geom2))
            for contact in data.contact
            if contact.dist < -1e-5
        }
        deep = {frozenset(pair) for pair, gap in zip(tripod.self_pairs, distance, strict=True) if gap < -1e-5}
        slight = {frozenset(pair) for pair, gap in zip(tripod.self_pairs, distance, strict=True) if gap < 1e-5}
        assert deep <= theirs | slight, posture
        assert theirs <= slight, posture
        touched |= theirs
    assert len(touched) >= 3
    pairs = {frozenset(pair) for pair in tripod.self_pairs}
    # parts of the palm are one body, and so touch the first links of the fingers that it carries
    assert not pairs & {frozenset(pair) for pair in combinations(["base", "left_mount", "right_mount"], 2)}
    assert frozenset(("thumb_upper", "left_mount")) in pairs


def test_distances_have_gradients(tripod: Hand) -> None:
    q = postures(tripod, 3).requires_grad_()
    points = torch.rand(5, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 0.1
    assert gradcheck(lambda q: tripod.signed_distance(tripod.forward_kinematics(q), points), q)
    assert gradcheck(lambda q: tripod.self_distance(tripod.forward_kinematics(q)), q, atol=1e-6)
    assert gradcheck(lambda q: tripod.clearance(tripod.forward_kinematics(q), points.new_tensor([0, 0.6, 0.8, 0])), q)


@pytest.mark.parametrize("side", ["right", "left"])
def test_twin_has_the_masses_limits_and_couplings(folder: Path, side: Side) -> None:
    hand = Hand.load(folder, side)
    model, data = twin(hand)
    assert model.body_mass.sum() == pytest.approx(0.4 + 2 * 0.01 + 3 * 0.05)
    for link, inertia in hand.spec.inertias.items():
        assert model.body(link).mass[0] == pytest.approx(inertia.mass)
        np.testing.assert_allclose(
            np.sort(model.body(link).inertia), np.linalg.eigvalsh(inertia.matrix), rtol=1e-6, atol=1e-12
        )
    for name, lower, upper in zip(hand.joint_names, hand.lower, hand.upper, strict=True):
        np.testing.assert_allclose(model.joint(name).range, [lower, upper], atol=1e-6)
        np.testing.assert_allclose(model.actuator(name).forcerange, [-0.8, 0.8])
    servos = [model.actuator(name).id for name in hand.joint_names]
    address = [model.joint(name).qposadr[0] for name in hand.joint_names]
    target = hand.expand(torch.tensor([0.2, 0.2, -0.1, 0.3], dtype=torch.float64))
    assert (hand.self_distance(hand.forward_kinematics(target)) > 0).all()
    data.qpos[address] = hand.expand(torch.zeros(4)).numpy()
    # only the free joints are pulled: the coupled ones must follow by the constraint alone
    data.ctrl[servos] = target
    model.actuator_gainprm[[model.actuator(name).id for name in hand.joint_names if name not in hand.freedoms]] = 0
    model.actuator_biasprm[[model.actuator(name).id for name in hand.joint_names if name not in hand.freedoms]] = 0
    worst = 0.0
    for _ in range(500):
        mujoco.mj_step(model, data)
        q = torch.tensor(data.qpos[address])
        worst = max(worst, float((q - hand.expand(hand.reduce(q))).abs().max()))
    assert worst < 0.02
    np.testing.assert_allclose(data.qpos[address], target, atol=0.02)


def mirror(folder: Path, knuckles: dict[str, str]) -> tuple[Hand, Hand, torch.Tensor]:
    """Both sides where knuckles are mirrored along these axes, and the signs of the angles that mirror a posture."""
    path = folder / "hand.yaml"
    entries = "".join(f"{side}_knuckle: {axis}, " for side, axis in knuckles.items())
    path.write_text(path.read_text().replace("mirror: {", "mirror: {" + entries))
    right, left = Hand.load(folder), Hand.load(folder, side="left")
    across = {f"{side}_spread" for side, axis in knuckles.items() if axis != "z"}
    return right, left, torch.tensor([-1.0 if name in across else 1.0 for name in left.joint_names]).double()


def assert_mirror_image(right: Hand, left: Hand, sign: torch.Tensor) -> None:
    q = postures(right, 20)
    left.check(q * sign)
    torch.testing.assert_close(left.expand(left.reduce(q * sign)), q * sign)
    lower, upper = right.lower.double(), right.upper.double()
    torch.testing.assert_close(left.lower.double(), torch.minimum(sign * lower, sign * upper))
    flip = torch.tensor([1.0, -1, 1], dtype=torch.float64)
    links, left_links = right.forward_kinematics(q), left.forward_kinematics(q * sign)
    torch.testing.assert_close(left_links[..., :3, 3], links[..., :3, 3] * flip)
    points = torch.rand(20, 50, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 0.2 - 0.1
    theirs = left.signed_distance(left_links, points * flip)
    torch.testing.assert_close(theirs, right.signed_distance(links, points))
    torch.testing.assert_close(left.self_distance(left_links), right.self_distance(links))
    for ours, others in zip(left.pads(left_links), right.pads(links), strict=True):
        torch.testing.assert_close(ours, others * flip)


# an angle about the axis along which its link is mirrored keeps its sign
KNUCKLES: list[dict[str, str]] = [{}, {"left": "x", "right": "y"}, {"left": "z", "right": "x"}]


@pytest.mark.parametrize("knuckles", KNUCKLES, ids=str)
def test_the_other_side_is_the_mirror_image(folder: Path, knuckles: dict[str, str]) -> None:
    assert_mirror_image(*mirror(folder, knuckles))


@pytest.mark.parametrize("knuckles", KNUCKLES, ids=str)
def test_any_axis_and_any_limit_can_be_mirrored(folder: Path, knuckles: dict[str, str]) -> None:
    """Limits that are not symmetric, an offset, and axes that lie neither along nor across that of the mirror."""
    urdf = folder / "tripod.urdf"
    text = urdf.read_text()
    for old, new in [
        ('<axis xyz="0 1 0"/>', '<axis xyz="0.3 0.9 0.2"/>'),
        ('<axis xyz="0 0 1"/><limit lower="-0.3"', '<axis xyz="0.1 0.2 1"/><limit lower="-0.2"'),
        ('"left_spread" multiplier="-1" offset="0"', '"left_spread" multiplier="0.5" offset="0.1"'),
    ]:
        assert old in text
        text = text.replace(old, new)
    urdf.write_text(text)
    assert_mirror_image(*mirror(folder, knuckles))


def test_the_viewer_shows_it(tripod: Hand) -> None:
    pytest.importorskip("viser")
    page = view_hand(tripod, port=0)
    try:
        assert list(page.sliders) == tripod.freedoms
        q = torch.tensor([0.3, 0.2, 0.1, 0.5], dtype=torch.float64)
        page.move(q)
        torch.testing.assert_close(page.posture, tripod.expand(q), atol=1e-3, rtol=0)  # sliders have steps
    finally:
        page.stop()


# --- the page --------------------------------------------------------------------------------------------------------


def test_the_snippets_of_the_page_run_and_lift_a_can(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder.parent)
    trimesh.creation.cylinder(0.03, 0.1).export("can.obj")
    names: dict[str, Any] = {}
    for block in blocks("python"):
        exec(block, names)
    assert names["lift"](0.9) > 0.28
    assert abs(names["lift"](-0.2)) < 0.01
    # at rest in the hand the couplings hold under the load of the grip
    names["lift"](0.9)
    q = torch.tensor(names["data"].qpos[names["joints"]])
    hand = names["hand"]
    torch.testing.assert_close(q, hand.expand(hand.reduce(q)), atol=0.03, rtol=0)
    assert (q[[0, 3, 6]] < 0.85).all()  # the can stops the fingers before their command


def test_the_page_names_every_key_and_quotes_the_urdf(folder: Path) -> None:
    keys = {line.split(":")[0] for line in blocks("yaml")[0].splitlines() if re.match(r"\w+:", line)}
    shipped = (resource("robots") / "dlr2" / "hand.yaml").read_text()
    assert keys == {line.split(":")[0] for line in shipped.splitlines() if re.match(r"\w+:", line)}
    quoted = ElementTree.fromstring(blocks("xml")[0])
    written = ElementTree.parse(folder / "tripod.urdf").find("joint[@name='thumb_curl']")
    assert written is not None
    for element in quoted:
        other = written.find(element.tag)
        assert other is not None
        for key, value in element.attrib.items():
            assert (
                np.allclose(*[[float(v) for v in t.split()] for t in (value, other.attrib[key])])
                if re.match(r"[-\d]", value)
                else value == other.attrib[key]
            )


# --- errors ----------------------------------------------------------------------------------------------------------

BAD = [
    (
        "hand.yaml",
        "  - [thumb_flex, thumb_curl]",
        "  - thumb_flex",
        "joint thumb_flex stands alone; joints takes a list",
    ),
    (
        "hand.yaml",
        "half: [0.045, 0.045, 0.015]",
        "half: [0.045, 0.045]",
        "half of the box of link base is .* expected three",
    ),
    ("hand.yaml", "half: [0.045, 0.045, 0.015]", "half: [0.045, 0, 0.015]", "half of the box of link base .* positive"),
    (
        "hand.yaml",
        "rpy: [0, 0, 0.785]",
        "rpy: [0, 0, x]",
        "rpy of the box of link left_mount is .* expected three numbers",
    ),
    (
        "hand.yaml",
        "to: [0, 0.006, 0.036]",
        "to: [0, -0.006, 0.036]",
        "radius and length of the capsule of link thumb_upper",
    ),
    ("hand.yaml", "normal: [1, 0, 0]", "normal: [0, 0, 0]", "normal of the pad thumb is zero"),
    ("hand.yaml", "point: [0.007, 0, 0.036]", "point: 3", "point of the pad thumb is 3, expected three numbers"),
    ("hand.yaml", "  base: [{box", "  - base: [{box", "is not YAML"),
    ("hand.yaml", "exclude:", "exclude: 3  #", "is not YAML|lacks the form"),
    (
        "hand.yaml",
        "  - [base, thumb_lower]",
        "  - [base, thumb_lowr]",
        "link thumb_lowr is not .* did you mean thumb_lower",
    ),
    (
        "tripod.urdf",
        '"thumb_flex" multiplier',
        '"thumb_flx" multiplier',
        "thumb_curl is coupled to thumb_flx, which does not",
    ),
    (
        "tripod.urdf",
        'multiplier="0.7"',
        'multiplier="1.7"',
        r"_curl would follow \w+_flex at -0\.3 to -0\.310 rad, outside its limits -0\.100 to 1\.100",
    ),
    ("tripod.urdf", 'lower="-0.3" upper="0.3"', 'lower="0" upper="0"', "left_spread has the limits 0 to 0"),
    ("tripod.urdf", 'lower="-0.3" upper="0.3"', "", "left_spread has the limits 0 to 0"),
    ("tripod.urdf", '<axis xyz="0 0 1"/>', '<axis xyz="0 0 0"/>', "axis of joint left_spread is zero"),
    (
        "tripod.urdf",
        '"left_flex" type="revolute"',
        '"left_flex" type="prismatic"',
        "joint left_flex is prismatic; only",
    ),
    ("tripod.urdf", '<link name="thumb_tip"/>', "", None),
    ("tripod.urdf", '<parent link="thumb_upper"/>', "", "tripod.urdf is not a URDF"),
    ("tripod.urdf", '<child link="thumb_tip"/>', '<child link="base"/>', "link base hangs from too many joints"),
    (
        "tripod.urdf",
        '<child link="thumb_tip"/>',
        '<child link="left_upper"/>',
        "link left_upper hangs from too many joints",
    ),
    (
        "tripod.urdf",
        '<parent link="base"/><child link="left_mount"/>',
        '<parent link="arm"/><child link="left_mount"/>',
        "left_root.* are not reached from the palm link base",
    ),
]


@pytest.mark.usefixtures("as_users_run_it")
@pytest.mark.parametrize(("file", "old", "new", "message"), BAD)
def test_mistakes_are_named_in_one_line(folder: Path, file: str, old: str, new: str, message: str | None) -> None:
    text = (folder / file).read_text()
    assert old in text
    (folder / file).write_text(text.replace(old, new))
    if message is None:
        Hand.load(folder)
        return
    with pytest.raises(ValueError, match=message) as caught:
        Hand.load(folder)
    assert "\n" not in str(caught.value)


def test_a_mirror_names_links_that_exist(folder: Path) -> None:
    text = (folder / "hand.yaml").read_text()
    (folder / "hand.yaml").write_text(text.replace("mirror: {base: y", "mirror: {bse: y"))
    assert Hand.load(folder).spec.side == "right"
    with pytest.raises(ValueError, match="link bse is not in the URDF, did you mean base"):
        Hand.load(folder, side="left")


def test_the_command_line_turns_a_mistake_into_one_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    urdf = folder / "tripod.urdf"
    urdf.write_text(urdf.read_text().replace('"thumb_flex" multiplier', '"thumb_flx" multiplier'))
    assert main(["view", "--hand", str(folder)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "joint thumb_curl is coupled to thumb_flx, which does not exist" in error


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('<mass value="0.01"/>', '<mass value="0"/>', "link left_knuckle of hand tripod moves without a mass"),
        ('effort="0.8"', 'effort="0"', "joint left_spread of hand tripod has no effort"),
    ],
)
def test_the_simulator_says_what_it_lacks(folder: Path, old: str, new: str, message: str) -> None:
    urdf = folder / "tripod.urdf"
    urdf.write_text(urdf.read_text().replace(old, new))
    hand = Hand.load(folder)  # all but the simulator can do without
    hand.forward_kinematics(torch.zeros(8))
    with pytest.raises(ValueError, match=message):
        twin(hand)

"""The hand's twin in MuJoCo, objects at rest on the table, and the camera against an independent ray cast."""

from dataclasses import fields, replace
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest
import torch
import trimesh
import yaml

from dexzoo.hand import Hand
from dexzoo.perception.camera import Camera, look_at
from dexzoo.perception.observation import Observation
from dexzoo.resources import resource
from dexzoo.sim import ObjectModel, Scene
from dexzoo.sim.shapes import make_object

ROBOT = resource("robots") / "dlr2"
SMALL = Camera(192, 144, 172.2, 172.2, 96.0, 72.0)
"""The default camera at 30 % of its pixels across."""
RESTING = ("ball_00", "bottle_01", "bowl_02", "box_03", "can_04", "mug_05")


# the hand's twin


@pytest.fixture(scope="module")
def twin(can_scene: Scene, hand: Hand) -> mujoco.MjModel:
    return can_scene.model(hand.spec)


@pytest.fixture
def raised(twin: mujoco.MjModel) -> mujoco.MjData:
    """The state with the hand one meter over the table."""
    data = mujoco.MjData(twin)
    at = twin.joint("wrist").qposadr[0]
    data.qpos[at : at + 7] = [0, 0, 1, 1, 0, 0, 0]
    data.mocap_pos[:] = [0, 0, 1]
    return data


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_twin_has_the_kinematics_of_the_hand(can_scene: Scene, side: str) -> None:
    hand = Hand.load("dlr2", side=side)
    model = can_scene.model(hand.spec)
    data = mujoco.MjData(model)
    share = torch.rand(1000, 15, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    low, high = hand.reduce(hand.lower.double()), hand.reduce(hand.upper.double())
    q20 = hand.expand(low + share * (high - low))
    ours = hand.forward_kinematics(q20).numpy()
    address = [model.joint(name).qposadr[0] for name in hand.joint_names]
    bodies = [model.body(name).id for name in hand.link_names]
    at = model.joint("wrist").qposadr[0]
    data.qpos[at : at + 7] = [0, 0, 0, 1, 0, 0, 0]
    for q, expected in zip(q20.numpy(), ours, strict=True):
        data.qpos[address] = q
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(data.xpos[bodies], expected[:, :3, 3], atol=1e-6, rtol=0)
        np.testing.assert_allclose(data.xmat[bodies].reshape(-1, 3, 3), expected[:, :3, :3], atol=1e-6, rtol=0)


def test_the_twin_has_the_masses_and_inertias_of_the_urdf(twin: mujoco.MjModel) -> None:
    links = ElementTree.parse(ROBOT / "dlr2.urdf").getroot().findall("link")
    heavy = [link for link in links if link.find("inertial") is not None]
    for link in heavy:
        inertial, body = link.find("inertial"), twin.body(link.get("name"))
        assert body.mass[0] == pytest.approx(float(inertial.find("mass").get("value")))
        center = [float(number) for number in inertial.find("origin").get("xyz").split()]
        np.testing.assert_allclose(body.ipos, center, atol=1e-9)
        v = {key: float(value) for key, value in inertial.find("inertia").attrib.items()}
        matrix = [[v["ixx"], v["ixy"], v["ixz"]], [v["ixy"], v["iyy"], v["iyz"]], [v["ixz"], v["iyz"], v["izz"]]]
        np.testing.assert_allclose(np.sort(body.inertia), np.linalg.eigvalsh(matrix), rtol=1e-6)
    hand_bodies = [link.get("name") for link in links]
    total = sum(twin.body(name).mass[0] for name in hand_bodies)
    assert total == pytest.approx(sum(float(link.find("inertial/mass").get("value")) for link in heavy))


def test_servos_and_joint_ranges_are_those_of_the_urdf(twin: mujoco.MjModel, hand: Hand) -> None:
    for joint in ElementTree.parse(ROBOT / "dlr2.urdf").getroot().findall("joint[@type='revolute']"):
        name, limit = joint.get("name"), joint.find("limit")
        effort = float(limit.get("effort"))
        np.testing.assert_allclose(twin.actuator(name).forcerange, [-effort, effort])
        radians = [float(limit.get("lower")), float(limit.get("upper"))]
        np.testing.assert_allclose(twin.joint(name).range, radians, atol=1e-9)
        assert twin.joint(name).limited[0]
    assert {twin.actuator(i).name for i in range(twin.nu)} == set(hand.joint_names)


def test_the_geoms_are_the_shapes_of_hand_yaml(twin: mujoco.MjModel, can_scene: Scene) -> None:
    shapes = yaml.safe_load((ROBOT / "hand.yaml").read_text())["primitives"]
    for link, expected in shapes.items():
        body = twin.body(link)
        found = [twin.geom(i) for i in range(body.geomadr[0], body.geomadr[0] + body.geomnum[0])]
        assert len(found) == len(expected)
        for geom, shape in zip(found, expected, strict=True):
            turn = np.zeros(9)
            mujoco.mju_quat2Mat(turn, geom.quat)
            if "box" in shape:
                np.testing.assert_allclose(geom.pos, shape["box"]["center"], atol=1e-9)
                np.testing.assert_allclose(geom.size, shape["box"]["half"], atol=1e-9)
                np.testing.assert_allclose(turn.reshape(3, 3), np.eye(3), atol=1e-9)
            else:
                assert geom.type[0] == mujoco.mjtGeom.mjGEOM_CAPSULE
                assert geom.size[0] == pytest.approx(shape["capsule"]["radius"])
                along = turn.reshape(3, 3)[:, 2] * geom.size[1]
                ends = {tuple(np.round(geom.pos + sign * along, 9) + 0.0) for sign in (-1, 1)}
                assert ends == {tuple(np.array(shape["capsule"][key], float)) for key in ("from", "to")}
    counts = sum(len(expected) for expected in shapes.values())
    assert sum(twin.body(link).geomnum[0] for link in shapes) == counts
    assert twin.ngeom == counts + len(can_scene.object.hulls) + 1, "the can's parts and the table"


def test_palm_and_proximal_links_do_not_touch(twin: mujoco.MjModel, hand: Hand) -> None:
    palm = twin.body("palm").id
    excluded = {(signature >> 16, signature & 0xFFFF) for signature in twin.exclude_signature.tolist()}
    for finger in ("thumb", "index", "middle", "ring", "little"):
        proximal = twin.body(f"{finger}_proximal").id
        assert (palm, proximal) in excluded or (proximal, palm) in excluded
    assert len(excluded) == len(hand.spec.exclude)


def test_the_open_hand_touches_nothing(twin: mujoco.MjModel, raised: mujoco.MjData) -> None:
    mujoco.mj_forward(twin, raised)
    hand_geoms = [i for i in range(twin.ngeom) if twin.geom_contype[i] == 1]
    assert not set(raised.contact.geom.ravel()) & set(hand_geoms)


def test_distal_joints_follow_and_the_wrist_stays_at_its_target(
    twin: mujoco.MjModel, raised: mujoco.MjData, hand: Hand
) -> None:
    flexed = [name for name in hand.joint_names if not name.startswith("thumb") and not name.endswith("abd")]
    for name in flexed:
        raised.ctrl[twin.actuator(name).id] = 0.8
    for _ in range(400):
        mujoco.mj_step(twin, raised)
        for finger in ("index", "middle", "ring", "little"):
            pip, dip = (raised.joint(f"{finger}_{joint}").qpos[0] for joint in ("pip", "dip"))
            assert dip == pytest.approx(pip, abs=0.02)
    np.testing.assert_allclose([raised.joint(name).qpos[0] for name in flexed], 0.8, atol=0.02)
    np.testing.assert_allclose(raised.body("palm").xpos, [0, 0, 1], atol=1e-3)


# objects at rest


@pytest.mark.parametrize("name", RESTING)
def test_objects_lie_still_on_the_table(name: str, hand: Hand) -> None:
    scene = Scene.place(make_object(name), seed=2)
    T = scene.T_world_object
    lowest = (scene.object.mesh.vertices @ T[:3, :3].T + T[:3, 3])[:, 2].min()
    assert abs(lowest) < 1.5e-3
    center = T[:3, :3] @ scene.object.inertia[0] + T[:3, 3]
    assert np.linalg.norm(center[:2]) < 0.1
    model = scene.model(hand.spec)
    data = mujoco.MjData(model)
    at, wrist = model.joint("object").qposadr[0], model.joint("wrist").qposadr[0]
    data.qpos[at : at + 3] = T[:3, 3]
    mujoco.mju_mat2Quat(data.qpos[at + 3 : at + 7], T[:3, :3].ravel())
    data.qpos[wrist : wrist + 7] = [0, 0, 1, 1, 0, 0, 0]
    data.mocap_pos[:] = [0, 0, 1]
    for _ in range(round(1 / model.opt.timestep)):
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(data.body("object").xpos, T[:3, 3], atol=1e-3)
    np.testing.assert_allclose(data.body("object").xmat.reshape(3, 3), T[:3, :3], atol=0.01)


def test_the_same_seed_gives_the_same_pose_and_view() -> None:
    def make(place: int, view: int) -> tuple[bytes, bytes, bytes]:
        scene = Scene.place(make_object("mug_02"), seed=place)
        observation = scene.observe(seed=view, camera=SMALL)
        return scene.T_world_object.tobytes(), observation.T_world_camera.tobytes(), observation.depth.tobytes()

    first = make(3, 4)
    assert make(3, 4) == first
    pose, camera, depth = make(3, 5)
    assert (pose, camera == first[1], depth == first[2]) == (first[0], False, False)
    assert make(4, 4)[0] != first[0]


def test_the_objects_friction_and_no_other_acts(can_scene: Scene, hand: Hand) -> None:
    scene = replace(can_scene, object=replace(can_scene.object, friction=0.123))
    model = scene.model(hand.spec)
    body = model.body("object")
    parts = range(body.geomadr[0], body.geomadr[0] + body.geomnum[0])
    others = [i for i in range(model.ngeom) if i not in parts]
    assert min(model.geom_priority[parts]) > max(model.geom_priority[others])
    data = mujoco.MjData(model)
    at, wrist = model.joint("object").qposadr[0], model.joint("wrist").qposadr[0]
    data.qpos[at : at + 3] = scene.T_world_object[:3, 3]
    mujoco.mju_mat2Quat(data.qpos[at + 3 : at + 7], scene.T_world_object[:3, :3].ravel())
    # the palm stands against the can's side, 1 mm deep
    radius = scene.object.mesh.extents[0] / 2
    data.qpos[wrist : wrist + 7] = [scene.T_world_object[0, 3] - radius - 0.0344, 0, 0.02, 1, 0, 0, 0]
    mujoco.mj_forward(model, data)
    touched = {model.body(model.geom_bodyid[i]).name for i in data.contact.geom.ravel()}
    assert touched >= {"object", "world", "palm"}
    for contact in data.contact:
        if body.id in model.geom_bodyid[contact.geom]:
            np.testing.assert_allclose(contact.friction[:2], 0.123)


# the camera


def test_drawn_views_are_those_of_the_grasp_set(can_scene: Scene) -> None:
    middle = can_scene.T_world_object[:3, :3] @ can_scene.object.mesh.bounds.mean(0) + can_scene.T_world_object[:3, 3]
    elevations, azimuths = [], []
    for seed in range(40):
        T = can_scene.observe(seed=seed, camera=SMALL).T_world_camera
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(T[:3, :3]) > 0
        assert T[2, 0] == pytest.approx(0, abs=1e-12), "the image is upright"
        assert T[2, 1] < 0
        elevations.append(np.rad2deg(np.arcsin(-T[2, 2])))
        azimuths.append(np.arctan2(*(T[:3, 3] - middle)[:2]))
        # the gaze passes within sqrt(3) x 3 cm of the middle, and starts 0.40 to 0.75 m from there
        along = (middle - T[:3, 3]) @ T[:3, 2]
        assert np.linalg.norm(middle - T[:3, 3] - along * T[:3, 2]) < 0.052
        assert 0.40 - 0.052 < along < 0.75 + 0.052
    assert min(elevations) > 30 - 1e-9
    assert max(elevations) < 57 + 1e-9
    assert max(elevations) - min(elevations) > 20
    assert np.histogram(azimuths, 4, (-np.pi, np.pi))[0].min() >= 3


def in_world(scene: Scene) -> trimesh.Trimesh:
    return scene.object.mesh.copy().apply_transform(scene.T_world_object)


@pytest.mark.parametrize("name", ["can_01", "bowl_01", "mug_01"])
def test_ideal_depth_agrees_with_another_ray_cast(name: str) -> None:
    scene = Scene.place(make_object(name), seed=1)
    observation = scene.observe(seed=3, camera=SMALL, ideal=True)
    T = observation.T_world_camera
    rays = (SMALL.directions() @ T[:3, :3].T).reshape(-1, 3)
    origins = np.broadcast_to(T[:3, 3], rays.shape)
    points, ray, _ = in_world(scene).ray.intersects_location(origins, rays, multiple_hits=False)
    expected = -T[2, 3] / rays[:, 2]  # the table
    expected[ray] = np.minimum(expected[ray], (points - T[:3, 3]) @ T[:3, 2])
    expected[expected > 1.4] = 0
    error = np.abs(observation.depth.ravel() - expected)
    # at silhouettes a ray may hit for the one and miss for the other
    assert np.quantile(error, 0.999) < 1e-4
    assert (error > 1e-4).sum() <= 5


def test_ideal_points_lie_on_the_object_and_noisy_ones_near_it(can_scene: Scene, can_view: Observation) -> None:
    mesh = in_world(can_scene)

    def distance(points: np.ndarray) -> np.ndarray:
        chosen = np.random.default_rng(0).permutation(len(points))[:500]
        return trimesh.proximity.closest_point(mesh, points[chosen])[1]

    ideal = can_scene.observe(seed=1, ideal=True)
    assert np.abs(ideal.T_world_camera - can_view.T_world_camera)[:, :3].max() < 1e-12
    assert distance(ideal.points_world).max() < 1e-4


def test_the_camera_stands_a_little_off_and_the_table_is_where_it_is_seen(can_scene: Scene) -> None:
    pose = look_at(np.array([0.0, 0, 0.05]), 0.6, 1.0, 0.8)
    ideal = can_scene.observe(camera=SMALL, T_world_camera=pose, ideal=True)
    np.testing.assert_allclose(ideal.table, pose[2], atol=1e-12)
    off = []
    for seed in range(100):
        observation = can_scene.observe(seed, SMALL, pose)
        np.testing.assert_allclose(observation.T_world_camera[:2], pose[:2], atol=1e-12)
        np.testing.assert_allclose(observation.T_world_camera[2], observation.table, atol=1e-12)
        np.testing.assert_allclose(observation.table[:3], pose[2, :3], atol=1e-12)
        off.append(observation.table[3] - pose[2, 3])
        if seed < 10:  # what lies far from the object is table
            assert abs(np.median(observation.height[observation.depth > 0])) < 5e-4
    assert np.std(off) == pytest.approx(0.004, rel=0.25)
    assert abs(np.mean(off)) < 0.0015


def test_points_are_off_by_as_much_as_the_camera(can_scene: Scene) -> None:
    """The middle of the can's top, seen from one place, is seen 4 mm off along the table, at its true height."""
    pose = look_at(np.array([0.0, 0, 0.05]), 0.5, 1.0, 0.8)

    def top(observation: Observation) -> np.ndarray:
        points = observation.points_world
        points = points[points[:, 2] > np.quantile(points[:, 2], 0.98) - 0.004]
        return (points.min(0) + points.max(0)) / 2

    moved = [top(can_scene.observe(seed, T_world_camera=pose)) for seed in range(30)]
    assert np.abs(np.mean(moved, axis=0) - top(can_scene.observe(T_world_camera=pose, ideal=True))).max() < 0.003
    spread = np.std(moved, axis=0)
    assert (spread[:2] > 0.0025).all()
    assert (spread[:2] < 0.0065).all()
    assert spread[2] < 0.0015


def test_ideal_depth_of_a_box_is_exact() -> None:
    box = trimesh.creation.box([0.06, 0.08, 0.1])
    model = ObjectModel.from_mesh(box, hulls=[box], name="box")
    pose = np.eye(4)
    pose[2, 3] = 0.05
    observation = Scene(model, pose).observe(seed=2, camera=SMALL, ideal=True)
    T = observation.T_world_camera
    rays, eye = SMALL.directions() @ T[:3, :3].T, T[:3, 3]
    near, far = (sign * np.array([-0.03, -0.04, -0.05]) - (eye - [0, 0, 0.05]) for sign in (1, -1))
    near, far = near / rays, far / rays
    enter, leave = np.minimum(near, far).max(-1), np.maximum(near, far).min(-1)
    expected = np.where(enter < leave, enter, -eye[2] / rays[..., 2])
    expected[expected > 1.4] = 0
    wrong = np.abs(observation.depth - expected) > 1e-6
    assert wrong.sum() <= 3, "rays that graze an edge"


def test_the_projector_casts_shadows_to_the_left_and_no_other_side(can_scene: Scene) -> None:
    pose = look_at(np.array([0.0, 0, 0.05]), 0.5, 1.0, 0.7)
    observation = can_scene.observe(T_world_camera=pose)
    column = observation.camera.project(observation.points)[:, 0]
    rows = np.flatnonzero(observation.mask.any(1))
    middle = observation.depth[rows[len(rows) // 4] : rows[len(rows) // 2]] == 0
    left, right = int(column.min()), int(column.max())
    assert middle[:, left - 40 : left].mean() > 0.3
    assert middle[:, right + 5 : right + 40].mean() < 0.01


def test_the_shadow_is_where_its_own_geometry_puts_it() -> None:
    """A vertical plate before a level table: the table's points whose line to the projector crosses it are dark."""
    plate = trimesh.creation.box([0.1, 0.002, 0.12])
    pose = np.eye(4)
    pose[2, 3] = 0.06
    model = ObjectModel.from_mesh(plate, hulls=[plate], name="plate")
    T = look_at(np.array([0, 0, 0.05]), 0.6, -np.pi / 2, 0.8)
    scene = Scene(model, pose)
    exact = scene.observe(T_world_camera=T, ideal=True)
    projector = T[:3, 3] + 0.075 * T[:3, 0]
    rays = exact.camera.directions() @ T[:3, :3].T
    points = T[:3, 3] + rays * exact.depth[..., None]
    way = projector - points
    with np.errstate(divide="ignore", invalid="ignore"):
        share = -points[..., 1] / way[..., 1]  # of the way to the projector at which y is 0
        at = points + share[..., None] * way
    table = np.abs(points[..., 2]) < 1e-6
    expected = table & (share > 0) & (share < 1) & (np.abs(at[..., 0]) < 0.05) & (at[..., 2] < 0.12)
    lit = scene._rays.lit(exact.depth.astype(np.float64), exact.camera, T, projector)
    assert expected.sum() > 500
    assert ((~lit & table) ^ expected).sum() < 0.06 * expected.sum(), "but for a pixel along its outline"
    assert lit[~table & (exact.depth > 0)].mean() > 0.9


def test_a_given_camera_and_pose_are_honored(can_scene: Scene) -> None:
    pose = look_at(np.array([0.0, 0, 0.05]), 0.5, 1.0, 0.8)
    observation = can_scene.observe(camera=SMALL, T_world_camera=pose, ideal=True)
    assert observation.camera == SMALL
    np.testing.assert_array_equal(observation.T_world_camera, pose)
    # the middle pixel sees the can where the gaze meets its side or top
    T = can_scene.T_world_object
    height, radius = can_scene.object.mesh.extents[2], can_scene.object.mesh.extents[0] / 2
    x, y, z = pose[:3, 3] + observation.depth[72, 96] * pose[:3, 2] - T[:3, 3]
    assert np.hypot(x, y) == pytest.approx(radius, rel=0.02) or z == pytest.approx(height, abs=1e-3)


@pytest.mark.parametrize(("target", "distance"), [((2.0, 2.0, 0.0), 0.5), ((0.0, 0.0, 0.05), 1.3)])
def test_an_object_out_of_sight_is_reported(can_scene: Scene, target: tuple[float, ...], distance: float) -> None:
    with pytest.raises(ValueError, match=r"object can_07 covers \d+ pixels, fewer than 250"):
        can_scene.observe(camera=SMALL, T_world_camera=look_at(np.array(target), distance, 0.0, 0.8))


def test_to_observe_a_scene_changes_nothing_in_it(can_scene: Scene, hand: Hand) -> None:
    scene = replace(can_scene, T_world_object=can_scene.T_world_object.copy())
    first = scene.observe(seed=1, camera=SMALL)
    scene.observe(seed=2, camera=SMALL)
    scene.observe(T_world_camera=look_at(np.array([0.0, 0, 0.05]), 0.5, 1.0, 0.8), ideal=True)
    with pytest.raises(ValueError, match="pixels"):
        scene.observe(T_world_camera=look_at(np.array([2.0, 2, 0]), 0.5, 0.0, 0.8))
    assert [field.name for field in fields(scene)] == ["object", "T_world_object", "support"]
    assert scene.object is can_scene.object
    assert scene.support is None
    np.testing.assert_array_equal(scene.T_world_object, can_scene.T_world_object)
    again = scene.observe(seed=1, camera=SMALL)
    assert again.depth.tobytes() == first.depth.tobytes()
    np.testing.assert_array_equal(again.T_world_camera, first.T_world_camera)
    ours, theirs = (s.model(hand.spec) for s in (scene, can_scene))
    for name in ("geom_pos", "geom_quat", "geom_size", "geom_friction", "body_mass", "body_inertia", "qpos0"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), name)

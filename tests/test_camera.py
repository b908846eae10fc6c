"""Observations of scenes whose depth is known in closed form, and every bad input."""

import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from scipy import ndimage
from scipy.spatial import cKDTree

import dexzoo
from dexzoo import rotation
from dexzoo.models.encoders import colorize
from dexzoo.perception.camera import Camera
from dexzoo.perception.observation import Observation
from dexzoo.perception.table import fit_table

CAMERA = Camera()
CENTER, RADIUS = np.array([0.02, -0.01, 0.05]), 0.05  # a ball on the table


def look_from(eye: list[float], target: list[float]) -> np.ndarray:
    """T_world_camera of an upright camera, apart from the package's own."""
    z = np.subtract(target, eye)
    z = z / np.linalg.norm(z)
    x = np.cross(z, [0, 0, 1])
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3] = np.column_stack((x, np.cross(z, x), z, eye))
    return T


def depth_of_table(rays: np.ndarray, eye: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore"):
        t = -eye[2] / rays[..., 2]
    return np.where(t > 0, t, np.inf)


def depth_of_ball(rays: np.ndarray, eye: np.ndarray) -> np.ndarray:
    a, b = (rays * rays).sum(-1), rays @ (eye - CENTER)
    c = (eye - CENTER) @ (eye - CENTER) - RADIUS**2
    discriminant = b * b - a * c
    return np.where(discriminant > 0, (-b - np.sqrt(np.maximum(discriminant, 0))) / a, np.inf)


def depth_of_box(rays: np.ndarray, eye: np.ndarray, low: list[float], high: list[float]) -> np.ndarray:
    with np.errstate(divide="ignore"):
        near, far = (np.subtract(low, eye) / rays), (np.subtract(high, eye) / rays)
    enter, leave = np.minimum(near, far).max(-1), np.maximum(near, far).min(-1)
    return np.where((enter < leave) & (enter > 0), enter, np.inf)


def render(T: np.ndarray, things: str = "ball", camera: Camera = CAMERA) -> tuple[np.ndarray, np.ndarray]:
    """Depth of a table with some things on it, and the pixels of those."""
    rays, eye = camera.directions() @ T[:3, :3].T, T[:3, 3]
    table = depth_of_table(rays, eye)
    depth = np.full(table.shape, np.inf)
    if "ball" in things:
        depth = depth_of_ball(rays, eye)
    if "box" in things:
        depth = np.minimum(depth, depth_of_box(rays, eye, [-0.03, -0.04, 0], [0.05, 0.03, 0.12]))
    mask = depth < table
    depth = np.minimum(depth, table)
    if "wall" in things:  # on a table of 0.35 m around the origin, with a wall far behind
        place = eye + rays * depth[..., None]
        off = np.linalg.norm(place[..., :2], axis=-1) > 0.35
        depth = np.where(off, 1.9, depth)
    return np.where(np.isfinite(depth), depth, 0), mask


T_WORLD_CAMERA = look_from([0.5, -0.3, 0.45], [0.05, 0.03, 0.0])


def noisy(depth: np.ndarray, sigma: float = 0.001) -> np.ndarray:
    return depth + np.random.default_rng(0).normal(0, sigma, depth.shape) * (depth > 0)


@pytest.fixture(scope="module")
def ball() -> Observation:
    return Observation(render(T_WORLD_CAMERA)[0], CAMERA, T_WORLD_CAMERA)


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


# --- the camera ------------------------------------------------------------------------------------------------------


def test_project_undoes_directions() -> None:
    camera = Camera(64, 48, 60.0, 55.0, 30.5, 25.0)
    u, v = np.meshgrid(np.arange(64), np.arange(48))
    pixels = camera.project(camera.directions() * np.linspace(0.3, 2, 64)[:, None])
    np.testing.assert_allclose(pixels, np.stack((u, v), -1), atol=1e-9)


def test_camera_file(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(asdict(CAMERA) | {"depth_scale": 0.001}))
    assert Camera.load(path) == CAMERA


# --- the table -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("things", ["ball", "box", "ball wall", "none"])
@pytest.mark.parametrize("eye", [[0.5, -0.3, 0.45], [-0.2, 0.4, 0.7]], ids=["low", "high"])
def test_table_is_fitted(things: str, eye: list[float]) -> None:
    T = look_from(eye, [0, 0, 0.03])
    plane = fit_table((CAMERA.directions() * noisy(render(T, things)[0])[..., None]).reshape(-1, 3))
    assert np.linalg.norm(plane[:3]) == pytest.approx(1)
    assert np.rad2deg(np.arccos(min(plane[:3] @ T[2, :3], 1))) < 0.5
    assert abs(plane[3] - T[2, 3]) < 0.002


def test_world_is_laid_into_the_table() -> None:
    observation = Observation(noisy(render(T_WORLD_CAMERA)[0]), CAMERA)
    T = observation.T_world_camera
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
    assert T[:2, 3].tolist() == [0, 0]  # the origin lies below the camera
    assert T[2, 3] == pytest.approx(0.45, abs=0.002)
    assert T[0, 0] > 0.999  # x along the camera's
    assert T[1, 0] == pytest.approx(0, abs=1e-9)
    np.testing.assert_allclose(observation.table, T[2], atol=1e-12)


def test_table_of_a_camera_on_its_side() -> None:
    plane = np.array([1.0, 0, 0, 0.4])
    T = Observation(np.full((480, 640), 0.5), CAMERA, table=plane).T_world_camera
    np.testing.assert_allclose(T[:3, :3] @ [1, 0, 0], [0, 0, 1], atol=1e-9)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)


def test_a_pose_is_leveled_by_the_table_that_is_seen() -> None:
    truth = Observation(np.full((480, 640), 0.5), CAMERA, T_WORLD_CAMERA)
    off = T_WORLD_CAMERA.copy()
    tilt = rotation.to_matrix(rotation.exp(torch.tensor([0.02, -0.03, 0.0], dtype=torch.float64))).numpy()
    off[:3, :3] = tilt @ off[:3, :3]
    off[2, 3] += 0.01
    leveled = Observation(truth.depth, CAMERA, off, truth.table)
    np.testing.assert_allclose(leveled.T_world_camera[2], truth.table, atol=1e-9)
    np.testing.assert_allclose(leveled.T_world_camera, T_WORLD_CAMERA, atol=2e-3)
    np.testing.assert_allclose(leveled.table, truth.table, atol=1e-12)


@pytest.mark.parametrize(("rise", "tilt", "says"), [(0.1, 0.0, "-100 mm"), (0.0, 0.3, "17.2 degrees")])
def test_a_pose_that_contradicts_the_table(rise: float, tilt: float, says: str) -> None:
    pose = T_WORLD_CAMERA.copy()
    turn = rotation.to_matrix(rotation.exp(torch.tensor([tilt, 0, 0], dtype=torch.float64))).numpy()
    pose[:3, :3] = turn @ pose[:3, :3]
    pose[2, 3] += rise
    with pytest.raises(ValueError, match=f"contradict each other by .*{says}"):
        Observation(np.full((480, 640), 0.5), CAMERA, pose, T_WORLD_CAMERA[2])


def test_table_plane_need_not_be_normalized() -> None:
    depth = render(T_WORLD_CAMERA)[0]
    plane = Observation(depth, CAMERA, T_WORLD_CAMERA).table
    np.testing.assert_allclose(Observation(depth, CAMERA, table=3 * plane).table, plane, atol=1e-9)


def test_height_map(ball: Observation) -> None:
    T = T_WORLD_CAMERA
    height = (ball.camera.directions() * ball.depth[..., None]) @ T[:3, :3].T[:, 2] + T[2, 3]
    np.testing.assert_allclose(ball.height, height, atol=1e-6)
    assert ball.height.max() == pytest.approx(2 * RADIUS, abs=1e-4)
    assert np.abs(ball.height[~render(T)[1]]).max() < 1e-6
    depth = ball.depth.copy()
    depth[:100] = np.nan
    assert (Observation(depth, CAMERA, T).height[:100] == 0).all()


# --- the object ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("things", ["ball", "box"])
def test_object_is_segmented(things: str) -> None:
    depth, mask = render(T_WORLD_CAMERA, things)
    known = Observation(noisy(depth), CAMERA, T_WORLD_CAMERA)
    fitted = Observation(noisy(depth), CAMERA)
    assert iou(known.mask, mask) > 0.95
    assert iou(fitted.mask, mask) > 0.95


def test_an_object_cut_apart_is_kept_whole() -> None:
    depth, mask = render(T_WORLD_CAMERA, "box")
    row = int(np.nonzero(mask.any(1))[0].mean())
    depth[row : row + 3] = 0
    mask[row : row + 3] = False
    assert iou(Observation(depth, CAMERA, T_WORLD_CAMERA).mask, mask) > 0.95


def test_a_speck_is_not_the_object() -> None:
    depth, mask = render(T_WORLD_CAMERA)
    depth[300:305, 100:105] -= 0.05
    assert iou(Observation(depth, CAMERA, T_WORLD_CAMERA).mask, mask) > 0.95


def test_points_lie_on_the_surface(ball: Observation) -> None:
    assert ball.points.shape == (ball.mask.sum(), 3)
    np.testing.assert_allclose(np.linalg.norm(ball.points_world - CENTER, axis=1), RADIUS, atol=1e-5)
    back = (ball.points_world - T_WORLD_CAMERA[:3, 3]) @ T_WORLD_CAMERA[:3, :3]
    np.testing.assert_allclose(back, ball.points, atol=1e-6)


# --- the aimed view --------------------------------------------------------------------------------------------------


def straight_down() -> np.ndarray:
    T = np.diag([1.0, -1, -1, 1])
    T[:3, 3] = [0.06, 0.02, 0.6]
    return T


def tilted() -> np.ndarray:
    roll = np.eye(4)
    roll[:2, :2] = [[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]]
    return T_WORLD_CAMERA @ roll


@pytest.mark.parametrize("T", [T_WORLD_CAMERA, tilted(), straight_down()], ids=["upright", "tilted", "straight down"])
def test_aimed_view_turns_the_camera_and_keeps_the_points(T: np.ndarray) -> None:
    whole = Observation(render(T, "box")[0], CAMERA, T)
    aimed = whole.aimed()
    assert aimed.depth.shape == (224, 224)
    np.testing.assert_allclose(aimed.T_world_camera[:3, 3], T[:3, 3])
    np.testing.assert_allclose(np.linalg.det(aimed.T_world_camera[:3, :3]), 1)
    # each point lies within a pixel of a point of the whole view, and none is missing
    pixel = whole.points[:, 2].max() / min(CAMERA.fx, aimed.camera.fx)
    assert cKDTree(whole.points_world).query(aimed.points_world)[0].max() < pixel
    assert cKDTree(aimed.points_world).query(whole.points_world)[0].max() < 2 * pixel
    # the center of the points is in the middle of the image
    center = np.append(whole.points_world.mean(0, dtype=np.float64), 1)
    middle = aimed.camera.project((np.linalg.inv(aimed.T_world_camera) @ center)[:3])
    np.testing.assert_allclose(middle, [111.5, 111.5], atol=1e-2)


@pytest.mark.parametrize("T", [T_WORLD_CAMERA, tilted()], ids=["upright", "tilted"])
def test_aimed_view_is_upright(T: np.ndarray) -> None:
    aimed = Observation(render(T)[0], CAMERA, T).aimed()
    assert aimed.T_world_camera[2, 0] == pytest.approx(0, abs=1e-9)  # its x is level
    assert aimed.T_world_camera[2, 1] < 0  # its y points down


def test_image_is_the_objects_depth_and_height(ball: Observation) -> None:
    aimed = ball.aimed()
    image = aimed.image()
    assert image.shape == (2, 224, 224)
    assert image.dtype == torch.float32
    assert (image[:, ~torch.from_numpy(aimed.mask)] == 0).all()
    assert float(image[1].max()) == pytest.approx(2 * RADIUS, abs=1e-3)
    np.testing.assert_array_equal(image[0][aimed.mask], aimed.depth[aimed.mask])


# --- color ----------------------------------------------------------------------------------------------------------


def test_colorize_of_a_quadratic_surface() -> None:
    y, x = torch.meshgrid(torch.arange(12.0).double(), torch.arange(10.0).double(), indexing="ij")
    a, b, c = 0.02, -0.05, 0.03
    image = colorize((a * x**2 + b * y**2 + c * x * y + 50)[None])
    inner = image[0, :, 1:-1, 1:-1]
    mean, gaussian = 2 * a + 2 * b, 4 * a * b - c**2
    torch.testing.assert_close(inner[1], torch.full_like(inner[1], -(abs(mean) ** 0.5)))
    torch.testing.assert_close(inner[2], torch.full_like(inner[2], -(abs(gaussian) ** 0.25)))


def test_colorize_agrees_with_scipy() -> None:
    rng = np.random.default_rng(0)
    depth = ndimage.gaussian_filter(rng.random((20, 24)), 2) + 0.5
    second = [1.0, -2, 1]
    g_xx, g_yy = (ndimage.correlate1d(depth, second, axis) for axis in (1, 0))
    g_xy = ndimage.correlate1d(ndimage.correlate1d(depth, [-0.5, 0, 0.5], 0), [-0.5, 0, 0.5], 1)
    mean, gaussian = g_xx + g_yy, g_xx * g_yy - g_xy**2
    expected = np.stack((depth, np.sign(mean) * abs(mean) ** 0.5, np.sign(gaussian) * abs(gaussian) ** 0.25))
    ours = colorize(torch.tensor(depth)[None])[0].numpy()
    np.testing.assert_allclose(ours[:, 1:-1, 1:-1], expected[:, 1:-1, 1:-1], atol=1e-6)


def test_curvature_is_zero_where_the_window_leaves_the_object() -> None:
    depth = 0.5 + torch.rand(1, 9, 9, generator=torch.Generator().manual_seed(0))
    depth[0, 4, 4] = 0
    curvature = colorize(depth)[0, 1:] != 0
    assert not curvature[:, 3:6, 3:6].any()
    assert not curvature[:, [0, -1]].any()
    assert not curvature[:, :, [0, -1]].any()
    assert curvature[:, 1:3, 1:-1].all()


# --- bad input -------------------------------------------------------------------------------------------------------


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    """A good pair of files, in millimeters, for a test to spoil."""
    depth, camera = tmp_path / "depth.png", tmp_path / "camera.json"
    cv2.imwrite(str(depth), np.round(render(T_WORLD_CAMERA)[0] * 1000).astype(np.uint16))
    camera.write_text(json.dumps(asdict(CAMERA) | {"depth_scale": 0.001}))
    return depth, camera


def spoil(camera: Path, **changes: Any) -> None:  # noqa: ANN401, whatever JSON can hold
    values = json.loads(camera.read_text()) | changes
    camera.write_text(json.dumps({name: value for name, value in values.items() if value != "drop"}))


def refused(files: tuple[Path, Path], message: str, error: type[Exception] = ValueError) -> None:
    with pytest.raises(error, match=message) as caught:
        Observation.load(*files)
    assert "\n" not in str(caught.value)


def test_good_files_load(files: tuple[Path, Path]) -> None:
    observation = Observation.load(*files)
    assert iou(observation.mask, render(T_WORLD_CAMERA)[1]) > 0.95
    np.save(files[0].with_suffix(".npy"), observation.depth)
    spoil(files[1], depth_scale="drop", T_world_camera=T_WORLD_CAMERA.tolist())
    again = Observation.load(files[0].with_suffix(".npy"), str(files[1]))
    np.testing.assert_array_equal(again.depth, observation.depth)
    np.testing.assert_array_equal(again.T_world_camera, T_WORLD_CAMERA)


def test_missing_files_are_named(files: tuple[Path, Path]) -> None:
    depth, camera = files
    refused((depth.with_name("none.png"), camera), r"depth image .*none\.png does not exist", FileNotFoundError)
    refused((depth, camera.with_name("none.json")), r"camera file .*none\.json does not exist", FileNotFoundError)


@pytest.mark.parametrize("name", ["depth.png", "depth.npy"])
def test_unreadable_depth(files: tuple[Path, Path], name: str) -> None:
    path = files[0].with_name(name)
    for content in (b"", b"no image at all"):
        path.write_bytes(content)
        refused((path, files[1]), f"depth image .*{name} cannot be read")


def test_truncated_and_pickled_arrays_are_refused(files: tuple[Path, Path]) -> None:
    path = files[0].with_suffix(".npy")
    np.save(path, np.ones((480, 640)))
    path.write_bytes(path.read_bytes()[:5000])
    refused((path, files[1]), "cannot be read")
    np.save(path, np.array([[{}]], dtype=object))  # numpy writes objects as a pickle
    refused((path, files[1]), "cannot be read")


def test_depth_of_the_wrong_shape(files: tuple[Path, Path]) -> None:
    spoil(files[1], width=320, height=240)
    refused(files, r"depth\.png: depth is 640 x 480 pixels, but the camera is 320 x 240")
    cv2.imwrite(str(files[0]), np.zeros((480, 640, 3), np.uint8))
    refused(files, "3 dimensions, expected one channel")


def test_depth_in_millimeters(files: tuple[Path, Path]) -> None:
    spoil(files[1], depth_scale=1)
    refused(files, r"median of \d+ and looks like millimeters; give meters")
    with pytest.raises(ValueError, match="looks like millimeters"):
        Observation(render(T_WORLD_CAMERA)[0] * 1000, CAMERA)


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, -np.inf, -1.0])
def test_depth_without_a_reading(value: float) -> None:
    with pytest.raises(ValueError, match="depth holds no reading: every pixel is zero, negative, NaN or infinite"):
        Observation(np.full((480, 640), value), CAMERA)


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf])
def test_pixels_without_a_reading_are_left_out(value: float, ball: Observation) -> None:
    depth = ball.depth.copy()
    depth[::7] = value
    observation = Observation(depth, CAMERA, T_WORLD_CAMERA)
    assert np.isfinite(observation.points).all()
    assert not observation.mask[::7].any()
    assert np.isfinite(Observation(depth, CAMERA).aimed().image().numpy()).all()


def test_no_object_above_the_table() -> None:
    for observation in (
        Observation(render(T_WORLD_CAMERA, "none")[0], CAMERA, T_WORLD_CAMERA),
        Observation(noisy(render(T_WORLD_CAMERA, "none")[0]), CAMERA),
    ):
        with pytest.raises(ValueError, match="no object is seen above the table"):
            _ = observation.points


def test_a_pose_whose_table_is_not_in_the_image() -> None:
    """A robot's base as the world, say: the table is then not at z = 0."""
    for above in (-0.1, 0.7):
        raised = T_WORLD_CAMERA.copy()
        raised[2, 3] += above
        observation = Observation(render(T_WORLD_CAMERA)[0], CAMERA, raised)
        with pytest.raises(ValueError, match="hardly a reading lies on the table; T_world_camera must be of a world"):
            _ = observation.points


def test_no_table() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match=r"no table plane is seen; give table_plane or T_world_camera"):
        Observation(rng.uniform(0.3, 1.3, (480, 640)), CAMERA)
    depth = np.zeros((480, 640))
    depth[0, :3] = 0.5
    with pytest.raises(ValueError, match="fewer than 50 readings within"):
        Observation(depth, CAMERA)


CAMERA_FILES = [
    ({"fx": "drop"}, r"camera\.json has no fx; it needs width, height, fx, fy, cx, cy"),
    ({"fx": "wide"}, "fx is 'wide', expected a number"),
    ({"fx": -574.0}, r"fx is -574\.0, expected a positive number"),
    ({"cy": None}, "cy is None, expected a number"),
    ({"depth_scale": "drop"}, r"camera\.json has no depth_scale .* which .*depth\.png needs"),
    ({"depth_scale": "mm"}, "depth_scale is 'mm', expected meters per unit"),
    ({"depth_scale": 0}, "depth_scale is 0, expected meters per unit"),
    ({"table_plane": {"normal": [0, -1, 0]}}, r"camera\.json: table_plane must be"),
    ({"table_plane": [0, -1, 0, 0.5]}, "table_plane must be"),
    ({"table_plane": {"normal": [0, 0, 0], "offset": 0.5}}, r"table plane is \[0.*expected four numbers"),
    ({"table_plane": {"normal": [0, -1], "offset": 0.5}}, "expected four numbers"),
    ({"table_plane": {"normal": [0, 0.8, 0.6], "offset": -0.5}}, "table plane lies above the camera"),
    ({"T_world_camera": [[1, 0], [0, 1]]}, r"T_world_camera must be a finite 4 x 4 matrix, got shape \(2, 2\)"),
    ({"T_world_camera": [[1, 0, 0, 0]] * 4}, "T_world_camera's rotation is not orthonormal"),
    ({"T_world_camera": {"x": 1}}, "T_world_camera"),
]


@pytest.mark.parametrize(("changes", "message"), CAMERA_FILES)
def test_bad_camera_files(files: tuple[Path, Path], changes: dict[str, Any], message: str) -> None:
    spoil(files[1], **changes)
    refused(files, message)


@pytest.mark.parametrize(
    ("text", "message"), [("{", "is not JSON"), ("[1, 2]", "holds no mapping"), ("", "is not JSON")]
)
def test_camera_files_that_are_no_mapping(files: tuple[Path, Path], text: str, message: str) -> None:
    files[1].write_text(text)
    refused(files, message)


def test_bad_masks(ball: Observation) -> None:
    with pytest.raises(ValueError, match=r"mask has shape \(4, 4\)"):
        Observation(ball.depth, CAMERA, T_WORLD_CAMERA, mask=np.ones((4, 4), bool))
    empty = Observation(ball.depth, CAMERA, T_WORLD_CAMERA, mask=np.zeros((480, 640), bool))
    with pytest.raises(ValueError, match="mask holds no depth reading"):
        empty.aimed()


# --- real frames -----------------------------------------------------------------------------------------------------

FRAMES = os.environ.get("DEXZOO_REAL_FRAMES")


@pytest.mark.skipif(FRAMES is None, reason="DEXZOO_REAL_FRAMES names no folder of NAME_depth.png, .json, _mask.png")
@pytest.mark.parametrize("fitted", [False, True], ids=["table given", "table fitted"])
@pytest.mark.parametrize("name", ["blue_mug", "green_bowl", "mustard"])
def test_real_frames(name: str, fitted: bool, tmp_path: Path) -> None:
    folder = Path(str(FRAMES))
    camera = folder / f"{name}.json"
    plane = json.loads(camera.read_text())["table_plane"]
    if fitted:
        spoiled = tmp_path / "camera.json"
        spoiled.write_text(camera.read_text())
        spoil(spoiled, table_plane="drop")
        camera = spoiled
    observation = Observation.load(folder / f"{name}_depth.png", camera)
    mask = cv2.imread(str(folder / f"{name}_mask.png"), cv2.IMREAD_UNCHANGED) > 0
    assert iou(observation.mask, mask) > 0.95
    assert np.rad2deg(np.arccos(min(observation.table[:3] @ plane["normal"], 1))) < 0.5
    assert observation.table[3] == pytest.approx(plane["offset"], abs=0.003)
    assert observation.aimed().mask.sum() > 1000


@pytest.mark.skipif(FRAMES is None, reason="DEXZOO_REAL_FRAMES names no folder of NAME_depth.png, .json")
@pytest.mark.parametrize("name", ["blue_mug", "green_bowl", "mustard"])
def test_grasps_on_real_frames_are_refined(name: str) -> None:
    observation = Observation.load(Path(str(FRAMES)) / f"{name}_depth.png", Path(str(FRAMES)) / f"{name}.json")
    given = dexzoo.generate(observation, num_grasps=4, seed=0)
    result = dexzoo.refine(given, observation, num_steps=4)
    assert torch.isfinite(result.grasps.wrist).all()
    assert torch.isfinite(result.grasps.joints).all()
    assert result.accepted.any()
    assert result.score_after.mean() > result.score_before.mean()

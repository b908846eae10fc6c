"""Pictures: geometry against a sphere's closed form, sizes, files."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh

from dexzoo.grasp import GRIP, Grasps
from dexzoo.hand import Hand
from dexzoo.perception.camera import Camera, look_at
from dexzoo.perception.observation import Observation
from dexzoo.viewing import pictures

CAMERA = Camera(160, 120, 143.5, 143.5, 80.0, 60.0)
CENTER, RADIUS = np.array([0.02, -0.01, 0.05]), 0.05
POSE = look_at(np.array([0.0, 0.0, 0.03]), 0.5, 0.7, 0.6)


@pytest.fixture(scope="module")
def ball() -> pictures.Solid:
    mesh = trimesh.creation.icosphere(6, RADIUS).apply_translation(CENTER)
    return pictures.Solid(mesh, (200, 30, 40))


def sphere_depth() -> np.ndarray:
    """Depth of the ball by the quadratic equation, inf beside it."""
    rays = CAMERA.directions() @ POSE[:3, :3].T
    origin = POSE[:3, 3] - CENTER
    a, b, c = (rays**2).sum(-1), rays @ origin, origin @ origin - RADIUS**2
    root = b * b - a * c
    return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)


def test_the_depth_is_that_of_a_sphere(ball: pictures.Solid) -> None:
    picture, depth = pictures.render([ball], CAMERA, POSE, table=False)
    expected = sphere_depth()
    assert (np.isfinite(depth) != np.isfinite(expected)).sum() <= 10  # the silhouette
    both = np.isfinite(depth) & np.isfinite(expected)
    # flat facets of 1 mm lie up to 5 um inside, more along rays that graze them
    assert np.quantile(np.abs(depth[both] - expected[both]), 0.99) < 1e-4
    assert picture.shape == (120, 160, 3)
    assert picture.dtype == np.uint8
    assert (picture[~np.isfinite(depth)] == 255).all()
    red, green, blue = picture[np.isfinite(depth)].mean(0)
    assert red > 2 * green
    assert red > 2 * blue


def test_the_table_is_a_plane_that_hides_what_is_below(ball: pictures.Solid) -> None:
    _, depth = pictures.render([ball], CAMERA, POSE)
    table = -POSE[2, 3] / (CAMERA.directions() @ POSE[2, :3])
    np.testing.assert_allclose(depth, np.minimum(sphere_depth(), table), atol=2e-3)
    sunk = pictures.Solid(ball.mesh.copy().apply_translation([0, 0, -0.2]), ball.color)
    _, depth = pictures.render([sunk], CAMERA, POSE)
    np.testing.assert_allclose(depth, table, atol=1e-6)


def test_the_nearer_of_two_solids_is_seen(ball: pictures.Solid) -> None:
    forward = POSE[:3, 2]
    behind = pictures.Solid(ball.mesh.copy().apply_translation(0.2 * forward), (0, 0, 255))
    alone, depth_alone = pictures.render([ball], CAMERA, POSE, table=False)
    for solids in ([ball, behind], [behind, ball]):
        picture, depth = pictures.render(solids, CAMERA, POSE, table=False)
        seen = np.isfinite(depth_alone)
        np.testing.assert_allclose(depth[seen], depth_alone[seen], atol=1e-6)
        np.testing.assert_array_equal(picture[seen], alone[seen])


def test_look_at_looks_there_upright() -> None:
    target = np.array([0.1, 0.2, 0.3])
    T = look_at(target, 0.6, 2.0, 0.5)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
    np.testing.assert_allclose(T[:3, 3] + 0.6 * T[:3, 2], target, atol=1e-12)
    assert T[2, 0] == pytest.approx(0, abs=1e-12)
    assert np.arcsin(-T[2, 2]) == pytest.approx(0.5)
    assert T[2, 1] < 0, "the image's y points down"


def test_the_hands_solid_is_where_its_links_are(hand: Hand, can_grasps: Grasps) -> None:
    mesh = pictures.hand_solid(hand, can_grasps.wrist[0, GRIP], can_grasps.joints[0, GRIP]).mesh
    np.testing.assert_array_equal(pictures.grasp_solid(can_grasps[0], GRIP).mesh.vertices, mesh.vertices)
    links = can_grasps.wrist_pose[0, GRIP] @ hand.forward_kinematics(can_grasps.joints[0, GRIP])
    surface = torch.from_numpy(mesh.vertices).float()
    distance = hand.signed_distance(links, surface).amin(0)
    # faceted capsules lie within their radius, and boxes of the palm within each other
    assert float(distance.max()) < 5e-4
    for name in hand.solid_names:
        if name != "palm":  # a capsule of 10 or 11 mm whose axis passes within 11 mm of the link's origin
            origin = links[hand.link_names.index(name), :3, 3]
            assert float((surface - origin).norm(dim=-1).min()) < 0.02


def test_an_overlay_has_the_size_of_the_image_and_shows_the_hand(can_view: Observation, can_grasps: Grasps) -> None:
    plain = pictures.depth_picture(can_view)
    picture = pictures.overlay_hand(can_view, can_grasps[0], GRIP)
    assert picture.shape == plain.shape == (480, 640, 3)
    assert picture.dtype == plain.dtype == np.uint8
    changed = (picture != plain).any(-1)
    assert 2_000 < changed.sum() < 150_000
    seen = can_grasps.transformed(np.linalg.inv(can_view.T_world_camera))
    u, v = can_view.camera.project(seen.position[0, GRIP].numpy()).round().astype(int)
    rows, columns = np.nonzero(changed)
    assert rows.min() - 20 < v < rows.max() + 20
    assert columns.min() - 20 < u < columns.max() + 20
    # another world frame, turned and moved along the table, shows the same
    T = np.array([[0, -1, 0, 0.3], [1, 0, 0, -0.2], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    moved = Observation(can_view.depth, can_view.camera, T @ can_view.T_world_camera, mask=can_view.mask)
    np.testing.assert_allclose(pictures.overlay_hand(moved, can_grasps[0].transformed(T), GRIP), picture, atol=60)


def test_before_and_after_differ_where_the_hand_moved(can_view: Observation, can_grasps: Grasps) -> None:
    given = can_grasps[0]
    shift = np.eye(4)
    shift[:3, 3] = 0.01
    picture = pictures.refinement_picture(can_view, given, given.transformed(shift))
    still = pictures.refinement_picture(can_view, given, given)
    assert picture.shape == still.shape == (2 * (460 + 28), 3 * 460, 3)
    half = len(picture) // 2
    np.testing.assert_array_equal(picture[:half], still[:half])
    line = (picture == pictures.OUTLINE_COLOR).all(-1)
    assert not line[:half].any()
    assert line[half:].sum() == pytest.approx((still == pictures.OUTLINE_COLOR).all(-1).sum())  # where it was given
    inner = ~line
    inner[:half] = False
    assert (picture != still).any(-1)[inner].sum() > 1000


def test_the_object_is_tinted(can_view: Observation) -> None:
    picture = pictures.depth_picture(can_view).astype(int)
    tint = picture[..., 0] - picture[..., 2]
    assert (tint[can_view.mask] > 10).all()
    assert (tint[~can_view.mask] == 0).all()
    lost = ~can_view.mask & (can_view.depth == 0)
    assert (picture[lost] == 255).all()


@pytest.mark.parametrize(
    ("count", "columns", "shape"), [(1, 1, (1, 1)), (3, 3, (1, 3)), (5, 2, (3, 2)), (2, 3, (1, 3))]
)
def test_a_grid_has_room_for_pictures_and_titles(count: int, columns: int, shape: tuple[int, int]) -> None:
    cells = [np.full((40, 60, 3), 10 * (i + 1), np.uint8) for i in range(count)]
    whole = pictures.grid(cells, [f"picture {i}" for i in range(count)], columns)
    assert whole.shape == ((40 + 28) * shape[0], 60 * shape[1], 3)
    for i in range(count):
        row, column = divmod(i, columns)
        cell = whole[68 * row : 68 * (row + 1), 60 * column : 60 * (column + 1)]
        np.testing.assert_array_equal(cell[28:], cells[i])
        assert (cell[:28] < 128).any(), "the title is written"


def test_a_picture_is_read_back_as_it_was_saved(tmp_path: Path) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    path = tmp_path / "new" / "picture.png"
    pictures.save(picture, path)
    np.testing.assert_array_equal(cv2.imread(str(path))[..., ::-1], picture)
    with pytest.raises(IsADirectoryError):
        pictures.save(picture, tmp_path / "new")

"""A grasp set on disk: what is written is read back, whole or not at all, and damage is named."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from dexzoo.camera import Observation
from dexzoo.data import schema
from dexzoo.data.schema import GraspSet, decode_path, decode_view, encode_path, encode_view, merge, write_scene
from dexzoo.grasp import Grasps
from dexzoo.hand import Hand

NUM_GRASPS = 6


def scene_row(scene: int, **values: object) -> dict[str, Any]:
    row = {
        "scene": scene,
        "object": f"can_{scene:02d}",
        "category": "can",
        "split": ("train", "validation", "test")[scene % 3],
        "mass": 0.3,
        "friction": 0.7,
        "scale": 1.0,
        "seed": 11,
        "T_world_object": np.eye(4).ravel().tolist(),
    }
    return row | values


@pytest.fixture(scope="module")
def world(can_grasps: Grasps, can_view: Observation) -> Grasps:
    return can_grasps[:NUM_GRASPS].to_frame("world", can_view.T_world_camera)


@pytest.fixture(scope="module")
def view(can_view: Observation) -> dict[str, Any]:
    return encode_view(can_view.aimed())


@pytest.fixture(scope="module")
def rows(world: Grasps, hand: Hand) -> dict[str, Any]:
    """The columns of a scene's grasps, but for the scene."""
    return {
        "view": [0, 1] * (NUM_GRASPS // 2),
        "grasp_type": world.grasp_type.tolist(),
        "source": ["generated"] * NUM_GRASPS,
        "log_likelihood": list(range(NUM_GRASPS)),
        "path": encode_path(world, hand).tolist(),
        "success": [True, False] * (NUM_GRASPS // 2),
        "collided": [False] * NUM_GRASPS,
        "unstable": [False] * NUM_GRASPS,
        "shift": [0.001] * NUM_GRASPS,
        "rotation": [float("nan")] * NUM_GRASPS,
    }


def write(folder: Path, scene: int, view: dict[str, Any], rows: dict[str, Any], **values: object) -> None:
    grasps = pa.table({"scene": [scene] * NUM_GRASPS, **rows})
    views = [{"scene": scene, "view": number, **view} for number in range(2)]
    write_scene(folder, scene_row(scene, **values), views, grasps)


@pytest.fixture
def grasp_set(tmp_path: Path, view: dict[str, Any], rows: dict[str, Any]) -> Path:
    for scene in (2, 0, 1):
        write(tmp_path / "scenes", scene, view, rows)
    merge(tmp_path / "scenes", tmp_path / "set")
    return tmp_path / "set"


# columns


def test_a_path_keeps_the_grasp(world: Grasps, hand: Hand) -> None:
    path = encode_path(world, hand)
    assert path.shape == (NUM_GRASPS, 66)
    assert path.dtype == np.float32
    back = decode_path(torch.from_numpy(path), world.grasp_type, hand)
    assert back.frame == "world"
    torch.testing.assert_close(back.waypoints, world.waypoints, atol=1e-5, rtol=0)


def test_a_path_holds_what_the_docstring_says(world: Grasps, hand: Hand) -> None:
    path = torch.from_numpy(encode_path(world, hand)).unflatten(-1, (3, 22))
    for row, waypoint in enumerate((0, 6, 9)):
        assert torch.equal(path[:, row, :3], world.position[:, waypoint])
        assert torch.equal(path[:, row, 3:7], world.quaternion[:, waypoint])
        assert torch.equal(hand.expand(path[:, row, 7:]), world.joints[:, waypoint])


def test_a_view_is_kept_to_a_tenth_of_a_millimetre(can_view: Observation) -> None:
    aimed = can_view.aimed()
    back = decode_view(encode_view(aimed))
    assert back.camera == aimed.camera
    np.testing.assert_array_equal(back.mask, aimed.mask)
    np.testing.assert_array_equal(back.T_world_camera, aimed.T_world_camera)
    np.testing.assert_allclose(back.depth[aimed.mask], aimed.depth[aimed.mask], atol=0.51e-4)
    assert (back.depth[~aimed.mask] == 0).all()
    np.testing.assert_allclose(back.points_world, aimed.points_world, atol=1e-4)


def test_a_view_is_a_16_bit_png(view: dict[str, Any]) -> None:
    image = cv2.imdecode(np.frombuffer(view["depth"], np.uint8), cv2.IMREAD_UNCHANGED)
    assert image.dtype == np.uint16
    assert image.shape == (224, 224)


# whole or not at all


def test_a_scene_is_written_whole(tmp_path: Path, view: dict[str, Any], rows: dict[str, Any]) -> None:
    write(tmp_path, 7, view, rows)
    assert [path.name for path in tmp_path.iterdir()] == ["scene_000007"]
    names = sorted(path.name for path in (tmp_path / "scene_000007").iterdir())
    assert names == ["grasps.parquet", "scenes.parquet", "views.parquet"]
    assert pq.read_table(tmp_path / "scene_000007" / "grasps.parquet").num_rows == NUM_GRASPS


@pytest.mark.parametrize("failing", [0, 1, 2])
def test_a_failure_leaves_nothing_behind(
    tmp_path: Path, view: dict[str, Any], rows: dict[str, Any], failing: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_table, done = pq.write_table, []

    def full_disk(*args: object, **options: object) -> None:
        if len(done) == failing:
            raise OSError("no space left")
        done.append(write_table(*args, **options))

    monkeypatch.setattr(pq, "write_table", full_disk)
    with pytest.raises(OSError, match="no space left"):
        write(tmp_path, 7, view, rows)
    assert not list(tmp_path.iterdir())


def test_rows_that_do_not_fit_leave_nothing_behind(tmp_path: Path, view: dict[str, Any], rows: dict[str, Any]) -> None:
    with pytest.raises((pa.ArrowInvalid, ValueError)):
        write(tmp_path, 7, view, {name: column for name, column in rows.items() if name != "success"})
    assert not list(tmp_path.iterdir())


def test_the_same_rows_make_the_same_bytes(tmp_path: Path, view: dict[str, Any], rows: dict[str, Any]) -> None:
    for folder in ("a", "b"):
        write(tmp_path / folder, 3, view, rows)
    for name in schema.TABLES:
        first, second = (tmp_path / folder / "scene_000003" / f"{name}.parquet" for folder in ("a", "b"))
        assert first.read_bytes() == second.read_bytes()


# the merged set


def test_merging_orders_the_scenes(grasp_set: Path) -> None:
    assert sorted(path.name for path in grasp_set.iterdir()) == ["grasps.parquet", "scenes.parquet", "views.parquet"]
    read = GraspSet(grasp_set)
    assert read.scenes["scene"].to_pylist() == [0, 1, 2]
    assert read.grasps["scene"].to_pylist() == [0] * NUM_GRASPS + [1] * NUM_GRASPS + [2] * NUM_GRASPS
    assert read.views.num_rows == 6


def test_a_set_is_read_back(grasp_set: Path, world: Grasps, can_view: Observation) -> None:
    read = GraspSet(grasp_set)
    assert read.grasp_view.tolist() == [2 * scene + number % 2 for scene in range(3) for number in range(NUM_GRASPS)]
    assert read.grasp_split.tolist() == [0] * NUM_GRASPS + [1] * NUM_GRASPS + [2] * NUM_GRASPS
    assert read.view_split.tolist() == [0, 0, 1, 1, 2, 2]
    assert read.success.tolist() == [True, False] * (3 * NUM_GRASPS // 2)
    grasps = read.world_grasps
    torch.testing.assert_close(grasps.waypoints[:NUM_GRASPS], world.waypoints, atol=1e-5, rtol=0)
    assert grasps.log_likelihood is not None
    assert grasps.log_likelihood.tolist() == list(range(NUM_GRASPS)) * 3
    aimed = can_view.aimed()
    torch.testing.assert_close(read.camera_poses[3], torch.from_numpy(aimed.T_world_camera).float())
    np.testing.assert_array_equal(read.observation(3).mask, aimed.mask)


def test_a_set_of_more_than_one_chunk_is_read_alike(grasp_set: Path) -> None:
    """A table may come in several pieces, as after appending."""
    whole = GraspSet(grasp_set).world_grasps
    path = grasp_set / "grasps.parquet"
    table = pq.read_table(path)
    pq.write_table(table, path, row_group_size=4)
    assert torch.equal(GraspSet(grasp_set).world_grasps.waypoints, whole.waypoints)


def test_nothing_to_merge_is_reported(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="holds no scene; run collect first"):
        merge(tmp_path, tmp_path / "set")
    assert not (tmp_path / "set").exists()


# damage


@pytest.mark.parametrize("name", schema.TABLES)
def test_a_missing_or_damaged_table_is_named(grasp_set: Path, name: str) -> None:
    path = grasp_set / f"{name}.parquet"
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match=rf"{name}\.parquet cannot be read as Parquet") as caught:
        GraspSet(grasp_set)
    assert "\n" not in str(caught.value)
    path.unlink()
    with pytest.raises(FileNotFoundError, match=rf"has no {name}\.parquet"):
        GraspSet(grasp_set)


def test_a_damaged_scene_is_named_when_merging(tmp_path: Path, view: dict[str, Any], rows: dict[str, Any]) -> None:
    for scene in range(2):
        write(tmp_path / "scenes", scene, view, rows)
    path = tmp_path / "scenes" / "scene_000001" / "views.parquet"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(ValueError, match=r"scene_000001.views\.parquet cannot be read as Parquet"):
        merge(tmp_path / "scenes", tmp_path / "set")
    path.unlink()
    with pytest.raises(FileNotFoundError, match=r"scene_000001 has no views\.parquet"):
        merge(tmp_path / "scenes", tmp_path / "set")


def test_other_columns_are_another_version(grasp_set: Path) -> None:
    path = grasp_set / "scenes.parquet"
    pq.write_table(pq.read_table(path).drop_columns(["friction"]), path)
    with pytest.raises(ValueError, match=r"scenes\.parquet has the columns scene, object, .*; expected version 1's"):
        GraspSet(grasp_set)


def test_a_grasp_of_no_view_is_reported(grasp_set: Path) -> None:
    path = grasp_set / "views.parquet"
    pq.write_table(pq.read_table(path).slice(0, 5), path)
    with pytest.raises(ValueError, match=r"grasps\.parquet names scene or view \(2, 1\), which is not there"):
        GraspSet(grasp_set)


def test_a_stranger_split_is_named(tmp_path: Path, view: dict[str, Any], rows: dict[str, Any]) -> None:
    write(tmp_path / "scenes", 0, view, rows, split="holdout")
    merge(tmp_path / "scenes", tmp_path / "set")
    with pytest.raises(ValueError, match=r"scenes\.parquet has the split 'holdout'; use train, validation, test"):
        GraspSet(tmp_path / "set")

"""A grasp set on disk: whole or not at all while it is written, open to other programs, and damage is named."""

import contextlib
import json
import resource
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import synthetic
import torch

from dexzoo.collection import rendering
from dexzoo.data import writer
from dexzoo.data.grasp_set import GraspSet, ViewImages
from dexzoo.data.schema import SCHEMAS
from dexzoo.data.writer import GraspSetWriter, SceneRows, scene_rows
from dexzoo.hand import Hand
from dexzoo.resources import user_cache

CONFIGURATION = {"seed": 0}
NUM_VIEWS, NUM_GRASPS = 2, 6


def make_rows(scene: int, **values: object) -> SceneRows:
    """A scene of numbers that make no sense together."""
    rng = np.random.default_rng(scene)
    row = {"scene": scene, "object": f"can_{scene:02d}", "category": "can", "split": "train", "generated": 6, "held": 3}
    camera = {"width": 224, "height": 224, "fx": 279.5, "fy": 279.5, "cx": 111.5, "cy": 111.5}
    pose = {"T_world_camera": rng.normal(size=16).tolist(), "table": [0.0, 0, -1, 0.5]}
    path = rng.normal(size=(NUM_GRASPS, 66)).astype(np.float32)
    grasps = {
        "view": np.arange(NUM_GRASPS) % NUM_VIEWS,
        "source": ["generated"] * NUM_GRASPS,
        "grasp_type": np.zeros(NUM_GRASPS, np.int8),
        "path": path,
        "success": np.arange(NUM_GRASPS) % 2 == 0,
        "shift": np.array([0.1, np.nan] * 3),
    }
    return scene_rows(row | values, [camera | pose | {"seed": 5}] * NUM_VIEWS, grasps)


def write(folder: Path, scenes: list[int], num_scenes: int) -> None:
    with GraspSetWriter(folder, CONFIGURATION, num_scenes) as out:
        for scene in scenes:
            out.write(make_rows(scene))


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(autouse=True)
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writer, "SHARD_SCENES", 3)


@pytest.fixture(scope="module")
def synthetic_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return synthetic.write(tmp_path_factory.mktemp("synthetic"))


@pytest.fixture
def folder(synthetic_set: Path, tmp_path: Path) -> Path:
    """A copy of the synthetic set, to damage."""
    return shutil.copytree(synthetic_set, tmp_path / "set")


# shards


def test_scenes_are_gathered_into_shards(tmp_path: Path) -> None:
    with GraspSetWriter(tmp_path, CONFIGURATION, 7) as out:
        for scene in (4, 0, 2):
            out.write(make_rows(scene))
        assert sorted(path.name for path in (tmp_path / ".scenes").iterdir()) == ["000000", "000002", "000004"]
        assert not list(tmp_path.glob("*/*.parquet"))
        out.write(make_rows(1))
        assert [path.name for path in (tmp_path / ".scenes").iterdir()] == ["000004"]
        assert out.done == {0, 1, 2, 4}
        for scene in (6, 5, 3):
            out.write(make_rows(scene))
    names = [f"{table}/0000{shard}.parquet" for table in ("grasps", "scenes", "views") for shard in range(3)]
    assert sorted(contents(tmp_path)) == sorted(["manifest.json", *names])
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []
    for shard, scenes in enumerate(([0, 1, 2], [3, 4, 5], [6])):
        table = pq.read_table(tmp_path / "grasps" / f"0000{shard}.parquet")
        assert table["scene"].to_pylist() == np.repeat(scenes, NUM_GRASPS).tolist()


def test_the_files_depend_on_the_scenes_alone(tmp_path: Path) -> None:
    write(tmp_path / "a", [0, 1, 2, 3, 4], 5)
    write(tmp_path / "b", [4, 2], 5)
    write(tmp_path / "b", [3, 1, 0], 5)
    write(tmp_path / "c", [0, 1], 2)  # a set that grows opens its last shard again
    write(tmp_path / "c", [2, 3], 4)
    write(tmp_path / "c", [4], 5)
    assert contents(tmp_path / "a") == contents(tmp_path / "b") == contents(tmp_path / "c")


@pytest.mark.parametrize("step", range(12))
def test_a_writer_that_dies_at_any_step_loses_nothing_else(
    tmp_path: Path, step: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Death is an exception that no handler of ours gets, at each rename in turn."""
    write(tmp_path / "whole", [0, 1, 2], 3)
    write(tmp_path / "set", [0, 1], 3)
    left = iter(range(step))

    class Death(BaseException):
        pass

    rename = Path.rename

    def mortal(self: Path, target: Path) -> Path:
        if next(left, None) is None:
            raise Death
        return rename(self, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", mortal)
        patch.setattr(Path, "unlink", lambda self, missing_ok=False: None)
        with contextlib.suppress(Death):
            write(tmp_path / "set", [2], 3)
    with GraspSetWriter(tmp_path / "set", CONFIGURATION, 3) as out:
        assert out.done in ({0, 1}, {0, 1, 2})
        if 2 not in out.done:
            out.write(make_rows(2))
    assert contents(tmp_path / "set") == contents(tmp_path / "whole")


def test_the_manifest_counts_and_has_every_checksum(tmp_path: Path) -> None:
    with GraspSetWriter(tmp_path, CONFIGURATION, 3) as out:
        out.write(make_rows(0))
        out.write(make_rows(2))
        out.write(scene_rows({"scene": 1, "split": "test", "skipped": "it rolls", "generated": 4, "held": 0}))
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert (manifest["format"], manifest["version"]) == ("dexzoo.grasp_set", "2")
    assert manifest["configuration"] == CONFIGURATION
    counts = {"scenes": 2, "skipped": {"it rolls": 1}, "views": 4, "grasps": 12, "generated": 16, "held": 6}
    assert manifest["counts"] == counts
    for name, content in contents(tmp_path).items():
        if name != "manifest.json":
            sha256 = subprocess.run(["sha256sum", tmp_path / name], capture_output=True, text=True, check=True).stdout
            assert sha256.startswith(manifest["files"][name]["sha256"])
            assert pq.read_table(pa.BufferReader(content)).num_rows == manifest["files"][name]["rows"]


def test_a_part_of_refined_grasps_is_a_file_of_its_own(tmp_path: Path) -> None:
    write(tmp_path, [0, 1, 2], 3)
    before = contents(tmp_path)
    part = make_rows(1)["grasps"]
    with GraspSetWriter(tmp_path, CONFIGURATION, 3) as out:
        out.add_grasps("refined-1", part)
    after = contents(tmp_path)
    assert {name for name in after if before.get(name) != after[name]} == {"manifest.json", "grasps/refined-1.parquet"}
    read = GraspSet(tmp_path)
    assert read.grasps.num_rows == 4 * NUM_GRASPS
    assert read.grasp_scene[-NUM_GRASPS:].tolist() == [1] * NUM_GRASPS


# what cannot be written


def test_another_configuration_is_refused(tmp_path: Path) -> None:
    write(tmp_path, [0], 1)
    with pytest.raises(ValueError, match="was made with seed 0, not 1; go on with the same or give another folder"):
        GraspSetWriter(tmp_path, {"seed": 1}, 1)


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.pdf").touch()
    with pytest.raises(ValueError, match=r"holds thesis\.pdf and is no grasp set"):
        GraspSetWriter(tmp_path, CONFIGURATION, 1)


def test_two_writers_do_not_mix(tmp_path: Path) -> None:
    with (
        GraspSetWriter(tmp_path, CONFIGURATION, 1),
        pytest.raises(RuntimeError, match="another process is writing to the grasp set"),
    ):
        GraspSetWriter(tmp_path, CONFIGURATION, 1)
    write(tmp_path, [0], 1)


def test_a_lost_file_is_named(tmp_path: Path) -> None:
    write(tmp_path, [0], 1)
    (tmp_path / "views" / "00000.parquet").unlink()
    with pytest.raises(FileNotFoundError, match=r"has lost views/00000\.parquet"):
        GraspSetWriter(tmp_path, CONFIGURATION, 1)


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match=r"file.set cannot be written: Not a directory; choose another folder"):
        GraspSetWriter(tmp_path / "file" / "set", CONFIGURATION, 1)


@contextlib.contextmanager
def full_disk(size: int) -> Iterator[None]:
    """No file may grow beyond so many bytes: the system's own error, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_leaves_what_is_finished(tmp_path: Path) -> None:
    with GraspSetWriter(tmp_path, CONFIGURATION, 3) as out:
        out.write(make_rows(0))
        before = contents(tmp_path)
        with (
            full_disk(2000),
            pytest.raises(OSError, match=r"cannot be written: File too large; what is finished is kept"),
        ):
            out.write(make_rows(1))
        assert contents(tmp_path) == before
        out.write(make_rows(1))
        out.write(make_rows(2))
    assert GraspSet(tmp_path).grasps.num_rows == 3 * NUM_GRASPS


def test_rows_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="the table scenes has no column color"):
        make_rows(0, color="red")
    with pytest.raises(ValueError, match="scene 0 has the split 'holdout'; use one of train, validation, test"):
        make_rows(0, split="holdout")


# reading


def test_a_set_is_read_back(synthetic_set: Path) -> None:
    read = GraspSet(synthetic_set)
    assert read.scenes["scene"].to_pylist() == list(range(6))
    assert read.grasp_split.tolist() == np.repeat([0, 0, 0, 0, 1, 2], 40).tolist()
    assert read.grasp_scene.tolist() == np.repeat(range(6), 40).tolist()
    assert read.view_scene.tolist() == np.repeat(range(6), 2).tolist()
    assert read.grasp_view.tolist() == (2 * read.grasp_scene + read.grasps["view"].to_numpy()).tolist()
    assert set(read.source) == {"generated"}
    assert read.success.tolist() == read.grasps["success"].to_pylist()
    rng = np.random.default_rng(0)  # the first scene again, as synthetic.py draws it
    half = np.full(3, rng.uniform(0.03, 0.05))
    center = np.array([0, 0, half[2]])
    poses = [synthetic.camera_pose(center, rng) for _ in range(2)]
    grasps, success = synthetic.draw_grasps(center, 40, rng)
    assert read.success[:40].tolist() == success.tolist()
    assert read.hand == read.world_grasps.hand == Hand.load("dlr2")
    torch.testing.assert_close(read.world_grasps.wrist[:40], grasps.wrist, atol=1e-5, rtol=0)
    torch.testing.assert_close(read.world_grasps.joints[:40], grasps.joints, atol=1e-5, rtol=0)
    assert torch.equal(read.world_grasps.grasp_type[:40], grasps.grasp_type)
    torch.testing.assert_close(read.camera_poses[1], torch.tensor(poses[1]).float())
    np.testing.assert_array_equal(read.observation(1).mask, synthetic.render("ball", half, center, poses[1]).mask)


def test_images_are_those_of_the_observations(synthetic_set: Path) -> None:
    read = GraspSet(synthetic_set)
    images = read.images([3, 0, 7])
    assert isinstance(images, ViewImages)
    for place, view in enumerate((3, 0, 7)):
        expected = read.observation(view).image()
        torch.testing.assert_close(images[torch.tensor([place])][0], expected, atol=1e-6, rtol=0)


def test_views_without_images_come_from_the_renderer(tmp_path: Path, synthetic_set: Path) -> None:
    write(tmp_path / "set", [0, 1, 2], 3)
    pngs = GraspSet(synthetic_set).depth([4, 5])
    asked = []

    def renderer(scene: dict[str, object], seeds: list[int], cache: Path) -> list[bytes]:
        asked.append((scene["scene"], seeds, cache))
        return pngs

    read = GraspSet(tmp_path / "set", tmp_path / "cache", renderer)
    assert read.depth([5, 0, 4]) == [pngs[1], pngs[0], pngs[0]]
    # all views of a scene at once
    assert asked == [(scene, [5, 5], tmp_path / "cache" / "renders") for scene in (0, 2)]


def test_skipped_scenes_are_passed_over(tmp_path: Path) -> None:
    with GraspSetWriter(tmp_path, CONFIGURATION, 3) as out:
        out.write(scene_rows({"scene": 0, "split": "test", "skipped": "it rolls"}))
        out.write(make_rows(1))
        out.write(make_rows(2))
    read = GraspSet(tmp_path)
    assert read.scenes["scene"].to_pylist() == [1, 2]
    assert read.grasp_scene.tolist() == [0] * NUM_GRASPS + [1] * NUM_GRASPS


def test_a_set_without_manifest_is_read_too(folder: Path) -> None:
    with_manifest = GraspSet(folder)
    (folder / "manifest.json").unlink()
    (folder / "grasps" / ".00000.parquet.partial").touch()
    without = GraspSet(folder)
    assert without.grasps.equals(with_manifest.grasps)
    assert without.sha256 == with_manifest.sha256


def test_pandas_reads_a_set(synthetic_set: Path) -> None:
    pandas = pytest.importorskip("pandas")
    read = GraspSet(synthetic_set)
    grasps = pandas.read_parquet(synthetic_set / "grasps")
    scenes = pandas.read_parquet(synthetic_set / "scenes")
    assert len(grasps) == 240
    np.testing.assert_array_equal(np.stack(grasps["path"]), read.paths)
    by_object = grasps.merge(scenes, on="scene").groupby("object")["success"].mean()
    assert by_object["ball_0"] == read.success[:40].mean()


def test_duckdb_reads_a_set(synthetic_set: Path) -> None:
    duckdb = pytest.importorskip("duckdb")
    read = GraspSet(synthetic_set)
    query = f"""
        SELECT split, count(*), avg(success::INT), max(path[3])
        FROM '{synthetic_set}/grasps/*.parquet' JOIN '{synthetic_set}/scenes/*.parquet' USING (scene)
        GROUP BY split ORDER BY split
    """
    for (split, count, held, height), index in zip(duckdb.sql(query).fetchall(), (2, 0, 1), strict=True):
        rows = read.grasp_split == index
        assert split == ("train", "validation", "test")[index]
        assert count == rows.sum()
        assert held == pytest.approx(read.success[rows].mean())
        assert height == read.paths[rows, 2].max()


def test_a_set_is_read_from_any_file_system(synthetic_set: Path) -> None:
    fsspec = pytest.importorskip("fsspec")
    memory = fsspec.filesystem("memory")
    memory.put(str(synthetic_set), "/grasps", recursive=True)
    local, remote = GraspSet(synthetic_set), GraspSet("memory://grasps")
    assert remote.sha256 == local.sha256
    assert remote.grasps.equals(local.grasps)
    np.testing.assert_array_equal(remote.observation(3).depth, local.observation(3).depth)


def test_a_set_is_read_from_s3(synthetic_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From a server on this machine, by the same address as from a cloud."""
    pytest.importorskip("s3fs")
    moto = pytest.importorskip("moto.server")
    server = moto.ThreadedMotoServer(port=0)
    server.start()
    host, port = server.get_host_and_port()
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "none")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    try:
        import s3fs

        system = s3fs.S3FileSystem()
        system.mkdir("bucket")
        system.put(str(synthetic_set), "bucket/grasps", recursive=True)
        read = GraspSet("s3://bucket/grasps")
        assert read.sha256 == GraspSet(synthetic_set).sha256
        with pytest.raises(FileNotFoundError, match=r"grasp set s3://bucket/nothing has no scenes/\*\.parquet"):
            GraspSet("s3://bucket/nothing")
    finally:
        server.stop()


# damage


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize("table", ["scenes", "views", "grasps"])
@pytest.mark.parametrize(
    ("damage", "error", "message"),
    [
        (flip, ValueError, r"00000\.parquet differs from its checksum in manifest\.json"),
        (Path.unlink, FileNotFoundError, r"00000\.parquet, which the manifest names, is not there"),
    ],
)
def test_a_damaged_shard_names_itself(
    folder: Path, table: str, damage: Callable[[Path], None], error: type[Exception], message: str
) -> None:
    damage(folder / table / "00000.parquet")
    with pytest.raises(error, match=f"{table}/{message}") as caught:
        GraspSet(folder)
    assert "\n" not in str(caught.value)


def test_a_damaged_file_without_manifest_names_itself(folder: Path) -> None:
    (folder / "manifest.json").unlink()
    path = folder / "grasps" / "00000.parquet"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"grasps/00000\.parquet cannot be read as Parquet") as caught:
        GraspSet(folder)
    assert "\n" not in str(caught.value)
    shutil.rmtree(folder / "views")
    with pytest.raises(FileNotFoundError, match=r"has no views/\*\.parquet"):
        GraspSet(folder)


def rewrite(folder: Path, table: str, change: Callable[[pa.Table], pa.Table]) -> None:
    """A file changed by another program, which knows of no manifest."""
    (folder / "manifest.json").unlink(missing_ok=True)
    path = folder / table / "00000.parquet"
    pq.write_table(change(pq.read_table(path)), path)


def test_rows_that_do_not_belong_together_are_named(folder: Path) -> None:
    rewrite(folder, "views", lambda table: table.slice(0, 11))
    with pytest.raises(ValueError, match=r"grasps name 1000 x scene \+ view 5001, which is not there"):
        GraspSet(folder)
    rewrite(folder, "scenes", lambda table: table.slice(0, 5))
    with pytest.raises(ValueError, match="views name scene 5, which is not there"):
        GraspSet(folder)


def test_another_format_is_named(folder: Path) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").write_text(json.dumps(manifest | {"version": "3"}))
    with pytest.raises(ValueError, match=r"manifest\.json is of format version 3; this dexzoo reads version 2"):
        GraspSet(folder)
    (folder / "manifest.json").write_text("{")
    with pytest.raises(ValueError, match=r"manifest\.json is not JSON"):
        GraspSet(folder)
    (folder / "manifest.json").write_text("{}")
    with pytest.raises(ValueError, match=r"manifest\.json is no manifest of a grasp set"):
        GraspSet(folder)
    rewrite(folder, "scenes", lambda table: table.drop_columns(["friction"]))
    with pytest.raises(ValueError, match=r"scenes/00000\.parquet has the columns scene, .*; expected version 2's"):
        GraspSet(folder)


def test_addresses_that_lead_nowhere_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"nowhere has no scenes/\*\.parquet"):
        GraspSet(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="Protocol not known: nosuch"):
        GraspSet("nosuch://bucket/grasps")


def test_views_that_cannot_be_had_are_named(tmp_path: Path) -> None:
    write(tmp_path / "set", [0], 1)
    with pytest.raises(ValueError, match="set keeps no images; open it with a renderer, see GraspSet"):
        GraspSet(tmp_path / "set", tmp_path / "cache").observation(0)
    with pytest.raises(ValueError, match="scene 0 was not simulated, so it cannot be made again"):
        GraspSet(tmp_path / "set", tmp_path / "cache", rendering.render).observation(0)


def test_a_set_of_an_unknown_hand_is_refused(folder: Path) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["configuration"]["hand"] = "shadow"
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(ValueError, match=r"set is of a hand 'shadow', which is not in robots/"):
        GraspSet(folder)


def test_rendered_views_are_cached_and_made_again_when_damaged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = []
    rebuild = rendering.rebuild
    monkeypatch.setattr(rendering, "rebuild", lambda row: made.append(row["scene"]) or rebuild(row))
    row = make_rows(0, object="can_02", scale=1.0, mass=0.3, friction=0.7, T_world_object=np.eye(4).ravel().tolist())
    scene = row["scenes"].to_pylist()[0]
    first = rendering.render(scene, [1, 2], tmp_path)
    assert rendering.render(scene, [1, 2], tmp_path) == first
    assert made == [0]
    (path,) = tmp_path.iterdir()
    path.write_bytes(path.read_bytes()[:50])
    assert rendering.render(scene, [1, 2], tmp_path) == first
    assert rendering.render(scene, [2, 1], tmp_path) == first[::-1]
    assert made == [0, 0, 0]


def test_the_cache_is_the_users(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert user_cache() == tmp_path / "dexzoo"


def test_every_table_has_its_version() -> None:
    assert {schema.metadata[b"dexzoo.grasp_set"] for schema in SCHEMAS.values()} == {b"2"}

"""Collecting grasp sets: the same bytes however it is run, scenes in turn, rows that say what happened."""

import json
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from dexzoo.collection import collect as module
from dexzoo.collection.collect import Configuration, collect, make_scene, object_of
from dexzoo.collection.neighbors import choose, perturb
from dexzoo.collection.rendering import rebuild, render
from dexzoo.collection.workers import in_processes
from dexzoo.data.grasp_set import GraspSet
from dexzoo.data.writer import SceneRows
from dexzoo.generators.heuristic import HeuristicGenerator
from dexzoo.grasp import GRIP, PREGRASP, SQUEEZE, Grasps
from dexzoo.hand import Hand
from dexzoo.sim import trial
from dexzoo.sim.shapes import MASS_RANGE, object_names, split_of

SMALL = Configuration(seed=3, num_grasps=10, num_views=2)


def make_small(patch: pytest.MonkeyPatch) -> None:
    """Few grasps of two objects, made in this process."""
    patch.setattr(module, "make_generator", lambda name, hand: HeuristicGenerator(hand, num_samples=300))
    patch.setattr(module, "object_of", lambda number, split: ("can_02", "box_04")[number % 2])
    patch.setattr(module, "in_processes", lambda function, numbers, workers: map(function, numbers))


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    make_small(monkeypatch)


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("collected")
    with pytest.MonkeyPatch.context() as patch:
        make_small(patch)
        told = list(collect(folder, SMALL, 2))
    assert [line.split(":")[0] for line in told] == ["scene 0 can_02", "scene 1 box_04"]
    return folder


@pytest.fixture(scope="module")
def read(collected: Path, tmp_path_factory: pytest.TempPathFactory) -> GraspSet:
    return GraspSet(collected, tmp_path_factory.mktemp("cache"), render)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


# the same bytes


@pytest.mark.usefixtures("small")
def test_a_set_that_grew_has_the_same_bytes(collected: Path, tmp_path: Path) -> None:
    assert len(list(collect(tmp_path, SMALL, 1))) == 1
    lines = list(collect(tmp_path, SMALL, 2))
    assert lines[0] == "scene 0 is there already"
    assert contents(tmp_path) == contents(collected)
    before = (tmp_path / "manifest.json").stat().st_mtime_ns
    assert list(collect(tmp_path, SMALL, 2)) == ["scene 0 is there already", "scene 1 is there already"]
    assert (tmp_path / "manifest.json").stat().st_mtime_ns == before


@pytest.mark.usefixtures("small")
def test_scenes_in_any_order_make_the_same_bytes(
    collected: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def backwards(function: Callable[[int], SceneRows], numbers: Sequence[int], workers: int) -> Iterator[SceneRows]:
        return map(function, reversed(numbers))

    monkeypatch.setattr(module, "in_processes", backwards)
    list(collect(tmp_path, SMALL, 2))
    assert contents(tmp_path) == contents(collected)


@pytest.mark.usefixtures("small")
def test_another_seed_makes_another_set(collected: Path, tmp_path: Path) -> None:
    list(collect(tmp_path, Configuration(seed=4, num_grasps=10, num_views=2), 2))
    ours, theirs = contents(tmp_path), contents(collected)
    assert ours.keys() == theirs.keys()
    assert {name for name in ours if ours[name] == theirs[name]} == {"objects/00000.parquet"}


@pytest.mark.usefixtures("small")
def test_nothing_is_left_of_a_scene_that_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("the simulator has failed")

    monkeypatch.setattr(module.trial, "run", fail)
    with pytest.raises(RuntimeError, match="the simulator has failed"):
        list(collect(tmp_path, SMALL, 1))
    assert sorted(contents(tmp_path)) == ["manifest.json", "objects/00000.parquet"]


def run(*args: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "dexzoo", "collect", "--num_grasps", "10", "--num_views", "1", *map(str, args)]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent)}
    pipe = subprocess.PIPE
    return subprocess.Popen(command, env=environment, stdout=pipe, stderr=pipe, text=True)


@pytest.mark.slow
def test_processes_killed_and_gone_on_write_what_one_does(tmp_path: Path) -> None:
    out, err = run("--out", tmp_path / "one", "--scenes", 3).communicate()
    assert not err, out
    killed = run("--out", tmp_path / "two", "--scenes", 3, "--workers", 2)
    while not list((tmp_path / "two").glob(".scenes/0*")) and killed.poll() is None:
        time.sleep(0.1)
    killed.kill()
    killed.wait()
    out, err = run("--out", tmp_path / "two", "--scenes", 3, "--workers", 2, "--json").communicate()
    assert not err
    counts = json.loads(out)
    assert counts["scenes"] + sum(counts["skipped"].values()) == 3
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


@pytest.mark.slow
def test_ray_writes_what_a_process_does(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    for folder, how in (("process", ["--workers", 1]), ("ray", ["--ray", "local"])):
        _, err = run("--out", tmp_path / folder, "--scenes", 2, *how).communicate()
        assert not err
    assert contents(tmp_path / "process") == contents(tmp_path / "ray")


# workers


def test_a_worker_that_dies_is_reported() -> None:
    with pytest.raises(RuntimeError, match=r"a worker process died, .* run the same command to go on"):
        list(in_processes(os._exit, [1], 1))


# rows


def test_rows_say_what_was_done(read: GraspSet, hand: Hand) -> None:
    assert read.scenes["object"].to_pylist() == ["can_02", "box_04"]
    assert read.scenes["split"].to_pylist() == [split_of("can_02"), split_of("box_04")]
    for scene in read.scenes.to_pylist():
        assert scene["seed"] == SMALL.seed
        assert MASS_RANGE[scene["category"]][0] <= scene["mass"] <= MASS_RANGE[scene["category"]][1]
        assert 0.5 <= scene["friction"] <= 1.0
        assert 0.95 <= scene["scale"] <= 1.05
    assert read.views.num_rows == 4
    for number, scene in enumerate(read.scenes.to_pylist()):
        here = read.grasp_scene == number
        generated, perturbed = here & (read.source == "generated"), here & (read.source == "perturbed")
        assert generated.sum() == scene["generated"] == 10
        assert read.success[generated].sum() == scene["held"] >= 1
        assert perturbed.sum() == 6
        rank = read.grasps["rank"].to_numpy()
        assert rank[generated].tolist() == list(range(10))
        assert set(rank[perturbed]) <= set(range(10))
        likelihood = read.world_grasps.log_likelihood
        assert likelihood is not None
        assert torch.isfinite(likelihood[torch.tensor(generated)]).all()
        assert torch.isnan(likelihood[torch.tensor(perturbed)]).all()
    assert set(read.grasps["view"].to_pylist()) == {0, 1}
    assert read.grasps["success_rate"].null_count == read.grasps.num_rows
    hand.check(read.world_grasps.joints)
    np.testing.assert_array_equal(np.isfinite(read.grasps["shift"].to_numpy()), read.success)


def test_what_is_read_is_what_was_tried(read: GraspSet) -> None:
    """Scene and grasps made again from the files give the labels of the files, numbers and all."""
    for number, row in enumerate(read.scenes.to_pylist()):
        here = np.flatnonzero(read.grasp_scene == number)
        again = trial.run(rebuild(row), read.world_grasps[here], 1)
        np.testing.assert_array_equal(again.success, read.success[here])
        np.testing.assert_array_equal(again.shift, read.grasps["shift"].to_numpy()[here])


def test_views_are_rendered_again_as_they_were(read: GraspSet) -> None:
    assert read.views["depth"].null_count == 4
    for view in range(4):
        row = read.views.slice(view, 1).to_pylist()[0]
        scene = rebuild(read.scenes.slice(int(read.view_scene[view]), 1).to_pylist()[0])
        expected, seen = scene.observe(row["seed"]).aimed(), read.observation(view)
        np.testing.assert_array_equal(seen.T_world_camera, expected.T_world_camera)
        np.testing.assert_array_equal(seen.mask, expected.mask)
        np.testing.assert_allclose(seen.depth[seen.mask], expected.depth[seen.mask], atol=0.51e-4)


def test_views_without_images_need_a_renderer(collected: Path) -> None:
    with pytest.raises(ValueError, match="keeps no images; open it with a renderer"):
        GraspSet(collected).depth([0])


@pytest.mark.usefixtures("small")
def test_images_are_kept_on_request(read: GraspSet, tmp_path: Path) -> None:
    rows = make_scene(Configuration(seed=3, num_grasps=10, num_views=2, images=True), 0)
    assert rows["views"]["depth"].to_pylist() == read.depth([0, 1])


@pytest.mark.usefixtures("small")
def test_success_rates_come_of_repeated_trials(read: GraspSet) -> None:
    rows = make_scene(Configuration(seed=3, num_grasps=10, num_views=2, trials=3), 0)
    rate = rows["grasps"]["success_rate"].to_numpy()
    np.testing.assert_allclose(3 * rate, np.round(3 * rate), atol=1e-6)
    assert len(set(rate)) > 1
    assert rows["grasps"]["success"].to_pylist() == read.success[read.grasp_scene == 0].tolist()


@pytest.mark.usefixtures("small")
def test_scenes_that_give_up_are_kept_as_such(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Hopeless:
        def generate(self, *_: object) -> Grasps:
            raise RuntimeError("no feasible grasp is found")

    def restless(*_: object) -> None:
        raise ValueError("it rolls")

    monkeypatch.setattr(module, "make_generator", lambda name, hand: Hopeless())
    assert list(collect(tmp_path, SMALL, 1)) == ["scene 0 can_02: skipped, fewer than 10 grasps are generated"]
    monkeypatch.setattr(module.Scene, "place", restless)
    assert list(collect(tmp_path, SMALL, 2))[1] == "scene 1 box_04: skipped, the object does not come to rest"
    assert list(collect(tmp_path, SMALL, 2)) == ["scene 0 is there already", "scene 1 is there already"]
    counts = json.loads((tmp_path / "manifest.json").read_text())["counts"]
    assert counts["skipped"] == {
        "fewer than 10 grasps are generated": 1,
        "the object does not come to rest": 1,
    }
    assert (counts["scenes"], counts["grasps"]) == (0, 0)


@pytest.mark.usefixtures("small")
def test_a_scene_without_a_success_is_skipped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module.trial, "run", lambda scene, grasps, num_threads: trial.Outcomes.none(len(grasps)))
    rows = make_scene(SMALL, 0)
    scene = rows["scenes"].to_pylist()[0]
    assert (scene["skipped"], scene["generated"], scene["held"]) == ("no generated grasp holds", 10, 0)
    assert rows["grasps"].num_rows == rows["views"].num_rows == 0


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"split": "holdout"}, "split 'holdout' is unknown; use one of train, validation, test, all"),
        ({"generator": "magic"}, "generator 'magic' is unknown; use one of kopicki, heuristic"),
        ({"num_grasps": 9}, "num_grasps is 9, but scenes of fewer than 10 are skipped"),
        ({"num_views": 0}, "num_views is 0"),
    ],
)
def test_wrong_configurations_are_named(wrong: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Configuration(**wrong)


# which object


def test_objects_come_round_in_turn() -> None:
    for split in ("train", "validation", "test"):
        names = object_names(split)
        assert sorted(object_of(i, split) for i in range(len(names))) == sorted(names)
        assert object_of(len(names), split) == object_of(0, split)
    uses = Counter(object_of(i, "all") for i in range(1200))
    assert sum(count for name, count in uses.items() if split_of(name) == "test") == 200
    assert len(uses) == len(object_names())
    assert set(uses.values()) == {4, 5}


def test_any_first_scenes_have_the_categories_in_proportion() -> None:
    names = object_names("train")
    share = Counter(name.rpartition("_")[0] for name in names)
    for count in (50, 100, 150):
        seen = Counter(object_of(i, "train").rpartition("_")[0] for i in range(count))
        assert all(abs(seen[kind] - count * share[kind] / len(names)) <= 1 for kind in share)


# neighbors


def test_neighbors_are_near_and_valid(can_grasps: Grasps, hand: Hand) -> None:
    original = can_grasps[np.repeat(np.arange(len(can_grasps)), 4)]
    near = perturb(original, np.random.default_rng(0))
    assert len(near) == len(original)
    assert near.hand == hand
    assert torch.equal(near.grasp_type, original.grasp_type)
    distance = (near.position[:, GRIP] - original.position[:, GRIP]).norm(dim=-1)
    assert float(distance.min()) >= 0.002 - 1e-6
    assert float(distance.max()) <= 0.015 + 1e-6
    cosine = (near.quaternion * original.quaternion).sum(-1).abs().clamp(max=1)
    angle = 2 * torch.arccos(cosine[:, GRIP].double())
    assert float(angle.min()) >= 0.03 - 1e-3
    assert float(angle.max()) <= 0.2 + 1e-3
    change = (near.joints - original.joints).abs()
    assert float(change[:, PREGRASP].max()) < 1e-6
    assert float(change.max()) <= 0.15 + 1e-6
    # the joint that moves most is only stopped by a limit
    free = (near.joints > hand.lower + 1e-3) & (near.joints < hand.upper - 1e-3)
    whole = free[:, GRIP].all(-1)
    assert whole.any()
    assert float(change[whole][:, GRIP].amax(-1).min()) >= 0.03 - 1e-6
    hand.check(near.joints, tolerance=1e-6)
    # where no limit is met grip and squeeze change alike
    both = free[:, GRIP] & free[:, SQUEEZE]
    moved = near.joints - original.joints
    torch.testing.assert_close(moved[:, GRIP][both], moved[:, SQUEEZE][both], atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("success", "around_held"),
    [([True, True, True, False, False], 20), ([True, False], 8), ([False, False], 0), ([True, True], 30)],
)
def test_neighbors_are_sought_around_those_that_hold(success: list[bool], around_held: int) -> None:
    index = choose(np.array(success), 30, np.random.default_rng(0))
    assert len(index) == 30
    assert np.array(success)[index].sum() == around_held

"""Collecting grasp sets: the same bytes however it is run, splits by object, and rows that say what happened."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dexzoo.camera import Observation
from dexzoo.data import collect as module
from dexzoo.data.collect import choose, collect, collect_scene, perturb
from dexzoo.data.schema import TABLES, GraspSet, merge
from dexzoo.generators.heuristic import HeuristicGenerator
from dexzoo.grasp import GRIP, PREGRASP, SQUEEZE, Grasps
from dexzoo.hand import Hand
from dexzoo.sim import Outcomes
from dexzoo.sim.shapes import MASS_RANGE

SEED = 3


def make_small(patch: pytest.MonkeyPatch) -> None:
    """Few grasps, few candidates, two views."""
    patch.setattr(module, "NUM_GENERATED", 4)
    patch.setattr(module, "NUM_NEIGHBOURS", 3)
    patch.setattr(module, "NUM_VIEWS", 2)
    patch.setattr(module, "HeuristicGenerator", lambda: HeuristicGenerator(num_samples=150))
    patch.setattr(module, "object_names", lambda: ["box_03", "can_02"])


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    make_small(monkeypatch)


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("collected")
    with pytest.MonkeyPatch.context() as patch:
        make_small(patch)
        told = list(collect(folder / "scenes", 2, seed=SEED))
    assert [line.split(":")[0] for line in told] == ["scene 0 box_03", "scene 1 can_02"]
    merge(folder / "scenes", folder)
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*.parquet"))}


# the same bytes


@pytest.mark.usefixtures("small")
def test_a_set_resumed_has_the_same_bytes(collected: Path, tmp_path: Path) -> None:
    collect_scene(tmp_path, SEED, 1)  # what a run that was stopped left behind
    untouched = (tmp_path / "scene_000001" / "grasps.parquet").stat().st_mtime_ns
    lines = list(collect(tmp_path, 2, seed=SEED))
    assert len(lines) == 2
    assert lines[0] == "scene 1 is there already"
    assert (tmp_path / "scene_000001" / "grasps.parquet").stat().st_mtime_ns == untouched
    assert contents(tmp_path) == contents(collected / "scenes")


@pytest.mark.usefixtures("small")
def test_another_seed_makes_another_set(collected: Path, tmp_path: Path) -> None:
    collect_scene(tmp_path, SEED + 1, 0)
    ours, theirs = contents(tmp_path), contents(collected / "scenes")
    assert all(ours[f"scene_000000/{name}.parquet"] != theirs[f"scene_000000/{name}.parquet"] for name in TABLES)


@pytest.mark.usefixtures("small")
def test_nothing_is_left_of_a_scene_that_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("the simulator has failed")

    monkeypatch.setattr(module.trial, "run", fail)
    with pytest.raises(RuntimeError, match="the simulator has failed"):
        list(collect(tmp_path, 1, seed=SEED))
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("small")
def test_a_scene_without_feasible_grasps_has_no_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Hopeless:
        def generate(self, *_: object) -> Grasps:
            raise RuntimeError("no feasible grasp is found")

    monkeypatch.setattr(module, "HeuristicGenerator", Hopeless)
    assert collect_scene(tmp_path / "scenes", SEED, 0) == "scene 0 box_03: 0 grasps, 0% hold"
    merge(tmp_path / "scenes", tmp_path)
    read = GraspSet(tmp_path)
    assert (read.scenes.num_rows, read.views.num_rows, read.grasps.num_rows) == (1, 2, 0)
    assert len(read.world_grasps) == 0


@pytest.mark.slow
def test_two_workers_write_what_one_does(tmp_path: Path) -> None:
    for workers in (1, 2):
        assert len(list(collect(tmp_path / str(workers), 2, workers, SEED))) == 2
    assert contents(tmp_path / "1") == contents(tmp_path / "2")


# rows


def test_rows_say_what_was_done(collected: Path, hand: Hand) -> None:
    read = GraspSet(collected)
    assert read.scenes["object"].to_pylist() == ["box_03", "can_02"]
    assert read.scenes["seed"].to_pylist() == [SEED, SEED]
    assert read.scenes["split"].to_pylist() == ["test", "train"]
    for scene in read.scenes.to_pylist():
        assert MASS_RANGE[scene["category"]][0] <= scene["mass"] <= MASS_RANGE[scene["category"]][1]
        assert 0.5 <= scene["friction"] <= 1.0
        assert 0.95 <= scene["scale"] <= 1.05
    assert read.views.num_rows == 4
    generated, perturbed = read.source == "generated", read.source == "perturbed"
    assert 0 < generated.sum() <= 8
    assert perturbed.sum() == 6
    likelihood = np.array(read.grasps["log_likelihood"].to_pylist())
    assert np.isfinite(likelihood[generated]).all()
    assert np.isnan(likelihood[perturbed]).all()
    assert set(read.grasps["view"].to_pylist()) <= {0, 1}
    hand.check(read.world_grasps.joints)
    moved = np.array(read.grasps["shift"].to_pylist(), float)
    np.testing.assert_array_equal(np.isfinite(moved), read.success)


def test_views_show_the_object_of_the_scene(collected: Path) -> None:
    read = GraspSet(collected)
    for index in range(read.views.num_rows):
        view = read.observation(index)
        assert view.mask.sum() > 250
        low, high = view.points_world.min(0), view.points_world.max(0)
        assert (np.abs([low[:2], high[:2]]) < 0.12).all()
        assert low[2] > -0.01


# neighbours


@pytest.fixture(scope="module")
def world(can_grasps: Grasps, can_view: Observation) -> Grasps:
    return can_grasps.to_frame("world", can_view.T_world_camera)


def test_neighbours_are_near_and_valid(world: Grasps, hand: Hand) -> None:
    index = np.repeat(np.arange(len(world)), 4)
    near = perturb(index, world, hand, np.random.default_rng(0))
    original = world[index]
    assert len(near) == len(index)
    assert near.frame == "world"
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
    assert float(change[:, GRIP].max()) > 0.05
    hand.check(near.joints, tolerance=1e-6)
    # where no limit is met grip and squeeze change alike
    free = (near.joints[:, SQUEEZE] > hand.lower + 1e-3) & (near.joints[:, SQUEEZE] < hand.upper - 1e-3)
    free &= (near.joints[:, GRIP] > hand.lower + 1e-3) & (near.joints[:, GRIP] < hand.upper - 1e-3)
    both = (near.joints - original.joints)[:, [GRIP, SQUEEZE]]
    torch.testing.assert_close(both[:, 0][free], both[:, 1][free], atol=1e-6, rtol=0)


def outcomes(success: list[bool]) -> Outcomes:
    return replace(Outcomes.none(len(success)), success=np.array(success, bool))


@pytest.mark.parametrize(
    ("success", "around_good"), [([True, False, False], 20), ([False, False], 0), ([True, True], 30), ([True], 30)]
)
def test_neighbours_are_sought_around_those_that_hold(success: list[bool], around_good: int) -> None:
    index = choose(outcomes(success), 30, np.random.default_rng(0))
    assert len(index) == 30
    assert np.array(success)[index].sum() == around_good

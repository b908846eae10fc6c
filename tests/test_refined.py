"""Refined grasps in a grasp set: only of training objects, tried, the same again, and going on where it stopped."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import synthetic
import torch

from dexzoo.cli import main
from dexzoo.collection import refined
from dexzoo.collection.refined import SLICE_SCENES, Refining, collect_refined
from dexzoo.data.datamodule import GraspDataModule
from dexzoo.data.grasp_set import GraspSet
from dexzoo.data.schema import encode_path, encode_view
from dexzoo.data.writer import GraspSetWriter, scene_rows
from dexzoo.generators.demonstration import load_demonstrations
from dexzoo.generators.kopicki import KopickiGenerator
from dexzoo.grasp import GRIP, Grasps
from dexzoo.hand import Hand
from dexzoo.models.em_fk import EMFK
from dexzoo.perception.observation import Observation
from dexzoo.refinement import TrustRegion, refinement
from dexzoo.refinement.terms import Table
from dexzoo.sim import Outcomes, Scene, trial

NUM = 8
SCENES = {0: "train", 1: "test", SLICE_SCENES: "train", 2 * SLICE_SCENES: "test"}


@pytest.fixture(scope="module")
def evaluator(tmp_path_factory: pytest.TempPathFactory) -> str:
    """An EM-FK that has learned nothing yet, but has a slope."""
    torch.manual_seed(0)
    model = EMFK(width=32, num_blocks=1, image=False)
    with torch.no_grad():
        model.head[-1].weight *= 30
    return str(model.save(tmp_path_factory.mktemp("evaluator")))


@pytest.fixture(scope="module")
def generator(hand: Hand) -> KopickiGenerator:
    """One that knows few demonstrations, whose density is quickly made."""
    return KopickiGenerator(load_demonstrations(hand)[:2], num_kernels=1000)


@pytest.fixture(autouse=True)
def in_this_process(generator: KopickiGenerator, monkeypatch: pytest.MonkeyPatch) -> None:
    def one_by_one(function: Callable[[int], object], numbers: list[int], workers: int) -> Iterator[object]:
        refined._open.cache_clear()
        return map(function, numbers)

    monkeypatch.setattr(refined, "in_processes", one_by_one)
    monkeypatch.setattr(refined, "make_generator", lambda name, hand: generator)


@pytest.fixture
def folder(tmp_path: Path, can_scene: Scene, can_view: Observation, can_grasps: Grasps, can_outcomes: Outcomes) -> Path:
    """The scene of the can several times over, as of training and of test objects, with grasps and one view."""
    grasps, obj = can_grasps[:NUM], can_scene.object
    columns = {
        "view": [0] * NUM,
        "grasp_type": grasps.grasp_type.numpy(),
        "source": ["generated"] * (NUM - 1) + ["perturbed"],
        "rank": np.arange(NUM),
        "path": encode_path(grasps),
        "success": can_outcomes.success[:NUM],
    }
    row = {
        "object": obj.name,
        "category": "can",
        "scale": 1.0,
        "mass": obj.mass,
        "friction": obj.friction,
        "T_world_object": can_scene.T_world_object.reshape(-1).tolist(),
    }
    with GraspSetWriter(tmp_path / "set", {"seed": 0}, 2 * SLICE_SCENES + 1) as writer:
        for number in range(2 * SLICE_SCENES + 1):
            if number in SCENES:
                view = encode_view(can_view.aimed(), 1)
                writer.write(scene_rows(row | {"scene": number, "split": SCENES[number]}, [view], columns))
            else:
                writer.write(
                    scene_rows({"scene": number, "object": "x", "category": "x", "split": "train", "skipped": "?"})
                )
    return tmp_path / "set"


def test_refined_grasps_of_training_objects_join_the_set(
    folder: Path, evaluator: str, can_scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = list(collect_refined(folder, Refining(evaluator, num_grasps=4)))
    assert len(lines) == 2  # the last slice has no training scene
    grasp_set = GraspSet(folder)
    new = grasp_set.source == "refined"
    assert 0 < new.sum() <= 8
    assert lines[0].startswith(f"refined1_00000: {int(new.sum()) // 2} refined grasps")
    assert set(grasp_set.scenes["split"].to_numpy()[grasp_set.grasp_scene[new]]) == {"train"}
    assert set(grasp_set.views["view"].to_numpy()[grasp_set.grasp_view[new]]) == {0}
    # each is near the generated grasp whose rank it has, and is what the simulator says of it
    world, rank = grasp_set.world_grasps, grasp_set.grasps["rank"].to_numpy()
    for row in np.flatnonzero(new):
        generated = grasp_set.source == "generated"
        same = generated & (grasp_set.grasp_scene == grasp_set.grasp_scene[row]) & (rank == rank[row])
        (parent,) = np.flatnonzero(same)
        apart = (world.position[row, GRIP] - world.position[parent, GRIP]).norm()
        assert 0 < float(apart) < 3**0.5 * TrustRegion().wrist + 1e-4
        assert world.grasp_type[row] == world.grasp_type[parent]
    again = trial.run(can_scene, world[np.flatnonzero(new)], num_threads=1)
    np.testing.assert_array_equal(again.success, grasp_set.success[new])
    module = GraspDataModule(str(folder), sources=["refined"])
    assert len(module._rows("train", ["refined"])) == new.sum()
    with pytest.raises(ValueError, match="no refined grasps in its test split"):
        module._rows("test", ["refined"])


def test_a_round_can_be_continued_and_repeated(folder: Path, evaluator: str, tmp_path: Path) -> None:
    how = Refining(evaluator, num_grasps=2)
    first = next(iter(collect_refined(folder, how)))  # then it is stopped
    assert first.startswith("refined1_00000:")
    assert next(iter(collect_refined(folder, how))) == "refined1_00000 is there already"
    kept = (folder / "grasps" / "refined1_00000.parquet").read_bytes()
    lines = list(collect_refined(folder, how))
    assert [line.endswith("there already") for line in lines] == [True, False]
    assert (folder / "grasps" / "refined1_00000.parquet").read_bytes() == kept
    other = list(collect_refined(folder, Refining(evaluator, round=2, num_grasps=2)))
    assert other[0].startswith("refined2_00000:")
    with pytest.raises(ValueError, match=r"refined1 of grasp set .* was made with .*'num_grasps': 2.*; start another"):
        next(iter(collect_refined(folder, Refining(evaluator, num_grasps=3))))
    torch.manual_seed(1)
    stranger = str(EMFK(width=32, num_blocks=1, image=False).save(tmp_path / "stranger"))
    with pytest.raises(ValueError, match="start another --round"):
        next(iter(collect_refined(folder, Refining(stranger, num_grasps=2))))
    part = "grasps/refined1_00001.parquet"
    content = (folder / part).read_bytes()
    with GraspSetWriter(folder, {}, 0) as writer:
        del writer.manifest["files"][part]
        writer._save()
    (folder / part).unlink()
    list(collect_refined(folder, how))  # now that there are others besides
    assert (folder / part).read_bytes() == content


def test_the_command_adds_to_a_set(folder: Path, evaluator: str, capsys: pytest.CaptureFixture[str]) -> None:
    args = ["collect_refined", "--out", str(folder), "--evaluator", evaluator, "--num_grasps", "2", "--json"]
    assert main(args) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert f'"refined": {(GraspSet(folder).source == "refined").sum()}' in out


def test_sets_that_cannot_be_refined_are_refused_in_one_line(tmp_path: Path, evaluator: str) -> None:
    with pytest.raises(FileNotFoundError, match="has no scenes"):
        list(collect_refined(tmp_path / "none", Refining(evaluator)))
    assert not (tmp_path / "none").exists()
    recorded = synthetic.write(tmp_path / "recorded", num_grasps=4)
    with pytest.raises(ValueError, match="scene 0 was not simulated, so it cannot be made again"):
        list(collect_refined(recorded, Refining(evaluator)))
    with pytest.raises(ValueError, match="model 'em22' is unknown"):
        list(collect_refined(recorded, Refining("em22")))


def test_a_round_of_other_settings_or_of_a_set_that_grew_is_not_continued(
    folder: Path, evaluator: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    how = Refining(evaluator, num_grasps=1)
    list(collect_refined(folder, how))
    manifest = folder / "manifest.json"
    made = json.loads(manifest.read_text())["configuration"]["refined1"]
    assert made["num_scenes"] == 2
    assert made["trust_region"]["wrist"] == TrustRegion().wrist
    assert made["terms"]["table"] == Table().weight
    assert made["terms"]["prior"] == 0.05
    assert made["num_steps"] == 30
    assert made["step_size"] == 0.2
    assert made["clearance"] == {"table": 0.002, "around": 0.007, "support": 0.35, "lack": 0.001}
    assert made["shadow"] == [0.007, 0.014]
    for home, name, value, differs in (
        (refinement, "NUM_STEPS", 20, "'num_steps': 30"),
        (refinement, "STEP_SIZE", 0.1, "'step_size': 0.2"),
        (refinement, "AROUND", 0.005, "'clearance': {"),
        (refinement, "SHADOW_DEPTHS", (0.007,), "'shadow': "),
        (refinement, "WEIGHTS", {"table": -100.0}, "'terms': {"),
        (refined, "training_scenes", lambda folder: [0, 1, SLICE_SCENES], "'num_scenes': 2"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(home, name, value)
            message = rf"refined1 of grasp set .* was made with {{{differs}.*; start another --round"
            with pytest.raises(ValueError, match=message):
                next(iter(collect_refined(folder, how)))
    old = json.loads(manifest.read_text())
    old["configuration"]["refined1"] = {name: made[name] for name in ("evaluator", "seed", "num_grasps")}
    manifest.write_text(json.dumps(old))
    assert (GraspSet(folder).source == "refined").any()
    with pytest.raises(ValueError, match="start another --round"):
        next(iter(collect_refined(folder, how)))

"""The benchmark on meshes from elsewhere: what it records is a grasp set, resumes, and is compared and reported."""

import sys
from pathlib import Path
from typing import Any

import pytest
import trimesh

import dexzoo
from dexzoo import Observation
from dexzoo.comparison import scores
from dexzoo.comparison.compare import compare
from dexzoo.data.datamodule import GraspDataModule
from dexzoo.data.grasp_set import GraspSet
from dexzoo.generators.heuristic import HeuristicGenerator
from dexzoo.grasp import Grasps
from dexzoo.hand import Hand
from dexzoo.models.em2 import EM2
from dexzoo.sim.shapes import make_object

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"
NAMES = ["can", "wall"]


@pytest.fixture
def meshes(monkeypatch: pytest.MonkeyPatch):  # noqa: ANN201, a module
    monkeypatch.syspath_prepend(BENCHMARKS)
    monkeypatch.setattr(scores, "NUM_TIMED", 3)
    import meshes

    yield meshes
    for name in ("meshes", "generator", "generator_figures", "generator_pictures", "evaluator_report", "tables"):
        sys.modules.pop(name, None)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A can, and a wall that no hand can hold."""
    can, wall = make_object("can_07"), trimesh.creation.box((0.5, 0.5, 0.2))
    wall.apply_translation((0, 0, 0.1))
    for name, mesh, hulls in (("can", can.mesh, can.hulls), ("wall", wall, [wall])):
        (tmp_path / "objects" / name).mkdir(parents=True)
        mesh.export(tmp_path / "objects" / name / "mesh.obj")
        for number, hull in enumerate(hulls):
            hull.export(tmp_path / "objects" / name / f"hull_{number:02d}.obj")
    return tmp_path / "objects"


def test_objects_are_tried_recorded_compared_and_reported(
    meshes: Any,  # noqa: ANN401
    folder: Path,
    hand: Hand,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    generator = HeuristicGenerator(hand, num_samples=800)  # the default one takes seconds for a view
    seen = []

    def generate(view: Observation, num_grasps: int, seed: int) -> Grasps:
        seen.append(seed)
        if len(seen) == 2:
            raise KeyboardInterrupt("killed")
        return generator.generate(view, num_grasps, seed)

    monkeypatch.setattr(dexzoo, "generate", generate)
    with pytest.raises(KeyboardInterrupt):
        meshes.record(tmp_path / "set", folder, NAMES, 2, 20)
    meshes.record(tmp_path / "set", folder, NAMES, 2, 20)
    asked = len(seen)
    assert len(set(seen)) == asked - 1  # only the scene that was interrupted was asked for again
    meshes.record(tmp_path / "set", folder, NAMES, 2, 20)
    assert len(seen) == asked

    found = meshes.outcomes(tmp_path / "set")
    made = GraspSet(tmp_path / "set", tmp_path / "cache")
    can = found["objects"]["can"]
    assert (can["scenes"], can["grasps"], can["hold"]) == (2, len(made.success), int(made.success.sum()))
    assert can["hold"] > 0
    assert found["objects"]["wall"] | {"scenes": 0} == dict.fromkeys(can, 0)
    assert list(found["objects_without_grasps"]) == ["wall"]
    assert None not in made.views["depth"].to_pylist()
    assert set(made.scenes["T_world_object"].to_pylist()) == {None}

    data = GraspDataModule(str(tmp_path / "set"), cache=str(tmp_path / "cache"))
    result = compare({"em2": EM2(width=8).eval()}, data) | found
    from evaluator_report import meshes as written

    text = written(result)
    first = result["sources"]["generated"]["rows"]["em2"]["figures"]["top1"]["value"]
    assert f"| can | 2 | {can['grasps']} | {can['hold']} | {can['collided']} | {2 * first:.0f} of 2 |" in text
    assert "Objects without any grasp: wall (" in text

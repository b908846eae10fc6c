"""What README and examples show runs as it stands."""

import json
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import dexzoo
from dexzoo.cli.main import main
from dexzoo.grasp import Grasps
from dexzoo.models.registry import list_models, shipped_card
from dexzoo.perception import Observation
from dexzoo.sim import Scene
from dexzoo.sim.shapes import make_object

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
# These make or go through a grasp set, train or serve until stopped; tests of their own run them small.
ELSEWHERE = ("collect", "compare", "fit", "test", "view")


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the files that README's lines name."""
    folder = tmp_path_factory.mktemp("desk")
    obj = make_object("can_01")
    obj.mesh.export(folder / "mug.obj")
    observation = Scene.place(obj, seed=0).observe(seed=0)
    cv2.imwrite(str(folder / "depth.png"), np.round(observation.depth * 10_000).astype(np.uint16))
    camera = {**observation.camera.__dict__, "depth_scale": 0.0001}
    (folder / "camera.json").write_text(json.dumps(camera))
    return folder


@pytest.mark.xdist_group("readme")
def test_the_lines_of_python_in_the_readme_run(desk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(desk)
    (block,) = re.findall(r"```python\n(.*?)```", README, re.S)
    names: dict[str, object] = {}
    exec(block, names)
    assert len(names["result"].grasps) == 20  # type: ignore[attr-defined]
    assert len(names["outcomes"]) > 0  # type: ignore[arg-type]


@pytest.mark.xdist_group("readme")
def test_the_commands_in_the_readme_run(desk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(desk)
    lines = re.findall(r"^python -m dexzoo (.*?)(?:\s+#.*)?$", README, re.M)
    assert len(lines) > 8
    for line in lines:
        if not line.startswith(ELSEWHERE):
            assert main(shlex.split(line)) == 0, line
    assert (desk / "out" / "plan" / "best_grasp.png").exists()
    assert (desk / "better.safetensors").exists()


def test_a_term_of_your_own_is_climbed(can_view: Observation, can_grasps: Grasps) -> None:
    (block,) = re.findall(r"```python\n(.*?)```", (ROOT / "CONTRIBUTING.md").read_text(), re.S)
    names: dict[str, object] = {
        "dexzoo": dexzoo,
        "evaluator": dexzoo.load("em_fk"),
        "grasps": can_grasps[:2],
        "observation": can_view,
    }
    exec(block, names)
    result = names["result"]
    assert isinstance(result, dexzoo.Refinement)
    assert (result.grasps.position[result.accepted, 6, 2] > 0).all()
    torch.testing.assert_close(result.penalties["height"], result.grasps.position[:, 6, 2])


def test_the_demo_ranks_verifies_and_draws(tmp_path: Path) -> None:
    call = [sys.executable, str(ROOT / "examples" / "01_demo.py"), "--num_grasps", "12", "--out", str(tmp_path)]
    done = subprocess.run(call, capture_output=True, text=True, check=True, timeout=120)
    assert "verified" in done.stdout
    assert "score before" in done.stdout
    assert {path.name for path in tmp_path.iterdir()} == {"grasp.png", "lift.png"}


def test_your_architecture_is_trained_saved_and_scores(tmp_path: Path) -> None:
    path = ROOT / "examples" / "02_your_architecture.py"
    assert len(path.read_text().splitlines()) < 60
    call = [sys.executable, str(path), "--out", str(tmp_path)]
    done = subprocess.run(call, capture_output=True, text=True, check=True, timeout=120, cwd=ROOT)
    scores = json.loads(done.stdout.strip().splitlines()[-1].partition(": ")[2])
    assert len(scores) == 20
    assert len(set(scores)) > 5
    assert json.loads((tmp_path / "two_branches.json").read_text())["data"]["train_grasps"] > 0


def test_the_cards_say_what_the_weights_and_the_benchmarks_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    cards = runpy.run_path(str(ROOT / "benchmarks" / "cards.py"))
    written = {path.stem: path.read_text() for path in (ROOT / "docs" / "cards").glob("*.md")}
    assert written == {name: cards["page"](name) for name in cards["shipped"]()}
    for name, license in (("hed", "MIT"), ("lite0", "Apache-2.0")):
        assert f"| license | {license}, Copyright" in "\n".join(cards["trunk"]({"trunk": name}))
    assert "Frozen trunk" in written["em2"]
    assert "Frozen trunk" not in written["em_fk"]


def test_the_comparison_is_of_the_weights_that_ship() -> None:
    compared = json.loads((ROOT / "benchmarks" / "results" / "comparison.json").read_text())
    cards = {name: card for name in list_models() if (card := shipped_card(name))}
    files = {name: [name, *card["arguments"].get("members", [])] for name, card in cards.items()}
    shipped = {name: [cards[one]["sha256"] for one in every] for name, every in files.items()}
    assert compared["weights"] == shipped


def test_the_figures_are_those_that_the_benchmarks_wrote(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    report = runpy.run_path(str(ROOT / "benchmarks" / "report.py"))
    assert report["with_figures"](README, report["summary"]()) == README
    card = (ROOT / "docs" / "data.md").read_text()
    assert report["with_figures"](card, report["counts"]()) == card
    views = (ROOT / "docs" / "sensor.md").read_text()
    assert report["with_figures"](views, report["sensor"]()) == views
    grasps = (ROOT / "docs" / "generator.md").read_text()
    assert report["with_figures"](grasps, report["generator"]()) == grasps
    refined = (ROOT / "docs" / "refinement.md").read_text()
    assert report["with_figures"](refined, report["refinement"]()) == refined
    assert (ROOT / "docs" / "results.md").read_text() == report["page"]()

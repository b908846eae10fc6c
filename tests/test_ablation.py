"""The benchmark of ingredients, data, width and recipe: runs resume, are not repeated, and are measured alike."""

import os
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic
import torch

from dexzoo.comparison.compare import compare
from dexzoo.data.datamodule import GraspDataModule
from dexzoo.data.schema import SOURCES
from dexzoo.models.em2 import EM2
from dexzoo.models.zoo import load
from dexzoo.resources import resource

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"


@pytest.fixture
def ablation(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):  # noqa: ANN201, a module
    monkeypatch.syspath_prepend(BENCHMARKS)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    import ablation

    yield ablation
    for name in ("ablation", "evaluator_report", "tables"):
        sys.modules.pop(name, None)


def test_every_run_names_arguments_that_there_are(ablation: Any) -> None:  # noqa: ANN401
    for name, run in ablation.runs().items():
        shipped = ablation.configuration(ablation.Run(run.config, {}), "somewhere", 64_000)
        made = ablation.configuration(run, "somewhere", 64_000)
        assert (resource("configs") / run.config).is_file()
        assert (made == shipped) == (not run.changes), name
        for key in run.changes:
            part, _, argument = key.rpartition(".")
            if part == "model":
                assert argument in shipped["model"]["init_args"], name
        whole, _, without = name.partition("-")
        if without:  # one ingredient less, and nothing else
            base = ablation.runs()[whole].changes
            assert run.changes.keys() >= base.keys(), name
            less = [value for key, value in run.changes.items() if base.get(key) != value]
            assert less == ([SOURCES[:1]] if without == "perturbed" else [False]), name
            assert run.against == whole
        assert made["trainer"]["max_steps"] * made["data"]["batch_size"] == 64_000
        assert run.against is None or run.against in ablation.runs()


def test_runs_go_on_are_not_repeated_and_are_measured_as_compare_does(
    ablation: Any,  # noqa: ANN401
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    grasps = str(synthetic.write(tmp_path / "grasps"))
    known = {
        "em2": ablation.Run("em2_lite.yaml", {"model.width": 16}),
        "em2@50": ablation.Run("em2_lite.yaml", {"model.width": 16, "data.train_share": 0.5}, "em2"),
    }
    folder = tmp_path / "runs"
    step = EM2.training_step

    def killed(self: EM2, batch: object, batch_idx: int) -> torch.Tensor:
        if self.trainer.global_step == 2:
            raise RuntimeError("killed")
        return step(self, batch, batch_idx)

    with monkeypatch.context() as patch:
        patch.setattr(EM2, "training_step", killed)
        with pytest.raises(RuntimeError, match="killed"):
            ablation.fit(folder / "em2@50", known["em2@50"], grasps, 4 * 64)
    assert not ablation.finished(folder / "em2@50")
    for name, run in known.items():
        ablation.fit(folder / name, run, grasps, 4 * 64)
        assert torch.load(folder / name / "checkpoints" / "last.ckpt", weights_only=True)["global_step"] == 4
    ablation.fit(tmp_path / "unbroken" / "em2@50", known["em2@50"], grasps, 4 * 64)
    ends = [load(place / "em2@50").state_dict() for place in (folder, tmp_path / "unbroken")]
    assert all(torch.equal(value, ends[1][name]) for name, value in ends[0].items())

    with monkeypatch.context() as patch:
        patch.setattr(ablation.command_line, "main", lambda _: pytest.fail("repeated"))
        ablation.fit(folder / "em2@50", known["em2@50"], grasps, 4 * 64)
        with pytest.raises(ValueError, match=r"em2@50\.yaml differs from what is asked for"):
            ablation.fit(folder / "em2@50", known["em2@50"], grasps, 5 * 64)

    for name in known:
        ablation.keep(folder / name, tmp_path / "results", grasps)
    result = ablation.measured(tmp_path / "results", known, grasps)
    assert [row["train_grasps"] for row in result["runs"].values()] == [160, 80]
    data = GraspDataModule(grasps)
    reference = compare({name: load(folder / name) for name in known}, data)["sources"]["generated"]["rows"]
    for name, row in result["runs"].items():
        assert row["grasps_seen"] == 256
        for key, figure in row["figures"]["generated"].items():
            assert figure == reference[name]["figures"][key]
    moved = result["runs"]["em2@50"]["change"]["generated"]["auroc"]["value"]
    values = [row["figures"]["generated"]["auroc"]["value"] for row in result["runs"].values()]
    assert moved == pytest.approx(values[1] - values[0], abs=2e-6)
    assert np.ptp(result["runs"]["em2@50"]["change"]["generated"]["auroc"]["interval"]) == 0  # of one scene

    from evaluator_report import ablation as written

    text = written(result)
    assert "each run sees 256 grasps in training" in text
    assert re.findall(r"^\| (em2\S*) \| (\d+) \|", text, re.M) == [("em2", "160"), ("em2@50", "80")]
    assert f"| {moved:+.3f} (" in text


def test_a_run_on_other_data_is_refused(ablation: Any, tmp_path: Path) -> None:  # noqa: ANN401
    grasps, others = synthetic.write(tmp_path / "grasps"), synthetic.write(tmp_path / "others", seed=1)
    known = {"one": ablation.Run("em2_lite.yaml", {"model.width": 8})}
    ablation.fit(tmp_path / "runs" / "one", known["one"], str(grasps), 64)
    with pytest.raises(ValueError, match="was trained on another grasp set"):
        ablation.keep(tmp_path / "runs" / "one", tmp_path / "results", os.fspath(others))
    ablation.keep(tmp_path / "runs" / "one", tmp_path / "results", os.fspath(grasps))
    with pytest.raises(ValueError, match="is of another grasp set"):
        ablation.measured(tmp_path / "results", known, os.fspath(others))
    other = {"one": ablation.Run("em2_lite.yaml", {"model.width": 16})}
    with pytest.raises(ValueError, match="differs from what is asked for now"):
        ablation.measured(tmp_path / "results", other, os.fspath(grasps))

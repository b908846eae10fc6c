"""Training goes on after a kill, is shared among processes, and ends in honest probabilities."""

import csv
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import synthetic
import torch
from lightning.pytorch import Trainer
from safetensors.torch import load_file

import dexzoo
from dexzoo.data.batches import BalancedBatches, GraspDataset
from dexzoo.grasp import Trajectory
from dexzoo.models.em2 import EM2
from dexzoo.models.evaluator import GraspEvaluator
from dexzoo.training import command_line
from dexzoo.training.command_line import CommandLine, main

# 160 training grasps in batches of 32 make five steps an epoch; a checkpoint every four lies in mid-epoch.
STEPS = [
    "--config=smoke.yaml",
    "--model.width=32",
    "--trainer.val_check_interval=3",
    "--trainer.max_steps=12",
]
TWO_PROCESSES = ["--trainer.accelerator=cpu", "--trainer.devices=2", "--trainer.strategy=ddp"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return synthetic.write(tmp_path_factory.mktemp("grasps"))


@pytest.fixture
def arguments(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.chdir(tmp_path)
    return ["fit", *STEPS, "--json", "--data.folder", str(folder), "--data.cache", str(tmp_path / "cache")]


def fit(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> Path:
    main(arguments)
    return Path(json.loads(capsys.readouterr().out)["weights"]).parent


def test_a_killed_run_goes_on_to_the_same_weights(
    arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = fit(arguments, capsys)
    step = EM2.training_step

    def killed(self: EM2, batch: object, batch_idx: int) -> torch.Tensor:
        if self.trainer.global_step == 11:
            raise KeyboardInterrupt("killed")
        return step(self, batch, batch_idx)

    with monkeypatch.context() as patch:
        patch.setattr(EM2, "training_step", killed)
        with pytest.raises(SystemExit):  # what Lightning makes of an interrupt
            main(arguments)
    capsys.readouterr()
    left = Path("runs/smoke/version_1/checkpoints/last.ckpt")
    assert torch.load(left, weights_only=True)["global_step"] == 8
    resumed = fit([*arguments, "--ckpt_path", str(left)], capsys)
    first, second = (torch.load(run / "checkpoints" / "last.ckpt", weights_only=True) for run in (whole, resumed))
    assert first["global_step"] == second["global_step"] == 12
    for part in ("state_dict", "current_model_state"):
        assert first[part].keys() == second[part].keys()
        assert all(torch.equal(value, second[part][name]) for name, value in first[part].items())
    ends = [load_file(run / "em2.safetensors") for run in (whole, resumed)]
    assert all(torch.equal(value, ends[1][name]) for name, value in ends[0].items())


def test_a_resumed_run_remembers_the_best_before_the_kill(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    before = fit(arguments, capsys)
    checkpoint = torch.load(before / "checkpoints" / "last.ckpt", weights_only=True)
    (state,) = [one for key, one in checkpoint["callbacks"].items() if "'monitor': 'validation_auroc'" in key]
    state["best_model_score"] = torch.tensor(2.0)  # what no later validation reaches
    state["kth_value"], state["best_k_models"] = torch.tensor(2.0), {state["best_model_path"]: torch.tensor(2.0)}
    torch.save(checkpoint, before / "unbeatable.ckpt")
    best = torch.load(before / "checkpoints" / "best.ckpt", weights_only=True)["state_dict"]
    more = ["--trainer.max_steps=15", "--ckpt_path", str(before / "unbeatable.ckpt")]
    after = fit([*arguments, *more], capsys)
    assert after != before
    weights = load_file(after / "em2.safetensors")
    assert all(torch.equal(value.half(), best[name].half()) for name, value in weights.items() if "head" in name)
    assert (before / "checkpoints" / "best.ckpt").is_file()


def test_a_resumed_run_takes_the_settings_that_are_typed(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    stopping = ["--trainer.callbacks+=EarlyStopping", "--trainer.callbacks.monitor=validation_auroc"]
    stopping.append("--trainer.callbacks.min_delta=2")  # more than it can rise: all validations but the first wait
    before = fit([*arguments, *stopping, "--trainer.callbacks.patience=30"], capsys)
    more = ["--trainer.max_steps=16", "--trainer.callbacks.patience=20", "--model.learning_rate=1e-5"]
    left = str(before / "checkpoints" / "last.ckpt")
    after = fit([*arguments, *stopping, *more, "--model.weight_decay=0.3", "--ckpt_path", left], capsys)
    checkpoint = torch.load(after / "checkpoints" / "last.ckpt", weights_only=True)
    assert checkpoint["global_step"] == 16
    (group,) = checkpoint["optimizer_states"][0]["param_groups"]
    assert (group["lr"], group["weight_decay"]) == (1e-5, 0.3)
    (state,) = [one for key, one in checkpoint["callbacks"].items() if key.startswith("EarlyStopping")]
    assert (state["patience"], state["wait_count"] > 2) == (20, True)


def drawn_from(success: torch.Tensor, scene: torch.Tensor) -> GraspDataset:
    """Grasps of scenes with as many views as the scene's number modulo 3, and one."""
    view_scene = torch.tensor([number for number in scene.unique().tolist() for _ in range(1 + number % 3)])
    count, views = len(success), len(view_scene)
    first = torch.searchsorted(view_scene, scene)
    grasps = Trajectory(torch.zeros(count, 10, 7), torch.zeros(count, 10, 20), torch.zeros(count, dtype=torch.long))
    return GraspDataset(grasps, success, scene, first, {}, view_scene, torch.eye(4).expand(views, 4, 4))


@pytest.mark.parametrize(("has", "precision"), [(True, "bf16-mixed"), (False, "32-true")])
def test_bfloat16_only_where_it_is_fast(
    arguments: list[str],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    has: bool,
    precision: str,
) -> None:
    monkeypatch.setattr(command_line, "fast_bfloat16", lambda device: has)
    run = fit([*arguments, "--trainer.max_steps=1", "--trainer.val_check_interval=1"], capsys)
    card = json.loads((run / "em2.json").read_text())
    assert card["config"]["trainer"]["precision"] == precision


def test_balanced_batches_are_balanced_and_go_on() -> None:
    rng = np.random.default_rng(0)
    scene = torch.tensor(rng.integers(0, 50, 2000))
    success = torch.tensor(rng.random(2000) < 0.1).float()
    dataset = drawn_from(success, scene)
    for together in (1, 8):
        batches = BalancedBatches(dataset, 64, together, seed=3)
        assert len(batches) == 32
        draws = [draw for _ in range(40) for draw in batches]
        drawn = [row for draw in draws for row in draw.rows]
        assert float(success[drawn].mean()) == pytest.approx(0.5, abs=0.02)
        # within a class each grasp is as likely as any other: counts are about 0.5 * draws / size of the class
        count = np.bincount(drawn, minlength=2000)
        for label in (0, 1):
            expected = 0.5 * len(drawn) / int((success == label).sum())
            assert count[success.numpy() == label].mean() == pytest.approx(expected, rel=0.05)
            assert count[success.numpy() == label].min() > 0
        # each view shows its own scene, and the views of a scene are as likely
        seen = torch.tensor([view for draw in draws for view in draw.views])
        assert torch.equal(dataset.view_scene[seen], scene[drawn])
        of_three = torch.bincount(seen)[dataset.view_scene % 3 == 2].view(-1, 3)
        assert (of_three / of_three.sum(1, keepdim=True)).mean(0).tolist() == pytest.approx([1 / 3] * 3, abs=0.03)
        other = BalancedBatches(dataset, 64, together, seed=3)
        other.drawn = 7
        again = BalancedBatches(dataset, 64, together, seed=3)
        assert next(iter(other)) == list(again)[7]
    shown = [len(set(draw.views)) for draw in BalancedBatches(dataset, 64, 8)]
    assert max(shown) <= 8


def test_processes_share_batches() -> None:
    dataset = drawn_from((torch.arange(100) % 2).float(), torch.arange(100) // 10)
    whole = list(BalancedBatches(dataset, 7, 2))
    parts = [list(BalancedBatches(dataset, 7, 2, rank=rank, world_size=2)) for rank in (0, 1)]
    assert [(a.rows + b.rows, a.views + b.views) for a, b in zip(*parts, strict=True)] == whole


class Alone(GraspEvaluator):
    architecture = "alone"


def test_calibration_finds_what_made_the_labels() -> None:
    generator = torch.Generator().manual_seed(0)
    logit = 4 * torch.randn(20_000, generator=generator)
    success = torch.bernoulli(torch.sigmoid(logit / 2.5 - 0.8), generator=generator)
    model = Alone()
    before = model.probability(logit)
    assert torch.equal(before, logit.sigmoid())
    model.calibrate(logit, success)
    assert float(model.temperature) == pytest.approx(2.5, rel=0.05)
    assert float(model.offset) == pytest.approx(-0.8, abs=0.05)
    p = model.probability(logit)
    for low in np.arange(0, 1, 0.1):
        here = (p >= low) & (p < low + 0.1)
        assert float(p[here].mean()) == pytest.approx(float(success[here].mean()), abs=0.04)
    assert (p[logit.argsort()].diff() >= 0).all()


def test_calibration_needs_both_outcomes_and_survives_the_perfect() -> None:
    logit = torch.linspace(-2, 2, 50)
    with pytest.raises(ValueError, match="calibration needs grasps that hold and grasps that fail"):
        Alone().calibrate(logit, torch.ones(50))
    model = Alone()
    model.calibrate(logit, (logit > 0).float())
    assert torch.isfinite(model.probability(logit)).all()
    assert float(model.temperature) > 0


def test_one_process_predicts(arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CommandLine, "_load", None)  # refused before any work, and before the second process
    for more in (TWO_PROCESSES, ["--trainer.accelerator=cpu", "--trainer.devices=1", "--trainer.num_nodes=2"]):
        with pytest.raises(ValueError, match=r"^predict: one process does it, not 2; give --trainer\.devices 1 "):
            main(["predict", *arguments[1:], *more])


@pytest.mark.parametrize("command", ["validate", "test"])
def test_the_first_of_several_processes_reports(
    command: str, arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    main([command, *arguments[1:]])
    assert json.loads(capsys.readouterr().out).keys() >= {f"{command.replace('validate', 'validation')}_auroc"}
    monkeypatch.setattr(Trainer, "is_global_zero", False)
    main([command, *arguments[1:]])
    assert capsys.readouterr().out == ""


@pytest.mark.slow
def test_two_processes_learn_as_one(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    # each process draws its own dropout; after more steps rounding alone sets two runs apart
    short = ["--model.dropout=0", "--trainer.precision=32", "--trainer.max_steps=6"]
    one = fit([*arguments, *short], capsys)
    command = [sys.executable, "-m", "dexzoo", *arguments, *short, *TWO_PROCESSES]
    environment = {**os.environ, "PYTHONPATH": str(Path(dexzoo.__file__).parent.parent)}
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    both = Path(json.loads(done.stdout.strip().splitlines()[-1])["weights"]).parent
    losses = [
        [
            float(row["validation_loss"])
            for row in csv.DictReader((run / "metrics.csv").open())
            if row["validation_loss"]
        ]
        for run in (one, both)
    ]
    assert len(losses[0]) == 3
    assert losses[1] == pytest.approx(losses[0], abs=1e-3)

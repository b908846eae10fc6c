"""Training and evaluation from the command line: fit, validate, test and predict, by Lightning's own command line.

The configuration is the truth and a checkpoint is weights: nothing that a checkpoint stores changes a setting.
"""

from __future__ import annotations

import argparse
import json
import logging
import pickle
import re
import shlex
import sys
import warnings
from pathlib import Path
from typing import Any

import torch
import yaml
from jsonargparse import ArgumentError
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI

from dexzoo.collection.rendering import render
from dexzoo.data.datamodule import GraspDataModule
from dexzoo.models.encoders import fast_bfloat16
from dexzoo.models.evaluator import GraspEvaluator
from dexzoo.models.files import load_weights
from dexzoo.models.zoo import load
from dexzoo.resources import resource

SUBCOMMANDS = ("fit", "validate", "test", "predict")
CONFIG_OPTIONS = ("-c", "--config")
DATA_SETTINGS = ("batch_size", "sources", "num_scenes", "train_share", "seed")
NOT_NEWS = (
    ".*does not have many workers.*",  # batches are gathers from memory, workers would slow them
    ".*args parameter is intended to run from within Python.*",  # Lightning sees ours and those of `python -m dexzoo`
    ".*isinstance.treespec, LeafSpec.*",  # between Lightning and torch
)
"""Warnings of Lightning's that a user can do nothing about."""

_log = logging.getLogger(__name__)


class CommandLine(LightningCLI):
    """Lightning's command line, with weights from the zoo, and with export after fitting.

    --ckpt_path takes a Lightning checkpoint (.ckpt, to resume or to evaluate), or anything that `zoo.load` takes: a
    model's name, a .safetensors file or a run's folder.

    Args:
        args: Arguments, the subcommand first.
        command: The whole command, for the card.
    """

    def __init__(self, args: list[str], command: str) -> None:
        self.command = command
        # errors raised instead of printed with a page of usage, by the main parser and by each subcommand's
        parser: dict[str, Any] = {"exit_on_error": False, "prog": "python -m dexzoo"}
        parser |= {name: {"exit_on_error": False} for name in SUBCOMMANDS}
        super().__init__(
            GraspEvaluator,
            GraspDataModule,
            subclass_mode_model=True,
            trainer_defaults={
                "enable_progress_bar": sys.stderr.isatty(),
                "enable_model_summary": False,
                "log_every_n_steps": 1,
                "use_distributed_sampler": False,  # the loaders share batches among processes themselves
            },
            save_config_kwargs={"overwrite": True},
            parser_kwargs=parser,
            auto_configure_optimizers=False,
            args=args,
        )

    def add_default_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Add the arguments that all of dexzoo's commands have.

        Args:
            parser: The parser.
        """
        parser.add_argument("--seed_everything", "--seed", type=int, default=0, help="Seed of all random numbers.")
        parser.add_argument("--json", action="store_true", help="Write results to standard output as one JSON object.")

    @staticmethod
    def subcommands() -> dict[str, set[str]]:
        """The subcommands, with those of the trainer's arguments that this command line settles by itself."""
        settled = {"weights_only", "verbose", "return_predictions"}
        return {name: skipped | settled for name, skipped in LightningCLI.subcommands().items()}

    def before_instantiate_classes(self) -> None:
        """Train in float32 where bfloat16 would be slow."""
        trainer = self._get(self.config, "trainer")
        chosen = trainer.accelerator
        on_processor = chosen == "cpu" or (chosen == "auto" and not torch.accelerator.is_available())
        if on_processor and trainer.precision == "bf16-mixed" and not fast_bfloat16(torch.device("cpu")):
            _log.warning("bfloat16 is slower than float32 on this processor: precision 32-true in place of it")
            trainer.precision = "32-true"

    def instantiate_classes(self) -> None:
        """Make model, data and trainer, and hand the renderer in to the data."""
        super().instantiate_classes()
        self.datamodule.renderer = render

    def _parse_ckpt_path(self) -> None:
        """Overrides Lightning, which would let a checkpoint's hyper-parameters beat the given configuration."""

    def fit(self, ckpt_path: str | None, **_: object) -> None:
        """Train, then write the best averaged weights and their card into the run's folder.

        A model that has nothing to train, such as an ensemble, is calibrated and written.

        Args:
            ckpt_path: Checkpoint to resume, or weights to start from.
        """
        self._load(ckpt_path)
        if any(parameter.requires_grad for parameter in self.model.parameters()):
            resumed = ckpt_path if ckpt_path and _is_checkpoint(ckpt_path) else None
            self.trainer.fit(self.model, datamodule=self.datamodule, ckpt_path=resumed, weights_only=True)
        if self._get(self.config, "trainer").fast_dev_run:
            return
        best = self.trainer.checkpoint_callback
        if isinstance(best, ModelCheckpoint) and best.best_model_path:
            self._load(best.best_model_path)
        self._calibrate()
        metrics = self.trainer.validate(self.model, datamodule=self.datamodule, verbose=False)[0]
        card = {
            "data": self.datamodule.describe(),
            "grasps_seen": self.trainer.global_step * self.trainer.accumulate_grad_batches * self.datamodule.batch_size,
            "metrics": {name: round(value, 4) for name, value in metrics.items()},
            "config": self._settings(),
            "seed": self._get(self.config, "seed_everything"),
            "command": self.command,
        }
        folder = self.trainer.log_dir or "."  # asks all processes
        if self.trainer.is_global_zero:
            path = self.model.save(folder, card=card)
            self._report({"weights": str(path), "metrics": card["metrics"]})

    def validate(self, ckpt_path: str | None, **_: object) -> None:
        """Metrics over the validation split.

        Args:
            ckpt_path: Weights.
        """
        self._load(ckpt_path)
        self._report(dict(self.trainer.validate(self.model, datamodule=self.datamodule, verbose=False)[0]))

    def test(self, ckpt_path: str | None, **_: object) -> None:
        """Metrics over the test split.

        Args:
            ckpt_path: Weights.
        """
        self._load(ckpt_path)
        self._report(dict(self.trainer.test(self.model, datamodule=self.datamodule, verbose=False)[0]))

    def predict(self, ckpt_path: str | None, **_: object) -> None:
        """Write probabilities of one split, in the order of the set, to predictions.json in the run.

        Args:
            ckpt_path: Weights.

        Raises:
            ValueError: There are several processes.
        """
        processes = self.trainer.world_size
        if processes > 1:  # each would write its own share of the grasps to the one file
            raise ValueError(f"one process does it, not {processes}; give --trainer.devices 1 --trainer.num_nodes 1")
        self._load(ckpt_path)
        batches = self.trainer.predict(self.model, datamodule=self.datamodule) or []
        path = Path(self.trainer.log_dir or ".") / "predictions.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        probabilities = torch.cat([torch.as_tensor(batch) for batch in batches]).tolist()
        path.write_text(json.dumps({"split": self.datamodule.predict_split, "probability": probabilities}) + "\n")
        self._report({"predictions": str(path)})

    def _load(self, ckpt_path: str | None) -> None:
        """Put the weights that --ckpt_path names into the model."""
        if ckpt_path is None:
            return
        if _is_checkpoint(ckpt_path):
            load_weights(self.model, read_checkpoint(ckpt_path), ckpt_path)
            return
        loaded = load(ckpt_path)
        arguments = loaded.arguments if type(loaded) is type(self.model) else None
        load_weights(self.model, loaded.state_dict(), ckpt_path, arguments)

    @torch.no_grad()
    def _calibrate(self) -> None:
        """Fit the probabilities to the validation split; where that has one outcome only they stay, with a warning."""
        self.model.eval()
        dataset = self.datamodule.dataset("validation", self.model)
        if not 0 < dataset.success.sum() < len(dataset):
            _log.warning("the validation split has one outcome only; probabilities stay uncalibrated")
            return
        rows = torch.arange(len(dataset)).split(self.datamodule.batch_size)  # all of them in each process
        logit = torch.cat([self.model.batch_logit(dataset[part.tolist()]) for part in rows])
        self.model.calibrate(logit, dataset.success)

    def _settings(self) -> dict[str, Any]:
        """Settings of the run for the card, besides the model's arguments: those of data and trainer."""
        asked = yaml.safe_load(self._parser("fit").dump(self.config["fit"], skip_default=True))
        trainer = {name: value for name, value in asked["trainer"].items() if name not in ("logger", "callbacks")}
        data = {name: getattr(self.datamodule, name) for name in DATA_SETTINGS}
        return {"data": data, "trainer": trainer}

    def _report(self, results: dict[str, Any]) -> None:
        """Write results to standard output, once however many processes there are."""
        if not self.trainer.is_global_zero:
            return
        if self._get(self.config, "json"):
            sys.stdout.write(json.dumps(results) + "\n")
            return
        for name, value in (results.pop("metrics", {}) | results).items():
            sys.stdout.write(f"{name:30} {value:.4f}\n" if isinstance(value, float) else f"{name:30} {value}\n")


def _is_checkpoint(path: str | Path) -> bool:
    return Path(path).suffix == ".ckpt"


def read_checkpoint(path: str | Path) -> dict[str, torch.Tensor]:
    """The averaged weights of one of Lightning's checkpoints; only plain tensors are ever read.

    Args:
        path: The checkpoint.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file is damaged, or holds more than tensors and plain values.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"checkpoint {path} does not exist")
    try:
        weights: dict[str, torch.Tensor] = torch.load(path, map_location="cpu", weights_only=True)["state_dict"]
    except (pickle.UnpicklingError, RuntimeError, EOFError, KeyError, TypeError, ValueError) as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise ValueError(f"checkpoint {path} is not what fit writes, refused: {reason[:99]}") from None
    return weights


def _with_configs(args: list[str]) -> list[str]:
    """The arguments, with bare names of configurations looked up in configs/."""
    out: list[str] = []
    for arg in args:
        name, equals, value = arg.partition("=")
        if name in CONFIG_OPTIONS and equals:
            out += [name, _config(value)]
        elif out and out[-1] in CONFIG_OPTIONS:
            out.append(_config(arg))
        else:
            out.append(arg)
    return out


def _config(name: str) -> str:
    path = Path(name)
    if path.is_file():
        return name
    shipped = resource("configs") / name
    if path.name == name and shipped.is_file():
        return str(shipped)
    known = ", ".join(sorted(file.name for file in resource("configs").glob("*.yaml")))
    raise FileNotFoundError(f"configuration {name} does not exist, here or among those shipped: {known}")


def main(args: list[str]) -> None:
    """Run `fit`, `validate`, `test` or `predict` as on the command line.

    Args:
        args: Arguments, the subcommand first.

    Raises:
        FileNotFoundError: A file does not exist.
        ValueError: The call is wrong.
        SystemExit: After --help, with status 0.
    """
    asked = {arg.partition("=")[0] for arg in args}
    if not asked & {"-h", "--help"}:
        if not args or args[0] not in SUBCOMMANDS:
            raise ValueError(f"give one of {', '.join(SUBCOMMANDS)}, got {args[0] if args else 'nothing'}")
        if not asked & {*CONFIG_OPTIONS, "--model"}:
            raise ValueError(f"{args[0]} needs a configuration that says what the model is; add --config em2.yaml")
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    for message in NOT_NEWS:
        warnings.filterwarnings("ignore", message)
    try:
        CommandLine(_with_configs(args), shlex.join(["python", "-m", "dexzoo", *args]))
    except (ArgumentError, argparse.ArgumentError, ValueError) as error:
        raise ValueError(f"{args[0]}: {_reason(error)}") from None


def _reason(error: Exception) -> str:
    """The one line that matters of an error; jsonargparse lists, each after a dash, why no type of several fits."""
    if "`tensorboard`" in str(error):  # Lightning's three lines name two packages
        return "TensorBoardLogger needs tensorboard; install it with `pip install dexzoo[tensorboard]`"
    whole, *reasons = [" ".join(part.split()) for part in re.split(r"\n\s*- ", str(error))]
    reasons = [reason for reason in reasons if "NoneType" not in reason]
    return (reasons[0] if reasons else whole)[:400]

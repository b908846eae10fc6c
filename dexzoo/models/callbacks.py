"""Callbacks that every evaluator brings to its training: averaged weights, and runs that resume as if never stopped."""

from __future__ import annotations

from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint, WeightAveraging
from torch import Tensor


class MovingAverage(WeightAveraging):
    """Keeps an exponential moving average of the weights and validates, selects and saves with it.

    The decay is min(decay, (1 + n) / (10 + n)) after n steps, so that a short run is not left with its random start
    (the rule of TensorFlow's ExponentialMovingAverage). Lightning's checkpoints then hold the average as `state_dict`,
    and the raw weights for resuming. Buffers are copied, not averaged.

    Args:
        decay: Share of the old average that a step keeps.

    Raises:
        ValueError: The decay is not in [0, 1).
    """

    def __init__(self, decay: float = 0.999) -> None:
        if not 0 <= decay < 1:
            raise ValueError(f"average_decay is {decay}, expected at least 0 and below 1")
        super().__init__(use_buffers=False, multi_avg_fn=self._average)
        self.decay = decay

    @torch.no_grad()
    def _average(self, averages: list[Tensor], weights: list[Tensor], num_averaged: Tensor | int) -> None:
        steps = float(num_averaged)
        decay = min(self.decay, (1 + steps) / (10 + steps))
        torch._foreach_lerp_(averages, weights, 1 - decay)

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Let go of the average once fitting is over; otherwise a later validation would swap it in again.

        Args:
            trainer: The trainer.
            pl_module: The evaluator.
            stage: Stage that has ended.
        """
        if stage == "fit":
            self._average_model = None


class Resuming(Callback):
    """Makes a resumed run go on as it would have without the stop, with the settings that are configured now.

    Checkpoints keep the random state, so that dropout continues. The best score so far is kept although a resumed run
    has a folder of its own. Early stopping's patience and, unless a schedule moves them, the optimizer's rates stay as
    configured.
    """

    def __init__(self) -> None:
        self._random_state: Tensor | None = None

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Keep the random state.

        Args:
            trainer: The trainer.
            pl_module: The evaluator.
            checkpoint: Content of the file.
        """
        checkpoint["random_state"] = torch.get_rng_state()

    def on_load_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Take up the random state at the next step, and mend the state that other callbacks would load.

        Args:
            trainer: The trainer.
            pl_module: The evaluator.
            checkpoint: Content of the file.
        """
        self._random_state = checkpoint["random_state"]
        for callback in trainer.checkpoint_callbacks:
            state = checkpoint["callbacks"].get(callback.state_key)
            if isinstance(callback, ModelCheckpoint) and state is not None:
                state["dirpath"] = callback.dirpath  # with another one Lightning forgets the best score
        for stopping in trainer.early_stopping_callbacks:
            checkpoint["callbacks"].get(stopping.state_key, {})["patience"] = stopping.patience
        if not checkpoint["lr_schedulers"]:
            rates = {"lr": pl_module.learning_rate, "weight_decay": pl_module.weight_decay}
            for group in (group for state in checkpoint["optimizer_states"] for group in state["param_groups"]):
                group |= rates

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:  # noqa: ANN401, Lightning's own
        """Set the random state that a checkpoint kept; making loaders may have drawn meanwhile.

        Args:
            trainer: The trainer.
            pl_module: The evaluator.
            batch: Not used.
            batch_idx: Not used.
        """
        if self._random_state is not None:
            torch.set_rng_state(self._random_state.cpu())
            self._random_state = None

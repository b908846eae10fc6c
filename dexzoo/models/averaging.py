"""The exponential moving average of the weights."""

from __future__ import annotations

import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import WeightAveraging
from torch import Tensor


class MovingAverage(WeightAveraging):
    """Keeps an exponential moving average of the weights and validates, selects and saves with it.

    decay: share of the old average that a step keeps; in the first steps min(decay, (1 + n) / (10 + n)) after n steps,
    so that a short run is not left with its random start (the rule of TensorFlow's ExponentialMovingAverage).
    Lightning's checkpoints then hold the average as `state_dict`, and the raw weights for resuming. Buffers are
    copied, not averaged.
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
        """Let go of the average once fitting is over; otherwise a later validation would swap it in again."""
        if stage == "fit":
            self._average_model = None

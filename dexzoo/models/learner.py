"""The training side of evaluators, by Lightning: loss, metrics, optimizer, averaged weights."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from lightning.pytorch import Callback, LightningModule
from lightning.pytorch.trainer.states import TrainerFn
from torch import Tensor
from torch.nn import functional as F
from torchmetrics import MetricCollection
from torchmetrics.classification import BinaryAccuracy, BinaryAUROC, BinaryAveragePrecision

from dexzoo.metrics import TopKSuccess
from dexzoo.models.batch import Batch
from dexzoo.models.callbacks import MovingAverage, Resuming

OPTIMIZERS = ("sgd", "adamw")


class Learner(LightningModule):
    """A module that learns log-odds of success from batches; `GraspEvaluator` says how it gives them.

    Args:
        optimizer: "sgd" or "adamw".
        learning_rate: Step size of the optimizer.
        weight_decay: Weight decay of the optimizer.
        average_decay: Decay of the moving average of the weights.

    Raises:
        ValueError: The optimizer is unknown.
    """

    def __init__(self, optimizer: str, learning_rate: float, weight_decay: float, average_decay: float) -> None:
        super().__init__()
        if optimizer not in OPTIMIZERS:
            raise ValueError(f"optimizer {optimizer!r} is unknown; use one of {', '.join(OPTIMIZERS)}")
        self.optimizer, self.learning_rate, self.weight_decay = optimizer, learning_rate, weight_decay
        self.average_decay = average_decay
        metrics = MetricCollection(
            {
                "accuracy": BinaryAccuracy(),
                "auroc": BinaryAUROC(),
                "average_precision": BinaryAveragePrecision(),
                "top1": TopKSuccess(1),
            }
        )
        self.metrics = torch.nn.ModuleDict(
            {stage: metrics.clone(prefix=f"{stage}_") for stage in ("validation", "test")}
        )

    def batch_logit(self, batch: Batch) -> Float[Tensor, " batch"]:
        """Log-odds of success of a batch's grasps.

        Args:
            batch: Grasps and their views.
        """
        raise NotImplementedError

    def probability(self, logit: Tensor) -> Tensor:
        """Probability of success.

        Args:
            logit: Log-odds as `batch_logit` gives them.
        """
        raise NotImplementedError

    def _step(self, batch: Batch, stage: str) -> Tensor:
        """Loss and metrics of one batch.

        The loss is the softmax cross-entropy over {fail, success}. With two outputs l0, l1 it equals the binary
        cross-entropy with logits of the log-odds l1 - l0, which serves architectures with one output as well.
        """
        logit = self.batch_logit(batch)
        loss = F.binary_cross_entropy_with_logits(logit, batch.success)
        size = len(batch.success)
        self.log(f"{stage}_loss", loss, prog_bar=True, on_step=False, on_epoch=True, batch_size=size, sync_dist=True)
        if stage in self.metrics:
            metrics = self.metrics[stage]
            assert isinstance(metrics, MetricCollection)
            metrics.update(preds=self.probability(logit), target=batch.success.long(), indexes=batch.scene_index)
            self.log_dict(metrics, on_step=False, on_epoch=True, batch_size=size)
        return loss

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """The loss of a training batch.

        Args:
            batch: Grasps and their views.
            batch_idx: Not used.
        """
        return self._step(batch, "train")

    def validation_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """The loss of a validation batch.

        Args:
            batch: Grasps and their views.
            batch_idx: Not used.
        """
        return self._step(batch, "validation")

    def test_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """The loss of a test batch.

        Args:
            batch: Grasps and their views.
            batch_idx: Not used.
        """
        return self._step(batch, "test")

    def predict_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Probabilities of success, (batch,).

        Args:
            batch: Grasps and their views.
            batch_idx: Not used.
        """
        return self.probability(self.batch_logit(batch))

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Stochastic gradient descent as in the thesis, or AdamW; in one kernel unless gradients are clipped.

        Lightning refuses to clip for a fused optimizer where precision is mixed.
        """
        weights = [parameter for parameter in self.parameters() if parameter.requires_grad]
        fused = self._trainer is None or not self._trainer.gradient_clip_val
        kind = torch.optim.SGD if self.optimizer == "sgd" else torch.optim.AdamW
        return kind(weights, lr=self.learning_rate, weight_decay=self.weight_decay, fused=fused)

    def configure_callbacks(self) -> Sequence[Callback]:
        """The moving average of the weights, and resuming as if never stopped; while fitting only."""
        fitting = self.trainer.state.fn == TrainerFn.FITTING
        return [MovingAverage(self.average_decay), Resuming()] if fitting else []

"""The one interface of all evaluative models: an image and grasps in, log-odds of success out."""

from __future__ import annotations

import hashlib
import inspect
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TypedDict

import torch
from jaxtyping import Float
from lightning.pytorch import Callback, LightningModule
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.trainer.states import TrainerFn
from safetensors.torch import save_file
from torch import Tensor
from torch.nn import functional as F
from torchmetrics import MetricCollection
from torchmetrics.classification import BinaryAccuracy, BinaryAUROC, BinaryAveragePrecision

from dexzoo.camera import Observation
from dexzoo.grasp import Grasps, transform_waypoints
from dexzoo.metrics import TopKSuccess
from dexzoo.models.averaging import MovingAverage

CARD_FORMAT = "dexzoo.evaluator.1"
OPTIMIZERS = ("sgd", "adamw")
CHUNK = 128
"""Grasps scored at once; bounds memory, and keeps what lies between layers in cache."""

Scene = dict[str, Tensor]
"""What an architecture keeps of its views: tensors whose first dimension is the view."""


class Batch(NamedTuple):
    """Grasps with the view each is paired with.

    views: the views that occur, encoded, or, where the encoder is trained, as images (view, 2, 224, 224); each of them
    is paired with a grasp, and some may occur more than once.
    view: (batch,) which of them each grasp is paired with.
    grasps: (batch, 1, 10, 28) waypoints in the frame of the view's aimed camera.
    success: (batch,) 0 or 1. scene_index: (batch,) which scene of the set.
    """

    views: Scene | Tensor
    view: Tensor
    grasps: Tensor
    success: Tensor
    scene_index: Tensor


class TrainingOptions(TypedDict, total=False):
    """The arguments that every architecture hands on to `GraspEvaluator`."""

    optimizer: str
    learning_rate: float
    weight_decay: float
    average_decay: float


@dataclass(frozen=True)
class PreparedView:
    """One observation, encoded once, ready to score any number of grasps, on any device and of any precision.

    T_aimed_world: (4, 4), world frame to the frame of the aimed camera.
    """

    evaluator: GraspEvaluator
    scene: Scene
    T_aimed_world: Float[Tensor, "4 4"]

    def logit(self, waypoints: Float[Tensor, "grasp 10 28"]) -> Float[Tensor, " grasp"]:
        """Log-odds of success of grasps in the world frame; differentiable."""
        with self.evaluator.without_dropout():
            return self.evaluator.logit(self.scene, self._aimed(waypoints))[0].to(waypoints.device)

    def logit_and_spread(
        self, waypoints: Float[Tensor, "grasp 10 28"]
    ) -> tuple[Float[Tensor, " grasp"], Float[Tensor, " grasp"]]:
        """Log-odds of grasps in the world frame and their spread among members; both differentiable."""
        with self.evaluator.without_dropout():
            logit, spread = self.evaluator.logit_and_spread(self.scene, self._aimed(waypoints))
        return logit[0].to(waypoints.device), spread[0].to(waypoints.device)

    def _aimed(self, waypoints: Tensor) -> Tensor:
        waypoints = waypoints.to(self.T_aimed_world.device, self.evaluator.temperature.dtype)
        return transform_waypoints(self.T_aimed_world.to(waypoints), waypoints)[None]


class GraspEvaluator(LightningModule):
    """Base of all evaluative models. An architecture adds its constructor, `encode` and `logit`.

    Arguments of constructors are plain str, int, float, bool or list, and kept in attributes of the same name.

    optimizer: "sgd" or "adamw". learning_rate, weight_decay: its settings.
    average_decay: decay of the moving average of the weights, which is what is validated and saved.
    """

    architecture: ClassVar[str]
    temperature: Tensor
    offset: Tensor
    sha256: str | None = None
    num_bytes: int | None = None
    """Both of the file that `dexzoo.load` read; None for a model that was made otherwise."""
    frozen_encoder: ClassVar[bool] = False
    """Whether `encode` has nothing to train, so that its result can be kept for the next epoch and on disk."""

    def __init__(
        self,
        optimizer: str = "sgd",
        learning_rate: float = 0.001,
        weight_decay: float = 0.0,
        average_decay: float = 0.999,
    ) -> None:
        super().__init__()
        if optimizer not in OPTIMIZERS:
            raise ValueError(f"optimizer {optimizer!r} is unknown; use one of {', '.join(OPTIMIZERS)}")
        self.optimizer, self.learning_rate, self.weight_decay = optimizer, learning_rate, weight_decay
        self.average_decay = average_decay
        self.register_buffer("temperature", torch.ones(()))
        self.register_buffer("offset", torch.zeros(()))
        self._random_state: Tensor | None = None
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

    def encode(self, images: Float[Tensor, "view 2 224 224"]) -> Scene:
        """What is kept of each view.

        images: `Observation.aimed().image()`, the object's depth and height over the table in metres, 0 elsewhere.
        """
        raise NotImplementedError

    def logit(self, scene: Scene, grasps: Float[Tensor, "view grasp 10 28"]) -> Float[Tensor, "view grasp"]:
        """Log-odds of success, differentiable in the grasps, which are in the frame of the view's aimed camera.

        Each grasp for itself: what is handed in together differs from call to call.
        """
        raise NotImplementedError

    def logit_and_spread(
        self, scene: Scene, grasps: Float[Tensor, "view grasp 10 28"]
    ) -> tuple[Float[Tensor, "view grasp"], Float[Tensor, "view grasp"]]:
        """Log-odds, and their standard deviation among the members of an ensemble; 0 for a model alone."""
        logit = self.logit(scene, grasps)
        return logit, torch.zeros_like(logit)

    def fit_statistics(self, images: Float[Tensor, "view 2 224 224"], waypoints: Float[Tensor, "grasp 10 28"]) -> None:
        """Set what is standardised by the training data; called once, before training. Nothing by default."""

    @property
    def parts(self) -> tuple[GraspEvaluator, ...]:
        """All evaluators that take part, each with a file of its own: this one, and an ensemble's members."""
        return (self,)

    @property
    def arguments(self) -> dict[str, Any]:
        """The constructor's arguments, from which the same architecture can be made again."""
        classes = [cls for cls in type(self).__mro__ if issubclass(cls, GraspEvaluator) and "__init__" in cls.__dict__]
        kinds = (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
        return {
            name: getattr(self, name)
            for cls in classes
            for name, parameter in inspect.signature(cls.__init__).parameters.items()
            if name != "self" and parameter.kind not in kinds
        }

    # scoring

    def probability(self, logit: Tensor) -> Tensor:
        """Probability of success of log-odds as `logit` gives them: sigmoid(logit / temperature + offset)."""
        return torch.sigmoid(logit / self.temperature.to(logit.device) + self.offset.to(logit.device))

    def calibrate(self, logit: Float[Tensor, " grasp"], success: Float[Tensor, " grasp"]) -> None:
        """Fit temperature and offset by the likelihood of grasps that were not trained on.

        The temperature takes back overconfidence (Guo et al. 2017); the offset brings log-odds that were learned on as
        many successes as failures to the grasps' own rate (Platt 1999). Ranks do not change, nor does `logit`.
        Raises ValueError unless there are both successes and failures.
        """
        if not 0 < success.sum() < len(success):
            raise ValueError("calibration needs grasps that hold and grasps that fail")
        logit, success = logit.detach().double(), success.double()
        slope_and_offset = torch.tensor([0.0, 0.0], dtype=torch.float64, requires_grad=True)
        optimiser = torch.optim.LBFGS([slope_and_offset], max_iter=100, line_search_fn="strong_wolfe")

        def loss() -> Tensor:
            optimiser.zero_grad()
            log_slope, offset = slope_and_offset  # the temperature stays positive: the order is not turned
            value = F.binary_cross_entropy_with_logits(logit * log_slope.exp() + offset, success)
            value.backward()
            return value

        with torch.enable_grad():
            optimiser.step(loss)
        self.temperature.fill_((-slope_and_offset[0]).exp().item())
        self.offset.fill_(slope_and_offset[1].item())

    def prepare(self, observation: Observation) -> PreparedView:
        """Encode an observation once. Any observation will do: it is aimed at the object first."""
        aimed = observation.aimed()
        with torch.no_grad(), self.without_dropout():
            scene = self.encode(aimed.image()[None].to(self.device))
        T_aimed_world = torch.linalg.inv(torch.from_numpy(aimed.T_world_camera))
        return PreparedView(self, scene, T_aimed_world.to(self.device))

    @torch.no_grad()
    def score(self, observation: Observation, grasps: Grasps) -> Float[Tensor, " grasp"]:
        """Probability of success of each grasp, (num_grasps,), on the evaluator's device.

        observation: any view of the object; grasps: in the world frame or in that of the observation's camera.
        Dropout is off whatever the module's mode.
        """
        prepared = self.prepare(observation)
        world = grasps.to_frame("world", observation.T_world_camera).waypoints.to(self.device)
        logits = [prepared.logit(part) for part in world.split(CHUNK)] if len(world) else [world.new_zeros(0)]
        return self.probability(torch.cat(logits))

    @contextmanager
    def without_dropout(self) -> Iterator[None]:
        """Have the module in evaluation mode for a while, and then each part of it in its own mode again."""
        training = [part for part in self.modules() if part.training]
        for part in training:
            part.training = False
        try:
            yield
        finally:
            for part in training:
                part.training = True

    # training

    def batch_logit(self, batch: Batch) -> Float[Tensor, " batch"]:
        """Log-odds of success of a batch's grasps; each view is encoded once, and looked at by its grasps together."""
        views = self.encode(batch.views) if isinstance(batch.views, Tensor) else batch.views
        counts = torch.bincount(batch.view)
        order = batch.view.argsort(stable=True)
        count_of_row = counts[batch.view[order]]
        parts, logits = [], []
        for count in counts.unique():  # views with as many grasps go at once
            rows = order[count_of_row == count].view(-1, int(count))
            scene = {name: value[counts == count] for name, value in views.items()}
            parts.append(rows.flatten())
            logits.append(self.logit(scene, batch.grasps[rows, 0]).flatten())
        return torch.cat(logits)[torch.cat(parts).argsort()].float()

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
        """The loss of a training batch."""
        return self._step(batch, "train")

    def validation_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """The loss of a validation batch."""
        return self._step(batch, "validation")

    def test_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """The loss of a test batch."""
        return self._step(batch, "test")

    def predict_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Probabilities of success, (batch,)."""
        return self.probability(self.batch_logit(batch))

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Stochastic gradient descent as in the thesis, or AdamW; in one kernel unless gradients are clipped.

        Lightning refuses to clip for a fused optimiser where precision is mixed.
        """
        weights = [parameter for parameter in self.parameters() if parameter.requires_grad]
        fused = self._trainer is None or not self._trainer.gradient_clip_val
        kind = torch.optim.SGD if self.optimizer == "sgd" else torch.optim.AdamW
        return kind(weights, lr=self.learning_rate, weight_decay=self.weight_decay, fused=fused)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep the random state, so that dropout goes on after a kill as it would have without."""
        checkpoint["random_state"] = torch.get_rng_state()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take up the random state at the next step, and the best so far, though a resumed run has its own folder.

        Settings stay as configured: early stopping's patience and, unless a schedule moves them, the optimiser's.
        """
        self._random_state = checkpoint["random_state"]
        for callback in self.trainer.checkpoint_callbacks:
            state = checkpoint["callbacks"].get(callback.state_key)
            if isinstance(callback, ModelCheckpoint) and state is not None:
                state["dirpath"] = callback.dirpath  # with another one Lightning forgets the best score
        for stopping in self.trainer.early_stopping_callbacks:
            checkpoint["callbacks"].get(stopping.state_key, {})["patience"] = stopping.patience
        if not checkpoint["lr_schedulers"]:
            for group in (group for state in checkpoint["optimizer_states"] for group in state["param_groups"]):
                group |= {"lr": self.learning_rate, "weight_decay": self.weight_decay}

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        """Set the random state that a checkpoint kept; what came between, such as making loaders, may have drawn."""
        if self._random_state is not None:
            torch.set_rng_state(self._random_state.cpu())
            self._random_state = None

    def configure_callbacks(self) -> list[Callback]:
        """The moving average, while fitting."""
        return [MovingAverage(self.average_decay)] if self.trainer.state.fn == TrainerFn.FITTING else []

    # files

    @property
    def digest(self) -> str:
        """SHA-256 of the weights and statistics, by which an evaluator is told from another training of it."""
        values = (value.cpu().contiguous().flatten().view(torch.uint8) for value in self.state_dict().values())
        return hashlib.sha256(b"".join(value.numpy().tobytes() for value in values)).hexdigest()

    def save(self, path: str | Path, *, half: bool = True, card: Mapping[str, Any] | None = None) -> Path:
        """Write weights and card; returns the path of the weights.

        path: a folder, for NAME.safetensors and NAME.json with NAME the architecture's, or the .safetensors itself.
        half: store the weights in float16; the statistics stay float32. The shared trunk is not stored.
        card: what else the card shall say, such as data, metrics, seed and command.
        """
        path = Path(path)
        if path.suffix != ".safetensors":
            path = path / f"{self.architecture}.safetensors"
        path.parent.mkdir(parents=True, exist_ok=True)
        trained = {name for name, _ in self.named_parameters()}
        tensors = {
            name: (value.half() if half and name in trained else value).detach().cpu().contiguous()
            for name, value in self.state_dict().items()
        }
        temporary = path.with_name(f".{path.name}.partial")
        save_file(tensors, temporary)
        temporary.chmod(0o644)
        temporary.rename(path)
        content = {
            "format": CARD_FORMAT,
            "architecture": self.architecture,
            "arguments": self.arguments,
            "precision": "float16" if half else "float32",
            **(card or {}),
            "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        }
        path.with_suffix(".json").write_text(json.dumps(content, indent=2) + "\n")
        return path

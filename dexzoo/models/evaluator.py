"""The one interface of all evaluative models: an image and grasps in, log-odds of success out."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, TypedDict

import torch
from jaxtyping import Float
from torch import Tensor

from dexzoo.grasp import Grasps, Trajectory
from dexzoo.hand import Hand
from dexzoo.models.batch import Batch, Encoding
from dexzoo.models.calibration import fit_calibration
from dexzoo.models.files import save_evaluator
from dexzoo.models.learner import Learner
from dexzoo.perception import Observation, View

CHUNK = 128
"""Grasps scored at once; bounds memory, and keeps activations in cache."""


class EvaluatorOptions(TypedDict, total=False):
    """The arguments that every architecture hands on to `GraspEvaluator`."""

    hands: list[str] | None
    optimizer: str
    learning_rate: float
    weight_decay: float
    average_decay: float


@dataclass(frozen=True, eq=False)
class EncodedView:
    """One view, encoded once by an evaluator, ready to score any number of grasps on any device.

    Attributes:
        evaluator: The evaluator.
        encoding: Its encoding of the view.
        T_aimed_world: World frame to the frame of the aimed camera, (4, 4).
    """

    evaluator: GraspEvaluator
    encoding: Encoding
    T_aimed_world: Float[Tensor, "4 4"]

    def logit(self, grasps: Trajectory) -> Float[Tensor, " grasp"]:
        """Log-odds of success; differentiable.

        Args:
            grasps: Grasps in the world frame, on any device.

        Returns:
            Log-odds, on the device of the grasps.
        """
        with self.evaluator.without_dropout():
            return self.evaluator.logit(self.encoding, self._aimed(grasps))[0].to(grasps.wrist.device)

    def logit_and_spread(self, grasps: Trajectory) -> tuple[Float[Tensor, " grasp"], Float[Tensor, " grasp"]]:
        """Log-odds of success and their spread among the members of an ensemble; both differentiable.

        Args:
            grasps: Grasps in the world frame, on any device.

        Returns:
            Log-odds and spread, on the device of the grasps.
        """
        with self.evaluator.without_dropout():
            logit, spread = self.evaluator.logit_and_spread(self.encoding, self._aimed(grasps))
        return logit[0].to(grasps.wrist.device), spread[0].to(grasps.wrist.device)

    def _aimed(self, grasps: Trajectory) -> Trajectory:
        """(view, grasp) trajectories as `GraspEvaluator.logit` takes them."""
        grasps = grasps.to(self.T_aimed_world.device, self.evaluator.temperature.dtype)
        aimed = grasps.transformed(self.T_aimed_world)
        return Trajectory(aimed.wrist[None], aimed.joints[None], aimed.grasp_type[None])


class GraspEvaluator(Learner):
    """Base of all evaluative models. An architecture adds its constructor, `encode` and `logit`.

    Arguments of constructors are plain str, int, float, bool or list, and kept in attributes of the same name.

    Args:
        hands: Names in robots/ of the hands that the model knows; dlr2 alone if not given.
        optimizer: "sgd" or "adamw".
        learning_rate: Step size of the optimizer.
        weight_decay: Weight decay of the optimizer.
        average_decay: Decay of the moving average of the weights; the average is validated and saved.

    Attributes:
        architecture: Name of the architecture in cards.
        frozen_encoder: Whether `encode` has nothing to train, so that its result can be kept for later epochs.
        sha256: Checksum of the file that `dexzoo.load` read; None for a model that was made otherwise.
        num_bytes: Size of that file.
    """

    architecture: ClassVar[str]
    frozen_encoder: ClassVar[bool] = False
    temperature: Tensor
    offset: Tensor
    sha256: str | None = None
    num_bytes: int | None = None

    def __init__(
        self,
        hands: list[str] | None = None,
        optimizer: str = "sgd",
        learning_rate: float = 0.001,
        weight_decay: float = 0.0,
        average_decay: float = 0.999,
    ) -> None:
        super().__init__(optimizer, learning_rate, weight_decay, average_decay)
        self.hands = ["dlr2"] if hands is None else hands
        if not self.hands:
            raise ValueError("hands is empty; name at least one hand of robots/")
        with torch.device("cpu"):  # a hand's tables are read, also where a model is made on "meta" for its sizes alone
            self.known_hands = [Hand.load(name) for name in self.hands]
        self.register_buffer("temperature", torch.ones(()))
        self.register_buffer("offset", torch.zeros(()))

    def encode(self, images: Float[Tensor, "view 2 224 224"]) -> Encoding:
        """Encode views.

        Args:
            images: Images of `Observation.aimed().image()`: the object's depth and its height over the table in meters,
                0 elsewhere.

        Returns:
            Tensors with the view as first dimension.
        """
        raise NotImplementedError

    def logit(self, encoding: Encoding, grasps: Trajectory) -> Float[Tensor, "view grasp"]:
        """Log-odds of success, differentiable in the grasps.

        Each grasp is scored by itself: which others are handed in with it makes no difference.

        Args:
            encoding: Result of `encode` for some views.
            grasps: Trajectories (view, grasp), in the frame of each view's aimed camera.

        Returns:
            Log-odds.
        """
        raise NotImplementedError

    def logit_and_spread(
        self, encoding: Encoding, grasps: Trajectory
    ) -> tuple[Float[Tensor, "view grasp"], Float[Tensor, "view grasp"]]:
        """Log-odds, and their standard deviation among the members of an ensemble.

        Args:
            encoding: As in `logit`.
            grasps: As in `logit`.

        Returns:
            Log-odds and spread; the spread of a single model is 0.
        """
        logit = self.logit(encoding, grasps)
        return logit, torch.zeros_like(logit)

    def fit_statistics(self, images: Float[Tensor, "view 2 224 224"], grasps: Trajectory) -> None:
        """Set the standardization by the training data; called once, before training. Nothing by default.

        Args:
            images: Training views, as in `encode`.
            grasps: Training grasps, (grasp,), each in the frame of its view's aimed camera.
        """

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

    def knows(self, hand: Hand) -> bool:
        """Whether the model knows a hand.

        Args:
            hand: The hand.
        """
        return hand in self.known_hands

    def check_hand(self, hand: Hand) -> None:
        """Refuse a hand that the model does not know.

        Args:
            hand: The hand of some grasps.

        Raises:
            ValueError: The model knows other hands only.
        """
        if not self.knows(hand):
            raise ValueError(
                f"evaluator {self.architecture} knows the hand {', '.join(self.hands)} (right), "
                f"not {hand.spec.name} ({hand.spec.side})"
            )

    def probability(self, logit: Tensor) -> Tensor:
        """Probability of success.

        Args:
            logit: Log-odds as `logit` gives them.

        Returns:
            sigmoid(logit / temperature + offset).
        """
        return torch.sigmoid(logit / self.temperature.to(logit.device) + self.offset.to(logit.device))

    def calibrate(self, logit: Float[Tensor, " grasp"], success: Float[Tensor, " grasp"]) -> None:
        """Fit the calibration of probabilities; `logit` itself and ranks do not change.

        Args:
            logit: Log-odds of grasps that were not trained on.
            success: Their outcomes, 0 or 1.

        Raises:
            ValueError: The grasps have one outcome only.
        """
        temperature, offset = fit_calibration(logit, success)
        self.temperature.fill_(temperature)
        self.offset.fill_(offset)

    def prepare(self, observation: Observation | View) -> EncodedView:
        """Encode an observation, which is aimed at the object first; once for each view.

        Args:
            observation: Any view of the object.

        Returns:
            The encoded view.
        """
        view = View.of(observation)

        def encode() -> EncodedView:
            with torch.no_grad(), self.without_dropout():
                encoding = self.encode(view.aimed.image()[None].to(self.device))
            T_aimed_world = torch.linalg.inv(torch.from_numpy(view.aimed.T_world_camera))
            return EncodedView(self, encoding, T_aimed_world.to(self.device))

        return view.once(("encoding", self, self.device, self.temperature.dtype), encode)

    @torch.no_grad()
    def score(
        self, grasps: Grasps | Observation | View, observation: Observation | View | Grasps
    ) -> Float[Tensor, " grasp"]:
        """Probability of success of each grasp. Dropout is off whatever the module's mode.

        Args:
            grasps: Grasps in the world frame of the observation.
            observation: Any view of the object. The two arguments may also come in the other order.

        Returns:
            Probabilities, on the evaluator's device.

        Raises:
            ValueError: The grasps are of a hand that the model does not know.
        """
        if isinstance(observation, Grasps):
            grasps, observation = observation, grasps
        if not isinstance(grasps, Grasps) or isinstance(observation, Grasps):
            raise ValueError("score takes grasps and an observation")
        self.check_hand(grasps.hand)
        if not len(grasps):
            return torch.zeros(0, device=self.device)
        encoded = self.prepare(observation)
        logits = [encoded.logit(part) for part in grasps.trajectory.to(self.device).split(CHUNK)]
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

    def batch_logit(self, batch: Batch) -> Float[Tensor, " batch"]:
        """Log-odds of success of a batch's grasps; each view is encoded once, and its grasps are scored together.

        Args:
            batch: Grasps and their views.
        """
        views = self.encode(batch.views) if isinstance(batch.views, Tensor) else batch.views
        counts = torch.bincount(batch.view)
        order = batch.view.argsort(stable=True)
        count_of_row = counts[batch.view[order]]
        parts, logits = [], []
        for count in counts.unique():  # views with as many grasps go at once
            rows = order[count_of_row == count].view(-1, int(count))
            encoding = {name: value[counts == count] for name, value in views.items()}
            parts.append(rows.flatten())
            logits.append(self.logit(encoding, batch.grasps[rows]).flatten())
        return torch.cat(logits)[torch.cat(parts).argsort()].float()

    # files

    @property
    def digest(self) -> str:
        """SHA-256 of the weights and statistics, which differs between trainings of one architecture."""
        values = (value.cpu().contiguous().flatten().view(torch.uint8) for value in self.state_dict().values())
        return hashlib.sha256(b"".join(value.numpy().tobytes() for value in values)).hexdigest()

    def save(self, path: str | Path, *, half: bool = True, card: Mapping[str, Any] | None = None) -> Path:
        """Write weights and card; `dexzoo.load` reads them.

        Args:
            path: A folder, for NAME.safetensors and NAME.json named by the architecture, or the .safetensors file.
            half: Whether weights are stored in float16; statistics stay float32.
            card: Further entries of the card, such as data, metrics, seed and command.

        Returns:
            Path of the weights.
        """
        return save_evaluator(self, path, half=half, card=card)

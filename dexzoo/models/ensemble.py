"""Several evaluators as one: the mean of their log-odds, and how far they are apart."""

from __future__ import annotations

import hashlib
from typing import ClassVar, Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from dexzoo.grasp import Trajectory
from dexzoo.hand import Hand
from dexzoo.models.batch import Encoding
from dexzoo.models.evaluator import EvaluatorOptions, GraspEvaluator
from dexzoo.models.zoo import load


class Ensemble(GraspEvaluator):
    """Members that were trained one by one; nothing of its own but the calibration, which `dexzoo fit` sets.

    Members are loaded, not copied: a saved ensemble holds their names and its own calibration, and needs them where
    they were.

    Args:
        members: Names of models, files or folders, as `dexzoo.load` takes them; em_fk alone if none are given.
        options: Arguments of `GraspEvaluator`.

    Raises:
        ValueError: There is no member.

    >>> Ensemble(members=["em_fk", "runs/em_fk/version_0"]).save("runs/ensemble")  # doctest: +SKIP
    """

    architecture: ClassVar[str] = "ensemble"

    def __init__(self, members: list[str] | None = None, **options: Unpack[EvaluatorOptions]) -> None:
        super().__init__(**options)
        self.members = ["em_fk"] if members is None else members
        if not self.members:
            raise ValueError("an ensemble needs at least one member")
        # in a tuple, out of the way of state_dict, since each has its own file; they follow the device of their input
        self._loaded = tuple(load(member).requires_grad_(False) for member in self.members)

    @property
    def parts(self) -> tuple[GraspEvaluator, ...]:
        """Itself and its members; those of a member that is an ensemble too."""
        return (self, *(part for member in self._loaded for part in member.parts))

    def knows(self, hand: Hand) -> bool:
        """Whether all members know a hand.

        Args:
            hand: The hand.
        """
        return all(member.knows(hand) for member in self._loaded)

    @property
    def digest(self) -> str:
        """SHA-256 of its own calibration and the members' weights."""
        every = [super().digest, *(member.digest for member in self._loaded)]
        return hashlib.sha256("".join(every).encode()).hexdigest()

    def encode(self, images: Float[Tensor, "view 2 224 224"]) -> Encoding:
        """The encodings of all members, under their numbers.

        Args:
            images: Depth and height over the table in meters, 0 where the object is not; see `GraspEvaluator.encode`.
        """
        encodings = [member.to(images).encode(images) for member in self._loaded]
        return {f"{i}.{name}": value for i, encoding in enumerate(encodings) for name, value in encoding.items()}

    def logit(self, encoding: Encoding, grasps: Trajectory) -> Float[Tensor, "view grasp"]:
        """Mean of the members' log-odds of success, each with its own calibration.

        Args:
            encoding: Result of `encode`.
            grasps: Trajectories (view, grasp), in the frame of each view's aimed camera.
        """
        return self.logit_and_spread(encoding, grasps)[0]

    def logit_and_spread(
        self, encoding: Encoding, grasps: Trajectory
    ) -> tuple[Float[Tensor, "view grasp"], Float[Tensor, "view grasp"]]:
        """Mean and standard deviation of the members' calibrated log-odds; differentiable, also where equal.

        Args:
            encoding: Result of `encode`.
            grasps: Trajectories (view, grasp), in the frame of each view's aimed camera.
        """
        logits = []
        for i, member in enumerate(self._loaded):
            own = {name.removeprefix(f"{i}."): value for name, value in encoding.items() if name.startswith(f"{i}.")}
            logits.append(member.to(grasps.wrist).logit(own, grasps) / member.temperature + member.offset)
        every = torch.stack(logits)
        mean = every.mean(0)
        variance = (every - mean).square().mean(0)
        positive = variance > 0  # the root has no gradient at zero
        return mean, torch.where(positive, torch.where(positive, variance, 1.0).sqrt(), 0.0)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Raises ValueError: there is nothing to train."""
        raise ValueError("an ensemble has nothing to train; `python -m dexzoo fit` calibrates it")

"""Several evaluators as one: the mean of their log-odds, and how far they are apart."""

from __future__ import annotations

import hashlib
from typing import ClassVar, Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from dexzoo.models.evaluator import GraspEvaluator, Scene, TrainingOptions
from dexzoo.models.zoo import load


class Ensemble(GraspEvaluator):
    """Members that were trained one by one; nothing of its own but the calibration, which `dexzoo fit` sets.

    members: what `dexzoo.load` takes: names of models, files or folders; em_fk alone where none are given. They are
    loaded, not copied: a saved ensemble holds their names and its own calibration, and needs them where they were.

    >>> Ensemble(members=["em_fk", "runs/em_fk/version_0"]).save("runs/ensemble")  # doctest: +SKIP
    """

    architecture: ClassVar[str] = "ensemble"

    def __init__(self, members: list[str] | None = None, **training: Unpack[TrainingOptions]) -> None:
        super().__init__(**training)
        self.members = ["em_fk"] if members is None else members
        if not self.members:
            raise ValueError("an ensemble needs at least one member")
        # in a tuple, out of the way of state_dict, since each has its own file; they follow what they are given
        self._loaded = tuple(load(member).requires_grad_(False) for member in self.members)

    @property
    def parts(self) -> tuple[GraspEvaluator, ...]:
        """Itself and its members; those of a member that is an ensemble too."""
        return (self, *(part for member in self._loaded for part in member.parts))

    @property
    def digest(self) -> str:
        """SHA-256 of its own calibration and the members' weights."""
        every = [super().digest, *(member.digest for member in self._loaded)]
        return hashlib.sha256("".join(every).encode()).hexdigest()

    def encode(self, images: Float[Tensor, "view 2 224 224"]) -> Scene:
        """What each member keeps, under its number."""
        scenes = [member.to(images).encode(images) for member in self._loaded]
        return {f"{i}.{name}": value for i, scene in enumerate(scenes) for name, value in scene.items()}

    def logit(self, scene: Scene, grasps: Float[Tensor, "view grasp 10 28"]) -> Float[Tensor, "view grasp"]:
        """Mean of the members' log-odds of success, each as its own calibration has it."""
        return self.logit_and_spread(scene, grasps)[0]

    def logit_and_spread(
        self, scene: Scene, grasps: Float[Tensor, "view grasp 10 28"]
    ) -> tuple[Float[Tensor, "view grasp"], Float[Tensor, "view grasp"]]:
        """Mean and standard deviation of the members' calibrated log-odds; both differentiable, also where equal."""
        logits = []
        for i, member in enumerate(self._loaded):
            own = {name.removeprefix(f"{i}."): value for name, value in scene.items() if name.startswith(f"{i}.")}
            logits.append(member.to(grasps).logit(own, grasps) / member.temperature + member.offset)
        every = torch.stack(logits)
        mean = every.mean(0)
        variance = (every - mean).square().mean(0)
        positive = variance > 0  # the root has no gradient at zero
        return mean, torch.where(positive, torch.where(positive, variance, 1.0).sqrt(), 0.0)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Raises ValueError: there is nothing to train."""
        raise ValueError("an ensemble has nothing to train; `python -m dexzoo fit` calibrates it")

"""EM1: image and hand features added."""

from __future__ import annotations

from typing import ClassVar, Unpack

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from dexzoo.models.encoders import DepthEncoder, GraspVector, dense, initialise
from dexzoo.models.evaluator import GraspEvaluator, Scene, TrainingOptions


class EM1(GraspEvaluator):
    """The thesis' first evaluative model (section 3.3, Table 3.1).

    Frozen VGG-16 with all poolings -> 512 x 7 x 7 -> FC-1024; the 280-vector -> FC-1024; both added; four FC-1024;
    softmax over {fail, success}. ReLU and dropout after every FC, Xavier weights.

    trunk: "hed" (shipped) or "imagenet" (fetched). dropout: probability of dropping a unit.
    gain: of Xavier's weights; the root of 2 keeps the variance through ReLUs, which 1, the thesis', does not.
    The other arguments are `GraspEvaluator`'s.
    """

    architecture: ClassVar[str] = "em1"
    frozen_encoder: ClassVar[bool] = True

    def __init__(
        self,
        trunk: str = "hed",
        dropout: float = 0.5,
        gain: float = 1.0,
        **training: Unpack[TrainingOptions],
    ) -> None:
        super().__init__(**training)
        self.trunk, self.dropout, self.gain = trunk, dropout, gain
        self.image_encoder = DepthEncoder(trunk)
        if self.image_encoder.channels != 512:
            raise ValueError(f"trunk {trunk!r} is no VGG-16, which EM1 asks for; use hed or imagenet")
        self.grasp_vector = GraspVector()
        self.image_branch = nn.Sequential(*dense(512 * 7 * 7, 1024, dropout))
        self.hand_branch = nn.Sequential(*dense(280, 1024, dropout))
        self.head = nn.Sequential(*dense(1024, 1024, dropout, depth=4), nn.Linear(1024, 2))
        initialise(self, gain)

    def fit_statistics(self, images: Float[Tensor, "view 2 224 224"], waypoints: Float[Tensor, "grasp 10 28"]) -> None:
        """Set the standardisation of both inputs from training data."""
        self.image_encoder.fit_statistics(images)
        self.grasp_vector.fit_statistics(waypoints)

    def encode(self, images: Float[Tensor, "view 2 224 224"]) -> Scene:
        """The trunk's features, (view, 25088)."""
        return {"features": F.max_pool2d(self.image_encoder(images), 2).flatten(1)}

    def logit(self, scene: Scene, grasps: Float[Tensor, "view grasp 10 28"]) -> Float[Tensor, "view grasp"]:
        """Log-odds of success."""
        image = self.image_branch(scene["features"].to(grasps))
        hand = self.hand_branch(self.grasp_vector(grasps))
        fail, success = self.head(image[:, None] + hand).unbind(-1)
        log_odds: Tensor = success - fail
        return log_odds

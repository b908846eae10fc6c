"""EM1: image and hand features added."""

from __future__ import annotations

from typing import ClassVar, Unpack

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from dexzoo.grasp import Trajectory
from dexzoo.models.batch import Encoding
from dexzoo.models.encoders import DepthEncoder, GraspVector, dense, initialize
from dexzoo.models.evaluator import EvaluatorOptions, GraspEvaluator


class EM1(GraspEvaluator):
    """The thesis' first evaluative model (section 3.3, Table 3.1).

    Frozen VGG-16 with all poolings -> 512 x 7 x 7 -> FC-1024; the 280-vector -> FC-1024; both added; four FC-1024;
    softmax over {fail, success}. ReLU and dropout after every FC, Xavier weights.

    Args:
        trunk: "hed" (shipped) or "imagenet" (fetched).
        dropout: Probability of dropping a unit.
        gain: Gain of Xavier's weights; the root of 2 keeps the variance through ReLUs, the thesis' 1 does not.
        options: Arguments of `GraspEvaluator`.

    Raises:
        ValueError: The trunk is no VGG-16.
    """

    architecture: ClassVar[str] = "em1"
    frozen_encoder: ClassVar[bool] = True

    def __init__(
        self,
        trunk: str = "hed",
        dropout: float = 0.5,
        gain: float = 1.0,
        **options: Unpack[EvaluatorOptions],
    ) -> None:
        super().__init__(**options)
        self.trunk, self.dropout, self.gain = trunk, dropout, gain
        self.image_encoder = DepthEncoder(trunk)
        if self.image_encoder.channels != 512:
            raise ValueError(f"trunk {trunk!r} is no VGG-16, which EM1 asks for; use hed or imagenet")
        self.grasp_vector = GraspVector()
        self.image_branch = nn.Sequential(*dense(512 * 7 * 7, 1024, dropout))
        self.hand_branch = nn.Sequential(*dense(280, 1024, dropout))
        self.head = nn.Sequential(*dense(1024, 1024, dropout, depth=4), nn.Linear(1024, 2))
        initialize(self, gain)

    def fit_statistics(self, images: Float[Tensor, "view 2 224 224"], grasps: Trajectory) -> None:
        """Set the standardization of both inputs.

        Args:
            images: Training views, as in `encode`.
            grasps: Training grasps, (grasp,), each in the frame of its view's aimed camera.
        """
        self.image_encoder.fit_statistics(images)
        self.grasp_vector.fit_statistics(grasps)

    def encode(self, images: Float[Tensor, "view 2 224 224"]) -> Encoding:
        """The trunk's features, (view, 25088).

        Args:
            images: Depth and height over the table in meters, 0 where the object is not; see `GraspEvaluator.encode`.
        """
        return {"features": F.max_pool2d(self.image_encoder(images), 2).flatten(1)}

    def logit(self, encoding: Encoding, grasps: Trajectory) -> Float[Tensor, "view grasp"]:
        """Log-odds of success.

        Args:
            encoding: Result of `encode`.
            grasps: Trajectories (view, grasp), in the frame of each view's aimed camera.
        """
        image = self.image_branch(encoding["features"].to(grasps.wrist))
        hand = self.hand_branch(self.grasp_vector(grasps))
        fail, success = self.head(image[:, None] + hand).unbind(-1)
        log_odds: Tensor = success - fail
        return log_odds

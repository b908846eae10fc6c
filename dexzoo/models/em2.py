"""EM2: image and hand features concatenated, the hand's by one-dimensional convolutions."""

from __future__ import annotations

from typing import ClassVar, Unpack

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dexzoo.grasp import Trajectory
from dexzoo.models.batch import Encoding
from dexzoo.models.encoders import CLIP, DepthEncoder, GraspVector, Standardization, dense, initialize
from dexzoo.models.evaluator import EvaluatorOptions, GraspEvaluator

BLOCKS = ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))
"""Channels and number of convolutions in each block, VGG-16's."""


class EM2(GraspEvaluator):
    """The thesis' second evaluative model (section 3.3, Table 3.1).

    Frozen VGG-16 with global average pooling in place of the last pooling -> 512; the 280-vector through thirteen
    convolutions of width 3, pooled after each block but the last, and averaged -> 512; concatenated; two FC-`width`;
    softmax over {fail, success}. ReLU everywhere, dropout after every FC, Xavier weights.

    Args:
        width: Width of the last layers: 2048 in the thesis' text, 4096 in its Table 3.1.
        trunk: The thesis' VGG-16, "hed" (shipped) or "imagenet" (fetched), or another of `trunks.TRUNKS`.
        dropout: Probability of dropping a unit.
        gain: Gain of Xavier's weights; the root of 2 keeps the variance through ReLUs, the thesis' 1 does not.
        standardize: Whether the trunk's features are standardized, channel by channel, over training views. The thesis
            does not, but averaged over an image that is mostly background they hardly differ from view to view.
        options: Arguments of `GraspEvaluator`.
    """

    architecture: ClassVar[str] = "em2"
    frozen_encoder: ClassVar[bool] = True

    def __init__(
        self,
        width: int = 2048,
        trunk: str = "hed",
        dropout: float = 0.5,
        gain: float = 1.0,
        standardize: bool = False,
        **options: Unpack[EvaluatorOptions],
    ) -> None:
        super().__init__(**options)
        self.width, self.trunk, self.dropout, self.gain = width, trunk, dropout, gain
        self.standardize = standardize
        self.image_encoder = DepthEncoder(trunk)
        self.grasp_vector = GraspVector()
        if standardize:
            self.features = Standardization(self.image_encoder.channels, CLIP)
        layers: list[nn.Module] = []
        channels = 1
        for block, (size, count) in enumerate(BLOCKS):
            if block:
                layers.append(nn.MaxPool1d(2))
            for _ in range(count):
                layers += [nn.Conv1d(channels, size, kernel_size=3, padding=1), nn.ReLU()]
                channels = size
        self.hand_branch = nn.Sequential(*layers, nn.AdaptiveAvgPool1d(1), nn.Flatten())
        self.head = nn.Sequential(
            *dense(BLOCKS[-1][0] + self.image_encoder.channels, width, dropout, depth=2), nn.Linear(width, 2)
        )
        initialize(self, gain)

    def fit_statistics(self, images: Float[Tensor, "view 2 224 224"], grasps: Trajectory) -> None:
        """Set the standardization of both inputs and, if asked for, of the trunk's features.

        Args:
            images: Training views, as in `encode`.
            grasps: Training grasps, (grasp,), each in the frame of its view's aimed camera.
        """
        self.image_encoder.fit_statistics(images)
        self.grasp_vector.fit_statistics(grasps)
        if self.standardize:
            self.features.fit(torch.cat([self.encode(part)["features"] for part in images.split(16)]))

    def encode(self, images: Float[Tensor, "view 2 224 224"]) -> Encoding:
        """The trunk's features, averaged over the image: (view, channel), 512 of them with VGG-16.

        Args:
            images: Depth and height over the table in meters, 0 where the object is not; see `GraspEvaluator.encode`.
        """
        return {"features": self.image_encoder(images).mean((2, 3))}

    def logit(self, encoding: Encoding, grasps: Trajectory) -> Float[Tensor, "view grasp"]:
        """Log-odds of success.

        Args:
            encoding: Result of `encode`.
            grasps: Trajectories (view, grasp), in the frame of each view's aimed camera.
        """
        vectors = self.grasp_vector(grasps)
        views, count = vectors.shape[:2]
        vector = vectors.flatten(0, 1)
        hand = self.hand_branch(vector[:, None]).unflatten(0, (views, count))
        features = encoding["features"].to(hand)
        if self.standardize:
            features = self.features.standardize(features)
        image = features[:, None].expand(-1, count, -1)
        fail, success = self.head(torch.cat((image, hand), dim=-1)).unbind(-1)
        log_odds: Tensor = success - fail
        return log_odds

"""EM2: image and hand features concatenated, the hand's by one-dimensional convolutions."""

from __future__ import annotations

from typing import ClassVar, Unpack

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dexzoo.models.encoders import CLIP, DepthEncoder, GraspVector, Standardisation, dense, initialise
from dexzoo.models.evaluator import GraspEvaluator, Scene, TrainingOptions

BLOCKS = ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))
"""Channels and number of convolutions in each block, VGG-16's."""


class EM2(GraspEvaluator):
    """The thesis' second evaluative model (section 3.3, Table 3.1).

    Frozen VGG-16 with global average pooling in place of the last pooling -> 512; the 280-vector through thirteen
    convolutions of width 3, pooled after each block but the last, and averaged -> 512; concatenated; two FC-`width`;
    softmax over {fail, success}. ReLU everywhere, dropout after every FC, Xavier weights.

    width: 2048 as the thesis' text has it; its Table 3.1 has 4096.
    trunk: the thesis' VGG-16, "hed" (shipped) or "imagenet" (fetched), or another of `trunks.TRUNKS`.
    dropout: probability of dropping a unit.
    gain: of Xavier's weights; the root of 2 keeps the variance through ReLUs, which 1, the thesis', does not.
    standardise: whether the trunk's features are standardised, channel by channel, over training views. The thesis
        does not; but averaged over an image that is mostly background they hardly differ from view to view.
    The other arguments are `GraspEvaluator`'s.
    """

    architecture: ClassVar[str] = "em2"
    frozen_encoder: ClassVar[bool] = True

    def __init__(
        self,
        width: int = 2048,
        trunk: str = "hed",
        dropout: float = 0.5,
        gain: float = 1.0,
        standardise: bool = False,
        **training: Unpack[TrainingOptions],
    ) -> None:
        super().__init__(**training)
        self.width, self.trunk, self.dropout, self.gain = width, trunk, dropout, gain
        self.standardise = standardise
        self.image_encoder = DepthEncoder(trunk)
        self.grasp_vector = GraspVector()
        if standardise:
            self.features = Standardisation(self.image_encoder.channels, CLIP)
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
            *dense(512 + self.image_encoder.channels, width, dropout, depth=2), nn.Linear(width, 2)
        )
        initialise(self, gain)

    def fit_statistics(self, images: Float[Tensor, "view 2 224 224"], waypoints: Float[Tensor, "grasp 10 28"]) -> None:
        """Set the standardisation of both inputs, and of the trunk's features, from training data."""
        self.image_encoder.fit_statistics(images)
        self.grasp_vector.fit_statistics(waypoints)
        if self.standardise:
            self.features.fit(torch.cat([self.encode(part)["features"] for part in images.split(16)]))

    def encode(self, images: Float[Tensor, "view 2 224 224"]) -> Scene:
        """The trunk's features, averaged over the image: (view, channel), 512 of them with VGG-16."""
        return {"features": self.image_encoder(images).mean((2, 3))}

    def logit(self, scene: Scene, grasps: Float[Tensor, "view grasp 10 28"]) -> Float[Tensor, "view grasp"]:
        """Log-odds of success."""
        views, count = grasps.shape[:2]
        vector = self.grasp_vector(grasps).flatten(0, 1)
        hand = self.hand_branch(vector[:, None]).unflatten(0, (views, count))
        features = scene["features"].to(hand)
        if self.standardise:
            features = self.features.standardise(features)
        image = features[:, None].expand(-1, count, -1)
        fail, success = self.head(torch.cat((image, hand), dim=-1)).unbind(-1)
        log_odds: Tensor = success - fail
        return log_odds

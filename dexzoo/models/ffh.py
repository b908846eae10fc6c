"""FFH: distances from fixed points to the object, and the hand's pose and joints, through a residual network."""

from __future__ import annotations

from typing import ClassVar, Unpack

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from dexzoo import rotation
from dexzoo.grasp import GRIP, NUM_TYPES, Trajectory
from dexzoo.models.batch import Encoding
from dexzoo.models.evaluator import EvaluatorOptions, GraspEvaluator
from dexzoo.models.view_geometry import cloud, upright_axes, view_geometry

NUM_BASIS = 4096
RADIUS = 0.2
"""Meters around the object's center in which the basis points lie."""
NUM_CLOUD = 1024
BASIS_SEED = 0


class FFH(GraspEvaluator):
    """The idea of FFHNet (Mayer et al., ICRA 2022), this very hand's peer, with the joints as an input too.

    A basis point set (Prokudin et al. 2019): the distances from 4,096 points, fixed in a ball around the object's
    center, to the nearest observed point. The grasp is the palm's pose at the grip, the 15 free joints there (FFHNet
    leaves them out) and the type. Both go through residual blocks of two layers; each block sees the grasp again. All
    is expressed in axes that stand upright, with the object's center as origin, and the center's height over the table.

    Args:
        width: Width of the layers.
        num_blocks: Number of residual blocks.
        dropout: Probability of dropping a unit.
        options: Arguments of `GraspEvaluator`.
    """

    architecture: ClassVar[str] = "ffh"
    frozen_encoder: ClassVar[bool] = True
    basis: Tensor

    def __init__(
        self, width: int = 512, num_blocks: int = 3, dropout: float = 0.1, **options: Unpack[EvaluatorOptions]
    ) -> None:
        super().__init__(**options)
        self.width, self.num_blocks, self.dropout = width, num_blocks, dropout
        self.register_buffer("basis", _ball(NUM_BASIS, RADIUS))
        grasp_size = 3 + 9 + len(self.known_hands[0].freedoms) + NUM_TYPES + 1
        self.object_branch = nn.Sequential(nn.LayerNorm(NUM_BASIS), nn.Linear(NUM_BASIS, width), nn.ReLU())
        self.entrance = nn.Linear(width + grasp_size, width)
        self.blocks = nn.ModuleList(ResidualBlock(width, grasp_size, dropout) for _ in range(num_blocks))
        self.exit = nn.Linear(width, 1)

    @torch.no_grad()
    def encode(self, images: Float[Tensor, "view 2 224 224"]) -> Encoding:
        """Basis distances (view, 4096), upright axes (view, 3, 3), and center and its height (view, 4); meters.

        Args:
            images: Depth and height over the table in meters, 0 where the object is not; see `GraspEvaluator.encode`.
        """
        geometry = view_geometry(images.float())
        axes = upright_axes(geometry.table)
        points = (cloud(geometry, NUM_CLOUD)[..., :3] - geometry.center[:, None]) @ axes.mT
        distance = torch.stack([torch.cdist(self.basis.to(seen), seen).amin(1) for seen in points])
        return {"distance": distance, "axes": axes, "center": geometry.center_and_height}

    def logit(self, encoding: Encoding, grasps: Trajectory) -> Float[Tensor, "view grasp"]:
        """Log-odds of success.

        Args:
            encoding: Result of `encode`.
            grasps: Trajectories (view, grasp), in the frame of each view's aimed camera.
        """
        features = self.grasp_features({name: value.to(grasps.wrist) for name, value in encoding.items()}, grasps)
        seen = self.object_branch(encoding["distance"].to(grasps.wrist) / RADIUS)[:, None]
        seen = seen.expand(-1, features.shape[1], -1)
        x = F.relu(self.entrance(torch.cat((seen, features.to(seen)), -1)))
        for block in self.blocks:
            x = block(x, features)
        log_odds: Tensor = self.exit(x).squeeze(-1)
        return log_odds

    def grasp_features(self, encoding: Encoding, grasps: Trajectory) -> Float[Tensor, "view grasp number"]:
        """Describe grasps by numbers of the order of one: pose and joints at the grip, type, height of the object.

        Args:
            encoding: Result of `encode`.
            grasps: As in `logit`.

        Returns:
            Numbers in the upright frame of the object.
        """
        with torch.autocast(grasps.wrist.device.type, enabled=False):
            axes = encoding["axes"]
            position = (grasps.position[:, :, GRIP] - encoding["center"][:, None, :3]) @ axes.mT / 0.1
            turn = axes[:, None] @ rotation.to_matrix(rotation.normalize(grasps.quaternion[:, :, GRIP]))
            kind = F.one_hot(grasps.grasp_type, NUM_TYPES).to(position)
            height = encoding["center"][:, None, 3:].expand(-1, position.shape[1], -1) / 0.1
            joints = self.known_hands[0].reduce(grasps.joints[:, :, GRIP])
            return torch.cat((position, turn.flatten(-2), joints, kind, height), -1)


class ResidualBlock(nn.Module):
    """Two layers and a shortcut; the grasp enters beside the features.

    Args:
        width: Width of the layers.
        grasp_size: Numbers that describe a grasp.
        dropout: Probability of dropping a unit.
    """

    def __init__(self, width: int, grasp_size: int, dropout: float) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.layers = nn.Sequential(
            nn.Linear(width + grasp_size, width), nn.ReLU(), nn.Dropout(dropout), nn.Linear(width, width)
        )

    def forward(
        self, x: Float[Tensor, "view grasp width"], grasp: Float[Tensor, "view grasp number"]
    ) -> Float[Tensor, "view grasp width"]:
        """Features after the block.

        Args:
            x: Features before it.
            grasp: Numbers that describe each grasp.
        """
        change: Tensor = self.layers(torch.cat((self.norm(x), grasp.to(x)), -1))
        return x + change


def _ball(count: int, radius: float) -> Tensor:
    """Points drawn evenly from a ball, always the same."""
    generator = torch.Generator().manual_seed(BASIS_SEED)
    direction = torch.randn(count, 3, generator=generator)
    share = torch.rand(count, 1, generator=generator) ** (1 / 3)
    return radius * share * F.normalize(direction, dim=1)

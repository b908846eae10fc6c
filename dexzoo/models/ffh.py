"""FFH: distances from fixed points to the object, and the hand's pose and joints, through a residual network."""

from __future__ import annotations

from typing import ClassVar, Unpack

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from dexzoo import rotation
from dexzoo.grasp import GRIP, JOINTS, NUM_TYPES, POSITION, QUATERNION, TYPE
from dexzoo.hand import default_hand
from dexzoo.models.evaluator import GraspEvaluator, Scene, TrainingOptions
from dexzoo.models.view_geometry import cloud, upright_axes, view_geometry

NUM_BASIS = 4096
RADIUS = 0.2
"""Metres around the object's centre in which the basis points lie."""
NUM_CLOUD = 1024
BASIS_SEED = 0


class FFH(GraspEvaluator):
    """The idea of FFHNet (Mayer et al., ICRA 2022), this very hand's peer, with the joints as an input too.

    A basis point set (Prokudin et al. 2019): the distances from 4,096 points, fixed in a ball around the object's
    centre, to the nearest observed point. The grasp is the palm's pose at the grip, the 15 free joints there (FFHNet
    leaves them out) and the type. Both go through residual blocks of two layers; each block sees the grasp again. All
    is told in axes that stand upright, with the object's centre as origin, and the centre's height over the table.

    width: of the layers. num_blocks: residual blocks. dropout: probability of dropping a unit.
    The other arguments are `GraspEvaluator`'s.
    """

    architecture: ClassVar[str] = "ffh"
    frozen_encoder: ClassVar[bool] = True
    basis: Tensor

    def __init__(
        self, width: int = 512, num_blocks: int = 3, dropout: float = 0.1, **training: Unpack[TrainingOptions]
    ) -> None:
        super().__init__(**training)
        self.width, self.num_blocks, self.dropout = width, num_blocks, dropout
        self.register_buffer("basis", _ball(NUM_BASIS, RADIUS))
        grasp_size = 3 + 9 + len(default_hand().freedoms) + NUM_TYPES + 1
        self.object_branch = nn.Sequential(nn.LayerNorm(NUM_BASIS), nn.Linear(NUM_BASIS, width), nn.ReLU())
        self.entrance = nn.Linear(width + grasp_size, width)
        self.blocks = nn.ModuleList(ResidualBlock(width, grasp_size, dropout) for _ in range(num_blocks))
        self.exit = nn.Linear(width, 1)

    @torch.no_grad()
    def encode(self, images: Float[Tensor, "view 2 224 224"]) -> Scene:
        """Basis distances (view, 4096), upright axes (view, 3, 3), and centre and its height (view, 4); metres."""
        geometry = view_geometry(images.float())
        axes = upright_axes(geometry.table)
        points = (cloud(geometry, NUM_CLOUD)[..., :3] - geometry.centre[:, None]) @ axes.mT
        distance = torch.stack([torch.cdist(self.basis.to(seen), seen).amin(1) for seen in points])
        return {"distance": distance, "axes": axes, "centre": geometry.centre_and_height}

    def logit(self, scene: Scene, grasps: Float[Tensor, "view grasp 10 28"]) -> Float[Tensor, "view grasp"]:
        """Log-odds of success."""
        told = self.tell({name: value.to(grasps) for name, value in scene.items()}, grasps)
        seen = self.object_branch(scene["distance"].to(grasps) / RADIUS)[:, None].expand(-1, grasps.shape[1], -1)
        x = F.relu(self.entrance(torch.cat((seen, told.to(seen)), -1)))
        for block in self.blocks:
            x = block(x, told)
        log_odds: Tensor = self.exit(x).squeeze(-1)
        return log_odds

    def tell(self, scene: Scene, grasps: Float[Tensor, "view grasp 10 28"]) -> Float[Tensor, "view grasp number"]:
        """The grasp's numbers, of the order of one."""
        with torch.autocast(grasps.device.type, enabled=False):
            grip = grasps[:, :, GRIP]
            axes = scene["axes"]
            position = (grip[..., POSITION] - scene["centre"][:, None, :3]) @ axes.mT / 0.1
            turn = axes[:, None] @ rotation.to_matrix(rotation.normalize(grip[..., QUATERNION]))
            kind = F.one_hot(grip[..., TYPE].detach().round().long(), NUM_TYPES).to(grip)
            height = scene["centre"][:, None, 3:].expand(-1, grip.shape[1], -1) / 0.1
            joints = default_hand().reduce(grip[..., JOINTS])
            told: Tensor = torch.cat((position, turn.flatten(-2), joints, kind, height), -1)
        return told


class ResidualBlock(nn.Module):
    """Two layers and a shortcut; the grasp enters beside the features."""

    def __init__(self, width: int, grasp_size: int, dropout: float) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.layers = nn.Sequential(
            nn.Linear(width + grasp_size, width), nn.ReLU(), nn.Dropout(dropout), nn.Linear(width, width)
        )

    def forward(
        self, x: Float[Tensor, "view grasp width"], told: Float[Tensor, "view grasp number"]
    ) -> Float[Tensor, "view grasp width"]:
        """Features after the block."""
        change: Tensor = self.layers(torch.cat((self.norm(x), told.to(x)), -1))
        return x + change


def _ball(count: int, radius: float) -> Tensor:
    """Points drawn evenly from a ball, always the same."""
    generator = torch.Generator().manual_seed(BASIS_SEED)
    direction = torch.randn(count, 3, generator=generator)
    share = torch.rand(count, 1, generator=generator) ** (1 / 3)
    return radius * share * F.normalize(direction, dim=1)

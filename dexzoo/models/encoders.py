"""What evaluators see: a frozen trunk on the colourised depth image, and a grasp as 280 standardised numbers."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from dexzoo import rotation
from dexzoo.camera import colourise
from dexzoo.grasp import NUM_TYPES, NUM_WAYPOINTS, QUATERNION, TYPE, WAYPOINT_SIZE
from dexzoo.models.trunks import load_trunk, trunk

VECTOR_SIZE = NUM_TYPES + NUM_WAYPOINTS * (WAYPOINT_SIZE - 1)
"""A grasp as a vector: ten numbers of the type, then 27 for each of ten waypoints; 280."""
CLIP = 3.0
MIN_STD = 1e-6


def fast_bfloat16(device: torch.device) -> bool:
    """Whether bfloat16 is the faster way there: a processor without instructions for it takes up to 50 times longer.

    Of Intel's only AMX counts: its AVX-512 multiplies bfloat16 half as fast as float32, AMD's faster.
    """
    if device.type != "cpu":
        return True
    abilities = torch.cpu.get_capabilities()
    by_vector = abilities.get("avx512_bf16") and "Intel" not in str(abilities["cpu_name"])
    return bool(by_vector or abilities.get("amx_bf16") or abilities.get("bf16"))


class Standardisation(nn.Module):
    """Numbers less their mean and divided by their deviation, over training data, index by index along the last axis.

    An index that does not vary in the training data is only shifted. limit: what is further from 0 is clipped.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, size: int, limit: float = math.inf) -> None:
        super().__init__()
        self.limit = limit
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("std", torch.ones(size))

    def fit(self, x: Float[Tensor, "sample index"]) -> None:
        """Set mean and standard deviation."""
        x = x.double()
        std = x.std(0)
        self.mean.copy_(x.mean(0))
        self.std.copy_(torch.where(std > MIN_STD, std, 1.0))

    def standardise(self, x: Float[Tensor, "*batch index"]) -> Float[Tensor, "*batch index"]:
        """The standardised numbers."""
        return ((x - self.mean) / self.std).clamp(-self.limit, self.limit)


class DepthEncoder(Standardisation):
    """Depth image -> feature map of a frozen trunk (`dexzoo.models.trunks`), in bfloat16 where that is fast.

    The colourised depth is standardised by channel, with mean and standard deviation over the object pixels of the
    training views, and clipped to three standard deviations: that puts the background, of depth 0, at -3. The thesis
    standardises each pixel by itself; with hundreds of views instead of hundreds of thousands a pixel that few objects
    reach has next to no variance, and its standardised values explode. Images are brought to the scale that the
    trunk was trained on, and features back by the same factor, so that they are of the order of one.

    The trunk is not a submodule: it is neither trained, averaged nor saved, only shared.
    channels: of the feature map.
    """

    def __init__(self, name: str = "hed") -> None:
        super().__init__(3, CLIP)
        self.name = name
        self.channels = trunk(name).channels
        self.mean.copy_(torch.tensor([0.57, 0.0, 0.0]))
        self.std.copy_(torch.tensor([0.1, 0.03, 0.03]))

    def fit_statistics(self, images: Float[Tensor, "view 2 224 224"]) -> None:
        """Set mean and standard deviation from training views."""
        channels = colourise(images[:, 0])
        pixels = channels.movedim(1, -1)[images[:, 0] > 0]
        if not len(pixels):
            raise ValueError("the training views show no object: all depths are 0")
        self.fit(pixels)

    @torch.no_grad()
    def forward(self, images: Float[Tensor, "view 2 224 224"]) -> Float[Tensor, "view channel row column"]:
        """The last convolution's features, after its ReLU and before the last pooling."""
        network = load_trunk(self.name).to(images.device)
        scale = trunk(self.name).scale
        standard = self.standardise(colourise(images[:, 0].float()).movedim(1, -1)).movedim(-1, 1)
        x = (scale * standard).contiguous(memory_format=torch.channels_last)
        with torch.autocast(images.device.type, torch.bfloat16, enabled=fast_bfloat16(images.device)):
            features: Tensor = network(x)
        return (features.float() / scale).contiguous()


class GraspVector(Standardisation):
    """A grasp as 280 numbers: the type as one of ten, then 27 for each waypoint, standardised index by index.

    The 27 are position, quaternion (wxyz, w >= 0) and the 20 joints.
    """

    def __init__(self) -> None:
        super().__init__(VECTOR_SIZE)

    def fit_statistics(self, waypoints: Float[Tensor, "grasp 10 28"]) -> None:
        """Set mean and standard deviation from training grasps in the camera frame."""
        self.fit(self.flatten(waypoints))

    @staticmethod
    def flatten(waypoints: Float[Tensor, "*batch 10 28"]) -> Float[Tensor, "*batch 280"]:
        """The 280 numbers before standardisation."""
        kind = F.one_hot(waypoints[..., 0, TYPE].detach().round().long(), NUM_TYPES).to(waypoints)
        quaternion = rotation.normalize(waypoints[..., QUATERNION])
        path = torch.cat((waypoints[..., :3], quaternion, waypoints[..., 7:TYPE]), dim=-1)
        return torch.cat((kind, path.flatten(-2)), dim=-1)

    def forward(self, waypoints: Float[Tensor, "*batch 10 28"]) -> Float[Tensor, "*batch 280"]:
        """The 280 standardised numbers."""
        return self.standardise(self.flatten(waypoints))


def initialise(module: nn.Module, gain: float = 1.0) -> None:
    """Xavier's uniform weights times `gain`, and zero biases, in linear layers and convolutions (Glorot, Bengio 2010).

    A ReLU halves the variance: with gain 1 thirteen layers leave a hundredth of their input, with the root of 2 all.
    """
    for layer in module.modules():
        if isinstance(layer, (nn.Linear, nn.Conv1d)):
            nn.init.xavier_uniform_(layer.weight, gain)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)


def dense(size: int, width: int, dropout: float, depth: int = 1) -> list[nn.Module]:
    """Fully connected layers of `width`, each with ReLU and dropout."""
    layers: list[nn.Module] = []
    for before in [size, *[width] * (depth - 1)]:
        layers += [nn.Linear(before, width), nn.ReLU(), nn.Dropout(dropout)]
    return layers

"""Input layers of the thesis' networks: a frozen trunk on the colorized depth image, a grasp as 280 numbers."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from dexzoo import rotation
from dexzoo.grasp import NUM_TYPES, NUM_WAYPOINTS, Trajectory
from dexzoo.models.trunks import load_trunk, trunk

VECTOR_SIZE = NUM_TYPES + NUM_WAYPOINTS * (3 + 4 + 20)
"""A grasp as a vector: ten numbers of the type, then 27 for each of ten waypoints; 280."""
CLIP = 3.0
MIN_STD = 1e-6


def fast_bfloat16(device: torch.device) -> bool:
    """Whether bfloat16 is faster than float32 on a device.

    A processor without instructions for it takes up to 50 times longer. Of Intel's only AMX counts: its AVX-512
    multiplies bfloat16 half as fast as float32, AMD's faster.

    Args:
        device: The device.
    """
    if device.type != "cpu":
        return True
    abilities = torch.cpu.get_capabilities()
    by_vector = abilities.get("avx512_bf16") and "Intel" not in str(abilities["cpu_name"])
    return bool(by_vector or abilities.get("amx_bf16") or abilities.get("bf16"))


def colorize(depth: Float[Tensor, "view height width"]) -> Float[Tensor, "view 3 height width"]:
    """Depth, mean curvature g_xx + g_yy and Gaussian curvature g_xx g_yy - g_xy^2 (thesis, eqs 3.3 to 3.6).

    Derivatives are central differences over 1 x 3 windows, in meters per pixel; zero where the window leaves the
    object (depth 0). Square and signed roots bring the curvatures to the scale of the depth's own changes.

    Args:
        depth: Depth in meters, 0 where the object is not.
    """
    g = torch.nn.functional.pad(depth[:, None], (1, 1, 1, 1))[:, 0]
    seen = torch.nn.functional.max_pool2d((g == 0).float()[:, None], 3, 1)[:, 0] == 0
    middle = g[:, 1:-1, 1:-1]
    g_xx = g[:, 1:-1, 2:] - 2 * middle + g[:, 1:-1, :-2]
    g_yy = g[:, 2:, 1:-1] - 2 * middle + g[:, :-2, 1:-1]
    g_xy = (g[:, 2:, 2:] - g[:, 2:, :-2] - g[:, :-2, 2:] + g[:, :-2, :-2]) / 4
    mean = torch.where(seen, g_xx + g_yy, 0.0)
    gaussian = torch.where(seen, g_xx * g_yy - g_xy * g_xy, 0.0)

    def compress(value: Tensor) -> Tensor:
        return value.sign() * value.abs().sqrt()

    return torch.stack((depth, compress(mean), compress(compress(gaussian))), dim=1)


class Standardization(nn.Module):
    """Numbers less their mean and divided by their deviation, over training data, index by index along the last axis.

    An index that does not vary in the training data is only shifted.

    Args:
        size: Number of indices.
        limit: Results further from 0 are clipped.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, size: int, limit: float = math.inf) -> None:
        super().__init__()
        self.limit = limit
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("std", torch.ones(size))

    def fit(self, x: Float[Tensor, "sample index"]) -> None:
        """Set mean and standard deviation.

        Args:
            x: Training data.
        """
        x = x.double()
        std = x.std(0)
        self.mean.copy_(x.mean(0))
        self.std.copy_(torch.where(std > MIN_STD, std, 1.0))

    def standardize(self, x: Float[Tensor, "*batch index"]) -> Float[Tensor, "*batch index"]:
        """The standardized numbers.

        Args:
            x: Numbers.
        """
        return ((x - self.mean) / self.std).clamp(-self.limit, self.limit)


class DepthEncoder(Standardization):
    """Depth image -> feature map of a frozen trunk (`dexzoo.models.trunks`), in bfloat16 where that is fast.

    The colorized depth is standardized by channel, with mean and standard deviation over the object pixels of the
    training views, and clipped to three standard deviations: that puts the background, of depth 0, at -3. The thesis
    standardizes each pixel by itself; with hundreds of views instead of hundreds of thousands a pixel that few objects
    reach has next to no variance, and its standardized values explode. Images are brought to the scale that the
    trunk was trained on, and features back by the same factor, so that they are of the order of one.

    The trunk is not a submodule: it is neither trained, averaged nor saved, only shared.

    Args:
        name: Name of the trunk in `dexzoo.models.trunks.TRUNKS`.

    Attributes:
        channels: Channels of the feature map.
    """

    def __init__(self, name: str = "hed") -> None:
        super().__init__(3, CLIP)
        self.name = name
        self.channels = trunk(name).channels
        self.mean.copy_(torch.tensor([0.57, 0.0, 0.0]))
        self.std.copy_(torch.tensor([0.1, 0.03, 0.03]))

    def fit_statistics(self, images: Float[Tensor, "view 2 224 224"]) -> None:
        """Set mean and standard deviation from training views.

        Args:
            images: Training views, as in `GraspEvaluator.encode`.

        Raises:
            ValueError: The views show no object.
        """
        channels = colorize(images[:, 0])
        pixels = channels.movedim(1, -1)[images[:, 0] > 0]
        if not len(pixels):
            raise ValueError("the training views show no object: all depths are 0")
        self.fit(pixels)

    @torch.no_grad()
    def forward(self, images: Float[Tensor, "view 2 224 224"]) -> Float[Tensor, "view channel row column"]:
        """The last convolution's features, after its ReLU and before the last pooling.

        Args:
            images: Views, as in `GraspEvaluator.encode`.
        """
        network = load_trunk(self.name).to(images.device)
        scale = trunk(self.name).scale
        standard = self.standardize(colorize(images[:, 0].float()).movedim(1, -1)).movedim(-1, 1)
        x = (scale * standard).contiguous(memory_format=torch.channels_last)
        with torch.autocast(images.device.type, torch.bfloat16, enabled=fast_bfloat16(images.device)):
            features: Tensor = network(x)
        return (features.float() / scale).contiguous()


class GraspVector(Standardization):
    """A grasp as 280 numbers: the type as one of ten, then 27 for each waypoint, standardized index by index.

    The 27 are position, quaternion (wxyz, w >= 0) and the 20 joints.
    """

    def __init__(self) -> None:
        super().__init__(VECTOR_SIZE)

    def fit_statistics(self, grasps: Trajectory) -> None:
        """Set mean and standard deviation.

        Args:
            grasps: Training grasps, (grasp,), each in the frame of its view's aimed camera.
        """
        self.fit(self.flatten(grasps))

    @staticmethod
    def flatten(grasps: Trajectory) -> Float[Tensor, "*batch 280"]:
        """The 280 numbers before standardization.

        Args:
            grasps: Trajectories of a hand with 20 joints, (*batch,).
        """
        kind = F.one_hot(grasps.grasp_type, NUM_TYPES).to(grasps.wrist)
        path = torch.cat((grasps.position, rotation.normalize(grasps.quaternion), grasps.joints), dim=-1)
        return torch.cat((kind, path.flatten(-2)), dim=-1)

    def forward(self, grasps: Trajectory) -> Float[Tensor, "*batch 280"]:
        """The 280 standardized numbers.

        Args:
            grasps: Trajectories of a hand with 20 joints, (*batch,).
        """
        return self.standardize(self.flatten(grasps))


def initialize(module: nn.Module, gain: float = 1.0) -> None:
    """Xavier's uniform weights times `gain`, and zero biases, in linear layers and convolutions (Glorot, Bengio 2010).

    A ReLU halves the variance: with gain 1 thirteen layers leave a hundredth of their input, with the root of 2 all.

    Args:
        module: Module whose layers are set.
        gain: Factor of the weights.
    """
    for layer in module.modules():
        if isinstance(layer, (nn.Linear, nn.Conv1d)):
            nn.init.xavier_uniform_(layer.weight, gain)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)


def dense(size: int, width: int, dropout: float, depth: int = 1) -> list[nn.Module]:
    """Fully connected layers, each with ReLU and dropout.

    Args:
        size: Numbers of the input.
        width: Width of the layers.
        dropout: Probability of dropping a unit.
        depth: Number of layers.
    """
    layers: list[nn.Module] = []
    for before in [size, *[width] * (depth - 1)]:
        layers += [nn.Linear(before, width), nn.ReLU(), nn.Dropout(dropout)]
    return layers

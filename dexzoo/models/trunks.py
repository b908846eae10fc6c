"""Pretrained convolutional trunks, frozen; each is loaded once and shared by all models."""

from __future__ import annotations

import json
from collections import OrderedDict
from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from safetensors.torch import load_file
from torch import Tensor, nn
from torchvision.models import ResNet50_Weights, VGG16_Weights, WeightsEnum, resnet50, vgg16

from dexzoo.resources import resource

LITE0_BLOCKS = (
    (3, 1, 1, 16, 1), (3, 2, 6, 24, 2), (5, 2, 6, 40, 2), (3, 2, 6, 80, 3), (5, 1, 6, 112, 3), (5, 2, 6, 192, 4),
    (3, 1, 6, 320, 1),
)  # fmt: skip
"""EfficientNet-lite0's stages: kernel, stride of the first block, expansion, channels, number of blocks."""


class Trunk(NamedTuple):
    """A pretrained trunk.

    Attributes:
        channels: Channels of its last feature map.
        scale: Standard deviation of the images that it was trained on.
        build: Makes the network.
        weights: Name of a file that comes with dexzoo, or a function that fetches the weights.
    """

    channels: int
    scale: float
    build: Callable[[], nn.Module]
    weights: str | Callable[[], dict[str, Tensor]]


def _vgg16() -> nn.Module:
    """The 13 convolutions with their poolings but the last."""
    features: nn.Sequential = vgg16(weights=None).features
    return features[:-1]


def _resnet50() -> nn.Module:
    """All but the pooling and the classifier."""
    layers = resnet50(weights=None).named_children()
    return nn.Sequential(OrderedDict((name, layer) for name, layer in layers if name not in ("avgpool", "fc")))


class InvertedResidual(nn.Module):
    """Widen, convolve each channel, narrow; ReLU6 after the first two (Sandler et al. 2018).

    Each convolution has taken up its batch normalization. With stride 2 it pads as TensorFlow does: the odd row and
    column at the end.

    Args:
        before: Channels of the input.
        after: Channels of the output.
        kernel: Size of the kernels.
        stride: Stride of the convolution of each channel.
        expansion: Factor by which it widens.
    """

    def __init__(self, before: int, after: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        inner, pad = before * expansion, kernel - stride
        layers: list[nn.Module] = [nn.Conv2d(before, inner, 1), nn.ReLU6()] if expansion > 1 else []
        self.layers = nn.Sequential(
            *layers,
            nn.ZeroPad2d((pad // 2, pad - pad // 2) * 2),
            nn.Conv2d(inner, inner, kernel, stride, groups=inner),
            nn.ReLU6(),
            nn.Conv2d(inner, after, 1),
        )
        self.shortcut = stride == 1 and before == after

    def forward(self, x: Float[Tensor, "view before row column"]) -> Float[Tensor, "view after row2 column2"]:
        """The block's output.

        Args:
            x: Feature map.
        """
        out: Tensor = self.layers(x)
        return x + out if self.shortcut else out


def efficientnet_lite0() -> nn.Module:
    """EfficientNet-lite0 without its classifier: 1280 channels (Tan and Le 2019; its lite variants of 2020)."""
    layers: list[nn.Module] = [nn.ZeroPad2d((0, 1, 0, 1)), nn.Conv2d(3, 32, 3, 2), nn.ReLU6()]
    channels = 32
    for kernel, stride, expansion, size, count in LITE0_BLOCKS:
        for i in range(count):
            layers.append(InvertedResidual(channels, size, kernel, stride if i == 0 else 1, expansion))
            channels = size
    return nn.Sequential(*layers, nn.Conv2d(channels, 1280, 1), nn.ReLU6())


_SCALE = "@scale"


def _shipped(name: str) -> dict[str, Tensor]:
    path = resource("checkpoints") / f"{name}.safetensors"
    if not path.is_file():
        raise FileNotFoundError(f"trunk weights {path} are missing; use another trunk, or reinstall dexzoo")
    stored = load_file(path)
    scales = {name: stored.pop(name + _SCALE) for name in list(stored) if name + _SCALE in stored}
    return {name: value.float() * scales[name] if name in scales else value for name, value in stored.items()}


def pack(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Weights as a file keeps them in a quarter of the space: int8 with a scale for each output channel.

    Vectors, such as those of normalizations, stay: in float16, or as they are if they are integers.

    Args:
        weights: Tensors by name.
    """
    packed: dict[str, Tensor] = {}
    for name, value in weights.items():
        if value.ndim > 1:
            scale = value.flatten(1).abs().amax(1).clamp_min(1e-12).view(-1, *[1] * (value.ndim - 1)) / 127
            packed[name], packed[name + _SCALE] = (value / scale).round().to(torch.int8).contiguous(), scale
        else:
            packed[name] = value.half() if value.is_floating_point() else value
    return packed


def _fetched(weights: WeightsEnum, *, prefix: str = "", without: str) -> dict[str, Tensor]:
    try:
        values = weights.get_state_dict(progress=False, check_hash=True, weights_only=True)
    except OSError as error:
        raise FileNotFoundError(f"ImageNet weights cannot be fetched ({error}); use a shipped trunk") from None
    return {name.removeprefix(prefix): value for name, value in values.items() if not name.startswith(without)}


_VGG = partial(_fetched, VGG16_Weights.IMAGENET1K_V1, prefix="features.", without="classifier.")
_RESNET = partial(_fetched, ResNet50_Weights.IMAGENET1K_V2, without="fc.")
TRUNKS = {
    "hed": Trunk(512, 60.0, _vgg16, "vgg16_hed"),
    "imagenet": Trunk(512, 1.0, _vgg16, _VGG),
    "lite0": Trunk(1280, 0.5, efficientnet_lite0, "efficientnet_lite0"),
    "resnet50": Trunk(2048, 1.0, _resnet50, _RESNET),
    "resnet50_views": Trunk(2048, 1.0, _resnet50, "resnet50_views"),
}
"""hed: VGG-16, ImageNet weights fine-tuned for edge detection (Xie and Tu 2015). imagenet: VGG-16, fetched by
torchvision. lite0: EfficientNet-lite0, ImageNet. resnet50: ImageNet, fetched by torchvision. resnet50_views: ResNet-50
trained on rendered views by assets/checkpoints/train_resnet50.py. All but the fetched come with dexzoo."""


def trunk(name: str) -> Trunk:
    """A trunk by its name.

    Args:
        name: A name in `TRUNKS`.

    Raises:
        ValueError: The name is unknown.
    """
    if name not in TRUNKS:
        raise ValueError(f"trunk {name!r} is unknown; use one of {', '.join(TRUNKS)}")
    return TRUNKS[name]


def trunk_card(name: str) -> dict[str, Any] | None:
    """Card of a trunk that comes with dexzoo, with source and license.

    Args:
        name: A name in `TRUNKS`.

    Returns:
        The card; None for a trunk that is fetched.

    Raises:
        FileNotFoundError: The card is missing.
        ValueError: The name is unknown.
    """
    file = trunk(name).weights
    if not isinstance(file, str):
        return None
    card: dict[str, Any] = json.loads((resource("checkpoints") / f"{file}.json").read_text())
    return card


def trunk_bytes(name: str) -> int:
    """Size of the file that a trunk comes in, or of the weights in memory if it is fetched.

    Args:
        name: A name in `TRUNKS`.
    """
    file = trunk(name).weights
    if isinstance(file, str):
        return (resource("checkpoints") / f"{file}.safetensors").stat().st_size
    return sum(value.numel() * value.element_size() for value in load_trunk(name).state_dict().values())


@cache
def load_trunk(name: str) -> nn.Module:
    """A trunk with its weights, frozen; one copy of each is shared by all models.

    Args:
        name: A name in `TRUNKS`.

    Raises:
        FileNotFoundError: The weights are missing or cannot be fetched.
        ValueError: The name is unknown.
    """
    known = trunk(name)
    weights = _shipped(known.weights) if isinstance(known.weights, str) else known.weights()
    with torch.device("meta"):  # torchvision would draw millions of random weights in vain
        network = known.build()
    network.load_state_dict(
        {key: value.float() if value.is_floating_point() else value for key, value in weights.items()}, assign=True
    )
    network.requires_grad_(False)
    return network.to(memory_format=torch.channels_last).eval()

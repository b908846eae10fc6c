"""Train resnet50_views.safetensors, EM3's trunk: ResNet-50 from scratch on the views of a grasp set's training objects.

    python assets/checkpoints/train_resnet50.py

It learns the object's category from the mean of its last features, and the surface's normals, in the frame of the
camera, from each of them; mirrored views double the data. All epochs but the last see views of 128 pixels a side, a
third of the work, as the features' cells then are still whole. No grasp and no test object is seen. Called again with
the same --folder it goes on after the last epoch that it finished there.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shlex
import sys
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.data import DataLoader

from dexzoo.collection.rendering import render
from dexzoo.data.grasp_set import GraspSet
from dexzoo.data.schema import VERSION
from dexzoo.models.encoders import DepthEncoder, colorize, fast_bfloat16
from dexzoo.models.trunks import TRUNKS, pack
from dexzoo.models.view_geometry import view_geometry

NAME = "resnet50_views"
LEARNING_RATE, WEIGHT_DECAY = 1e-3, 0.05
SMALL = 128


class Pretext(lightning.LightningModule):
    """The trunk and what it is trained by: views of training objects, each with its category."""

    def __init__(self, data: GraspSet, epochs: int, batch_size: int, seed: int) -> None:
        super().__init__()
        self.epochs, self.batch_size, self.seed = epochs, batch_size, seed
        self.asked = f"{data.sha256} {epochs} {batch_size} {seed}"
        self.told: dict[str, float] = {}
        names = data.scenes["category"].to_pylist()
        kinds = sorted(set(names))
        views = np.flatnonzero(np.array(data.scenes["split"].to_pylist())[data.view_scene] == "train")
        self.images = data.images(views.tolist())
        self.kind = torch.tensor([kinds.index(name) for name in names])[data.view_scene[views]]
        self.encoder = DepthEncoder(NAME)
        self.encoder.fit_statistics(self.images[torch.arange(0, len(views), max(1, len(views) // 256))])
        self.trunk = TRUNKS[NAME].build().to(memory_format=torch.channels_last)
        self.category = nn.Linear(TRUNKS[NAME].channels, len(kinds))
        self.normals = nn.Conv2d(TRUNKS[NAME].channels, 3, 1)

    def train_dataloader(self) -> DataLoader[int]:
        """Rows of the views in an order that is the epoch's own."""
        generator = torch.Generator().manual_seed(1000 * self.seed + self.current_epoch)
        order = torch.randperm(len(self.kind), generator=generator).tolist()
        return DataLoader(order, self.batch_size, generator=generator)

    def training_step(self, rows: Tensor, batch_idx: int) -> Tensor:
        """Cross-entropy of the category plus one less the cosine between normals."""
        images, kind = self.images[rows.cpu()].to(self.device), self.kind[rows.cpu()].to(self.device)
        geometry = view_geometry(images)
        x = self.encoder.standardize(colorize(images[:, 0]).movedim(1, -1)).movedim(-1, 1)
        normals, mask = geometry.normals, geometry.mask[:, None]
        if (batch_idx + self.current_epoch) % 2:
            mirrored = normals.flip(-1) * normals.new_tensor([-1, 1, 1])[:, None, None]
            x, normals, mask = x.flip(-1), mirrored, mask.flip(-1)
        if self.current_epoch < self.epochs - 1:
            x = F.interpolate(x, size=(SMALL, SMALL), mode="area")
        features = self.trunk(x.contiguous(memory_format=torch.channels_last))
        cells = features.shape[-2:]
        normals, mask = F.adaptive_avg_pool2d(normals * mask, cells), F.adaptive_avg_pool2d(mask, cells)[:, 0]
        logits, guess = self.category(features.mean((2, 3))), self.normals(features)
        wrong = 1 - F.cosine_similarity(guess.float(), normals, dim=1)
        told = {"right": (logits.argmax(1) == kind).float().mean(), "normals": (mask * wrong).sum() / mask.sum()}
        self.log_dict(told, on_step=False, on_epoch=True, prog_bar=True, batch_size=len(rows))
        loss: Tensor = F.cross_entropy(logits.float(), kind) + told["normals"]
        return loss

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """AdamW, its rate rising and falling once (Smith and Topin 2017)."""
        optimizer = torch.optim.AdamW(self.parameters(), LEARNING_RATE, weight_decay=WEIGHT_DECAY, fused=True)
        steps = self.epochs * -(-len(self.kind) // self.batch_size)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, LEARNING_RATE, total_steps=steps)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def on_train_epoch_end(self) -> None:
        """Say how far it is."""
        self.told = {name: round(float(self.trainer.callback_metrics[name]), 4) for name in ("right", "normals")}
        line = f"{100 * self.told['right']:.1f} % of categories right, normals {self.told['normals']:.3f} off"
        sys.stderr.write(f"epoch {self.current_epoch}: {line}\n")

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep what was asked for and what the last epoch told."""
        checkpoint |= {"asked": self.asked, "told": self.told}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """ValueError where something else was asked for."""
        if checkpoint["asked"] != self.asked:
            raise ValueError("the folder holds a run on other data or with other options; give another --folder")
        self.told = checkpoint["told"]


def main(args: list[str]) -> None:
    """Train, and write weights and card."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", default="assets/grasps")
    parser.add_argument("--epochs", type=int, default=10)
    parser.add_argument("--batch_size", type=int, default=32)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, default=Path("runs/resnet50_views"), help="for the checkpoint")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    options = parser.parse_args(args)
    lightning.seed_everything(options.seed, verbose=False)
    data = GraspSet(options.data, renderer=render)
    task = Pretext(data, options.epochs, options.batch_size, options.seed)
    trainer = lightning.Trainer(
        max_epochs=options.epochs,
        precision="bf16-mixed" if fast_bfloat16(task.device) else "32-true",
        callbacks=[ModelCheckpoint(options.folder, "last", save_on_train_epoch_end=True, enable_version_counter=False)],
        reload_dataloaders_every_n_epochs=1,
        logger=False,
        enable_progress_bar=sys.stderr.isatty(),
        enable_model_summary=False,
    )
    last = options.folder / "last.ckpt"
    trainer.fit(task, ckpt_path=last if last.exists() else None, weights_only=True)
    path = options.out / f"{NAME}.safetensors"
    save_file(pack(task.trunk.state_dict()), path)
    path.chmod(0o644)
    card = {
        "trunk": "ResNet-50, trained here on rendered views by the objects' categories and the surfaces' normals",
        "data": {"version": VERSION, "sha256": data.sha256},
        "in_the_last_epoch": task.told,
        "seed": options.seed,
        "precision": "int8, a scale for each output channel",
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "command": shlex.join(["python", "assets/checkpoints/train_resnet50.py", *args]),
    }
    path.with_suffix(".json").write_text(json.dumps(card, indent=2) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])

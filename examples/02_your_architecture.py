"""An architecture of your own: a subclass with `encode` and `logit`, trained, saved, loaded and used like the others.

python examples/02_your_architecture.py --out out/yours
Tests hold it to what all models keep (tests/test_models.py). To train yours in earnest: docs/training.md.
"""

import argparse
from pathlib import Path
from typing import Unpack

from lightning import Trainer, seed_everything
from torch import Tensor, nn

import dexzoo
from dexzoo.collection.rendering import render
from dexzoo.data.datamodule import GraspDataModule
from dexzoo.grasp import Trajectory
from dexzoo.models.batch import Encoding
from dexzoo.models.encoders import GraspVector
from dexzoo.models.evaluator import EvaluatorOptions, GraspEvaluator


class TwoBranches(GraspEvaluator):
    """A small convolutional network looks at the view, a layer at the grasp, and both are joined."""

    architecture = "two_branches"  # the name in its card, by which `load` finds the class

    def __init__(self, width: int = 128, **options: Unpack[EvaluatorOptions]) -> None:
        super().__init__(**options)
        self.width = width  # arguments are kept under their names: from them the model is made again
        layers = [nn.Conv2d(2, 16, 5, 4), nn.ReLU(), nn.Conv2d(16, 32, 5, 4), nn.ReLU(), nn.Conv2d(32, 64, 3, 2)]
        self.view = nn.Sequential(*layers, nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(64, width))
        self.grasp_vector, self.grasp = GraspVector(), nn.Linear(280, width)
        self.head = nn.Sequential(nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, 1))

    def fit_statistics(self, images: Tensor, grasps: Trajectory) -> None:
        """Standardize the grasp's 280 numbers by the training data."""
        self.grasp_vector.fit_statistics(grasps)

    def encode(self, images: Tensor) -> Encoding:
        """(view, 2, 224, 224) -> what `logit` needs of each view, computed once."""
        return {"view": self.view(images)}

    def logit(self, encoding: Encoding, grasps: Trajectory) -> Tensor:
        """Trajectories (view, grasp) -> (view, grasp) log-odds of success."""
        return self.head(encoding["view"][:, None] + self.grasp(self.grasp_vector(grasps)))[..., 0]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/yours"))
    options = parser.parse_args()
    seed_everything(0)
    data, made = GraspDataModule(num_scenes=4), TwoBranches(optimizer="adamw", average_decay=0.9)
    data.renderer = render  # the shipped set keeps no images
    Trainer(max_steps=50, accelerator="cpu", logger=False, enable_checkpointing=False).fit(made, datamodule=data)
    model = dexzoo.load(made.save(options.out, card={"data": data.describe()}))
    p = model.score(data.source.world_grasps[:20], data.source.observation(0))
    print("probabilities of success of the first twenty grasps:", [round(float(x), 2) for x in p])

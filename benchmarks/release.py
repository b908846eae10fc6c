"""Ship a run's weights: assets/checkpoints/NAME.safetensors and its card, NAME being the architecture's.

python benchmarks/release.py runs/em2-adamw/version_0 --limits "What its users should know." "And this."
Half precision is kept where no figure on the test objects differs by more than 0.1 point from those of the run's best
checkpoint. The card gets the limits, and the AUROC on a small part of the test split, by which a test knows whether the
weights do what they did. Then run comparison.py, cards.py and report.py. RUN may also be a file of weights without its
checkpoints, such as the shipped one after the grasp set has changed; its precision is kept.
"""

import argparse
import copy
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torchmetrics.functional.classification import binary_auroc

import dexzoo
from dexzoo.collection.rendering import render
from dexzoo.comparison.compare import GENERATED
from dexzoo.comparison.figures import figures
from dexzoo.comparison.scores import model_scores, read_labels
from dexzoo.data.datamodule import GraspDataModule
from dexzoo.models.evaluator import GraspEvaluator
from dexzoo.models.files import load_weights
from dexzoo.resources import resource
from dexzoo.training.command_line import read_checkpoint

TOLERANCE = 0.001
"""A tenth of a point."""
SMALL_PART = 6
"""The first so many scenes of the test split."""
LIMITS = (
    "Trained and tested in simulation; no grasp that it ranked has been tried on a robot.",
    "It knows one hand, the right DLR/HIT hand II, and grasps of ten waypoints as dexzoo's generators make them.",
    "It has seen single household objects, on a table or a block, from 0.40 to 0.75 m away and 30 to 57 degrees above; "
    "clutter, other views and objects that the hand cannot span are untried.",
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="a folder that fit has written, or a .safetensors file")
    parser.add_argument("--limits", nargs="*", help="sentences, besides those that hold for all; default: as they were")
    parser.add_argument("--data", default="assets/grasps")
    parser.add_argument("--folder", type=Path, default=resource("checkpoints"))
    options = parser.parse_args()
    sys.stdout.write(f"{release(options.run, options.folder, options.data, options.limits)}\n")


def release(run: Path, folder: Path, data: str, limits: list[str] | None = None) -> Path:
    """Write weights and card into the folder; returns the path of the weights.

    limits: of this model, in its card after those that hold for all; None leaves what the card has.
    """
    model, weights = dexzoo.load(run), run if run.is_file() else next(run.glob("*.safetensors"))
    path, full = folder / f"{model.architecture}.safetensors", full_precision(run, model)
    card = json.loads(weights.with_suffix(".json").read_text())
    if limits is not None or "limits" not in card:
        card["limits"] = [*LIMITS, *(limits or [])]
    if full is not None:
        differences = compared(model, full, opened(data))
        told = ", ".join(f"{name} {100 * value:.2f}" for name, value in differences.items())
        sys.stderr.write(f"half precision moves figures by points: {told}\n")
        if max(differences.values()) > TOLERANCE:
            return full.save(path, half=False, card=card | {"precision": "float32", **small_part(full, data)})
    if weights.resolve() != path.resolve():
        shutil.copyfile(weights, path)
    path.with_suffix(".json").write_text(json.dumps(card | small_part(model, data), indent=2) + "\n")
    return path


def full_precision(run: Path, half: GraspEvaluator) -> GraspEvaluator | None:
    """The model with the weights that its own were rounded from, calibrated as it is; None where they are not kept."""
    rounded = dict(half.named_parameters())
    calibration = {"temperature": half.temperature, "offset": half.offset}
    for path in sorted((run / "checkpoints").glob("best*.ckpt")):
        weights = read_checkpoint(path)
        if all(torch.equal(weights[name].half().float(), value) for name, value in rounded.items()):
            model = copy.deepcopy(half)
            load_weights(model, weights | calibration, path)
            return model
    return None


def compared(model: GraspEvaluator, other: GraspEvaluator, data: GraspDataModule) -> dict[str, float]:
    """By how much each figure on the generated grasps of the test objects differs."""
    labels = read_labels(data, "test", GENERATED)
    found = []
    for one in (model, other):
        scores = model_scores(one, data.dataset("test", one, [GENERATED]), one.architecture)
        found.append(figures(labels, scores, np.ones((1, labels.num_scenes))))
    return {name: abs(float(value[0] - found[1][name][0])) for name, value in found[0].items()}


def opened(data: str, num_scenes: int | None = None) -> GraspDataModule:
    """A grasp set whose views are rendered where it keeps no images."""
    module = GraspDataModule(data, num_scenes=num_scenes)
    module.renderer = render
    return module


def small_part(model: GraspEvaluator, data: str) -> dict[str, dict[str, Any]]:
    """What a card says of the generated grasps of the first scenes of the test split."""
    part = opened(data, SMALL_PART).dataset("test", model, [GENERATED])
    probability = model_scores(model, part, model.architecture).probability
    auroc = float(binary_auroc(torch.from_numpy(probability), part.success.long()))
    return {"small_part": {"split": "test", "scenes": SMALL_PART, "grasps": len(part), "auroc": round(auroc, 4)}}


if __name__ == "__main__":
    main()

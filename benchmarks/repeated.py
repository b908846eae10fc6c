"""How far an outcome can be foreseen at all: grasps tried several times under drawn mass, friction and wrist error.

python benchmarks/repeated.py --out benchmarks/results/repeated.json
Every trial is a label of its own. What foresees it: the rate of all trials of the grasp, which knows the trial itself
and so is too good; the rate of the others, which is too coarse; between the two lies the ceiling. Then the one trial
under the scene's own mass and friction, whose outcomes evaluators learn from, and all models that come with weights.
"""

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dexzoo.collection.rendering import render
from dexzoo.comparison.compare import GENERATED, load_models
from dexzoo.comparison.figures import draw_scenes, figures_with_intervals
from dexzoo.comparison.scores import Scores, model_scores, read_labels
from dexzoo.data.datamodule import GraspDataModule
from dexzoo.data.schema import SPLITS

ALL, OTHERS, UNDISTURBED = (
    "the rate of all its trials",
    "the rate of its other trials",
    "its one trial without disturbance",
)
FIGURES = ("accuracy", "auroc", "average_precision", "brier", "calibration_error")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*")
    parser.add_argument("--data", default="assets/grasps_repeated")
    parser.add_argument("--split", default="test", choices=SPLITS)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    data = GraspDataModule(options.data)
    data.renderer = render
    text = json.dumps(foreseen(options.models, data, options.split), indent=2)
    if options.out:
        options.out.write_text(text + "\n")
    sys.stdout.write(text + "\n")


def foreseen(models: list[str], data: GraspDataModule, split: str) -> dict[str, Any]:
    labels = read_labels(data, split, GENERATED)
    if labels is None:
        raise ValueError(f"grasp set {data.folder} has no generated grasps in its {split} split")
    grasp_set = data.source
    rate = grasp_set.grasps["success_rate"].to_numpy()[data.rows(split, [GENERATED]).numpy()]
    if np.isnan(rate).any():
        raise ValueError(f"grasp set {data.folder} has grasps that were tried once; collect it with --trials 5")
    trials = int(grasp_set.scenes["trials"][0].as_py())
    held = np.rint(rate * trials).astype(int)
    success = np.arange(trials) < held[:, None]  # (grasp, trial), in no order
    of_trials = replace(
        labels,
        success=success.ravel(),
        scene=labels.scene.repeat(trials),
        log_likelihood=labels.log_likelihood.repeat(trials),
    )
    rest = (held[:, None] - success) / (trials - 1)
    known = {ALL: rate.repeat(trials), OTHERS: rest.ravel(), UNDISTURBED: labels.success.repeat(trials)}
    scores = {name: Scores(value.astype(np.float32), 0.5, value.astype(np.float32)) for name, value in known.items()}
    for name, model in load_models(models).items():
        once = model_scores(model, data.dataset(split, model, [GENERATED]), name)
        scores[name] = once[np.arange(len(rate)).repeat(trials)]
    draws = draw_scenes(labels.num_scenes, seed=0)
    found = {name: figures_with_intervals(of_trials, score, draws) for name, score in scores.items()}
    return {
        "data": grasp_set.sha256,
        "grasps": len(rate),
        "scenes": labels.num_scenes,
        "objects": len(set(labels.objects)),
        "trials": trials,
        "hold_as_they_are": float(labels.success.mean()),
        "mean_rate": float(rate.mean()),
        "always_the_same": float(np.isin(held, (0, trials)).mean()),
        "rows": {name: {key: row[key] for key in FIGURES} for name, row in found.items()},
    }


if __name__ == "__main__":
    main()

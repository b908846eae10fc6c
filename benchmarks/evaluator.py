"""How well an evaluator tells grasps that hold from those that fail, on the test objects of a grasp set.

python benchmarks/evaluator.py --evaluator em2 --out benchmarks/results/em2.json
Intervals are 95 % bootstrap over scenes. `generated` grasps come first, since they are what a user ranks.
"""

import argparse
import json
import sys
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torchmetrics.functional.classification import binary_auroc

import dexzoo
from dexzoo.data.grasp_set import GraspSet
from dexzoo.data.schema import SPLITS
from dexzoo.grasp import Grasps

NUM_BOOTSTRAP = 1000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=Path("assets/grasps"))
    parser.add_argument("--evaluator", default="em2")
    parser.add_argument("--split", default="test", choices=SPLITS)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    result = evaluate(GraspSet(options.data), options.evaluator, options.split)
    text = json.dumps(result, indent=2)
    if options.out:
        options.out.write_text(text + "\n")
    sys.stdout.write(text + "\n")


def evaluate(data: GraspSet, evaluator: str, split: str) -> dict[str, object]:
    rows = np.flatnonzero(data.grasp_split == SPLITS.index(split))
    score = scores(data, rows, evaluator)
    success, scene, source = data.success[rows], data.grasp_scene[rows], data.source[rows]
    likelihood = data.world_grasps.log_likelihood.numpy()[rows]
    generated = source == "generated"
    return {
        "evaluator": evaluator,
        "split": split,
        "objects": len({data.scenes["object"][int(s)].as_py() for s in np.unique(scene)}),
        "generated": {
            **summary(score[generated], success[generated], scene[generated]),
            "auroc_of_generator_order": auroc(likelihood[generated], success[generated]),
            "top1": top1_table(score[generated], likelihood[generated], success[generated], scene[generated]),
        },
        "all": summary(score, success, scene),
    }


def scores(data: GraspSet, rows: np.ndarray, evaluator: str) -> np.ndarray:
    model = dexzoo.load(evaluator)
    score = np.zeros(len(rows), np.float32)
    world = data.world_grasps.waypoints
    for view in np.unique(data.grasp_view[rows]):
        here = np.flatnonzero(data.grasp_view[rows] == view)
        grasps = Grasps(world[torch.tensor(rows[here])], "world")
        score[here] = model.score(data.observation(int(view)), grasps).numpy()
    return score


def auroc(score: np.ndarray, success: np.ndarray) -> float:
    return float(binary_auroc(torch.tensor(score).argsort().argsort() / len(score), torch.tensor(success).long()))


def summary(score: np.ndarray, success: np.ndarray, scene: np.ndarray) -> dict[str, object]:
    return {
        "grasps": len(score),
        "scenes": len(np.unique(scene)),
        "success_rate": float(success.mean()),
        "accuracy": float(((score > 0.5) == success).mean()),
        "auroc": auroc(score, success),
        "auroc_interval": interval(lambda rows: auroc(score[rows], success[rows]), scene),
    }


def top1_table(score: np.ndarray, likelihood: np.ndarray, success: np.ndarray, scene: np.ndarray) -> dict[str, object]:
    """Success of the first grasp of each scene by evaluator, by the generator's order, and by chance."""
    values = {"evaluator": [], "generator": [], "chance": []}
    for index in np.unique(scene):
        here = np.flatnonzero(scene == index)
        values["evaluator"].append(success[here[score[here].argmax()]])
        values["generator"].append(success[here[likelihood[here].argmax()]])
        values["chance"].append(success[here].mean())
    scenes = np.arange(len(values["chance"]))
    return {
        name: {
            "rate": float(np.mean(rates)),
            "interval": interval(partial(mean_of, np.asarray(rates, float)), scenes),
        }
        for name, rates in values.items()
    }


def mean_of(values: np.ndarray, rows: np.ndarray) -> float:
    return float(values[rows].mean())


def interval(statistic, groups: np.ndarray) -> list[float]:  # noqa: ANN001, a function of row indices
    """95 % bootstrap over groups."""
    rng = np.random.default_rng(0)
    members = [np.flatnonzero(groups == group) for group in np.unique(groups)]
    draws = []
    for _ in range(NUM_BOOTSTRAP):
        rows = np.concatenate([members[i] for i in rng.integers(len(members), size=len(members))])
        draws.append(statistic(rows))
    return [float(x) for x in np.percentile(draws, [2.5, 97.5])]


if __name__ == "__main__":
    main()

"""Compare evaluative models on the grasps of unseen objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from dexzoo.comparison.figures import NUM_DRAWS, against, by_top1, describe, draw_scenes
from dexzoo.comparison.scores import (
    COIN,
    EM2,
    GM,
    Labels,
    Scores,
    coin_scores,
    first_image,
    likelihood_scores,
    measure,
    model_scores,
    read_labels,
)
from dexzoo.data.datamodule import GraspDataModule
from dexzoo.data.schema import SOURCES, VERSION
from dexzoo.models.evaluator import GraspEvaluator
from dexzoo.models.registry import list_models, shipped_card
from dexzoo.models.zoo import load

GENERATED = SOURCES[0]


def load_models(models: Sequence[str]) -> dict[str, GraspEvaluator]:
    """Load models by the names of their rows: the last part of a path without .safetensors, or all of it if taken.

    Args:
        models: Names, files, folders or addresses, as `dexzoo.load` takes them. One given twice is loaded once;
            if none is given, all that come with weights are.
    """
    models = list(dict.fromkeys(models)) or [name for name in list_models() if shipped_card(name)]
    short = [Path(model).name.removesuffix(".safetensors") for model in models]
    taken = [*short, GM, COIN]
    names = [name if taken.count(name) == 1 else model for name, model in zip(short, models, strict=True)]
    return {name: load(model) for name, model in zip(names, models, strict=True)}


def compare(
    models: Mapping[str, GraspEvaluator], data: GraspDataModule, split: str = "test", seed: int = 0
) -> dict[str, Any]:
    """All figures of some models, of the generator's likelihood (gm) and of a coin on one split of a grasp set.

    The same call gives the same result, but for the times in `cost`. Ranks are within the grasps of one source in
    one scene, each seen in the view that the set pairs it with. There is no row gm if the set has no likelihoods;
    its threshold is the most accurate one for the generated grasps of validation.

    Args:
        models: Models by the names of their rows.
        data: The grasp set.
        split: Split that is compared on.
        seed: Seed of the coin and of the bootstrap's draws.

    Returns:
        Plain values, ready for JSON: split, seed, num_draws; data (version and checksum of the set); weights (by
            model, checksums of its file and of its members', None for one that was not read from a file); sources
            (for generated grasps and, if the split has some, for perturbed and refined ones: number of grasps,
            objects and scenes, the success rate, and in `rows`, by name, `figures.describe` and `figures.against`,
            the latter of gm, em2 and, for the model with the highest top-1, of the next); cost, by model.

    Raises:
        FileNotFoundError: The set cannot be found.
        ValueError: The set cannot be read, or the split has no generated grasps.
    """
    labels = {source: found for source in SOURCES if (found := read_labels(data, split, source))}
    if GENERATED not in labels:
        raise ValueError(f"grasp set {data.folder} has no generated grasps in its {split} split; collect more objects")
    rows: dict[str, dict[str, Scores]] = {source: {} for source in labels}
    cost = {}
    image = first_image(data, split)
    for name, model in models.items():
        for source in labels:
            dataset = data.dataset(split, model, [source])
            rows[source][name] = model_scores(model, dataset, f"{name} on {source} grasps")
            if source == GENERATED:
                cost[name] = asdict(measure(model, image, dataset.aimed(torch.arange(len(dataset)))))
    validation = read_labels(data, "validation", GENERATED)
    return {
        "split": split,
        "seed": seed,
        "num_draws": NUM_DRAWS,
        "data": {"version": VERSION, "sha256": data.source.sha256},
        "weights": {name: [part.sha256 for part in model.parts] for name, model in models.items()},
        "sources": {source: _section(labels[source], rows[source], validation, seed) for source in labels},
        "cost": cost,
    }


def _section(labels: Labels, rows: dict[str, Scores], validation: Labels | None, seed: int) -> dict[str, Any]:
    """The figures of all rows on the grasps of one source."""
    likelihood = likelihood_scores(labels, validation)
    reference = {} if likelihood is None else {GM: likelihood}
    rows = {**rows, **reference, COIN: coin_scores(labels, seed)}
    draws = draw_scenes(labels.num_scenes, seed)
    described = {name: describe(labels, scores, draws) for name, scores in rows.items()}
    best, second = [*by_top1(described), None, None][:2]
    for name, scores in rows.items():
        others = dict.fromkeys([GM, EM2, *([second] if name == best else [])])
        for one in [one for one in others if one in rows and one != name]:
            described[name][f"against_{one}"] = against(labels, scores, rows[one], one, draws)
    return {
        "grasps": len(labels.success),
        "objects": len(set(labels.objects)),
        "scenes": labels.num_scenes,
        "success_rate": float(labels.success.mean()),
        "rows": described,
    }

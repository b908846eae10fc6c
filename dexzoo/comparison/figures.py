"""The figures of one row, each with its bootstrap interval over scenes.

Grasps of one scene share object, pose and luck, so scenes are resampled. A draw is how often each scene
is taken, and every figure is a function of such weights (draw, scene): a row of ones gives the figure itself, and a
thousand draws give all its replicates at once, without a grasp being copied.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import binomtest

from dexzoo.comparison.scores import COIN, GM, Labels, Scores
from dexzoo.metrics import (
    CalibrationError,
    SceneAUROC,
    SceneMetric,
    SuccessByRank,
    TopKSuccess,
    bin_index,
    expected_calibration_error,
)

Array = NDArray[np.float64]
NUM_DRAWS = 1000
NUM_BINS = 15
_CHUNK = 50
"""Draws at once; bounds memory to so many numbers for each grasp."""


def draw_scenes(num_scenes: int, seed: int, num_draws: int = NUM_DRAWS) -> Array:
    """Draw how often each scene is taken, (1 + draw, scene): once, then with replacement.

    Args:
        num_scenes: Number of scenes.
        seed: Seed of the draws.
        num_draws: Number of draws.
    """
    share = np.full(num_scenes, 1 / num_scenes)
    drawn = np.random.default_rng(seed).multinomial(num_scenes, share, num_draws)
    return np.concatenate((np.ones((1, num_scenes)), drawn))


def describe(labels: Labels, scores: Scores, draws: Array) -> dict[str, Any]:
    """All figures of a row, plain values ready for JSON, None if one is not defined.

    Args:
        labels: Grasps and their outcomes.
        scores: Scores of the row.
        draws: As of `draw_scenes`.

    Returns:
        figures: value and 95 % interval of each. threshold, counts: tp, fp, tn, fn of the predictions at the
            threshold. by_rank: success rate of each tenth of the scenes' rankings, best first. reliability: of each
            bin of probability, the grasps, their mean probability and their success rate. by_category: grasps, scenes
            and a few figures of each.
    """
    tenths = by_scene(SuccessByRank(), labels, scores).T
    return {
        "figures": figures_with_intervals(labels, scores, draws),
        "threshold": scores.threshold,
        "counts": counts(labels, scores),
        "by_rank": [with_interval(mean(tenth, draws)) for tenth in tenths],
        "reliability": reliability(labels, scores),
        "by_category": {str(name): _of_category(name, labels, scores) for name in np.unique(labels.category)},
    }


def figures_with_intervals(labels: Labels, scores: Scores, draws: Array) -> dict[str, Any]:
    """Value and 95 % interval of every figure of a row, plain values.

    Args:
        labels: Grasps and their outcomes.
        scores: Scores of the row.
        draws: As of `draw_scenes`.
    """
    return {name: with_interval(values) for name, values in figures(labels, scores, draws).items()}


def figures(labels: Labels, scores: Scores, weights: Array) -> dict[str, Array]:
    """Every figure of a row by name, each (draw,); nan if it is not defined.

    accuracy and balanced_accuracy (the mean of the rates at which successes and failures are recognized) at the
    row's threshold; auroc over all grasps; scene_auroc, average_precision; brier, the mean squared error of the
    probability; calibration_error in bins of equal width; top1 and top5, the success rate of each scene's best.
    Those that need a threshold or a probability are left out if the row has none.

    Args:
        labels: Grasps and their outcomes.
        scores: Scores of the row.
        weights: How often each scene is taken, (draw, scene).
    """
    found = {}
    held, size = labels.success, weights @ _sums(labels, np.ones(len(labels.success)))
    if scores.predicted is not None:
        hits, misses = (weights @ _sums(labels, kind & (scores.predicted == held)) for kind in (held, ~held))
        successes = weights @ _sums(labels, held)
        found["accuracy"] = (hits + misses) / size
        found["balanced_accuracy"] = (_ratio(hits, successes) + _ratio(misses, size - successes)) / 2
    found["auroc"], found["average_precision"] = ranking(labels, scores.score, weights)
    found["scene_auroc"] = mean(by_scene(SceneAUROC(), labels, scores), weights)
    if scores.probability is not None:
        found["brier"] = weights @ _sums(labels, (scores.probability - held) ** 2) / size
        bins = np.tensordot(weights, _bins(labels, scores.probability), 1)
        found["calibration_error"] = expected_calibration_error(torch.from_numpy(bins)).numpy()
    for k in (1, 5):
        found[f"top{k}"] = mean(by_scene(TopKSuccess(k), labels, scores), weights)
    return found


def ranking(labels: Labels, score: NDArray[np.float32], weights: Array) -> tuple[Array, Array]:
    """AUROC and average precision, (draw,) each, ties counting half in the one and together in the other.

    Args:
        labels: Grasps and their outcomes.
        score: Scores, (grasp,).
        weights: How often each scene is taken, (draw, scene).
    """
    order = np.argsort(-score, kind="stable")
    last = np.flatnonzero(np.append(np.diff(score[order]) != 0, True))  # of each group of equal scores
    scene, held = labels.scene[order], labels.success[order].astype(np.float64)
    parts = []
    for part in np.split(weights, range(_CHUNK, len(weights), _CHUNK)):
        weight = part[:, scene]
        taken = np.cumsum(weight, 1)[:, last]
        hits = np.cumsum(weight * held, 1)[:, last]
        new_hits = np.diff(hits, prepend=0.0)
        misses = taken - hits
        above = (np.diff(misses, prepend=0.0) * (hits - new_hits / 2)).sum(1)  # pairs in order
        precision = _ratio((new_hits * _ratio(hits, taken, 0.0)).sum(1), hits[:, -1])
        parts.append((_ratio(above, hits[:, -1] * misses[:, -1]), precision))
    auroc, precision = (np.concatenate(column) for column in zip(*parts, strict=True))
    return auroc, precision


def by_scene(metric: SceneMetric, labels: Labels, scores: Scores) -> Array:
    """The figure of each scene, (scene, ...).

    Args:
        metric: The metric.
        labels: Grasps and their outcomes.
        scores: Scores of the row.
    """
    metric.update(*(torch.from_numpy(values) for values in (scores.score, labels.success, labels.scene)))
    return np.asarray(metric.by_scene(), np.float64)


def mean(values: Array, weights: Array) -> Array:
    """Mean over scenes, (draw,); scenes without the figure are left out.

    Args:
        values: Figure of each scene, nan without one, (scene,).
        weights: How often each scene is taken, (draw, scene).
    """
    known = np.isfinite(values)
    return _ratio(weights[:, known] @ values[known], weights[:, known].sum(1))


def counts(labels: Labels, scores: Scores) -> dict[str, int] | None:
    """True and false positives, true and false negatives.

    Args:
        labels: Grasps and their outcomes.
        scores: Scores of the row.
    """
    called = scores.predicted
    if called is None:
        return None
    kinds = {"tp": (True, True), "fp": (True, False), "tn": (False, False), "fn": (False, True)}
    return {
        name: int(np.count_nonzero((called == predicted) & (labels.success == held)))
        for name, (predicted, held) in kinds.items()
    }


def reliability(labels: Labels, scores: Scores) -> list[dict[str, Any]] | None:
    """The reliability diagram.

    Args:
        labels: Grasps and their outcomes.
        scores: Scores of the row.
    """
    if scores.probability is None:
        return None
    metric = CalibrationError(NUM_BINS)
    metric.update(torch.from_numpy(scores.probability), torch.from_numpy(labels.success))
    return [
        {"grasps": int(count), "probability": _plain(probability), "success_rate": _plain(rate)}
        for count, probability, rate in metric.bins().tolist()
    ]


def against(labels: Labels, scores: Scores, other: Scores, name: str, draws: Array) -> dict[str, Any]:
    """A row against another one on the same grasps: `cross_table` and `gains` of both.

    top1: over scenes, whether the first grasp holds, as the thesis counts (Table 3.4). accuracy: over grasps,
    whether the prediction is right; grasps of a scene are alike, so that its p is too small. None without
    thresholds.

    Args:
        labels: Grasps and their outcomes.
        scores: Scores of the row.
        other: Scores of the other row.
        name: Name of the other row.
        draws: As of `draw_scenes`.
    """
    scenes = np.arange(labels.num_scenes)
    first, other_first = (by_scene(TopKSuccess(1), labels, row) > 0.5 for row in (scores, other))
    found: dict[str, Any] = {"top1": cross_table(first, other_first, name) | gains(first, other_first, scenes, draws)}
    found["accuracy"] = None
    if scores.predicted is not None and other.predicted is not None:
        right, other_right = scores.predicted == labels.success, other.predicted == labels.success
        found["accuracy"] = cross_table(right, other_right, name) | gains(right, other_right, labels.scene, draws)
    return found


def by_top1(rows: dict[str, Any]) -> list[str]:
    """Names of the rows that are models, those with the highest top-1 first.

    Args:
        rows: Rows by name, as of `describe`.
    """
    models = [name for name in rows if name not in (GM, COIN)]
    return sorted(models, key=lambda name: -rows[name]["figures"]["top1"]["value"])


def gains(
    right: NDArray[np.bool_], other_right: NDArray[np.bool_], scene: NDArray[np.int64], draws: Array
) -> dict[str, Any]:
    """Gains of a row over another on the same cases, with intervals over the same draws.

    difference: of the rates at which they are right. failures_removed: the share of the other's failures that are
    gone, less those that are new; negative if there are more.

    Args:
        right: Whether the row is right, (case,).
        other_right: Whether the other is, (case,).
        scene: Scene of each case, (case,).
        draws: As of `draw_scenes`.
    """
    columns = (right * 1.0 - other_right, np.ones(len(right)), ~other_right)
    gained, cases, failures = (np.bincount(scene, column, draws.shape[1]) for column in columns)
    return {
        name: with_interval(_ratio(draws @ gained, draws @ whole))
        for name, whole in (("difference", cases), ("failures_removed", failures))
    }


def cross_table(right: NDArray[np.bool_], other_right: NDArray[np.bool_], name: str) -> dict[str, Any]:
    """The four cells, and McNemar's exact p: of a split at least as uneven among the cases in which they differ.

    Args:
        right: Whether the row is right, (case,).
        other_right: Whether the other is, (case,).
        name: Name of the other.
    """
    alone, other_alone = int((right & ~other_right).sum()), int((~right & other_right).sum())
    differ = alone + other_alone
    return {
        "both": int((right & other_right).sum()),
        "neither": int((~right & ~other_right).sum()),
        "only_this": alone,
        f"only_{name}": other_alone,
        "p": float(binomtest(alone, differ).pvalue) if differ else 1.0,
    }


def _of_category(name: str, labels: Labels, scores: Scores) -> dict[str, Any]:
    scenes = np.flatnonzero(labels.category == name)
    part = labels[scenes]
    found = figures(part, scores[np.isin(labels.scene, scenes)], np.ones((1, part.num_scenes)))
    return {
        "grasps": len(part.success),
        "scenes": part.num_scenes,
        "success_rate": _plain(part.success.mean()),
        **{name: _plain(found[name][0]) for name in ("accuracy", "auroc", "top1") if name in found},
    }


def with_interval(values: Array) -> dict[str, Any]:
    """A figure and its 95 % interval.

    Args:
        values: The figure, then its value in each draw, (1 + draw,).
    """
    value, replicates = values[0], values[1:]
    known = replicates[np.isfinite(replicates)]
    interval = [_plain(x) for x in np.percentile(known, [2.5, 97.5])] if len(known) else None
    return {"value": _plain(value), "interval": interval}


def _plain(value: float) -> float | None:
    return round(float(value), 6) if np.isfinite(value) else None


def _sums(labels: Labels, values: NDArray[Any]) -> Array:
    """Sum over the grasps of each scene, (scene,)."""
    return np.asarray(np.bincount(labels.scene, values, labels.num_scenes), np.float64)


def _bins(labels: Labels, probability: NDArray[np.float32]) -> Array:
    """(scene, bin, 3) number of grasps, sum of their probabilities and of their successes."""
    cell = labels.scene * NUM_BINS + bin_index(torch.from_numpy(probability), NUM_BINS).numpy()
    columns = (np.ones_like(probability), probability, labels.success)
    sums = [np.bincount(cell, column, labels.num_scenes * NUM_BINS) for column in columns]
    return np.stack(sums, -1).reshape(labels.num_scenes, NUM_BINS, 3).astype(np.float64)


def _ratio(part: Array, whole: Array, otherwise: float = np.nan) -> Array:
    return np.divide(part, whole, out=np.full_like(part, otherwise), where=whole > 0)

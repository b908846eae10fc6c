"""The rows of a comparison: how evaluators, the generator's likelihood and a coin score the grasps of a set."""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from rich.progress import track
from torch import Tensor

from dexzoo.data.batches import GraspDataset
from dexzoo.data.datamodule import GraspDataModule
from dexzoo.data.schema import SPLITS
from dexzoo.grasp import Trajectory
from dexzoo.models.batch import Encoding
from dexzoo.models.encoders import DepthEncoder, fast_bfloat16
from dexzoo.models.evaluator import CHUNK, GraspEvaluator
from dexzoo.models.trunks import trunk_bytes

GM, COIN = "gm", "coin"
"""The rows that every comparison has: the generative model, ranking by its own likelihood, and chance."""
EM2 = "em2"
"""The thesis' evaluator, a reference for the other rows."""
NUM_TIMED = 1000
_REPEATS = 3


@dataclass(frozen=True)
class Labels:
    """Grasps of one source and their outcomes.

    Attributes:
        success: Whether each held, (grasp,).
        scene: Scene of each, from 0, without gaps, (grasp,).
        objects: Names of the objects, (scene,).
        category: Their categories, (scene,).
        log_likelihood: The generator's, nan if it is not known, (grasp,).
    """

    success: NDArray[np.bool_]
    scene: NDArray[np.int64]
    objects: NDArray[Any]
    category: NDArray[Any]
    log_likelihood: NDArray[np.float32]

    @property
    def num_scenes(self) -> int:
        """How many scenes there are."""
        return len(self.category)

    def __getitem__(self, scenes: NDArray[np.int64]) -> Labels:
        """The grasps of some scenes, which are numbered anew."""
        rows = np.isin(self.scene, scenes)
        scene = np.unique(self.scene[rows], return_inverse=True)[1]
        return Labels(self.success[rows], scene, self.objects[scenes], self.category[scenes], self.log_likelihood[rows])


@dataclass(frozen=True)
class Scores:
    """Scores of one row.

    Attributes:
        score: Score that ranks the grasps, best highest, (grasp,).
        threshold: Probability, or else score, above which a grasp is predicted to hold; None if none was chosen.
        probability: Probability of success, (grasp,); None if the row gives none.
    """

    score: NDArray[np.float32]
    threshold: float | None
    probability: NDArray[np.float32] | None

    @property
    def predicted(self) -> NDArray[np.bool_] | None:
        """(grasp,) whether each is predicted to hold."""
        value = self.score if self.probability is None else self.probability
        return None if self.threshold is None else value > self.threshold

    def __getitem__(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Scores:
        """The scores of some grasps."""
        probability = None if self.probability is None else self.probability[rows]
        return Scores(self.score[rows], self.threshold, probability)


@dataclass(frozen=True)
class Cost:
    """Size and speed of a model; an ensemble's members count in all.

    Attributes:
        parameters: Number of trained parameters.
        megabytes: Size of the file that it was read from, or else that `save` would write, without the frozen
            trunk, which models share.
        trunk_megabytes: Size of the trunk as dexzoo keeps it, or else in memory; 0 without one.
        milliseconds_per_view: Time to encode a view, trunk included; best of three.
        milliseconds_per_1000_grasps: Time to score 1,000 grasps on one view; best of three.
        threads: Number of threads.
        processor: Name of the processor, and whether it is fast in bfloat16.
    """

    parameters: int
    megabytes: float
    trunk_megabytes: float
    milliseconds_per_view: float
    milliseconds_per_1000_grasps: float
    threads: int
    processor: str


def read_labels(data: GraspDataModule, split: str, source: str) -> Labels | None:
    """The grasps of a split from one source, in the order of `data.dataset`.

    Args:
        data: The grasp set.
        split: The split.
        source: The source.

    Returns:
        The grasps; None if there are none.
    """
    grasp_set, rows = data.source, data.rows(split, [source]).numpy()
    if not len(rows):
        return None
    shown, scene = np.unique(grasp_set.grasp_scene[rows], return_inverse=True)
    objects, category = (np.array(grasp_set.scenes[name].to_pylist(), str)[shown] for name in ("object", "category"))
    likelihood = np.asarray(grasp_set.grasps["log_likelihood"].to_numpy(), np.float32)
    return Labels(grasp_set.success[rows], scene, objects, category, likelihood[rows])


def first_image(data: GraspDataModule, split: str) -> Float[Tensor, "1 2 224 224"]:
    """Image of the first view of a split.

    Args:
        data: The grasp set.
        split: The split.
    """
    row = int(data.source.grasp_view[data.source.grasp_split == SPLITS.index(split)].min())
    return data.source.images([row])[torch.tensor([0])]


def encoded_views(model: GraspEvaluator, dataset: GraspDataset) -> Iterator[tuple[Tensor, Encoding]]:
    """Encode each view of a dataset once.

    Args:
        model: The model.
        dataset: The grasps.

    Returns:
        For each view the rows of its grasps, and its encoding.
    """
    order = dataset.view.argsort(stable=True)
    views, count = dataset.view[order].unique_consecutive(return_counts=True)
    for view, rows in zip(views.split(1), order.split(count.tolist()), strict=True):
        if isinstance(dataset.views, dict):
            yield rows, {name: value[view].to(model.device) for name, value in dataset.views.items()}
        else:
            yield rows, model.encode(dataset.views[view].to(model.device))


def one_view(grasps: Trajectory) -> Trajectory:
    """Grasps of one view as `GraspEvaluator.logit` takes them.

    Args:
        grasps: Trajectories, (grasp,).

    Returns:
        Trajectories, (1, grasp).
    """
    return Trajectory.stack([grasps])


@torch.no_grad()
def model_scores(model: GraspEvaluator, dataset: GraspDataset, title: str) -> Scores:
    """Log-odds and probabilities of a model on each grasp, without dropout, in the view that the set pairs it with.

    Args:
        model: The model.
        dataset: The grasps.
        title: Title of the progress bar.

    Raises:
        ValueError: The model gives scores that are nan or infinite.
    """
    logit = torch.zeros(len(dataset))
    views = encoded_views(model, dataset)
    num_views = len(dataset.view.unique())
    with model.without_dropout():
        for rows, encoding in track(views, title, num_views, transient=True, disable=not sys.stderr.isatty()):
            logit[rows] = model.logit(encoding, one_view(dataset.aimed(rows).to(model.device)))[0].float().cpu()
    if wrong := int((~logit.isfinite()).sum()):
        raise ValueError(f"{title}: {wrong} of {len(logit)} scores are nan or infinite; the weights are of no use")
    return Scores(logit.numpy(), 0.5, model.probability(logit).numpy())


def likelihood_scores(labels: Labels, validation: Labels | None) -> Scores | None:
    """The generator's log-likelihood, with the threshold that is most accurate on validation grasps.

    A likelihood is no probability of success, so it has no calibration.

    Args:
        labels: The grasps.
        validation: Validation grasps, if there are some.

    Returns:
        The scores; None if likelihoods are not known.
    """
    if np.isnan(labels.log_likelihood).any():
        return None
    threshold = None
    if validation is not None and not np.isnan(validation.log_likelihood).any():
        threshold = best_threshold(validation.log_likelihood, validation.success)
    return Scores(labels.log_likelihood, threshold, None)


def coin_scores(labels: Labels, seed: int) -> Scores:
    """A probability drawn for each grasp, uniformly.

    Args:
        labels: The grasps.
        seed: Seed of the coin.
    """
    probability = np.random.default_rng(seed).random(len(labels.success), np.float32)
    return Scores(probability, 0.5, probability)


def best_threshold(score: NDArray[np.float32], success: NDArray[np.bool_]) -> float:
    """The most accurate threshold; the lowest of equals.

    Args:
        score: Scores, (grasp,).
        success: Whether each held, (grasp,).
    """
    value, place = np.unique(score, return_inverse=True)
    held, failed = (np.bincount(place, kind, minlength=len(value)) for kind in (success, ~success))
    # a threshold below all values gets every success right; each value that it rises to trades successes for failures
    right = held.sum() + np.concatenate(([0], np.cumsum(failed - held)))
    below = np.nextafter(value[0], np.float32(-np.inf))
    return float(np.append(below, value)[right.argmax()])


@torch.no_grad()
def measure(model: GraspEvaluator, image: Float[Tensor, "1 2 224 224"], grasps: Trajectory) -> Cost:
    """Size of a model, and its speed on one view and some grasps, which are repeated up to 1,000.

    Args:
        model: The model.
        image: Image of one view.
        grasps: Grasps, in the frame of its aimed camera.
    """
    image = image.to(model.device)
    grasps = grasps[torch.arange(NUM_TIMED) % len(grasps)].to(model.device)
    with model.without_dropout():
        encoding = model.encode(image)
        view = _best_time(lambda: model.encode(image))
        scoring = _best_time(lambda: [model.logit(encoding, one_view(part)) for part in grasps.split(CHUNK)])
    with tempfile.TemporaryDirectory() as folder:
        size = sum(part.num_bytes or part.save(folder).stat().st_size for part in model.parts)
    trunks = {layer.name for part in model.parts for layer in part.modules() if isinstance(layer, DepthEncoder)}
    return Cost(
        sum(parameter.numel() for part in model.parts for parameter in part.parameters()),
        round(size / 1e6, 1),
        round(sum(map(trunk_bytes, trunks)) / 1e6, 1),
        round(1000 * view, 1),
        round(1000 * scoring, 1),
        torch.get_num_threads(),
        processor(),
    )


def processor() -> str:
    """This machine's, and whether it is fast in bfloat16."""
    name = torch.cpu.get_capabilities()["cpu_name"]
    return f"{name}, {'with' if fast_bfloat16(torch.device('cpu')) else 'without'} fast bfloat16"


def _best_time(work: Callable[[], object]) -> float:
    """Seconds on the clock, the least of a few runs."""
    times = []
    for _ in range(_REPEATS):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)

"""Metrics of evaluators that torchmetrics has not: those within scenes, and calibration with its diagram.

All can be logged by Lightning and joined over processes. Accuracy, the four counts, AUROC and average precision are
torchmetrics' own; the Brier score is its MeanSquaredError of the probabilities.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat


class _Ranking(NamedTuple):
    """Grasps scene by scene, best first. scene: (grasp,) row of its scene; place: 0 is the best of the scene."""

    preds: Float[Tensor, " grasp"]
    target: Float[Tensor, " grasp"]
    scene: Int[Tensor, " grasp"]
    place: Int[Tensor, " grasp"]
    size: Int[Tensor, " scene"]


class SceneMetric(Metric):
    """Base of the metrics that rank the grasps of each scene and average over scenes. A subclass adds `by_scene`.

    `update` takes preds (num_grasps,) scores of any monotonic scale, target (num_grasps,) successes 0 or 1 and indexes
    (num_grasps,) integers that name the scene; grasps of one scene may come in several calls and in any order. Equal
    scores rank in an order that is drawn over all grasps with one fixed seed: by the order in which they come, often
    the generator's, a constant score would be as good as the generator. Scenes without a figure, nan, are left out of
    the average.
    """

    is_differentiable = False
    higher_is_better: bool | None = True
    full_state_update = False
    preds: list[Tensor]
    target: list[Tensor]
    indexes: list[Tensor]

    def __init__(self) -> None:
        super().__init__()
        for name in ("preds", "target", "indexes"):
            self.add_state(name, default=[], dist_reduce_fx="cat")

    def update(self, preds: Tensor, target: Tensor, indexes: Tensor) -> None:
        """Take in scored grasps.

        Args:
            preds: Scores of any monotonic scale, (grasp,).
            target: Successes, 0 or 1, (grasp,).
            indexes: Integers that name the scene, (grasp,).

        Raises:
            ValueError: The shapes differ.
        """
        if not preds.shape == target.shape == indexes.shape:
            raise ValueError(
                f"{type(self).__name__}: preds {tuple(preds.shape)}, target {tuple(target.shape)} and indexes "
                f"{tuple(indexes.shape)} must have one shape"
            )
        self.preds.append(preds.detach().float())
        self.target.append(target.detach().float())
        self.indexes.append(indexes.detach().long())

    def by_scene(self) -> Tensor:
        """The figure, or row of figures, of each scene in the order of their indexes; nan if it has none."""
        raise NotImplementedError

    def compute(self) -> Tensor:
        """The mean over scenes; nan before any update."""
        rate: Tensor = self.by_scene().nanmean(0) if len(self.preds) else torch.tensor(float("nan"))
        return rate

    def _ranked(self) -> _Ranking:
        preds, target, indexes = (dim_zero_cat(state) for state in (self.preds, self.target, self.indexes))
        order = torch.randperm(len(preds), generator=torch.Generator().manual_seed(0)).to(preds.device)
        order = order[preds[order].argsort(descending=True, stable=True)]
        order = order[indexes[order].argsort(stable=True)]
        _, scene, size = indexes[order].unique_consecutive(return_inverse=True, return_counts=True)
        start = size.cumsum(0) - size
        place = torch.arange(len(order), device=size.device) - start[scene]
        return _Ranking(preds[order], target[order], scene, place, size)


class TopKSuccess(SceneMetric):
    """Success rate of the k grasps with the highest score in each scene, averaged over scenes.

    A scene with fewer than k grasps counts with all it has. With k = 1 this is the thesis' "top grasp" figure.

    Args:
        k: Number of best grasps.

    Raises:
        ValueError: k is below 1.

    >>> metric = TopKSuccess(k=1)
    >>> metric.update(torch.tensor([0.9, 0.2, 0.4, 0.6]), torch.tensor([1, 0, 1, 0]), torch.tensor([0, 0, 7, 7]))
    >>> metric.compute()
    tensor(0.5000)
    """

    def __init__(self, k: int = 1) -> None:
        super().__init__()
        if k < 1:
            raise ValueError(f"TopKSuccess: k is {k}, expected at least 1")
        self.k = k

    def by_scene(self) -> Float[Tensor, " scene"]:
        """Success rate of each scene's k best."""
        ranked = self._ranked()
        taken = ranked.place < self.k
        return _sum(ranked.target[taken], ranked.scene[taken], len(ranked.size)) / ranked.size.clamp_max(self.k)


class SuccessByRank(SceneMetric):
    """Success rate of the best tenth of each scene's grasps, of the second, and so on (thesis, Fig. 3.13).

    A scene with fewer grasps than parts has none in some of them, and counts only in the others. `compute` gives
    (num_parts,), best first.

    Args:
        num_parts: Number of parts.

    Raises:
        ValueError: num_parts is below 1.

    >>> metric = SuccessByRank(num_parts=2)
    >>> metric.update(torch.tensor([0.9, 0.8, 0.4, 0.1]), torch.tensor([1, 1, 1, 0]), torch.zeros(4))
    >>> metric.compute()
    tensor([1.0000, 0.5000])
    """

    higher_is_better = None

    def __init__(self, num_parts: int = 10) -> None:
        super().__init__()
        if num_parts < 1:
            raise ValueError(f"SuccessByRank: num_parts is {num_parts}, expected at least 1")
        self.num_parts = num_parts

    def by_scene(self) -> Float[Tensor, "scene part"]:
        """Success rate of each part of each scene's ranking."""
        ranked = self._ranked()
        cell = ranked.scene * self.num_parts + ranked.place * self.num_parts // ranked.size[ranked.scene]
        cells = len(ranked.size) * self.num_parts
        held, count = (_sum(values, cell, cells) for values in (ranked.target, torch.ones_like(ranked.target)))
        return (held / count).reshape(-1, self.num_parts)


class SceneAUROC(SceneMetric):
    """Area under the ROC curve within each scene, averaged over the scenes that have both successes and failures.

    It is the chance that a success ranks above a failure of the same scene, a tie counting half. A planner
    never chooses between scenes. Telling easy scenes from hard ones raises the plain AUROC, but not this.

    >>> metric = SceneAUROC()
    >>> metric.update(torch.tensor([0.9, 0.5, 0.1]), torch.tensor([1, 0, 1]), torch.zeros(3))
    >>> metric.compute()
    tensor(0.5000)
    """

    def by_scene(self) -> Float[Tensor, " scene"]:
        """AUROC of each scene, by the sum of ranks (Mann and Whitney 1947)."""
        ranked = self._ranked()
        scenes = len(ranked.size)
        pairs = torch.stack((ranked.scene.double(), ranked.preds.double()), 1)
        _, tie, count = pairs.unique_consecutive(dim=0, return_inverse=True, return_counts=True)
        rank_from_below = (ranked.size[ranked.scene] - ranked.place).double()
        rank = (_sum(rank_from_below, tie, len(count)) / count)[tie]
        held = ranked.target > 0.5
        successes = _sum(held.double(), ranked.scene, scenes)
        failures = ranked.size - successes
        above = _sum(rank[held], ranked.scene[held], scenes) - successes * (successes + 1) / 2
        return (above / (successes * failures)).float()


class CalibrationError(Metric):
    """Expected calibration error: how far predicted probabilities are from the success rate, on average over grasps.

    Grasps are put into num_bins bins of equal width by their probability; the distance is between each bin's mean
    probability and its success rate (Guo et al. 2017, equation 3). `bins` gives the reliability diagram. torchmetrics'
    BinaryCalibrationError gives the same number without the diagram, and keeps every grasp; this one keeps sums.

    Args:
        num_bins: Number of bins.

    Raises:
        ValueError: num_bins is below 1.

    >>> metric = CalibrationError()
    >>> metric.update(torch.tensor([0.7, 0.7, 0.7, 0.7]), torch.tensor([1, 1, 0, 0]))
    >>> metric.compute()
    tensor(0.2000)
    """

    is_differentiable = False
    higher_is_better = False
    full_state_update = False
    sums: Tensor

    def __init__(self, num_bins: int = 15) -> None:
        super().__init__()
        if num_bins < 1:
            raise ValueError(f"CalibrationError: num_bins is {num_bins}, expected at least 1")
        self.num_bins = num_bins
        self.add_state("sums", default=torch.zeros(num_bins, 3, dtype=torch.float64), dist_reduce_fx="sum")

    def update(self, preds: Tensor, target: Tensor) -> None:
        """Take in predictions.

        Args:
            preds: Probabilities, (grasp,).
            target: Successes, 0 or 1, (grasp,).

        Raises:
            ValueError: The shapes differ, or a probability is outside 0 to 1.
        """
        if preds.shape != target.shape:
            raise ValueError(
                f"CalibrationError: preds {tuple(preds.shape)} and target {tuple(target.shape)} must have one shape"
            )
        columns = torch.stack((torch.ones_like(preds), preds.detach(), target.to(preds)), 1).double()
        self.sums.index_add_(0, bin_index(preds, self.num_bins), columns)

    def compute(self) -> Tensor:
        """The error, a scalar; nan before any update."""
        return expected_calibration_error(self.sums).float()

    def bins(self) -> Float[Tensor, "bin 3"]:
        """Of each bin the number of grasps, their mean probability and success rate, both nan if there are none."""
        return torch.cat((self.sums[:, :1], self.sums[:, 1:] / self.sums[:, :1]), 1)


def bin_index(probability: Tensor, num_bins: int) -> Int[Tensor, " grasp"]:
    """Bin of equal width that each probability falls into.

    Args:
        probability: Probabilities.
        num_bins: Number of bins.

    Raises:
        ValueError: A probability is outside 0 to 1.
    """
    if not bool(((probability >= 0) & (probability <= 1)).all()):
        raise ValueError("probabilities must lie between 0 and 1; give sigmoid(logit)")
    return (probability * num_bins).long().clamp_max(num_bins - 1)


def expected_calibration_error(sums: Float[Tensor, "*batch bin 3"]) -> Float[Tensor, "*batch"]:
    """The error from the sums of each bin; nan if all are empty.

    Args:
        sums: Number of grasps, sum of probability and sum of success of each bin.
    """
    count, probability, success = sums.unbind(-1)
    return (probability - success).abs().sum(-1) / count.sum(-1)


def _sum(values: Tensor, group: Tensor, num_groups: int) -> Tensor:
    return values.new_zeros(num_groups).index_add_(0, group, values)

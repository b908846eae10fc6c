"""Metrics that rank: how good the best-scored grasps of a scene are."""

from __future__ import annotations

import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat


class TopKSuccess(Metric):
    """Success rate of the k grasps with the highest score in each scene, averaged over scenes.

    A scene with fewer than k grasps counts with all it has. With k = 1 this is the thesis' "top grasp" figure.
    `update` takes preds (num_grasps,) scores of any monotonic scale, target (num_grasps,) successes 0 or 1 and indexes
    (num_grasps,) integers that name the scene; grasps of one scene may come in several calls and in any order. Among
    equal scores the one that came first is taken.

    >>> metric = TopKSuccess(k=1)
    >>> metric.update(torch.tensor([0.9, 0.2, 0.4, 0.6]), torch.tensor([1, 0, 1, 0]), torch.tensor([0, 0, 7, 7]))
    >>> metric.compute()
    tensor(0.5000)
    """

    is_differentiable = False
    higher_is_better = True
    full_state_update = False
    preds: list[Tensor]
    target: list[Tensor]
    indexes: list[Tensor]

    def __init__(self, k: int = 1) -> None:
        super().__init__()
        if k < 1:
            raise ValueError(f"TopKSuccess: k is {k}, expected at least 1")
        self.k = k
        for name in ("preds", "target", "indexes"):
            self.add_state(name, default=[], dist_reduce_fx="cat")

    def update(self, preds: Tensor, target: Tensor, indexes: Tensor) -> None:
        """Take in scored grasps; all three of shape (num_grasps,)."""
        if not preds.shape == target.shape == indexes.shape:
            raise ValueError(
                f"TopKSuccess: preds {tuple(preds.shape)}, target {tuple(target.shape)} and indexes "
                f"{tuple(indexes.shape)} must have one shape"
            )
        self.preds.append(preds.detach().float())
        self.target.append(target.detach().float())
        self.indexes.append(indexes.detach().long())

    def compute(self) -> Tensor:
        """The mean over scenes, a scalar; nan before any update."""
        if not self.preds:
            return torch.tensor(float("nan"))
        preds, target, indexes = (dim_zero_cat(state) for state in (self.preds, self.target, self.indexes))
        order = preds.argsort(descending=True, stable=True)
        order = order[indexes[order].argsort(stable=True)]  # scene by scene, best first
        scene, size = indexes[order].unique_consecutive(return_counts=True)
        start = torch.cat((size.new_zeros(1), size.cumsum(0)[:-1]))
        row = torch.repeat_interleave(torch.arange(len(scene), device=size.device), size)
        taken = torch.arange(len(order), device=size.device) - start[row] < self.k
        held = torch.zeros(len(scene), device=target.device).index_add_(0, row[taken], target[order][taken])
        rate: Tensor = (held / size.clamp_max(self.k)).mean()
        return rate

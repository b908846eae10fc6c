"""Batches of grasps with their views: gathered from tensors, drawn balanced, and resumable in mid-epoch."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from dexzoo.data.grasp_set import ViewImages
from dexzoo.grasp import Trajectory
from dexzoo.models.batch import Batch, Encoding


class Draw(NamedTuple):
    """A batch that has been drawn.

    Attributes:
        rows: Rows of the grasps in the dataset.
        views: Row of the view that each is seen in.
    """

    rows: list[int]
    views: list[int]


class GraspDataset(Dataset[Batch]):
    """Whole batches by lists of rows, or by draws: gathers from tensors, no work by row.

    Args:
        grasps: Grasps in the world frame, (grasp,).
        success: 0 or 1, (grasp,).
        scene_index: Scene of each grasp, (grasp,).
        view: Row of the view that each grasp is paired with, (grasp,).
        views: The views, encoded or as images.
        view_scene: Scene that each view shows, (view,).
        T_aimed_world: World frame to the frame of each view's aimed camera, (view, 4, 4).
    """

    def __init__(
        self,
        grasps: Trajectory,
        success: Tensor,
        scene_index: Tensor,
        view: Tensor,
        views: Encoding | ViewImages,
        view_scene: Tensor,
        T_aimed_world: Tensor,
    ) -> None:
        self.grasps, self.success, self.scene_index, self.view = grasps, success, scene_index, view
        self.views, self.view_scene, self.T_aimed_world = views, view_scene, T_aimed_world

    def __len__(self) -> int:
        return len(self.grasps)

    def __getitem__(self, index: list[int] | Draw) -> Batch:
        rows = torch.tensor(index.rows if isinstance(index, Draw) else index)
        view = torch.tensor(index.views) if isinstance(index, Draw) else self.view[rows]
        # a view drawn twice stays twice: with as many grasps for each, all of them are looked at in one go
        unique = Tensor.unique_consecutive if isinstance(index, Draw) else Tensor.unique
        shown, place = unique(view, return_inverse=True)
        views: Encoding | Tensor
        if isinstance(self.views, ViewImages):
            views = self.views[shown]
        else:
            views = {name: value[shown] for name, value in self.views.items()}
        return Batch(views, place, self.aimed(rows, view), self.success[rows], self.scene_index[rows])

    def aimed(self, rows: Tensor, view: Tensor | None = None) -> Trajectory:
        """Grasps in the frames of the aimed cameras of views.

        Args:
            rows: Rows of the dataset, (batch,).
            view: Row of the view of each; by default that which it is paired with.

        Returns:
            Trajectories, (batch,).
        """
        view = self.view[rows] if view is None else view
        return self.grasps[rows].transformed(self.T_aimed_world[view])


class BalancedBatches(Sampler[Draw]):
    """Batches with as many successes as failures, drawn with replacement; continues where it was stopped.

    Each time that a grasp is drawn, it is seen in another view of its scene, any being as likely.
    The batch with number n is a function of the seed and n alone. Each call of `iter` hands out as many batches as
    an epoch has, from number `drawn` on.

    Args:
        dataset: The grasps.
        batch_size: Grasps in a batch, shared among processes.
        grasps_per_view: Grasps of a batch that share a view; scenes are then drawn with their own weights, so that each
            grasp is as likely as it is with 1.
        seed: Seed of the drawing.
        rank: Part of each batch that this process takes.
        world_size: Number of parts.
    """

    def __init__(
        self,
        dataset: GraspDataset,
        batch_size: int,
        grasps_per_view: int = 1,
        seed: int = 0,
        rank: int = 0,
        world_size: int = 1,
    ) -> None:
        success, scene = dataset.success.long(), dataset.scene_index
        share = 1 / torch.bincount(success, minlength=2).double()
        self.order = scene.argsort(stable=True).numpy()  # grasps of a scene stand together
        self.end = share[success].numpy()[self.order].cumsum()
        scenes, count = scene.unique(return_counts=True)
        self.scene_end = self.end[count.numpy().cumsum() - 1]
        self.view_order = dataset.view_scene.argsort(stable=True).numpy()
        sorted_scene = dataset.view_scene.numpy()[self.view_order]
        self.first_view = np.searchsorted(sorted_scene, scenes.numpy())
        self.num_views = np.searchsorted(sorted_scene, scenes.numpy(), side="right") - self.first_view
        self.batch_size, self.grasps_per_view, self.seed = batch_size, grasps_per_view, seed
        self.part = slice(rank * batch_size // world_size, (rank + 1) * batch_size // world_size)
        self.drawn = 0

    def __len__(self) -> int:
        return -(-len(self.order) // self.batch_size)

    def __iter__(self) -> Iterator[Draw]:
        for _ in range(len(self)):
            self.drawn += 1
            yield self.batch(self.drawn - 1)

    def batch(self, number: int) -> Draw:
        """Draw a batch, or this process's part of it.

        Args:
            number: Number of the batch, from 0.
        """
        rng = np.random.default_rng((self.seed, number))
        num_views = -(-self.batch_size // self.grasps_per_view)
        scene = np.searchsorted(self.scene_end, self.end[-1] * rng.random(num_views), side="right")
        view = self.view_order[self.first_view[scene] + rng.integers(self.num_views[scene])]
        low, high = np.append(0.0, self.scene_end)[scene], self.scene_end[scene]
        place = low + (high - low) * rng.random((self.grasps_per_view, num_views))
        rows = self.order[np.searchsorted(self.end[:-1], place.T.ravel(), side="right")]
        views = view.repeat(self.grasps_per_view)
        return Draw(*(part[: self.batch_size][self.part].tolist() for part in (rows, views)))


class ResumableLoader(DataLoader[Batch]):
    """A loader of balanced batches that Lightning's checkpoints can continue in mid-epoch."""

    def state_dict(self) -> dict[str, int]:
        """Number of batches drawn."""
        return {"drawn": self._batches.drawn}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Continue after some batches.

        Args:
            state: As of `state_dict`.
        """
        self._batches.drawn = state["drawn"]

    @property
    def _batches(self) -> BalancedBatches:
        assert isinstance(self.sampler, BalancedBatches)
        return self.sampler

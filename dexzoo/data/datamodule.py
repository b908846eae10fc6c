"""A grasp set as batches."""

from __future__ import annotations

import hashlib
import logging
import os
import sys
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from lightning.pytorch import LightningDataModule
from rich.progress import track
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor
from torch.utils.data import BatchSampler, DataLoader, Dataset, Sampler

from dexzoo.data.grasp_set import GraspSet, ViewImages, user_cache
from dexzoo.data.schema import SOURCES, SPLITS, VERSION
from dexzoo.grasp import transform_waypoints
from dexzoo.models.evaluator import Batch, GraspEvaluator, Scene
from dexzoo.resources import resource

VIEWS_PER_FILE = 64
"""Views that are encoded and cached together; a grown set keeps the files of its old views."""
GRASPS_PER_IMAGE, GRASPS_PER_FEATURES = 8, 4
"""Grasps in a training batch that share a view, where encoding it is part of each step and where it is not."""
STATISTICS_VIEWS = 256
"""Training views that the image statistics are taken from, evenly spaced."""

_log = logging.getLogger(__name__)


class Draw(NamedTuple):
    """Grasps of a dataset, by row, and the views that they are seen in, by row of its views."""

    rows: list[int]
    views: list[int]


class GraspDataset(Dataset[Batch]):
    """Whole batches by lists of rows, or by draws: gathers from tensors, no work by row.

    world_grasps: (num_grasps, 10, 28) waypoints in the world frame. view: (num_grasps,) the row of the view that each
    is paired with. views: encoded, or images. view_scene: (num_views,) the scene that each shows. T_aimed_world:
    (num_views, 4, 4), world frame to the frame of its aimed camera.
    """

    def __init__(
        self,
        world_grasps: Tensor,
        success: Tensor,
        scene_index: Tensor,
        view: Tensor,
        views: Scene | ViewImages,
        view_scene: Tensor,
        T_aimed_world: Tensor,
    ) -> None:
        self.world_grasps, self.success, self.scene_index, self.view = world_grasps, success, scene_index, view
        self.views, self.view_scene, self.T_aimed_world = views, view_scene, T_aimed_world

    def __len__(self) -> int:
        return len(self.world_grasps)

    def __getitem__(self, index: list[int] | Draw) -> Batch:
        rows = torch.tensor(index.rows if isinstance(index, Draw) else index)
        view = torch.tensor(index.views) if isinstance(index, Draw) else self.view[rows]
        # a view drawn twice stays twice: with as many grasps for each, all of them are looked at in one go
        unique = Tensor.unique_consecutive if isinstance(index, Draw) else Tensor.unique
        shown, place = unique(view, return_inverse=True)
        views: Scene | Tensor
        if isinstance(self.views, ViewImages):
            views = self.views[shown]
        else:
            views = {name: value[shown] for name, value in self.views.items()}
        return Batch(views, place, self.aimed(rows, view)[:, None], self.success[rows], self.scene_index[rows])

    def aimed(self, rows: Tensor, view: Tensor | None = None) -> Float[Tensor, "batch 10 28"]:
        """Grasps in the frames of the aimed cameras of views; by default of those that they are paired with."""
        view = self.view[rows] if view is None else view
        return transform_waypoints(self.T_aimed_world[view], self.world_grasps[rows])


class BalancedBatches(Sampler[Draw]):
    """Batches with as many successes as failures, drawn with replacement; goes on where it was stopped.

    Each time that a grasp is drawn, it is seen in another view of its scene, any being as likely.
    The batch with number n is a function of the seed and n alone. Each call of `iter` hands out as many batches as
    an epoch has, from number `drawn` on.

    batch_size: grasps in a batch, shared among processes. grasps_per_view: grasps of a batch that share a view; scenes
    are then drawn with their own weights, so that each grasp is as likely as it is with 1.
    rank, world_size: which part of each batch this process takes, of how many.
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
        """What a batch, or this process's part of it, is made of."""
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
    """A loader of balanced batches that Lightning's checkpoints can take up in mid-epoch."""

    def state_dict(self) -> dict[str, int]:
        """How many batches were drawn."""
        return {"drawn": self._batches.drawn}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Go on after so many batches."""
        self._batches.drawn = state["drawn"]

    @property
    def _batches(self) -> BalancedBatches:
        assert isinstance(self.sampler, BalancedBatches)
        return self.sampler


class GraspDataModule(LightningDataModule):
    """Batches of a grasp set, split by object as the set itself says.

    folder: the set (`dexzoo.data.schema`), a folder or an address such as s3://...; a relative folder is looked up in
    the working folder, then beside the package.
    batch_size: grasps in a batch, over all processes; training draws as many successes as failures, with replacement.
    sources: the grasps that are trained on: generated, perturbed, refined.
    evaluation_sources: those that are validated, tested and predicted; what a user ranks is generated.
    predict_split: the split that `predict` runs over.
    num_scenes: use only the first so many scenes of each split, to try things out.
    train_share: use only this share of the training scenes, the first ones; the other splits stay whole.
    cache: where encoded views are kept; by default the user's cache folder.
    seed: of the drawing.

    Evaluators with a frozen encoder see each view once, ever: its encoding is kept on disk under a name made from the
    view's bytes and from what the encoder makes of a probe image. Raises FileNotFoundError or ValueError where the set
    cannot be read or a split is empty.
    """

    def __init__(
        self,
        folder: str = "assets/grasps",
        batch_size: int = 64,
        sources: list[str] = SOURCES,
        evaluation_sources: list[str] = SOURCES[:1],
        predict_split: str = "test",
        num_scenes: int | None = None,
        train_share: float = 1.0,
        cache: str | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__()
        if predict_split not in SPLITS:
            raise ValueError(f"predict_split {predict_split!r} is unknown; use one of {', '.join(SPLITS)}")
        if batch_size < 1:
            raise ValueError(f"batch_size is {batch_size}, expected at least 1")
        if not 0 < train_share <= 1:
            raise ValueError(f"train_share is {train_share}, expected more than 0 and at most 1")
        for source in (*sources, *evaluation_sources):
            if source not in SOURCES:
                raise ValueError(f"source {source!r} is unknown; use some of {', '.join(SOURCES)}")
        elsewhere = "://" in folder or Path(folder).exists() or not resource(folder).exists()
        self.folder = folder if elsewhere else str(resource(folder))
        self.batch_size, self.predict_split, self.seed = batch_size, predict_split, seed
        self.sources, self.evaluation_sources = sources, evaluation_sources
        self.num_scenes, self.train_share = num_scenes, train_share
        self.cache = Path(cache) if cache else user_cache()

    @cached_property
    def source(self) -> GraspSet:
        """The set, read into memory."""
        return GraspSet(self.folder, self.cache)

    @cached_property
    def waypoints(self) -> Tensor:
        """(num_grasps, 10, 28) all grasps, each in the frame of the aimed camera of its view."""
        return transform_waypoints(self.T_aimed_world[self.source.grasp_view], self.source.world_grasps.waypoints)

    @cached_property
    def T_aimed_world(self) -> Tensor:
        """(num_views, 4, 4) world frame to the frame of each view's aimed camera."""
        T: Tensor = torch.linalg.inv(self.source.camera_poses.double())
        return T.float()

    def setup(self, stage: str) -> None:
        """Before fitting, give the model the statistics of the training data."""
        if stage == "fit":
            self.fit_statistics(self._model)

    def fit_statistics(self, model: GraspEvaluator) -> None:
        """Set the model's standardisation from the training split."""
        rows = self._rows("train", self.sources)
        views = np.unique(self.source.grasp_view[rows])
        views = views[np.linspace(0, len(views) - 1, min(len(views), STATISTICS_VIEWS)).astype(int)]
        images = self.source.images(views.tolist())[torch.arange(len(views))]
        model.fit_statistics(images.to(model.device), self.waypoints[rows].to(model.device))

    def dataset(self, split: str, model: GraspEvaluator, sources: list[str] | None = None) -> GraspDataset:
        """The grasps of a split and all views of their scenes, encoded by the model where its encoder is frozen.

        sources: those that are taken; by default `sources` for training and `evaluation_sources` for the rest.
        """
        if sources is None:
            sources = self.sources if split == "train" else self.evaluation_sources
        rows = self._rows(split, sources)
        scene, view_scene = (torch.from_numpy(array) for array in (self.source.grasp_scene, self.source.view_scene))
        shown = torch.isin(view_scene, scene[rows]).nonzero()[:, 0]
        views = shown.tolist()
        return GraspDataset(
            self.source.world_grasps.waypoints[rows],
            torch.from_numpy(self.source.success).float()[rows],
            scene[rows],
            torch.searchsorted(shown, torch.from_numpy(self.source.grasp_view)[rows]),
            self._encode(views, model) if model.frozen_encoder else self.source.images(views),
            view_scene[shown],
            self.T_aimed_world[shown],
        )

    def loader(self, dataset: GraspDataset, *, balanced: bool = False) -> DataLoader[Batch]:
        """Batches of a dataset, in order, or drawn with as many successes as failures.

        Of several processes each takes its part.
        """
        rank, world_size = (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)
        unused = torch.Generator()  # with none, a loader draws from the global one when it starts
        if not balanced:
            rows = range(rank, len(dataset), world_size)
            batches = BatchSampler(rows, self.batch_size, drop_last=False)
            return DataLoader(dataset, sampler=batches, batch_size=None, generator=unused)
        if not torch.bincount(dataset.success.long(), minlength=2).all():
            raise ValueError(f"grasp set {self.folder}: training needs both successes and failures")
        together = GRASPS_PER_IMAGE if isinstance(dataset.views, ViewImages) else GRASPS_PER_FEATURES
        drawn = BalancedBatches(dataset, self.batch_size, together, self.seed, rank, world_size)
        return ResumableLoader(dataset, sampler=drawn, batch_size=None, generator=unused)

    def train_dataloader(self) -> DataLoader[Batch]:
        """Balanced batches of the training split."""
        return self.loader(self.dataset("train", self._model), balanced=True)

    def val_dataloader(self) -> DataLoader[Batch]:
        """The validation split."""
        return self.loader(self.dataset("validation", self._model))

    def test_dataloader(self) -> DataLoader[Batch]:
        """The test split: objects that neither training nor selection has seen."""
        return self.loader(self.dataset("test", self._model))

    def predict_dataloader(self) -> DataLoader[Batch]:
        """The split named `predict_split`."""
        return self.loader(self.dataset(self.predict_split, self._model))

    def describe(self) -> dict[str, str | int]:
        """What a model card says of the data: format version, number of training grasps, hash of the tables."""
        count = len(self._rows("train", self.sources))
        return {"version": VERSION, "train_grasps": count, "sha256": self.source.sha256}

    @property
    def _model(self) -> GraspEvaluator:
        model = self.trainer.lightning_module if self.trainer else None
        if not isinstance(model, GraspEvaluator):
            raise ValueError(
                "GraspDataModule needs a Trainer with a GraspEvaluator; without, use dataset() and loader()"
            )
        return model

    def rows(self, split: str, sources: list[str]) -> Tensor:
        """Rows (n,) of the table of grasps that a split has from these sources, in the order of `dataset`."""
        chosen = (self.source.grasp_split == SPLITS.index(split)) & np.isin(self.source.source, sources)
        rows = np.flatnonzero(chosen)
        scene = self.source.grasp_scene[rows]
        scenes = np.unique(scene)[: self.num_scenes]
        if split == "train":
            scenes = scenes[: max(1, round(self.train_share * len(scenes)))]
        return torch.from_numpy(rows[np.isin(scene, scenes)])

    def _rows(self, split: str, sources: list[str]) -> Tensor:
        rows = self.rows(split, sources)
        if not len(rows):
            what = f"no {' or '.join(sources)} grasps in its {split} split"
            raise ValueError(f"grasp set {self.folder} has {what}; collect more objects")
        return rows

    def _encode(self, rows: list[int], model: GraspEvaluator) -> Scene:
        """The encoded views of some rows of the table of views, float16, from the cache where it has them."""
        folder = self.cache / "views" / _fingerprint(model)
        starts = range(0, len(rows), VIEWS_PER_FILE)
        parts = []
        for start in track(starts, "encoding views", transient=True, disable=not sys.stderr.isatty()):
            parts.append(self._encode_part(rows[start : start + VIEWS_PER_FILE], model, folder))
        return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}

    def _encode_part(self, rows: list[int], model: GraspEvaluator, folder: Path) -> Scene:
        digest = hashlib.sha256()
        for depth in self.source.depth(rows):
            digest.update(depth)
        digest.update(self.source.tables[rows].numpy().tobytes())
        path = folder / f"{digest.hexdigest()[:32]}.safetensors"
        try:
            return load_file(path)
        except FileNotFoundError:
            pass
        except SafetensorError:
            _log.warning("cached views %s cannot be read; encoding them again", path)
        images = self.source.images(rows)[torch.arange(len(rows))]
        with torch.no_grad():
            encoded = [model.encode(part.to(model.device)) for part in images.split(16)]
        scene = {name: torch.cat([part[name] for part in encoded]).cpu().half() for name in encoded[0]}
        folder.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f".{path.name}.{os.getpid()}")
        save_file(scene, temporary)
        temporary.rename(path)
        return scene


def _fingerprint(model: GraspEvaluator) -> str:
    """A name for an encoder that changes with its weights, its statistics and its code."""
    row, column = torch.meshgrid(torch.arange(224.0), torch.arange(224.0), indexing="ij")
    bump = 70**2 - (row - 112) ** 2 - (column - 112) ** 2
    probe = torch.stack((0.6 - bump.clamp_min(0).sqrt() / 1000, 0.1 + row / 2000)) * (bump > 0)
    with torch.no_grad():
        encoded = model.encode(probe[None].to(model.device))
    digest = hashlib.sha256(model.architecture.encode())
    for name, value in sorted(encoded.items()):
        digest.update(name.encode() + value.cpu().contiguous().numpy().tobytes())
    return f"{model.architecture}-{digest.hexdigest()[:16]}"

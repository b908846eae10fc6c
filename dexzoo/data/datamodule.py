"""A grasp set as batches."""

from __future__ import annotations

import hashlib
import logging
import os
import sys
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from lightning.pytorch import LightningDataModule
from rich.progress import track
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor
from torch.utils.data import BatchSampler, DataLoader

from dexzoo.data.batches import BalancedBatches, GraspDataset, ResumableLoader
from dexzoo.data.grasp_set import GraspSet, Renderer, ViewImages
from dexzoo.data.schema import SOURCES, SPLITS, VERSION
from dexzoo.grasp import Trajectory
from dexzoo.models.batch import Batch, Encoding
from dexzoo.models.evaluator import GraspEvaluator
from dexzoo.resources import resource, user_cache

VIEWS_PER_FILE = 64
"""Views that are encoded and cached together; a grown set keeps the files of its old views."""
GRASPS_PER_IMAGE, GRASPS_PER_FEATURES = 8, 4
"""Grasps in a training batch that share a view: if each step encodes it, and if encodings are kept."""
STATISTICS_VIEWS = 256
"""Training views that the image statistics are taken from, evenly spaced."""

_log = logging.getLogger(__name__)


class GraspDataModule(LightningDataModule):
    """Batches of a grasp set, split by object as the set itself says.

    Evaluators with a frozen encoder see each view once, ever: its encoding is kept on disk under a name made from the
    view's bytes and from the encoding of a probe image.

    Args:
        folder: The set (`dexzoo.data.schema`), a folder or an address such as s3://...; a relative folder is looked up
            in the working folder, then beside the package.
        batch_size: Grasps in a batch, over all processes; training draws as many successes as failures, with
            replacement.
        sources: Grasps that are trained on: generated, perturbed, refined.
        evaluation_sources: Grasps that are validated, tested and predicted; a user ranks generated ones.
        predict_split: Split that `predict` runs over.
        num_scenes: Use only the first so many scenes of each split, to try things out.
        train_share: Use only this share of the training scenes, the first ones; the other splits stay whole.
        cache: Folder of encoded views; by default the user's cache folder.
        seed: Seed of the drawing.

    Attributes:
        renderer: Renders views that the set keeps no image of, see `GraspSet`; set it before the set is first used.

    Raises:
        FileNotFoundError: The set cannot be found.
        ValueError: The set cannot be read, a split is empty, or an argument cannot be.
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
        self.renderer: Renderer | None = None
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
        return GraspSet(self.folder, self.cache, self.renderer)

    @cached_property
    def aimed_grasps(self) -> Trajectory:
        """All grasps, each in the frame of the aimed camera of its view."""
        return self.source.world_grasps.trajectory.transformed(self.T_aimed_world[self.source.grasp_view])

    @cached_property
    def T_aimed_world(self) -> Tensor:
        """(num_views, 4, 4) world frame to the frame of each view's aimed camera."""
        T: Tensor = torch.linalg.inv(self.source.camera_poses.double())
        return T.float()

    def setup(self, stage: str) -> None:
        """Before fitting, give the model the statistics of the training data.

        Args:
            stage: Stage of the trainer.
        """
        if stage == "fit":
            self.fit_statistics(self._model)

    def fit_statistics(self, model: GraspEvaluator) -> None:
        """Set the model's standardization from the training split.

        Args:
            model: The model.
        """
        rows = self._rows("train", self.sources)
        views = np.unique(self.source.grasp_view[rows])
        views = views[np.linspace(0, len(views) - 1, min(len(views), STATISTICS_VIEWS)).astype(int)]
        images = self.source.images(views.tolist())[torch.arange(len(views))]
        model.fit_statistics(images.to(model.device), self.aimed_grasps[rows].to(model.device))

    def dataset(self, split: str, model: GraspEvaluator, sources: list[str] | None = None) -> GraspDataset:
        """The grasps of a split and all views of their scenes, encoded by the model if its encoder is frozen.

        Args:
            split: train, validation or test.
            model: The model.
            sources: Sources that are taken; by default `sources` for training and `evaluation_sources` for the rest.

        Raises:
            ValueError: There are no such grasps, or the model does not know their hand.
        """
        model.check_hand(self.source.hand)
        if sources is None:
            sources = self.sources if split == "train" else self.evaluation_sources
        rows = self._rows(split, sources)
        scene, view_scene = (torch.from_numpy(array) for array in (self.source.grasp_scene, self.source.view_scene))
        shown = torch.isin(view_scene, scene[rows]).nonzero()[:, 0]
        views = shown.tolist()
        return GraspDataset(
            self.source.world_grasps.trajectory[rows],
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

        Args:
            dataset: The grasps.
            balanced: Whether they are drawn.

        Raises:
            ValueError: They are to be drawn, and have one outcome only.
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
        """Entries of a model card about the data: format version, number of training grasps, hash of the tables."""
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
        """Rows of the table of grasps that a split has from some sources, in the order of `dataset`, (grasp,).

        Args:
            split: train, validation or test.
            sources: The sources.
        """
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

    def _encode(self, rows: list[int], model: GraspEvaluator) -> Encoding:
        """The encoded views of some rows of the table of views, float16, from the cache if it has them."""
        folder = self.cache / "views" / _fingerprint(model)
        starts = range(0, len(rows), VIEWS_PER_FILE)
        parts = []
        for start in track(starts, "encoding views", transient=True, disable=not sys.stderr.isatty()):
            parts.append(self._encode_part(rows[start : start + VIEWS_PER_FILE], model, folder))
        return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}

    def _encode_part(self, rows: list[int], model: GraspEvaluator, folder: Path) -> Encoding:
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
        encoding = {name: torch.cat([part[name] for part in encoded]).cpu().half() for name in encoded[0]}
        folder.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f".{path.name}.{os.getpid()}")
        save_file(encoding, temporary)
        temporary.rename(path)
        return encoding


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

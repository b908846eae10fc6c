"""Reading a grasp set, from a folder or from any address that fsspec knows."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from rich.progress import track
from torch import Tensor

from dexzoo.data.schema import (
    DEPTH_UNIT,
    SCHEMAS,
    SPLITS,
    VERSION,
    decode_depth,
    decode_path,
    decode_view,
)
from dexzoo.data.writer import MANIFEST, read_manifest
from dexzoo.grasp import Grasps
from dexzoo.hand import Hand, HandSpec
from dexzoo.perception.camera import Camera
from dexzoo.perception.observation import Observation
from dexzoo.resources import user_cache

Renderer = Callable[[dict[str, Any], list[int], Path], list[bytes]]
"""Gives the depth PNGs of views: row of the table of scenes, seeds of the views, cache folder."""
_READERS = 8
_VIEWS = 1000  # more than a scene has


class GraspSet:
    """A grasp set read into memory.

    Args:
        address: A folder, or s3://..., hf://... and the like, with the package that fsspec asks for.
        cache: Folder for views without images once they are rendered; by default in the user's cache folder.
        renderer: Renders views that the set keeps no image of, such as `dexzoo.collection.rendering.render`; without
            it, asking for such a view is an error.

    Attributes:
        scenes: Table of scenes, as `dexzoo.data.schema` says; scenes that were skipped are left out.
        views: Table of views.
        grasps: Table of grasps.
        hand: The hand of the grasps.
        sha256: Checksum of all that was read.
        grasp_scene: Row in `scenes` of each grasp's scene, (grasp,).
        grasp_view: Row in `views` of the view that each grasp is paired with, (grasp,).
        grasp_split: Index into `SPLITS`, (grasp,).
        view_scene: Row in `scenes` of each view's scene, (view,).
        success: Whether each grasp held, (grasp,).
        source: Where each grasp comes from, (grasp,).

    Raises:
        FileNotFoundError: A file is missing.
        ValueError: A file is damaged, or the set is of a hand that is not in robots/.
        RuntimeError: The address cannot be reached.
    """

    def __init__(self, address: str | Path, cache: Path | None = None, renderer: Renderer | None = None) -> None:
        self.address = str(address)
        self.cache = (cache or user_cache()) / "renders"
        self.renderer = renderer
        files = _Files(self.address)
        scenes, self.views, self.grasps = (files.read(name) for name in ("scenes", "views", "grasps"))
        self.sha256 = files.digest.hexdigest()
        if files.hand not in HandSpec.known():
            raise ValueError(f"{self.address} is of a hand {files.hand!r}, which is not in robots/")
        self.hand = Hand.load(files.hand)
        self.scenes = scenes.filter(pc.is_null(scenes["skipped"]))
        number = _column(self.scenes, "scene")
        self.view_scene = _find(number, _column(self.views, "scene"), f"{self.address}/views name scene")
        self.grasp_scene = _find(number, _column(self.grasps, "scene"), f"{self.address}/grasps name scene")
        self.grasp_view = _find(
            _VIEWS * self.view_scene + _column(self.views, "view"),
            _VIEWS * self.grasp_scene + _column(self.grasps, "view"),
            f"{self.address}/grasps name {_VIEWS} x scene + view",
        )
        names = self.scenes["split"].to_pylist()
        if strange := set(names) - set(SPLITS):
            raise ValueError(f"{self.address}/scenes has the split {strange.pop()!r}; use {', '.join(SPLITS)}")
        self.grasp_split = np.array([SPLITS.index(name) for name in names], np.int64)[self.grasp_scene]
        self.success = np.asarray(self.grasps["success"].to_numpy(), bool)
        self.source = np.array(self.grasps["source"].to_pylist(), str)

    @cached_property
    def paths(self) -> NDArray[np.float32]:
        """(num_grasps, 66) column path."""
        flat = self.grasps["path"].combine_chunks().flatten().to_numpy()
        return np.array(flat, np.float32).reshape(len(self.grasps), -1)

    @cached_property
    def world_grasps(self) -> Grasps:
        """All grasps in the world frame, in the order of the table; log_likelihood is NaN if unknown."""
        types = torch.tensor(self.grasps["grasp_type"].to_numpy())
        grasps = decode_path(self.paths, types, self.hand)
        likelihood = torch.tensor(np.asarray(self.grasps["log_likelihood"].to_numpy(), np.float32))
        return Grasps.of(grasps.trajectory, self.hand, likelihood)

    @cached_property
    def camera_poses(self) -> Float[Tensor, "view 4 4"]:
        """T_world_camera of each view's aimed camera."""
        return torch.tensor(_lists(self.views, "T_world_camera", 16).reshape(-1, 4, 4), dtype=torch.float32)

    @cached_property
    def tables(self) -> Float[Tensor, "view 4"]:
        """The plane of each view's table in the frame of its aimed camera."""
        return torch.tensor(_lists(self.views, "table", 4), dtype=torch.float32)

    def depth(self, views: Sequence[int]) -> list[bytes]:
        """The depth of some views as 16-bit PNGs, rendered if the set keeps none.

        Args:
            views: Rows of `views`.

        Raises:
            ValueError: A view has neither depth nor seed, or must be rendered and there is no renderer.
        """
        known = self.views["depth"].take(pa.array(views, pa.int64())).to_pylist()
        missing = np.array([view for view, png in zip(views, known, strict=True) if png is None], np.int64)
        rendered: dict[int, bytes] = {}
        scenes = np.unique(self.view_scene[missing])
        for scene in track(scenes, "rendering views", transient=True, disable=not sys.stderr.isatty()):
            # all views of the scene, which share a file in the cache
            rows = np.flatnonzero(self.view_scene == scene)
            seeds = self.views["seed"].take(pa.array(rows)).to_pylist()
            if None in seeds:
                raise ValueError(f"{self.address}/views has neither depth nor seed for scene {scene}")
            if self.renderer is None:
                raise ValueError(f"{self.address} keeps no images; open it with a renderer, see GraspSet")
            images = self.renderer(self.scenes.slice(scene, 1).to_pylist()[0], seeds, self.cache)
            rendered |= dict(zip(rows.tolist(), images, strict=True))
        return [rendered[view] if png is None else png for view, png in zip(views, known, strict=True)]

    def observation(self, view: int) -> Observation:
        """The aimed observation of a view.

        Args:
            view: Row of `views`.
        """
        return decode_view(self.views.slice(view, 1).to_pylist()[0], self.depth([view])[0])

    def images(self, views: Sequence[int]) -> ViewImages:
        """The images of some views, held in memory.

        Args:
            views: Rows of `views`.
        """
        depth = [decode_depth(png, f"view {view}") for view, png in zip(views, self.depth(views), strict=True)]
        return ViewImages(torch.from_numpy(np.stack(depth)), self.tables[torch.tensor(views)])


class ViewImages:
    """Depth images of aimed views, from which evaluators' images are made on demand.

    Args:
        depth: Depth in units of 0.1 mm, uint16, (view, 224, 224).
        table: Plane of each view's table.
    """

    def __init__(self, depth: Tensor, table: Float[Tensor, "view 4"]) -> None:
        self.depth, self.table = depth, table
        self._rays = torch.tensor(Camera.aimed().directions(), dtype=torch.float32)

    def __getitem__(self, views: Tensor) -> Float[Tensor, "view 2 224 224"]:
        """`Observation.image()` of each: depth and height over the table in meters, 0 where the object is not."""
        depth = self.depth[views].int().float() * DEPTH_UNIT
        normal, offset = self.table[views, :3], self.table[views, 3]
        height = depth * (self._rays @ normal.T).permute(2, 0, 1) + offset[:, None, None]
        return torch.stack((depth, torch.where(depth > 0, height, 0.0)), 1)


class _Files:
    """The files of a set, as its manifest names them, or all that are there if it has none; and the set's hand."""

    def __init__(self, address: str) -> None:
        self.address = address
        self.digest = hashlib.sha256()
        self.hand = "dlr2"
        try:
            self.system, self.root = fsspec.core.url_to_fs(address)
            self.names = self._list()
        except (FileNotFoundError, ValueError):
            raise
        except ImportError as error:
            raise RuntimeError(f"grasp set {address}: {error}") from None
        except Exception as error:  # each file system raises its own
            raise RuntimeError(f"grasp set {address} cannot be reached: {error}") from None

    def _list(self) -> dict[str, str | None]:
        """Paths of the files below the root, with their checksums where a manifest has them."""
        path = f"{self.root}/{MANIFEST}"
        if self.system.isfile(path):
            manifest = read_manifest(self.system.cat_file(path), f"{self.address}/{MANIFEST}")
            self.hand = manifest["configuration"].get("hand", self.hand)
            return {name: file["sha256"] for name, file in manifest["files"].items()}
        found = [path for name in SCHEMAS for path in self.system.glob(f"{self.root}/{name}/*.parquet")]
        names = ["/".join(path.split("/")[-2:]) for path in sorted(found)]
        return {name: None for name in names if "/." not in name}

    def read(self, table: str) -> pa.Table:
        """All files of a table.

        Args:
            table: Name of the table.
        """
        names = [name for name in self.names if name.startswith(f"{table}/")]
        if not names:
            raise FileNotFoundError(f"grasp set {self.address} has no {table}/*.parquet")
        with ThreadPoolExecutor(_READERS) as pool:
            parts = list(pool.map(self._read_file, names))
        for _, sha256 in parts:
            self.digest.update(sha256.encode())
        return pa.concat_tables([part for part, _ in parts])

    def _read_file(self, name: str) -> tuple[pa.Table, str]:
        where = f"{self.address}/{name}"
        try:
            content = self.system.cat_file(f"{self.root}/{name}")
        except FileNotFoundError:
            raise FileNotFoundError(f"{where}, which the manifest names, is not there; fetch it again") from None
        sha256 = hashlib.sha256(content).hexdigest()
        if self.names[name] not in (None, sha256):
            raise ValueError(f"{where} differs from its checksum in {MANIFEST}; fetch or make it again")
        try:
            part = pq.read_table(pa.BufferReader(content))
        except (pa.ArrowInvalid, OSError) as error:
            raise ValueError(f"{where} cannot be read as Parquet: {error}") from None
        schema = SCHEMAS[name.split("/")[0]]
        if not part.schema.equals(schema):
            raise ValueError(f"{where} has the columns {', '.join(part.schema.names)}; expected version {VERSION}'s")
        return part, sha256


def _column(table: pa.Table, name: str) -> NDArray[np.int64]:
    return np.asarray(table[name].to_numpy(), np.int64)


def _lists(table: pa.Table, name: str, size: int) -> NDArray[np.float64]:
    return np.array(table[name].combine_chunks().flatten().to_numpy(), np.float64).reshape(-1, size)


def _find(keys: NDArray[np.int64], wanted: NDArray[np.int64], where: str) -> NDArray[np.int64]:
    """Positions of the wanted among the keys; ValueError for one that is not there."""
    order = np.argsort(keys, kind="stable")
    place = np.searchsorted(keys, wanted, sorter=order)
    found = order[np.minimum(place, len(keys) - 1)] if len(keys) else np.zeros(len(wanted), np.int64)
    wrong = keys[found] != wanted if len(keys) else np.ones(len(wanted), bool)
    if wrong.any():
        raise ValueError(f"{where} {wanted[wrong][0]}, which is not there")
    return np.asarray(found)

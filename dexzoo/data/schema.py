"""A grasp set on disk: three Parquet tables in one folder, version 1.

scenes.parquet  one row a scene: scene, object, category, split (train, validation, test; by object), mass (kg),
                friction, scale, seed, T_world_object (16 numbers, row by row).
views.parquet   one row a view: scene, view, T_world_camera (16) of the aimed 224 x 224 camera of f = 279.5,
                depth (16-bit PNG of the object's pixels, 0.1 mm a unit, 0 elsewhere).
grasps.parquet  one row a grasp: scene, view (the one it is paired with), grasp_type, source (generated, perturbed,
                refined), log_likelihood (NaN where not generated), path (3 x 22: wrist position, quaternion wxyz and
                free joints at pre-grasp, grip and squeeze, world frame), success, collided, unstable, shift (m) and
                rotation (rad) of the object in the hand while lifted.
Each scene is first written to a folder of its own, whole or not at all; `merge` makes the tables of them.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from dexzoo.camera import IMAGE_SIZE, Camera, Observation
from dexzoo.grasp import GRIP, PREGRASP, SQUEEZE, Grasps
from dexzoo.hand import Hand, default_hand

VERSION = "1"
DEPTH_UNIT = 1e-4
TABLES = ("scenes", "views", "grasps")
SPLITS = ("train", "validation", "test")

_POSE = pa.list_(pa.float64(), 16)
SCHEMAS = {
    "scenes": pa.schema(
        [
            ("scene", pa.int32()),
            ("object", pa.string()),
            ("category", pa.string()),
            ("split", pa.string()),
            ("mass", pa.float32()),
            ("friction", pa.float32()),
            ("scale", pa.float32()),
            ("seed", pa.int64()),
            ("T_world_object", _POSE),
        ],
        metadata={"dexzoo.grasp_set": VERSION},
    ),
    "views": pa.schema(
        [("scene", pa.int32()), ("view", pa.int16()), ("T_world_camera", _POSE), ("depth", pa.binary())],
        metadata={"dexzoo.grasp_set": VERSION},
    ),
    "grasps": pa.schema(
        [
            ("scene", pa.int32()),
            ("view", pa.int16()),
            ("grasp_type", pa.int8()),
            ("source", pa.string()),
            ("log_likelihood", pa.float32()),
            ("path", pa.list_(pa.float32(), 66)),
            ("success", pa.bool_()),
            ("collided", pa.bool_()),
            ("unstable", pa.bool_()),
            ("shift", pa.float32()),
            ("rotation", pa.float32()),
        ],
        metadata={"dexzoo.grasp_set": VERSION},
    ),
}


def encode_view(observation: Observation) -> dict[str, Any]:
    """The columns T_world_camera and depth of an aimed observation."""
    depth = np.where(observation.mask, observation.depth, 0)
    done, png = cv2.imencode(".png", np.round(depth / DEPTH_UNIT).astype(np.uint16), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not done:
        raise OSError("a depth image could not be encoded as PNG")
    return {"T_world_camera": observation.T_world_camera.reshape(-1).tolist(), "depth": png.tobytes()}


def decode_view(row: dict[str, Any]) -> Observation:
    """The aimed observation of a row of views.parquet."""
    image = cv2.imdecode(np.frombuffer(row["depth"], np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.shape != (IMAGE_SIZE, IMAGE_SIZE):
        raise ValueError(f"the depth of scene {row['scene']}, view {row['view']} is no {IMAGE_SIZE} x {IMAGE_SIZE} PNG")
    depth = image.astype(np.float32) * np.float32(DEPTH_UNIT)
    pose = np.array(row["T_world_camera"], np.float64).reshape(4, 4)
    return Observation(depth, Camera.aimed(), pose, mask=depth > 0)


def encode_path(grasps: Grasps, hand: Hand) -> NDArray[np.float32]:
    """(num_grasps, 66) column path of grasps in the world frame."""
    key = grasps.waypoints[:, [PREGRASP, GRIP, SQUEEZE]]
    return torch.cat((key[..., :7], hand.reduce(key[..., 7:27])), -1).flatten(1).numpy().astype(np.float32)


def decode_path(path: Float[Tensor, "grasp 66"], grasp_type: Tensor, hand: Hand) -> Grasps:
    """The grasps, in the world frame, of a column path."""
    key = path.unflatten(-1, (3, 22))
    return Grasps.from_keyframes(key[..., :3], key[..., 3:7], hand.expand(key[..., 7:]), grasp_type, "world")


def write_scene(folder: Path, scene: dict[str, Any], views: Sequence[dict[str, Any]], grasps: pa.Table) -> None:
    """Write one scene to folder/scene_NNNNNN whole or not at all: a temporary name, then a rename."""
    final = folder / f"scene_{scene['scene']:06d}"
    temporary = folder / f".{final.name}.{os.getpid()}"
    temporary.mkdir(parents=True)
    try:
        rows = {
            "scenes": pa.Table.from_pylist([scene], SCHEMAS["scenes"]),
            "views": pa.Table.from_pylist(list(views), SCHEMAS["views"]),
            "grasps": grasps.cast(SCHEMAS["grasps"]),
        }
        for name, table in rows.items():
            pq.write_table(table, temporary / f"{name}.parquet", compression="zstd")
        temporary.rename(final)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def merge(folder: Path, out: Path) -> None:
    """Make the three tables in `out` of the scenes written below `folder`, ordered by scene."""
    scenes = sorted(folder.glob("scene_*"))
    if not scenes:
        raise ValueError(f"{folder} holds no scene; run collect first")
    tables = {name: pa.concat_tables([_read(scene, name) for scene in scenes]) for name in TABLES}
    out.mkdir(parents=True, exist_ok=True)
    for name, table in tables.items():
        temporary = out / f".{name}.parquet"
        pq.write_table(table, temporary, compression="zstd", use_byte_stream_split=False)
        temporary.rename(out / f"{name}.parquet")


def _read(folder: Path, name: str) -> pa.Table:
    path = folder / f"{name}.parquet"
    if not path.is_file():
        raise FileNotFoundError(f"grasp set {folder} has no {name}.parquet")
    try:
        table = pq.read_table(path)
    except (pa.ArrowInvalid, OSError) as error:
        raise ValueError(f"{path} cannot be read as Parquet: {error}") from None
    if table.schema.names != SCHEMAS[name].names:
        raise ValueError(f"{path} has the columns {', '.join(table.schema.names)}; expected version {VERSION}'s")
    return table


class GraspSet:
    """A grasp set read into memory.

    scenes, views, grasps: the three pyarrow tables.
    grasp_view: (num_grasps,) row in `views` of the view each grasp is paired with.
    grasp_split: (num_grasps,) index into SPLITS.

    Raises FileNotFoundError or ValueError that names the file at fault.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.scenes, self.views, self.grasps = (_read(self.folder, name) for name in TABLES)
        scene_row = {scene: row for row, scene in enumerate(self.scenes["scene"].to_pylist())}
        view_row = {
            key: row
            for row, key in enumerate(zip(self.views["scene"].to_pylist(), self.views["view"].to_pylist(), strict=True))
        }
        pairs = zip(self.grasps["scene"].to_pylist(), self.grasps["view"].to_pylist(), strict=True)
        try:
            self.grasp_view = np.array([view_row[pair] for pair in pairs], np.int64)
            self.grasp_scene = np.array([scene_row[scene] for scene in self.grasps["scene"].to_pylist()], np.int64)
        except KeyError as error:
            raise ValueError(
                f"{self.folder / 'grasps.parquet'} names scene or view {error}, which is not there"
            ) from None
        names = self.scenes["split"].to_pylist()
        if strange := set(names) - set(SPLITS):
            raise ValueError(
                f"{self.folder / 'scenes.parquet'} has the split {strange.pop()!r}; use {', '.join(SPLITS)}"
            )
        split = np.array([SPLITS.index(name) for name in names], np.int64)
        self.grasp_split = split[self.grasp_scene]
        self.view_split = split[[scene_row[scene] for scene in self.views["scene"].to_pylist()]]
        self.success = self.grasps["success"].to_numpy(zero_copy_only=False)
        self.source = np.array(self.grasps["source"].to_pylist())

    @cached_property
    def world_grasps(self) -> Grasps:
        """All grasps in the world frame, in the order of grasps.parquet."""
        path = np.array(self.grasps["path"].combine_chunks().flatten().to_numpy(zero_copy_only=False)).reshape(-1, 66)
        likelihood = np.array(self.grasps["log_likelihood"].to_numpy(zero_copy_only=False))
        types = torch.tensor(np.array(self.grasps["grasp_type"].to_numpy(zero_copy_only=False)))
        grasps = decode_path(torch.tensor(path), types, default_hand())
        return Grasps(grasps.waypoints, "world", torch.tensor(likelihood))

    @cached_property
    def camera_poses(self) -> Float[Tensor, "view 4 4"]:
        """T_world_camera of each view."""
        poses = np.array(self.views["T_world_camera"].combine_chunks().flatten()).reshape(-1, 4, 4)
        return torch.tensor(poses, dtype=torch.float32)

    def observation(self, view: int) -> Observation:
        """The aimed observation of a row of `views`."""
        return decode_view(self.views.slice(view, 1).to_pylist()[0])

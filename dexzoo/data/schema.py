"""The format of a grasp set, version 2: four tables of Parquet files, and how grasps and views become numbers.

FOLDER/objects/*.parquet, scenes/*.parquet, views/*.parquet, grasps/*.parquet: a table is all files of its folder, so
that `pandas.read_parquet("FOLDER/grasps")` or DuckDB's `SELECT * FROM 'FOLDER/grasps/*.parquet'` read it whole.
manifest.json: version, configuration, counts, and the checksum of each file.

objects  object (its name), category, split (train, validation or test: by object), mass_min, mass_max (kg).
scenes   one row for each scene that was tried: scene (number), object, category, split, scale, mass (kg), friction,
         T_world_object (16 numbers, row by row), support_half (3, meters) and support_yaw (rad) of the block that the
         object lies on, if any, seed (of the set), trials (behind success_rate), generated and held (how many grasps
         were generated, and how many of them held), skipped (why the scene has no views and grasps, or null).
views    scene, view (the generator saw number 0), seed (of the drawn camera and the sensor's noise), T_world_camera
         (16) of the aimed camera, width, height, fx, fy, cx, cy (pixels), table (4: plane in the camera frame), depth
         (16-bit PNG of the object's pixels, 0.1 mm a unit, 0 elsewhere; null if it is rendered again).
grasps   scene, view (the one it is paired with, drawn among the scene's), grasp_type (0 to 9), source (generated,
         perturbed or refined), rank (place in the generator's order from 0; a neighbor has that of the grasp it was
         made from), log_likelihood (null where not generated), path (3 x 22: wrist position, quaternion wxyz and free
         joints at pre-grasp, grip and squeeze, world frame), and the outcome, as in `dexzoo.sim.Outcomes`
         with null for NaN; success_rate is null where the grasp was tried once.

Frames, joint order and units: docstring of `dexzoo.grasp`.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import torch
from numpy.typing import NDArray
from torch import Tensor

from dexzoo.grasp import KEYFRAMES, Grasps, Trajectory
from dexzoo.hand import Hand
from dexzoo.perception.camera import IMAGE_SIZE, Camera
from dexzoo.perception.observation import Observation

VERSION = "2"
DEPTH_UNIT = 1e-4
SPLITS = ("train", "validation", "test")
SOURCES = ["generated", "perturbed", "refined"]
PATH_SIZE = 66
_AIMED = Camera.aimed()

_POSE = pa.list_(pa.float64(), 16)
_FIELDS: dict[str, list[tuple[str, pa.DataType]]] = {
    "objects": [
        ("object", pa.string()),
        ("category", pa.string()),
        ("split", pa.string()),
        ("mass_min", pa.float64()),
        ("mass_max", pa.float64()),
    ],
    "scenes": [
        ("scene", pa.int32()),
        ("object", pa.string()),
        ("category", pa.string()),
        ("split", pa.string()),
        ("scale", pa.float64()),
        ("mass", pa.float64()),
        ("friction", pa.float64()),
        ("T_world_object", _POSE),
        ("support_half", pa.list_(pa.float64(), 3)),
        ("support_yaw", pa.float64()),
        ("seed", pa.int64()),
        ("trials", pa.int16()),
        ("generated", pa.int16()),
        ("held", pa.int16()),
        ("skipped", pa.string()),
    ],
    "views": [
        ("scene", pa.int32()),
        ("view", pa.int16()),
        ("seed", pa.int64()),
        ("T_world_camera", _POSE),
        ("width", pa.int16()),
        ("height", pa.int16()),
        ("fx", pa.float64()),
        ("fy", pa.float64()),
        ("cx", pa.float64()),
        ("cy", pa.float64()),
        ("table", pa.list_(pa.float64(), 4)),
        ("depth", pa.binary()),
    ],
    "grasps": [
        ("scene", pa.int32()),
        ("view", pa.int16()),
        ("grasp_type", pa.int8()),
        ("source", pa.string()),
        ("rank", pa.int16()),
        ("log_likelihood", pa.float32()),
        ("path", pa.list_(pa.float32(), PATH_SIZE)),
        ("success", pa.bool_()),
        ("collided", pa.bool_()),
        ("starts_inside", pa.bool_()),
        ("unstable", pa.bool_()),
        ("closing_shift", pa.float32()),
        ("closing_rotation", pa.float32()),
        ("shift", pa.float32()),
        ("rotation", pa.float32()),
        ("lost_at", pa.float32()),
        ("contact_force", pa.float32()),
        ("success_rate", pa.float32()),
    ],
}
SCHEMAS = {name: pa.schema(fields, {"dexzoo.grasp_set": VERSION}) for name, fields in _FIELDS.items()}
TABLES = tuple(SCHEMAS)


def encode_depth(observation: Observation) -> bytes:
    """Encode the column depth: the object's pixels as a 16-bit PNG.

    Args:
        observation: An aimed observation.
    """
    depth = np.where(observation.mask, observation.depth, 0)
    done, png = cv2.imencode(".png", np.round(depth / DEPTH_UNIT).astype(np.uint16), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not done:
        raise OSError("a depth image could not be encoded as PNG")
    return png.tobytes()


def decode_depth(png: bytes, where: str) -> NDArray[np.uint16]:
    """Decode the column depth.

    Args:
        png: A 16-bit PNG.
        where: Its place, for errors.

    Returns:
        Depth in units of 0.1 mm, (224, 224).

    Raises:
        ValueError: It is no such PNG.
    """
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED) if png else None
    if image is None or image.shape != (IMAGE_SIZE, IMAGE_SIZE) or image.dtype != np.uint16:
        raise ValueError(f"the depth of {where} is no 16-bit PNG of {IMAGE_SIZE} x {IMAGE_SIZE} pixels")
    return np.asarray(image)


def encode_view(observation: Observation, seed: int | None = None, depth: bool = True) -> dict[str, Any]:
    """Encode the columns of an aimed observation, without its scene and number.

    Args:
        observation: The observation.
        seed: Seed of `Scene.observe`, from which the view can be rendered again.
        depth: Whether the image is kept.

    Raises:
        ValueError: The observation is not aimed.
    """
    camera = observation.camera
    if camera != _AIMED:
        raise ValueError("a grasp set keeps aimed views only; give observation.aimed()")
    return {
        "seed": seed,
        "T_world_camera": observation.T_world_camera.reshape(-1).tolist(),
        "width": camera.width,
        "height": camera.height,
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "table": observation.table.tolist(),
        "depth": encode_depth(observation) if depth else None,
    }


def decode_view(row: dict[str, Any], png: bytes) -> Observation:
    """Decode an aimed observation.

    Args:
        row: Row of the table of views.
        png: Its depth.

    Raises:
        ValueError: The camera is not that of an aimed view, or the depth is damaged.
    """
    where = f"scene {row['scene']}, view {row['view']}"
    camera = Camera.from_dict(row, where)
    if camera != _AIMED:
        raise ValueError(f"{where} has the camera {camera}; a grasp set keeps aimed views, with {_AIMED}")
    depth = decode_depth(png, where).astype(np.float32) * np.float32(DEPTH_UNIT)
    pose = np.array(row["T_world_camera"], np.float64).reshape(4, 4)
    return Observation(depth, camera, pose, np.array(row["table"]), mask=depth > 0)


def encode_path(grasps: Grasps) -> NDArray[np.float32]:
    """Encode grasps as the column path.

    Args:
        grasps: Grasps in the world frame.

    Returns:
        Wrist position, quaternion and free joints at the three keyframes, (grasp, 66) for dlr2.
    """
    keys = grasps.trajectory.waypoint(KEYFRAMES)
    numbers = torch.cat((keys.wrist, grasps.hand.reduce(keys.joints)), -1)
    return numbers.flatten(1).numpy().astype(np.float32)


def decode_path(path: NDArray[np.float32], grasp_type: Tensor, hand: Hand) -> Grasps:
    """Decode the column path.

    Args:
        path: The column, (grasp, 66) for dlr2.
        grasp_type: The column grasp_type, (grasp,).
        hand: The hand of the set.

    Returns:
        The grasps in the world frame.
    """
    keys = torch.tensor(path).unflatten(-1, (3, 7 + len(hand.freedoms)))
    joints = hand.expand(keys[..., 7:])
    motion = Trajectory.from_keyframes(keys[..., :3], keys[..., 3:7], joints, grasp_type.long())
    return Grasps.of(motion, hand)

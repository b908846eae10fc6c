"""Scenes of a grasp set made again, and the views of a set that keeps no images."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from dexzoo.data.schema import VERSION, encode_depth
from dexzoo.sim import Scene
from dexzoo.sim.shapes import make_object
from dexzoo.sim.world import Support


def rebuild(row: dict[str, Any]) -> Scene:
    """Make a scene again, as it stood when its grasps were tried.

    Args:
        row: Row of the table of scenes.

    Raises:
        ValueError: The scene was not simulated, or dexzoo does not have its object.
    """
    if row["T_world_object"] is None or row["scale"] is None:
        raise ValueError(f"scene {row['scene']} was not simulated, so it cannot be made again")
    obj = make_object(row["object"]).scaled(row["scale"])
    obj = replace(obj, mass=row["mass"], friction=row["friction"])
    pose = np.array(row["T_world_object"]).reshape(4, 4)
    support = None if row["support_half"] is None else Support(tuple(row["support_half"]), row["support_yaw"])
    return Scene(obj, pose, support)


def render(scene: dict[str, Any], seeds: list[int], cache: Path) -> list[bytes]:
    """The depth of views of a scene as the set would hold it, from the cache if it has them.

    Args:
        scene: Row of the table of scenes.
        seeds: Seeds of the views.
        cache: Cache folder, with a file for each scene.

    Returns:
        A 16-bit PNG for each view.
    """
    digest = hashlib.sha256(json.dumps([VERSION, scene, seeds], sort_keys=True).encode()).hexdigest()[:32]
    path = cache / f"{digest}.safetensors"
    try:
        return [bytes(image.numpy()) for _, image in sorted(load_file(path).items())]
    except (FileNotFoundError, SafetensorError):  # not there yet, or damaged
        pass
    stage = rebuild(scene)
    images = [encode_depth(stage.observe(seed).aimed()) for seed in seeds]
    cache.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    save_file({f"{i:03d}": torch.tensor(np.frombuffer(png, np.uint8)) for i, png in enumerate(images)}, temporary)
    temporary.rename(path)
    return images

"""A small grasp set made without a simulator: balls and boxes, and a rule that a grasp closed enough holds."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from dexzoo import rotation
from dexzoo.data.schema import encode_path, encode_view
from dexzoo.data.writer import GraspSetWriter, scene_rows
from dexzoo.grasp import Grasps, Trajectory
from dexzoo.hand import Hand
from dexzoo.perception.camera import Camera, look_at
from dexzoo.perception.observation import Observation

SPLIT_OF = ("train", "train", "train", "train", "validation", "test")
CLOSED = 0.75
"""A grasp holds when its joints end, on average, beyond this share of their ranges."""


def camera_pose(center: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """A camera that looks at a point from 0.4 to 0.75 m, 30 to 57 degrees above it, upright."""
    elevation, azimuth = np.deg2rad(rng.uniform(30, 57)), rng.uniform(0, 2 * np.pi)
    return look_at(center, rng.uniform(0.4, 0.75), azimuth, elevation)


def render(
    shape: str, half: NDArray[np.float64], center: NDArray[np.float64], T_world_camera: NDArray[np.float64]
) -> Observation:
    """The aimed view of a "ball" of radius half[0] or of a "box", by intersecting each pixel's ray."""
    ray = Camera.aimed().directions() @ T_world_camera[:3, :3].T
    origin = T_world_camera[:3, 3] - center
    if shape == "ball":
        a, b = (ray * ray).sum(-1), ray @ origin
        root = b * b - a * (origin @ origin - half[0] ** 2)
        depth = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, 0)
    else:
        with np.errstate(divide="ignore"):
            near = np.minimum((-half - origin) / ray, (half - origin) / ray).max(-1)
            far = np.maximum((-half - origin) / ray, (half - origin) / ray).min(-1)
        depth = np.where(near < far, near, 0)
    return Observation(depth, Camera.aimed(), T_world_camera, mask=depth > 0)


def draw_grasps(center: NDArray[np.float64], count: int, rng: np.random.Generator) -> tuple[Grasps, NDArray[np.bool_]]:
    """Grasps in the world frame whose palm comes towards a point from above, and whether they hold."""
    way = rng.normal(size=(count, 3))
    way[:, 2] = np.abs(way[:, 2])
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    end = rng.uniform(0.04, 0.14, count)
    x = -way
    y = np.cross(x, rng.normal(size=(count, 3)))
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    turn = rotation.from_matrix(torch.tensor(np.stack((x, y, np.cross(x, y)), -1), dtype=torch.float32))
    distance = np.stack((end + 0.1, end, end), 1)[..., None]
    position = torch.tensor(center + distance * way[:, None], dtype=torch.float32)
    hand = Hand.load()
    low, high = hand.reduce(hand.lower), hand.reduce(hand.upper)
    share = torch.tensor(np.sort(rng.uniform(0, 1, (count, 3, len(hand.freedoms))), axis=1), dtype=torch.float32)
    joints = hand.expand(low + share * (high - low))
    kind = torch.tensor(rng.integers(0, 10, count))
    motion = Trajectory.from_keyframes(position, turn[:, None].expand(-1, 3, -1), joints, kind)
    return Grasps.of(motion, hand), share[:, 2].mean(-1).numpy() > CLOSED


def write(folder: Path, num_grasps: int = 40, num_views: int = 2, seed: int = 0) -> Path:
    """Write a set of one scene for each entry of SPLIT_OF, each an object of its own; returns its folder.

    Its views have images and no seeds, as those of recorded sets.
    """
    rng = np.random.default_rng(seed)
    with GraspSetWriter(folder, {"made by": "tests/synthetic.py", "seed": seed}, len(SPLIT_OF)) as writer:
        for scene, split in enumerate(SPLIT_OF):
            shape = ("ball", "box")[scene % 2]
            half = np.full(3, rng.uniform(0.03, 0.05)) if shape == "ball" else rng.uniform(0.02, 0.05, 3)
            center = np.array([0.0, 0.0, half[2]])
            views = [encode_view(render(shape, half, center, camera_pose(center, rng))) for _ in range(num_views)]
            grasps, success = draw_grasps(center, num_grasps, rng)
            columns = {
                "view": rng.integers(num_views, size=num_grasps),
                "grasp_type": grasps.grasp_type.numpy(),
                "source": ["generated"] * num_grasps,
                "rank": np.arange(num_grasps),
                "log_likelihood": rng.normal(size=num_grasps),
                "path": encode_path(grasps),
                "success": success,
            }
            row = {"scene": scene, "object": f"{shape}_{scene}", "category": shape, "split": split}
            writer.write(scene_rows(row, views, columns))
    return folder


if __name__ == "__main__":
    write(Path(sys.argv[1]))

"""Demonstrations: one recorded grasp each, and what of the object's surface lay under the hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from dexzoo.generators.features import Features
from dexzoo.grasp import GRIP, Grasps
from dexzoo.hand import Hand
from dexzoo.resources import resource
from dexzoo.segmentation import MIN_POINTS

SHIPPED = resource("robots") / "dlr2" / "demonstrations"
"""The ten demonstrations of the DLR/HIT hand II, and preshapes.yaml, which they are made of."""
REACH = 0.012
"""Metres from the hand within which the surface is kept; the contact models' receptive field is smaller."""
MAX_SURFACE_DIFFERENCE, MAX_JOINT_DIFFERENCE = 0.006, 0.15
"""Metres and radians within which two demonstrations are near-equal."""
MAX_GAP = 0.005
SPACING = 0.0015
"""Metres between the points that a mesh is known by."""


@dataclass(frozen=True)
class Demonstration:
    """One grasp of a known object, and the surface near the hand at its grip, all in the object's frame.

    object: its name. grasp: one Grasps whose "world" frame is the object's. surface: features near the hand at the
    grip.
    """

    object: str
    grasp: Grasps
    surface: Features

    @classmethod
    def record(cls, grasp: Grasps, mesh: trimesh.Trimesh, hand: Hand, name: str = "object") -> Demonstration:
        """From a grasp in the frame of the mesh of an object of that name, its faces turned outwards.

        Raises ValueError when the hand is not at the object at the grip.
        """
        hand.check(grasp.joints)
        num = int(np.clip(mesh.area / SPACING**2, 2_000, 100_000))
        points, faces = trimesh.sample.sample_surface(mesh, num, seed=0)
        links = grasp.wrist_pose[0, GRIP].double() @ hand.forward_kinematics(grasp.joints[0, GRIP].double())
        distance = hand.signed_distance(links, torch.tensor(np.array(points))).amin(0)
        near = np.asarray(distance < REACH)
        if near.sum() < MIN_POINTS or distance.min() > MAX_GAP:
            raise ValueError(
                f"demonstration on {name}: the hand is {1000 * float(distance.min()):.0f} mm from the object "
                "at the grip; give the grasp in the frame of the mesh, in metres"
            )
        return cls(name, grasp, Features.of_surface(np.array(points), mesh.face_normals[faces], near))

    def near_surface(self) -> Float[Tensor, "point 3"]:
        """The surface under the hand in the frame of the palm at the grip: what tells one contact from another."""
        pose = torch.linalg.inv(self.grasp.wrist_pose[0, GRIP])
        points: Tensor = self.surface.points @ pose[:3, :3].T + pose[:3, 3]
        return points

    @property
    def grasp_type(self) -> int:
        """Index of the grasp type, 0...9."""
        return int(self.grasp.grasp_type[0])

    def save(self, path: str | Path) -> None:
        """Write to a safetensors file."""
        tensors = {
            "waypoints": self.grasp.waypoints.float().contiguous(),
            "points": self.surface.points.contiguous(),
            "frames": self.surface.quaternion.contiguous(),
            "curvature": self.surface.curvature.contiguous(),
        }
        save_file(tensors, str(path), {"format": "dexzoo.demonstration.1", "object": self.object})

    @classmethod
    def load(cls, path: str | Path) -> Demonstration:
        """Read what `save` wrote. FileNotFoundError or ValueError when that is not possible."""
        if not Path(path).is_file():
            raise FileNotFoundError(f"demonstration {path} does not exist")
        try:
            with safe_open(str(path), framework="pt") as file:
                about = file.metadata() or {}
                tensors = {key: file.get_tensor(key) for key in ("waypoints", "points", "frames", "curvature")}
        except SafetensorError as error:
            raise ValueError(f"{path} is no demonstration ({error}); write it with Demonstration.save") from None
        surface = Features(tensors["points"], tensors["frames"], tensors["curvature"])
        return cls(about.get("object", ""), Grasps(tensors["waypoints"], "world"), surface)


@lru_cache(maxsize=4)
def load_demonstrations(folder: str = "") -> tuple[Demonstration, ...]:
    """The demonstrations of a folder, by name of the file; those of the DLR/HIT hand II by default."""
    where = Path(folder) if folder else SHIPPED
    paths = sorted(where.glob("*.safetensors"))
    if not paths:
        raise FileNotFoundError(f"folder {where} holds no demonstration; make some with python -m dexzoo demonstrate")
    return tuple(Demonstration.load(path) for path in paths)


def distinct(demonstrations: Sequence[Demonstration], max_per_type: int) -> list[Demonstration]:
    """Those that differ in what they touch or how; of near-equal ones of a type the first is kept.

    Near-equal: the surfaces under the hand lie within 6 mm of each other on average, and no joint differs by 0.15 rad.
    """
    kept: list[Demonstration] = []
    for one in demonstrations:
        like = [other for other in kept if other.grasp_type == one.grasp_type]
        if len(like) < max_per_type and not any(_near_equal(one, other) for other in like):
            kept.append(one)
    return kept


def _near_equal(a: Demonstration, b: Demonstration) -> bool:
    if (a.grasp.joints[0, GRIP] - b.grasp.joints[0, GRIP]).abs().max() > MAX_JOINT_DIFFERENCE:
        return False
    apart = torch.cdist(a.near_surface()[::4], b.near_surface()[::4])
    return bool((apart.amin(0).mean() + apart.amin(1).mean()) / 2 < MAX_SURFACE_DIFFERENCE)

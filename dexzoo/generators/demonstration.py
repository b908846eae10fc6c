"""Demonstrations: one recorded grasp each, and what of the object's surface lay under the hand."""

from __future__ import annotations

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

from dexzoo import rotation
from dexzoo.generators.features import Features
from dexzoo.grasp import GRASP_TYPES, GRIP, JOINTS, PREGRASP, SQUEEZE, Grasps
from dexzoo.hand import Hand
from dexzoo.resources import resource

REACH = 0.02
"""Metres from the hand within which the surface is kept; the contact models' receptive field is smaller."""
SPACING = 0.0015
"""Metres between the points that a mesh is known by."""


@dataclass(frozen=True)
class Demonstration:
    """One grasp of a known object, and the surface near the hand at its grip, all in the object's frame.

    grasp: one Grasps in the "world" frame, which is the object's. surface: features near the hand at the grip.
    """

    name: str
    object: str
    grasp: Grasps
    surface: Features

    @classmethod
    def record(cls, grasp: Grasps, mesh: trimesh.Trimesh, hand: Hand, name: str = "", object_name: str = "") -> Demonstration:
        """From a grasp in the frame of a watertight mesh.

        Raises ValueError when the hand touches nothing at the grip.
        """
        hand.check(grasp.joints)
        num = int(np.clip(mesh.area / SPACING**2, 2_000, 100_000))
        points, faces = trimesh.sample.sample_surface(mesh, num, seed=0)
        links = grasp.wrist_pose[0, GRIP].double() @ hand.forward_kinematics(grasp.joints[0, GRIP].double())
        distance = hand.signed_distance(links, torch.tensor(np.array(points))).amin(0)
        near = np.asarray(distance < REACH)
        if near.sum() < 10 or distance.min() > 0.005:
            raise ValueError(f"demonstration {name}: the hand is {float(distance.min()) * 1000:.0f} mm from the object at the grip")
        return cls(
            name or GRASP_TYPES[int(grasp.grasp_type[0])],
            object_name,
            grasp,
            Features.of_surface(np.array(points), mesh.face_normals[faces], near),
        )

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
        save_file(tensors, str(path), {"format": "dexzoo.demonstration.1", "name": self.name, "object": self.object})

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
        return cls(about.get("name", ""), about.get("object", ""), Grasps(tensors["waypoints"], "world"), surface)


@lru_cache(maxsize=4)
def load_demonstrations(folder: str = "") -> tuple[Demonstration, ...]:
    """The demonstrations of a folder, by name of the file; those of the DLR/HIT hand II by default."""
    where = Path(folder) if folder else resource("robots") / "dlr2" / "demonstrations"
    paths = sorted(where.glob("*.safetensors"))
    if not paths:
        raise FileNotFoundError(f"folder {where} holds no demonstration; make some with python -m dexzoo demonstrate")
    return tuple(Demonstration.load(path) for path in paths)

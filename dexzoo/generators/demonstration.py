"""Demonstrations: one recorded grasp each, and the part of the object's surface that lay under the hand."""

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

from dexzoo.grasp import GRIP, Grasps, read_trajectory
from dexzoo.hand import Hand
from dexzoo.perception.surface import SurfaceFeatures
from dexzoo.perception.table import MIN_POINTS
from dexzoo.resources import resource

FORMAT = "dexzoo.demonstration.2"
REACH = 0.012
"""Meters from the hand within which the surface is kept; the contact models' receptive field is smaller."""
MAX_SURFACE_DIFFERENCE, MAX_JOINT_DIFFERENCE = 0.006, 0.15
"""Meters and radians within which two demonstrations are near-equal."""
MAX_GAP = 0.005
SPACING = 0.0015
"""Meters between the points that a mesh is known by."""


@dataclass(frozen=True)
class Demonstration:
    """One grasp of a known object, and the surface near the hand at its grip, all in the object's frame.

    Attributes:
        object: Name of the object.
        grasp: One grasp, whose world frame is the object's.
        surface: Features of the surface near the hand at the grip.
    """

    object: str
    grasp: Grasps
    surface: SurfaceFeatures

    @classmethod
    def record(cls, grasp: Grasps, mesh: trimesh.Trimesh, name: str = "object") -> Demonstration:
        """Make a demonstration of a grasp of a known object.

        Args:
            grasp: One grasp in the frame of the mesh.
            mesh: Mesh of the object in meters, its faces turned outwards.
            name: Name of the object.

        Returns:
            The demonstration.

        Raises:
            ValueError: A joint is beyond its limits, or the hand is not at the object at the grip.
        """
        hand = grasp.hand
        hand.check(grasp.joints)
        num = int(np.clip(mesh.area / SPACING**2, 2_000, 100_000))
        points, faces = trimesh.sample.sample_surface(mesh, num, seed=0)
        links = grasp.wrist_pose[0, GRIP].double() @ hand.forward_kinematics(grasp.joints[0, GRIP].double())
        distance = hand.signed_distance(links, torch.tensor(np.array(points))).amin(0)
        near = np.asarray(distance < REACH)
        if near.sum() < MIN_POINTS or distance.min() > MAX_GAP:
            raise ValueError(
                f"demonstration on {name}: the hand is {1000 * float(distance.min()):.0f} mm from the object "
                "at the grip; give the grasp in the frame of the mesh, in meters"
            )
        return cls(name, grasp, SurfaceFeatures.of_surface(np.array(points), mesh.face_normals[faces], near))

    def near_surface(self) -> Float[Tensor, "point 3"]:
        """The surface under the hand in the frame of the palm at the grip, by which contacts are compared."""
        pose = torch.linalg.inv(self.grasp.wrist_pose[0, GRIP])
        points: Tensor = self.surface.points @ pose[:3, :3].T + pose[:3, 3]
        return points

    @property
    def grasp_type(self) -> int:
        """Index of the grasp type, 0...9."""
        return int(self.grasp.grasp_type[0])

    def save(self, path: str | Path) -> None:
        """Write to a safetensors file.

        Args:
            path: File to write.
        """
        tensors = {
            "wrist": self.grasp.wrist.float().contiguous(),
            "joints": self.grasp.joints.float().contiguous(),
            "grasp_type": self.grasp.grasp_type.contiguous(),
            "points": self.surface.points.contiguous(),
            "frames": self.surface.quaternion.contiguous(),
            "curvature": self.surface.curvature.contiguous(),
        }
        save_file(tensors, str(path), {"format": FORMAT, "object": self.object, **self.grasp.hand.identity})

    @classmethod
    def load(cls, path: str | Path, hand: Hand | None = None) -> Demonstration:
        """Read what `save` wrote.

        Args:
            path: File to read.
            hand: Hand of the demonstration; by default the one that the file names, from robots/.

        Returns:
            The demonstration.

        Raises:
            FileNotFoundError: The file does not exist.
            ValueError: The file is no demonstration, or of another hand.
        """
        if not Path(path).is_file():
            raise FileNotFoundError(f"demonstration {path} does not exist")
        try:
            with safe_open(str(path), framework="pt") as file:
                about = file.metadata() or {}
                tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118, not a dict
        except SafetensorError as error:
            raise ValueError(f"{path} is no demonstration ({error}); write it with Demonstration.save") from None
        try:
            surface = SurfaceFeatures(*(tensors[key] for key in ("points", "frames", "curvature")))
            grasp = Grasps.of(read_trajectory(tensors), Hand.of_file(about, hand))
        except KeyError as error:
            raise ValueError(
                f"{path} is no demonstration: it has no {error}; write it with Demonstration.save"
            ) from None
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
        return cls(about.get("object", ""), grasp, surface)


@lru_cache(maxsize=4)
def load_demonstrations(hand: Hand, folder: str = "") -> tuple[Demonstration, ...]:
    """Load the demonstrations of a folder, by name of the file.

    Args:
        hand: The hand that they must be of.
        folder: Folder of .safetensors files; by default the one that comes with the hand.

    Returns:
        The demonstrations.

    Raises:
        FileNotFoundError: The folder holds no demonstration.
        ValueError: A file is no demonstration, or of another hand.
    """
    where = Path(folder) if folder else shipped_demonstrations(hand)
    paths = sorted(where.glob("*.safetensors"))
    if not paths:
        raise FileNotFoundError(f"folder {where} holds no demonstration; make some with python -m dexzoo demonstrate")
    return tuple(Demonstration.load(path, hand) for path in paths)


def shipped_demonstrations(hand: Hand) -> Path:
    """Folder of the demonstrations that come with a hand, and of preshapes.yaml, which they are made of.

    Args:
        hand: The hand.
    """
    return resource("robots") / hand.spec.name / "demonstrations"


def distinct(demonstrations: Sequence[Demonstration], max_per_type: int) -> list[Demonstration]:
    """Demonstrations that differ in touched surface or posture; of near-equal ones of a type the first is kept.

    Near-equal: the surfaces under the hand lie within 6 mm of each other on average, and no joint differs by 0.15 rad.

    Args:
        demonstrations: Demonstrations; the earlier ones are preferred.
        max_per_type: Most demonstrations of a grasp type.
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

"""Author a demonstration: bring the hand to a known mesh in a given preshape and close it until it touches."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
import yaml
from torch import Tensor

from dexzoo import rotation
from dexzoo.grasp import GRASP_TYPES, NUM_JOINTS, Grasps, pose_matrix
from dexzoo.hand import Hand

STANDOFF = 0.09
"""Metres from the pre-grasp to the grip."""
SQUEEZE = 0.523
"""Radians that the joint which closes furthest goes on from the grip to the squeeze (30 degrees: the thesis' simulator)."""
_LEVELS = 60


@dataclass(frozen=True)
class Preshape:
    """A hand about to close on an object.

    object: name of a known object, or its mesh file. wrist: (4, 4) pose of the palm at the grip in the object's frame.
    opened, closed: (15,) free joints to begin with and to close towards, rad; a finger for which they are equal stays
    as it is. approach: (3,) direction in the palm frame in which the pre-grasp lies.
    """

    grasp_type: int
    object: str
    wrist: Tensor
    opened: Tensor
    closed: Tensor
    approach: Tensor


def read_preshapes(path: str | Path, hand: Hand) -> list[Preshape]:
    """The preshapes of a YAML file: for each grasp type object, wrist {position, quaternion}, open, closed, approach.

    open and closed give the free joints of each finger by its name. Raises FileNotFoundError or ValueError that names
    the entry at fault.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"file of preshapes {path} does not exist")
    entries = yaml.safe_load(Path(path).read_text())
    if not isinstance(entries, dict):
        raise ValueError(f"{path} holds no preshapes; it maps names of grasp types to object, wrist, open, closed, approach")
    return [_read(name, entry, hand, f"{path}: preshape {name}") for name, entry in entries.items()]


def _read(name: str, entry: dict[str, Any], hand: Hand, where: str) -> Preshape:
    if name not in GRASP_TYPES:
        raise ValueError(f"{where} is no grasp type; use one of {', '.join(GRASP_TYPES)}")
    try:
        wrist = entry["wrist"]
        quaternion = rotation.normalize(torch.tensor(wrist["quaternion"], dtype=torch.float32))
        postures = [
            torch.tensor([angle for finger in hand.spec.fingers for angle in entry[key][finger]], dtype=torch.float32)
            for key in ("open", "closed")
        ]
        approach = torch.nn.functional.normalize(torch.tensor(entry["approach"], dtype=torch.float32), dim=0)
        pose = pose_matrix(torch.tensor(wrist["position"], dtype=torch.float32), quaternion)
        return Preshape(GRASP_TYPES.index(name), str(entry["object"]), pose, *postures, approach)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{where} lacks or misspells {error}; it needs object, wrist, open, closed, approach") from None


def close(preshape: Preshape, mesh: trimesh.Trimesh, hand: Hand) -> Grasps:
    """The grasp, in the mesh's frame, whose fingers stop where they first touch.

    Each finger closes evenly until one of its links touches the mesh; where that is its first link, the others go on.
    From the grip, each joint goes on to the squeeze in proportion to how far it came, the furthest by 0.523 rad.
    """
    points, _ = trimesh.sample.sample_surface(mesh, 20_000, seed=0)
    cloud = torch.tensor(np.array(points), dtype=torch.float32)
    near = cloud[(cloud - preshape.wrist[:3, 3]).norm(dim=-1) < 0.25]
    grip = preshape.closed.clone()
    fingers = [name.split("_")[0] for name in hand.freedoms]
    begin = preshape.opened
    for _ in range(2):
        levels = torch.linspace(0, 1, _LEVELS)[:, None]
        postures = torch.lerp(begin, preshape.closed, levels)
        links = preshape.wrist @ hand.forward_kinematics(hand.expand(postures))
        touch = hand.signed_distance(links, near).amin(-1) < 0
    raise NotImplementedError

"""Author a demonstration: bring the hand to a known mesh in a given preshape and close it until it touches.

Or take one from a recording: where the wrist was and how the fingers were bent, on the way and at the grip.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
import yaml
from torch import Tensor

from dexzoo import rotation
from dexzoo.grasp import GRASP_TYPES, Grasps, Trajectory
from dexzoo.hand import Hand
from dexzoo.rotation import pose_matrix

STANDOFF = 0.09
"""Meters from the pre-grasp to the grip."""
SQUEEZE_TRAVEL = 0.523
"""Radians that the joint which closes furthest goes on from the grip to the squeeze (the thesis' 30 degrees)."""
_LEVELS = 60
_NUM_POINTS = 20_000
_REACH = 0.25  # meters from the wrist that the fingers cannot pass
_TOLERANCE = 0.001


@dataclass(frozen=True)
class Preshape:
    """A hand about to close on an object.

    Attributes:
        grasp_type: Index into `GRASP_TYPES`.
        object: Name of a known object, or its mesh file.
        wrist: Pose of the palm at the grip in the object's frame, (4, 4).
        opened: Free joints to begin with, radians, (freedom,).
        closed: Free joints to close towards; a finger for which they equal `opened` stays as it is.
        approach: Vector in meters from the grip to the pre-grasp in the palm frame, (3,).
    """

    grasp_type: int
    object: str
    wrist: Tensor
    opened: Tensor
    closed: Tensor
    approach: Tensor


def read_preshapes(path: str | Path, hand: Hand) -> list[Preshape]:
    """Read the preshapes of a YAML file.

    For each grasp type the file has object, wrist {position, quaternion}, open, closed and approach; open and closed
    give the free joints of each finger by its name.

    Args:
        path: File to read.
        hand: The hand.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: An entry is wrong; the error names it.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"file of preshapes {path} does not exist")
    entries = yaml.safe_load(Path(path).read_text())
    if not isinstance(entries, dict):
        raise ValueError(
            f"{path} holds no preshapes; it maps names of grasp types to object, wrist, open, closed, approach"
        )
    return [_read(name, entry, hand, f"{path}: preshape {name}") for name, entry in entries.items()]


def _read(name: str, entry: dict[str, Any], hand: Hand, where: str) -> Preshape:
    if name not in GRASP_TYPES:
        raise ValueError(f"{where} is no grasp type; use one of {', '.join(GRASP_TYPES)}")
    try:
        wrist = entry["wrist"]
        quaternion = rotation.normalize(torch.tensor(wrist["quaternion"], dtype=torch.float32))
        postures = [
            torch.tensor([angle for finger in hand.fingers for angle in entry[key][finger]], dtype=torch.float32)
            for key in ("open", "closed")
        ]
        direction = torch.tensor(entry["approach"], dtype=torch.float32)
        approach = STANDOFF * torch.nn.functional.normalize(direction, dim=0)
        pose = pose_matrix(torch.tensor(wrist["position"], dtype=torch.float32), quaternion)
        return Preshape(GRASP_TYPES.index(name), str(entry["object"]), pose, postures[0], postures[1], approach)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{where} lacks or misspells {error}; it needs object, wrist, open, closed, approach"
        ) from None


def close(preshape: Preshape, mesh: trimesh.Trimesh, hand: Hand) -> Grasps:
    """Close the hand on an object: each finger stops when it first touches.

    Each finger closes evenly until one of its links touches the mesh; if that is its first, the others go on. From the
    grip on, each flexing joint goes on as it came, the one that came furthest by 0.523 rad.

    Args:
        preshape: The open hand.
        mesh: The object, meters.
        hand: The hand.

    Returns:
        The grasp, in the frame of the mesh.

    Raises:
        ValueError: The open hand is in the mesh, or the thumb or all the other fingers miss it.
    """
    points, _ = trimesh.sample.sample_surface(mesh, _NUM_POINTS, seed=0)
    cloud = torch.tensor(np.array(points), dtype=torch.float32)
    cloud = cloud[(cloud - preshape.wrist[:3, 3]).norm(dim=-1) < _REACH]
    where = f"preshape {GRASP_TYPES[preshape.grasp_type]} on {preshape.object}"
    if not len(cloud) or not _distance(preshape, preshape.opened[None], cloud, hand).min() > -_TOLERANCE:
        raise ValueError(f"{where}: the open hand is in the object or out of reach of it; move the wrist")
    grip, touching = preshape.opened.clone(), list[str]()
    for finger in hand.fingers:
        joints = [i for i, name in enumerate(hand.freedoms) if name.startswith(finger)]
        links = [i for i, name in enumerate(hand.solid_names) if name.startswith(finger)]
        grip, touched = _bend(preshape, grip, joints, links, cloud, hand)
        if touched == links[0]:
            grip, _ = _bend(preshape, grip, joints[-1:], links[1:], cloud, hand)
        if touched is not None:
            touching.append(finger)
    if "thumb" not in touching or len(touching) < 2:
        raise ValueError(f"{where}: only {', '.join(touching) or 'nothing'} touches the object; move the wrist")
    return _path(preshape, grip, hand)


def _bend(
    preshape: Preshape, posture: Tensor, joints: list[int], links: list[int], cloud: Tensor, hand: Hand
) -> tuple[Tensor, int | None]:
    """Move some joints towards closed until one of some links touches: the posture, and that link, if any did."""
    end = posture.clone()
    end[joints] = preshape.closed[joints]
    way = torch.lerp(posture, end, torch.linspace(0, 1, _LEVELS)[:, None])
    touch = _distance(preshape, way, cloud, hand)[:, links] < 0
    if not touch.any():
        return end, None
    level = int(touch.any(1).int().argmax())
    return way[level], links[int(touch[level].int().argmax())]


def _distance(preshape: Preshape, postures: Tensor, cloud: Tensor, hand: Hand) -> Tensor:
    """(posture, solid) distances of the links to the nearest point of the object."""
    links = preshape.wrist @ hand.forward_kinematics(hand.expand(postures))
    return hand.signed_distance(links, cloud).amin(-1)


def _path(preshape: Preshape, grip: Tensor, hand: Hand) -> Grasps:
    """Pre-grasp, grip and squeeze of one grasp."""
    came = grip - preshape.opened
    came[[i for i, name in enumerate(hand.freedoms) if name.endswith("_abd")]] = 0
    squeeze = hand.clamp(grip + came * (SQUEEZE_TRAVEL / came.abs().max().clamp_min(1e-3)))
    pregrasp = preshape.wrist.clone()
    pregrasp[:3, 3] += preshape.wrist[:3, :3] @ preshape.approach
    position = torch.stack((pregrasp[:3, 3], preshape.wrist[:3, 3], preshape.wrist[:3, 3]))[None]
    quaternion = rotation.from_matrix(preshape.wrist[:3, :3]).expand(1, 3, 4)
    joints = hand.expand(torch.stack((preshape.opened, grip, squeeze)))[None]
    motion = Trajectory.from_keyframes(position, quaternion, joints, torch.tensor([preshape.grasp_type]))
    return Grasps.of(motion, hand)


def read_recording(path: str | Path, hand: Hand) -> Grasps:
    """Read one grasp from a JSON file.

    {"grasp_type": name, "waypoints": [{"position": [3], "quaternion": [4], "joints": [15 or 20]}, ...]}: the wrist in
    meters and wxyz, the free joints or all in radians. The first waypoint is the pre-grasp, the last the grip; the
    squeeze goes on from there as in `close`.

    Args:
        path: File to read.
        hand: The hand.

    Returns:
        The grasp, in the frame of its object.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file is no such recording.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"recording {path} does not exist")
    try:
        recorded = json.loads(Path(path).read_text())
        kind = GRASP_TYPES.index(recorded["grasp_type"])
        ends = [recorded["waypoints"][0], recorded["waypoints"][-1]]
        position, quaternion, joints = (
            torch.tensor([end[key] for end in ends], dtype=torch.float32)
            for key in ("position", "quaternion", "joints")
        )
        if joints.shape[1] == len(hand.joint_names):
            joints = hand.reduce(joints)
        poses = pose_matrix(position, rotation.normalize(quaternion))
        approach = poses[1, :3, :3].T @ (poses[0, :3, 3] - poses[1, :3, 3])
        if not 0.01 < approach.norm() < 0.5:
            raise ValueError(f"the first waypoint lies {approach.norm():.3f} m from the last, expected 0.01 to 0.5 m")
        preshape = Preshape(kind, str(path), poses[1], joints[0], joints[1], approach)
        hand.check(hand.expand(joints))
    except (ValueError, KeyError, IndexError, TypeError, RuntimeError) as error:
        raise ValueError(
            f"recording {path} cannot be read: {error}; "
            "it needs grasp_type and waypoints of position, quaternion, joints"
        ) from None
    return _path(preshape, joints[1], hand)

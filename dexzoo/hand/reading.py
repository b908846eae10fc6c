"""Entries of a URDF and of a hand.yaml, read and checked one by one."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml
import yourdfpy
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dexzoo.hand.tables import Inertia, Joint, Primitive


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a hand.yaml.

    Args:
        path: The file.

    Raises:
        ValueError: The file is no YAML mapping.
    """
    try:
        config = yaml.safe_load(path.read_text())
    except yaml.YAMLError as error:
        raise ValueError(f"{path} is not YAML: {' '.join(str(error).split())}") from None
    if not isinstance(config, dict):
        raise ValueError(f"{path} holds no mapping; it needs urdf, side, palm, joints and primitives")
    return config


def read_urdf(path: Path) -> yourdfpy.Robot:
    """Read a URDF.

    Args:
        path: The file.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file is no URDF.
    """
    if not path.is_file():
        raise FileNotFoundError(f"URDF {path} does not exist; hand.yaml names it as urdf")
    try:
        ElementTree.parse(path)  # yourdfpy would make do with half a file
        return yourdfpy.URDF.load(str(path), load_meshes=False, build_scene_graph=False).robot
    except (AttributeError, KeyError, SyntaxError, TypeError, ValueError) as error:  # what yourdfpy raises
        raise ValueError(f"{path.name} is not a URDF: {error}") from None


def parse_joint(joint: yourdfpy.Joint) -> Joint:
    """A joint of the tables.

    Args:
        joint: Joint as yourdfpy reads it.

    Raises:
        ValueError: The joint is of another kind, or has no limits.
    """
    moves = joint.type in ("revolute", "continuous")
    if not moves and joint.type != "fixed":
        raise ValueError(f"joint {joint.name} is {joint.type}; only revolute and fixed joints are supported")
    limit, dynamics = joint.limit, joint.dynamics
    mimic = joint.mimic if moves else None
    if moves and limit is None:
        raise ValueError(f"joint {joint.name} has no <limit>")
    return Joint(
        name=joint.name,
        parent=joint.parent,
        child=joint.child,
        origin=np.eye(4) if joint.origin is None else np.asarray(joint.origin, float),
        axis=parse_direction(joint.axis, f"axis of joint {joint.name}") if moves else None,
        lower=limit.lower or 0.0 if moves else 0.0,
        upper=limit.upper or 0.0 if moves else 0.0,
        effort=limit.effort or 0.0 if moves else 0.0,
        damping=float(dynamics.damping or 0.0) if dynamics else 0.0,  # yourdfpy leaves it a string
        mimic=mimic.joint if mimic else None,
        multiplier=1.0 if mimic is None or mimic.multiplier is None else mimic.multiplier,
        offset=0.0 if mimic is None or mimic.offset is None else mimic.offset,
    )


def parse_inertia(inertial: yourdfpy.Inertial) -> Inertia:
    """An inertia of the tables.

    Args:
        inertial: Inertial as yourdfpy reads it.
    """
    origin = np.eye(4) if inertial.origin is None else np.asarray(inertial.origin, float)
    turn = origin[:3, :3]
    return Inertia(float(inertial.mass), origin[:3, 3], turn @ np.asarray(inertial.inertia, float) @ turn.T)


def parse_finger(joints: object) -> list[str]:
    """The joints of one finger.

    Args:
        joints: Entry of `joints` in hand.yaml.

    Raises:
        ValueError: The entry is no list.
    """
    if not isinstance(joints, list):
        raise ValueError(f"joint {joints} stands alone; joints takes a list for each finger, such as [[a, b], [c]]")
    return joints


def parse_vector(values: object, what: str) -> NDArray[np.float64]:
    """Three finite numbers.

    Args:
        values: Entry of hand.yaml.
        what: Its name, for errors.

    Raises:
        ValueError: The entry is something else.
    """
    try:
        vector = np.array(values, float)
    except (TypeError, ValueError):
        vector = np.empty(0)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"{what} is {values}, expected three numbers")
    return vector


def parse_direction(values: object, what: str) -> NDArray[np.float64]:
    """A unit vector.

    Args:
        values: Entry of hand.yaml.
        what: Its name, for errors.

    Raises:
        ValueError: The entry is no direction.
    """
    vector = parse_vector(values, what)
    if not vector.any():
        raise ValueError(f"{what} is zero, expected a direction")
    return vector / np.linalg.norm(vector)


def parse_primitive(link: str, shape: dict[str, Any]) -> Primitive:
    """A shape of a link.

    Args:
        link: Name of the link.
        shape: Entry of `primitives` in hand.yaml.

    Raises:
        ValueError: The entry is no box or capsule.
    """
    pose = np.eye(4)
    if "box" in shape:
        box, what = shape["box"], f"of the box of link {link}"
        half = parse_vector(box["half"], f"half {what}")
        if (half <= 0).any():
            raise ValueError(f"half {what} is {half.tolist()}, expected positive numbers")
        pose[:3, :3] = Rotation.from_euler("xyz", parse_vector(box.get("rpy", np.zeros(3)), f"rpy {what}")).as_matrix()
        pose[:3, 3] = parse_vector(box["center"], f"center {what}")
        return Primitive(link, pose, half, 0.0)
    if "capsule" in shape:
        capsule, what = shape["capsule"], f"of the capsule of link {link}"
        start, end = (parse_vector(capsule[key], f"{key} {what}") for key in ("from", "to"))
        radius, length = float(capsule["radius"]), float(np.linalg.norm(end - start))
        if radius <= 0 or length <= 0:
            raise ValueError(f"radius and length {what} are {radius:g} and {length:g}, expected positive numbers")
        x = (end - start) / length
        y = np.cross(np.eye(3)[np.abs(x).argmin()], x)
        y /= np.linalg.norm(y)
        pose[:3, :3] = np.column_stack((x, y, np.cross(x, y)))
        pose[:3, 3] = (start + end) / 2
        return Primitive(link, pose, np.array([length / 2, 0, 0]), radius)
    raise ValueError(f"primitive of link {link} is {', '.join(shape)}; use capsule or box")


def tree_order(root: str, joints: list[Joint]) -> tuple[Joint, ...]:
    """Sort joints so that a parent stands before its children.

    Args:
        root: Link at which the tree starts.
        joints: The joints.

    Raises:
        ValueError: The joints are no tree that starts there.
    """
    children = [joint.child for joint in joints]
    for link in (root, *children):
        if children.count(link) > (link != root):
            raise ValueError(f"link {link} hangs from too many joints; the URDF must be a tree that starts at {root}")
    ordered: list[Joint] = []
    stack = [root]
    while stack:
        link = stack.pop()
        ordered.extend(joint for joint in joints if joint.child == link)
        stack.extend(joint.child for joint in reversed(joints) if joint.parent == link)
    if len(ordered) != len(joints):
        lost = {joint.name for joint in joints} - {joint.name for joint in ordered}
        raise ValueError(f"the URDF's joints {', '.join(sorted(lost))} are not reached from the palm link {root}")
    return tuple(ordered)

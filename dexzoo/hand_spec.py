"""What is known of a hand, as tables: read from its folder, checked, and mirrored for the other side.

A hand is a folder with a URDF (kinematics, masses, limits, coupling) and a hand.yaml (shapes, pads, ignored contacts).
"""

from __future__ import annotations

import difflib
import itertools
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

import numpy as np
import trimesh
import yaml
import yourdfpy
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dexzoo.resources import resource

Side = Literal["right", "left"]
_MIRROR = {"x": (-1.0, 1.0, 1.0), "y": (1.0, -1.0, 1.0), "z": (1.0, 1.0, -1.0)}


@dataclass(frozen=True)
class Primitive:
    """A box of half sizes `half` rounded by `radius`: a capsule where two of the half sizes are zero.

    pose: (4, 4) in the frame of the link; lengths in metres.
    """

    link: str
    pose: NDArray[np.float64]
    half: NDArray[np.float64]
    radius: float

    @property
    def is_capsule(self) -> bool:
        """Whether it lies along x alone."""
        return bool(self.radius > 0 and not self.half[1:].any())

    def mesh(self) -> trimesh.Trimesh:
        """A mesh of it in its own frame, for pictures; a capsule is faceted and lies within its radius."""
        mesh: trimesh.Trimesh
        if self.is_capsule:
            mesh = trimesh.creation.capsule(2 * self.half[0], self.radius, count=[12, 12])
            mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
        else:
            mesh = trimesh.creation.box(2 * self.half)
        return mesh


@dataclass(frozen=True)
class Joint:
    """One joint of the tree; a fixed joint has no axis. Coupled: angle = multiplier * angle of `mimic` + offset."""

    name: str
    parent: str
    child: str
    origin: NDArray[np.float64]  # (4, 4), T_parent_child at angle 0
    axis: NDArray[np.float64] | None
    lower: float
    upper: float
    effort: float
    damping: float
    mimic: str | None
    multiplier: float
    offset: float


@dataclass(frozen=True)
class Inertia:
    """Mass in kg, centre of mass in m and inertia about it in kg m2, in the frame of the link."""

    mass: float
    center: NDArray[np.float64]
    matrix: NDArray[np.float64]


@dataclass(frozen=True)
class Pad:
    """Where a fingertip touches: a point and an outward normal in the frame of its link."""

    link: str
    point: NDArray[np.float64]
    normal: NDArray[np.float64]


@dataclass(frozen=True)
class HandSpec:
    """Everything known of a hand, as tables. Joints are in tree order: a parent stands before its children."""

    name: str
    side: Side
    palm: str
    joints: tuple[Joint, ...]
    joint_names: tuple[str, ...]  # order of the posture vector
    link_names: tuple[str, ...]
    inertias: dict[str, Inertia]
    primitives: tuple[Primitive, ...]
    pads: dict[str, Pad]
    exclude: tuple[tuple[str, str], ...]

    @classmethod
    def load(cls, name: str | Path = "dlr2", side: Side = "right") -> HandSpec:
        """Read a hand by its name in robots/ or from a folder.

        Raises FileNotFoundError for an unknown hand, ValueError for tables that contradict each other.
        """
        if side not in ("right", "left"):
            raise ValueError(f'side {side!r} is unknown, use "right" or "left"')
        folder = _folder(name)
        path = folder / "hand.yaml"
        config = _read_yaml(path)
        try:
            urdf = _read_urdf(folder / config["urdf"])
            joints = _tree_order(config["palm"], [_joint(joint) for joint in urdf.joints])
            spec = cls(
                name=folder.resolve().name,
                side=config["side"],
                palm=config["palm"],
                joints=joints,
                joint_names=tuple(joint for finger in config["joints"] for joint in _finger(finger)),
                link_names=(config["palm"], *(joint.child for joint in joints)),
                inertias={link.name: _inertia(link.inertial) for link in urdf.links if link.inertial is not None},
                primitives=tuple(
                    _primitive(link, shape) for link, shapes in config["primitives"].items() for shape in shapes
                ),
                pads={
                    finger: Pad(
                        pad["link"],
                        _vector(pad["point"], f"point of the pad {finger}"),
                        _unit(pad["normal"], f"normal of the pad {finger}"),
                    )
                    for finger, pad in config.get("pads", {}).items()
                },
                exclude=tuple((a, b) for a, b in config.get("exclude", [])),
            )
        except KeyError as error:
            raise ValueError(f"{path} lacks the entry {error}") from None
        except (AttributeError, TypeError) as error:
            raise ValueError(f"{path}: an entry lacks the form it has in robots/dlr2/hand.yaml: {error}") from None
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
        _check(spec, path)
        if side != spec.side:
            if "mirror" not in config:
                raise ValueError(
                    f'hand {spec.name} has no {side} side: {path} has no entry mirror; use side="{spec.side}"'
                )
            _check_links(spec, path, config["mirror"])
            spec = _mirrored(spec, side, config["mirror"])
        return spec

    @property
    def freedoms(self) -> tuple[str, ...]:
        """Names of the joints that move by themselves, in posture order."""
        free = {joint.name for joint in self.joints if joint.mimic is None}
        return tuple(name for name in self.joint_names if name in free)

    @property
    def fixed_to(self) -> dict[str, str]:
        """For each link, the first of those that are fixed to each other and to it."""
        first = {self.palm: self.palm}
        for joint in self.joints:
            first[joint.child] = first[joint.parent] if joint.axis is None else joint.child
        return first

    @property
    def joined(self) -> frozenset[frozenset[str]]:
        """Pairs of links that cannot but touch: they share a joint, where links fixed to each other count as one."""
        first = self.fixed_to
        shared = {frozenset((first[joint.parent], first[joint.child])) for joint in self.joints}
        pairs = (frozenset(pair) for pair in itertools.combinations(self.link_names, 2))
        return frozenset(pair for pair in pairs if frozenset(first[link] for link in pair) in shared)

    def joint(self, name: str) -> Joint:
        """The joint of that name."""
        return next(joint for joint in self.joints if joint.name == name)


def _folder(name: str | Path) -> Path:
    """The folder of a hand: of that name in robots/, or as given."""
    for folder in (resource("robots") / str(name), Path(name)):
        if (folder / "hand.yaml").is_file():
            return folder
    known = ", ".join(sorted(path.parent.name for path in resource("robots").glob("*/hand.yaml")))
    raise FileNotFoundError(f"hand {str(name)!r} has no hand.yaml; known hands: {known}, or give a folder")


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        config = yaml.safe_load(path.read_text())
    except yaml.YAMLError as error:
        raise ValueError(f"{path} is not YAML: {' '.join(str(error).split())}") from None
    if not isinstance(config, dict):
        raise ValueError(f"{path} holds no mapping; it needs urdf, side, palm, joints and primitives")
    return config


def _read_urdf(path: Path) -> yourdfpy.Robot:
    if not path.is_file():
        raise FileNotFoundError(f"URDF {path} does not exist; hand.yaml names it as urdf")
    try:
        ElementTree.parse(path)  # yourdfpy would make do with half a file
        return yourdfpy.URDF.load(str(path), load_meshes=False, build_scene_graph=False).robot
    except (AttributeError, KeyError, SyntaxError, TypeError, ValueError) as error:  # what yourdfpy raises
        raise ValueError(f"{path.name} is not a URDF: {error}") from None


def _joint(joint: yourdfpy.Joint) -> Joint:
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
        axis=_unit(joint.axis, f"axis of joint {joint.name}") if moves else None,
        lower=limit.lower or 0.0 if moves else 0.0,
        upper=limit.upper or 0.0 if moves else 0.0,
        effort=limit.effort or 0.0 if moves else 0.0,
        damping=float(dynamics.damping or 0.0) if dynamics else 0.0,  # yourdfpy leaves it a string
        mimic=mimic.joint if mimic else None,
        multiplier=1.0 if mimic is None or mimic.multiplier is None else mimic.multiplier,
        offset=0.0 if mimic is None or mimic.offset is None else mimic.offset,
    )


def _inertia(inertial: yourdfpy.Inertial) -> Inertia:
    origin = np.eye(4) if inertial.origin is None else np.asarray(inertial.origin, float)
    turn = origin[:3, :3]
    return Inertia(float(inertial.mass), origin[:3, 3], turn @ np.asarray(inertial.inertia, float) @ turn.T)


def _finger(joints: object) -> list[str]:
    if not isinstance(joints, list):
        raise ValueError(f"joint {joints} stands alone; joints takes a list for each finger, such as [[a, b], [c]]")
    return joints


def _vector(values: object, what: str) -> NDArray[np.float64]:
    try:
        vector = np.array(values, float)
    except (TypeError, ValueError):
        vector = np.empty(0)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"{what} is {values}, expected three numbers")
    return vector


def _unit(values: object, what: str) -> NDArray[np.float64]:
    vector = _vector(values, what)
    if not vector.any():
        raise ValueError(f"{what} is zero, expected a direction")
    return vector / np.linalg.norm(vector)


def _primitive(link: str, shape: dict[str, Any]) -> Primitive:
    pose = np.eye(4)
    if "box" in shape:
        box, what = shape["box"], f"of the box of link {link}"
        half = _vector(box["half"], f"half {what}")
        if (half <= 0).any():
            raise ValueError(f"half {what} is {half.tolist()}, expected positive numbers")
        pose[:3, :3] = Rotation.from_euler("xyz", _vector(box.get("rpy", np.zeros(3)), f"rpy {what}")).as_matrix()
        pose[:3, 3] = _vector(box["center"], f"center {what}")
        return Primitive(link, pose, half, 0.0)
    if "capsule" in shape:
        capsule, what = shape["capsule"], f"of the capsule of link {link}"
        start, end = (_vector(capsule[key], f"{key} {what}") for key in ("from", "to"))
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


def _tree_order(root: str, joints: list[Joint]) -> tuple[Joint, ...]:
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


def _check(spec: HandSpec, path: Path) -> None:
    moving = {joint.name: joint for joint in spec.joints if joint.axis is not None}
    if len(set(spec.joint_names)) != len(spec.joint_names) or set(spec.joint_names) != set(moving):
        odd = set(moving).symmetric_difference(spec.joint_names) or set(spec.joint_names)
        raise ValueError(f"{path}: joints and the URDF's moving joints differ in {', '.join(sorted(odd))}")
    if not spec.primitives:
        raise ValueError(f"{path}: primitives is empty; give at least one link a box or a capsule")
    for joint in moving.values():
        if not joint.lower < joint.upper:
            raise ValueError(
                f"{path}: joint {joint.name} has the limits {joint.lower:g} to {joint.upper:g} in the URDF; "
                "give it a range, or make it a fixed joint"
            )
        if joint.mimic is None:
            continue
        if joint.mimic not in moving:
            raise ValueError(f"{path}: joint {joint.name} is coupled to {joint.mimic}, which does not exist")
        if joint.mimic not in spec.freedoms:
            raise ValueError(f"{path}: joint {joint.name} is coupled to {joint.mimic}, which is coupled itself")
        leader = moving[joint.mimic]
        for angle in (leader.lower, leader.upper):
            follows = joint.multiplier * angle + joint.offset
            if not joint.lower - 1e-3 <= follows <= joint.upper + 1e-3:
                raise ValueError(
                    f"{path}: joint {joint.name} would follow {leader.name} at {angle:g} to {follows:.3f} rad, outside "
                    f"its limits {joint.lower:.3f} to {joint.upper:.3f}; widen them, or narrow those of {leader.name}"
                )
    _check_links(spec, path, {p.link for p in spec.primitives} | {p.link for p in spec.pads.values()})
    _check_links(spec, path, set(sum(spec.exclude, ())))


def _check_links(spec: HandSpec, path: Path, links: Iterable[str]) -> None:
    for link in sorted(set(links) - set(spec.link_names)):
        near = difflib.get_close_matches(link, spec.link_names, 1)
        raise ValueError(f"{path}: link {link} is not in the URDF" + (f", did you mean {near[0]}?" if near else ""))


def _mirrored(spec: HandSpec, side: Side, axes: dict[str, str]) -> HandSpec:
    """The other side's hand: each link's frame mirrored along an axis of its own.

    A joint's axis stays where it lies along that axis or across it, and its angle changes sign in the second case.
    """
    flip = {link: np.array(_MIRROR[axes.get(link, "z")]) for link in spec.link_names}

    def mirror(
        parent: NDArray[np.float64], pose: NDArray[np.float64], child: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        mirrored: NDArray[np.float64] = np.append(parent, 1.0)[:, None] * pose * np.append(child, 1.0)
        return mirrored

    sign: dict[str, float] = {}  # of each joint's angle

    def turn(joint: Joint) -> Joint:
        joint = replace(joint, origin=mirror(flip[joint.parent], joint.origin, flip[joint.child]))
        if joint.axis is None:
            return joint
        image = flip[joint.child] * joint.axis
        sign[joint.name] = -1.0 if image @ joint.axis > 0 else 1.0  # a mirror image turns the other way
        lower, upper = sorted((sign[joint.name] * joint.lower, sign[joint.name] * joint.upper))
        return replace(joint, axis=-sign[joint.name] * image, lower=lower, upper=upper)

    def follow(joint: Joint) -> Joint:
        if joint.mimic is None:
            return joint
        own = sign[joint.name]
        return replace(joint, multiplier=own * sign[joint.mimic] * joint.multiplier, offset=own * joint.offset)

    return replace(
        spec,
        side=side,
        joints=tuple(follow(joint) for joint in [turn(joint) for joint in spec.joints]),
        inertias={
            link: Inertia(i.mass, flip[link] * i.center, np.outer(flip[link], flip[link]) * i.matrix)
            for link, i in spec.inertias.items()
        },
        # a rounded box is its own mirror image along its third axis
        primitives=tuple(
            Primitive(p.link, mirror(flip[p.link], p.pose, np.array(_MIRROR["z"])), p.half, p.radius)
            for p in spec.primitives
        ),
        pads={f: Pad(p.link, flip[p.link] * p.point, flip[p.link] * p.normal) for f, p in spec.pads.items()},
    )

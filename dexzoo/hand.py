"""The hand: forward kinematics, coupled joints, limits and signed distances, all differentiable.

A hand is a folder with a URDF (kinematics, masses, limits, coupling) and a hand.yaml (shapes, pads, ignored contacts).
The same tables feed the simulator, so the two cannot drift apart.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import yaml
import yourdfpy
from jaxtyping import Float
from torch import Tensor, nn

from dexzoo.resources import resource

Side = Literal["right", "left"]
_MIRROR = {"x": (-1.0, 1.0, 1.0), "y": (1.0, -1.0, 1.0), "z": (1.0, 1.0, -1.0)}


@dataclass(frozen=True)
class Primitive:
    """A box of half sizes `half` rounded by `radius`: a capsule where two of the half sizes are zero.

    pose: (4, 4) in the frame of the link; lengths in metres.
    """

    link: str
    pose: np.ndarray
    half: np.ndarray
    radius: float


@dataclass(frozen=True)
class Joint:
    """One joint of the tree; a fixed joint has no axis. Coupled: angle = multiplier * angle of `mimic` + offset."""

    name: str
    parent: str
    child: str
    origin: np.ndarray  # (4, 4), T_parent_child at angle 0
    axis: np.ndarray | None
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
    center: np.ndarray
    matrix: np.ndarray


@dataclass(frozen=True)
class Pad:
    """Where a fingertip touches: a point and an outward normal in the frame of its link."""

    link: str
    point: np.ndarray
    normal: np.ndarray


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
        folder = Path(name) if Path(name).is_dir() else resource("robots") / str(name)
        if not (folder / "hand.yaml").is_file():
            known = sorted(path.parent.name for path in resource("robots").glob("*/hand.yaml"))
            raise FileNotFoundError(f"hand {str(name)!r} has no hand.yaml; known hands: {', '.join(known)}, or give a folder")
        config: dict[str, Any] = yaml.safe_load((folder / "hand.yaml").read_text())
        urdf = yourdfpy.URDF.load(str(folder / config["urdf"]), load_meshes=False, build_scene_graph=False).robot
        joint_names = tuple(joint for finger in config["joints"] for joint in finger)
        spec = cls(
            name=folder.name,
            side=config["side"],
            palm=config["palm"],
            joints=_tree_order(config["palm"], [_joint(joint) for joint in urdf.joints]),
            joint_names=joint_names,
            link_names=(),
            inertias={link.name: _inertia(link.inertial) for link in urdf.links if link.inertial is not None},
            primitives=tuple(
                _primitive(link, shape) for link, shapes in config["primitives"].items() for shape in shapes
            ),
            pads={
                finger: Pad(pad["link"], np.array(pad["point"], float), np.array(pad["normal"], float))
                for finger, pad in config.get("pads", {}).items()
            },
            exclude=tuple((a, b) for a, b in config.get("exclude", [])),
        )
        spec = _with(spec, link_names=(spec.palm, *(joint.child for joint in spec.joints)))
        _check(spec, folder / "hand.yaml")
        if side != spec.side:
            if "mirror" not in config:
                raise ValueError(f"hand {folder.name} has no {side} side: {folder / 'hand.yaml'} has no entry mirror")
            spec = _mirrored(spec, side, config["mirror"])
        return spec

    @property
    def freedoms(self) -> tuple[str, ...]:
        """Names of the joints that move by themselves, in posture order."""
        free = {joint.name for joint in self.joints if joint.mimic is None}
        return tuple(name for name in self.joint_names if name in free)

    def joint(self, name: str) -> Joint:
        """The joint of that name."""
        return next(joint for joint in self.joints if joint.name == name)


def _with(spec: HandSpec, **changes: Any) -> HandSpec:
    return HandSpec(**{**spec.__dict__, **changes})


def _joint(joint: yourdfpy.Joint) -> Joint:
    moves = joint.type in ("revolute", "continuous")
    if not moves and joint.type != "fixed":
        raise ValueError(f"joint {joint.name} is {joint.type}; only revolute and fixed joints are supported")
    limit, mimic, dynamics = joint.limit, joint.mimic, joint.dynamics
    if moves and limit is None:
        raise ValueError(f"joint {joint.name} has no <limit>")
    return Joint(
        name=joint.name,
        parent=joint.parent,
        child=joint.child,
        origin=np.eye(4) if joint.origin is None else np.asarray(joint.origin, float),
        axis=np.asarray(joint.axis, float) / np.linalg.norm(joint.axis) if moves else None,
        lower=limit.lower or 0.0 if moves else 0.0,
        upper=limit.upper or 0.0 if moves else 0.0,
        effort=limit.effort or 0.0 if moves else 0.0,
        damping=(dynamics.damping or 0.0) if dynamics else 0.0,
        mimic=mimic.joint if mimic else None,
        multiplier=1.0 if mimic is None or mimic.multiplier is None else mimic.multiplier,
        offset=0.0 if mimic is None or mimic.offset is None else mimic.offset,
    )


def _inertia(inertial: yourdfpy.Inertial) -> Inertia:
    origin = np.eye(4) if inertial.origin is None else np.asarray(inertial.origin, float)
    turn = origin[:3, :3]
    return Inertia(float(inertial.mass), origin[:3, 3], turn @ np.asarray(inertial.inertia, float) @ turn.T)


def _primitive(link: str, shape: dict[str, Any]) -> Primitive:
    pose = np.eye(4)
    if "box" in shape:
        pose[:3, 3] = shape["box"]["center"]
        return Primitive(link, pose, np.array(shape["box"]["half"], float), 0.0)
    if "capsule" in shape:
        start, end = (np.array(shape["capsule"][key], float) for key in ("from", "to"))
        length = float(np.linalg.norm(end - start))
        x = (end - start) / length
        y = np.cross(np.eye(3)[np.abs(x).argmin()], x)
        y /= np.linalg.norm(y)
        pose[:3, :3] = np.column_stack((x, y, np.cross(x, y)))
        pose[:3, 3] = (start + end) / 2
        return Primitive(link, pose, np.array([length / 2, 0, 0]), float(shape["capsule"]["radius"]))
    raise ValueError(f"primitive of link {link} is {', '.join(shape)}; use capsule or box")


def _tree_order(root: str, joints: list[Joint]) -> tuple[Joint, ...]:
    ordered: list[Joint] = []
    stack = [root]
    while stack:
        children = [joint for joint in joints if joint.parent == stack[-1]]
        link = stack.pop()
        incoming = [joint for joint in joints if joint.child == link]
        ordered.extend(incoming if link != root else [])
        stack.extend(joint.child for joint in reversed(children))
    if len(ordered) != len(joints):
        lost = {joint.name for joint in joints} - {joint.name for joint in ordered}
        raise ValueError(f"the URDF's joints {', '.join(sorted(lost))} are not reached from the palm link {root}")
    return tuple(ordered)


def _check(spec: HandSpec, path: Path) -> None:
    moving = {joint.name for joint in spec.joints if joint.axis is not None}
    if len(set(spec.joint_names)) != len(spec.joint_names) or set(spec.joint_names) != moving:
        odd = moving.symmetric_difference(spec.joint_names) or set(spec.joint_names)
        raise ValueError(f"{path}: joints and the URDF's moving joints differ in {', '.join(sorted(odd))}")
    for joint in spec.joints:
        if joint.mimic is not None and joint.mimic not in moving:
            raise ValueError(f"{path}: joint {joint.name} is coupled to {joint.mimic}, which does not exist")
    used = {p.link for p in spec.primitives} | {p.link for p in spec.pads.values()} | {n for e in spec.exclude for n in e}
    for link in sorted(used - set(spec.link_names)):
        near = difflib.get_close_matches(link, spec.link_names, 1)
        raise ValueError(f"{path}: link {link} is not in the URDF" + (f", did you mean {near[0]}?" if near else ""))


def _mirrored(spec: HandSpec, side: Side, axes: dict[str, str]) -> HandSpec:
    """The other side's hand: each link's frame mirrored along its own axis, so that joint axes and limits stay."""
    flip = {link: np.array(_MIRROR[axes.get(link, "z")]) for link in spec.link_names}

    def mirror(parent: np.ndarray, pose: np.ndarray, child: np.ndarray) -> np.ndarray:
        return np.diag([*parent, 1.0]) @ pose @ np.diag([*child, 1.0])

    def turn(joint: Joint) -> Joint:
        return Joint(**{**joint.__dict__, "origin": mirror(flip[joint.parent], joint.origin, flip[joint.child])})

    return _with(
        spec,
        side=side,
        joints=tuple(turn(joint) for joint in spec.joints),
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


class Hand(nn.Module):
    """A differentiable hand. Angles are radians, lengths metres, poses in the palm frame.

    joint_names: the 20 joints in posture order; freedoms: the 15 that move by themselves.
    link_names: the links in the order of `forward_kinematics`; solid_names: those with a shape, in the order of
    `signed_distance`.
    """

    lower: Tensor
    upper: Tensor

    def __init__(self, spec: HandSpec) -> None:
        super().__init__()
        self.spec = spec
        self.joint_names = list(spec.joint_names)
        self.link_names = list(spec.link_names)
        self.freedoms = list(spec.freedoms)
        self.free_index = [self.joint_names.index(name) for name in self.freedoms]
        joints = [spec.joint(name) for name in spec.joint_names]
        self.register_buffer("lower", torch.tensor([joint.lower for joint in joints], dtype=torch.float32))
        self.register_buffer("upper", torch.tensor([joint.upper for joint in joints], dtype=torch.float32))
        self._prepare_coupling(joints)
        self._prepare_kinematics()
        self._prepare_shapes()

    @classmethod
    def load(cls, name: str | Path = "dlr2", side: Side = "right") -> Hand:
        """The hand of that name in robots/, or of a folder with a URDF and a hand.yaml."""
        return cls(HandSpec.load(name, side))

    def _prepare_coupling(self, joints: list[Joint]) -> None:
        expand = torch.zeros(len(joints), len(self.freedoms), dtype=torch.float64)
        offset = torch.zeros(len(joints), dtype=torch.float64)
        for row, joint in enumerate(joints):
            expand[row, self.freedoms.index(joint.mimic or joint.name)] = joint.multiplier
            offset[row] = joint.offset
        self._expand, self._expand_offset = expand, offset

    def _prepare_kinematics(self) -> None:
        """Joints by depth in the tree, so that one batched product serves all fingers at once."""
        depth = {self.spec.palm: 0}
        levels: list[list[Joint]] = []
        for joint in self.spec.joints:
            depth[joint.child] = depth[joint.parent] + 1
            if len(levels) < depth[joint.child]:
                levels.append([])
            levels[depth[joint.child] - 1].append(joint)
        self._levels: list[tuple[list[int], list[int], Tensor]] = []
        order = [self.spec.palm]
        before = {self.spec.palm: 0}
        for level in levels:
            parents = [before[joint.parent] for joint in level]
            angles = [self.joint_names.index(joint.name) if joint.axis is not None else -1 for joint in level]
            self._levels.append((parents, angles, torch.tensor(np.stack([_joint_terms(joint) for joint in level]))))
            before = {joint.child: i for i, joint in enumerate(level)}
            order += [joint.child for joint in level]
        self._unsort = [order.index(name) for name in self.link_names]
        self._constants: dict[tuple[torch.dtype, torch.device], tuple[Tensor, ...]] = {}

    def _prepare_shapes(self) -> None:
        shapes = self.spec.primitives
        self.solid_names = [name for name in self.link_names if any(shape.link == name for shape in shapes)]
        shapes = tuple(sorted(shapes, key=lambda shape: self.solid_names.index(shape.link)))
        self._shape_link = [self.link_names.index(shape.link) for shape in shapes]
        solid = [self.solid_names.index(shape.link) for shape in shapes]
        self._shape_groups = [[i for i, s in enumerate(solid) if s == k] for k in range(len(self.solid_names))]
        self._shape_pose = torch.tensor(np.stack([shape.pose for shape in shapes]))
        self._shape_half = torch.tensor(np.stack([shape.half for shape in shapes]))
        self._shape_radius = torch.tensor([shape.radius for shape in shapes], dtype=torch.float64)

    def _cast(self, like: Tensor) -> tuple[Tensor, ...]:
        """Every constant in the dtype and on the device of a tensor, kept for the next call."""
        key = (like.dtype, like.device)
        if key not in self._constants:
            constants = [level[2] for level in self._levels]
            constants += [self._expand, self._expand_offset, self._shape_pose, self._shape_half, self._shape_radius]
            self._constants[key] = tuple(value.to(like) for value in constants)
        return self._constants[key]

    def expand(self, q15: Float[Tensor, "*batch freedom"]) -> Float[Tensor, "*batch joint"]:
        """All joint angles from the free ones: the coupled joints follow."""
        if q15.shape[-1] != len(self.freedoms):
            raise ValueError(f"expand takes the {len(self.freedoms)} free joints, got {q15.shape[-1]} angles")
        matrix, offset = self._cast(q15)[len(self._levels) : len(self._levels) + 2]
        return q15 @ matrix.T + offset

    def reduce(self, q20: Float[Tensor, "*batch joint"]) -> Float[Tensor, "*batch freedom"]:
        """The free joints among all; the inverse of `expand` on postures that keep the coupling."""
        return q20[..., self.free_index]

    def check(self, q20: Float[Tensor, "*batch joint"], tolerance: float = 1e-3) -> None:
        """Raise ValueError that names the joint, its value and its limits when a posture cannot be."""
        self._check_size(q20)
        excess = torch.maximum(self.lower.to(q20) - q20, q20 - self.upper.to(q20))
        if not torch.isfinite(q20).all():
            raise ValueError("joint angles hold a number that is not finite")
        if excess.numel() and excess.max() > tolerance:
            worst = int(excess.argmax())
            joint = worst % len(self.joint_names)
            raise ValueError(
                f"joint {self.joint_names[joint]} is at {float(q20.reshape(-1)[worst]):.3f} rad, outside its limits "
                f"{float(self.lower[joint]):.3f} to {float(self.upper[joint]):.3f}"
            )

    def _check_size(self, q20: Tensor) -> None:
        if q20.shape[-1] != len(self.joint_names):
            hint = "; use hand.expand first" if q20.shape[-1] == len(self.freedoms) else ""
            raise ValueError(f"a posture has {len(self.joint_names)} joint angles, got {q20.shape[-1]}{hint}")

    def forward_kinematics(self, q20: Float[Tensor, "*batch joint"]) -> Float[Tensor, "*batch link 4 4"]:
        """Poses of all links in the palm frame, in the order of `link_names`.

        Each joint's transform is O + sin(a) O K + (1 - cos(a)) O K K (Rodrigues), with O its origin and K the cross
        product matrix of its axis.
        """
        self._check_size(q20)
        batch = q20.shape[:-1]
        q = q20.reshape(-1, q20.shape[-1])
        sin = torch.cat((torch.sin(q), q.new_zeros(len(q), 1)), dim=-1)  # the last column serves fixed joints
        one_minus_cos = torch.cat((1 - torch.cos(q), q.new_zeros(len(q), 1)), dim=-1)
        pose = torch.eye(4, dtype=q.dtype, device=q.device).expand(len(q), 1, 4, 4)
        poses = [pose]
        for (parents, angles, _), terms in zip(self._levels, self._cast(q), strict=False):
            weights = torch.stack((torch.ones_like(sin[:, angles]), sin[:, angles], one_minus_cos[:, angles]), dim=-1)
            step = torch.einsum("bjk,jkrc->bjrc", weights, terms)
            pose = pose[:, parents] @ step
            poses.append(pose)
        return torch.cat(poses, dim=1)[:, self._unsort].reshape(*batch, len(self.link_names), 4, 4)

    def shape_poses(self, links: Float[Tensor, "*batch link 4 4"]) -> Float[Tensor, "*batch shape 4 4"]:
        """Poses of the primitives, given those of the links."""
        return links[..., self._shape_link, :, :] @ self._cast(links)[-3]

    def signed_distance(
        self, links: Float[Tensor, "*batch link 4 4"], points: Float[Tensor, "*batch point 3"]
    ) -> Float[Tensor, "*batch solid point"]:
        """Distance in metres from points to the surface of each solid link, negative inside.

        links: link poses in the frame of the points. points broadcast against the batch. Exact for capsules and
        boxes; where several primitives make one link, the nearest counts.
        """
        poses = self.shape_poses(links)
        half, radius = self._cast(links)[-2:]
        turn, origin = poses[..., :3, :3], poses[..., :3, 3]
        local = points[..., None, :, :] @ turn - (origin[..., None, :] @ turn)  # (*batch, shape, point, 3)
        outside = local.abs() - half[:, None]
        square = outside.clamp_min(0).square().sum(-1)
        positive = square > 0  # the root has no gradient at zero
        distance = torch.where(positive, torch.where(positive, square, 1.0).sqrt(), 0.0)
        distance = distance + outside.amax(-1).clamp_max(0) - radius[:, None]
        return torch.stack([distance[..., group, :].amin(-2) for group in self._shape_groups], dim=-2)

    def clearance(
        self, links: Float[Tensor, "*batch link 4 4"], plane: Float[Tensor, "*plane 4"]
    ) -> Float[Tensor, "*batch solid"]:
        """Smallest height in metres of each solid link over a plane (normal . p + offset), negative below it.

        plane: unit normal and offset in the frame of the link poses; broadcasts against the batch.
        """
        poses = self.shape_poses(links)
        half, radius = self._cast(links)[-2:]
        normal, offset = plane[..., None, :3], plane[..., None, 3]
        height = (poses[..., :3, 3] * normal).sum(-1) + offset
        reach = ((normal[..., None, :] @ poses[..., :3, :3]).squeeze(-2).abs() * half).sum(-1) + radius
        low = height - reach
        return torch.stack([low[..., group].amin(-1) for group in self._shape_groups], dim=-1)


def _joint_terms(joint: Joint) -> np.ndarray:
    """(3, 4, 4): the constant, sine and 1 - cosine terms of a joint's transform."""
    zero = np.zeros((4, 4))
    if joint.axis is None:
        return np.stack((joint.origin, zero, zero))
    x, y, z = joint.axis
    cross = np.zeros((4, 4))
    cross[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    return np.stack((joint.origin, joint.origin @ cross, joint.origin @ cross @ cross))


@lru_cache(maxsize=4)
def default_hand(side: Side = "right") -> Hand:
    """The DLR/HIT hand II, loaded once."""
    return Hand.load("dlr2", side)

"""The hand: forward kinematics, coupled joints, limits and signed distances, all differentiable.

Its tables (`HandSpec`) feed the simulator too, so the two cannot drift apart.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from dexzoo.hand_spec import HandSpec, Inertia, Joint, Pad, Primitive, Side
from dexzoo.kinematics import KinematicTree, LinkPoses

__all__ = ["Hand", "HandSpec", "Inertia", "Joint", "Pad", "Primitive", "Side", "default_hand"]


class _Constants(NamedTuple):
    """A hand's tables as tensors of one dtype on one device."""

    tree: KinematicTree
    expand: Tensor
    expand_offset: Tensor
    shape_pose: Tensor
    shape_half: Tensor
    shape_radius: Tensor


class Hand(nn.Module):
    """A differentiable hand. Angles are radians, lengths metres, poses in the palm frame.

    joint_names: the 20 joints in posture order; freedoms: the 15 that move by themselves.
    link_names: the links in the order of `forward_kinematics`; solid_names: those with a shape, in the order of
    `signed_distance`; shapes: the primitives in the order of `shape_poses`.
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
        self._prepare_shapes()
        self._constants: dict[tuple[torch.device, torch.dtype], _Constants] = {}

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

    def _prepare_shapes(self) -> None:
        solid_links = {shape.link for shape in self.spec.primitives}
        self.solid_names = [name for name in self.link_names if name in solid_links]
        shapes = sorted(self.spec.primitives, key=lambda shape: self.solid_names.index(shape.link))
        self.shapes = shapes
        self._shape_link = [self.link_names.index(shape.link) for shape in shapes]
        solid = [self.solid_names.index(shape.link) for shape in shapes]
        self._shape_groups = [[i for i, s in enumerate(solid) if s == k] for k in range(len(self.solid_names))]
        self._shape_pose = torch.tensor(np.stack([shape.pose for shape in shapes]))
        self._shape_half = torch.tensor(np.stack([shape.half for shape in shapes]))
        self._shape_radius = torch.tensor([shape.radius for shape in shapes], dtype=torch.float64)

    def _cast(self, like: Tensor) -> _Constants:
        """Every constant in the dtype and on the device of a tensor, kept for the next call."""
        key = (like.device, like.dtype)
        if key not in self._constants:
            values = (self._expand, self._expand_offset, self._shape_pose, self._shape_half, self._shape_radius)
            with torch.inference_mode(False):  # else a first call in inference mode would bar gradients from then on
                tree = KinematicTree(self.spec, like.dtype, like.device)
                self._constants[key] = _Constants(tree, *(value.to(*key) for value in values))
        return self._constants[key]

    def expand(self, q15: Float[Tensor, "*batch freedom"]) -> Float[Tensor, "*batch joint"]:
        """All joint angles from the free ones: the coupled joints follow."""
        if q15.shape[-1] != len(self.freedoms):
            raise ValueError(f"expand takes the {len(self.freedoms)} free joints, got {q15.shape[-1]} angles")
        constants = self._cast(q15)
        return q15 @ constants.expand.T + constants.expand_offset

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
        """Poses of all links in the palm frame, in the order of `link_names`; differentiable once."""
        self._check_size(q20)
        poses: Tensor = LinkPoses.apply(q20.reshape(-1, q20.shape[-1]), self._cast(q20).tree)
        return poses.reshape(*q20.shape[:-1], len(self.link_names), 4, 4)

    def shape_poses(self, links: Float[Tensor, "*batch link 4 4"]) -> Float[Tensor, "*batch shape 4 4"]:
        """Poses of the primitives, given those of the links."""
        return links[..., self._shape_link, :, :] @ self._cast(links).shape_pose

    def signed_distance(
        self, links: Float[Tensor, "*batch link 4 4"], points: Float[Tensor, "*cloud point 3"]
    ) -> Float[Tensor, "*both solid point"]:
        """Distance in metres from points to the surface of each solid link, negative inside.

        links: link poses in the frame of the points. points broadcast against the poses. Exact for capsules and
        boxes; where several primitives make one link, the nearest counts.
        """
        poses = self.shape_poses(links)
        half, radius = self._cast(links).shape_half, self._cast(links).shape_radius
        inverse = poses[..., :3, :3].mT
        local = inverse @ points.mT[..., None, :, :] if points.ndim > 2 else inverse @ points.mT
        local = local - inverse @ poses[..., :3, 3:]  # (*both, shape, 3, point): rows, so that each is one stretch
        distance = [
            _capsule_distance(local[..., i, :, :], half[i, 0], radius[i])
            if shape.is_capsule
            else _box_distance(local[..., i, :, :], half[i], radius[i])
            for i, shape in enumerate(self.shapes)
        ]
        nearest = [
            distance[group[0]] if len(group) == 1 else torch.stack([distance[i] for i in group]).amin(0)
            for group in self._shape_groups
        ]
        return torch.stack(nearest, dim=-2)

    def clearance(
        self, links: Float[Tensor, "*batch link 4 4"], plane: Float[Tensor, "*plane 4"]
    ) -> Float[Tensor, "*both solid"]:
        """Smallest height in metres of each solid link over a plane (normal . p + offset), negative below it.

        plane: unit normal and offset in the frame of the link poses; broadcasts against them.
        """
        poses = self.shape_poses(links)
        half, radius = self._cast(links).shape_half, self._cast(links).shape_radius
        normal, offset = plane[..., None, :3], plane[..., None, 3]
        height = (poses[..., :3, 3] * normal).sum(-1) + offset
        reach = ((normal[..., None, :] @ poses[..., :3, :3]).squeeze(-2).abs() * half).sum(-1) + radius
        low = height - reach
        return torch.stack([low[..., group].amin(-1) for group in self._shape_groups], dim=-1)


def _capsule_distance(local: Tensor, half: Tensor, radius: Tensor) -> Tensor:
    """Distances of points (..., 3, point) to a capsule of half length `half` along x."""
    x, y, z = local.unbind(-2)
    beyond = (x.abs() - half).clamp_min(0)
    square = beyond * beyond + y * y + z * z
    return square.clamp_min(1e-16).sqrt() - radius  # the root has no gradient at zero


def _box_distance(local: Tensor, half: Tensor, radius: Tensor) -> Tensor:
    """Distances of points (..., 3, point) to a box of half sizes `half` rounded by `radius`."""
    outside = local.abs() - half[:, None]
    square = outside.clamp_min(0).square().sum(-2)
    positive = square > 0
    distance = torch.where(positive, torch.where(positive, square, 1.0).sqrt(), 0.0)
    return distance + outside.amax(-2).clamp_max(0) - radius


@lru_cache(maxsize=4)
def default_hand(side: Side = "right") -> Hand:
    """The DLR/HIT hand II, loaded once."""
    return Hand.load("dlr2", side)

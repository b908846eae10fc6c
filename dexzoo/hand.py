"""The hand: forward kinematics, coupled joints, limits and signed distances, all differentiable.

Its tables (`HandSpec`) feed the simulator too, so the two cannot drift apart.
"""

from __future__ import annotations

import difflib
import itertools
import math
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from dexzoo.geometry import PointDistance, SegmentPairs, box_distance
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
    pads: Tensor  # (2, pad, 3): points and normals


class Hand(nn.Module):
    """A differentiable hand. Angles are radians, lengths metres, poses in the palm frame.

    joint_names: the 20 joints in posture order; freedoms: the 15 that move by themselves; fingers: in the order of the
    freedoms, whose names begin with theirs.
    link_names: the links in the order of `forward_kinematics`; solid_names: those with a shape, in the order of
    `signed_distance`; shapes: the primitives in the order of `shape_poses`; self_pairs: the pairs of solid links in the
    order of `self_distance`; pad_names: the fingers in the order of `pads`.
    """

    lower: Tensor
    upper: Tensor

    def __init__(self, spec: HandSpec) -> None:
        super().__init__()
        self.spec = spec
        self.joint_names = list(spec.joint_names)
        self.link_names = list(spec.link_names)
        self.freedoms = list(spec.freedoms)
        self.fingers = list(dict.fromkeys(name.split("_")[0] for name in self.freedoms))
        self.pad_names = list(spec.pads)
        self.free_index = [self.joint_names.index(name) for name in self.freedoms]
        joints = [spec.joint(name) for name in spec.joint_names]
        self.register_buffer("lower", torch.tensor([joint.lower for joint in joints], dtype=torch.float32))
        self.register_buffer("upper", torch.tensor([joint.upper for joint in joints], dtype=torch.float32))
        self._prepare_coupling(joints)
        self._prepare_shapes()
        pads = [spec.pads[name] for name in self.pad_names]
        self._pad_link = [self.link_index(pad.link) for pad in pads]
        points_and_normals = np.array([[pad.point for pad in pads], [pad.normal for pad in pads]])
        self._pads = torch.tensor(points_and_normals.reshape(2, len(pads), 3))
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
        ends = np.cumsum([sum(shape.link == name for shape in shapes) for name in self.solid_names]).tolist()
        self._shape_groups = [slice(*bounds) for bounds in itertools.pairwise([0, *ends])]
        self._shape_solid = [self.solid_names.index(shape.link) for shape in shapes]
        self._shape_pose = torch.tensor(np.stack([shape.pose for shape in shapes]))
        self._shape_half = torch.tensor(np.stack([shape.half for shape in shapes]))
        self._shape_radius = torch.tensor([shape.radius for shape in shapes], dtype=torch.float64)
        ignored = self.spec.joined | {frozenset(pair) for pair in self.spec.exclude}
        meeting = [
            p
            for p in itertools.combinations(range(len(self.solid_names)), 2)
            if frozenset(self.solid_names[i] for i in p) not in ignored
        ]
        self.self_pairs = [(self.solid_names[i], self.solid_names[j]) for i, j in meeting]
        members = [range(len(shapes))[group] for group in self._shape_groups]
        self._pairs = SegmentPairs.between(shapes, [(members[i], members[j]) for i, j in meeting])

    def _cast(self, like: Tensor) -> _Constants:
        """Every constant in the dtype and on the device of a tensor, kept for the next call."""
        key = (like.device, like.dtype)
        if key not in self._constants:
            shapes = (self._shape_pose, self._shape_half, self._shape_radius)
            values = (self._expand, self._expand_offset, *shapes, self._pads)
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

    def clamp(self, q: Float[Tensor, "*batch joint"]) -> Float[Tensor, "*batch joint"]:
        """The nearest angles within the limits; of all joints or of the free ones, by their number."""
        lower, upper = self._limits(q)
        return torch.minimum(torch.maximum(q, lower), upper)

    def reflect(self, q: Float[Tensor, "*batch joint"]) -> Float[Tensor, "*batch joint"]:
        """Angles beyond a limit mirrored back inside, as a random walk needs; of all joints or of the free ones."""
        lower, upper = self._limits(q)
        width = upper - lower
        phase = torch.remainder(q - lower, 2 * width)
        return lower + torch.minimum(phase, 2 * width - phase)

    def squash(self, z: Float[Tensor, "*batch joint"]) -> Float[Tensor, "*batch joint"]:
        """Real numbers smoothly to angles within the limits (middle at 0); of all joints or of the free ones."""
        lower, upper = self._limits(z)
        return lower + (upper - lower) * torch.sigmoid(z)

    def random(self, num: int, generator: torch.Generator) -> Float[Tensor, "num joint"]:
        """Postures drawn evenly within the limits, coupled, among those that do not touch themselves.

        Raises RuntimeError when fewer than one in a hundred is free.
        """
        lower, upper = self.reduce(self.lower), self.reduce(self.upper)
        found = torch.zeros(0, len(self.joint_names))
        for _ in range(100):
            if len(found) >= num:
                break
            q = self.expand(lower + (upper - lower) * torch.rand(max(num, 16), len(self.freedoms), generator=generator))
            found = torch.cat((found, q[(self.self_distance(self.forward_kinematics(q)) > 0).all(-1)]))
        if len(found) < num:
            raise RuntimeError(f"hand {self.spec.name} touches itself in almost every posture; check its primitives")
        return found[:num]

    def _limits(self, q: Tensor) -> tuple[Tensor, Tensor]:
        lower, upper = self.lower.to(q), self.upper.to(q)
        if q.shape[-1] == len(self.freedoms) != len(self.joint_names):
            return self.reduce(lower), self.reduce(upper)
        self._check_size(q)
        return lower, upper

    def check(self, q20: Float[Tensor, "*batch joint"], tolerance: float = 1e-3) -> None:
        """Raise ValueError that names the joint, its value and its limits when a posture cannot be."""
        self._check_size(q20)
        excess = torch.maximum(self.lower.to(q20) - q20, q20 - self.upper.to(q20)).nan_to_num(nan=torch.inf)
        if excess.numel() and excess.max() > tolerance:
            worst = int(excess.argmax())
            joint = worst % len(self.joint_names)
            angle, name = float(q20.reshape(-1)[worst]), self.joint_names[joint]
            if not math.isfinite(angle):
                raise ValueError(f"joint {name} is at {angle} rad, which is not finite")
            raise ValueError(
                f"joint {name} is at {angle:.3f} rad, outside its limits "
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

    def jacobian(
        self, q20: Float[Tensor, "*batch joint"], link: str, point: Float[Tensor, " 3"] | None = None
    ) -> Float[Tensor, "*batch 6 joint"]:
        """Velocity of a point of a link by joint velocities, palm frame: linear (rows 0:3), angular (rows 3:6).

        point: in the frame of the link; its origin if not given. Raises ValueError for an unknown link.
        """
        poses = self.forward_kinematics(q20)
        pose = poses[..., self.link_index(link), :, :]
        at = pose[..., :3, 3] if point is None else (pose[..., :3, :3] @ point.to(q20)) + pose[..., :3, 3]
        tree = self._cast(q20).tree
        frames = poses[..., tree.joint_links, :, :]
        axes = (frames[..., :3, :3] @ tree.axes.permute(1, 0, 2)).squeeze(-1)  # (*batch, joint, 3)
        axes = axes * tree.behind[:, self.link_index(link), None]
        linear = torch.cross(axes, at[..., None, :] - frames[..., :3, 3], dim=-1)
        return torch.cat((linear, axes), dim=-1).mT

    def link_index(self, name: str) -> int:
        """Place of a link in `link_names`; ValueError names the nearest for one that does not exist."""
        if name not in self.link_names:
            near = difflib.get_close_matches(name, self.link_names, 1)
            raise ValueError(
                f"hand {self.spec.name} has no link {name!r}" + (f", did you mean {near[0]}?" if near else "")
            )
        return self.link_names.index(name)

    def pads(self, links: Float[Tensor, "*batch link 4 4"]) -> tuple[Tensor, Tensor]:
        """Where the fingertips touch: points and outward normals, each (*batch, pad, 3), in the order `pad_names`."""
        poses = links[..., self._pad_link, :, :]
        turn, pads = poses[..., :3, :3], self._cast(links).pads[..., None]
        return (turn @ pads[0]).squeeze(-1) + poses[..., :3, 3], (turn @ pads[1]).squeeze(-1)

    def shape_poses(self, links: Float[Tensor, "*batch link 4 4"]) -> Float[Tensor, "*batch shape 4 4"]:
        """Poses of the primitives, given those of the links."""
        return links[..., self._shape_link, :, :] @ self._cast(links).shape_pose

    def signed_distance(
        self, links: Float[Tensor, "*batch link 4 4"], points: Float[Tensor, "*cloud point 3"]
    ) -> Float[Tensor, "*both solid point"]:
        """Distance in metres from points to the surface of each solid link, negative inside.

        links: link poses in the frame of the points. points broadcast against the poses. Exact for capsules and
        boxes; where several primitives make one link, the nearest counts, so a point in two of them may lie deeper.
        Differentiable once.
        """
        constants = self._cast(links)
        poses = self.shape_poses(links)
        inverse = poses[..., :3, :3].mT
        transform = torch.cat((inverse, -inverse @ poses[..., :3, 3:]), -1)  # (*batch, shape, 3, 4)
        batch = torch.broadcast_shapes(transform.shape[:-3], points.shape[:-2])
        transform = transform.expand(*batch, *transform.shape[-3:]).reshape(-1, *transform.shape[-3:])
        if points.ndim > 2:
            points = points.expand(*batch, *points.shape[-2:]).reshape(math.prod(batch), *points.shape[-2:])
        half, radius = constants.shape_half, constants.shape_radius
        distance: Tensor = PointDistance.apply(transform, points, half, radius, self._shape_groups)
        return distance.reshape(*batch, *distance.shape[-2:])

    def closest_distance(
        self, links: Float[Tensor, "*batch link 4 4"], points: Float[Tensor, "*cloud point 3"]
    ) -> Float[Tensor, "*both solid"]:
        """Distance in metres from each solid link to the closest of the points, negative inside; inf without points.

        The least of `signed_distance` over the points, in less time where a gradient is wanted: it is taken of the
        closest points alone.
        """
        if not points.shape[-2]:
            batch = torch.broadcast_shapes(links.shape[:-3], points.shape[:-2])
            return links.new_full((*batch, len(self.solid_names)), torch.inf)
        with torch.no_grad():
            closest = self.signed_distance(links, points).argmin(-1)
        cloud = points.expand(*closest.shape[:-1], *points.shape[-2:])
        point = cloud.take_along_dim(closest[..., None], -2)[..., self._shape_solid, :]
        constants, poses = self._cast(links), self.shape_poses(links)
        local = ((point - poses[..., :3, 3])[..., None, :] @ poses[..., :3, :3]).squeeze(-2).movedim(-1, 0)
        half = constants.shape_half.T.view(3, *(1,) * (local.ndim - 2), -1)
        distance = box_distance(local, half, constants.shape_radius)
        return torch.stack([distance[..., group].amin(-1) for group in self._shape_groups], dim=-1)

    def self_distance(self, links: Float[Tensor, "*batch link 4 4"]) -> Float[Tensor, "*batch pair"]:
        """Distance in metres between the links of each of `self_pairs`, negative where they overlap.

        The pairs are all solid links that neither share a joint nor are excluded in hand.yaml, as in the simulator.
        Overlap is measured by the deepest point of one link's core (a capsule's axis, a box's edge) in the other.
        """
        constants = self._cast(links)
        poses = self.shape_poses(links).reshape(-1, len(self.shapes), 4, 4)
        distance = self._pairs.distance(poses, constants.shape_half, constants.shape_radius, len(self.self_pairs))
        return distance.reshape(*links.shape[:-3], len(self.self_pairs))

    def self_overlap(self, links: Float[Tensor, "*batch link 4 4"]) -> Float[Tensor, "*batch pair"]:
        """Metres that the links of each of `self_pairs` overlap, 0 where they do not: what `self_distance` is below 0.

        Two to three times as fast, since most pairs are too far apart to be looked at.
        """
        constants = self._cast(links)
        poses = self.shape_poses(links).reshape(-1, len(self.shapes), 4, 4)
        overlap = self._pairs.overlap(poses, constants.shape_half, constants.shape_radius, len(self.self_pairs))
        return overlap.reshape(*links.shape[:-3], len(self.self_pairs))

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


@lru_cache(maxsize=4)
def default_hand(side: Side = "right") -> Hand:
    """The DLR/HIT hand II, loaded once."""
    return Hand.load("dlr2", side)

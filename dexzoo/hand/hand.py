"""The hand: forward kinematics, coupled joints, limits and signed distances, all differentiable.

Its tables (`HandSpec`) feed the simulator too, so the two cannot drift apart.
"""

from __future__ import annotations

import difflib
import itertools
import math
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dexzoo.hand.distances import PointDistance, SegmentPairs, box_distance
from dexzoo.hand.joints import JointSpace
from dexzoo.hand.kinematics import KinematicTree, LinkPoses, build_chain
from dexzoo.hand.spec import HandSpec, Side


class _Constants(NamedTuple):
    """A hand's tables as tensors of one dtype on one device."""

    tree: KinematicTree
    shape_pose: Tensor
    shape_half: Tensor
    shape_radius: Tensor
    pads: Tensor  # (2, pad, 3): points and normals


class Hand(JointSpace):
    """A differentiable hand. Angles are radians, lengths meters, poses in the palm frame. Joints: see `JointSpace`.

    Args:
        spec: Tables of the hand.

    Attributes:
        chain: Kinematic chain of pytorch_kinematics, float64, built from the URDF's joints.
        link_names: The links, in the order of `forward_kinematics`.
        solid_names: The links that have a shape, in the order of `signed_distance`.
        shapes: The primitives, in the order of `shape_poses`.
        self_pairs: Pairs of solid links, in the order of `self_distance`.
        pad_names: The fingers, in the order of `pads`.
    """

    def __init__(self, spec: HandSpec) -> None:
        super().__init__(spec)
        self.chain = build_chain(spec)
        self.link_names = list(spec.link_names)
        self.pad_names = list(spec.pads)
        self._prepare_shapes()
        pads = [spec.pads[name] for name in self.pad_names]
        self._pad_link = [self.link_index(pad.link) for pad in pads]
        points_and_normals = np.array([[pad.point for pad in pads], [pad.normal for pad in pads]])
        self._pads = torch.tensor(points_and_normals.reshape(2, len(pads), 3))
        self._constants: dict[tuple[torch.device, torch.dtype], _Constants] = {}

    @classmethod
    def load(cls, name: str | Path = "dlr2", side: Side = "right") -> Hand:
        """Load a hand.

        Args:
            name: Name in robots/, or a folder with a URDF and a hand.yaml.
            side: Side of the hand.

        Returns:
            The hand.

        Raises:
            FileNotFoundError: The hand is unknown.
            ValueError: Its tables contradict each other, or it has no such side.
        """
        return cls(HandSpec.load(name, side))

    @classmethod
    def of_file(cls, about: Mapping[str, str], hand: Hand | None = None) -> Hand:
        """The hand that a file's metadata names.

        Args:
            about: Metadata with the entries of `identity`. A file of the first edition has none, and is of dlr2.
            hand: The hand that the file must be of; by default the one of that name in robots/.

        Returns:
            The hand.

        Raises:
            ValueError: The file is of another hand, or its hand is not in robots/ or has changed since.
        """
        name, side = about.get("hand", "dlr2"), about.get("side", "right")
        if hand is None:
            if side not in ("right", "left") or name not in HandSpec.known():
                raise ValueError(f"the grasps are of a hand {name!r}, which is not in robots/; give it with hand=")
            hand = cls.load(name, "left" if side == "left" else "right")
        digest = about["digest"] if "digest" in about else cls.load("dlr2").digest
        if digest != hand.digest:
            raise ValueError(
                f"the grasps are of the hand {name} ({side}), not of {hand.spec.name} ({hand.spec.side}) as it is now"
            )
        return hand

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the hand's tables, equal for equal hands."""
        return self.spec.digest

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Hand) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    @property
    def identity(self) -> dict[str, str]:
        """Name, side and digest of the hand, as files of grasps keep them."""
        return {"hand": self.spec.name, "side": self.spec.side, "digest": self.digest}

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
            values = (*shapes, self._pads)
            with torch.inference_mode(False):  # else a first call in inference mode would bar gradients from then on
                tree = KinematicTree(self.chain, self.link_names, self.joint_names, like.dtype, like.device)
                self._constants[key] = _Constants(tree, *(value.to(*key) for value in values))
        return self._constants[key]

    def random(self, num: int, generator: torch.Generator) -> Float[Tensor, "num joint"]:
        """Draw postures evenly within the limits, coupled, among those that do not touch themselves.

        Args:
            num: Number of postures.
            generator: Source of randomness.

        Returns:
            Angles of all joints.

        Raises:
            RuntimeError: Fewer than one posture in a hundred is free of self-collision.
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

    def forward_kinematics(self, q20: Float[Tensor, "*batch joint"]) -> Float[Tensor, "*batch link 4 4"]:
        """Poses of all links in the palm frame, in the order of `link_names`; differentiable once.

        Args:
            q20: Angles of all joints.

        Returns:
            Homogeneous matrices.

        Raises:
            ValueError: The number of angles is wrong.
        """
        self._check_size(q20)
        poses: Tensor = LinkPoses.apply(q20.reshape(-1, q20.shape[-1]), self._cast(q20).tree)
        return poses.reshape(*q20.shape[:-1], len(self.link_names), 4, 4)

    def jacobian(
        self, q20: Float[Tensor, "*batch joint"], link: str, point: Float[Tensor, " 3"] | None = None
    ) -> Float[Tensor, "*batch 6 joint"]:
        """Velocity of a point of a link by joint velocities, in the palm frame.

        Args:
            q20: Angles of all joints.
            link: Name of the link.
            point: Point in the frame of the link, meters; its origin if not given.

        Returns:
            Linear velocity in rows 0:3, angular velocity in rows 3:6.

        Raises:
            ValueError: The link is unknown.
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
        """Place of a link in `link_names`.

        Args:
            name: Name of the link.

        Raises:
            ValueError: There is no such link; the error names the nearest.
        """
        if name not in self.link_names:
            near = difflib.get_close_matches(name, self.link_names, 1)
            raise ValueError(
                f"hand {self.spec.name} has no link {name!r}" + (f", did you mean {near[0]}?" if near else "")
            )
        return self.link_names.index(name)

    def pads(self, links: Float[Tensor, "*batch link 4 4"]) -> tuple[Tensor, Tensor]:
        """Contact points of the fingertips.

        Args:
            links: Link poses.

        Returns:
            Points and outward normals, each (*batch, pad, 3), in the order of `pad_names`.
        """
        poses = links[..., self._pad_link, :, :]
        turn, pads = poses[..., :3, :3], self._cast(links).pads[..., None]
        return (turn @ pads[0]).squeeze(-1) + poses[..., :3, 3], (turn @ pads[1]).squeeze(-1)

    def shape_poses(self, links: Float[Tensor, "*batch link 4 4"]) -> Float[Tensor, "*batch shape 4 4"]:
        """Poses of the primitives.

        Args:
            links: Link poses.
        """
        return links[..., self._shape_link, :, :] @ self._cast(links).shape_pose

    def signed_distance(
        self, links: Float[Tensor, "*batch link 4 4"], points: Float[Tensor, "*cloud point 3"]
    ) -> Float[Tensor, "*both solid point"]:
        """Distance in meters from points to the surface of each solid link, negative inside.

        Exact for capsules and boxes. If several primitives make one link, the nearest counts, so a point in two of them
        may lie deeper. Differentiable once.

        Args:
            links: Link poses in the frame of the points.
            points: Points in meters; they broadcast against the poses.
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
        """Distance in meters from each solid link to the closest of the points, negative inside; inf without points.

        The least of `signed_distance` over the points, in less time if a gradient is wanted: it is taken of the closest
        points alone.

        Args:
            links: Link poses in the frame of the points.
            points: Points in meters; they broadcast against the poses.
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
        """Distance in meters between the links of each of `self_pairs`, negative where they overlap.

        The pairs are all solid links that neither share a joint nor are excluded in hand.yaml, as in the simulator.
        Overlap is measured by the deepest point of one link's core (a capsule's axis, a box's edge) in the other.

        Args:
            links: Link poses.
        """
        constants = self._cast(links)
        poses = self.shape_poses(links).reshape(-1, len(self.shapes), 4, 4)
        distance = self._pairs.distance(poses, constants.shape_half, constants.shape_radius, len(self.self_pairs))
        return distance.reshape(*links.shape[:-3], len(self.self_pairs))

    def self_overlap(self, links: Float[Tensor, "*batch link 4 4"]) -> Float[Tensor, "*batch pair"]:
        """Meters by which the links of each of `self_pairs` overlap, 0 if they do not.

        Two to three times as fast as `self_distance`, since most pairs are too far apart to be looked at.

        Args:
            links: Link poses.
        """
        constants = self._cast(links)
        poses = self.shape_poses(links).reshape(-1, len(self.shapes), 4, 4)
        overlap = self._pairs.overlap(poses, constants.shape_half, constants.shape_radius, len(self.self_pairs))
        return overlap.reshape(*links.shape[:-3], len(self.self_pairs))

    def clearance(
        self, links: Float[Tensor, "*batch link 4 4"], plane: Float[Tensor, "*plane 4"]
    ) -> Float[Tensor, "*both solid"]:
        """Smallest height in meters of each solid link over a plane, negative below it.

        Args:
            links: Link poses.
            plane: Unit normal and offset (height = normal . p + offset) in the frame of the link poses; it broadcasts
                against them.
        """
        poses = self.shape_poses(links)
        half, radius = self._cast(links).shape_half, self._cast(links).shape_radius
        normal, offset = plane[..., None, :3], plane[..., None, 3]
        height = (poses[..., :3, 3] * normal).sum(-1) + offset
        reach = ((normal[..., None, :] @ poses[..., :3, :3]).squeeze(-2).abs() * half).sum(-1) + radius
        low = height - reach
        return torch.stack([low[..., group].amin(-1) for group in self._shape_groups], dim=-1)

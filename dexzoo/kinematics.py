"""Forward kinematics of a tree of joints for many postures at once, with its own backward pass.

Poses are kept as planes, one for each entry of the matrices, each (link, batch): a product of poses is then a few
multiplications of long rows, which is an order of magnitude faster than a batched product of small matrices. The
gradient needs no graph: a joint turns all links behind it about its axis, so its share is a sum over its subtree.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from dexzoo.hand_spec import HandSpec, Joint


@dataclass(frozen=True)
class _Level:
    """Joints of one depth: rows of their parents among the level before, of their angles, and of their links."""

    parents: list[int]
    angles: list[int]
    links: list[int]
    terms: Tensor  # (3, 3, 4, joint, 1): constant, sine and 1 - cosine terms of each joint's transform


class KinematicTree:
    """The joints of a hand by depth, in one dtype and on one device."""

    def __init__(self, spec: HandSpec, dtype: torch.dtype, device: torch.device) -> None:
        self.num_links = len(spec.link_names)
        depth = {spec.palm: 0}
        levels: list[list[Joint]] = []
        for joint in spec.joints:
            depth[joint.child] = depth[joint.parent] + 1
            if len(levels) < depth[joint.child]:
                levels.append([])
            levels[depth[joint.child] - 1].append(joint)
        self.palm = spec.link_names.index(spec.palm)
        self.levels: list[_Level] = []
        before = [spec.palm]
        for level in levels:
            terms = np.stack([_joint_terms(joint) for joint in level], axis=-1)[..., None]
            self.levels.append(
                _Level(
                    [before.index(joint.parent) for joint in level],
                    # a fixed joint may read any angle, since its terms do not depend on it
                    [0 if joint.axis is None else spec.joint_names.index(joint.name) for joint in level],
                    [spec.link_names.index(joint.child) for joint in level],
                    torch.tensor(terms, dtype=dtype, device=device),
                )
            )
            before = [joint.child for joint in level]
        moving = [spec.joint(name) for name in spec.joint_names]
        self.joint_links = [spec.link_names.index(joint.child) for joint in moving]
        axes = np.stack([joint.axis for joint in moving if joint.axis is not None], axis=-1)
        self.axes = torch.tensor(axes[..., None], dtype=dtype, device=device)  # (3, joint, 1) in the child's frame
        self.behind = torch.tensor(_descendants(spec), dtype=dtype, device=device)  # (joint, link)

    def planes(self, q: Float[Tensor, "joint batch"]) -> Float[Tensor, "3 4 link batch"]:
        """The upper three rows of all link poses in the palm frame."""
        sine, versine = torch.sin(q), 1 - torch.cos(q)
        planes = q.new_zeros(3, 4, self.num_links, q.shape[-1])
        for i in range(3):
            planes[i, i, self.palm] = 1
        pose: Tensor | None = None
        for level in self.levels:
            constant, by_sine, by_versine = level.terms
            step = torch.addcmul(constant + by_sine * sine[level.angles], by_versine, versine[level.angles])
            pose = step if pose is None else _compose(pose[:, :, level.parents], step)
            planes[:, :, level.links] = pose
        return planes


class LinkPoses(torch.autograd.Function):
    """Link poses (batch, link, 4, 4) of postures (batch, joint)."""

    @staticmethod
    def forward(ctx: Any, q: Tensor, tree: KinematicTree) -> Tensor:  # noqa: ANN401, torch's own type is untyped
        """Poses; keeps what the gradient needs."""
        planes = tree.planes(q.T.contiguous())
        ctx.save_for_backward(planes)
        ctx.tree = tree
        poses = q.new_zeros(len(q), tree.num_links, 4, 4)
        poses[..., :3, :] = planes.permute(3, 2, 0, 1)
        poses[..., 3, 3] = 1
        return poses

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:  # noqa: ANN401
        """For each joint, axis . (moment of its subtree about it), columns of a pose weighed as points."""
        (planes,) = ctx.saved_tensors
        tree: KinematicTree = ctx.tree
        force = gradient[..., :3, :].permute(2, 3, 1, 0).contiguous()  # (3, 4, link, batch)
        moment = tree.behind @ _cross(planes, force).sum(1)  # (3, joint, batch), about the palm's origin
        push = tree.behind @ force[:, 3]
        turn, origin = planes[:, :3, tree.joint_links], planes[:, 3, tree.joint_links]
        axis = (turn * tree.axes).sum(1)
        return (axis * (moment - _cross(origin, push))).sum(0).T, None


def _compose(first: Tensor, then: Tensor) -> Tensor:
    """Products of poses given as planes (3, 4, joint, batch)."""
    out = first[:, 0, None] * then[0]
    out = torch.addcmul(out, first[:, 1, None], then[1])
    out = torch.addcmul(out, first[:, 2, None], then[2])
    out[:, 3] += first[:, 3]
    return out


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross products along the first dimension."""
    return torch.stack((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))


def _descendants(spec: HandSpec) -> NDArray[np.float64]:
    """(joint, link): 1 where the link moves with the joint."""
    behind = np.zeros((len(spec.joint_names), len(spec.link_names)))
    carriers: dict[str, list[str]] = {spec.palm: []}
    for joint in spec.joints:
        own = [] if joint.axis is None else [joint.name]
        carriers[joint.child] = carriers[joint.parent] + own
    for link, names in carriers.items():
        for name in names:
            behind[spec.joint_names.index(name), spec.link_names.index(link)] = 1
    return behind


def _joint_terms(joint: Joint) -> NDArray[np.float64]:
    """(3, 3, 4): a joint's transform is O + sin(a) O K + (1 - cos(a)) O K K (Rodrigues).

    O is its origin, K the cross product matrix of its axis.
    """
    origin = joint.origin[:3]
    if joint.axis is None:
        return np.stack((origin, 0 * origin, 0 * origin))
    x, y, z = joint.axis
    cross = np.zeros((4, 4))
    cross[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    return np.stack((origin, origin @ cross, origin @ cross @ cross))

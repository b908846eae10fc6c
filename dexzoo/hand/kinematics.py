"""Forward kinematics of a hand for many postures at once, with an analytic backward pass.

The kinematic chain is one of pytorch_kinematics, built from the URDF's joints in double precision. `KinematicTree` is a
fast evaluation of that chain, whose tables are taken from it. It keeps poses as planes, one for each entry of the
matrices, each (link, batch): a product of poses is then a few multiplications of long rows, which is an order of
magnitude faster than a batched product of small matrices. The gradient needs no graph: a joint turns all links behind
it about its axis, so its share is a sum over its subtree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytorch_kinematics
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from pytorch_kinematics.frame import Frame, Joint, Link
from torch import Tensor
from torch.autograd.function import once_differentiable

from dexzoo.hand.spec import HandSpec


def build_chain(spec: HandSpec) -> pytorch_kinematics.Chain:
    """Build the pytorch_kinematics chain of a hand, float64, rooted at the palm.

    Args:
        spec: Tables of the hand.

    Returns:
        The chain. Its frames and links bear the names of the URDF's links. Coupled joints are joints of their own: give
        it the angles of `Hand.expand`.
    """
    frames = {spec.palm: Frame(spec.palm, Link(spec.palm), Joint(dtype=torch.float64))}
    for joint in spec.joints:
        offset = pytorch_kinematics.Transform3d(matrix=torch.tensor(joint.origin)[None], dtype=torch.float64)
        kind = "fixed" if joint.axis is None else "revolute"
        axis = None if joint.axis is None else torch.tensor(joint.axis)
        limits, efforts = (joint.lower, joint.upper), (-joint.effort, joint.effort)
        moved = Joint(joint.name, offset, kind, axis, torch.float64, limits=limits, effort_limits=efforts)
        frames[joint.child] = Frame(joint.child, Link(joint.child), moved)
        frames[joint.parent].add_child(frames[joint.child])
    return pytorch_kinematics.Chain(frames[spec.palm], dtype=torch.float64)


@dataclass(frozen=True)
class _Level:
    """Joints of one depth: rows of their parents among the level before, of their angles, and of their links."""

    parents: list[int]
    angles: list[int]
    links: list[int]
    terms: Tensor  # (3, 3, 4, joint, 1): constant, sine and 1 - cosine terms of each joint's transform


class KinematicTree:
    """The joints of a chain by depth, in one dtype and on one device.

    Args:
        chain: Chain of the hand.
        link_names: Order of the links in the results; the first is the root.
        joint_names: Order of the angles.
        dtype: Floating-point type of the tables.
        device: Device of the tables.
    """

    def __init__(
        self,
        chain: pytorch_kinematics.Chain,
        link_names: Sequence[str],
        joint_names: Sequence[str],
        dtype: torch.dtype,
        device: torch.device,
    ) -> None:
        links, joints = list(link_names), list(joint_names)
        self.num_links = len(links)
        self.palm = 0
        self.levels: list[_Level] = []
        carriers: dict[str, list[str]] = {links[0]: []}  # joints that move each link
        moving: dict[str, Frame] = {}
        before: list[Frame] = [chain.find_frame(links[0])]
        while children := [(row, child) for row, frame in enumerate(before) for child in frame.children]:
            level = [child for _, child in children]
            for row, child in children:
                moves = child.joint.joint_type != "fixed"
                carriers[child.name] = carriers[before[row].name] + [child.joint.name] * moves
                moving |= {child.joint.name: child} if moves else {}
            terms = np.stack([_joint_terms(child.joint) for child in level], axis=-1)[..., None]
            self.levels.append(
                _Level(
                    [row for row, _ in children],
                    # a fixed joint may read any angle, since its terms do not depend on it
                    [joints.index(child.joint.name) if child.joint.name in moving else 0 for child in level],
                    [links.index(child.name) for child in level],
                    torch.tensor(terms, dtype=dtype, device=device),
                )
            )
            before = level
        self.joint_links = [links.index(moving[name].name) for name in joints]
        axes = torch.stack([moving[name].joint.axis for name in joints], dim=-1)[..., None]
        self.axes = axes.to(device, dtype)  # (3, joint, 1) in the child's frame
        behind = [[float(name in carriers[link]) for link in links] for name in joints]
        self.behind = torch.tensor(behind, dtype=dtype, device=device)  # (joint, link): 1 where the link moves with it

    def planes(self, q: Float[Tensor, "joint batch"]) -> Float[Tensor, "3 4 link batch"]:
        """The upper three rows of all link poses in the palm frame.

        Args:
            q: Joint angles, radians.
        """
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
        """Poses; keeps what the gradient needs.

        Args:
            ctx: Context of torch.
            q: Joint angles, radians, (batch, joint).
            tree: Tables of the hand.
        """
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
        """For each joint, axis . (moment of its subtree about it), columns of a pose weighed as points.

        Args:
            ctx: Context of torch.
            gradient: Gradient by the poses, (batch, link, 4, 4).
        """
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


def _joint_terms(joint: Joint) -> NDArray[np.float64]:
    """(3, 3, 4): a joint's transform is O + sin(a) O K + (1 - cos(a)) O K K (Rodrigues).

    O is its origin, K the cross product matrix of its axis.
    """
    origin = joint.offset.get_matrix()[0, :3].numpy()
    if joint.joint_type == "fixed":
        return np.stack((origin, 0 * origin, 0 * origin))
    x, y, z = joint.axis.tolist()
    cross = np.zeros((4, 4))
    cross[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    return np.stack((origin, origin @ cross, origin @ cross @ cross))

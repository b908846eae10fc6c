"""Unit quaternions in wxyz order with w >= 0, rotation matrices, poses, and steps in their tangent space.

Everything is batched over leading dimensions and differentiable. Other quaternion orders are converted here
and nowhere else.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

_TINY = 1e-12


def check_pose(pose: object, name: str) -> Float[Tensor, "4 4"]:
    """Check that a pose is a rigid motion.

    Args:
        pose: Anything that torch makes a 4 x 4 matrix of.
        name: Name of the pose in the error.

    Returns:
        The pose, float64.

    Raises:
        ValueError: The pose is not finite, not 4 x 4, or its rotation is not orthonormal and right-handed.
    """
    T = torch.as_tensor(pose, dtype=torch.float64)
    if T.shape != (4, 4) or not torch.isfinite(T).all():
        raise ValueError(f"{name} must be a finite 4 x 4 matrix, got shape {tuple(T.shape)}")
    turn = T[:3, :3]
    if (turn @ turn.T - torch.eye(3).to(T)).abs().max() > 1e-3 or torch.linalg.det(turn) < 0:
        raise ValueError(f"{name}'s rotation is not orthonormal and right-handed")
    return T


def normalize(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Scale to unit length and choose the sign with w >= 0.

    Args:
        quaternion: Quaternions of any length but zero, wxyz.
    """
    unit = quaternion / quaternion.norm(dim=-1, keepdim=True).clamp_min(_TINY)
    return torch.where(unit[..., :1] < 0, -unit, unit)


def multiply(a: Float[Tensor, "... 4"], b: Float[Tensor, "... 4"]) -> Float[Tensor, "... 4"]:
    """Hamilton product: the rotation that applies b first, then a. The product is not normalized.

    Args:
        a: Unit quaternions, wxyz.
        b: Unit quaternions, wxyz; leading dimensions broadcast.
    """
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ),
        dim=-1,
    )


def conjugate(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """The inverse rotation.

    Args:
        quaternion: Unit quaternions, wxyz.
    """
    return torch.cat((quaternion[..., :1], -quaternion[..., 1:]), dim=-1)


def rotate(quaternion: Float[Tensor, "... 4"], vector: Float[Tensor, "... 3"]) -> Float[Tensor, "... 3"]:
    """Rotate vectors.

    Args:
        quaternion: Unit quaternions, wxyz.
        vector: Vectors; leading dimensions broadcast.
    """
    u, vector = torch.broadcast_tensors(quaternion[..., 1:], vector)
    twice = 2.0 * torch.cross(u, vector, dim=-1)
    return vector + quaternion[..., :1] * twice + torch.cross(u, twice, dim=-1)


def to_matrix(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """The rotation matrix of a rotation.

    Args:
        quaternion: Unit quaternions, wxyz.
    """
    w, x, y, z = quaternion.unbind(-1)
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(*w.shape, 3, 3)


def from_matrix(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """The unit quaternion of a rotation matrix, by the branch with the largest divisor (Shepperd 1978).

    Args:
        matrix: Rotation matrices.
    """
    m = matrix
    trace = m.diagonal(dim1=-2, dim2=-1).sum(-1)
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    # four times the products of q with each of its own components; each row is parallel to q
    rows = torch.stack(
        (
            torch.stack((1 + trace, m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0],
                         m[..., 1, 0] - m[..., 0, 1]), -1),
            torch.stack((m[..., 2, 1] - m[..., 1, 2], 1 + xx - yy - zz, m[..., 1, 0] + m[..., 0, 1],
                         m[..., 0, 2] + m[..., 2, 0]), -1),
            torch.stack((m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] + m[..., 0, 1], 1 - xx + yy - zz,
                         m[..., 2, 1] + m[..., 1, 2]), -1),
            torch.stack((m[..., 1, 0] - m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 2, 1] + m[..., 1, 2],
                         1 - xx - yy + zz), -1),
        ),
        dim=-2,
    )  # fmt: skip
    best = torch.stack((trace, xx, yy, zz), -1).argmax(-1)
    row = torch.take_along_dim(rows, best[..., None, None].expand(*best.shape, 1, 4), dim=-2).squeeze(-2)
    return normalize(row)


def from_xyzw(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Convert from the xyzw order of SciPy and ROS.

    Args:
        quaternion: Unit quaternions, xyzw.
    """
    return normalize(quaternion.roll(1, dims=-1))


def to_xyzw(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Convert to the xyzw order of SciPy and ROS.

    Args:
        quaternion: Unit quaternions, wxyz.
    """
    return quaternion.roll(-1, dims=-1)


def exp(tangent: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4"]:
    """The rotation by |tangent| radians about tangent; smooth at zero.

    Args:
        tangent: Rotation vectors, radians.
    """
    square = (tangent * tangent).sum(-1, keepdim=True)
    angle = square.clamp_min(_TINY).sqrt()
    small = square < 1e-8
    half_sinc = torch.where(small, 0.5 - square / 48, torch.sin(angle / 2) / angle)
    cosine = torch.where(small, 1 - square / 8, torch.cos(angle / 2))
    return normalize(torch.cat((cosine, half_sinc * tangent), dim=-1))


def log(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3"]:
    """The shortest rotation vector t with exp(t) = quaternion, in radians.

    Args:
        quaternion: Unit quaternions, wxyz.
    """
    quaternion = normalize(quaternion)
    w, u = quaternion[..., :1], quaternion[..., 1:]
    square = (u * u).sum(-1, keepdim=True)
    length = square.clamp_min(_TINY).sqrt()
    scale = torch.where(square < 1e-8, 2 + square / 3, 2 * torch.atan2(length, w) / length)
    return scale * u


def angle(a: Float[Tensor, "... 4"], b: Float[Tensor, "... 4"]) -> Float[Tensor, "*batch"]:
    """The angle between two rotations, radians in [0, pi].

    Args:
        a: Unit quaternions, wxyz.
        b: Unit quaternions, wxyz; leading dimensions broadcast.
    """
    radians: Tensor = log(multiply(conjugate(a), b)).norm(dim=-1)
    return radians


def slerp(a: Float[Tensor, "... 4"], b: Float[Tensor, "... 4"], t: Float[Tensor, "*step"]) -> Float[Tensor, "... 4"]:
    """Interpolate on the shortest path between two rotations (Shoemake 1985).

    Args:
        a: Unit quaternions at t = 0, wxyz.
        b: Unit quaternions at t = 1, wxyz.
        t: Share of the path.
    """
    step = log(multiply(conjugate(a), b))
    return normalize(multiply(a, exp(t[..., None] * step)))


def from_axis_angle(axis: Float[Tensor, "... 3"], radians: Float[Tensor, "*angle"]) -> Float[Tensor, "... 4"]:
    """The rotation about an axis.

    Args:
        axis: Unit vectors.
        radians: Angles.
    """
    return exp(axis * radians[..., None])


def random(num: int, generator: torch.Generator) -> Float[Tensor, "num 4"]:
    """Uniformly distributed rotations.

    Args:
        num: Number of rotations.
        generator: Source of randomness.
    """
    return normalize(torch.randn(num, 4, generator=generator))


def pose_matrix(
    position: Float[Tensor, "*batch 3"], quaternion: Float[Tensor, "*batch 4"]
) -> Float[Tensor, "*batch 4 4"]:
    """Homogeneous matrices of poses.

    Args:
        position: Origins, meters.
        quaternion: Orientations, unit, wxyz.
    """
    top = torch.cat((to_matrix(quaternion), position[..., None]), dim=-1)
    bottom = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*top.shape[:-2], 1, 4)
    return torch.cat((top, bottom), dim=-2)


def step_pose(
    pose: Float[Tensor, "*batch 4 4"], tangent: Float[Tensor, "*batch 6"], box: Float[Tensor, 6] | None = None
) -> Float[Tensor, "*batch 4 4"]:
    """Move poses in the tangent space of SE(3).

    Args:
        pose: Poses.
        tangent: Translation in meters and rotation vector in radians, in the poses' own frames.
        box: Half sizes of the box that a step stays in, smoothly: a step of t is box * tanh(t / box).
    """
    step = tangent if box is None else box * torch.tanh(tangent / box)
    return pose @ pose_matrix(step[..., :3], exp(step[..., 3:]))


def in_frame(pose: Float[Tensor, "*batch 4 4"], points: Float[Tensor, "*cloud point 3"]) -> Tensor:
    """Points in the frames of poses; quicker than to bring a whole hand to the points.

    Args:
        pose: Poses in the frame of the points.
        points: Points, meters; they broadcast against the poses.

    Returns:
        Points, (*both, point, 3).
    """
    return (points - pose[..., None, :3, 3]) @ pose[..., :3, :3]

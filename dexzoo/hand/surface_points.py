"""Points on the hand: few, even, on the side that grasps."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from dexzoo.hand import Hand
from dexzoo.hand.distances import box_slope

_CANDIDATES = 1000
_FACING = 0.2
"""Least cosine between a point's normal and the inner direction of its link."""

_CLEAR = 0.001
"""Meters before a point that must be clear of its own link, which may have other primitives there."""


def surface_points(hand: Hand, count: int) -> tuple[Float[Tensor, "shape {count} 3"], Float[Tensor, "shape {count} 3"]]:
    """Points and outward unit normals on the inner side of each primitive, in its own frame; float64.

    Of evenly spread candidates on the surface of the hand the innermost is taken first, then always the one farthest
    from those taken. Points that other primitives of the same link cover are left out.

    Args:
        hand: The hand.
        count: Points on each primitive.
    """
    zero = torch.zeros(len(hand.joint_names), dtype=torch.float64)
    links = hand.forward_kinematics(zero)
    poses = hand.shape_poses(links)
    inner = _inner_directions(hand, links)
    points, normals = [], []
    for i, shape in enumerate(hand.shapes):
        half = torch.tensor(shape.half)
        candidates = _spread(_CANDIDATES)
        # central projection to a box around the shape, from there to the nearest point of its surface
        around = (half + shape.radius + 0.01) * candidates / candidates.abs().amax(1, keepdim=True)
        normal = box_slope(around.T.clone(), half[:, None]).T
        surface = torch.minimum(torch.maximum(around, -half), half) + shape.radius * normal
        before = (surface + _CLEAR * normal) @ poses[i, :3, :3].T + poses[i, :3, 3]
        outside = hand.signed_distance(links, before)[hand.solid_names.index(shape.link)] > _CLEAR - 1e-6
        facing = normal @ poses[i, :3, :3].T @ inner[shape.link]
        seen = outside & (facing > _FACING)
        surface, normal, facing = surface[seen], normal[seen], facing[seen]
        chosen = [int((facing - 0.1 * surface.norm(dim=1) / half.norm()).argmax())]
        gap = (surface - surface[chosen[0]]).norm(dim=1)
        while len(chosen) < count:
            chosen.append(int(gap.argmax()))
            gap = torch.minimum(gap, (surface - surface[chosen[-1]]).norm(dim=1))
        points.append(surface[chosen])
        normals.append(normal[chosen])
    return torch.stack(points), torch.stack(normals)


def _inner_directions(hand: Hand, links: Tensor) -> dict[str, Tensor]:
    """For each link the direction, in the palm frame at zero posture, of the side that grasps.

    For all links of a finger it is its pad's normal; for the palm and links without a finger, out of the palm.
    """
    inner = {name: torch.tensor([1.0, 0, 0], dtype=torch.float64) for name in hand.link_names}
    parent = {joint.child: joint.parent for joint in hand.spec.joints}
    for pad in hand.spec.pads.values():
        direction = links[hand.link_index(pad.link), :3, :3] @ torch.tensor(pad.normal)
        link = pad.link
        while link != hand.spec.palm:
            inner[link] = direction
            link = parent[link]
    return inner


def _spread(count: int) -> Tensor:
    """Unit vectors evenly spread over the sphere (Fibonacci lattice)."""
    k = torch.arange(count, dtype=torch.float64) + 0.5
    z, turn = 1 - 2 * k / count, math.pi * (1 + math.sqrt(5)) * k
    flat = (1 - z * z).sqrt()
    return torch.stack((flat * turn.cos(), flat * turn.sin(), z), dim=1)

"""Neighbors of grasps: an evaluator must know them before it may guide refinement."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dexzoo import rotation
from dexzoo.data.schema import decode_path, encode_path
from dexzoo.grasp import Grasps

WRIST_STEP = (0.002, 0.015)
"""Meters that a wrist is moved by, in any direction."""
WRIST_TURN = (0.03, 0.2)
"""Radians that it is turned by, about any axis."""
JOINT_STEP = (0.03, 0.15)
"""Radians that the joint that moves most is changed by."""
MOST_OF_ONE = 8
"""Neighbors at most of each grasp that holds, on average."""


def choose(success: NDArray[np.bool_], num: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Choose the grasps whose neighbors are tried: two thirds of them hold, if there are enough.

    Args:
        success: Whether each grasp held, (grasp,).
        num: Number of neighbors.
        rng: Source of randomness.

    Returns:
        Indices of the grasps, (num,).
    """
    held, failed = np.flatnonzero(success), np.flatnonzero(~success)
    around_held = min(2 * num // 3, MOST_OF_ONE * len(held)) if len(failed) else num
    around_failed = num - around_held
    return np.concatenate(
        (
            rng.choice(held, around_held) if around_held else held[:0],
            rng.choice(failed, around_failed) if around_failed else failed[:0],
        )
    )


def perturb(grasps: Grasps, rng: np.random.Generator) -> Grasps:
    """A neighbor of each grasp, both in the world frame, within the ranges above.

    The whole path moves with the wrist; the joints of grip and squeeze change alike, those of the pre-grasp do not.

    Args:
        grasps: Grasps in the world frame.
        rng: Source of randomness.
    """
    n, hand = len(grasps), grasps.hand
    key = torch.from_numpy(encode_path(grasps)).unflatten(-1, (3, 7 + len(hand.freedoms)))

    def direction() -> Tensor:
        return torch.nn.functional.normalize(torch.tensor(rng.normal(size=(n, 3)), dtype=torch.float32), dim=-1)

    def size(limits: tuple[float, float]) -> Tensor:
        return torch.tensor(rng.uniform(*limits, (n, 1)), dtype=torch.float32)

    position = key[..., :3] + (direction() * size(WRIST_STEP))[:, None]
    step = rotation.exp(direction() * size(WRIST_TURN))
    quaternion = rotation.normalize(rotation.multiply(key[..., 3:7], step[:, None]))
    change = torch.tensor(rng.uniform(-1, 1, (n, len(hand.freedoms))), dtype=torch.float32)
    change *= size(JOINT_STEP) / change.abs().amax(-1, keepdim=True)
    joints = key[..., 7:].clone()
    joints[:, 1:] += change[:, None]
    near = torch.cat((position, quaternion, hand.clamp(joints)), -1).flatten(1)
    return decode_path(near.numpy(), grasps.grasp_type, hand)

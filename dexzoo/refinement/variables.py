"""The numbers that refinement moves, each between -1 and 1, and the grasps that follow from them.

-1 and 1 are the borders of the trust region around the given grasp. A state in the box is within the trust region,
within the limits of the joints and a path of ten waypoints, whatever an optimizer makes of it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from dexzoo import rotation
from dexzoo.grasp import KEYFRAMES, Trajectory
from dexzoo.hand import Hand
from dexzoo.refinement.trust_region import TrustRegion


@runtime_checkable
class Variables(Protocol):
    """States between -1 and 1, and the grasps that follow from them.

    Attributes:
        start: State of the given grasps, (grasp, number).
        stages: Which numbers are moved first, and which then; 1 or 0, (stage, number).
    """

    start: Tensor
    stages: Tensor

    def __call__(self, state: Float[Tensor, "grasp number"]) -> Trajectory:
        """The grasps of a state; differentiable."""


MakeVariables = Callable[[Trajectory, Hand, TrustRegion], Variables]


class GripVariables:
    """The grip's wrist (6 numbers in the tangent space of SE(3)), its free joints, opening and squeeze (2).

    The wrist carries the whole path along rigidly. Keyframes follow from the numbers, and all waypoints from them, so
    grasps that are not made of keyframes become so.

    Args:
        grasps: The given grasps, in the world frame.
        hand: The hand.
        trust_region: How far to go.
    """

    def __init__(self, grasps: Trajectory, hand: Hand, trust_region: TrustRegion) -> None:
        self.hand, self.trust_region = hand, trust_region
        keys = grasps.waypoint(KEYFRAMES)
        self.grasp_type = grasps.grasp_type
        self.place, self.turn = keys.position[:, 1:2], keys.quaternion[:, 1:2]
        back = rotation.conjugate(self.turn)
        self.place_in_palm = rotation.rotate(back, keys.position - self.place)
        self.turn_in_palm = rotation.multiply(back, keys.quaternion)
        self.joints = self.moved_joints(hand.clamp(keys.joints))
        lower, upper = self.moved_joints(hand.lower), self.moved_joints(hand.upper)
        grip = self.joints[:, 1]
        self.low = torch.maximum(lower.to(grip), grip - trust_region.joint)
        self.width = torch.minimum(upper.to(grip), grip + trust_region.joint) - self.low
        start = 2 * (grip - self.low) / self.width - 1
        self.start = torch.cat((start.new_zeros(len(start), 6), start, start.new_zeros(len(start), 2)), -1)
        wrist = torch.arange(self.start.shape[1]) < 6
        self.stages = torch.stack((wrist, ~wrist)).to(start)

    def moved_joints(self, joints: Float[Tensor, "*batch joint"]) -> Float[Tensor, "*batch number"]:
        """The joints that are moved by themselves, among all.

        Args:
            joints: Angles of all joints.
        """
        return self.hand.reduce(joints)

    def all_joints(self, moved: Float[Tensor, "*batch number"]) -> Float[Tensor, "*batch joint"]:
        """All joints, from those that are moved by themselves.

        Args:
            moved: Angles of the joints that are moved.
        """
        return self.hand.expand(moved)

    def __call__(self, state: Float[Tensor, "grasp number"]) -> Trajectory:
        """The grasps of a state; differentiable."""
        region = self.trust_region
        step = rotation.rotate(self.turn, region.wrist * state[:, None, :3])
        turn = rotation.multiply(self.turn, rotation.exp(region.turn * state[:, None, 3:6]))
        position = self.place + step + rotation.rotate(turn, self.place_in_palm)
        quaternion = rotation.normalize(rotation.multiply(*torch.broadcast_tensors(turn, self.turn_in_palm)))
        opening, squeeze = region.opening * state[:, -2:-1], region.squeeze * state[:, -1:]
        before, given, after = self.joints.unbind(1)
        grip = self.low + self.width * (state[:, 6:-2] + 1) / 2
        keys = (before + opening * (before - given), grip, grip + (1 + squeeze) * (after - given))
        joints = self.all_joints(self.hand.clamp(torch.stack(keys, 1)))
        return Trajectory.from_keyframes(position, quaternion, joints, self.grasp_type)

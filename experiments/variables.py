"""Other numbers for refinement to move than those of `GripVariables`, for `dexzoo.refine(..., variables=...)`."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from dexzoo import rotation
from dexzoo.grasp import NUM_WAYPOINTS, Trajectory
from dexzoo.hand import Hand
from dexzoo.refinement.trust_region import TrustRegion
from dexzoo.refinement.variables import GripVariables


class UncoupledVariables(GripVariables):
    """As `GripVariables`, but all joints are moved one by one, whatever couples them in the hand.

    Args:
        grasps: The given grasps, in the world frame.
        hand: The hand.
        trust_region: How far to go.
    """

    def moved_joints(self, joints: Float[Tensor, "*batch joint"]) -> Float[Tensor, "*batch number"]:
        """All joints.

        Args:
            joints: Angles of all joints.
        """
        return joints

    def all_joints(self, moved: Float[Tensor, "*batch number"]) -> Float[Tensor, "*batch joint"]:
        """The joints as they are moved.

        Args:
            moved: Angles of all joints.
        """
        return moved


class WaypointVariables:
    """Wrist and joints of all ten waypoints, each number for itself, as in the thesis but within the trust region.

    Quaternions are made unit again. The trust region's opening and squeeze are not used.

    Args:
        grasps: The given grasps, in the world frame.
        hand: The hand.
        trust_region: How far each number goes; a turn is twice the change of a quaternion's numbers.

    Attributes:
        start: See `dexzoo.refinement.variables.Variables`.
        stages: See there.
    """

    def __init__(self, grasps: Trajectory, hand: Hand, trust_region: TrustRegion) -> None:
        self.grasp_type = grasps.grasp_type
        given = torch.cat((grasps.wrist, grasps.joints), -1)
        num_joints = grasps.joints.shape[-1]
        sizes = [trust_region.wrist] * 3 + [trust_region.turn / 2] * 4 + [trust_region.joint] * num_joints
        reach = given.new_tensor(sizes)
        low, high = given - reach, given + reach
        self.low = torch.cat((low[..., :7], torch.maximum(low[..., 7:], hand.lower.to(low))), -1)
        self.width = torch.cat((high[..., :7], torch.minimum(high[..., 7:], hand.upper.to(high))), -1) - self.low
        self.start = (2 * (given - self.low) / self.width - 1).clamp(-1, 1).flatten(1)
        wrist = (torch.arange(len(sizes)) < 7).repeat(NUM_WAYPOINTS)
        self.stages = torch.stack((wrist, ~wrist)).to(given)

    def __call__(self, state: Float[Tensor, "grasp number"]) -> Trajectory:
        """The grasps of a state; differentiable.

        Args:
            state: Numbers between -1 and 1.
        """
        numbers = self.low + self.width * (state.unflatten(1, (NUM_WAYPOINTS, -1)) + 1) / 2
        quaternion = rotation.normalize(numbers[..., 3:7])
        return Trajectory(torch.cat((numbers[..., :3], quaternion), -1), numbers[..., 7:], self.grasp_type)

"""Hands at some waypoints of their grasps: poses of all links, and distances from them.

Everything is looked at in the palm's frame: it is quicker to bring points and planes there than all links to the world.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from dexzoo.grasp import GRIP, PREGRASP, Trajectory
from dexzoo.hand import Hand
from dexzoo.perception.memo import Memo
from dexzoo.rotation import in_frame

MOMENTS = (PREGRASP, GRIP // 2, GRIP)
"""The waypoints at which the hand is looked at; beyond the grip it is meant to press."""
NUM_NEAR = 128
"""Points of a kind that are looked at around each hand: enough for the trust region."""


class PosedHand(Memo):
    """Hands of some grasps at some waypoints; poses are computed on demand, and terms share results by `once`.

    Args:
        hand: The hand.
        grasps: Grasps in the world frame.
        waypoints: Waypoints at which the hand is looked at, in order.
    """

    def __init__(self, hand: Hand, grasps: Trajectory, waypoints: Sequence[int] = MOMENTS) -> None:
        super().__init__()
        self.hand, self.grasps, self.waypoints = hand, grasps, list(waypoints)

    @cached_property
    def _way(self) -> Trajectory:
        return self.grasps.waypoint(self.waypoints)

    @cached_property
    def wrist(self) -> Float[Tensor, "grasp moment 4 4"]:
        """Wrist poses in the world frame."""
        return self._way.wrist_pose

    @cached_property
    def links(self) -> Float[Tensor, "grasp moment link 4 4"]:
        """Link poses in the palm frame."""
        return self.hand.forward_kinematics(self._way.joints)

    @torch.no_grad()
    def nearest(self, points: Float[Tensor, "point 3"], first: int = 0) -> Float[Tensor, "grasp moment near 3"]:
        """The points nearest to any link at each moment.

        Args:
            points: Points in the world frame, meters.
            first: Place among the moments from which on they are looked at.
        """
        num = min(NUM_NEAR, len(points))
        distance = self.hand.signed_distance(self.links[:, first:], in_frame(self.wrist[:, first:], points)).amin(-2)
        return points[distance.topk(num, largest=False, sorted=False).indices]

    def closest(self, points: Tensor, first: int = 0) -> Float[Tensor, "grasp moment solid"]:
        """Distance in meters from each link to the closest of some points, negative inside.

        Args:
            points: Points in the world frame, (*cloud, point, 3).
            first: Place among the moments from which on they are looked at.
        """
        return self.hand.closest_distance(self.links[:, first:], in_frame(self.wrist[:, first:], points))

"""Approach and squeeze motion of a grip, and its collision costs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import torch
from torch import Tensor

from dexzoo import rotation
from dexzoo.generators.contact_density import Grips
from dexzoo.generators.contact_models import ContactModel
from dexzoo.generators.demonstration import Demonstration
from dexzoo.generators.generator import MAX_REACH, MIN_CLEARANCE
from dexzoo.grasp import KEYFRAMES, Grasps, Trajectory
from dexzoo.hand import Hand
from dexzoo.rotation import in_frame, pose_matrix

COLLISION_STEPS, COLLISION_WEIGHTS = (0.0, 0.4, 0.7, 0.9), (1.0, 1.0, 0.5, 0.2)
"""Shares of the way from the pre-grasp to the grip at which collisions are looked at, and their weights."""
COLLISION_COST = 4.0
THUMB_GAP_COST, FINGER_GAP_COST = 300.0, 100.0
"""Cost in log-likelihood of a meter between the surface and a finger that ought to touch it."""
NUM_POINTS = 300
NUM_NEAR = 12
"""Points of obstacles that are looked at while a grip is improved."""
TABLE_COST = 1000.0
"""Cost in log-likelihood of a meter below the least clearance."""


class ApproachMotion:
    """Approach and squeeze motion of grips, and its collision costs.

    The demonstrated path is carried over rigidly to each grip.

    Args:
        demonstrations: Demonstrations, by the rows of the grips.
        models: Contact models of each demonstration.
        hand: The hand.
        cloud: Points of the object in the world frame, seen and guessed.
        others: Points of other things on the table.
        generator: Draws the points that are looked at.
    """

    def __init__(
        self,
        demonstrations: Sequence[Demonstration],
        models: Sequence[Sequence[ContactModel]],
        hand: Hand,
        cloud: Tensor,
        others: Tensor,
        generator: torch.Generator,
    ) -> None:
        self.hand = hand
        self.points = _some(cloud, NUM_POINTS, generator)
        self.others = _some(others, 2 * NUM_POINTS, generator)
        self.surface = cloud
        self.finger_solids = [[i for i, n in enumerate(hand.solid_names) if n.startswith(f)] for f in hand.fingers]
        touching = [{hand.link_names[model.link].split("_")[0] for model in row} for row in models]
        cost = torch.tensor([THUMB_GAP_COST if finger == "thumb" else FINGER_GAP_COST for finger in hand.fingers])
        self.gap_weight = cost * torch.tensor([[finger in row for finger in hand.fingers] for row in touching])
        self.types = torch.tensor([d.grasp_type for d in demonstrations])
        keys = [demonstration.grasp.trajectory.waypoint(KEYFRAMES) for demonstration in demonstrations]
        poses = torch.cat([key.wrist_pose for key in keys])
        self.relative = torch.linalg.inv(poses[:, 1:2]) @ poses  # (demo, key, 4, 4) in the palm frame at the grip
        self.joints = hand.reduce(torch.cat([key.joints for key in keys]))

    def keyframes(self, grips: Grips) -> tuple[Tensor, Tensor]:
        """Wrist poses (grip, 3, 4, 4) and free joints (grip, 3, freedom) at pre-grasp, grip and squeeze.

        Args:
            grips: Grips.
        """
        wrist = grips.wrist[:, None] @ self.relative[grips.demo]
        far = torch.cdist(grips.wrist[:, :3, 3], self.points).amin(-1)
        back = wrist[:, 0, :3, 3] - grips.wrist[:, :3, 3]
        length = back.norm(dim=-1).clamp_min(1e-6)
        share = ((MAX_REACH - far) / length).clamp(0, 1)
        start = wrist[:, 0].clone()
        start[:, :3, 3] = grips.wrist[:, :3, 3] + share[:, None] * back
        shown = self.joints[grips.demo]
        joints = torch.stack((shown[:, 0], grips.joints, self.hand.clamp(grips.joints + shown[:, 2] - shown[:, 1])), 1)
        return torch.cat((start[:, None], wrist[:, 1:]), 1), joints

    def table_cost(self, grips: Grips, others: Tensor | None = None) -> Tensor:
        """Cost in log-likelihood of links too near to the table at the grip, where the hand is lowest.

        Args:
            grips: Grips.
            others: Points of other things on it, (point, 3) or (grip, point, 3); all of them if not given.
        """
        low = self._clearance(grips.wrist, self._links(grips), self.others if others is None else others)
        return TABLE_COST * (2 * MIN_CLEARANCE - low).clamp_min(0)

    def table_cost_near(self, grips: Grips) -> Callable[[Grips], Tensor]:
        """`table_cost` for grips that stay near these ones, by the nearest points alone.

        Args:
            grips: Grips.
        """
        distance = self.hand.signed_distance(self._links(grips), in_frame(grips.wrist, self.others)).amin(-2)
        nearest = distance.topk(min(NUM_NEAR, len(self.others)), largest=False, sorted=False).indices
        return partial(self.table_cost, others=self.others[nearest])

    def cost(self, grips: Grips) -> Tensor:
        """Kopicki's cost of collisions with the observed points during the approach, and that of the table.

        Args:
            grips: Grips.
        """
        wrist, links = self._path(grips, COLLISION_STEPS)
        distance = self.hand.signed_distance(links, in_frame(wrist, self.points))
        depth = (-distance.amin(-2)).clamp_min(0)
        weight = torch.tensor(COLLISION_WEIGHTS)[:, None]
        return self.table_cost(grips) + (weight * (torch.expm1(100 * depth))).sum((-1, -2)) * COLLISION_COST

    def gap_cost(self, grips: Grips) -> Tensor:
        """Cost of fingers that touched in the demonstration and here stop short of the surface, or in it.

        The product of experts knows where links may be, but only as sharply as its kernels are wide.

        Args:
            grips: Grips.
        """
        pairs = zip(self._links(grips).split(64), grips.wrist.split(64), strict=True)
        parts = [self.hand.signed_distance(links, in_frame(wrist, self.surface)).amin(-1) for links, wrist in pairs]
        gap = torch.stack([torch.cat(parts)[:, solids].amin(-1) for solids in self.finger_solids], -1)
        return (self.gap_weight[grips.demo] * gap.abs()).sum(-1)

    def feasible(self, grips: Grips) -> Tensor:
        """Whether every link keeps clear of the table during the whole approach, (grip,).

        Args:
            grips: Grips.
        """
        with torch.no_grad():
            path = self._path(grips, np.linspace(0, 1, 7).tolist())
            return self._clearance(*path, self.others).amin(-1) > MIN_CLEARANCE

    def grasps(self, grips: Grips, log_likelihood: Tensor) -> Grasps:
        """The grips with their paths, in the world frame.

        Args:
            grips: Grips.
            log_likelihood: Log-likelihood of each.
        """
        wrist, joints = self.keyframes(grips)
        motion = Trajectory.from_keyframes(
            wrist[..., :3, 3],
            rotation.from_matrix(wrist[..., :3, :3]),
            self.hand.expand(joints),
            self.types[grips.demo],
        )
        return Grasps.of(motion, self.hand, log_likelihood)

    def _links(self, grips: Grips) -> Tensor:
        """(n, link, 4, 4) link poses at the grip, in the palm frame."""
        return self.hand.forward_kinematics(self.hand.expand(grips.joints))

    def _path(self, grips: Grips, at: Sequence[float]) -> tuple[Tensor, Tensor]:
        """Wrist poses (n, step, 4, 4), and link poses in the palm frame (n, step, link, 4, 4) on the way.

        at: fractions of it from the pre-grasp to the grip.
        """
        wrist, joints = self.keyframes(grips)
        t = wrist.new_tensor(at)[:, None]
        place = torch.lerp(wrist[:, :1, :3, 3], wrist[:, 1:2, :3, 3], t)
        quaternion = rotation.from_matrix(wrist[:, :2, :3, :3])
        turn = rotation.slerp(quaternion[:, :1], quaternion[:, 1:], t[:, 0].expand(len(place), -1))
        posture = torch.lerp(joints[:, :1], joints[:, 1:2], t)
        return pose_matrix(place, turn), self.hand.forward_kinematics(self.hand.expand(posture))

    def _clearance(self, wrist: Tensor, links: Tensor, others: Tensor) -> Tensor:
        """Meters from the lowest link to the table, or from the nearest one to the other points.

        wrist: (*batch, 4, 4) poses. links: (*batch, link, 4, 4) in the palm frame.
        """
        # the third row of a pose is the table's plane in the palm frame
        clearance = self.hand.clearance(links, wrist[..., 2, :]).amin(-1)
        if not others.shape[-2]:
            return clearance
        return torch.minimum(clearance, self.hand.signed_distance(links, in_frame(wrist, others)).amin((-1, -2)))


def _some(points: Tensor, num: int, generator: torch.Generator) -> Tensor:
    return points[torch.randperm(len(points), generator=generator)[:num]]

"""What refined grasps pay for: hand in the object, in its shadow, in the table, in itself; and what they are like.

Everything is looked at in the palm's frame: it is quicker to bring points and planes there than all links to the world.
What lies near a grasp is sought once and serves as long as the grasp stays in its trust region.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dexzoo.camera import Observation
from dexzoo.generators.density import GraspDensity, Grips
from dexzoo.generators.generator import MIN_CLEARANCE
from dexzoo.generators.surroundings import beyond, obstacles, underneath
from dexzoo.grasp import GRIP, JOINTS, POSITION, PREGRASP, QUATERNION, in_frame, pose_matrix
from dexzoo.hand import Hand

MOMENTS = (PREGRASP, GRIP // 2, GRIP)
"""The waypoints at which the hand is looked at; beyond the grip it is meant to press."""
WAY = tuple(range(PREGRASP, GRIP + 1))
"""The waypoints that acceptance looks at."""
AT_OBJECT = 1
"""The first of `MOMENTS`, by its place among them, at which it can be in the object."""
NUM_OBSERVED, NUM_SHADOW = 256, 128
SHADOW_DEPTHS = (0.007, 0.014)
"""Metres behind the observed surface, along the line of sight, at which the object is taken to go on."""
MIDDLE = 0.35
"""Share of the object's sides under which it is taken to be carried, besides where what carries it is seen."""
AROUND = 0.007
"""Metres about each point of what stands on the table that count as it: between points, and for the camera's error."""
NUM_NEAR = 128
"""Points of a kind that are looked at around each hand: enough for what is near to stay so in the trust region."""


class Surroundings:
    """The points around a view that a hand should not be in, in the world frame.

    observed: of the object. shadow: behind them. others: of what else is seen on the table, or guessed to carry the
    object where the view does not see it free.
    """

    def __init__(self, observation: Observation) -> None:
        points = torch.from_numpy(observation.points_world)
        self.observed = _evenly(points, NUM_OBSERVED)
        camera = torch.tensor(observation.T_world_camera[:3, 3], dtype=torch.float32)
        some = _evenly(points, NUM_SHADOW)
        sight = torch.nn.functional.normalize(some - camera, dim=-1)
        behind = torch.cat([some + depth * sight for depth in SHADOW_DEPTHS])
        self.shadow = behind[behind[:, 2] > 0]
        seen = obstacles(observation)
        guess = torch.cat((underneath(points, MIDDLE), beyond(points, seen, camera)))
        hidden = guess[torch.from_numpy(~observation.would_see(guess.numpy()))]
        self.others = torch.cat((seen, hidden))


def _evenly(points: Tensor, num: int) -> Tensor:
    """A fixed even choice of at most `num`."""
    return points[torch.from_numpy(np.linspace(0, len(points) - 1, min(num, len(points))).astype(int))]


class Posed:
    """Hands at some waypoints: wrist (grasp, moment, 4, 4) in the world, links (..., link, 4, 4) in the palm."""

    def __init__(self, hand: Hand, waypoints: Float[Tensor, "grasp 10 28"], moments: tuple[int, ...] = MOMENTS) -> None:
        way = waypoints[:, list(moments)]
        self.hand = hand
        self.wrist = pose_matrix(way[..., POSITION], way[..., QUATERNION])
        self.links = hand.forward_kinematics(way[..., JOINTS])

    @torch.no_grad()
    def nearest(self, points: Float[Tensor, "point 3"], first: int = 0) -> Float[Tensor, "grasp moment near 3"]:
        """The points nearest to any link at each moment, from one on."""
        num = min(NUM_NEAR, len(points))
        distance = self.hand.signed_distance(self.links[:, first:], in_frame(self.wrist[:, first:], points)).amin(-2)
        return points[distance.topk(num, largest=False, sorted=False).indices]

    def closest(self, points: Tensor, first: int = 0) -> Float[Tensor, "grasp moment solid"]:
        """Metres from each link to the closest of points of the world (*cloud, n, 3), negative inside."""
        return self.hand.closest_distance(self.links[:, first:], in_frame(self.wrist[:, first:], points))

    def penetration(self, near: Float[Tensor, "grasp moment near 3"]) -> Float[Tensor, " grasp"]:
        """Metres that the deepest point lies in each link, summed over links and moments."""
        return (-self.closest(near, AT_OBJECT)).clamp_min(0).sum((-1, -2))

    def table(self, near: Float[Tensor, "#grasp #moment near 3"]) -> Float[Tensor, " grasp"]:
        """Metres that each link lacks of its clearance from the table and what stands on it, summed likewise."""
        # the third row of a pose is the table's plane in the palm frame
        clearance = self.hand.clearance(self.links, self.wrist[..., 2, :])
        clearance = torch.minimum(clearance, self.closest(near) - AROUND)
        return (MIN_CLEARANCE - clearance).clamp_min(0).sum((-1, -2))

    def self_collision(self) -> Float[Tensor, " grasp"]:
        """Metres that links overlap at the grip, summed over pairs."""
        return self.hand.self_overlap(self.links[:, -1]).sum(-1)


class Prior:
    """The generator's own log-density of grips, each by the demonstration that it is likeliest to come from.

    Grasps of a type that nobody has demonstrated have none: their value is 0, whatever they do.
    """

    def __init__(self, density: GraspDensity, waypoints: Float[Tensor, "grasp 10 28"]) -> None:
        self.density = density
        types = torch.tensor([demonstration.grasp_type for demonstration in density.demonstrations])
        grasp, demo = (waypoints[:, 0, -1:].round().long() == types).nonzero(as_tuple=True)
        with torch.no_grad():
            each = waypoints.new_full((len(waypoints), len(types)), -torch.inf)
            if len(grasp):
                each[grasp, demo] = density.log_likelihood(self._grips(waypoints[grasp], demo))
        self.known = torch.isfinite(each).any(-1).nonzero().squeeze(-1)
        self.demo = each[self.known].argmax(-1)
        self.near = density.neighbours(self._grips(waypoints[self.known], self.demo)) if len(self.known) else None

    def __call__(self, waypoints: Float[Tensor, "grasp 10 28"]) -> Float[Tensor, " grasp"]:
        """Log-density of grips near those that the prior was made around; differentiable."""
        value = waypoints.new_zeros(len(waypoints))
        if self.near is None:
            return value
        grips = self._grips(waypoints[self.known], self.demo)
        return value.index_put((self.known,), self.density.log_likelihood(grips, self.near))

    def _grips(self, waypoints: Tensor, demo: Tensor) -> Grips:
        grip = waypoints[:, GRIP]
        return Grips(
            demo, pose_matrix(grip[:, POSITION], grip[:, QUATERNION]), self.density.hand.reduce(grip[:, JOINTS])
        )

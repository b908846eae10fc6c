"""Kopicki's one-shot generator: grasps of an unknown object from a few demonstrations (thesis, section 3.1).

Grips are sampled from the product of experts of `density`, improved on it, and ranked by it less the cost of collisions
on the way. Each carries its demonstration's approach and squeeze.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from dexzoo import rotation
from dexzoo.camera import Observation
from dexzoo.generators.demonstration import Demonstration, load_demonstrations
from dexzoo.generators.density import Bandwidths, ContactModel, GraspDensity, Grips, contact_models
from dexzoo.generators.features import Features
from dexzoo.generators.generator import MAX_REACH, MIN_CLEARANCE, GraspGenerator, spread
from dexzoo.generators.search import anneal, climb
from dexzoo.generators.surroundings import obstacles, underneath
from dexzoo.grasp import GRIP, PREGRASP, SQUEEZE, Grasps, in_frame, pose_matrix
from dexzoo.hand import Hand, default_hand

NUM_FEATURES = 1000
COLLISION_STEPS, COLLISION_WEIGHTS = (0.0, 0.4, 0.7, 0.9), (1.0, 1.0, 0.5, 0.2)
"""Where on the way from the pre-grasp (0) to the grip (1) collisions are looked at, and how much they count."""
JOINT_BANDWIDTH = 0.1
"""Radians; wider than Kopicki's, so that each finger adapts to the surface by itself."""
COLLISION_COST = 4.0
THUMB_GAP_COST, FINGER_GAP_COST = 300.0, 100.0
"""Log-likelihood that a metre between the surface and a finger that ought to touch it costs."""
NUM_CLIMBED = 500
"""Grips that are improved to the end; twice as many are at first."""
NUM_POINTS = 300
NUM_NEAR = 12
"""Points of what else stands on the table that are looked at while a grip is improved."""
TABLE_COST = 1000.0
"""Log-likelihood that a metre below the least clearance costs."""


class KopickiGenerator(GraspGenerator):
    """Grasps like those of the demonstrations.

    demonstrations: what to learn from; the ten of the DLR/HIT hand II by default. num_per_type: most grasps of a type.
    num_samples: grips drawn, num_kernels: kernels of a link's query density, over all demonstrations. search: how
    samples are improved, by simulated annealing as in the original or by gradient; num_steps: before and after the best
    are chosen. completes: whether the hidden side is guessed, see `Features.completed`.
    """

    def __init__(
        self,
        demonstrations: Sequence[Demonstration] | None = None,
        num_per_type: int = 20,
        num_samples: int = 30_000,
        num_kernels: int = 30_000,
        widths: Bandwidths | None = None,
        search: Literal["gradient", "annealing"] = "gradient",
        num_steps: tuple[int, int] = (20, 40),
        completes: bool = True,
    ) -> None:
        self.hand: Hand = default_hand()
        self.demonstrations = list(demonstrations or load_demonstrations())
        share = len(self.demonstrations)
        self.num_per_type = num_per_type
        self.num_samples, self.num_kernels = max(num_samples // share, 50), max(num_kernels // share, 500)
        self.widths, self.search, self.num_steps = widths or Bandwidths(joint=JOINT_BANDWIDTH), search, num_steps
        self.completes = completes
        self.models = [contact_models(d, self.hand, self.widths) for d in self.demonstrations]

    def density(self, observation: Observation, seed: int = 0) -> GraspDensity:
        """The likelihood of grasps of the object seen, in the world frame."""
        surface = Features.of_view(observation, NUM_FEATURES, np.random.default_rng(seed))
        if self.completes:
            surface = surface.completed(observation)
        generator = torch.Generator().manual_seed(seed)
        return GraspDensity(
            self.demonstrations, self.models, surface, self.hand, self.num_kernels, self.widths, generator=generator
        )

    def generate(
        self, observation: Observation, num_grasps: int = 100, seed: int = 0, density: GraspDensity | None = None
    ) -> Grasps:
        """At most `num_grasps` grasps in the camera frame, the likeliest first, at most `num_per_type` of each type.

        density: of the observation, where it is at hand; it is made from the seed if not given.
        Raises ValueError when too little of the object is seen, RuntimeError when no candidate is feasible.
        """
        if num_grasps < 1:
            raise ValueError(f"num_grasps is {num_grasps}, expected at least 1")
        generator = torch.Generator().manual_seed(seed)
        if density is None:
            density = self.density(observation, seed)
        surface = density.surface.points
        others = torch.cat((obstacles(observation), underneath(surface)))
        way = Way(self.demonstrations, self.models, self.hand, surface, others, generator)
        share = max(NUM_CLIMBED // len(self.demonstrations), 8)
        with torch.no_grad():
            grips = density.sample(self.num_samples, generator)
            value = density.screen(grips) - way.table_cost(grips, way.others[:0])
            # what else stands on the table takes long to look at
            kept = best(value, grips.demo, 8 * share)
            grips, value = grips[kept], value[kept]
            grips = grips[best(value - way.table_cost(grips), grips.demo, 2 * share)]
        for num_steps in self.num_steps:
            if self.search == "gradient":
                grips = climb(density, grips, way.table_cost_near, num_steps)
            else:
                grips = anneal(density, grips, way.table_cost_near, num_steps, generator)
            with torch.no_grad():
                value = density.log_likelihood(grips) - way.cost(grips) - way.gap_cost(grips)
            kept = best(value, grips.demo, share)
            grips, value = grips[kept], value[kept]
        feasible = way.feasible(grips) & (value > 0)  # below, the hand does as well in the air
        if not feasible.any():
            raise RuntimeError("no feasible grasp is found: the object may be too large, too flat or out of reach")
        grasps = way.grasps(grips[feasible], value[feasible])
        chosen = spread(grasps, value[feasible], num_grasps, self.num_per_type)
        return grasps[chosen].to_frame("camera", observation.T_world_camera)


class Way:
    """How a grip is come to and squeezed: the demonstrated path carried over rigidly, and what stands in its way."""

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
        keys = torch.cat([d.grasp.waypoints[:, [PREGRASP, GRIP, SQUEEZE]] for d in demonstrations])
        poses = pose_matrix(keys[..., :3], keys[..., 3:7])
        self.relative = torch.linalg.inv(poses[:, 1:2]) @ poses  # (demo, key, 4, 4) in the palm frame at the grip
        self.joints = hand.reduce(keys[..., 7:27])

    def keyframes(self, grips: Grips) -> tuple[Tensor, Tensor]:
        """Wrist poses (n, 3, 4, 4) and free joints (n, 3, 15) at pre-grasp, grip and squeeze."""
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
        """Log-likelihood that links too near to the table cost at the grip, where the hand is lowest.

        others: (n, 3) or (grip, n, 3) points of what else stands on it; all of them if not given.
        """
        low = self._clearance(grips.wrist, self._links(grips), self.others if others is None else others)
        return TABLE_COST * (2 * MIN_CLEARANCE - low).clamp_min(0)

    def table_cost_near(self, grips: Grips) -> Callable[[Grips], Tensor]:
        """`table_cost` for grips that stay near these ones, by the nearest points alone."""
        distance = self.hand.signed_distance(self._links(grips), in_frame(grips.wrist, self.others)).amin(-2)
        nearest = distance.topk(min(NUM_NEAR, len(self.others)), largest=False, sorted=False).indices
        return partial(self.table_cost, others=self.others[nearest])

    def cost(self, grips: Grips) -> Tensor:
        """Kopicki's cost of collisions with the observed points on the way, besides that of the table."""
        wrist, links = self._path(grips, COLLISION_STEPS)
        distance = self.hand.signed_distance(links, in_frame(wrist, self.points))
        depth = (-distance.amin(-2)).clamp_min(0)
        weight = torch.tensor(COLLISION_WEIGHTS)[:, None]
        return self.table_cost(grips) + (weight * (torch.expm1(100 * depth))).sum((-1, -2)) * COLLISION_COST

    def gap_cost(self, grips: Grips) -> Tensor:
        """Cost of fingers that touched in the demonstration and here stop short of the surface, or in it.

        The product of experts knows where links may be, but only as sharply as its kernels are wide.
        """
        pairs = zip(self._links(grips).split(64), grips.wrist.split(64), strict=True)
        parts = [self.hand.signed_distance(links, in_frame(wrist, self.surface)).amin(-1) for links, wrist in pairs]
        gap = torch.stack([torch.cat(parts)[:, solids].amin(-1) for solids in self.finger_solids], -1)
        return (self.gap_weight[grips.demo] * gap.abs()).sum(-1)

    def feasible(self, grips: Grips) -> Tensor:
        """(n,) whether every link keeps clear of the table all the way."""
        with torch.no_grad():
            path = self._path(grips, np.linspace(0, 1, 7).tolist())
            return self._clearance(*path, self.others).amin(-1) > MIN_CLEARANCE

    def grasps(self, grips: Grips, log_likelihood: Tensor) -> Grasps:
        """The grips with their paths, in the world frame."""
        wrist, joints = self.keyframes(grips)
        return Grasps.from_keyframes(
            wrist[..., :3, 3],
            rotation.from_matrix(wrist[..., :3, :3]),
            self.hand.expand(joints),
            self.types[grips.demo],
            "world",
            log_likelihood,
        )

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
        """Metres from the lowest link to the table, or from the nearest one to the other points.

        wrist: (*batch, 4, 4) poses. links: (*batch, link, 4, 4) in the palm frame.
        """
        # the third row of a pose is the table's plane in the palm frame
        clearance = self.hand.clearance(links, wrist[..., 2, :]).amin(-1)
        if not others.shape[-2]:
            return clearance
        return torch.minimum(clearance, self.hand.signed_distance(links, in_frame(wrist, others)).amin((-1, -2)))


def _some(points: Tensor, num: int, generator: torch.Generator) -> Tensor:
    return points[torch.randperm(len(points), generator=generator)[:num]]


def best(value: Tensor, demo: Tensor, num: int) -> Tensor:
    """Indices of the `num` highest values of each demonstration."""
    parts = []
    for one in demo.unique():
        rows = (demo == one).nonzero().squeeze(-1)
        parts.append(rows[value[rows].topk(min(num, len(rows))).indices])
    return torch.cat(parts)

"""Kopicki's generator: grasps like demonstrated ones on another surface (thesis, section 3.1)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from dexzoo.generators.approach import ApproachMotion
from dexzoo.generators.contact_density import ContactDensity
from dexzoo.generators.contact_models import Bandwidths, contact_models
from dexzoo.generators.demonstration import Demonstration
from dexzoo.generators.generator import GraspGenerator, spread
from dexzoo.generators.search import anneal, ascend
from dexzoo.grasp import Grasps
from dexzoo.perception import Observation, View
from dexzoo.perception.surroundings import underneath

NUM_FEATURES = 1000
JOINT_BANDWIDTH = 0.1
"""Radians; wider than Kopicki's, so that each finger adapts to the surface by itself."""
NUM_CLIMBED = 500
"""Grips that are improved to the end; twice as many are at first."""


class KopickiGenerator(GraspGenerator):
    """Grasps like those of the demonstrations (Kopicki et al. 2016).

    Args:
        demonstrations: Demonstrations to learn from; at least one, all of one hand.
        num_per_type: Most grasps of a type.
        num_samples: Grips drawn, over all demonstrations.
        num_kernels: Kernels of a link's query density, over all demonstrations.
        widths: Widths of the kernels.
        search: How samples are improved: by gradient, or by simulated annealing as in the original.
        num_steps: Steps of the search before and after the best are chosen.
        completes: Whether the hidden side is guessed, see `SurfaceFeatures.completed`.
    """

    def __init__(
        self,
        demonstrations: Sequence[Demonstration],
        num_per_type: int = 20,
        num_samples: int = 30_000,
        num_kernels: int = 30_000,
        widths: Bandwidths | None = None,
        search: Literal["gradient", "annealing"] = "gradient",
        num_steps: tuple[int, int] = (20, 40),
        completes: bool = True,
    ) -> None:
        self.demonstrations = list(demonstrations)
        self.hand = self.demonstrations[0].grasp.hand
        share = len(self.demonstrations)
        self.num_per_type = num_per_type
        self.num_samples, self.num_kernels = max(num_samples // share, 50), max(num_kernels // share, 500)
        self.widths, self.search, self.num_steps = widths or Bandwidths(joint=JOINT_BANDWIDTH), search, num_steps
        self.completes = completes
        self.models = [contact_models(d, self.hand, self.widths) for d in self.demonstrations]

    def density(self, observation: Observation | View, seed: int = 0) -> ContactDensity:
        """The likelihood of grasps of the object seen.

        Args:
            observation: The view of the object.
            seed: Seed of the choice of surface points and kernels.

        Returns:
            The density over the world frame; computed once for each view and seed.

        Raises:
            ValueError: Too little of the object is seen.
        """
        view = View.of(observation)

        def make() -> ContactDensity:
            surface = view.surface(NUM_FEATURES, seed, self.completes)
            generator = torch.Generator().manual_seed(seed)
            return ContactDensity(
                self.demonstrations, self.models, surface, self.hand, self.num_kernels, self.widths, generator=generator
            )

        return view.once(("density", self, seed), make)

    def generate(self, observation: Observation | View, num_grasps: int = 100, seed: int = 0) -> Grasps:
        """Propose grasps, the likeliest first, at most `num_per_type` of each type.

        Args:
            observation: The view of the object.
            num_grasps: Most grasps to propose.
            seed: The same seed gives the same grasps.

        Returns:
            Grasps in the world frame of the observation, with their log-likelihood.

        Raises:
            ValueError: Too little of the object is seen.
            RuntimeError: No feasible grasp is found.
        """
        if num_grasps < 1:
            raise ValueError(f"num_grasps is {num_grasps}, expected at least 1")
        view = View.of(observation)
        generator = torch.Generator().manual_seed(seed)
        density = self.density(view, seed)
        surface = density.surface.points
        others = torch.cat((view.obstacles, underneath(surface)))
        motion = ApproachMotion(self.demonstrations, self.models, self.hand, surface, others, generator)
        share = max(NUM_CLIMBED // len(self.demonstrations), 8)
        with torch.no_grad():
            grips = density.sample(self.num_samples, generator)
            value = density.screen(grips) - motion.table_cost(grips, motion.others[:0])
            # other things on the table take long to look at
            kept = best(value, grips.demo, 8 * share)
            grips, value = grips[kept], value[kept]
            grips = grips[best(value - motion.table_cost(grips), grips.demo, 2 * share)]
        for num_steps in self.num_steps:
            if self.search == "gradient":
                grips = ascend(density, grips, motion.table_cost_near, num_steps)
            else:
                grips = anneal(density, grips, motion.table_cost_near, num_steps, generator)
            with torch.no_grad():
                value = density.log_likelihood(grips) - motion.cost(grips) - motion.gap_cost(grips)
            kept = best(value, grips.demo, share)
            grips, value = grips[kept], value[kept]
        feasible = motion.feasible(grips) & (value > 0)  # below, the hand does as well in the air
        if not feasible.any():
            raise RuntimeError("no feasible grasp is found: the object may be too large, too flat or out of reach")
        grasps = motion.grasps(grips[feasible], value[feasible])
        return grasps[spread(grasps, value[feasible], num_grasps, self.num_per_type)]


def best(value: Tensor, demo: Tensor, num: int) -> Tensor:
    """Indices of the highest values of each demonstration.

    Args:
        value: Values, (grip,).
        demo: Demonstration of each, (grip,).
        num: Most indices of a demonstration.
    """
    parts = []
    for one in demo.unique():
        rows = (demo == one).nonzero().squeeze(-1)
        parts.append(rows[value[rows].topk(min(num, len(rows))).indices])
    return torch.cat(parts)

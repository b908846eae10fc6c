"""The interface of a generator: one view in, ranked grasps out, and the density that it draws them from."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dexzoo.grasp import GRIP, NUM_TYPES, Grasps, Trajectory
from dexzoo.hand import Hand
from dexzoo.perception import Observation, View

MIN_CLEARANCE = 0.002
"""Meters that every link keeps from the table up to the grip."""
MAX_REACH = 0.24
"""Meters that the wrist may be from the nearest observed point at the pre-grasp; the stand-off is shortened for it."""


class GraspDensity(ABC):
    """Density of grasps for one view, the prior of refinement."""

    @abstractmethod
    def log_density(self, grasps: Trajectory) -> Float[Tensor, " grasp"]:
        """Log-density of grasps; differentiable where it is finite.

        Args:
            grasps: Grasps in the world frame of the view.

        Returns:
            Log-density up to a constant; -inf where there is none.
        """

    def near(self, grasps: Trajectory) -> Callable[[Trajectory], Float[Tensor, " grasp"]]:
        """The log-density as a function of grasps that stay near some given ones, row by row.

        Args:
            grasps: Grasps in the world frame of the view.

        Returns:
            The function, differentiable and finite; 0 for a grasp of which the density says nothing.
        """
        known = torch.isfinite(self.log_density(grasps))

        def value(moved: Trajectory) -> Tensor:
            density = self.log_density(moved)
            return torch.where(known & torch.isfinite(density), density, 0.0)

        return value


class GraspGenerator(ABC):
    """Proposes grasps of one hand for an object seen once.

    Attributes:
        hand: The hand.
    """

    hand: Hand

    @abstractmethod
    def generate(self, observation: Observation | View, num_grasps: int = 100, seed: int = 0) -> Grasps:
        """Propose grasps.

        Args:
            observation: The view of the object.
            num_grasps: Most grasps to propose.
            seed: The same seed gives the same grasps.

        Returns:
            Grasps in the world frame of the observation, best first.

        Raises:
            ValueError: Too little of the object is seen.
            RuntimeError: No feasible grasp is found.
        """

    def density(self, observation: Observation | View, seed: int = 0) -> GraspDensity | None:
        """The density that grasps of a view are drawn from, as a prior for refinement.

        Args:
            observation: The view of the object.
            seed: Seed of the draws that make the density.

        Returns:
            The density, or None if the generator has none.

        Raises:
            ValueError: Too little of the object is seen.
        """
        return None


def spread(grasps: Grasps, score: Tensor, num: int, num_per_type: int | None = None) -> Tensor:
    """Choose the best grasps that differ from each other.

    A grasp within 1 cm and 0.2 rad of a better one of its type is passed over.

    Args:
        grasps: Grasps to choose from.
        score: Score of each, higher is better, (grasp,).
        num: Most grasps to choose.
        num_per_type: Most grasps of one type; None for as many as there are.

    Returns:
        Indices of the chosen grasps, best first.
    """
    position, quaternion, types = grasps.position[:, GRIP], grasps.quaternion[:, GRIP], grasps.grasp_type
    taken, chosen = [0] * NUM_TYPES, list[int]()
    for index in score.argsort(descending=True, stable=True).tolist():
        if len(chosen) == num:
            break
        kind = int(types[index])
        if num_per_type is not None and taken[kind] >= num_per_type:
            continue
        near = (position[chosen] - position[index]).norm(dim=-1) < 0.01
        near &= (quaternion[chosen] * quaternion[index]).sum(-1).abs() > np.cos(0.1)
        near &= types[chosen] == kind
        if not near.any():
            chosen.append(index)
            taken[kind] += 1
    return torch.tensor(chosen, dtype=torch.long)

"""What a generator is: one observation in, ranked grasps out."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
import torch
from torch import Tensor

from dexzoo.camera import Observation
from dexzoo.grasp import GRIP, NUM_TYPES, Grasps

MIN_CLEARANCE = 0.002
"""Metres that every link keeps from the table up to the grip."""
MAX_REACH = 0.24
"""Metres that the wrist may be from the nearest observed point at the pre-grasp; the stand-off is shortened for it."""


class GraspGenerator(ABC):
    """Proposes grasps for an object seen once."""

    @abstractmethod
    def generate(self, observation: Observation, num_grasps: int = 100, seed: int = 0) -> Grasps:
        """At most `num_grasps` grasps in the camera frame, best first; the same for the same seed.

        Raises ValueError when too little of the object is seen, RuntimeError when no feasible grasp is found.
        """


def spread(grasps: Grasps, score: Tensor, num: int, num_per_type: int | None = None) -> Tensor:
    """Indices of `num` grasps, best first, passing over those within 1 cm and 0.2 rad of a better one of their type.

    score: (num_grasps,), higher is better. num_per_type: most of one type; None for as many as there are.
    """
    grip, taken, chosen = grasps.waypoints[:, GRIP], [0] * NUM_TYPES, list[int]()
    for index in score.argsort(descending=True, stable=True).tolist():
        if len(chosen) == num:
            break
        kind = int(grip[index, 27])
        if num_per_type is not None and taken[kind] >= num_per_type:
            continue
        near = (grip[chosen, :3] - grip[index, :3]).norm(dim=-1) < 0.01
        near &= (grip[chosen, 3:7] * grip[index, 3:7]).sum(-1).abs() > np.cos(0.1)
        near &= grip[chosen, 27] == kind
        if not near.any():
            chosen.append(index)
            taken[kind] += 1
    return torch.tensor(chosen)

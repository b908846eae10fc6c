"""What a generator is: one observation in, ranked grasps out."""

from __future__ import annotations

from abc import ABC, abstractmethod

from dexzoo.camera import Observation
from dexzoo.grasp import Grasps


class GraspGenerator(ABC):
    """Proposes grasps for an object seen once."""

    @abstractmethod
    def generate(self, observation: Observation, num_grasps: int = 100, seed: int = 0) -> Grasps:
        """At most `num_grasps` grasps in the camera frame, best first; the same for the same seed.

        Raises ValueError when too little of the object is seen, RuntimeError when no feasible grasp is found.
        """

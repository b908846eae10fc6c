"""A prepared view: one observation, and all that is computed from it alone, each once."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from dexzoo.perception.camera import Camera
from dexzoo.perception.memo import Memo
from dexzoo.perception.observation import Observation
from dexzoo.perception.surface import SurfaceFeatures
from dexzoo.perception.surroundings import beyond, obstacles, underneath

NUM_OBSERVED, NUM_SHADOW = 256, 128
"""Points of the object, and points of it with others behind them, that a hand must keep out of."""
SHADOW_DEPTHS = (0.007, 0.014)
"""Meters behind the observed surface, along the line of sight, at which the object is taken to go on."""
SUPPORT_SHARE = 0.35
"""Share of the object's sides under which it is taken to be carried, besides where its support is seen."""


class View(Memo):
    """One observation, prepared for generators, evaluators and refinement.

    Whatever is asked of a view is computed at the first call and kept, so hand the same view to `generate`, `score` and
    `refine`. It also keeps the encodings of evaluators: make a new view after training an evaluator further.

    Args:
        observation: The depth image with its camera; not to be changed afterwards.
    """

    def __init__(self, observation: Observation) -> None:
        super().__init__()
        self.observation = observation

    @classmethod
    def of(cls, given: NDArray[np.floating] | Observation | View, camera: Camera | None = None) -> View:
        """The view of whatever a user has.

        Args:
            given: A depth image (height, width) in meters, an observation, or a view, which is returned as it is.
            camera: Camera of a depth image; nothing else takes one.

        Returns:
            The view.

        Raises:
            ValueError: A depth image has no camera, or something else has one.
        """
        if isinstance(given, (Observation, View)):
            if camera is not None:
                raise ValueError("give a camera with a depth array only; an Observation has its own")
            return given if isinstance(given, View) else cls(given)
        if camera is None:
            raise ValueError("a depth array needs its camera: give camera=")
        return cls(Observation(given, camera))

    @cached_property
    def aimed(self) -> Observation:
        """The observation turned to the object, as evaluators see it."""
        return self.observation.aimed()

    @cached_property
    def points(self) -> Float[Tensor, "point 3"]:
        """The object's points in the world frame, meters."""
        return torch.from_numpy(self.observation.points_world)

    @cached_property
    def camera_position(self) -> Float[Tensor, 3]:
        """Place of the camera in the world frame, meters."""
        return torch.tensor(self.observation.T_world_camera[:3, 3], dtype=torch.float32)

    def surface(self, num: int, seed: int, completed: bool) -> SurfaceFeatures:
        """Normals and curvatures of the object's surface, in the world frame.

        Args:
            num: Most features of the seen side.
            seed: Seed of the choice of points.
            completed: Whether a guess of the hidden side is added.

        Returns:
            The features.

        Raises:
            ValueError: Too few points of the object are seen.
        """

        def fit() -> SurfaceFeatures:
            seen = SurfaceFeatures.of_view(self.observation, num, np.random.default_rng(seed))
            return seen.completed(self.observation) if completed else seen

        return self.once(("surface", num, seed, completed), fit)

    @cached_property
    def obstacles(self) -> Float[Tensor, "point 3"]:
        """Points of other things on the table, in the world frame, meters."""
        return obstacles(self.observation)

    @cached_property
    def obstructions(self) -> Float[Tensor, "point 3"]:
        """The obstacles, and a guess of the object's support where the view does not exclude one."""
        guess = torch.cat(
            (underneath(self.points, SUPPORT_SHARE), beyond(self.points, self.obstacles, self.camera_position))
        )
        hidden = guess[torch.from_numpy(~self.observation.would_see(guess.numpy()))]
        return torch.cat((self.obstacles, hidden))

    @cached_property
    def observed(self) -> Float[Tensor, "point 3"]:
        """At most 256 points of the object, an even choice, in the world frame, meters."""
        return evenly(self.points, NUM_OBSERVED)

    @cached_property
    def shadow(self) -> Float[Tensor, "point 3"]:
        """Points shortly behind the observed surface, where the object is taken to go on, above the table."""
        some = evenly(self.points, NUM_SHADOW)
        sight = torch.nn.functional.normalize(some - self.camera_position, dim=-1)
        behind = torch.cat([some + depth * sight for depth in SHADOW_DEPTHS])
        return behind[behind[:, 2] > 0]


def evenly(points: Float[Tensor, "point 3"], num: int) -> Float[Tensor, "chosen 3"]:
    """A fixed even choice of points.

    Args:
        points: Points to choose from.
        num: Most points to choose.
    """
    return points[torch.from_numpy(np.linspace(0, len(points) - 1, min(num, len(points))).astype(int))]

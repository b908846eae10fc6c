"""Local features of a surface known by points: normals, principal curvatures, and the frames that they span."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from dexzoo import rotation
from dexzoo.perception.hidden_side import guess_hidden_side
from dexzoo.perception.observation import Observation
from dexzoo.perception.table import MIN_POINTS

RADIUS = 0.015
"""Meters around a point that its normal and curvatures are fitted in (Kopicki's 15 mm)."""
OUTLIER_RADIUS, OUTLIER_NEIGHBORS = 0.005, 5
"""A point with fewer others this near is taken for noise."""
MAX_FLATNESS = 0.1
"""Least over greatest spread of a neighborhood beyond which it is no surface."""
_NUM_NEIGHBORS = 144
_MAX_POINTS = 6000


@dataclass(frozen=True)
class SurfaceFeatures:
    """Points of a surface with an orthonormal frame at each, all in one frame of reference.

    Attributes:
        points: Points in meters, (point, 3).
        quaternion: Orientation of each frame: z along the outward normal, x along the first principal direction.
        curvature: Principal curvatures k1 >= k2 in 1/m, positive if the surface is convex.
    """

    points: Float[Tensor, "point 3"]
    quaternion: Float[Tensor, "point 4"]
    curvature: Float[Tensor, "point 2"]

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, index: Tensor) -> SurfaceFeatures:
        return SurfaceFeatures(self.points[index], self.quaternion[index], self.curvature[index])

    @property
    def normals(self) -> Float[Tensor, "point 3"]:
        """Outward unit normals."""
        return rotation.rotate(self.quaternion, self.points.new_tensor([0.0, 0.0, 1.0]))

    @classmethod
    def of_view(cls, observation: Observation, num: int, rng: np.random.Generator) -> SurfaceFeatures:
        """Features of the object seen, in the world frame, lone points removed.

        Args:
            observation: The view of the object.
            num: Most features.
            rng: Chooses the points.

        Raises:
            ValueError: Fewer than 50 points remain.
        """
        cloud = observation.points_world.astype(np.float64)
        tree = cKDTree(cloud)
        near = tree.query(cloud, k=min(OUTLIER_NEIGHBORS + 1, len(cloud)), workers=-1)[0][:, -1]
        cloud = cloud[near < OUTLIER_RADIUS]
        if len(cloud) < MIN_POINTS:
            raise ValueError(
                f"the object has {len(cloud)} points besides noise, fewer than the {MIN_POINTS} a grasp is planned on"
            )
        camera = observation.T_world_camera[:3, 3]
        chosen = rng.permutation(len(cloud))[:num]
        return cls._fit(cloud, cloud[chosen], camera - cloud[chosen], None)

    @classmethod
    def of_surface(
        cls, points: NDArray[np.float64], normals: NDArray[np.float64], chosen: NDArray[np.bool_] | None = None
    ) -> SurfaceFeatures:
        """Features of a known surface. A neighborhood leaves out points that face away, as behind a thin wall.

        Args:
            points: Dense points, meters, (point, 3).
            normals: Outward normals, (point, 3).
            chosen: Mask of the points to make features of, (point,); all if not given.
        """
        which = np.flatnonzero(np.ones(len(points), bool) if chosen is None else chosen)
        return cls._fit(points, points[which], normals[which], normals)

    @classmethod
    def _fit(
        cls,
        cloud: NDArray[np.float64],
        points: NDArray[np.float64],
        outward: NDArray[np.float64],
        normals: NDArray[np.float64] | None,
    ) -> SurfaceFeatures:
        """Plane and quadric by least squares in the neighborhood of each point.

        outward: (n, 3) directions on the outer side of each point.
        """
        # neighbors spread over the whole radius: the nearest ones alone would fit the sensor's noise
        every = len(cloud) // _MAX_POINTS + 1 if len(cloud) > _MAX_POINTS else 1
        thinned = cloud[::every]
        distance, index = cKDTree(thinned).query(
            points, k=min(_NUM_NEIGHBORS, len(thinned)), distance_upper_bound=RADIUS, workers=-1
        )
        weight = np.isfinite(distance).astype(np.float64)
        index = np.minimum(index, len(thinned) - 1)
        if normals is not None:
            weight *= np.einsum("nki,ni->nk", normals[::every][index], outward) > 0.3
        offset = thinned[index] - points[:, None]
        total = np.maximum(weight.sum(1, keepdims=True), 1)
        mean = np.einsum("nk,nki->ni", weight, offset) / total
        centered = (offset - mean[:, None]) * np.sqrt(weight)[..., None]
        spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", centered, centered))
        normal = axes[:, :, 0] * np.sign(np.einsum("ni,ni->n", axes[:, :, 0], outward) + 1e-12)[:, None]
        good = (
            (weight.sum(1) >= 8) & (spread[:, 0] < MAX_FLATNESS * spread[:, 2]) & (spread[:, 1] > 1e-3 * spread[:, 2])
        )
        x, y = axes[:, :, 2], np.cross(normal, axes[:, :, 2])
        # height over the tangent plane as a quadric: h = (a u^2 + 2 b u v + c v^2) / 2 + tilt + offset
        u, v, h = (np.einsum("nki,ni->nk", offset, axis) / RADIUS for axis in (x, y, normal))
        terms = np.stack((u * u / 2, u * v, v * v / 2, u, v, np.ones_like(u)), -1)
        left = np.einsum("nk,nki,nkj->nij", weight, terms, terms) + 1e-3 * np.eye(6)
        right = np.einsum("nk,nki,nk->ni", weight, terms, h)
        fitted = np.linalg.solve(left, right[..., None])[..., 0]
        a, b, c = fitted[:, :3].T / -RADIUS
        points = points + RADIUS * fitted[:, 5:] * normal  # on the fitted surface, without the sensor's noise
        half, root = (a + c) / 2, np.hypot((a - c) / 2, b)
        angle = 0.5 * np.arctan2(2 * b, a - c)
        first = np.cos(angle)[:, None] * x + np.sin(angle)[:, None] * y
        turn = np.stack((first, np.cross(normal, first), normal), -1)[good]
        return cls(
            torch.tensor(points[good], dtype=torch.float32),
            rotation.from_matrix(torch.tensor(turn, dtype=torch.float32)),
            torch.tensor(np.stack((half + root, half - root), -1)[good], dtype=torch.float32),
        )

    def completed(self, observation: Observation) -> SurfaceFeatures:
        """Add a guess of the hidden side: the features turned half round about the vertical through the middle.

        Args:
            observation: The view that the features are of; they are in its world frame.

        Returns:
            The features, followed by those of the hidden side.
        """
        points, hidden = guess_hidden_side(observation, self.points)
        half_round = self.points.new_tensor([0.0, 0, 0, 1])
        quaternion = rotation.normalize(rotation.multiply(half_round, self.quaternion))
        turned = SurfaceFeatures(points, quaternion, self.curvature)
        parts = (self, turned[hidden])
        names = self.__dataclass_fields__
        return SurfaceFeatures(*(torch.cat([getattr(part, name) for part in parts]) for name in names))

    def ambiguous_turn(self, generator: torch.Generator) -> Float[Tensor, "point 4"]:
        """A random rotation about each normal by which the frame might as well have been turned.

        Half a turn is as good as none, and where the curvatures are alike any turn is: the angle is drawn from
        N(0 or pi, pi exp(-100 ((k1 - k2) / k)^2)) with the greater of the two as k (Kopicki's generator).

        Args:
            generator: Source of randomness.
        """
        largest = self.curvature.abs().amax(-1).clamp_min(1e-6)
        unlike = (self.curvature[:, 0] - self.curvature[:, 1]) / largest
        spread = torch.pi * torch.exp(-100 * unlike.square())
        flip = torch.pi * torch.randint(2, (len(self),), generator=generator)
        angle = flip + spread * torch.randn(len(self), generator=generator)
        return rotation.from_axis_angle(self.points.new_tensor([0.0, 0.0, 1.0]).expand(len(self), 3), angle)

"""Local features of a surface known by points: normals, principal curvatures, and the frames that they span."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from dexzoo import rotation
from dexzoo.camera import Observation
from dexzoo.segmentation import MIN_POINTS

RADIUS = 0.015
"""Metres around a point that its normal and curvatures are fitted in (Kopicki's 15 mm)."""
OUTLIER_RADIUS, OUTLIER_NEIGHBOURS = 0.005, 5
"""A point with fewer others this near is taken for noise."""
MAX_FLATNESS = 0.1
"""Least over greatest spread of a neighbourhood beyond which it is no surface."""
_NUM_NEIGHBOURS = 144
_MAX_POINTS = 6000


@dataclass(frozen=True)
class Features:
    """Points of a surface with an orthonormal frame at each, all in one frame of reference.

    points: (n, 3) metres. quaternion: (n, 4) orientation of each frame: z along the outward normal, x along the first
    principal direction. curvature: (n, 2) principal curvatures k1 >= k2 in 1/m, positive where the surface is convex.
    """

    points: Float[Tensor, "point 3"]
    quaternion: Float[Tensor, "point 4"]
    curvature: Float[Tensor, "point 2"]

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, index: Tensor) -> Features:
        return Features(self.points[index], self.quaternion[index], self.curvature[index])

    @property
    def normals(self) -> Float[Tensor, "point 3"]:
        """Outward unit normals."""
        return rotation.rotate(self.quaternion, self.points.new_tensor([0.0, 0.0, 1.0]))

    @classmethod
    def of_view(cls, observation: Observation, num: int, rng: np.random.Generator) -> Features:
        """At most `num` features of the object seen, in the world frame, lone points removed.

        Raises ValueError when fewer than 50 points remain.
        """
        cloud = observation.points_world.astype(np.float64)
        tree = cKDTree(cloud)
        near = tree.query(cloud, k=min(OUTLIER_NEIGHBOURS + 1, len(cloud)), workers=-1)[0][:, -1]
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
    ) -> Features:
        """Features of a known surface given by dense points (n, 3) and outward normals (n, 3); of `chosen` points only.

        A neighbourhood leaves out what faces away, as the other side of a thin wall does.
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
    ) -> Features:
        """Plane and quadric by least squares in the neighbourhood of each point.

        outward: (n, 3) directions on the outer side of each point.
        """
        # neighbours spread over the whole radius: the nearest ones alone would fit the sensor's noise
        every = len(cloud) // _MAX_POINTS + 1 if len(cloud) > _MAX_POINTS else 1
        thinned = cloud[::every]
        distance, index = cKDTree(thinned).query(
            points, k=min(_NUM_NEIGHBOURS, len(thinned)), distance_upper_bound=RADIUS, workers=-1
        )
        weight = np.isfinite(distance).astype(np.float64)
        index = np.minimum(index, len(thinned) - 1)
        if normals is not None:
            weight *= np.einsum("nki,ni->nk", normals[::every][index], outward) > 0.3
        offset = thinned[index] - points[:, None]
        total = np.maximum(weight.sum(1, keepdims=True), 1)
        mean = np.einsum("nk,nki->ni", weight, offset) / total
        centred = (offset - mean[:, None]) * np.sqrt(weight)[..., None]
        spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))
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

    def completed(self, observation: Observation) -> Features:
        """With a guess of the hidden side: the features turned half round about the vertical through the middle.

        The features are in the world frame. What would have been in plain view of the camera is left out: it would have
        been seen.
        """
        (x, y), _, _ = cv2.minAreaRect(self.points[:, :2].contiguous().numpy())
        points = self.points * self.points.new_tensor([-1.0, -1, 1]) + self.points.new_tensor([2 * x, 2 * y, 0])
        half_round = self.points.new_tensor([0.0, 0, 0, 1])
        turned = Features(points, rotation.normalize(rotation.multiply(half_round, self.quaternion)), self.curvature)
        hidden = torch.from_numpy(~observation.would_see(points.numpy()))
        parts = (self, turned[hidden])
        return Features(*(torch.cat([getattr(part, name) for part in parts]) for name in self.__dataclass_fields__))

    def ambiguous_turn(self, generator: torch.Generator) -> Float[Tensor, "point 4"]:
        """A random rotation about each normal by which the frame might as well have been turned.

        Half a turn is as good as none, and where the curvatures are alike any turn is: the angle is drawn from
        N(0 or pi, pi exp(-100 ((k1 - k2) / k)^2)) with the greater of the two as k (Kopicki's generator).
        """
        largest = self.curvature.abs().amax(-1).clamp_min(1e-6)
        unlike = (self.curvature[:, 0] - self.curvature[:, 1]) / largest
        spread = torch.pi * torch.exp(-100 * unlike.square())
        flip = torch.pi * torch.randint(2, (len(self),), generator=generator)
        angle = flip + spread * torch.randn(len(self), generator=generator)
        return rotation.from_axis_angle(self.points.new_tensor([0.0, 0.0, 1.0]).expand(len(self), 3), angle)

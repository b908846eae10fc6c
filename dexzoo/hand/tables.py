"""The parts that a hand's tables are made of: joints, inertias, shapes, pads. Meters, radians, kilograms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray


@dataclass(frozen=True)
class Primitive:
    """A rounded box; a capsule if two of the half sizes are zero.

    Attributes:
        link: Name of the link.
        pose: Pose in the frame of the link, (4, 4).
        half: Half sizes in meters, (3,).
        radius: Radius in meters that it is rounded by.
    """

    link: str
    pose: NDArray[np.float64]
    half: NDArray[np.float64]
    radius: float

    @property
    def is_capsule(self) -> bool:
        """Whether it lies along x alone."""
        return bool(self.radius > 0 and not self.half[1:].any())

    def mesh(self) -> trimesh.Trimesh:
        """A mesh of it in its own frame, for pictures; a capsule is faceted and lies within its radius."""
        mesh: trimesh.Trimesh
        if self.is_capsule:
            mesh = trimesh.creation.capsule(2 * self.half[0], self.radius, count=[12, 12])
            mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
        else:
            mesh = trimesh.creation.box(2 * self.half)
        return mesh


@dataclass(frozen=True)
class Joint:
    """One joint of the tree; a fixed joint has no axis. Coupled: angle = multiplier * angle of `mimic` + offset."""

    name: str
    parent: str
    child: str
    origin: NDArray[np.float64]  # (4, 4), T_parent_child at angle 0
    axis: NDArray[np.float64] | None
    lower: float
    upper: float
    effort: float
    damping: float
    mimic: str | None
    multiplier: float
    offset: float


@dataclass(frozen=True)
class Inertia:
    """Mass in kg, center of mass in m and inertia about it in kg m2, in the frame of the link."""

    mass: float
    center: NDArray[np.float64]
    matrix: NDArray[np.float64]


@dataclass(frozen=True)
class Pad:
    """Where a fingertip touches: a point and an outward normal in the frame of its link."""

    link: str
    point: NDArray[np.float64]
    normal: NDArray[np.float64]

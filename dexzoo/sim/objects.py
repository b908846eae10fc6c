"""Objects: a mesh for the camera, convex parts for contact, mass and friction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

MIN_EXTENT, MAX_EXTENT = 5e-4, 1.0
MIN_SLIVER = 2e-4
MAX_FRICTION = 2.0
Mesh = trimesh.Trimesh


@dataclass(frozen=True)
class ObjectModel:
    """A rigid object in its own frame: metres, z up, standing as it should be placed.

    mesh: what the camera sees. hulls: convex parts, what the hand touches. mass in kg; friction is the sliding
    coefficient that acts between the object and whatever touches it.
    """

    name: str
    mesh: Mesh
    hulls: tuple[Mesh, ...]
    mass: float
    friction: float
    category: str = ""

    def __post_init__(self) -> None:
        if not np.isfinite(self.mass) or self.mass <= 0:
            raise ValueError(f"object {self.name} has a mass of {self.mass} kg; give a positive one")
        if not np.isfinite(self.friction) or not 0 < self.friction <= MAX_FRICTION:
            raise ValueError(f"object {self.name} has a friction of {self.friction}; give one in (0, {MAX_FRICTION:g}]")

    @classmethod
    def from_mesh(
        cls,
        mesh: str | Path | Mesh,
        mass: float = 0.2,
        friction: float = 0.7,
        hulls: Sequence[str | Path | Mesh] | None = None,
        name: str | None = None,
    ) -> ObjectModel:
        """An object from a mesh file in metres (any format trimesh reads), or from a mesh.

        hulls: its convex parts, as files or meshes; None has them computed by CoACD (Wei et al. 2022), which takes
        seconds to a minute. Parts thinner than 0.2 mm, as decompositions leave them, are dropped.
        name: by default that of the file, or of its folder where the file is called mesh.
        Raises FileNotFoundError or ValueError for a mesh that is missing, empty, flat, not finite or not in metres.
        """
        label = name or ("object" if isinstance(mesh, Mesh) else _name(Path(mesh)))
        surface = _read(mesh, label)
        if surface.extents.min() < MIN_EXTENT:
            thin = f"{surface.extents.min() * 1000:.2f} mm thick, expected at least {MIN_EXTENT * 1000:g} mm"
            raise ValueError(f"mesh {label if isinstance(mesh, Mesh) else mesh} is flat: {thin}")
        parts = _decompose(surface) if hulls is None else [_read(hull, f"hull of {label}") for hull in hulls]
        convex = (part.convex_hull for part in parts)
        solid = tuple(part for part in convex if 2 * part.volume / part.area >= MIN_SLIVER)  # a plate's thickness
        if not solid:
            raise ValueError(f"object {label} has no convex parts; give hulls=None to have them computed")
        return cls(label, surface, solid, float(mass), float(friction))

    @property
    def inertia(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Centre of mass (3,) in m and inertia (3, 3) in kg m2 about it, of convex parts of one density."""
        volumes = np.array([hull.volume for hull in self.hulls])
        masses = self.mass * volumes / volumes.sum()
        centers = np.array([hull.center_mass for hull in self.hulls])
        center = masses @ centers / self.mass
        inertia = np.zeros((3, 3))
        for hull, mass, offset in zip(self.hulls, masses, centers - center, strict=True):
            inertia += hull.moment_inertia * (mass / hull.volume)
            inertia += mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))
        return center, inertia

    @property
    def radius(self) -> float:
        """Largest distance in m of a point of the object from its centre of mass."""
        return float(np.linalg.norm(self.mesh.vertices - self.inertia[0], axis=1).max())

    def scaled(self, factor: float) -> ObjectModel:
        """The object made larger or smaller; its mass stays."""
        return replace(
            self,
            mesh=self.mesh.copy().apply_scale(factor),
            hulls=tuple(hull.copy().apply_scale(factor) for hull in self.hulls),
        )


def _name(path: Path) -> str:
    return path.resolve().parent.name if path.stem == "mesh" else path.stem


def _read(source: str | Path | Mesh, label: str) -> Mesh:
    """A mesh that has passed the checks, its equal vertices merged where it comes from a file."""
    if isinstance(source, Mesh):
        _check(source, label)
        return source
    path = Path(source)
    if not path.is_file():
        raise FileNotFoundError(f"mesh {path} does not exist")
    try:
        mesh = trimesh.load(path, force="mesh", process=False)  # processing would drop what is not finite
    except Exception as error:  # trimesh raises what its many readers raise
        raise ValueError(f"mesh {path} cannot be read: {error}") from None
    if not isinstance(mesh, Mesh):
        raise ValueError(f"mesh {path} holds no triangles")
    _check(mesh, str(path))
    return mesh.process()


def _check(mesh: Mesh, where: str) -> None:
    if len(mesh.faces) == 0 or len(mesh.vertices) < 4:
        raise ValueError(f"mesh {where} is empty")
    if not np.isfinite(mesh.vertices).all():
        raise ValueError(f"mesh {where} has vertices that are not finite")
    extent = mesh.extents
    if extent.max() > MAX_EXTENT:
        raise ValueError(f"mesh {where} is {extent.max():.1f} m large and looks like millimetres; divide it by 1000")


def _decompose(mesh: Mesh) -> list[Mesh]:
    import coacd  # slow to import, seldom needed

    coacd.set_log_level("error")
    parts = coacd.run_coacd(coacd.Mesh(mesh.vertices, mesh.faces), threshold=0.05, max_convex_hull=24, seed=0)
    return [Mesh(vertices, faces) for vertices, faces in parts]

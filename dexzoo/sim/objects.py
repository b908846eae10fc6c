"""Objects: a mesh for the camera, convex parts for contact, mass and friction."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import QhullError

MIN_EXTENT, MAX_EXTENT = 5e-4, 1.0
MIN_SLIVER = 2e-4
MAX_FRICTION = 2.0
PATIENCE = 180.0
"""Seconds that CoACD may take for one mesh; with holes or faces that cut each other it may never end."""
_DECOMPOSE = Path(__file__).with_name("decompose.py")
Mesh = trimesh.Trimesh


@dataclass(frozen=True)
class ObjectModel:
    """A rigid object in its own frame: meters, z up, standing as it should be placed.

    Attributes:
        name: Name of the object.
        mesh: Surface that the camera sees.
        hulls: Convex parts that the hand touches.
        mass: Mass in kilograms.
        friction: Sliding coefficient between the object and whatever touches it.
        category: Category, if any.

    Raises:
        ValueError: The mass or the friction cannot be.
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
        """Make an object of a mesh.

        Unused vertices, faces that are double or of no area, holes of three or four edges, and faces of a closed mesh
        that look inwards are mended; larger holes and edges of more than two faces are left to CoACD.

        Args:
            mesh: File in meters, of any format that trimesh reads, or a mesh.
            mass: Mass in kilograms.
            friction: Sliding coefficient.
            hulls: Convex parts, as files or meshes; None has them computed by CoACD (Wei et al. 2022), which takes
                seconds to a minute. Parts thinner than 0.2 mm, as decompositions leave them, are dropped.
            name: Name of the object; by default that of the file, or of its folder if the file is called mesh.

        Returns:
            The object.

        Raises:
            FileNotFoundError: A file does not exist.
            ValueError: The mesh is empty, flat, not finite, not in meters or too bad for CoACD.
        """
        label = name or ("object" if isinstance(mesh, Mesh) else _name(Path(mesh)))
        surface = _read(mesh, label)
        where = label if isinstance(mesh, Mesh) else str(mesh)
        if surface.extents.min() < MIN_EXTENT:
            thin = f"{surface.extents.min() * 1000:.2f} mm thick, expected at least {MIN_EXTENT * 1000:g} mm"
            raise ValueError(f"mesh {where} is flat: {thin}")
        if not _convex([surface]):
            raise ValueError(f"mesh {where} is flat: all its vertices lie in one plane, or nearly so")
        parts = _decompose(surface, where) if hulls is None else [_read(hull, f"hull of {label}") for hull in hulls]
        solid = _convex(parts)
        if not solid:
            raise ValueError(f"object {label} has no convex parts; give hulls=None to have them computed")
        return cls(label, surface, solid, float(mass), float(friction))

    @property
    def inertia(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Center of mass (3,) in m and inertia (3, 3) in kg m2 about it, of convex parts of one density."""
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
        """Largest distance in m of a point of the object from its center of mass."""
        return float(np.linalg.norm(self.mesh.vertices - self.inertia[0], axis=1).max())

    def scaled(self, factor: float) -> ObjectModel:
        """The object made larger or smaller; its mass stays.

        Args:
            factor: Factor of all lengths.
        """
        return replace(
            self,
            mesh=self.mesh.copy().apply_scale(factor),
            hulls=tuple(hull.copy().apply_scale(factor) for hull in self.hulls),
        )


def _name(path: Path) -> str:
    return path.resolve().parent.name if path.stem == "mesh" else path.stem


def _read(source: str | Path | Mesh, label: str) -> Mesh:
    """A mesh that has passed the checks, mended."""
    if isinstance(source, Mesh):
        _check(source, label)
        return _mended(source)
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
    return _mended(mesh)


def _check(mesh: Mesh, where: str) -> None:
    if len(mesh.faces) == 0 or len(mesh.vertices) < 4:
        raise ValueError(f"mesh {where} is empty")
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise ValueError(f"mesh {where} has faces of vertices that do not exist")
    if not np.isfinite(mesh.vertices).all():
        raise ValueError(f"mesh {where} has vertices that are not finite")
    extent = mesh.extents
    if extent.max() > MAX_EXTENT:
        raise ValueError(f"mesh {where} is {extent.max():.1f} m large and looks like millimeters; divide it by 1000")


def _mended(mesh: Mesh) -> Mesh:
    """Degenerate faces removed, small holes filled, and faces of a closed mesh turned outwards."""
    mesh = mesh.copy()
    mesh.merge_vertices()
    mesh.update_faces(mesh.unique_faces() & mesh.nondegenerate_faces())
    mesh.remove_unreferenced_vertices()
    if not mesh.is_watertight:
        trimesh.repair.fill_holes(mesh)
    if mesh.is_watertight and (not mesh.is_winding_consistent or mesh.volume < 0):
        mesh.fix_normals()
    return mesh


def _convex(parts: Sequence[Mesh]) -> tuple[Mesh, ...]:
    """Convex hulls of the parts, without those as thin as a foil."""
    solid = []
    for part in parts:
        try:
            hull = part.convex_hull
        except QhullError:  # all in one plane
            continue
        if 2 * hull.volume / hull.area >= MIN_SLIVER:  # a plate's thickness
            solid.append(hull)
    return tuple(solid)


def _decompose(mesh: Mesh, where: str) -> list[Mesh]:
    """Convex parts, computed in a process of its own, which a bad mesh can crash or keep busy for ever."""
    advice = "repair the mesh, or give its convex parts as hulls"
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "mesh.npz", Path(folder) / "parts.npz"
        np.savez(source, vertices=mesh.vertices, faces=mesh.faces)
        try:
            done = subprocess.run(
                [sys.executable, "-P", _DECOMPOSE, source, target], capture_output=True, timeout=PATIENCE, check=False
            )
        except subprocess.TimeoutExpired:
            raise ValueError(f"mesh {where} keeps CoACD busy for over {PATIENCE:g} s; {advice}") from None
        if done.returncode != 0 or not target.exists():
            raise ValueError(f"mesh {where} cannot be cut into convex parts by CoACD; {advice}")
        arrays = np.load(target)
        return [Mesh(arrays[f"vertices_{i}"], arrays[f"faces_{i}"]) for i in range(len(arrays.files) // 2)]

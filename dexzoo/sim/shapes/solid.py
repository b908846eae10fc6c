"""Solids: a watertight mesh and the convex parts that fit it, made from the same sections. Lengths in millimetres.

`loft` skins a row of sections; bodies of revolution, tubes, bars and blades are lofts. `union` joins solids.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial import ConvexHull

from dexzoo.sim.objects import Mesh
from dexzoo.sim.shapes.curves import Array, Number, ellipse

TOLERANCE = 1.4
"""How deep below the surface of a convex part the true surface of a loft may lie."""


@dataclass(frozen=True)
class Solid:
    """mesh: its surface, watertight. parts: convex, together as large as the mesh within 2 mm."""

    mesh: Mesh
    parts: list[Mesh]

    def moved(self, offset: Sequence[Number] = (0, 0, 0), degrees: Number = 0.0, axis: str = "z") -> Solid:
        """The solid turned about an axis through the origin, then shifted."""
        turn = trimesh.transformations.rotation_matrix(np.deg2rad(degrees), np.eye(3)["xyz".index(axis)])
        turn[:3, 3] = offset
        return Solid(self.mesh.copy().apply_transform(turn), [part.copy().apply_transform(turn) for part in self.parts])


def union(*solids: Solid) -> Solid:
    """Several solids as one; where they overlap, the mesh has no inner walls."""
    mesh = trimesh.boolean.union([solid.mesh for solid in solids], engine="manifold")
    return Solid(mesh, [part for solid in solids for part in solid.parts])


def hull(points: Array) -> Mesh:
    """The convex hull of points (..., 3)."""
    mesh: Mesh = trimesh.convex.convex_hull(points.reshape(-1, 3))
    return mesh


def skin(sections: Array, closed: bool = False) -> Mesh:
    """A watertight mesh over sections (section, point, 3), closed loops each; outside is out.

    closed: the last section is joined to the first one; otherwise both are capped from their middle.
    """
    levels, count = sections.shape[:2]
    vertices = sections.reshape(-1, 3)
    around = np.arange(count)
    onward = np.roll(around, -1)
    lower = np.arange(levels if closed else levels - 1)[:, None] * count
    upper = (lower + count) % (levels * count)
    quads = np.stack((lower + around, lower + onward, upper + onward, upper + around), -1).reshape(-1, 4)
    faces = [quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]
    if not closed:
        first, last = len(vertices), len(vertices) + 1
        vertices = np.concatenate((vertices, sections[[0, -1]].mean(1)))
        end = (levels - 1) * count
        faces.append(np.column_stack((onward, around, np.full(count, first))))
        faces.append(np.column_stack((end + around, end + onward, np.full(count, last))))
    mesh = Mesh(vertices, np.concatenate(faces))
    if mesh.volume < 0:
        mesh.invert()
    return mesh


def loft(sections: Array, closed: bool = False, tolerance: Number = TOLERANCE) -> Solid:
    """A solid over sections (section, point, 3), each a convex loop.

    Its parts are hulls of as many sections in a row as the tolerance allows.
    """
    return Solid(skin(sections, closed), convex_parts(sections, closed, tolerance))


def convex_parts(sections: Array, closed: bool = False, tolerance: Number = TOLERANCE) -> list[Mesh]:
    """Hulls of as many sections in a row as leave none deeper than the tolerance below the surface."""
    if closed:
        sections = np.concatenate((sections, sections[:1]))
    parts, start, last = [], 0, len(sections) - 1
    while start < last:
        good, bad = start + 1, last + 1
        trial = last
        while bad - good > 0 and good < last:
            if _depth(sections[start : trial + 1]) <= tolerance:
                good = trial
            else:
                bad = trial
            trial = (good + bad) // 2
            if trial == good:
                break
        parts.append(hull(sections[start : good + 1]))
        start = good
    return parts


def _depth(sections: Array) -> float:
    """How deep the deepest point of the sections lies in their hull."""
    points = sections[:, ::2].reshape(-1, 3)
    planes = ConvexHull(points).equations
    return float((-(points @ planes[:, :3].T + planes[:, 3]).max(1)).max())


def turned(profile: Array, section: Array | None = None, exponent: Array | None = None) -> Array:
    """Sections (level, point, 3) of a body of revolution with the profile (level, 2) of radii and heights.

    section: another loop than the circle, of the size one. exponent: superellipses instead, one for each level.
    """
    if exponent is not None:
        loops = np.stack([ellipse(each) for each in exponent])
    else:
        loops = np.repeat((ellipse() if section is None else section)[None], len(profile), 0)
    heights = np.broadcast_to(profile[:, 1, None, None], (*loops.shape[:2], 1))
    return np.concatenate((loops * profile[:, 0, None, None], heights), -1)


def swept(
    path: Array, width: Array | Number, thickness: Array | Number, exponent: Number = 2.5, count: int = 20
) -> Array:
    """Sections of a bar along a path (point, 2) in the xz plane: half widths along y, half thicknesses across."""
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    loop = ellipse(exponent, count)
    across = np.broadcast_to(thickness, len(path))[:, None] * loop[None, :, 1]
    aside = np.broadcast_to(width, len(path))[:, None] * loop[None, :, 0]
    x = path[:, :1] - tangent[:, 1:] * across
    z = path[:, 1:] + tangent[:, :1] * across
    return np.stack((x, aside, z), -1)

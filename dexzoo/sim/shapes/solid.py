"""Solids: a watertight mesh and the convex parts that fit it, made from the same sections. Lengths in millimeters.

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

TOLERANCE = 1.3
"""How far a convex part may stand out beyond the surface of its loft."""

_FLAT = 0.05
"""Thickness of sections in a row, in the sense of a standard deviation, that make no part."""


@dataclass(frozen=True)
class Solid:
    """A watertight mesh and its convex parts.

    Attributes:
        mesh: Its surface, watertight.
        parts: Convex parts, together as large as the mesh within 2 mm.
    """

    mesh: Mesh
    parts: list[Mesh]

    def moved(self, offset: Sequence[Number] = (0, 0, 0), degrees: Number = 0.0, axis: str = "z") -> Solid:
        """The solid turned about an axis through the origin, then shifted.

        Args:
            offset: The shift.
            degrees: The angle.
            axis: x, y or z.
        """
        turn = trimesh.transformations.rotation_matrix(np.deg2rad(degrees), np.eye(3)["xyz".index(axis)])
        turn[:3, 3] = offset
        return Solid(self.mesh.copy().apply_transform(turn), [part.copy().apply_transform(turn) for part in self.parts])


def union(*solids: Solid) -> Solid:
    """Several solids as one; where they overlap, the mesh has no inner walls.

    Args:
        solids: The solids.
    """
    mesh = trimesh.boolean.union([solid.mesh for solid in solids], engine="manifold")
    return Solid(mesh, [part for solid in solids for part in solid.parts])


def hull(points: Array) -> Mesh:
    """The convex hull of points (..., 3), rounded to a nanometer: noise in what is flat can leave a facet out.

    Args:
        points: The points.
    """
    mesh: Mesh = trimesh.convex.convex_hull(points.reshape(-1, 3).round(6))
    return mesh


def skin(sections: Array, closed: bool = False) -> Mesh:
    """A watertight mesh over sections; outside is out.

    Args:
        sections: Closed loops, (section, point, 3).
        closed: Whether the last section is joined to the first one; otherwise both are capped from their middle.
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
    """A solid over sections.

    Its parts are hulls of as many sections in a row as the tolerance allows.

    Args:
        sections: Convex loops, (section, point, 3).
        closed: Whether the last section is joined to the first one.
        tolerance: How far a part may stand out.
    """
    return Solid(skin(sections, closed), convex_parts(sections, closed, tolerance))


def convex_parts(sections: Array, closed: bool = False, tolerance: Number = TOLERANCE) -> list[Mesh]:
    """Hulls of as many sections in a row as stand out beyond their surface by no more than the tolerance.

    Args:
        sections: Convex loops, (section, point, 3).
        closed: Whether the last section is joined to the first one.
        tolerance: How far a part may stand out.
    """
    normals = skin(sections, closed).vertex_normals[: sections.shape[0] * sections.shape[1]].reshape(sections.shape)
    if closed:
        sections, normals = (np.concatenate((each, each[:1])) for each in (sections, normals))
    parts, start, last = [], 0, len(sections) - 1
    while start < last:
        good, bad = start + 1, last + 1
        while good < last and _is_flat(sections[start : good + 1]):
            good += 1
        trial = last
        while trial > good:
            if _excess(sections[start : trial + 1], normals[start : trial + 1]) <= tolerance:
                good = trial
            else:
                bad = trial
            trial = (good + bad) // 2
        if not _is_flat(sections[start : good + 1]):
            parts.append(hull(sections[start : good + 1]))
        start = good
    return parts


def _excess(sections: Array, normals: Array) -> float:
    """How far the hull of sections stands out beyond them, along their normals."""
    if _is_flat(sections):
        return 0.0
    some = slice(None, None, max(1, sections.shape[1] // 16))
    points = sections[:, some].reshape(-1, 3)
    return float(exit_distance(points, points, normals[:, some].reshape(-1, 3)).max())


def _is_flat(sections: Array) -> bool:
    points = sections.reshape(-1, 3)
    return bool(np.linalg.svd(points - points.mean(0), compute_uv=False)[2] < _FLAT * np.sqrt(len(points)))


def exit_distance(cloud: Array, points: Array, directions: Array) -> Array:
    """Distance of points in the hull of a cloud from leaving it along a direction.

    Args:
        cloud: The cloud.
        points: Points in its hull, (n, 3).
        directions: Directions, (n, 3).
    """
    planes = ConvexHull(cloud).equations
    height = np.maximum(-(points @ planes[:, :3].T + planes[:, 3]), 0)
    speed = directions @ planes[:, :3].T
    distance = np.where(speed > 1e-6, height / np.maximum(speed, 1e-6), np.inf)
    return np.asarray(distance.min(1), np.float64)


def turned(profile: Array, section: Array | None = None, exponent: Array | None = None) -> Array:
    """Sections (level, point, 3) of a body of revolution.

    Args:
        profile: Radii and heights, (level, 2).
        section: Another loop than the circle, of the size one.
        exponent: Exponents of superellipses instead, one for each level.
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
    """Sections of a bar along a path in the xz plane.

    Args:
        path: The path, (point, 2).
        width: Half widths along y.
        thickness: Half thicknesses across.
        exponent: Exponent of the section.
        count: Points of a section.
    """
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    loop = ellipse(exponent, count)
    across = np.broadcast_to(thickness, len(path))[:, None] * loop[None, :, 1]
    aside = np.broadcast_to(width, len(path))[:, None] * loop[None, :, 0]
    x = path[:, :1] - tangent[:, 1:] * across
    z = path[:, 1:] + tangent[:, :1] * across
    return np.stack((x, aside, z), -1)

"""How well an object's convex parts, which the hand touches, fit its mesh, which the camera sees."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dexzoo.sim.objects import ObjectModel

Array = NDArray[np.float64]
_PROBE = 1e-4  # m in front of a part's face: a point in another part is not on the surface of the whole
_NEIGHBORS = 8
_PLANES = 64  # of a part that points are held against at once, before those outside are left out
_REFERENCES = 24_000  # points to measure to: a triangle of a part that none falls on is not measured to


def surface_distance(model: ObjectModel, num_points: int = 4000, seed: int = 0, least: float = 0.0) -> float:
    """Two-sided Hausdorff distance (m) between the mesh and the surface of the union of the convex parts.

    It is measured from points drawn on each surface, inner walls included, to the nearest triangles of the other one,
    and can miss a spot that no point falls on.

    Args:
        model: The object.
        num_points: Points drawn on each surface.
        seed: Seed of the points.
        least: Smaller distances (m) are not told apart, which is faster.
    """
    seen, seen_triangles = _draw(model.mesh, _REFERENCES, seed)
    area = sum(part.area for part in model.hulls)
    touched, touched_triangles = [], []
    for index, part in enumerate(model.hulls):
        points, triangles, ahead = _draw_ahead(part, 50 + int(1.5 * _REFERENCES * part.area / area), seed + index)
        others = replace(model, hulls=model.hulls[:index] + model.hulls[index + 1 :])
        outside = ~covered(others, ahead)
        touched.append(points[outside])
        touched_triangles.append(triangles[outside])
    skin, skin_triangles = np.concatenate(touched), np.concatenate(touched_triangles)
    few = np.random.default_rng(seed).permutation(min(len(skin), len(seen)))[:num_points]
    to_mesh = _farthest(skin[few], seen, seen_triangles, model.mesh.triangles, least)
    return _farthest(seen[few], skin, skin_triangles, np.unique(skin_triangles, axis=0), to_mesh)


def covered(model: ObjectModel, points: Array) -> NDArray[np.bool_]:
    """Whether points lie in a convex part, (n,).

    Args:
        model: The object.
        points: Points in the object's frame, meters, (n, 3).
    """
    inside = np.zeros(len(points), bool)
    for part in model.hulls:
        low, high = part.bounds
        near = np.flatnonzero(~inside & (points > low).all(1) & (points < high).all(1))
        normals = part.face_normals
        offsets = (part.triangles[:, 0] * normals).sum(1)
        for first in range(0, len(normals), _PLANES):
            some = slice(first, first + _PLANES)
            near = near[(points[near] @ normals[some].T - offsets[some] < 1e-9).all(1)]
        inside[near] = True
    return inside


def _draw(mesh: trimesh.Trimesh, num: int, seed: int) -> tuple[Array, Array]:
    """Points (n, 3) on a mesh and their triangles (n, 3, 3)."""
    points, faces = trimesh.sample.sample_surface(mesh, num, seed=seed)
    return np.asarray(points), np.asarray(mesh.triangles[faces])


def _draw_ahead(part: trimesh.Trimesh, num: int, seed: int) -> tuple[Array, Array, Array]:
    """Points on a part, their triangles, and points a little outside of it."""
    points, triangles = _draw(part, num, seed)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return points, triangles, points + _PROBE * normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _farthest(points: Array, others: Array, triangles: Array, surface: Array, least: float) -> float:
    """Largest distance of points (n, 3) from a surface, but no less than `least`.

    others: points drawn on the surface. triangles: those that they lie on.
    """
    _, near = cKDTree(others).query(points, k=_NEIGHBORS)
    repeated = np.repeat(points, _NEIGHBORS, axis=0)
    # the nearest triangle need not be among those of the nearest points, so these distances bound from above
    bound = _distance(repeated, triangles[near.ravel()]).reshape(near.shape).min(1)
    farthest = least
    for index in np.argsort(-bound):
        if bound[index] <= farthest:
            break
        farthest = max(farthest, _distance(np.repeat(points[None, index], len(surface), axis=0), surface).min())
    return farthest


def _distance(points: Array, triangles: Array) -> Array:
    """Distances of points (n, 3) from triangles (n, 3, 3), one from one."""
    closest: Array = trimesh.triangles.closest_point(triangles, points)
    distance: Array = np.linalg.norm(closest - points, axis=1)
    return distance

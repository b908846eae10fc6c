"""The poses in which an object can stay, and how likely each is after a fall.

Quasi-static: let go with a face of its hull on the table, an object topples over edges to lower faces until its center
of mass is over the face it rests on. A fall that starts in any orientation ends in a face with the share of directions
that lead there (Goldberg et al. 1999, Part pose statistics).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from dexzoo.sim.objects import Mesh, ObjectModel

Array = NDArray[np.float64]
_FLAT = 0.02  # rad between triangles of one face
_SAME = 1e-7  # m between heights that are one
_BARRIER = 3e-4  # m by which the center of mass must rise to topple to a lower face; less does not hold it


@dataclass(frozen=True)
class StablePose:
    """One way in which an object rests on the table.

    turn: rotation (3, 3) from the object's frame to the world. probability: that a fall ends in it.
    tilt: angle in rad by which it can be tipped, in the worst direction, and still falls back.
    """

    turn: Array
    probability: float
    tilt: float


def stable_poses(mesh: Mesh, center: Array) -> list[StablePose]:
    """All stable poses of a mesh, the most probable first.

    Args:
        mesh: The object's surface, in meters.
        center: Its center of mass (3,), inside the hull.

    Returns:
        The poses; their probabilities sum to one.

    Raises:
        ValueError: The center of mass is not inside the hull.
    """
    shell = mesh.convex_hull
    normals = shell.face_normals
    height = ((shell.triangles[:, 0] - center) * normals).sum(1)
    if height.min() <= 0:
        raise ValueError("the center of mass is not inside the hull of the mesh")
    first, second = shell.face_adjacency.T
    flat = shell.face_adjacency_angles < _FLAT
    links = coo_array((np.ones(flat.sum()), (first[flat], second[flat])), (len(normals),) * 2)
    num, labels = connected_components(links, directed=False)
    face = labels.astype(np.intp)
    weight = np.bincount(face, _solid_angles(shell.triangles - center), num)
    normal = np.stack([np.bincount(face, normals[:, axis] * shell.area_faces, num) for axis in range(3)], 1)
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    low = np.bincount(face, height * shell.area_faces, num) / np.bincount(face, shell.area_faces, num)
    edges = _edges(shell, face, center)
    onward = np.arange(num)
    tilt = np.full(num, np.pi / 2)
    for index in np.argsort(low):  # the lowest first, so that where a face topples to is known
        sides = edges[edges[:, 0] == index]
        other, inside = sides[:, 1].astype(int), sides[:, 2]
        barrier = np.hypot(inside, low[index]) - low[index]
        over = (low[other] < low[index] - _SAME) & ((inside < 0) | (barrier < _BARRIER))
        tilt[index] = np.arctan2(inside.min(), low[index])
        if over.any():
            onward[index] = onward[other[over][low[other[over]].argmin()]]
    share = np.bincount(onward, weight, num) / weight.sum()
    order = sorted(np.flatnonzero(share > 0), key=lambda index: (-round(share[index], 6), index))
    return [StablePose(_downwards(normal[index]), float(share[index]), float(tilt[index])) for index in order]


def set_down(model: ObjectModel, turn: Array, scale: float = 1.0) -> ObjectModel:
    """An object turned and set down: its lowest point at z = 0, the middle of its bounds on the z axis.

    Args:
        model: The object.
        turn: Rotation (3, 3) from its frame to the new one.
        scale: How much larger it becomes.

    Returns:
        The object in the new frame, mass and friction as before.
    """
    T = np.eye(4)
    T[:3, :3] = scale * turn
    low, high = model.mesh.copy().apply_transform(T).bounds
    T[:3, 3] = -(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2]
    mesh, *hulls = (each.copy().apply_transform(T) for each in (model.mesh, *model.hulls))
    return replace(model, mesh=mesh, hulls=tuple(hulls))


def _edges(shell: Mesh, face: NDArray[np.intp], center: Array) -> Array:
    """Rows of a face, its neighbor over an edge, and how far the center of mass is inside of that edge from above."""
    rows = []
    pairs, ends = shell.face_adjacency, shell.vertices[shell.face_adjacency_edges]
    along = ends[:, 1] - ends[:, 0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    for one, other in (pairs.T, pairs.T[::-1]):
        inwards = np.cross(shell.face_normals[one], along)
        inwards *= np.sign(((shell.triangles_center[one] - ends[:, 0]) * inwards).sum(1))[:, None]
        inside = ((center - ends[:, 0]) * inwards).sum(1)
        rows.append(np.column_stack((face[one], face[other], inside))[face[one] != face[other]])
    return np.concatenate(rows)


def _solid_angles(triangles: Array) -> Array:
    """Solid angles of triangles (n, 3, 3) seen from the origin (van Oosterom and Strackee 1983)."""
    a, b, c = triangles.transpose(1, 0, 2)
    la, lb, lc = (np.linalg.norm(each, axis=1) for each in (a, b, c))
    volume = np.abs((a * np.cross(b, c)).sum(1))
    scale = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
    return np.asarray(2 * np.arctan2(volume, scale))


def _downwards(normal: Array) -> Array:
    """The smallest rotation (3, 3) that brings a normal to point down."""
    if normal[2] < -1 + 1e-6:
        return np.eye(3)
    if normal[2] > 1 - 1e-6:
        return np.diag([1.0, -1.0, -1.0])
    axis = np.cross(normal, [0, 0, -1])
    axis /= np.linalg.norm(axis)
    return np.asarray(trimesh.transformations.rotation_matrix(np.arccos(-normal[2]), axis)[:3, :3])

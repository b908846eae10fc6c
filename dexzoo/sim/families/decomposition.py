"""Convex parts of any solid: cut by planes until each piece is close to its own hull. Lengths in millimeters.

The measure is the one an object is judged by (see `dexzoo.sim.fit`): how deep the surface lies in a hull, and how far
a hull stands out over the surface. Each cut is the one, of a few planes through the worst spot, that leaves the least
hull volume; pieces that fit as well together are joined again in the end.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import trimesh
from manifold3d import Manifold, Mesh64
from scipy.spatial import cKDTree

from dexzoo.sim.objects import Mesh
from dexzoo.sim.shapes.curves import Array
from dexzoo.sim.shapes.solid import hull

MAX_PARTS = 24
TOLERANCE = 1.5
"""How deep the surface may lie in a part, or how far the part may stand out over it."""
_SPARE = 8  # pieces beyond the budget that may be joined again
_POINTS, _PROBES, _NEIGHBORS = 4000, 160, 4
_LEAST, _THIN = 10.0, 0.7  # mm3 and mm: smaller or thinner pieces are crumbs that no finger feels
_CRUMB = 20  # how much worse a mm3 that is lost with a crumb is than one that a hull has too much
_FACE = 0.2  # mm3 of hull that a mm2 of its surface counts as: short cuts leave rounder pieces


def to_manifold(mesh: Mesh) -> Manifold:
    """The solid inside a watertight mesh.

    Args:
        mesh: A watertight surface.

    Returns:
        The solid.
    """
    return Manifold(Mesh64(np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.uint64)))


def to_mesh(solid: Manifold) -> Mesh:
    """The surface of a solid.

    Args:
        solid: The solid.

    Returns:
        Its surface, with the vertices as the solid has them.
    """
    faces = np.asarray(solid.to_mesh64().tri_verts).astype(np.int64)
    return Mesh(_vertices(solid), faces, process=False)  # merging what only touches would open seams


def decompose(mesh: Mesh, budget: int = MAX_PARTS, tolerance: float = TOLERANCE) -> list[Mesh]:
    """Convex parts that together are the mesh within a tolerance.

    Args:
        mesh: A watertight surface.
        budget: Number of parts at most.
        tolerance: How far the surfaces of mesh and parts may be apart.

    Returns:
        The parts, each convex.

    Raises:
        ValueError: More parts would be needed, or the mesh has spikes that are too thin for any.
    """
    surface = _Surface(mesh)
    queue: list[tuple[float, int, _Piece, Array]] = []
    count = 0
    new = [_Piece(to_manifold(mesh), ())]
    while True:
        for piece in (connected for each in new for connected in each.connected()):
            error, spot = surface.misfit(piece.solid.hull(), piece.cuts, tolerance)
            heapq.heappush(queue, (-error, count, piece, spot))
            count += 1
        if not queue or -queue[0][0] <= tolerance:
            break
        if len(queue) >= budget + _SPARE:
            raise ValueError(f"the mesh needs more than {budget} convex parts")
        _, _, piece, spot = heapq.heappop(queue)
        new = surface.cut(piece, spot)
    pieces = [_Piece(piece.solid.hull(), piece.cuts) for _, _, piece, _ in sorted(queue, key=lambda each: each[1])]
    pieces = _joined(pieces, surface, tolerance)
    if not 0 < len(pieces) <= budget:
        raise ValueError(f"the mesh needs more than {budget} convex parts")
    parts = [hull(_vertices(piece.solid)) for piece in pieces]
    if _farthest_outside(np.asarray(mesh.vertices), parts) > tolerance:
        raise ValueError("the mesh has spikes too thin for a convex part")
    return parts


@dataclass(frozen=True)
class _Piece:
    """A solid and the planes (normal, offset) that it was cut along."""

    solid: Manifold
    cuts: tuple[Array, ...]

    def connected(self) -> list[_Piece]:
        return [_Piece(solid, self.cuts) for solid in self.solid.decompose() if _is_felt(solid)]

    def split(self, normal: Array, offset: float) -> list[_Piece]:
        cuts = (*self.cuts, np.array([*normal, offset]))
        return [_Piece(half, cuts) for half in self.solid.split_by_plane(normal, offset) if _is_felt(half)]

    def bounds(self) -> Array:
        return np.reshape(self.solid.bounding_box(), (2, 3))


class _Surface:
    """Points on a mesh with normals, against which its pieces are measured; and its inner edges."""

    def __init__(self, mesh: Mesh) -> None:
        points, faces = trimesh.sample.sample_surface(mesh, _POINTS, seed=0)
        self.points, self.faces, self.normals = np.asarray(points), faces, np.asarray(mesh.face_normals[faces])
        self.triangles = np.asarray(mesh.triangles)
        self.tree = cKDTree(self.points)
        concave = ~mesh.face_adjacency_convex & (mesh.face_adjacency_angles > 0.3)
        ends = mesh.vertices[mesh.face_adjacency_edges[concave]]
        self.edges = ends.mean(1)
        self.edge_normals = mesh.face_normals[mesh.face_adjacency[concave]]
        self.edge_weight = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) * mesh.face_adjacency_angles[concave]

    def misfit(self, solid: Manifold, cuts: tuple[Array, ...], tolerance: float) -> tuple[float, Array]:
        """How far a convex solid is from the surface at worst, its cut faces left out, and where.

        What stands out over the surface by less than the tolerance may count as nothing.
        """
        shell = to_mesh(solid)
        planes, offsets = shell.face_normals, (shell.face_normals * shell.triangles[:, 0]).sum(1)
        low, high = shell.bounds
        near = self.points[((self.points > low) & (self.points < high)).all(1)]
        depth = (offsets - near @ planes.T).min(1) if len(near) else np.zeros(0)
        if cuts:
            across = shell.vertices @ np.array(cuts)[:, :3].T - np.array(cuts)[:, 3]
            free = np.abs(across[shell.faces]).max(1).min(1) > 1e-3
            if not free.any():
                return 0.0, low
            shell.update_faces(free)
        probes, _ = trimesh.sample.sample_surface(shell, _PROBES, seed=0)
        index = self.tree.query(probes, k=_NEIGHBORS)[1]
        away = np.repeat(probes, _NEIGHBORS, axis=0)
        # from above, since the nearest triangle need not be among those of the nearest points
        bound = _distance(away, self.triangles[self.faces[index.ravel()]]).reshape(index.shape).min(1)
        worst, spot = (float(depth.max()), near[depth.argmax()]) if len(depth) else (0.0, low)
        for probe in np.argsort(-bound):
            if bound[probe] <= max(worst, tolerance):
                break
            excess = _distance(np.broadcast_to(probes[probe], (len(self.triangles), 3)), self.triangles).min()
            if excess > worst:
                worst, spot = float(excess), probes[probe]
        return worst, spot

    def cut(self, piece: _Piece, spot: Array) -> list[_Piece]:
        """A piece cut in two by the plane that leaves the least hull."""
        best: list[_Piece] = []
        least = np.inf
        for normal, point in self._planes(piece, spot):
            halves = piece.split(normal, float(point @ normal))
            hulls = [half.solid.hull() for half in halves]
            waste = sum(hull.volume() + _FACE * hull.surface_area() for hull in hulls)
            lost = piece.solid.volume() - sum(half.solid.volume() for half in halves)
            waste += _CRUMB * lost
            if halves and (len(halves) == 2 or lost > 1) and waste < least:
                best, least = halves, waste
        return best

    def _planes(self, piece: _Piece, spot: Array) -> list[tuple[Array, Array]]:
        """Normals and points of planes to try: through the worst spot, the middle, and along inner edges."""
        vertices = _vertices(piece.solid)
        low, high = vertices.min(0), vertices.max(0)
        middle = (low + high) / 2
        axes = np.linalg.svd(vertices - vertices.mean(0), full_matrices=False)[2]
        normals = [*np.eye(3), *axes, self.normals[self.tree.query(spot)[1]]]
        planes = [(normal, spot) for normal in normals]
        planes += [(normal, middle) for normal in normals[:3] if np.abs((spot - middle) @ normal) > 1]
        inside = np.flatnonzero(((self.edges > low + 0.1) & (self.edges < high - 0.1)).all(1))
        for edge in inside[np.argsort(-self.edge_weight[inside], kind="stable")][:4]:
            first, second = self.edge_normals[edge]
            bisector = (first - second) / np.linalg.norm(first - second)
            planes += [(normal, self.edges[edge]) for normal in (first, second, bisector)]
        return planes


def _joined(pieces: list[_Piece], surface: _Surface, tolerance: float) -> list[_Piece]:
    """The convex pieces, pairs of which are made one as long as that fits too."""
    alive = dict(enumerate(pieces))
    fits: dict[tuple[int, int], tuple[float, _Piece] | None] = {}
    while True:
        for pair in combinations(alive, 2):
            if pair not in fits:
                fits[pair] = _join(alive[pair[0]], alive[pair[1]], surface, tolerance)
        good = [(fit[0], pair, fit[1]) for pair, fit in fits.items() if fit and set(pair) <= alive.keys()]
        if not good:
            return list(alive.values())
        _, pair, piece = min(good, key=lambda each: each[:2])
        for key in pair:
            del alive[key]
        alive[max(fits, key=lambda each: each[1])[1] + 1] = piece


def _join(first: _Piece, second: _Piece, surface: _Surface, tolerance: float) -> tuple[float, _Piece] | None:
    """The hull of two convex pieces and the volume it adds to theirs, or None if it does not fit."""
    (low, high), (other_low, other_high) = first.bounds(), second.bounds()
    if (low > other_high + 0.1).any() or (other_low > high + 0.1).any():
        return None
    joined = _Piece(Manifold.batch_hull([first.solid, second.solid]), first.cuts + second.cuts)
    waste = joined.solid.volume() - first.solid.volume() - second.solid.volume()
    if waste > tolerance * joined.solid.surface_area() / 4:
        return None
    return (waste, joined) if surface.misfit(joined.solid, joined.cuts, tolerance)[0] <= tolerance else None


def _farthest_outside(points: Array, parts: list[Mesh]) -> float:
    """How far the worst of some points (n, 3) is outside of the nearest part, at least."""
    outside = np.full(len(points), np.inf)
    for part in parts:
        offsets = (part.face_normals * part.triangles[:, 0]).sum(1)
        outside = np.minimum(outside, (points @ part.face_normals.T - offsets).max(1))
    return float(outside.max())


def _vertices(solid: Manifold) -> Array:
    return np.array(solid.to_mesh64().vert_properties, np.float64)[:, :3].copy()


def _distance(points: Array, triangles: Array) -> Array:
    """Distances of points (n, 3) from triangles (n, 3, 3), one from one."""
    return np.asarray(np.linalg.norm(trimesh.triangles.closest_point(triangles, points) - points, axis=1))


def _is_felt(solid: Manifold) -> bool:
    volume = solid.volume()
    return bool(volume > _LEAST and 2 * volume > _THIN * solid.surface_area())

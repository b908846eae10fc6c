"""Simple objects from a few numbers each: boxes, cans, balls, bottles, bowls and mugs.

Every object is made of convex parts, and its mesh is their surface, so that what the camera sees and what the hand
touches agree.
"""

from __future__ import annotations

import zlib
from itertools import pairwise

import numpy as np
import trimesh
from numpy.typing import NDArray

from dexzoo.sim.objects import Mesh, ObjectModel

NUM_OBJECTS = {"ball": 4, "bottle": 10, "bowl": 6, "box": 12, "can": 10, "mug": 8}
MASS_RANGE = {
    "ball": (0.05, 0.07),
    "bottle": (0.03, 0.07),
    "bowl": (0.05, 0.40),
    "box": (0.05, 0.50),
    "can": (0.20, 0.40),
    "mug": (0.25, 0.35),
}
"""Kilograms by category (thesis, Table 3.2)."""
_SECTIONS = 24


def object_names() -> list[str]:
    """Names of all objects, such as mug_03."""
    return [f"{category}_{i:02d}" for category, count in NUM_OBJECTS.items() for i in range(count)]


def make_object(name: str) -> ObjectModel:
    """The object of that name, always the same; ValueError names what exists."""
    category, _, number = name.rpartition("_")
    if name not in object_names():
        known = ", ".join(f"{kind}_00...{count - 1:02d}" for kind, count in NUM_OBJECTS.items())
        raise ValueError(f"object {name!r} is unknown; known are {known}")
    rng = np.random.default_rng([zlib.crc32(category.encode()), int(number)])
    parts, mesh = _MAKERS[category](rng)
    mass = float(rng.uniform(*MASS_RANGE[category]))
    friction = float(rng.uniform(0.5, 1.0))
    model = ObjectModel.from_mesh(mesh, mass, friction, parts, name)
    return ObjectModel(name, model.mesh, model.hulls, mass, friction, category)


def _box(rng: np.random.Generator) -> tuple[list[Mesh], Mesh]:
    size = rng.uniform([0.03, 0.04, 0.03], [0.075, 0.14, 0.20])
    return _standing([trimesh.creation.box(size)])


def _can(rng: np.random.Generator) -> tuple[list[Mesh], Mesh]:
    radius, height = rng.uniform(0.022, 0.04), rng.uniform(0.07, 0.16)
    return _standing([trimesh.creation.cylinder(radius, height, sections=_SECTIONS)])


def _ball(rng: np.random.Generator) -> tuple[list[Mesh], Mesh]:
    return _standing([trimesh.creation.icosphere(3, rng.uniform(0.025, 0.042))])


def _bottle(rng: np.random.Generator) -> tuple[list[Mesh], Mesh]:
    body, neck = rng.uniform(0.025, 0.038), rng.uniform(0.011, 0.016)
    body_height, shoulder, neck_height = rng.uniform(0.09, 0.15), rng.uniform(0.02, 0.045), rng.uniform(0.02, 0.05)
    levels = np.cumsum([0, body_height, shoulder, neck_height])
    return _standing(
        [
            _frustum(levels[i], levels[i + 1], a, b)
            for i, (a, b) in enumerate([(body, body), (body, neck), (neck, neck)])
        ]
    )


def _bowl(rng: np.random.Generator) -> tuple[list[Mesh], Mesh]:
    foot, middle, rim = rng.uniform(0.02, 0.03), rng.uniform(0.045, 0.06), rng.uniform(0.06, 0.08)
    height, wall = rng.uniform(0.045, 0.075), rng.uniform(0.003, 0.005)
    profile = [(foot, 0.0), (middle, 0.4 * height), (rim, height)]
    return _standing([_frustum(0.0, wall, foot, foot * 1.05), *_wall(profile, wall, sectors=10)])


def _mug(rng: np.random.Generator) -> tuple[list[Mesh], Mesh]:
    radius, height, wall = rng.uniform(0.034, 0.043), rng.uniform(0.08, 0.105), rng.uniform(0.003, 0.005)
    parts = [_frustum(0.0, wall, radius, radius), *_wall([(radius, 0.0), (radius, height)], wall, sectors=14)]
    reach, thick = rng.uniform(0.025, 0.035), rng.uniform(0.005, 0.007)
    angles = np.linspace(-np.pi / 2, np.pi / 2, 6)
    arc = np.column_stack(
        (radius - 0.002 + reach * np.cos(angles), 0 * angles, height / 2 + 0.3 * height * np.sin(angles))
    )
    for a, b in pairwise(arc):
        ends = [trimesh.creation.icosphere(1, thick).apply_translation(point).vertices for point in (a, b)]
        parts.append(_hull(*ends))
    return _standing(parts)


_MAKERS = {"ball": _ball, "bottle": _bottle, "bowl": _bowl, "box": _box, "can": _can, "mug": _mug}


def _ring(radius: float, z: float, angles: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.column_stack((radius * np.cos(angles), radius * np.sin(angles), np.full(len(angles), z)))


def _hull(*points: NDArray[np.float64]) -> Mesh:
    hull: Mesh = trimesh.convex.convex_hull(np.concatenate(points))
    return hull


def _frustum(bottom: float, top: float, radius_bottom: float, radius_top: float) -> Mesh:
    angles = np.linspace(0, 2 * np.pi, _SECTIONS, endpoint=False)
    return _hull(_ring(radius_bottom, bottom, angles), _ring(radius_top, top, angles))


def _wall(profile: list[tuple[float, float]], thickness: float, sectors: int) -> list[Mesh]:
    """A wall of revolution along (radius, height) pairs of its outer side, cut into convex sectors."""
    parts = []
    for (r0, z0), (r1, z1) in pairwise(profile):
        for k in range(sectors):
            # flat sectors: their outer corners lie on the circle, two steps a sector
            angles = 2 * np.pi / sectors * np.array([k, k + 1])
            corners = [_ring(r, z, angles) for r, z in ((r0, z0), (r1, z1), (r0 - thickness, z0), (r1 - thickness, z1))]
            parts.append(_hull(*corners))
    return parts


def _standing(parts: list[Mesh]) -> tuple[list[Mesh], Mesh]:
    """The parts with their lowest point at z = 0, and one mesh of them all."""
    mesh = trimesh.util.concatenate(parts)
    drop = [0, 0, -mesh.bounds[0][2]]
    return [part.apply_translation(drop) for part in parts], mesh.apply_translation(drop)

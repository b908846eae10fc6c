"""The 294 objects of the grasp set: twenty categories of household things, made from a few numbers each.

A name such as mug_03 stands for one object, always the same. Its mesh, which the camera sees, and its convex parts,
which the hand touches, come from the same description and agree within 2 mm. Numbers, categories and masses are those
of the thesis (section 3.5.1 and Table 3.2).
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from functools import cache

import numpy as np

from dexzoo.sim import families
from dexzoo.sim.objects import ObjectModel
from dexzoo.sim.shapes import containers, flatware, vessels
from dexzoo.sim.shapes.solid import Solid

NUM_OBJECTS = {
    "bottle": 25,
    "bowl": 14,
    "box": 15,
    "can": 20,
    "cup": 18,
    "fork": 20,
    "pan": 13,
    "jug": 14,
    "knife": 17,
    "mug": 18,
    "plate": 9,
    "scissors": 12,
    "shaker": 20,
    "spatula": 15,
    "spoon": 20,
    "teacup": 12,
    "teapot": 21,
    "funnel": 8,
    "ball": 2,
    "dustpan": 1,
}
MASS_RANGE = {
    "bottle": (0.03, 0.07),
    "bowl": (0.05, 0.40),
    "box": (0.05, 0.50),
    "can": (0.20, 0.40),
    "cup": (0.03, 0.33),
    "fork": (0.04, 0.08),
    "pan": (0.15, 0.45),
    "jug": (0.08, 0.20),
    "knife": (0.05, 0.15),
    "mug": (0.25, 0.35),
    "plate": (0.04, 0.08),
    "scissors": (0.05, 0.15),
    "shaker": (0.10, 0.16),
    "spatula": (0.04, 0.08),
    "spoon": (0.04, 0.08),
    "teacup": (0.15, 0.25),
    "teapot": (0.50, 0.80),
    "funnel": (0.04, 0.08),
    "ball": (0.05, 0.07),
    "dustpan": (0.10, 0.15),
}
"""Kilograms by category (thesis, Table 3.2)."""
NUM_TEST, NUM_VALIDATION = 44, 30
_FRICTION = (0.5, 1.0)
_MILLIMETER = 1e-3

_MAKERS: dict[str, Callable[[np.random.Generator, int], Solid]] = {
    category: getattr(module, category)
    for module in (containers, vessels, flatware)
    for category in NUM_OBJECTS
    if hasattr(module, category)
}


def object_names(split: str | None = None) -> list[str]:
    """Names of all objects, such as mug_03, or of those of one split.

    Args:
        split: train, validation or test; None for all.
    """
    names = [f"{category}_{i:02d}" for category, count in NUM_OBJECTS.items() for i in range(count)]
    return names if split is None else [name for name in names if split_of(name) == split]


@cache
def make_object(name: str) -> ObjectModel:
    """Make the object of a name, always the same; do not change it in place.

    It stands on z = 0 as it is to be placed, the middle of its bounds on the z axis.

    Args:
        name: Name of the object, such as mug_03, or of one of `dexzoo.sim.families`, such as revolved_00017.

    Raises:
        ValueError: The name is unknown; the error names those that exist.
    """
    if families.is_shape(name):
        return families.make_shape(name)
    category, number = _parse(name)
    rng = np.random.default_rng([zlib.crc32(category.encode()), number])
    solid = _MAKERS[category](rng, number)
    low, high = solid.mesh.bounds
    shift = [-(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2]]
    mesh, *parts = (
        each.copy().apply_translation(shift).apply_scale(_MILLIMETER) for each in (solid.mesh, *solid.parts)
    )
    mass, friction = float(rng.uniform(*MASS_RANGE[category])), float(rng.uniform(*_FRICTION))
    return ObjectModel(name, mesh, tuple(parts), mass, friction, category)


def split_of(name: str) -> str:
    """The split of an object: 220 are train, 30 validation and 44 test, in proportion in every category.

    Args:
        name: Name of the object.

    Raises:
        ValueError: The name is unknown.
    """
    category, number = _parse(name)
    order = np.random.default_rng([zlib.crc32(category.encode()), 1 << 20]).permutation(NUM_OBJECTS[category])
    rank = int(np.flatnonzero(order == number)[0])
    test, validation = _shares()
    if rank < test[category]:
        return "test"
    return "validation" if rank < test[category] + validation[category] else "train"


@cache
def _shares() -> tuple[dict[str, int], dict[str, int]]:
    """How many objects of each category are test and validation: by largest remainder, a pair has one for test."""
    shares = []
    for total, least in ((NUM_TEST, 1), (NUM_VALIDATION, 0)):
        exact = {kind: total * count / sum(NUM_OBJECTS.values()) for kind, count in NUM_OBJECTS.items()}
        share = {kind: max(int(exact[kind]), least if NUM_OBJECTS[kind] > 1 else 0) for kind in NUM_OBJECTS}
        for kind in sorted(NUM_OBJECTS, key=lambda kind: share[kind] - exact[kind])[: total - sum(share.values())]:
            share[kind] += 1
        shares.append(share)
    return shares[0], shares[1]


def _parse(name: str) -> tuple[str, int]:
    category, _, number = name.rpartition("_")
    if category not in NUM_OBJECTS or number not in {f"{i:02d}" for i in range(NUM_OBJECTS[category])}:
        known = ", ".join(f"{kind}_00...{count - 1:02d}" for kind, count in NUM_OBJECTS.items())
        raise ValueError(f"object {name!r} is unknown; known are {known}")
    return category, int(number)

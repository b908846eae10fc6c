"""Objects that no one made: ten families of shapes, each drawn from a seed.

A name such as revolved_00017 is a family and a seed, and stands for one object, always the same: a watertight mesh,
which the camera sees, and at most 24 convex parts, which the hand touches, within 2 mm of it and with open cavities.
No file belongs to them; objects that take long to make are kept in the user's cache folder.

Whole families are held out, so that figures measured on them tell how a method does on kinds of shapes that it never
saw: blob for validation, body and tool for test. The two of the test share the least with the others' rules of making,
and they resemble the scanned objects on which grasps failed most (teapots, clocks, toys with handles; long things with
a head). Blob is the only smooth, irregular one. The training families still have every element: cavities, walls, bars,
edges.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import QhullError

from dexzoo.sim.families.cache import cached
from dexzoo.sim.families.compound import body, carved
from dexzoo.sim.families.decomposition import MAX_PARTS
from dexzoo.sim.families.flat import extruded, relief
from dexzoo.sim.families.long import bar, tool
from dexzoo.sim.families.revolution import container, revolved
from dexzoo.sim.families.smooth import blob, superquadric
from dexzoo.sim.fit import surface_distance
from dexzoo.sim.objects import ObjectModel
from dexzoo.sim.poses import set_down, stable_poses
from dexzoo.sim.properties import DENSITY, FRICTION, MASS
from dexzoo.sim.shapes.solid import Solid

NUM_SEEDS = 100_000
"""Seeds of a family: 00000 to 99999."""
HELD_OUT = {"blob": "validation", "body": "test", "tool": "test"}
EXTENT = (0.03, 0.3)
"""The largest extent of an object, in meters."""
MAX_DISTANCE = 1.75e-3
"""Meters between mesh and parts above which a shape is drawn again."""
_TRIES = 40
_SLOW = ("blob", "carved")  # take a second or more, and are kept on disk
_POINTS, _POINTS_SLOW = 4000, 20_000
_TILT = 0.14  # rad; an object is left as drawn if it stands that far tipped
_MILLIMETER = 1e-3

_MAKERS: dict[str, Callable[[np.random.Generator], Solid]] = {
    maker.__name__: maker
    for maker in (revolved, container, extruded, relief, superquadric, blob, carved, body, bar, tool)
}


def family_names(split: str | None = None) -> list[str]:
    """Names of the families, all of them or those of one split.

    Args:
        split: Train, validation or test; None for all.

    Returns:
        The names.
    """
    return [family for family in _MAKERS if split is None or HELD_OUT.get(family, "train") == split]


def shape_name(family: str, seed: int) -> str:
    """The name of an object.

    Args:
        family: One of `family_names()`.
        seed: From 0 to 99999.

    Returns:
        The name, such as revolved_00017.

    Raises:
        ValueError: There is no such family or seed.
    """
    name = f"{family}_{seed:05d}"
    parse_name(name)
    return name


def parse_name(name: str) -> tuple[str, int]:
    """Family and seed of an object's name.

    Args:
        name: Such as revolved_00017.

    Returns:
        The family and the seed.

    Raises:
        ValueError: The name is not one of a family and a seed of five digits.
    """
    family, _, digits = name.rpartition("_")
    if family not in _MAKERS or len(digits) != 5 or not (digits.isascii() and digits.isdigit()):
        raise ValueError(f"shape {name!r} is unknown; known are {', '.join(_MAKERS)}, each _00000...{NUM_SEEDS - 1}")
    return family, int(digits)


def is_shape(name: str) -> bool:
    """Whether a name begins like those of the families.

    Args:
        name: Name of any object.

    Returns:
        True if the part before its last underscore is a family.
    """
    return name.rpartition("_")[0] in _MAKERS


def split_of_shape(name: str) -> str:
    """The split of an object: that of its family, train, validation or test.

    Args:
        name: Such as revolved_00017.

    Returns:
        The split.

    Raises:
        ValueError: There is no such object.
    """
    return HELD_OUT.get(parse_name(name)[0], "train")


@lru_cache(maxsize=256)
def make_shape(name: str) -> ObjectModel:
    """The object of that name, always the same. Do not change it in place.

    It stands on z = 0 with the middle of its bounds on the z axis: as it was drawn if it stands well like that,
    otherwise in its most probable stable pose. It is drawn again, from the same seed, until it is one piece of the
    right size that its parts fit.

    Args:
        name: Family and seed, such as revolved_00017.

    Returns:
        The object, its category the family's name.

    Raises:
        ValueError: There is no such object.
    """
    slow = parse_name(name)[0] in _SLOW
    return cached(name, lambda: _made(name)) if slow else _made(name)


def _made(name: str) -> ObjectModel:
    for attempt in range(_TRIES):
        model = draw_shape(name, attempt)
        if model is not None:
            return model
    raise ValueError(f"shape {name} cannot be made; take another seed")


def draw_shape(name: str, attempt: int) -> ObjectModel | None:
    """One of the draws that `make_shape` takes the first sound one of.

    Args:
        name: Family and seed, such as revolved_00017.
        attempt: Which draw, from 0.

    Returns:
        The object; None if it is not one piece, too large or too small, or of too many parts or parts that do not fit.

    Raises:
        ValueError: There is no such object.
    """
    family, seed = parse_name(name)
    rng = np.random.default_rng([zlib.crc32(family.encode()), seed, attempt])
    density = float(np.exp(rng.uniform(*np.log(DENSITY))))
    friction = float(rng.uniform(*FRICTION))
    try:
        solid = _MAKERS[family](rng)
    except (ValueError, IndexError, QhullError):  # a profile that cuts itself, a wall that needs too many parts
        return None
    mesh, parts = solid.mesh, solid.parts
    if not mesh.is_watertight or mesh.volume <= 0 or mesh.body_count != 1:
        return None
    if not 0 < len(parts) <= MAX_PARTS or not all(part.is_convex for part in parts):
        return None
    mass = float(np.clip(density * sum(part.volume for part in parts) * _MILLIMETER**3, *MASS))
    drawn = ObjectModel(name, mesh, tuple(parts), mass, friction, family)
    model = set_down(drawn, _stance(drawn), _MILLIMETER)
    if not EXTENT[0] <= model.mesh.extents.max() <= EXTENT[1]:
        return None
    points = _POINTS_SLOW if family in _SLOW else _POINTS  # where parts come of cuts, gaps are small and hidden
    return model if surface_distance(model, points, least=MAX_DISTANCE) <= MAX_DISTANCE else None


def _stance(model: ObjectModel) -> NDArray[np.float64]:
    """The rotation (3, 3) that stands an object up."""
    poses = stable_poses(model.mesh, model.inertia[0])
    for pose in poses:
        if pose.turn[2, 2] > 1 - 1e-6 and pose.tilt > _TILT:
            return np.eye(3)
    return poses[0].turn

"""Shapes that take long to make, kept in the user's cache folder; they can be made again at any time."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from functools import cache
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from dexzoo.resources import user_cache
from dexzoo.sim.objects import Mesh, ObjectModel

_SIM = Path(__file__).parent.parent
_SOURCES = [
    *sorted((_SIM / "families").glob("*.py")),
    *sorted((_SIM / "shapes").glob("*.py")),
    *(_SIM / name for name in ("fit.py", "poses.py", "properties.py")),
]
_PACKAGES = ("manifold3d", "numpy", "scipy", "trimesh")


def cached(name: str, make: Callable[[], ObjectModel]) -> ObjectModel:
    """An object from the cache, or made and put there.

    The file's name tells of the object, of the code that makes it and of the packages that this rests on, so that a
    change to any of them makes it anew.

    Args:
        name: The object's name.
        make: Makes it.

    Returns:
        The same object, to the byte, either way.
    """
    path = user_cache() / "shapes" / f"{name}_{_digest()}.npz"
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return _unpacked(name, dict(arrays))
    except (OSError, ValueError, KeyError, BadZipFile):  # not there, or written by half
        model = make()
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".npz", delete=False) as new:
        np.savez(new, allow_pickle=False, **_packed(model))
    Path(new.name).replace(path)
    return model


@cache
def _digest() -> str:
    sums = sha256()
    for path in _SOURCES:
        sums.update(path.read_bytes())
    for package in _PACKAGES:
        sums.update(f"{package} {version(package)}".encode())
    return sums.hexdigest()[:16]


def _packed(model: ObjectModel) -> dict[str, np.ndarray]:
    arrays = {"mass": np.array(model.mass), "friction": np.array(model.friction), "category": np.array(model.category)}
    for index, mesh in enumerate((model.mesh, *model.hulls)):
        arrays |= {f"vertices_{index}": np.asarray(mesh.vertices), f"faces_{index}": np.asarray(mesh.faces)}
    return arrays


def _unpacked(name: str, arrays: dict[str, np.ndarray]) -> ObjectModel:
    count = sum(key.startswith("faces_") for key in arrays)
    mesh, *hulls = (
        Mesh(arrays[f"vertices_{index}"], arrays[f"faces_{index}"], process=False) for index in range(count)
    )
    mass, friction = float(arrays["mass"]), float(arrays["friction"])
    return ObjectModel(name, mesh, tuple(hulls), mass, friction, str(arrays["category"]))

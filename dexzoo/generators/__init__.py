"""Generative models: what proposes grasps for an observation."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from dexzoo.generators.demonstration import load_demonstrations
from dexzoo.generators.generator import GraspGenerator
from dexzoo.generators.heuristic import HeuristicGenerator
from dexzoo.generators.kopicki import KopickiGenerator

_GENERATORS: dict[str, type[GraspGenerator]] = {"kopicki": KopickiGenerator, "heuristic": HeuristicGenerator}


def list_generators() -> list[str]:
    """Names of all generators, the default first."""
    return list(_GENERATORS)


@lru_cache(maxsize=4)
def make_generator(name: str) -> GraspGenerator:
    """The generator of that name with its default settings, or Kopicki's that learns from a folder of demonstrations.

    Raises ValueError that names what exists, or says what is wrong with a demonstration.
    """
    if name in _GENERATORS:
        return _GENERATORS[name]()
    if Path(name).is_dir():
        return KopickiGenerator(load_demonstrations(name))
    known = ", ".join(_GENERATORS)
    raise ValueError(f"generator {name!r} is unknown; use one of {known}, or a folder of demonstrations")


def default_generator() -> KopickiGenerator:
    """The one that `make_generator` gives as kopicki, whose density is the prior of refinement."""
    generator = make_generator("kopicki")
    assert isinstance(generator, KopickiGenerator)
    return generator

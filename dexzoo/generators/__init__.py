"""Generative models: what proposes grasps for an observation."""

from __future__ import annotations

import importlib

from dexzoo.generators.generator import GraspGenerator

_GENERATORS = {
    "heuristic": "dexzoo.generators.heuristic.HeuristicGenerator",
    "kopicki": "dexzoo.generators.kopicki.KopickiGenerator",
}


def list_generators() -> list[str]:
    """Names of all generators."""
    return list(_GENERATORS)


def make_generator(name: str) -> GraspGenerator:
    """The generator of that name with its default settings; ValueError names what exists."""
    if name not in _GENERATORS:
        raise ValueError(f"generator {name!r} is unknown; known are {', '.join(_GENERATORS)}")
    module, cls = _GENERATORS[name].rsplit(".", 1)
    generator: GraspGenerator = getattr(importlib.import_module(module), cls)()
    return generator

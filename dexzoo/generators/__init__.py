"""Generative models: they propose grasps for a view."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from dexzoo.generators.demonstration import load_demonstrations
from dexzoo.generators.generator import GraspDensity, GraspGenerator
from dexzoo.generators.heuristic import HeuristicGenerator
from dexzoo.generators.kopicki import KopickiGenerator
from dexzoo.hand import Hand

__all__ = ["GENERATORS", "GraspDensity", "GraspGenerator", "make_generator"]

GENERATORS = ("kopicki", "heuristic")
"""Names of all generators, the default first."""


@lru_cache(maxsize=4)
def make_generator(name: str, hand: Hand) -> GraspGenerator:
    """Make a generator with its default settings.

    Args:
        name: A name in `GENERATORS`, or a folder of demonstrations that Kopicki's learns from.
        hand: The hand that it proposes grasps of.

    Returns:
        The generator.

    Raises:
        FileNotFoundError: The hand has no demonstrations.
        ValueError: The name is unknown, or a demonstration is damaged or of another hand.
    """
    if name == "heuristic":
        return HeuristicGenerator(hand)
    if name == "kopicki":
        return KopickiGenerator(load_demonstrations(hand))
    if Path(name).is_dir():
        return KopickiGenerator(load_demonstrations(hand, name))
    known = ", ".join(GENERATORS)
    raise ValueError(f"generator {name!r} is unknown; use one of {known}, or a folder of demonstrations")

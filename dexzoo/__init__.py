"""dexzoo: grasps for a five-finger hand from one depth image: proposed, predicted, refined, checked in simulation.

Names are loaded when they are first used, so that `import dexzoo` takes no time.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dexzoo import sim
    from dexzoo.grasp import Grasps
    from dexzoo.hand import Hand
    from dexzoo.models.evaluator import GraspEvaluator
    from dexzoo.models.registry import list_models
    from dexzoo.models.zoo import load
    from dexzoo.perception import Camera, Observation, View
    from dexzoo.planning import Plan, generate, plan
    from dexzoo.refinement import Refinement, refine
    from dexzoo.verification import verify

__version__ = "0.1.0"

_HOMES = {
    "Camera": "dexzoo.perception",
    "GraspEvaluator": "dexzoo.models.evaluator",
    "Grasps": "dexzoo.grasp",
    "Hand": "dexzoo.hand",
    "Observation": "dexzoo.perception",
    "Plan": "dexzoo.planning",
    "Refinement": "dexzoo.refinement",
    "View": "dexzoo.perception",
    "generate": "dexzoo.planning",
    "list_models": "dexzoo.models.registry",
    "load": "dexzoo.models.zoo",
    "plan": "dexzoo.planning",
    "refine": "dexzoo.refinement",
    "verify": "dexzoo.verification",
}

__all__ = [
    "Camera",
    "GraspEvaluator",
    "Grasps",
    "Hand",
    "Observation",
    "Plan",
    "Refinement",
    "View",
    "generate",
    "list_models",
    "load",
    "plan",
    "refine",
    "sim",
    "verify",
]


def __getattr__(name: str) -> Any:  # noqa: ANN401, whatever bears the name
    if name == "sim":
        return importlib.import_module("dexzoo.sim")
    if name not in _HOMES:
        raise AttributeError(f"module 'dexzoo' has no attribute {name!r}")
    found = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted((*globals(), *__all__))

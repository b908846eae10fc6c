"""dexzoo: grasps for a five-finger hand from one depth image: proposed, predicted, refined, checked in simulation."""

from dexzoo import sim
from dexzoo.camera import Camera, Observation
from dexzoo.grasp import Grasps
from dexzoo.hand import Hand
from dexzoo.models.zoo import list_models, load
from dexzoo.planning import generate, plan
from dexzoo.refinement import refine
from dexzoo.verification import verify

__version__ = "0.1.0"

__all__ = [
    "Camera",
    "Grasps",
    "Hand",
    "Observation",
    "generate",
    "list_models",
    "load",
    "plan",
    "refine",
    "sim",
    "verify",
]

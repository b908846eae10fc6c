"""The simulator that judges grasps. Nothing that proposes, predicts or refines grasps may import it."""

from dexzoo.sim.objects import ObjectModel
from dexzoo.sim.scene import Scene
from dexzoo.sim.trial import Outcomes

__all__ = ["ObjectModel", "Outcomes", "Scene"]

"""Autonomous training (Kopicki et al. 2019): grasps that held in simulation become further demonstrations.

Only training objects are practised on.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dexzoo.generators.demonstration import Demonstration
from dexzoo.generators.generator import GraspGenerator
from dexzoo.sim import Scene
from dexzoo.sim.shapes import make_object
from dexzoo.verification import verify

TRIALS = 5
MIN_RATE = 0.8
"""Share of the trials under drawn mass, friction and wrist error in which a grasp must hold to be learned from."""
MAX_PER_SCENE = 6


def practise(generator: GraspGenerator, name: str, num_grasps: int = 60, seed: int = 0) -> Iterator[Demonstration]:
    """Try a generator on a known object.

    Args:
        generator: The generator.
        name: Name of the object.
        num_grasps: Grasps that are tried.
        seed: Seed of scene, view and grasps.

    Returns:
        Demonstrations of the grasps that hold again and again, at most six.
    """
    obj = make_object(name)
    try:
        scene = Scene.place(obj, seed)
        observation = scene.observe(seed)
        grasps = generator.generate(observation, num_grasps, seed)
    except (RuntimeError, ValueError):  # not to be placed, seen or grasped this time
        return
    held = np.flatnonzero(verify(grasps, scene).success)
    if not len(held):
        return
    rate = verify(grasps[held], scene, seed, TRIALS).success_rate
    good = held[rate >= MIN_RATE][:MAX_PER_SCENE]
    local = grasps[good].transformed(np.linalg.inv(scene.T_world_object))
    for row in range(len(good)):
        yield Demonstration.record(local[row], obj.mesh, name)

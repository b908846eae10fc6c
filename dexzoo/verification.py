"""Grasps and a scene in, outcomes out: the simulator's verdict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from dexzoo import rotation
from dexzoo.grasp import Grasps
from dexzoo.sim import Outcomes, Scene, trial
from dexzoo.sim.execution import Variation

WRIST_ERROR, TURN_ERROR = 0.001, 0.01
"""Standard deviations of the drawn wrist error: meters along and radians about each axis."""
MASS_FACTOR, FRICTION = (0.8, 1.2), (0.5, 1.0)
"""Bounds of the drawn mass, over that of the object, and of the drawn friction (thesis, section 3.5.1)."""


def verify(grasps: Grasps, scene: Scene, seed: int = 0, trials: int = 1, num_threads: int = 0) -> Outcomes:
    """Execute each grasp on the scene in MuJoCo: close, lift 1 m, hold 2 s.

    Args:
        grasps: Grasps in the world frame of the scene.
        scene: The scene.
        seed: Seed of the draws of repeated trials.
        trials: 1 executes each grasp as it is. More repeat it under a mass within 20 %, a friction from U[0.5, 1] and a
            wrist error, drawn anew for each grasp and trial: `success_rate` is then the share that holds, and the other
            fields are those of the first trial.
        num_threads: Threads of the simulator; 0 uses all cores. The outcomes do not depend on it.

    Returns:
        The outcome of each grasp.

    Raises:
        ValueError: Joints are outside their limits, or there is no trial.
    """
    if trials < 1:
        raise ValueError(f"trials is {trials}, expected at least 1")
    grasps.hand.check(grasps.joints)
    if trials == 1:
        return trial.run(scene, grasps, num_threads)
    rng = np.random.default_rng(seed)
    count = len(grasps)
    repeated = _displaced(grasps[np.tile(np.arange(count), trials)], rng)
    drawn = Variation(
        scene.object.mass * rng.uniform(*MASS_FACTOR, len(repeated)), rng.uniform(*FRICTION, len(repeated))
    )
    outcomes = trial.run(scene, repeated, num_threads, variation=drawn)
    rate = outcomes.success.reshape(trials, count).mean(0, dtype=np.float32)
    return replace(outcomes[:count], success_rate=rate)


def _displaced(grasps: Grasps, rng: np.random.Generator) -> Grasps:
    """The same paths executed by an arm that stands slightly off."""
    n = len(grasps)
    shift = torch.tensor(rng.normal(0, WRIST_ERROR, (n, 1, 3)), dtype=torch.float32)
    turn = rotation.exp(torch.tensor(rng.normal(0, TURN_ERROR, (n, 1, 3)), dtype=torch.float32))
    quaternion = rotation.normalize(rotation.multiply(grasps.quaternion, turn))
    return replace(grasps, wrist=torch.cat((grasps.position + shift, quaternion), -1), log_likelihood=None)

"""Grasps and a scene in, outcomes out: the simulator's verdict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from dexzoo import rotation
from dexzoo.grasp import POSITION, QUATERNION, Grasps
from dexzoo.hand import default_hand
from dexzoo.sim import Outcomes, Scene, trial
from dexzoo.sim.execution import Variation

WRIST_ERROR, TURN_ERROR = 0.001, 0.01
"""Standard deviations of the drawn wrist error: metres along and radians about each axis."""
MASS_FACTOR, FRICTION = (0.8, 1.2), (0.5, 1.0)
"""Bounds of the drawn mass, over that of the object, and of the drawn friction (thesis, section 3.5.1)."""


def verify(grasps: Grasps, scene: Scene, seed: int = 0, trials: int = 1, num_threads: int = 0) -> Outcomes:
    """Execute each grasp on the scene in MuJoCo: close, lift 1 m, hold 2 s.

    grasps: in the world frame, or in the camera frame of the scene's latest observation.
    trials: 1 executes each grasp as it is. More repeat it under a mass within 20 %, a friction from U[0.5, 1] and a
    wrist error, drawn anew by `seed` for each grasp and trial: `success_rate` is then the share that holds, and the
    other fields are those of the first trial.
    num_threads: 0 uses all cores; the outcomes do not depend on it.
    Raises ValueError for joints outside their limits, or grasps in the camera frame of a scene not yet observed.
    """
    if trials < 1:
        raise ValueError(f"trials is {trials}, expected at least 1")
    hand = default_hand()
    hand.check(grasps.joints)
    if grasps.frame == "camera":
        if scene.T_world_camera is None:
            raise ValueError(
                "the grasps are in the camera frame, but the scene has not been observed; use to_frame first"
            )
        grasps = grasps.to_frame("world", scene.T_world_camera)
    if trials == 1:
        return trial.run(scene, grasps, hand, num_threads)
    rng = np.random.default_rng(seed)
    count = len(grasps)
    repeated = _displaced(grasps[np.tile(np.arange(count), trials)], rng)
    drawn = Variation(
        scene.object.mass * rng.uniform(*MASS_FACTOR, len(repeated)), rng.uniform(*FRICTION, len(repeated))
    )
    outcomes = trial.run(scene, repeated, hand, num_threads, variation=drawn)
    rate = outcomes.success.reshape(trials, count).mean(0, dtype=np.float32)
    return replace(outcomes[:count], success_rate=rate)


def _displaced(grasps: Grasps, rng: np.random.Generator) -> Grasps:
    """The same paths executed by an arm that stands slightly off."""
    n = len(grasps)
    shift = torch.tensor(rng.normal(0, WRIST_ERROR, (n, 1, 3)), dtype=torch.float32)
    turn = rotation.exp(torch.tensor(rng.normal(0, TURN_ERROR, (n, 1, 3)), dtype=torch.float32))
    quaternion = rotation.normalize(rotation.multiply(grasps.quaternion, turn))
    waypoints = grasps.waypoints.clone()
    waypoints[..., POSITION] += shift
    waypoints[..., QUATERNION] = quaternion
    return Grasps(waypoints, "world")

"""The protocol of a trial: when and how far the hand approaches, closes, squeezes, lifts and holds."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from dexzoo import rotation
from dexzoo.grasp import GRIP, PREGRASP, SQUEEZE, Grasps

APPROACH_DISTANCE = 0.05
"""Meters along the palm's normal from where the hand starts to the pre-grasp."""
LIFT_HEIGHT = 1.0
"""Meters that the hand is lifted."""
APPROACH_TIME, CLOSE_TIME, SQUEEZE_TIME, PAUSE_TIME, LIFT_TIME, HOLD_TIME = 0.2, 0.9, 0.4, 0.1, 2.0, 2.0
"""Seconds: to the pre-grasp, to the grip, to the squeeze, before the lift, of the lift, held up there."""
LIFT_START = APPROACH_TIME + CLOSE_TIME + SQUEEZE_TIME + PAUSE_TIME
END = LIFT_START + LIFT_TIME + HOLD_TIME
Array = NDArray[np.float64]


class Motion:
    """The motion of many grasps in the world frame, at any time.

    Args:
        grasps: The grasps.
    """

    def __init__(self, grasps: Grasps) -> None:
        motion = grasps.trajectory.detach().to(torch.float64)
        position, quaternion, joints = motion.position, motion.quaternion, motion.joints
        # the hand comes straight along its palm's normal, but never from below the table
        back = rotation.rotate(quaternion[:, PREGRASP], position.new_tensor([-APPROACH_DISTANCE, 0, 0]))
        back[:, 2] = back[:, 2].clamp_min(0)
        self._position = torch.cat((position[:, :1] + back[:, None], position), 1)
        self._quaternion = torch.cat((quaternion[:, :1], quaternion), 1)
        self._joints = grasps.hand.clamp(torch.cat((joints[:, :1], joints), 1))
        steps = [APPROACH_TIME] + [CLOSE_TIME / GRIP] * GRIP + [SQUEEZE_TIME / (SQUEEZE - GRIP)] * (SQUEEZE - GRIP)
        self._times = np.concatenate(([0], np.cumsum(steps)))

    def at(self, times: Array, ids: NDArray[np.int64]) -> tuple[Array, Array, Array]:
        """Commands at some times.

        Args:
            times: Seconds since the start, (t,).
            ids: Grasps, by their place, (n,).

        Returns:
            Wrist positions (n, t, 3), wrist quaternions (n, t, 4) and joint targets (n, t, joint).
        """
        wrist, turn, angles = self._interpolate(np.interp(times, self._times, np.arange(len(self._times))), ids)
        rise = np.clip((times - LIFT_START) / LIFT_TIME, 0, 1)
        wrist[..., 2] += torch.tensor(LIFT_HEIGHT * rise**2 * (3 - 2 * rise))
        return wrist.numpy(), turn.numpy(), angles.numpy()

    def closing(self, steps: int = 4) -> tuple[Array, Array, Array]:
        """Commands of all grasps before and during the closing.

        Args:
            steps: Times between two waypoints.

        Returns:
            As `at`: at the approach, and then up to the grip.
        """
        keys = np.concatenate(([0.0], np.arange(GRIP * steps + 1) / steps + 1))  # 0 is the approach
        wrist, turn, angles = self._interpolate(keys, np.arange(len(self._position)))
        return wrist.numpy(), turn.numpy(), angles.numpy()

    def _interpolate(self, keys: Array, ids: NDArray[np.int64]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """The path at fractional indices of its eleven points."""
        index = np.minimum(keys.astype(np.int64), self._position.shape[1] - 2)
        t = torch.tensor(keys - index)
        wrist, angles = (
            torch.lerp(part[ids][:, index], part[ids][:, index + 1], t[:, None])
            for part in (self._position, self._joints)
        )
        quaternion = self._quaternion[ids]
        turn = rotation.slerp(quaternion[:, index], quaternion[:, index + 1], t.expand(len(ids), -1))
        return wrist, turn, angles

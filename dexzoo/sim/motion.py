"""What the arm and the fingers are told in a trial: approach, close, squeeze, lift one metre, hold for two seconds."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from dexzoo import rotation
from dexzoo.grasp import GRIP, JOINTS, POSITION, PREGRASP, QUATERNION, SQUEEZE, Grasps
from dexzoo.hand import Hand

APPROACH_DISTANCE = 0.05
APPROACH, CLOSE, SQUEEZE_TIME, PAUSE, LIFT, HOLD = 0.2, 0.9, 0.4, 0.1, 2.0, 2.0
"""Seconds: to the pre-grasp, to the grip, to the squeeze, before the lift, up one metre, held there."""
LIFT_START = APPROACH + CLOSE + SQUEEZE_TIME + PAUSE
END = LIFT_START + LIFT + HOLD
LIFT_HEIGHT = 1.0
Array = NDArray[np.float64]


class Motion:
    """The motion of many grasps in the world frame, to be asked for any times."""

    def __init__(self, grasps: Grasps, hand: Hand) -> None:
        waypoints = grasps.waypoints.detach().double()
        position, quaternion, joints = (waypoints[..., part] for part in (POSITION, QUATERNION, JOINTS))
        # the hand comes straight along its palm's normal, but never from below the table
        back = rotation.rotate(quaternion[:, PREGRASP], position.new_tensor([-APPROACH_DISTANCE, 0, 0]))
        back[:, 2] = back[:, 2].clamp_min(0)
        self._position = torch.cat((position[:, :1] + back[:, None], position), 1)
        self._quaternion = torch.cat((quaternion[:, :1], quaternion), 1)
        self._joints = hand.clamp(torch.cat((joints[:, :1], joints), 1))
        steps = [APPROACH] + [CLOSE / GRIP] * GRIP + [SQUEEZE_TIME / (SQUEEZE - GRIP)] * (SQUEEZE - GRIP)
        self._times = np.concatenate(([0], np.cumsum(steps)))

    def at(self, times: Array, ids: NDArray[np.int64]) -> tuple[Array, Array, Array]:
        """Commands of the grasps `ids` at times (t,) since the start.

        Returns wrist positions (n, t, 3), wrist quaternions (n, t, 4) and joint targets (n, t, 20).
        """
        wrist, turn, angles = self._interpolate(np.interp(times, self._times, np.arange(len(self._times))), ids)
        rise = np.clip((times - LIFT_START) / LIFT, 0, 1)
        wrist[..., 2] += torch.tensor(LIFT_HEIGHT * rise**2 * (3 - 2 * rise))
        return wrist.numpy(), turn.numpy(), angles.numpy()

    def closing(self, steps: int = 4) -> tuple[Array, Array, Array]:
        """All grasps at the approach, and then `steps` times between two waypoints up to the grip; as `at`."""
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

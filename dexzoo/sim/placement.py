"""Placement of an object in a scene: its orientation, its support, and its drop."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from dexzoo.sim.objects import ObjectModel
from dexzoo.sim.world import WORKING, Support, make_world

TRIES = 3
MAX_SIZE = 0.5
"""Largest extent in meters of an object in a scene; a camera 0.4 m away still sees most of it."""
FINGER_CLEARANCE = 0.022
"""Clearance of a supported object from the table in meters: a finger's thickness."""
LONG = ("fork", "knife", "scissors", "spatula", "spoon")
"""Categories of long flat things; they lie on a block of 70 % of their width and up to 40 % of their length."""
LONG_HEIGHT = 0.055
"""Meters of that block's height, so high since a spoon or a spatula lies on it with one end down."""
WIDE = ("dustpan", "pan", "plate")
"""Categories whose rim would lie too low for fingers; they lie on a square block of half their smaller extent."""
WIDE_HEIGHT = 0.04
DROP = 0.005
SETTLE_TIME = 4.0
_STILL, _STILL_TIME = 0.01, 0.1  # m/s and rad/s, and for how many seconds together
_PUSH = 0.1  # rad/s, so that a ball does not come to rest on an edge of its mesh
_AIR = 5.0  # 1/s, by which velocities decay: without it a ball would roll for ever
_STAYS = 5e-4  # m, or half radians, over the last quarter of the time


def place(obj: ObjectModel, seed: int) -> tuple[NDArray[np.float64], Support | None]:
    """Drop an object and let it settle.

    The yaw is random. Funnels, and cups in half of the scenes, start in any orientation (the simulator behind the
    thesis). The lowest point starts 5 mm above the table or the block, the center of mass over the origin.

    Args:
        obj: The object.
        seed: Seed of its orientation.

    Returns:
        Its pose T_world_object (4, 4), and the block that it lies on, if any.

    Raises:
        ValueError: The object is too large, or does not come to rest near the origin in three tries.
    """
    if obj.mesh.extents.max() > MAX_SIZE:
        raise ValueError(
            f"object {obj.name} is {obj.mesh.extents.max():.2f} m large, too large to place; a scene holds "
            f"{MAX_SIZE:g} m, so scale it down"
        )
    rng = np.random.default_rng(seed)
    tumbled = obj.category == "funnel" or (obj.category == "cup" and rng.random() < 0.5)
    support = support_for(obj)
    for _ in range(TRIES):
        yaw = rng.uniform(0, 2 * np.pi)
        quaternion = rng.normal(size=4) if tumbled else np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])
        if support is not None:
            support = replace(support, yaw=yaw)
        pose = _settle(obj, support, quaternion / np.linalg.norm(quaternion))
        if pose is not None:
            return pose, support
    place = "the table" if support is None else "its support"
    raise ValueError(
        f"object {obj.name} does not come to rest on {place} in {TRIES} tries; check its mesh, convex parts and size"
    )


def support_for(obj: ObjectModel) -> Support | None:
    """The block that objects of this category lie on, narrower than they are, so that fingers get under them.

    Args:
        obj: The object.

    Returns:
        The block; None for an object that lies on the table.
    """
    extents = obj.mesh.extents[:2]
    if obj.category in LONG:
        axis = int(extents.argmax())
        # the block stands below the center of mass, from where one end may be near
        reach = np.abs(obj.mesh.bounds[:, axis] - obj.inertia[0][axis]).min()
        half = 0.35 * extents
        half[axis] = max(min(0.2 * extents[axis], reach - FINGER_CLEARANCE), 0.01)
        return Support((float(half[0]), float(half[1]), LONG_HEIGHT / 2), 0.0)
    if obj.category in WIDE:
        side = float(extents.min()) / 4
        return Support((side, side, WIDE_HEIGHT / 2), 0.0)
    return None


def _settle(obj: ObjectModel, support: Support | None, quaternion: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """The pose in which a dropped object lies still, or None if it does not, or not where it should."""
    model = make_world(obj, WORKING, support).compile()
    data = mujoco.MjData(model)
    flat = np.zeros(9)
    mujoco.mju_quat2Mat(flat, quaternion)
    turn = flat.reshape(3, 3)
    top = 0.0 if support is None else 2 * support.half[2]
    data.qpos[:2] = -(turn @ obj.inertia[0])[:2]
    data.qpos[2] = top + DROP - _lowest(obj, turn)
    data.qpos[3:] = quaternion
    data.qvel[3:5] = _PUSH
    still_since = 0.0
    late = data.qpos.copy()
    while data.time < SETTLE_TIME and data.time - still_since < _STILL_TIME:
        mujoco.mj_step(model, data)
        data.qvel[:] *= 1 - _AIR * WORKING.timestep
        if np.abs(data.qvel).max() > _STILL:
            still_since = data.time
        if data.time < 0.75 * SETTLE_TIME:
            late = data.qpos.copy()
    # an object on three points may tremble for ever without moving
    stays = data.time < SETTLE_TIME or np.abs(data.qpos - late).max() < _STAYS
    body = data.body("object")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = body.xmat.reshape(3, 3), body.xpos
    supported = support is None or pose[2, 3] + _lowest(obj, pose[:3, :3]) > FINGER_CLEARANCE
    return pose if stays and supported and np.linalg.norm(body.xipos[:2]) < 0.1 else None


def _lowest(obj: ObjectModel, turn: NDArray[np.float64]) -> float:
    """Height in m of the turned object's lowest point over its own origin."""
    return float((obj.mesh.vertices @ turn[2]).min())

"""The physics of a scene: how it is simulated, and the table and the object as MuJoCo sees them."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import trimesh
from numpy.typing import NDArray

from dexzoo.sim.objects import Mesh, ObjectModel
from dexzoo.sim.robot import HAND, OBJECT, TABLE, to_quaternion


@dataclass(frozen=True)
class Physics:
    """How finely a trial is simulated.

    As the hand closes things slide and collide, which needs small steps; an object that hangs in the hand hardly moves,
    but is held long enough to creep.

    Attributes:
        timestep: Seconds of a step until the lift begins.
        noslip_iterations: Sweeps that take the creep out of friction until the lift begins.
        carry_timestep: Seconds of a step from then on.
        carry_noslip_iterations: Sweeps from then on.
        stops_early: Whether a trial ends once its object is lost.
    """

    timestep: float = 0.002
    noslip_iterations: int = 0
    carry_timestep: float = 0.004
    carry_noslip_iterations: int = 10
    stops_early: bool = True


WORKING = Physics()
"""The setting of all labels."""
REFERENCE = Physics(0.001, 5, 0.001, 5, stops_early=False)
"""The setting that labels are compared with."""


@dataclass(frozen=True)
class Support:
    """A block fixed to the table in its middle, which an object lies on so that fingers get under it.

    It stands on z = 0 over the world's origin.

    Attributes:
        half: Half sizes in meters.
        yaw: Angle about the vertical in radians.
    """

    half: tuple[float, float, float]
    yaw: float

    @property
    def pose(self) -> NDArray[np.float64]:
        """T_world_support (4, 4), of the block's center."""
        pose = np.eye(4)
        pose[:2, :2] = [[np.cos(self.yaw), -np.sin(self.yaw)], [np.sin(self.yaw), np.cos(self.yaw)]]
        pose[2, 3] = self.half[2]
        return pose

    @property
    def mesh(self) -> Mesh:
        """Its surface in the world frame."""
        box: Mesh = trimesh.creation.box(2 * np.array(self.half), self.pose)
        return box


def make_world(obj: ObjectModel, physics: Physics, support: Support | None = None) -> mujoco.MjSpec:
    """Table, support and object. The object's friction acts on all its contacts, since its geoms have priority.

    Args:
        obj: The object.
        physics: How finely the world is simulated.
        support: Block that the object lies on, if any.
    """
    world = mujoco.MjSpec()
    world.compiler.degree = False
    option = world.option
    option.timestep = physics.timestep
    option.noslip_iterations = physics.noslip_iterations
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 100  # friction that is soft lets the object creep out of the hand
    option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE  # a fifth faster than dense here, the same physics
    world.worldbody.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[2, 2, 0.1],
        contype=TABLE,
        conaffinity=HAND | OBJECT,
        friction=[0.5, 0.005, 0.0001],
    )
    if support is not None:
        world.worldbody.add_geom(
            name="support",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=support.half,
            pos=support.pose[:3, 3],
            quat=to_quaternion(support.pose[:3, :3]),
            contype=TABLE,
            conaffinity=HAND | OBJECT,
            condim=4,
            friction=[0.5, 0.005, 0.0001],
        )
    center, inertia = obj.inertia
    body = world.worldbody.add_body(name="object", mass=obj.mass, ipos=center, explicitinertial=True)
    body.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    body.add_freejoint(name="object")
    for index, hull in enumerate(obj.hulls):
        world.add_mesh(
            name=f"hull_{index}",
            uservert=hull.vertices.astype(np.float32).ravel(),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX,
        )
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=f"hull_{index}",
            contype=OBJECT,
            conaffinity=HAND | TABLE,
            priority=1,
            condim=4,
            friction=[obj.friction, 0.005 * obj.friction, 0.0001 * obj.friction],
            solref=[0.01, 1],
            solimp=[0.95, 0.99, 0.001, 0.5, 2],
            mass=0,
        )
    return world

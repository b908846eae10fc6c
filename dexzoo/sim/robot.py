"""The hand in MuJoCo, made from the same tables as the differentiable hand."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from dexzoo.hand import HandSpec, Primitive

FULL_EFFORT_ANGLE = 0.5
"""Radians past contact at which a finger presses with its whole effort: the gain of its servo is effort over this."""
ARMATURE = 0.002
HAND, OBJECT, TABLE = 1, 2, 4
"""Collision bits."""


def add_hand(world: mujoco.MjSpec, hand: HandSpec) -> None:
    """Add the hand with a free wrist, welded to the mocap body `wrist_target`, and a position servo on each joint.

    Bodies, joints and actuators bear the names of the URDF's links and joints. The coupled distal joints follow by an
    equality constraint and have a servo of their own, whose target is the coupled angle: one motor whose torque acts on
    both through the steel coupling. The hand's weight is carried by the arm (gravity compensation).

    Args:
        world: The world that it is added to.
        hand: Tables of the hand.

    Raises:
        ValueError: The URDF lacks masses or efforts, which the differentiable hand does without.
    """
    _check(hand)
    target = world.worldbody.add_body(name="wrist_target", mocap=True)
    palm = world.worldbody.add_body(name=hand.palm)
    palm.add_freejoint(name="wrist")
    bodies = {hand.palm: palm}
    for joint in hand.joints:
        body = bodies[joint.parent].add_body(
            name=joint.child, pos=joint.origin[:3, 3], quat=to_quaternion(joint.origin[:3, :3])
        )
        bodies[joint.child] = body
        if joint.axis is None:
            continue
        body.add_joint(
            name=joint.name,
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=joint.axis,
            limited=True,
            range=[joint.lower, joint.upper],
            damping=float(joint.damping),
            armature=ARMATURE,
        )
        servo = world.add_actuator(
            name=joint.name,
            target=joint.name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            forcelimited=True,
            forcerange=[-joint.effort, joint.effort],
        )
        servo.set_to_position(kp=joint.effort / FULL_EFFORT_ANGLE, dampratio=1.0)
        if joint.mimic is not None:
            world.add_equality(
                type=mujoco.mjtEq.mjEQ_JOINT,
                name1=joint.name,
                name2=joint.mimic,
                data=[joint.offset, joint.multiplier] + [0] * 10,
                solref=[0.01, 1],
            )
    for name, body in bodies.items():
        body.gravcomp = 1
        if name in hand.inertias:
            inertia = hand.inertias[name]
            body.mass, body.ipos, body.explicitinertial = inertia.mass, inertia.center, True
            body.fullinertia = inertia.matrix[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    for primitive in hand.primitives:
        _add_primitive(bodies[primitive.link], primitive)
    for first, second in hand.exclude:
        world.add_exclude(bodyname1=first, bodyname2=second)
    world.add_equality(
        type=mujoco.mjtEq.mjEQ_WELD,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        name1=target.name,
        name2=palm.name,
        data=[0] * 6 + [1, 0, 0, 0] + [1, 0],  # anchor, relative pose, torque scale
        solref=[0.01, 1],
        solimp=[0.95, 0.99, 0.001, 0.5, 2],
    )


def _check(hand: HandSpec) -> None:
    heavy = {hand.fixed_to[link] for link, inertia in hand.inertias.items() if inertia.mass > 0}
    for link in hand.link_names:
        if hand.fixed_to[link] not in heavy:
            raise ValueError(f"link {link} of hand {hand.name} moves without a mass; give it an <inertial> in the URDF")
    for joint in hand.joints:
        if joint.axis is not None and joint.effort <= 0:
            raise ValueError(f"joint {joint.name} of hand {hand.name} has no effort; give its <limit> one in the URDF")


def _add_primitive(body: mujoco.MjsBody, primitive: Primitive) -> None:
    turn = primitive.pose[:3, :3]
    if primitive.is_capsule:  # MuJoCo's capsules lie along z, ours along x
        turn = turn @ np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE if primitive.is_capsule else mujoco.mjtGeom.mjGEOM_BOX,
        size=[primitive.radius, primitive.half[0], 0] if primitive.is_capsule else primitive.half,
        pos=primitive.pose[:3, 3],
        quat=to_quaternion(turn),
        contype=HAND,
        conaffinity=HAND | OBJECT | TABLE,
        condim=4,
        friction=[0.5, 0.005, 0.0001],
        mass=0,
        rgba=[0.75, 0.75, 0.8, 1],
    )


def to_quaternion(turn: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quaternion wxyz of a rotation matrix, as MuJoCo computes it.

    Args:
        turn: Rotation matrix, (3, 3).
    """
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, turn.reshape(-1))
    return quaternion

"""The simulator against mechanics that can be written down: friction cones, creep, rest."""

import mujoco
import numpy as np
import pytest
import trimesh

from dexzoo.sim import ObjectModel
from dexzoo.sim.robot import HAND, OBJECT
from dexzoo.sim.world import WORKING, Physics, make_world

GRAVITY = 9.81
EDGE = 0.05
CLOSING = Physics(WORKING.timestep, WORKING.noslip_iterations)
CARRYING = Physics(WORKING.carry_timestep, WORKING.carry_noslip_iterations)


def between_plates(
    mass: float, friction: float, force: float, physics: Physics
) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """A cube held in the air by two plates that are pushed together, each by `force` newtons."""
    cube = trimesh.creation.box([EDGE] * 3)
    world = make_world(ObjectModel("cube", cube, (cube,), mass, friction), physics)
    for name, side in (("left", -1), ("right", 1)):
        plate = world.worldbody.add_body(name=name, pos=[side * (EDGE / 2 + 0.005), 0, 0.5])
        plate.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[-side, 0, 0])
        plate.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[0.005, 0.04, 0.04],
            mass=0.2,
            contype=HAND,
            conaffinity=OBJECT,
            condim=4,
        )
        world.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    model = world.compile()
    data = mujoco.MjData(model)
    data.qpos[2] = 0.5
    data.ctrl[:] = force
    return model, data


def fall(mass: float, friction: float, force: float, seconds: float, physics: Physics) -> float:
    """Meters that the cube sinks between the plates, after a tenth of a second for the contacts to build up."""
    model, data = between_plates(mass, friction, force, physics)
    mujoco.mj_step(model, data, round(0.1 / physics.timestep))
    start = data.qpos[2]
    mujoco.mj_step(model, data, round(seconds / physics.timestep))
    return float(start - data.qpos[2])


@pytest.mark.parametrize("physics", [CLOSING, CARRYING])
@pytest.mark.parametrize(("mass", "friction"), [(0.05, 0.6), (0.1, 0.5), (0.3, 0.7), (0.5, 1.0), (0.8, 0.5)])
def test_plates_hold_exactly_when_friction_bears_the_weight(mass: float, friction: float, physics: Physics) -> None:
    needed = mass * GRAVITY / (2 * friction)
    assert fall(mass, friction, 1.05 * needed, 1.0, physics) < 0.002
    assert fall(mass, friction, 0.95 * needed, 1.0, physics) > 0.02


@pytest.mark.parametrize("physics", [CLOSING, CARRYING])
@pytest.mark.parametrize(("mass", "friction"), [(0.05, 0.5), (0.3, 0.7), (0.8, 0.5)])
def test_what_is_held_does_not_creep(mass: float, friction: float, physics: Physics) -> None:
    needed = mass * GRAVITY / (2 * friction)
    assert fall(mass, friction, 1.2 * needed, 10.0, physics) < 0.002


@pytest.mark.parametrize("physics", [CLOSING, CARRYING])
def test_without_gravity_nothing_moves(physics: Physics) -> None:
    model, data = between_plates(0.3, 0.7, 0.0, physics)
    model.opt.gravity[:] = 0
    start = data.qpos.copy()
    mujoco.mj_step(model, data, round(1.0 / physics.timestep))
    assert np.abs(data.qpos - start).max() < 1e-6

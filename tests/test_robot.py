"""The hand in MuJoCo under load: what its servos, couplings and wrist do. Its tables are tested with the scene."""

import mujoco
import numpy as np
import pytest
import torch

from dexzoo import rotation
from dexzoo.hand import Hand, Side
from dexzoo.sim.robot import FULL_EFFORT_ANGLE, add_hand

Twin = tuple[Hand, mujoco.MjModel, mujoco.MjData]


def make_twin(side: Side) -> Twin:
    """The hand alone in space, with weight."""
    hand = Hand.load("dlr2", side)
    world = mujoco.MjSpec()
    world.compiler.degree = False
    world.option.timestep = 0.004
    world.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    add_hand(world, hand.spec)
    model = world.compile()
    return hand, model, mujoco.MjData(model)


@pytest.fixture(params=["right", "left"])
def twin(request: pytest.FixtureRequest) -> Twin:
    return make_twin(request.param)


def angles(twin: Twin) -> torch.Tensor:
    hand, model, data = twin
    return torch.tensor([data.qpos[model.joint(name).qposadr[0]] for name in hand.joint_names])


def command(twin: Twin, q20: torch.Tensor) -> None:
    hand, model, data = twin
    data.ctrl[[model.actuator(name).id for name in hand.joint_names]] = q20.numpy()


def step(twin: Twin, num: int) -> None:
    for _ in range(num):
        mujoco.mj_step(twin[1], twin[2])


def free_posture(hand: Hand, seed: int) -> torch.Tensor:
    return hand.random(1, torch.Generator().manual_seed(seed))[0].double()


def test_the_hand_does_not_sag_however_it_is_turned(twin: Twin) -> None:
    hand, model, data = twin
    q = free_posture(hand, 0)
    turn = rotation.random(1, torch.Generator().manual_seed(1))[0].numpy()
    at = model.joint("wrist").qposadr[0]
    data.qpos[at + 3 : at + 7] = data.mocap_quat[0] = turn
    data.qpos[[model.joint(name).qposadr[0] for name in hand.joint_names]] = q
    command(twin, q)
    step(twin, 250)
    torch.testing.assert_close(angles(twin), q, atol=1e-4, rtol=0)
    np.testing.assert_allclose(data.body("palm").xpos, 0, atol=1e-4)


def test_the_wrist_follows_its_target(twin: Twin) -> None:
    _, _, data = twin
    axis = torch.tensor([0.6, 0.0, 0.8])
    for share in np.linspace(0, 1, 250):  # 0.3 m and 90 degrees in a second
        data.mocap_pos[0] = [0, 0, 0.3 * share]
        data.mocap_quat[0] = rotation.from_axis_angle(axis, torch.tensor(share * np.pi / 2).float())
        step(twin, 1)
    step(twin, 100)
    np.testing.assert_allclose(data.body("palm").xpos, [0, 0, 0.3], atol=1e-3)
    turned = torch.tensor(data.body("palm").xquat).float()
    assert rotation.angle(turned, torch.tensor(data.mocap_quat[0]).float()) < 0.01


def test_couplings_hold_when_a_fingertip_is_pushed(twin: Twin) -> None:
    hand, model, data = twin
    q = hand.expand(torch.full((15,), 0.3, dtype=torch.float64) * torch.tensor([0.0, 1, 1] * 5))
    command(twin, q)
    step(twin, 200)
    for finger in ("index", "little"):
        data.xfrc_applied[model.body(f"{finger}_distal").id, :3] = [-4, 0, 0]  # newtons, against flexion
    for _ in range(200):
        step(twin, 1)
        now = angles(twin)
        assert (now[3::4] - now[2::4]).abs().max() < 0.03
    assert (q - angles(twin))[[6, 18]].min() > 0.05  # the push is felt


def test_a_servo_gives_its_effort_and_no_more() -> None:
    twin = hand, model, data = make_twin("right")
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    command(twin, hand.upper.double())
    for _ in range(200):
        step(twin, 1)
        for joint in hand.spec.joints:
            if joint.axis is not None:
                assert abs(data.actuator(joint.name).force[0]) <= joint.effort + 1e-9
    # where the joint is held, the servo presses with its whole effort as far as FULL_EFFORT_ANGLE past it
    mujoco.mj_resetData(model, data)
    command(twin, torch.full((20,), FULL_EFFORT_ANGLE / 2, dtype=torch.float64))
    mujoco.mj_forward(model, data)
    for joint in hand.spec.joints:
        if joint.axis is not None:
            assert data.actuator(joint.name).force[0] == pytest.approx(joint.effort / 2)


def test_the_left_twin_weighs_on_the_other_side() -> None:
    centers = []
    for side in ("right", "left"):
        hand, model, data = make_twin(side)
        q = free_posture(Hand.load("dlr2"), 3)
        if side == "left":
            q[0::4] *= -1
        data.qpos[[model.joint(name).qposadr[0] for name in hand.joint_names]] = q
        mujoco.mj_forward(model, data)
        assert model.body_mass.sum() == pytest.approx(1.5)
        centers.append(data.subtree_com[model.body("palm").id].copy())
    np.testing.assert_allclose(centers[1], centers[0] * [1, -1, 1], atol=1e-8)
    assert abs(centers[0][1]) > 1e-3

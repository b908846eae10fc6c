"""The trial: what counts as success, and that it counts alike however it is run."""

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dexzoo import rotation
from dexzoo.grasp import Grasps
from dexzoo.hand import Hand
from dexzoo.perception import Observation
from dexzoo.perception.camera import look_at
from dexzoo.sim import Outcomes, Scene, trial
from dexzoo.sim.protocol import END, LIFT_START, Motion
from dexzoo.sim.world import REFERENCE, WORKING, Support
from dexzoo.verification import verify


@pytest.fixture(scope="module")
def some(can_outcomes: Outcomes) -> np.ndarray:
    """Indices of a dozen grasps, half of which hold."""
    held, failed = np.flatnonzero(can_outcomes.success), np.flatnonzero(~can_outcomes.success)
    return np.sort(np.concatenate((held[:6], failed[:6])))


@pytest.fixture(scope="module")
def good(can_grasps: Grasps, can_outcomes: Outcomes) -> Grasps:
    return can_grasps[np.flatnonzero(can_outcomes.success)]


def moved(grasps: Grasps, offset: list[float], waypoints: slice = slice(None)) -> Grasps:
    """The same grasps, displaced at all or some of their waypoints."""
    wrist = grasps.wrist.clone()
    wrist[:, waypoints, :3] += torch.tensor(offset)
    return replace(grasps, wrist=wrist)


def assert_equal(first: Outcomes, second: Outcomes) -> None:
    for field in fields(Outcomes):
        np.testing.assert_array_equal(getattr(first, field.name), getattr(second, field.name), err_msg=field.name)


# what is success


def test_some_grasps_hold_and_some_do_not(can_outcomes: Outcomes) -> None:
    assert 5 <= can_outcomes.success.sum() <= 40
    assert not (can_outcomes.success & can_outcomes.collided).any()
    assert not can_outcomes.unstable.any()
    lost = np.isfinite(can_outcomes.lost_at)
    np.testing.assert_array_equal(can_outcomes.success, ~lost & ~can_outcomes.collided & ~can_outcomes.unstable)
    for motion in (can_outcomes.shift, can_outcomes.rotation):
        np.testing.assert_array_equal(np.isfinite(motion), can_outcomes.success)
        assert (motion[can_outcomes.success] >= 0).all()
    assert can_outcomes.shift[can_outcomes.success].max() < 0.1
    assert can_outcomes.lost_at[lost].max() <= trial.LIFT_TIME + trial.HOLD_TIME
    lifted = can_outcomes.success | (can_outcomes.lost_at > 0)
    assert np.isfinite(can_outcomes.closing_shift[lifted]).all()
    assert np.isfinite(can_outcomes.closing_rotation[lifted]).all()
    np.testing.assert_array_equal(can_outcomes.success_rate, can_outcomes.success)


def test_the_object_of_a_good_grasp_is_lifted_one_meter_and_held(can_scene: Scene, good: Grasps) -> None:
    times = [-0.02, trial.LIFT_TIME / 2, trial.LIFT_TIME, trial.LIFT_TIME + trial.HOLD_TIME]
    moments = trial.replay(can_scene, good[0], times)
    rest = can_scene.T_world_object[2, 3]
    heights = [moment.T_world_object[2, 3] - rest for moment in moments]
    np.testing.assert_allclose(heights, [0, 0.5, 1.0, 1.0], atol=0.05)
    wrist = [float(moment.wrist[2]) for moment in moments]
    np.testing.assert_allclose(np.diff(wrist), [0.5, 0.5, 0], atol=0.02)


def test_a_replay_tells_the_wrist_and_all_joints(can_scene: Scene, good: Grasps, hand: Hand) -> None:
    start, grip = trial.replay(can_scene, good[0], [-LIFT_START, 0.0])
    torch.testing.assert_close(start.wrist[3:], good.quaternion[0, 0].double(), atol=1e-6, rtol=0)
    torch.testing.assert_close(start.joints, good.joints[0, 0].double())
    assert (grip.joints - start.joints).abs().max() > 0.2, "the hand has closed"
    torch.testing.assert_close(grip.joints, hand.expand(hand.reduce(grip.joints)), atol=0.03, rtol=0)


def test_a_replay_ends_as_the_trial_did(can_scene: Scene, can_grasps: Grasps, can_outcomes: Outcomes) -> None:
    def shift(grasp: Grasps) -> float:
        gripped, held = (
            np.linalg.inv(rotation.pose_matrix(m.wrist[:3], m.wrist[3:]).numpy()) @ m.T_world_object
            for m in trial.replay(can_scene, grasp, [0.0, trial.LIFT_TIME + trial.HOLD_TIME])
        )
        center = np.append(can_scene.object.inertia[0], 1)
        return float(np.linalg.norm((gripped - held) @ center))

    held = np.flatnonzero(can_outcomes.success)[:2]
    for index in held:
        assert shift(can_grasps[index]) == pytest.approx(can_outcomes.shift[index], abs=1e-5)
    failed = int(np.flatnonzero(~can_outcomes.success)[0])
    assert shift(can_grasps[failed]) > 0.1


def test_the_object_does_not_creep_out_of_the_hand(can_scene: Scene, good: Grasps, hand: Hand) -> None:
    """Held for another ten seconds, at the working setting."""
    execution = trial.Execution(can_scene, good, can_scene.model(hand.spec), WORKING)
    for time in (LIFT_START, END):
        execution.advance(execution.everyone, time)
    before = execution.in_palm(execution.everyone)
    execution.advance(execution.everyone, END + 10)
    assert np.linalg.norm((execution.in_palm(execution.everyone) - before)[:, :3], axis=1).max() < 0.002


def test_the_hand_presses_hard_enough_to_bear_the_weight(can_scene: Scene, can_outcomes: Outcomes) -> None:
    held = can_outcomes.success
    np.testing.assert_array_equal(np.isfinite(can_outcomes.contact_force), held)
    weight = 9.81 * can_scene.object.mass
    needed = weight / np.hypot(1, can_scene.object.friction)  # no contact gives more than its friction cone
    assert (can_outcomes.contact_force[held] > needed).all()
    assert can_outcomes.contact_force[held].max() < 150


def test_grasps_that_miss_lose_the_object(can_scene: Scene, good: Grasps) -> None:
    outcomes = trial.run(can_scene, moved(good, [0.0, 0.0, 0.25]))
    assert not outcomes.success.any()
    assert not outcomes.collided.any()
    assert ((outcomes.lost_at > 0) & (outcomes.lost_at < trial.LIFT_TIME)).all()
    far = trial.run(can_scene, moved(good[:2], [2.0, 0.0, 0.0]))
    assert not far.success.any()
    assert np.isfinite(far.lost_at).all()


def test_a_path_into_the_table_is_not_executed(can_scene: Scene, good: Grasps) -> None:
    low = good.position[:, :7, 2].amin()
    outcomes = trial.run(can_scene, moved(good, [0.0, 0.0, -float(low) - 0.05]))
    assert outcomes.collided.all()
    assert not outcomes.success.any()
    assert np.isnan(outcomes.lost_at).all()
    assert np.isnan(outcomes.shift).all()


def collided(scene: Scene, grasps: Grasps) -> bool:
    return bool(trial.run(scene, grasps).collided.all())


def test_a_collision_between_waypoints_is_seen(can_scene: Scene, good: Grasps) -> None:
    """The path is looked at in between, and the approach before the pre-grasp as well."""
    assert not collided(can_scene, good[:1])
    assert collided(can_scene, moved(good[:1], [0.0, 0.0, -0.3], slice(3, 4)))


def test_the_squeeze_may_press_on_the_table_but_the_grip_may_not(can_scene: Scene, good: Grasps) -> None:
    squeeze = moved(good[:1], [0.0, 0.0, -0.3], slice(8, None))
    assert not collided(can_scene, squeeze)
    assert collided(can_scene, moved(squeeze, [0.0, 0.0, -0.3], slice(6, 7)))


def test_a_block_on_the_table_stands_in_the_way_as_well(can_scene: Scene, good: Grasps) -> None:
    block = replace(can_scene, support=Support((0.5, 0.5, float(good.position[:, :7, 2].amin())), 0.0))
    assert trial.run(block, good).collided.all()


def test_a_grasp_that_starts_in_the_object_is_no_plain_failure(can_scene: Scene, good: Grasps, hand: Hand) -> None:
    center = can_scene.object.inertia[0] + can_scene.T_world_object[:3, 3]
    back = trial.Execution(can_scene, good[:2], can_scene.model(hand.spec), WORKING)
    palm = torch.tensor(back.wrist(back.everyone)[:, :3]).float()
    wrist = good[:2].wrist.clone()
    wrist[:1, :, :3] += (torch.tensor(center).float() - palm[:1])[:, None]
    wrist[:1, :, 2] += 0.02  # above the table
    outcomes = trial.run(can_scene, replace(good[:2], wrist=wrist))
    assert outcomes.starts_inside.tolist() == [True, False]
    assert outcomes.success.tolist() == [False, True]
    assert np.isnan(outcomes.lost_at[0])
    assert np.isnan(outcomes.closing_shift[0])


def test_the_hand_may_touch_the_object_on_its_way(can_scene: Scene, good: Grasps) -> None:
    """That is what a grip is, and pushing it over is a failure that was tried."""
    outcomes = trial.run(can_scene, moved(good, [0.0, 0.0, 0.01]))
    assert not outcomes.starts_inside.any()


def test_a_fall_at_the_end_is_no_success(can_scene: Scene, good: Grasps, monkeypatch: pytest.MonkeyPatch) -> None:
    """The hand opens a moment before the end: the object is not yet far, but it falls."""
    commands = Motion.at

    def opening(self: Motion, times: np.ndarray, ids: np.ndarray) -> tuple[Any, Any, Any]:
        wrist, turn, angles = commands(self, times, ids)
        angles[:, times > END - 0.2] = 0.0
        return wrist, turn, angles

    monkeypatch.setattr(Motion, "at", opening)
    outcomes = trial.run(can_scene, good[:4])
    assert not outcomes.success.any()
    assert (outcomes.lost_at > trial.LIFT_TIME + trial.HOLD_TIME - 0.5).all()


def test_the_reference_setting_agrees_on_clear_cases(can_scene: Scene, good: Grasps) -> None:
    outcomes = trial.run(can_scene, good[:3], physics=REFERENCE)
    assert outcomes.success.mean() >= 2 / 3


def test_a_slippery_object_is_not_held(can_scene: Scene, good: Grasps) -> None:
    slippery = replace(can_scene, object=replace(can_scene.object, friction=0.03))
    assert trial.run(can_scene, good).success.all()
    assert trial.run(slippery, good).success.mean() < 0.2


def test_a_diverged_simulation_is_unstable_and_no_success(
    can_scene: Scene, good: Grasps, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    advance = trial.Execution.advance

    def shaken(self: trial.Execution, ids: np.ndarray, until: float) -> None:
        if self.time == 0:
            self.qpos[0, self.object_at] = np.nan  # a bad state
            self.qvel[1, self.object_dof] = 1e12  # one that MuJoCo resets with a warning
        advance(self, ids, until)

    monkeypatch.setattr(trial.Execution, "advance", shaken)
    outcomes = trial.run(can_scene, good[:4])
    assert outcomes.unstable.tolist() == [True, True, False, False]
    assert outcomes.success.tolist() == [False, False, True, True]
    assert np.isnan(outcomes.shift[:2]).all()
    assert not list(tmp_path.iterdir()), "MuJoCo's log is kept out of the working folder"


def test_a_diverged_trial_is_repeated_at_the_reference_setting(
    can_scene: Scene, good: Grasps, monkeypatch: pytest.MonkeyPatch
) -> None:
    advance = trial.Execution.advance

    def shaken(self: trial.Execution, ids: np.ndarray, until: float) -> None:
        if self.time == 0 and self.physics == WORKING:
            self.qpos[0, self.object_at] = np.nan
        advance(self, ids, until)

    alone = trial.run(can_scene, good[:1], physics=REFERENCE)
    monkeypatch.setattr(trial.Execution, "advance", shaken)
    outcomes = trial.run(can_scene, good[:2])
    assert not outcomes.unstable.any()
    assert outcomes.success[0] == alone.success[0]


# the same however it is run


@pytest.mark.parametrize(("num_threads", "batch"), [(1, 1024), (2, 1024), (2, 5), (1, 1)])
def test_outcomes_depend_neither_on_threads_nor_on_batches(
    can_scene: Scene,
    can_grasps: Grasps,
    can_outcomes: Outcomes,
    some: np.ndarray,
    num_threads: int,
    batch: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """All alike to the last bit; the fixture's fifty ran together on all cores."""
    monkeypatch.setattr(trial, "_BATCH", batch)
    assert_equal(trial.run(can_scene, can_grasps[some], num_threads), can_outcomes[some])


@pytest.mark.slow
def test_a_hundred_together_end_as_each_alone(can_scene: Scene, can_grasps: Grasps, some: np.ndarray) -> None:
    many = np.resize(some, 100)
    together = verify(can_grasps[many], can_scene)
    for i in (0, 57, 99):
        assert_equal(together[i : i + 1], verify(can_grasps[many[i : i + 1]], can_scene))


def test_a_copy_of_another_mass_and_friction_is_a_scene_of_that_object(can_scene: Scene, good: Grasps) -> None:
    mass, friction = np.array([0.1, 0.5]), np.array([0.9, 0.4])
    together = trial.run(can_scene, good[:2], variation=trial.Variation(mass, friction))
    for i in range(2):
        obj = replace(can_scene.object, mass=float(mass[i]), friction=float(friction[i]))
        alone = trial.run(replace(can_scene, object=obj), good[i : i + 1])
        assert together.success[i] == alone.success[0]
        for name in ("closing_shift", "shift", "contact_force"):
            np.testing.assert_allclose(getattr(together, name)[i], getattr(alone, name)[0], rtol=0.02)


def test_looking_from_elsewhere_in_between_changes_no_outcome(
    can_scene: Scene, can_view: Observation, can_grasps: Grasps, can_outcomes: Outcomes, some: np.ndarray
) -> None:
    """Grasps belong to the world, and not to the view that the scene was last seen in."""
    scene, few = replace(can_scene), some[::2]
    assert set(can_outcomes.success[few]) == {False, True}
    view = scene.observe(seed=1)
    np.testing.assert_array_equal(view.depth, can_view.depth, "the view that the grasps were made on")
    before = verify(can_grasps[few], scene)
    eye = view.T_world_camera[:3, 3]
    behind = look_at(scene.T_world_object[:3, 3], 0.6, np.arctan2(-eye[1], -eye[0]), 0.8)
    for other in (scene.observe(seed=2), scene.observe(T_world_camera=behind, ideal=True)):
        assert np.linalg.norm(other.T_world_camera[:3, 3] - eye) > 0.1
    assert_equal(verify(can_grasps[few], scene), before)
    assert_equal(before, can_outcomes[few])


def test_grasps_given_in_the_camera_frame_get_the_same_verdict_in_the_world(
    can_scene: Scene, can_view: Observation, can_grasps: Grasps, can_outcomes: Outcomes, some: np.ndarray
) -> None:
    T = can_view.T_world_camera
    in_camera = can_grasps[some].transformed(np.linalg.inv(T))
    outcomes = verify(in_camera.transformed(T), can_scene)
    np.testing.assert_array_equal(outcomes.success, can_outcomes.success[some])
    assert not verify(in_camera, can_scene).success.any(), "where they are not meant"


def test_no_grasps_give_no_outcomes(can_scene: Scene, hand: Hand) -> None:
    none = Grasps.none(hand)
    for outcomes in (trial.run(can_scene, none), verify(none, can_scene), verify(none, can_scene, trials=2)):
        assert len(outcomes) == 0
        assert all(getattr(outcomes, field.name).shape == (0,) for field in fields(Outcomes))


def test_repeated_trials_tell_a_rate_that_the_seed_repeats(
    can_scene: Scene, can_grasps: Grasps, some: np.ndarray
) -> None:
    friction = can_scene.object.friction
    first = verify(can_grasps[some], can_scene, seed=4, trials=3)
    np.testing.assert_allclose(first.success_rate * 3, np.round(first.success_rate * 3), atol=1e-6)
    assert len(np.unique(first.success_rate)) > 1
    assert_equal(verify(can_grasps[some], can_scene, seed=4, trials=3), first)
    assert can_scene.object.friction == friction, "the scene stays as it was"


# wrong calls


def test_wrong_calls_are_explained(can_scene: Scene, good: Grasps) -> None:
    with pytest.raises(ValueError, match="trials is 0, expected at least 1"):
        verify(good, can_scene, trials=0)
    joints = good.joints.clone()
    joints[0, 9, 1] = 3.0
    with pytest.raises(ValueError, match=r"joint thumb_mcp is at 3\.000 rad, outside its limits"):
        verify(replace(good, joints=joints), can_scene)

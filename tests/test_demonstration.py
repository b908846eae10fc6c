"""Demonstrations: authored, recorded, kept, told apart, and good enough to learn from."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from dexzoo.generators.demonstration import Demonstration, distinct, load_demonstrations, shipped_demonstrations
from dexzoo.generators.preshape import SQUEEZE_TRAVEL, close, read_preshapes, read_recording
from dexzoo.grasp import GRASP_TYPES, GRIP, PREGRASP, SQUEEZE, Grasps
from dexzoo.hand import Hand
from dexzoo.sim import Scene
from dexzoo.sim.shapes import make_object, split_of
from dexzoo.verification import verify


def test_ten_types_are_shown_on_six_training_objects(hand: Hand) -> None:
    shown = load_demonstrations(hand)
    assert sorted(one.grasp_type for one in shown) == list(range(10))
    assert len({one.object for one in shown}) == 6
    assert all(split_of(one.object) == "train" for one in shown)


def test_what_is_shipped_is_what_the_preshapes_make(hand: Hand) -> None:
    shown = {one.grasp_type: one for one in load_demonstrations(hand)}
    for preshape in read_preshapes(shipped_demonstrations(hand) / "preshapes.yaml", hand)[:3]:
        made = close(preshape, make_object(preshape.object).mesh, hand)
        grasp = shown[preshape.grasp_type].grasp
        torch.testing.assert_close(made.wrist, grasp.wrist, atol=1e-4, rtol=0)
        torch.testing.assert_close(made.joints, grasp.joints, atol=1e-4, rtol=0)
        assert torch.equal(made.grasp_type, grasp.grasp_type)


@pytest.mark.slow
@pytest.mark.parametrize("kind", GRASP_TYPES)
def test_a_demonstration_lifts_its_object(kind: str, hand: Hand) -> None:
    one = next(d for d in load_demonstrations(hand) if d.grasp_type == GRASP_TYPES.index(kind))
    scene = Scene.place(make_object(one.object), seed=0)
    outcomes = verify(one.grasp.transformed(scene.T_world_object), scene, seed=0, trials=10)
    assert outcomes.success_rate[0] >= 0.9


def test_fingers_stop_where_they_touch(hand: Hand) -> None:
    preshape = next(
        p for p in read_preshapes(shipped_demonstrations(hand) / "preshapes.yaml", hand) if p.object == "box_09"
    )
    box = make_object("box_09")
    grasp = close(preshape, box.mesh, hand)
    links = grasp.wrist_pose[0, GRIP].double() @ hand.forward_kinematics(grasp.joints[0, GRIP].double())
    points, _ = trimesh.sample.sample_surface(box.mesh, 40_000, seed=1)
    distance = hand.signed_distance(links, torch.tensor(np.array(points))).amin(-1)
    assert distance.min() > -0.004, "no deeper than one step of closing"
    thumb = [i for i, name in enumerate(hand.solid_names) if name.startswith("thumb")]
    assert distance[thumb].min() < 0.001
    came = (grasp.joints[0, SQUEEZE] - grasp.joints[0, GRIP]).abs().max()
    assert came == pytest.approx(SQUEEZE_TRAVEL, abs=1e-3)


def test_a_demonstration_comes_back_as_it_was_saved(hand: Hand, tmp_path: Path) -> None:
    one = load_demonstrations(hand)[0]
    one.save(tmp_path / "one.safetensors")
    back = Demonstration.load(tmp_path / "one.safetensors")
    assert back.object == one.object
    for name in ("wrist", "joints", "grasp_type"):
        assert torch.equal(getattr(back.grasp, name), getattr(one.grasp, name))
    for name in ("points", "quaternion", "curvature"):
        assert torch.equal(getattr(back.surface, name), getattr(one.surface, name))
    assert back.grasp.hand == hand


def test_a_demonstration_of_another_hand_is_refused(hand: Hand, tmp_path: Path) -> None:
    left, one = Hand.load(side="left"), load_demonstrations(hand)[0]
    Demonstration(one.object, Grasps.of(one.grasp.trajectory, left), one.surface).save(tmp_path / "one.safetensors")
    assert load_demonstrations(left, str(tmp_path))[0].grasp.hand is left
    with pytest.raises(ValueError, match=r"one.safetensors: .* the hand dlr2 \(left\), not of dlr2 \(right\)"):
        load_demonstrations(hand, str(tmp_path))


def test_near_equal_demonstrations_are_merged(hand: Hand) -> None:
    first, second = load_demonstrations(hand)[:2]
    assert distinct([first, second, first], max_per_type=5) == [first, second]
    assert distinct([first, second], max_per_type=0) == []


def test_a_grasp_beside_the_object_is_no_demonstration(hand: Hand) -> None:
    one = load_demonstrations(hand)[0]
    away = np.eye(4)
    away[2, 3] = 0.5
    with pytest.raises(ValueError, match=r"the hand is \d+ mm from the object at the grip"):
        Demonstration.record(one.grasp.transformed(away), make_object(one.object).mesh, one.object)


def test_a_recording_is_read(hand: Hand, tmp_path: Path) -> None:
    grasp = load_demonstrations(hand)[0].grasp
    ends = [PREGRASP, GRIP]
    waypoints = [
        {"position": wrist[:3].tolist(), "quaternion": wrist[3:].tolist(), "joints": joints.tolist()}
        for wrist, joints in zip(grasp.wrist[0, ends], grasp.joints[0, ends], strict=True)
    ]
    path = tmp_path / "grasp.json"
    path.write_text(json.dumps({"grasp_type": GRASP_TYPES[int(grasp.grasp_type[0])], "waypoints": waypoints}))
    read = read_recording(path, hand)
    torch.testing.assert_close(read.wrist, grasp.wrist, atol=1e-4, rtol=0)
    torch.testing.assert_close(read.joints, grasp.joints, atol=1e-4, rtol=0)
    assert torch.equal(read.grasp_type, grasp.grasp_type)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("not json", "cannot be read"),
        ('{"waypoints": []}', "grasp_type"),
        ('{"grasp_type": "rim", "waypoints": []}', "needs grasp_type and waypoints"),
        ('{"grasp_type": "crab", "waypoints": []}', "cannot be read"),
    ],
)
def test_bad_recordings_are_refused(text: str, message: str, hand: Hand, tmp_path: Path) -> None:
    path = tmp_path / "grasp.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_recording(path, hand)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("crab: {object: box_09}", "is no grasp type"),
        ("rim: {object: box_09}", "preshape rim lacks or misspells 'wrist'"),
        ("[1, 2]", "holds no preshapes"),
    ],
)
def test_bad_preshapes_are_refused(text: str, message: str, hand: Hand, tmp_path: Path) -> None:
    path = tmp_path / "preshapes.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_preshapes(path, hand)


def test_what_is_no_demonstration_is_refused(hand: Hand, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="does not exist"):
        Demonstration.load(tmp_path / "none.safetensors")
    (tmp_path / "bad.safetensors").write_bytes(b"12345678901")
    with pytest.raises(ValueError, match="is no demonstration"):
        Demonstration.load(tmp_path / "bad.safetensors")
    load_demonstrations(hand)[0].grasp.save(tmp_path / "grasps.safetensors")
    with pytest.raises(ValueError, match="is no demonstration: it has no 'points'"):
        Demonstration.load(tmp_path / "grasps.safetensors")
    with pytest.raises(FileNotFoundError, match="holds no demonstration"):
        load_demonstrations(hand, str(tmp_path / "empty"))

"""The conventions of dexzoo.grasp, one test a sentence, and the container that keeps them."""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch.autograd import gradcheck

from dexzoo import rotation
from dexzoo.grasp import GRIP, KEYFRAMES, NUM_TYPES, PREGRASP, SQUEEZE, Grasps, Trajectory
from dexzoo.hand import Hand
from dexzoo.perception.camera import Camera
from dexzoo.rotation import pose_matrix


def keyframes(hand: Hand, num: int = 6, seed: int = 0) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    q15 = torch.rand(num, 3, len(hand.freedoms), generator=generator)
    return {
        "position": torch.randn(num, 3, 3, generator=generator) * 0.2,
        "quaternion": rotation.random(3 * num, generator).reshape(num, 3, 4),
        "joints": hand.lower + hand.expand(q15) * (hand.upper - hand.lower),
        "grasp_type": torch.randint(NUM_TYPES, (num,), generator=generator),
    }


@pytest.fixture
def grasps(hand: Hand) -> Grasps:
    return Grasps.of(Trajectory.from_keyframes(**keyframes(hand)), hand, torch.arange(6.0))


@pytest.fixture
def T_world_camera() -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = rotation.to_matrix(rotation.random(1, torch.Generator().manual_seed(5)))[0]
    pose[:3, 3] = [0.3, -0.4, 0.5]
    return pose


def assert_equal(ours: Trajectory, theirs: Trajectory) -> None:
    for name in ("wrist", "joints", "grasp_type"):
        assert torch.equal(getattr(ours, name), getattr(theirs, name)), name


# --- the conventions -------------------------------------------------------------------------------------------------


def test_T_a_b_maps_coordinates_in_b_to_a(grasps: Grasps, T_world_camera: np.ndarray) -> None:
    in_camera = grasps.transformed(np.linalg.inv(T_world_camera))
    point = torch.cat((in_camera.position, torch.ones(6, 10, 1)), -1)
    back = point @ torch.tensor(T_world_camera, dtype=torch.float32).T
    torch.testing.assert_close(back[..., :3], grasps.position)
    pose = torch.tensor(T_world_camera, dtype=torch.float32) @ in_camera.wrist_pose
    torch.testing.assert_close(pose, grasps.wrist_pose)


def test_frames_are_right_handed(grasps: Grasps) -> None:
    turn = grasps.wrist_pose[..., :3, :3]
    torch.testing.assert_close(torch.cross(turn[..., 0], turn[..., 1], dim=-1), turn[..., 2])


def test_quaternions_are_wxyz() -> None:
    quarter_about_z = torch.tensor([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    pose = pose_matrix(torch.zeros(3), quarter_about_z.float())
    torch.testing.assert_close(pose[:3, 0], torch.tensor([0.0, 1, 0]))  # x turns to y


def test_quaternions_have_w_not_negative_whatever_sign_is_given(grasps: Grasps) -> None:
    turned = torch.cat((grasps.position, -grasps.quaternion), -1)
    torch.testing.assert_close(replace(grasps, wrist=turned).wrist, grasps.wrist)
    assert (grasps.transformed(np.diag([1.0, -1, -1, 1])).quaternion[..., 0] >= 0).all()


def test_camera_looks_along_z_with_x_right_and_y_down() -> None:
    camera = Camera()
    assert camera.project(np.array([0.0, 0, 1])).tolist() == [camera.cx, camera.cy]
    assert camera.project(np.array([0.1, 0, 1]))[0] > camera.cx
    assert camera.project(np.array([0.0, 0.1, 1]))[1] > camera.cy


def test_wrist_frame_has_x_out_of_the_palm_y_to_the_thumb_z_to_the_fingers(hand: Hand) -> None:
    zero, bent = hand.forward_kinematics(torch.stack((torch.zeros(20), hand.upper)))
    tip = {finger: hand.link_names.index(f"{finger}_tip") for finger in ("thumb", "index", "middle", "ring", "little")}
    fingers = [tip[finger] for finger in ("index", "middle", "ring", "little")]
    assert (bent[fingers, 0, 3] > zero[fingers, 0, 3] + 0.04).all()  # fingers flex out of the palm
    assert zero[tip["thumb"], 1, 3] > zero[fingers, 1, 3].max()
    assert (zero[fingers, :3, 3].argmax(-1) == 2).all()


def test_joints_are_five_fingers_of_abd_mcp_pip_dip(hand: Hand) -> None:
    fingers, parts = ("thumb", "index", "middle", "ring", "little"), ("abd", "mcp", "pip", "dip")
    assert hand.joint_names == [f"{finger}_{part}" for finger in fingers for part in parts]
    assert len(hand.freedoms) == 15


def test_dip_equals_pip(hand: Hand) -> None:
    q20 = hand.expand(torch.rand(8, 15)).unflatten(-1, (5, 4))
    assert torch.equal(q20[..., 3], q20[..., 2])


def test_a_grasp_is_ten_waypoints_of_wrist_and_joints_and_a_type(grasps: Grasps) -> None:
    assert grasps.wrist.shape == (6, 10, 7)
    assert grasps.joints.shape == (6, 10, 20)
    assert [part.shape for part in (grasps.position, grasps.quaternion)] == [(6, 10, 3), (6, 10, 4)]
    assert torch.equal(torch.cat((grasps.position, grasps.quaternion), -1), grasps.wrist)


def test_grasp_type_is_an_index_one_for_each_grasp(grasps: Grasps, hand: Hand) -> None:
    assert grasps.grasp_type.dtype == torch.int64
    assert torch.equal(grasps.grasp_type, keyframes(hand)["grasp_type"])


def test_waypoints_0_6_and_9_are_pregrasp_grip_and_squeeze(grasps: Grasps, hand: Hand) -> None:
    assert KEYFRAMES == [PREGRASP, GRIP, SQUEEZE] == [0, 6, 9]
    key = keyframes(hand)
    torch.testing.assert_close(grasps.position[:, [0, 6, 9]], key["position"])
    torch.testing.assert_close(grasps.quaternion[:, [0, 6, 9]], key["quaternion"], atol=1e-6, rtol=0)
    torch.testing.assert_close(grasps.joints[:, [0, 6, 9]], key["joints"])


@pytest.mark.parametrize("leg", [slice(0, 7), slice(6, 10)], ids=["approach", "squeeze"])
def test_waypoints_are_equally_spaced_on_each_leg(grasps: Grasps, leg: slice) -> None:
    for values in (grasps.position, grasps.joints):
        steps = values[:, leg].diff(dim=1)
        torch.testing.assert_close(steps, steps[:, :1].expand_as(steps), atol=1e-6, rtol=0)
    quaternion = grasps.quaternion[:, leg].double()
    step = rotation.log(rotation.multiply(rotation.conjugate(quaternion[:, :-1]), quaternion[:, 1:]))
    torch.testing.assert_close(step, step[:, :1].expand_as(step), atol=1e-5, rtol=0)  # slerp: one axis, one speed


# --- the container ---------------------------------------------------------------------------------------------------


def test_transformed_and_back(grasps: Grasps, T_world_camera: np.ndarray) -> None:
    in_camera = grasps.transformed(np.linalg.inv(T_world_camera))
    assert torch.equal(in_camera.joints, grasps.joints)
    assert torch.equal(in_camera.grasp_type, grasps.grasp_type)
    back = in_camera.transformed(torch.tensor(T_world_camera))
    torch.testing.assert_close(back.wrist, grasps.wrist, atol=1e-6, rtol=0)
    assert torch.equal(back.log_likelihood, grasps.log_likelihood)
    assert back.hand is grasps.hand


def test_one_pose_for_each_grasp(grasps: Grasps, T_world_camera: np.ndarray) -> None:
    poses = torch.tensor(T_world_camera, dtype=torch.float32).repeat(6, 1, 1)
    poses[:, 0, 3] = torch.arange(6.0)
    torch.testing.assert_close(grasps.transformed(poses).wrist[4:5], grasps[4].transformed(poses[4]).wrist)


def test_from_keyframes_has_gradients(hand: Hand) -> None:
    key = {name: value.double() for name, value in keyframes(hand, 2).items()}
    kind = key["grasp_type"].long()
    tangent = rotation.log(key["quaternion"]).requires_grad_()

    def motion(position: torch.Tensor, tangent: torch.Tensor, joints: torch.Tensor) -> tuple[torch.Tensor, ...]:
        made = Trajectory.from_keyframes(position, rotation.exp(tangent), joints, kind)
        return made.wrist, made.joints

    assert gradcheck(motion, (key["position"].requires_grad_(), tangent, key["joints"].requires_grad_()))


def test_transformed_has_gradients(grasps: Grasps, T_world_camera: np.ndarray) -> None:
    few = grasps[:2].to(torch.float64)

    def moved(position: torch.Tensor, tangent: torch.Tensor) -> torch.Tensor:
        wrist = torch.cat((position, rotation.exp(tangent)), -1)
        return Trajectory(wrist, few.joints, few.grasp_type).transformed(T_world_camera).wrist

    tangent = rotation.log(few.quaternion).requires_grad_()
    assert gradcheck(moved, (few.position.clone().requires_grad_(), tangent))


def test_subsets(grasps: Grasps) -> None:
    order = grasps.log_likelihood.argsort(descending=True)
    assert torch.equal(grasps[order].wrist, grasps.wrist.flip(0))
    assert torch.equal(grasps[order].log_likelihood, torch.arange(5.0, -1, -1))
    mask = grasps.log_likelihood > 3
    last = Trajectory(grasps.wrist[4:], grasps.joints[4:], grasps.grasp_type[4:])
    for index in (mask, mask.numpy(), slice(4, None), [4, 5], np.array([4, 5]), torch.tensor([-2, -1])):
        assert_equal(grasps[index], last)
        assert torch.equal(grasps[index].log_likelihood, torch.tensor([4.0, 5.0]))
        assert grasps[index].hand is grasps.hand
    for index in (-1, np.int64(5), torch.tensor(5)):
        assert_equal(grasps[index], last[1:])
    assert len(grasps[[]]) == 0
    assert len(list(grasps)) == 6


def test_some_waypoints_alone(grasps: Grasps) -> None:
    ends = grasps.trajectory.waypoint([PREGRASP, SQUEEZE])
    assert torch.equal(ends.wrist, grasps.wrist[:, [0, 9]])
    assert torch.equal(ends.joints, grasps.joints[:, [0, 9]])
    assert torch.equal(ends.grasp_type, grasps.grasp_type)
    assert torch.equal(grasps.trajectory.waypoint(GRIP).wrist, grasps.wrist[:, 6:7])


def test_trajectories_split_and_joined(grasps: Grasps) -> None:
    motion = grasps.trajectory
    parts = motion.split(4)
    assert [len(part) for part in parts] == [4, 2]
    assert_equal(Trajectory.cat(parts), motion)
    turned = motion.transformed(np.diag([-1.0, -1, 1, 1]))
    both = Trajectory.stack([motion, turned])
    assert both.wrist_pose.shape == (2, 6, 10, 4, 4)
    assert_equal(both[1], Trajectory.stack([turned]))


def test_precision_changes_numbers_and_leaves_types(grasps: Grasps) -> None:
    double = grasps.to(torch.float64)
    assert [double.wrist.dtype, double.joints.dtype, double.log_likelihood.dtype] == [torch.float64] * 3
    assert double.grasp_type.dtype == torch.int64
    assert_equal(double.to(torch.float32), grasps)


def test_concatenate(grasps: Grasps) -> None:
    joined = Grasps.concatenate([grasps[:2], grasps[2:]])
    assert_equal(joined, grasps)
    assert torch.equal(joined.log_likelihood, grasps.log_likelihood)
    assert Grasps.concatenate([grasps, Grasps.of(grasps.trajectory, Hand.load())]).log_likelihood is None
    assert len(Grasps.concatenate([Grasps.none(grasps.hand), grasps])) == 6
    left = Grasps.of(grasps.trajectory, Hand.load(side="left"))
    with pytest.raises(ValueError, match="must be of one hand"):
        Grasps.concatenate([grasps, left])


def broken(values: torch.Tensor, where: tuple[int | slice, ...] | int, value: float) -> torch.Tensor:
    values = values.clone()
    values[where] = value
    return values


@pytest.mark.usefixtures("as_users_run_it")
def test_errors_name_the_grasp_at_fault(grasps: Grasps) -> None:
    with pytest.raises(ValueError, match=r"wrist of grasps has shape \(6, 10, 6\), expected \(num_grasps, 10, 7\)"):
        replace(grasps, wrist=grasps.wrist[..., :6])
    with pytest.raises(ValueError, match=r"wrist of grasps has shape \(10, 7\)"):
        replace(grasps, wrist=grasps.wrist[0])
    with pytest.raises(ValueError, match=r"joints of grasps has shape \(6, 10, 15\), expected \(6, 10, 20\)"):
        replace(grasps, joints=grasps.hand.reduce(grasps.joints))
    with pytest.raises(ValueError, match=r"grasp_type of grasps has shape \(5,\), expected \(6,\)"):
        replace(grasps, grasp_type=grasps.grasp_type[1:])
    for value in (float("nan"), float("inf")):
        with pytest.raises(ValueError, match="joints of grasp 3 holds a number that is not finite"):
            replace(grasps, joints=broken(grasps.joints, (3, 2, 4), value))
        with pytest.raises(ValueError, match="wrist of grasp 3 holds a number that is not finite"):
            replace(grasps, wrist=broken(grasps.wrist, (3, 2, 1), value))
    with pytest.raises(ValueError, match="quaternion of grasp 4, waypoint 7 has length"):
        replace(grasps, wrist=broken(grasps.wrist, (4, 7, slice(3, 7)), 0.7))
    for value in (-1, 10):
        with pytest.raises(ValueError, match=f"grasp 2 has the type {value}, expected 0 to 9"):
            replace(grasps, grasp_type=broken(grasps.grasp_type, 2, value))
    with pytest.raises(ValueError, match=r"log_likelihood of grasps has shape \(5,\), expected \(6,\)"):
        replace(grasps, log_likelihood=torch.zeros(5))
    with pytest.raises(ValueError, match=r"T_a_b must be a finite 4 x 4 matrix, got shape \(3, 4\)"):
        grasps.transformed(np.eye(4)[:3])
    for turn in (2 * np.eye(4), np.diag([1.0, 1, -1, 1])):
        with pytest.raises(ValueError, match="T_a_b's rotation is not orthonormal and right-handed"):
            grasps.transformed(turn)


def test_save_and_load(grasps: Grasps, tmp_path: Path) -> None:
    path = tmp_path / "grasps.safetensors"
    grasps.save(path)
    loaded = Grasps.load(path)
    assert_equal(loaded, grasps)
    assert torch.equal(loaded.log_likelihood, grasps.log_likelihood)
    assert loaded.hand == grasps.hand
    with safe_open(path, framework="pt") as file:
        assert file.metadata() == {"format": "dexzoo.grasps.2", "frame": "world", **grasps.hand.identity}
    Grasps.of(grasps.trajectory, grasps.hand).save(path)
    assert Grasps.load(str(path)).log_likelihood is None


def test_a_file_is_of_the_hand_that_it_names(grasps: Grasps, tmp_path: Path) -> None:
    path, left = tmp_path / "grasps.safetensors", Hand.load(side="left")
    Grasps.of(grasps.trajectory, left).save(path)
    assert Grasps.load(path).hand == left
    assert Grasps.load(path, left).hand is left
    with pytest.raises(ValueError, match=r"of the hand dlr2 \(left\), not of dlr2 \(right\)"):
        Grasps.load(path, grasps.hand)
    tensors = {"wrist": grasps.wrist, "joints": grasps.joints, "grasp_type": grasps.grasp_type}
    save_file(tensors, path, {"frame": "world", **grasps.hand.identity, "hand": "claw"})
    with pytest.raises(ValueError, match="a hand 'claw', which is not in robots/; give it with hand="):
        Grasps.load(path)
    save_file(tensors, path, {"frame": "world", **grasps.hand.identity, "digest": "0" * 64})
    with pytest.raises(ValueError, match="as it is now"):
        Grasps.load(path)


def first_edition(grasps: Grasps) -> dict[str, torch.Tensor]:
    kind = grasps.grasp_type[:, None, None].expand(-1, 10, 1)
    return {"waypoints": torch.cat((grasps.wrist, grasps.joints, kind), -1), "log_likelihood": grasps.log_likelihood}


def test_a_file_of_the_first_edition_is_read_in_the_world_frame_alone(grasps: Grasps, tmp_path: Path) -> None:
    path = tmp_path / "grasps.safetensors"
    save_file(first_edition(grasps), path, {"frame": "world", "format": "dexzoo.grasps.1"})
    assert_equal(Grasps.load(path), grasps)
    assert torch.equal(Grasps.load(path).log_likelihood, grasps.log_likelihood)
    save_file(first_edition(grasps), path, {"frame": "camera", "format": "dexzoo.grasps.1"})
    with pytest.raises(ValueError, match="the grasps are in the camera frame, expected the world frame") as refused:
        Grasps.load(path)
    assert "\n" not in str(refused.value)
    save_file({"waypoints": first_edition(grasps)["waypoints"][..., :27].contiguous()}, path, {"frame": "world"})
    with pytest.raises(ValueError, match=r"shape \(6, 10, 27\), expected \(num_grasps, 10, 28\)"):
        Grasps.load(path)


def test_files_that_are_no_grasps_are_refused(grasps: Grasps, tmp_path: Path) -> None:
    path = tmp_path / "grasps.safetensors"
    with pytest.raises(FileNotFoundError, match="does not exist"):
        Grasps.load(path)
    grasps.save(path)
    whole = path.read_bytes()
    for part in (b"", whole[:4], whole[:200], whole[:-8]):
        path.write_bytes(part)
        with pytest.raises(ValueError, match="is not a safetensors file of grasps"):
            Grasps.load(path)
    save_file({"weights": torch.zeros(2)}, path)
    with pytest.raises(ValueError, match=r"no tensor wrist; write the file with Grasps\.save"):
        Grasps.load(path)
    save_file(first_edition(grasps), path)
    with pytest.raises(ValueError, match="the grasps are in the unknown frame"):
        Grasps.load(path)


class Bomb:
    """An object that leaves a trace when unpickled."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[object, tuple[Path]]:
        return Path.touch, (self.trace,)


def test_a_pickle_is_refused_unread(tmp_path: Path) -> None:
    path, trace = tmp_path / "grasps.safetensors", tmp_path / "trace"
    for write in (lambda: path.write_bytes(pickle.dumps(Bomb(trace))), lambda: torch.save({"a": Bomb(trace)}, path)):
        write()
        with pytest.raises(ValueError, match="is not a safetensors file of grasps"):
            Grasps.load(path)
    assert not trace.exists()

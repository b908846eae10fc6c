"""The conventions of dexzoo.grasp, one test a sentence, and the container that keeps them."""

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch.autograd import gradcheck

from dexzoo import rotation
from dexzoo.camera import Camera
from dexzoo.grasp import GRIP, NUM_TYPES, PREGRASP, SQUEEZE, Grasps, pose_matrix, step_pose, transform_waypoints
from dexzoo.hand import default_hand


def keyframes(num: int = 6, seed: int = 0) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    hand = default_hand()
    q15 = torch.rand(num, 3, len(hand.freedoms), generator=generator)
    return {
        "position": torch.randn(num, 3, 3, generator=generator) * 0.2,
        "quaternion": rotation.random(3 * num, generator).reshape(num, 3, 4),
        "joints": hand.lower + hand.expand(q15) * (hand.upper - hand.lower),
        "grasp_type": torch.randint(NUM_TYPES, (num,), generator=generator),
    }


@pytest.fixture
def grasps() -> Grasps:
    return Grasps.from_keyframes(**keyframes(), frame="world", log_likelihood=torch.arange(6.0))


@pytest.fixture
def T_world_camera() -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = rotation.to_matrix(rotation.random(1, torch.Generator().manual_seed(5)))[0]
    pose[:3, 3] = [0.3, -0.4, 0.5]
    return pose


# --- the conventions -------------------------------------------------------------------------------------------------


def test_T_a_b_maps_coordinates_in_b_to_a(grasps: Grasps, T_world_camera: np.ndarray) -> None:
    in_camera = grasps.to_frame("camera", T_world_camera)
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
    waypoints = grasps.waypoints.clone()
    waypoints[..., 3:7] *= -1
    torch.testing.assert_close(Grasps(waypoints, "world").waypoints, grasps.waypoints)
    assert (grasps.to_frame("camera", np.diag([1.0, -1, -1, 1])).quaternion[..., 0] >= 0).all()


def test_camera_looks_along_z_with_x_right_and_y_down() -> None:
    camera = Camera()
    assert camera.project(np.array([0.0, 0, 1])).tolist() == [camera.cx, camera.cy]
    assert camera.project(np.array([0.1, 0, 1]))[0] > camera.cx
    assert camera.project(np.array([0.0, 0.1, 1]))[1] > camera.cy


def test_wrist_frame_has_x_out_of_the_palm_y_to_the_thumb_z_to_the_fingers() -> None:
    hand = default_hand()
    zero, bent = hand.forward_kinematics(torch.stack((torch.zeros(20), hand.upper)))
    tip = {finger: hand.link_names.index(f"{finger}_tip") for finger in ("thumb", "index", "middle", "ring", "little")}
    fingers = [tip[finger] for finger in ("index", "middle", "ring", "little")]
    assert (bent[fingers, 0, 3] > zero[fingers, 0, 3] + 0.04).all()  # fingers flex out of the palm
    assert zero[tip["thumb"], 1, 3] > zero[fingers, 1, 3].max()
    assert (zero[fingers, :3, 3].argmax(-1) == 2).all()


def test_joints_are_five_fingers_of_abd_mcp_pip_dip() -> None:
    hand = default_hand()
    fingers, parts = ("thumb", "index", "middle", "ring", "little"), ("abd", "mcp", "pip", "dip")
    assert hand.joint_names == [f"{finger}_{part}" for finger in fingers for part in parts]
    assert len(hand.freedoms) == 15


def test_dip_equals_pip() -> None:
    hand = default_hand()
    q20 = hand.expand(torch.rand(8, 15)).unflatten(-1, (5, 4))
    assert torch.equal(q20[..., 3], q20[..., 2])


def test_a_grasp_is_ten_waypoints_of_position_quaternion_joints_type(grasps: Grasps) -> None:
    assert grasps.waypoints.shape == (6, 10, 28)
    parts = (grasps.position, grasps.quaternion, grasps.joints, grasps.grasp_type[:, None, None].expand(-1, 10, 1))
    assert [part.shape[-1] for part in parts] == [3, 4, 20, 1]
    assert torch.equal(torch.cat(parts, -1), grasps.waypoints)


def test_grasp_type_is_an_index_the_same_in_all_ten(grasps: Grasps) -> None:
    assert grasps.grasp_type.dtype == torch.int64
    assert torch.equal(grasps.grasp_type, keyframes()["grasp_type"])
    assert (grasps.waypoints[:, :, 27] == grasps.waypoints[:, :1, 27]).all()


def test_waypoints_0_6_and_9_are_pregrasp_grip_and_squeeze(grasps: Grasps) -> None:
    assert (PREGRASP, GRIP, SQUEEZE) == (0, 6, 9)
    key = keyframes()
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


def test_to_frame_and_back(grasps: Grasps, T_world_camera: np.ndarray) -> None:
    in_camera = grasps.to_frame("camera", T_world_camera)
    assert in_camera.frame == "camera"
    assert torch.equal(in_camera.waypoints[..., 7:], grasps.waypoints[..., 7:])
    back = in_camera.to_frame("world", torch.tensor(T_world_camera))
    torch.testing.assert_close(back.waypoints, grasps.waypoints, atol=1e-6, rtol=0)
    assert torch.equal(back.log_likelihood, grasps.log_likelihood)
    assert grasps.to_frame("world", T_world_camera) is grasps


def test_one_pose_for_each_grasp(grasps: Grasps, T_world_camera: np.ndarray) -> None:
    poses = torch.tensor(T_world_camera, dtype=torch.float32).repeat(6, 1, 1)
    poses[:, 0, 3] = torch.arange(6.0)
    each = transform_waypoints(poses, grasps.waypoints)
    torch.testing.assert_close(each[4:5], transform_waypoints(poses[4], grasps.waypoints[4:5]))


def test_from_keyframes_has_gradients() -> None:
    key = {name: value.double() for name, value in keyframes(2).items()}
    tangent = rotation.log(key["quaternion"]).requires_grad_()

    def waypoints(position: torch.Tensor, tangent: torch.Tensor, joints: torch.Tensor) -> torch.Tensor:
        return Grasps.from_keyframes(position, rotation.exp(tangent), joints, key["grasp_type"], "world").waypoints

    assert gradcheck(waypoints, (key["position"].requires_grad_(), tangent, key["joints"].requires_grad_()))


def test_subsets(grasps: Grasps) -> None:
    order = grasps.log_likelihood.argsort(descending=True)
    assert torch.equal(grasps[order].waypoints, grasps.waypoints.flip(0))
    assert torch.equal(grasps[order].log_likelihood, torch.arange(5.0, -1, -1))
    mask = grasps.log_likelihood > 3
    for index in (mask, mask.numpy(), slice(4, None), [4, 5], np.array([4, 5]), torch.tensor([-2, -1])):
        assert torch.equal(grasps[index].waypoints, grasps.waypoints[4:])
        assert torch.equal(grasps[index].log_likelihood, torch.tensor([4.0, 5.0]))
    for index in (-1, np.int64(5), torch.tensor(5)):
        assert torch.equal(grasps[index].waypoints, grasps.waypoints[5:])
    assert len(grasps[[]]) == 0
    assert len(list(grasps)) == 6


def test_concatenate(grasps: Grasps, T_world_camera: np.ndarray) -> None:
    joined = Grasps.concatenate([grasps[:2], grasps[2:]])
    assert torch.equal(joined.waypoints, grasps.waypoints)
    assert torch.equal(joined.log_likelihood, grasps.log_likelihood)
    assert Grasps.concatenate([grasps, Grasps(grasps.waypoints, "world")]).log_likelihood is None
    with pytest.raises(ValueError, match="share one frame"):
        Grasps.concatenate([grasps, grasps.to_frame("camera", T_world_camera)])


def broken(grasps: Grasps, where: tuple[int | slice, ...], value: float) -> torch.Tensor:
    waypoints = grasps.waypoints.clone()
    waypoints[where] = value
    return waypoints


@pytest.mark.usefixtures("as_users_run_it")
def test_errors_name_the_grasp_at_fault(grasps: Grasps) -> None:
    with pytest.raises(ValueError, match=r"shape \(6, 10, 27\), expected \(num_grasps, 10, 28\)"):
        Grasps(grasps.waypoints[..., :27], "world")
    with pytest.raises(ValueError, match=r"shape \(10, 28\)"):
        Grasps(grasps.waypoints[0], "world")
    with pytest.raises(ValueError, match="'robot' is unknown"):
        Grasps(grasps.waypoints, "robot")
    for value in (float("nan"), float("inf")):
        with pytest.raises(ValueError, match="grasp 3 holds a number that is not finite"):
            Grasps(broken(grasps, (3, 2, 11), value), "world")
    with pytest.raises(ValueError, match="quaternion of grasp 4, waypoint 7 has length"):
        Grasps(broken(grasps, (4, 7, slice(3, 7)), 0.7), "world")
    for value in (-1, 10):
        with pytest.raises(ValueError, match=f"grasp 2 has the type {value}, expected 0 to 9"):
            Grasps(broken(grasps, (2, slice(None), 27), value), "world")
    with pytest.raises(ValueError, match=r"log_likelihood has shape \(5,\), expected \(6,\)"):
        Grasps(grasps.waypoints, "world", torch.zeros(5))
    with pytest.raises(ValueError, match=r"T_world_camera must be a finite 4 x 4 matrix, got shape \(3, 4\)"):
        grasps.to_frame("camera", np.eye(4)[:3])
    for turn in (2 * np.eye(4), np.diag([1.0, 1, -1, 1])):
        with pytest.raises(ValueError, match="T_world_camera's rotation is not orthonormal and right-handed"):
            grasps.to_frame("camera", turn)


def test_save_and_load(grasps: Grasps, tmp_path: Path) -> None:
    path = tmp_path / "grasps.safetensors"
    grasps.save(path)
    loaded = Grasps.load(path)
    assert torch.equal(loaded.waypoints, grasps.waypoints)
    assert torch.equal(loaded.log_likelihood, grasps.log_likelihood)
    assert loaded.frame == "world"
    Grasps(grasps.waypoints, "camera").save(path)
    assert Grasps.load(str(path)).log_likelihood is None


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
    with pytest.raises(ValueError, match="no tensor named waypoints"):
        Grasps.load(path)
    save_file({"waypoints": grasps.waypoints}, path)
    with pytest.raises(ValueError, match="names no frame"):
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


def test_a_pose_steps_in_its_own_frame_and_stays_in_its_box() -> None:
    pose = pose_matrix(
        torch.tensor([0.1, 0.2, 0.3]), rotation.from_axis_angle(torch.tensor([0.0, 0, 1]), torch.tensor(0.5))
    )
    ahead = step_pose(pose, torch.tensor([0.01, 0, 0, 0, 0, 0.2]))
    assert torch.allclose(ahead[:3, 3] - pose[:3, 3], 0.01 * pose[:3, 0], atol=1e-6)
    turn = rotation.log(rotation.from_matrix(pose[:3, :3].T @ ahead[:3, :3]))
    assert torch.allclose(turn, torch.tensor([0.0, 0, 0.2]), atol=1e-5)
    box = torch.tensor([0.005] * 3 + [0.05] * 3)
    far = torch.linalg.inv(pose) @ step_pose(pose, torch.full((6,), 9.0), box)
    assert (far[:3, 3].abs() <= 0.005 + 1e-6).all()
    assert torch.allclose(step_pose(pose, 1e-5 * torch.ones(6), box), step_pose(pose, 1e-5 * torch.ones(6)), atol=1e-7)

"""Grasps and the conventions that everything else follows.

- Metres, radians, kilograms, newtons, seconds. Right-handed frames. `T_a_b` maps coordinates in b to a.
- Quaternions are wxyz, unit, w >= 0.
- World: the table top is z = 0, z points up. Camera: x right, y down, z forward (OpenCV); depth is z in metres,
  and 0 or NaN means no reading.
- Wrist frame = palm frame: +x out of the palm, +y to the thumb side, +z to the fingers.
- Joints: thumb, index, middle, ring, little x (abd, mcp, pip, dip); dip = pip, so 20 angles and 15 freedoms.
- A grasp is 10 waypoints x 28 numbers: wrist position 0:3, wrist quaternion 3:7, joints 7:27, grasp type 27 (an
  index 0...9, the same in all ten). Waypoint 0 is the pre-grasp, waypoint 6 the grip, waypoint 9 the squeeze.
  Waypoints are equally spaced on each leg of the path: positions and joints linear, orientation slerp.
- Grasp sets hold grasps in the world frame; `generate` and `plan` give them in the camera frame, and a file says which
  it is. `score` and `refine` take either; an architecture's `logit` gets them in the frame of the aimed camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from dexzoo import rotation

NUM_WAYPOINTS = 10
PREGRASP, GRIP, SQUEEZE = 0, 6, 9
"""Waypoint indices of the pre-grasp, the grip (first full contact) and the squeeze."""
NUM_JOINTS = 20
GRASP_TYPES = (
    "power", "power_tube", "pinch", "pinch_support", "rim", "handle", "tripod", "lateral", "top", "edge",
)  # fmt: skip
"""Names of the grasp types; number 27 of a waypoint is the index into them."""
NUM_TYPES = len(GRASP_TYPES)
WAYPOINT_SIZE = 28
POSITION, QUATERNION, JOINTS, TYPE = slice(0, 3), slice(3, 7), slice(7, 27), 27
"""Where the parts of a waypoint stand among its 28 numbers."""

Frame = Literal["world", "camera"]


@dataclass(frozen=True)
class Grasps:
    """Any number of grasps in one frame.

    waypoints: (num_grasps, 10, 28), laid out as the module's docstring says.
    frame: "world" or "camera".
    log_likelihood: (num_grasps,) under the generator that proposed them, or None.

    Quaternions are stored with w >= 0, whichever of the two signs is given.
    Raises ValueError when the shape is wrong, a number is not finite, a quaternion is not unit, or a grasp type is
    none of 0...9.
    """

    waypoints: Float[Tensor, "grasp 10 28"]
    frame: Frame
    log_likelihood: Float[Tensor, " grasp"] | None = None

    def __post_init__(self) -> None:
        w = self.waypoints
        if w.ndim != 3 or w.shape[1:] != (NUM_WAYPOINTS, WAYPOINT_SIZE):
            raise ValueError(f"grasps have shape {tuple(w.shape)}, expected (num_grasps, 10, 28)")
        if self.frame not in ("world", "camera"):
            raise ValueError(f'grasp frame {self.frame!r} is unknown, use "world" or "camera"')
        if not torch.isfinite(w).all():
            bad = int((~torch.isfinite(w)).flatten(1).any(1).nonzero()[0])
            raise ValueError(f"grasp {bad} holds a number that is not finite")
        error = (w[..., QUATERNION].norm(dim=-1) - 1).abs()
        if error.numel() and error.max() > 1e-3:
            grasp, waypoint = divmod(int(error.argmax()), NUM_WAYPOINTS)
            raise ValueError(
                f"quaternion of grasp {grasp}, waypoint {waypoint} has length "
                f"{float(w[grasp, waypoint, QUATERNION].norm()):.3f}, expected 1 (wxyz at 3:7)"
            )
        types = w[..., TYPE].round()
        if ((types < 0) | (types >= NUM_TYPES)).any():
            bad = int(((types < 0) | (types >= NUM_TYPES)).any(1).nonzero()[0])
            raise ValueError(f"grasp {bad} has the type {float(w[bad, 0, TYPE]):g}, expected 0 to 9 (number 27)")
        if (w[..., 3] < 0).any():
            quaternion = torch.where(w[..., 3:4] < 0, -w[..., QUATERNION], w[..., QUATERNION])
            object.__setattr__(self, "waypoints", torch.cat((w[..., POSITION], quaternion, w[..., 7:]), dim=-1))
        if self.log_likelihood is not None and self.log_likelihood.shape != w.shape[:1]:
            raise ValueError(
                f"log_likelihood has shape {tuple(self.log_likelihood.shape)}, expected ({w.shape[0]},) for the grasps"
            )

    @classmethod
    def from_keyframes(
        cls,
        position: Float[Tensor, "grasp 3 3"],
        quaternion: Float[Tensor, "grasp 3 4"],
        joints: Float[Tensor, "grasp 3 20"],
        grasp_type: Tensor,
        frame: Frame,
        log_likelihood: Float[Tensor, " grasp"] | None = None,
    ) -> Grasps:
        """Grasps from their pre-grasp, grip and squeeze (dimension 1, in this order); differentiable.

        grasp_type: (num_grasps,) indices 0...9.
        """
        t = torch.linspace(0, 1, GRIP + 1, dtype=position.dtype, device=position.device)
        s = torch.linspace(0, 1, SQUEEZE - GRIP + 1, dtype=position.dtype, device=position.device)[1:]

        def blend(values: Tensor) -> Tensor:
            a, b, c = (values[:, i, None] for i in range(3))
            return torch.cat((a + t[:, None] * (b - a), b + s[:, None] * (c - b)), dim=1)

        a, b, c = (quaternion[:, i, None] for i in range(3))
        turned = torch.cat(
            (
                rotation.slerp(a, b, t.expand(len(position), -1)),
                rotation.slerp(b, c, s.expand(len(position), -1)),
            ),
            dim=1,
        )
        types = grasp_type.to(position)[:, None, None].expand(-1, NUM_WAYPOINTS, 1)
        return cls(torch.cat((blend(position), turned, blend(joints), types), -1), frame, log_likelihood)

    @classmethod
    def concatenate(cls, parts: list[Grasps]) -> Grasps:
        """All grasps of parts in the same frame, in order. The likelihood is kept if every part has one."""
        if len({part.frame for part in parts}) != 1:
            raise ValueError("grasps to concatenate must share one frame; use to_frame first")
        likelihoods = [part.log_likelihood for part in parts]
        known = [value for value in likelihoods if value is not None]
        joined = torch.cat(known) if len(known) == len(parts) else None
        return cls(torch.cat([part.waypoints for part in parts]), parts[0].frame, joined)

    def __len__(self) -> int:
        return self.waypoints.shape[0]

    def __getitem__(self, index: Tensor | slice | list[int] | np.ndarray | np.integer[Any] | int) -> Grasps:
        """A subset, as Grasps: by slice, mask, list, order of indices, or one index."""
        if isinstance(index, np.ndarray):
            index = torch.as_tensor(index)
        if isinstance(index, (int, np.integer)) or (isinstance(index, Tensor) and not index.ndim):
            index = [int(index)]
        likelihood = None if self.log_likelihood is None else self.log_likelihood[index]
        return replace(self, waypoints=self.waypoints[index], log_likelihood=likelihood)

    @property
    def position(self) -> Float[Tensor, "grasp 10 3"]:
        """Wrist positions, metres."""
        return self.waypoints[..., POSITION]

    @property
    def quaternion(self) -> Float[Tensor, "grasp 10 4"]:
        """Wrist orientations, wxyz."""
        return self.waypoints[..., QUATERNION]

    @property
    def joints(self) -> Float[Tensor, "grasp 10 20"]:
        """Joint angles, radians."""
        return self.waypoints[..., JOINTS]

    @property
    def grasp_type(self) -> Tensor:
        """(num_grasps,) integer grasp types 0...9."""
        return self.waypoints[:, 0, TYPE].round().long()

    @property
    def wrist_pose(self) -> Float[Tensor, "grasp 10 4 4"]:
        """Wrist poses as homogeneous matrices T_frame_wrist."""
        return pose_matrix(self.position, self.quaternion)

    def to_frame(self, frame: Frame, T_world_camera: Tensor | np.ndarray) -> Grasps:
        """The same grasps in "world" or "camera", given the pose of the camera in the world, (4, 4)."""
        if frame == self.frame:
            return self
        T = rotation.check_pose(T_world_camera, "T_world_camera")
        if frame == "camera":
            T = torch.linalg.inv(T)
        return replace(self, waypoints=transform_waypoints(T.to(self.waypoints), self.waypoints), frame=frame)

    def moved(self, motion: Tensor | np.ndarray) -> Grasps:
        """The grasps carried along by a rigid motion (4, 4) within their frame, as when the object under them moves."""
        T = rotation.check_pose(motion, "motion").to(self.waypoints)
        return replace(self, waypoints=transform_waypoints(T, self.waypoints))

    def save(self, path: str | Path) -> None:
        """Write to a safetensors file, frame included."""
        tensors = {"waypoints": self.waypoints.detach().float().contiguous()}
        if self.log_likelihood is not None:
            tensors["log_likelihood"] = self.log_likelihood.detach().float().contiguous()
        save_file(tensors, str(path), metadata={"frame": self.frame, "format": "dexzoo.grasps.1"})

    @classmethod
    def load(cls, path: str | Path) -> Grasps:
        """Read what `save` wrote. FileNotFoundError or ValueError when that is not possible."""
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"grasp file {path} does not exist")
        try:
            with safe_open(str(path), framework="pt") as file:
                frame = (file.metadata() or {}).get("frame", "")
                tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118, not a dict
        except SafetensorError as error:
            raise ValueError(
                f"{path} is not a safetensors file of grasps ({error}); write it with Grasps.save"
            ) from None
        if "waypoints" not in tensors:
            raise ValueError(f"{path} holds no tensor named waypoints; write it with Grasps.save")
        if frame not in ("world", "camera"):
            raise ValueError(f"{path} names no frame in its metadata; write it with Grasps.save")
        likelihood = tensors.get("log_likelihood")
        try:
            return cls(tensors["waypoints"].float(), frame, None if likelihood is None else likelihood.float())
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None


def pose_matrix(
    position: Float[Tensor, "*batch 3"], quaternion: Float[Tensor, "*batch 4"]
) -> Float[Tensor, "*batch 4 4"]:
    """Homogeneous matrices from positions and unit quaternions."""
    top = torch.cat((rotation.to_matrix(quaternion), position[..., None]), dim=-1)
    bottom = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*top.shape[:-2], 1, 4)
    return torch.cat((top, bottom), dim=-2)


def step_pose(
    pose: Float[Tensor, "*batch 4 4"], tangent: Float[Tensor, "*batch 6"], box: Float[Tensor, 6] | None = None
) -> Float[Tensor, "*batch 4 4"]:
    """Poses moved in the tangent space of SE(3): a translation (m) and a rotation vector (rad), in their own frame.

    box: half sizes of the box that the step stays in, smoothly: a step of t is box * tanh(t / box).
    """
    step = tangent if box is None else box * torch.tanh(tangent / box)
    return pose @ pose_matrix(step[..., :3], rotation.exp(step[..., 3:]))


def in_frame(pose: Float[Tensor, "*batch 4 4"], points: Float[Tensor, "*cloud point 3"]) -> Tensor:
    """Points in the frames of poses, which they broadcast against: quicker than to bring a whole hand to the points."""
    return (points - pose[..., None, :3, 3]) @ pose[..., :3, :3]


def transform_waypoints(
    T_a_b: Float[Tensor, "*pose 4 4"], waypoints: Float[Tensor, "*batch 10 28"]
) -> Float[Tensor, "*batch 10 28"]:
    """Waypoints given in frame b, expressed in frame a. T_a_b is one pose, or one for each grasp."""
    if T_a_b.ndim > 2:
        T_a_b = T_a_b[..., None, :, :]
    position = (T_a_b[..., :3, :3] @ waypoints[..., POSITION, None]).squeeze(-1) + T_a_b[..., :3, 3]
    turn = rotation.from_matrix(T_a_b[..., :3, :3])
    quaternion = rotation.normalize(rotation.multiply(*torch.broadcast_tensors(turn, waypoints[..., QUATERNION])))
    return torch.cat((position, quaternion, waypoints[..., 7:]), dim=-1)

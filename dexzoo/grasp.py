"""Grasps and the conventions that everything else follows.

- Units are meters, radians, kilograms, newtons and seconds. Frames are right-handed. `T_a_b` maps coordinates in frame
  b to frame a.
- Quaternions are wxyz, unit, with w >= 0.
- World frame: the table top is z = 0 and z points up. Grasps are in the world frame of the observation or the scene
  that they belong to. `Grasps.transformed` converts them where they leave or enter the program.
- Camera frame: x right, y down, z forward (OpenCV). Depth is z in meters; 0 or NaN means no reading.
- Wrist frame = palm frame: +x out of the palm, +y to the thumb side, +z to the fingers.
- Joints are in the order of `hand.joint_names`. Coupled joints have their own angle: the DLR/HIT hand II has 20 angles
  (thumb, index, middle, ring, little x abd, mcp, pip, dip) and 15 degrees of freedom.
- A grasp is ten waypoints of the wrist and the joints, and a grasp type. Waypoint 0 is the pre-grasp, waypoint 6 the
  grip (first full contact) and waypoint 9 the squeeze. Waypoints are equally spaced on each leg of the path: positions
  and joints linear, orientation slerp.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from dexzoo import rotation
from dexzoo.hand import Hand

NUM_WAYPOINTS = 10
PREGRASP, GRIP, SQUEEZE = 0, 6, 9
"""Waypoint indices of the pre-grasp, the grip (first full contact) and the squeeze."""
KEYFRAMES = [PREGRASP, GRIP, SQUEEZE]
GRASP_TYPES = (
    "power", "power_tube", "pinch", "pinch_support", "rim", "handle", "tripod", "lateral", "top", "edge",
)  # fmt: skip
"""Names of the grasp types; a grasp stores the index."""
NUM_TYPES = len(GRASP_TYPES)
FORMAT = "dexzoo.grasps.2"
Kind = TypeVar("Kind", bound="Trajectory")
Index = Tensor | slice | Sequence[int] | np.ndarray | np.integer[Any] | int


@dataclass(frozen=True)
class Trajectory:
    """Motion of the hand through the waypoints of any number of grasps, in one frame. Values are not checked.

    Attributes:
        wrist: Wrist poses, position in meters and quaternion wxyz, (*batch, waypoint, 7).
        joints: Joint angles in radians, (*batch, waypoint, joint).
        grasp_type: Index into `GRASP_TYPES`, (*batch,).
    """

    wrist: Float[Tensor, "*batch waypoint 7"]
    joints: Float[Tensor, "*batch waypoint joint"]
    grasp_type: Int[Tensor, "*batch"]

    @classmethod
    def from_keyframes(
        cls,
        position: Float[Tensor, "grasp 3 3"],
        quaternion: Float[Tensor, "grasp 3 4"],
        joints: Float[Tensor, "grasp 3 joint"],
        grasp_type: Int[Tensor, " grasp"],
    ) -> Trajectory:
        """Interpolate the ten waypoints between pre-grasp, grip and squeeze; differentiable.

        Args:
            position: Wrist positions in meters at the three keyframes.
            quaternion: Wrist orientations, wxyz.
            joints: Angles of all joints in radians.
            grasp_type: Index into `GRASP_TYPES`.

        Returns:
            The trajectories, in the frame of the keyframes.
        """
        t = torch.linspace(0, 1, GRIP + 1, dtype=position.dtype, device=position.device)
        s = torch.linspace(0, 1, SQUEEZE - GRIP + 1, dtype=position.dtype, device=position.device)[1:]

        def blend(values: Tensor) -> Tensor:
            a, b, c = (values[:, i, None] for i in range(3))
            return torch.cat((a + t[:, None] * (b - a), b + s[:, None] * (c - b)), dim=1)

        a, b, c = (quaternion[:, i, None] for i in range(3))
        approach = rotation.slerp(a, b, t.expand(len(position), -1))
        squeeze = rotation.slerp(b, c, s.expand(len(position), -1))
        wrist = torch.cat((blend(position), torch.cat((approach, squeeze), dim=1)), dim=-1)
        return Trajectory(wrist, blend(joints), grasp_type)

    @classmethod
    def cat(cls, parts: Sequence[Trajectory], dim: int = 0) -> Trajectory:
        """Join trajectories along a dimension that is there.

        Args:
            parts: Trajectories; at least one.
            dim: A batch dimension.
        """
        return cls._join(torch.cat, parts, dim)

    @classmethod
    def stack(cls, parts: Sequence[Trajectory]) -> Trajectory:
        """Join trajectories along a new first dimension.

        Args:
            parts: Trajectories; at least one.
        """
        return cls._join(torch.stack, parts, 0)

    @staticmethod
    def _join(function: Any, parts: Sequence[Trajectory], dim: int) -> Trajectory:  # noqa: ANN401, one of torch's
        names = ("wrist", "joints", "grasp_type")
        return Trajectory(*(function([getattr(part, name) for part in parts], dim) for name in names))

    @property
    def position(self) -> Float[Tensor, "*batch waypoint 3"]:
        """Wrist positions in meters."""
        return self.wrist[..., :3]

    @property
    def quaternion(self) -> Float[Tensor, "*batch waypoint 4"]:
        """Wrist orientations, wxyz."""
        return self.wrist[..., 3:]

    @property
    def wrist_pose(self) -> Float[Tensor, "*batch waypoint 4 4"]:
        """Wrist poses as homogeneous matrices."""
        return rotation.pose_matrix(self.position, self.quaternion)

    def __len__(self) -> int:
        return len(self.wrist)

    def __getitem__(self: Kind, index: Index) -> Kind:
        """A subset along the first dimension: by slice, mask, list, order of indices, or one index."""
        if isinstance(index, np.ndarray):
            index = torch.as_tensor(index)
        if isinstance(index, (int, np.integer)) or (isinstance(index, Tensor) and not index.ndim):
            index = [int(index)]
        return self._map(lambda value: value[index])

    def waypoint(self, index: int | Sequence[int]) -> Trajectory:
        """The motion at some waypoints only; the dimension `waypoint` stays.

        Args:
            index: One waypoint, or several in order.
        """
        rows = [index] if isinstance(index, int) else list(index)
        return Trajectory(self.wrist[..., rows, :], self.joints[..., rows, :], self.grasp_type)

    def transformed(self: Kind, T_a_b: Float[Tensor, "*pose 4 4"] | np.ndarray) -> Kind:
        """Express trajectories that are given in frame b in frame a.

        Args:
            T_a_b: Pose of frame b in frame a: one for all grasps, or one for each.

        Returns:
            The same trajectories in frame a.
        """
        T = torch.as_tensor(T_a_b).to(self.wrist)[..., None, :, :]
        position = (T[..., :3, :3] @ self.position[..., None]).squeeze(-1) + T[..., :3, 3]
        turn = rotation.from_matrix(T[..., :3, :3])
        quaternion = rotation.multiply(*torch.broadcast_tensors(turn, self.quaternion))
        return replace(self, wrist=torch.cat((position, rotation.normalize(quaternion)), dim=-1))

    def to(self: Kind, *args: Any, **kwargs: Any) -> Kind:  # noqa: ANN401, as torch's own
        """Move to a device or a floating-point type; grasp types stay integers.

        Args:
            args: Arguments of `torch.Tensor.to`.
            kwargs: Keywords of `torch.Tensor.to`.
        """

        def move(value: Tensor) -> Tensor:
            moved = value.to(*args, **kwargs)
            return moved if value.is_floating_point() else moved.to(value.dtype)

        return self._map(move)

    def detach(self: Kind) -> Kind:
        """The same values without their gradient."""
        return self._map(Tensor.detach)

    def split(self: Kind, size: int) -> list[Kind]:
        """Consecutive parts of at most `size` grasps; one empty part if there are none, as `torch.split` has it.

        Args:
            size: Largest number of grasps in a part.
        """
        return [self[start : start + size] for start in range(0, max(len(self), 1), size)]

    def _map(self: Kind, function: Any) -> Kind:  # noqa: ANN401, any function of tensors
        tensors = {field.name: getattr(self, field.name) for field in fields(self)}
        return replace(self, **{name: function(v) for name, v in tensors.items() if isinstance(v, Tensor)})


@dataclass(frozen=True)
class Grasps(Trajectory):
    """Grasps of one hand, in the world frame of the observation or scene that they belong to.

    Quaternions are stored with w >= 0, whichever sign is given.

    Attributes:
        wrist: Wrist poses, position in meters and quaternion wxyz, (grasp, 10, 7).
        joints: Joint angles in radians, in the order of `hand.joint_names`, (grasp, 10, joint).
        grasp_type: Index into `GRASP_TYPES`, (grasp,).
        hand: The hand whose wrist and joints these are.
        log_likelihood: Log-likelihood under the generator that proposed the grasps, (grasp,), or None.

    Raises:
        ValueError: A shape is wrong, a number is not finite, a quaternion is not unit, or a grasp type is unknown.
    """

    hand: Hand
    log_likelihood: Float[Tensor, " grasp"] | None = None

    def __post_init__(self) -> None:
        joints = len(self.hand.joint_names)
        count = len(self.wrist) if self.wrist.ndim else 0
        expected = {
            "wrist": (count, NUM_WAYPOINTS, 7),
            "joints": (count, NUM_WAYPOINTS, joints),
            "grasp_type": (count,),
            "log_likelihood": (count,),
        }
        for name, shape in expected.items():
            value = getattr(self, name)
            if value is not None and value.shape != shape:
                wanted = f"(num_grasps, {NUM_WAYPOINTS}, 7)" if name == "wrist" else shape
                raise ValueError(f"{name} of grasps has shape {tuple(value.shape)}, expected {wanted}")
        for name in ("wrist", "joints"):
            finite = torch.isfinite(getattr(self, name)).flatten(1).all(1)
            if not finite.all():
                raise ValueError(f"{name} of grasp {int((~finite).nonzero()[0])} holds a number that is not finite")
        length = self.quaternion.norm(dim=-1)
        if count and (length - 1).abs().max() > 1e-3:
            grasp, waypoint = divmod(int((length - 1).abs().argmax()), NUM_WAYPOINTS)
            raise ValueError(
                f"quaternion of grasp {grasp}, waypoint {waypoint} has length "
                f"{float(length[grasp, waypoint]):.3f}, expected 1 (wxyz at 3:7 of wrist)"
            )
        unknown = (self.grasp_type < 0) | (self.grasp_type >= NUM_TYPES)
        if unknown.any():
            row = int(unknown.nonzero()[0])
            raise ValueError(f"grasp {row} has the type {int(self.grasp_type[row])}, expected 0 to {NUM_TYPES - 1}")
        if (self.wrist[..., 3] < 0).any():
            sign = torch.where(self.wrist[..., 3:4] < 0, -1.0, 1.0)
            object.__setattr__(self, "wrist", torch.cat((self.position, sign * self.quaternion), dim=-1))

    @classmethod
    def of(cls, trajectory: Trajectory, hand: Hand, log_likelihood: Float[Tensor, " grasp"] | None = None) -> Grasps:
        """Check trajectories in the world frame and make grasps of them.

        Args:
            trajectory: Trajectories, (grasp,).
            hand: The hand that they are of.
            log_likelihood: As in `Grasps`.

        Returns:
            The grasps.

        Raises:
            ValueError: As in `Grasps`.
        """
        return cls(trajectory.wrist, trajectory.joints, trajectory.grasp_type, hand, log_likelihood)

    @property
    def trajectory(self) -> Trajectory:
        """The motion alone, without hand and likelihood."""
        return Trajectory(self.wrist, self.joints, self.grasp_type)

    def transformed(self: Kind, T_a_b: Float[Tensor, "*pose 4 4"] | np.ndarray) -> Kind:
        """Express grasps that are given in frame b in frame a.

        Args:
            T_a_b: Pose of frame b in frame a: one for all grasps, or one for each.

        Returns:
            The same grasps in frame a.

        Raises:
            ValueError: A single pose is no rigid motion.
        """
        return super().transformed(rotation.check_pose(T_a_b, "T_a_b") if np.ndim(T_a_b) == 2 else T_a_b)

    @classmethod
    def none(cls, hand: Hand) -> Grasps:
        """No grasps.

        Args:
            hand: The hand of which there are none.
        """
        joints = torch.zeros(0, NUM_WAYPOINTS, len(hand.joint_names))
        return cls(torch.zeros(0, NUM_WAYPOINTS, 7), joints, torch.zeros(0, dtype=torch.long), hand)

    @classmethod
    def concatenate(cls, parts: Sequence[Grasps]) -> Grasps:
        """All grasps of some parts in order.

        Args:
            parts: Grasps of one hand in one world frame; at least one part.

        Returns:
            The grasps; their log-likelihood is kept if every part has one.

        Raises:
            ValueError: The parts are of different hands.
        """
        if len({part.hand.digest for part in parts}) != 1:
            raise ValueError("grasps to concatenate must be of one hand")
        known = [part.log_likelihood for part in parts if part.log_likelihood is not None]
        likelihood = torch.cat(known) if len(known) == len(parts) else None
        return cls.of(Trajectory.cat(parts), parts[0].hand, likelihood)

    def save(self, path: str | Path) -> None:
        """Write to a safetensors file, with the hand's name, side and digest.

        Args:
            path: File to write.
        """
        tensors = {
            "wrist": self.wrist.detach().cpu().float().contiguous(),
            "joints": self.joints.detach().cpu().float().contiguous(),
            "grasp_type": self.grasp_type.cpu().contiguous(),
        }
        if self.log_likelihood is not None:
            tensors["log_likelihood"] = self.log_likelihood.detach().cpu().float().contiguous()
        save_file(tensors, str(path), metadata={"format": FORMAT, "frame": "world", **self.hand.identity})

    @classmethod
    def load(cls, path: str | Path, hand: Hand | None = None) -> Grasps:
        """Read a file that `save` wrote, or one of the first edition in the world frame.

        Args:
            path: File to read.
            hand: The hand of the grasps; by default the one that the file names, from robots/.

        Returns:
            The grasps, on the CPU.

        Raises:
            FileNotFoundError: The file does not exist.
            ValueError: The file holds no grasps, is in the camera frame, or is of another hand.
        """
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"grasp file {path} does not exist")
        try:
            with safe_open(str(path), framework="pt") as file:
                about = file.metadata() or {}
                tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118, not a dict
        except SafetensorError as error:
            raise ValueError(
                f"{path} is not a safetensors file of grasps ({error}); write it with Grasps.save"
            ) from None
        try:
            trajectory = read_trajectory(tensors)
            if about.get("frame") != "world":
                raise ValueError(
                    f"the grasps are in the {about.get('frame', 'unknown')} frame, expected the world frame; "
                    "make them again with plan"
                )
            likelihood = tensors.get("log_likelihood")
            likelihood = None if likelihood is None else likelihood.float()
            return cls.of(trajectory, Hand.of_file(about, hand), likelihood)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None


def read_trajectory(tensors: dict[str, Tensor]) -> Trajectory:
    """Trajectories from the tensors of a file.

    Args:
        tensors: `wrist`, `joints` and `grasp_type`; or, in files of the first edition, `waypoints` (grasp, 10, 28):
            position, quaternion, 20 joints, type.

    Returns:
        The trajectories, float32, values unchecked.

    Raises:
        ValueError: A tensor is missing, or has the wrong shape.
    """
    if "waypoints" in tensors:
        rows = tensors["waypoints"].float()
        if rows.ndim != 3 or rows.shape[1:] != (NUM_WAYPOINTS, 28):
            raise ValueError(f"waypoints have shape {tuple(rows.shape)}, expected (num_grasps, 10, 28)")
        return Trajectory(rows[..., :7], rows[..., 7:27], rows[:, 0, 27].round().long())
    for name in ("wrist", "joints", "grasp_type"):
        if name not in tensors:
            raise ValueError(f"there is no tensor {name}; write the file with Grasps.save")
    return Trajectory(tensors["wrist"].float(), tensors["joints"].float(), tensors["grasp_type"].long())

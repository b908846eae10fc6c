"""The joints of a hand: names, coupling and limits."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from dexzoo.hand.spec import HandSpec


class JointSpace:
    """Postures of a hand. Angles are radians.

    Args:
        spec: Tables of the hand.

    Attributes:
        spec: Tables of the hand.
        joint_names: All joints, in the order of a posture.
        freedoms: The joints that move by themselves; the others are coupled to them.
        fingers: Names that the names of the freedoms begin with, in their order.
        free_index: Places of the freedoms among all joints.
        lower: Lower limits of all joints, (joint,).
        upper: Upper limits of all joints, (joint,).
    """

    def __init__(self, spec: HandSpec) -> None:
        self.spec = spec
        self.joint_names = list(spec.joint_names)
        self.freedoms = list(spec.freedoms)
        self.fingers = list(dict.fromkeys(name.split("_")[0] for name in self.freedoms))
        self.free_index = [self.joint_names.index(name) for name in self.freedoms]
        joints = [spec.joint(name) for name in spec.joint_names]
        self.lower = torch.tensor([joint.lower for joint in joints], dtype=torch.float32)
        self.upper = torch.tensor([joint.upper for joint in joints], dtype=torch.float32)
        self._coupling = torch.zeros(len(joints), len(self.freedoms), dtype=torch.float64)
        self._offset = torch.zeros(len(joints), dtype=torch.float64)
        for row, joint in enumerate(joints):
            self._coupling[row, self.freedoms.index(joint.mimic or joint.name)] = joint.multiplier
            self._offset[row] = joint.offset
        self._cast_coupling: dict[tuple[torch.device, torch.dtype], tuple[Tensor, Tensor]] = {}

    def _coupling_like(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Factors and offsets in the dtype and on the device of a tensor, kept for the next call."""
        key = (q.device, q.dtype)
        if key not in self._cast_coupling:
            with torch.inference_mode(False):  # else a first call in inference mode would bar gradients from then on
                self._cast_coupling[key] = self._coupling.to(*key), self._offset.to(*key)
        return self._cast_coupling[key]

    def expand(self, q15: Float[Tensor, "*batch freedom"]) -> Float[Tensor, "*batch joint"]:
        """All joint angles from the free ones: the coupled joints follow.

        Args:
            q15: Angles of the freedoms, 15 for dlr2.

        Raises:
            ValueError: The number of angles is wrong.
        """
        if q15.shape[-1] != len(self.freedoms):
            raise ValueError(f"expand takes the {len(self.freedoms)} free joints, got {q15.shape[-1]} angles")
        coupling, offset = self._coupling_like(q15)
        return q15 @ coupling.T + offset

    def reduce(self, q20: Float[Tensor, "*batch joint"]) -> Float[Tensor, "*batch freedom"]:
        """The free joints among all; the inverse of `expand` on postures that keep the coupling.

        Args:
            q20: Angles of all joints, 20 for dlr2.
        """
        return q20[..., self.free_index]

    def clamp(self, q: Float[Tensor, "*batch joint"]) -> Float[Tensor, "*batch joint"]:
        """The nearest angles within the limits.

        Args:
            q: Angles of all joints or of the free ones, by their number.
        """
        lower, upper = self._limits(q)
        return torch.minimum(torch.maximum(q, lower), upper)

    def reflect(self, q: Float[Tensor, "*batch joint"]) -> Float[Tensor, "*batch joint"]:
        """Mirror angles beyond a limit back inside, as a random walk needs.

        Args:
            q: Angles of all joints or of the free ones, by their number.
        """
        lower, upper = self._limits(q)
        width = upper - lower
        phase = torch.remainder(q - lower, 2 * width)
        return lower + torch.minimum(phase, 2 * width - phase)

    def squash(self, z: Float[Tensor, "*batch joint"]) -> Float[Tensor, "*batch joint"]:
        """Map real numbers smoothly to angles within the limits, 0 to the middle.

        Args:
            z: Numbers for all joints or for the free ones, by their number.
        """
        lower, upper = self._limits(z)
        return lower + (upper - lower) * torch.sigmoid(z)

    def _limits(self, q: Tensor) -> tuple[Tensor, Tensor]:
        lower, upper = self.lower.to(q), self.upper.to(q)
        if q.shape[-1] == len(self.freedoms) != len(self.joint_names):
            return self.reduce(lower), self.reduce(upper)
        self._check_size(q)
        return lower, upper

    def check(self, q20: Float[Tensor, "*batch joint"], tolerance: float = 1e-3) -> None:
        """Check that postures are within the limits.

        Args:
            q20: Angles of all joints.
            tolerance: Radians by which a limit may be exceeded.

        Raises:
            ValueError: A joint is beyond its limits, or the number of angles is wrong.
        """
        self._check_size(q20)
        excess = torch.maximum(self.lower.to(q20) - q20, q20 - self.upper.to(q20)).nan_to_num(nan=torch.inf)
        if excess.numel() and excess.max() > tolerance:
            worst = int(excess.argmax())
            joint = worst % len(self.joint_names)
            angle, name = float(q20.reshape(-1)[worst]), self.joint_names[joint]
            if not math.isfinite(angle):
                raise ValueError(f"joint {name} is at {angle} rad, which is not finite")
            raise ValueError(
                f"joint {name} is at {angle:.3f} rad, outside its limits "
                f"{float(self.lower[joint]):.3f} to {float(self.upper[joint]):.3f}"
            )

    def _check_size(self, q20: Tensor) -> None:
        if q20.shape[-1] != len(self.joint_names):
            hint = "; use hand.expand first" if q20.shape[-1] == len(self.freedoms) else ""
            raise ValueError(f"a posture has {len(self.joint_names)} joint angles, got {q20.shape[-1]}{hint}")

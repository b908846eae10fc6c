"""What refinement may move, as numbers between -1 and 1, and the waypoints that follow from them.

-1 and 1 are the borders of the trust region around the grasp that was given, so that a state in the box is in the
region, within the limits of the joints and a path of ten waypoints, whatever an optimiser makes of it.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from dexzoo import rotation
from dexzoo.grasp import GRIP, JOINTS, NUM_JOINTS, NUM_WAYPOINTS, POSITION, PREGRASP, QUATERNION, SQUEEZE, TYPE, Grasps
from dexzoo.hand import Hand

KEY_FRAMES = [PREGRASP, GRIP, SQUEEZE]


@dataclass(frozen=True)
class Region:
    """How far refinement may go from the grasp that it is given, either way.

    wrist: metres along, and turn: radians about, each axis of the palm at the grip. joint: radians of each joint there.
    opening: how much wider the fingers open at the pre-grasp, as a share of the way that they close to the grip.
    squeeze: how much farther they are commanded beyond the grip, as a share of the given way.
    Raises ValueError for what is not a positive number.
    """

    wrist: float = 0.01
    turn: float = 0.1
    joint: float = 0.2
    opening: float = 0.2
    squeeze: float = 0.3

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not 0 < value < torch.inf:
                raise ValueError(f"the trust region's {name} is {value}, expected a positive number")


class GripVariables:
    """The grip's wrist (6 numbers in the tangent space of SE(3)), its free joints (15), opening and squeeze (2).

    The wrist carries the whole path along rigidly. Key frames follow from the numbers, and all waypoints from them, so
    grasps that are not made of key frames become so.
    coupled: whether the coupled joints follow the free ones; if not, all 20 joints are moved one by one.
    """

    def __init__(
        self, waypoints: Float[Tensor, "grasp 10 28"], hand: Hand, region: Region, coupled: bool = True
    ) -> None:
        self.hand, self.region, self.coupled = hand, region, coupled
        keys = waypoints[:, KEY_FRAMES]
        self.types = waypoints[:, 0, TYPE]
        self.place, self.turn = keys[:, 1:2, POSITION], keys[:, 1:2, QUATERNION]
        back = rotation.conjugate(self.turn)
        self.place_in_palm = rotation.rotate(back, keys[..., POSITION] - self.place)
        self.turn_in_palm = rotation.multiply(back, keys[..., QUATERNION])
        self.joints = hand.clamp(keys[..., JOINTS])
        if coupled:
            self.joints = hand.reduce(self.joints)
        lower, upper = (hand.reduce(limit) if coupled else limit for limit in (hand.lower, hand.upper))
        grip = self.joints[:, 1]
        self.low = torch.maximum(lower.to(grip), grip - region.joint)
        self.width = torch.minimum(upper.to(grip), grip + region.joint) - self.low
        start = 2 * (grip - self.low) / self.width - 1
        self.start = torch.cat((start.new_zeros(len(start), 6), start, start.new_zeros(len(start), 2)), -1)
        wrist = torch.arange(self.start.shape[1]) < 6
        self.stages = torch.stack((wrist, ~wrist)).to(start)

    def __call__(self, state: Float[Tensor, "grasp number"]) -> Float[Tensor, "grasp 10 28"]:
        """The waypoints; differentiable."""
        region = self.region
        step = rotation.rotate(self.turn, region.wrist * state[:, None, :3])
        turn = rotation.multiply(self.turn, rotation.exp(region.turn * state[:, None, 3:6]))
        position = self.place + step + rotation.rotate(turn, self.place_in_palm)
        quaternion = rotation.normalize(rotation.multiply(*torch.broadcast_tensors(turn, self.turn_in_palm)))
        opening, squeeze = region.opening * state[:, -2:-1], region.squeeze * state[:, -1:]
        before, given, after = self.joints.unbind(1)
        grip = self.low + self.width * (state[:, 6:-2] + 1) / 2
        keys = (before + opening * (before - given), grip, grip + (1 + squeeze) * (after - given))
        joints = self.hand.clamp(torch.stack(keys, 1))
        if self.coupled:
            joints = self.hand.expand(joints)
        return Grasps.from_keyframes(position, quaternion, joints, self.types, "world").waypoints


class WaypointVariables:
    """The numbers of all ten waypoints, each for itself, as in the thesis (chapter 4) but in the trust region.

    Quaternions are made unit again; the grasp type is no number to be moved.
    """

    def __init__(self, waypoints: Float[Tensor, "grasp 10 28"], hand: Hand, region: Region) -> None:
        self.given = waypoints
        sizes = [region.wrist] * 3 + [region.turn / 2] * 4 + [region.joint] * NUM_JOINTS
        reach = waypoints.new_tensor(sizes)
        moved = waypoints[..., :TYPE]
        low, high = moved - reach, moved + reach
        limits = hand.lower.to(low), hand.upper.to(low)
        self.low = torch.cat((low[..., :7], torch.maximum(low[..., JOINTS], limits[0])), -1)
        self.width = torch.cat((high[..., :7], torch.minimum(high[..., JOINTS], limits[1])), -1) - self.low
        self.start = (2 * (moved - self.low) / self.width - 1).clamp(-1, 1).flatten(1)
        wrist = (torch.arange(TYPE) < 7).repeat(NUM_WAYPOINTS)
        self.stages = torch.stack((wrist, ~wrist)).to(waypoints)

    def __call__(self, state: Float[Tensor, "grasp number"]) -> Float[Tensor, "grasp 10 28"]:
        """The waypoints; differentiable."""
        way = self.low + self.width * (state.unflatten(1, (NUM_WAYPOINTS, TYPE)) + 1) / 2
        quaternion = rotation.normalize(way[..., QUATERNION])
        return torch.cat((way[..., POSITION], quaternion, way[..., JOINTS], self.given[..., TYPE:]), -1)


Variables = GripVariables | WaypointVariables
"""States (grasp, number) within -1...1 to waypoints: start, (grasp, number), is the state of the given grasps; stages,
(stage, number), says which numbers are moved first and which then."""
VARIABLES = ("grip", "uncoupled", "waypoints")


def make_variables(name: str, waypoints: Float[Tensor, "grasp 10 28"], hand: Hand, region: Region) -> Variables:
    """The variables of that name around waypoints in the world frame."""
    if name == "waypoints":
        return WaypointVariables(waypoints, hand, region)
    return GripVariables(waypoints, hand, region, coupled=name == "grip")

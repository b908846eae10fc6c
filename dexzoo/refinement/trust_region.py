"""The trust region: how far refinement may move a grasp."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import torch


@dataclass(frozen=True)
class TrustRegion:
    """How far refinement may go from the given grasp, either way.

    Attributes:
        wrist: Meters along each axis of the palm at the grip.
        turn: Radians about each axis of the palm at the grip.
        joint: Radians of each joint at the grip.
        opening: How much wider the fingers open at the pre-grasp, as a share of the way that they close to the grip.
        squeeze: How much farther they are commanded beyond the grip, as a share of the given way.

    Raises:
        ValueError: A value is not a positive number.
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

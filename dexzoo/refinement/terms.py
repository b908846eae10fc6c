"""Terms of the objective: log-odds of success, prior, and penalties.

A term has a name, a weight and a value. To add one of your own, subclass `Term` and put it into the list that `refine`
is given:

    class Height(Term):
        name = "height"

        def near(self, view, hands):
            return lambda moved: moved.grasps.position[:, GRIP, 2]

    refine(grasps, observation, evaluator, terms=[*default_terms(evaluator, prior=None), Height(weight=5.0)])
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dexzoo.generators.generator import MIN_CLEARANCE, GraspDensity
from dexzoo.grasp import GRIP, PREGRASP, Trajectory
from dexzoo.hand import Hand
from dexzoo.models.evaluator import GraspEvaluator
from dexzoo.perception import View
from dexzoo.refinement.posed_hand import PosedHand

Value = Callable[[PosedHand], Float[Tensor, " grasp"]]

WEIGHTS = {
    "log_odds": 1.0,
    "spread": -1.0,
    "prior": 0.05,
    "penetration": -50.0,
    "shadow": -15.0,
    "table": -300.0,
    "self_collision": -50.0,
}
"""Default weights of the terms, chosen on validation objects."""
AT_OBJECT = 1
"""The first of `MOMENTS`, by its place among them, at which the hand can be in the object."""
AROUND = 0.007
"""Meters about each point of an obstacle that count as it: between points, and for the camera's error."""
APPROACH = tuple(range(PREGRASP, GRIP + 1))
"""The waypoints at which the table's clearance is compared before a grasp is replaced."""
MAX_LACK = 0.001
"""Meters by which the clearance that links lack, summed over links and the approach, may grow."""
_TOGETHER = 8
"""Grasps that are looked at together on their whole approach; bounds memory."""


class Term(ABC):
    """One term of the objective.

    Args:
        weight: Log-odds, before calibration, that a unit of the value adds: positive rewards, negative penalizes.

    Attributes:
        name: Name of the term in results; one of its own in each objective.

    Raises:
        ValueError: The weight is no finite number.
    """

    name: ClassVar[str]

    def __init__(self, weight: float) -> None:
        if not math.isfinite(weight):
            raise ValueError(f"the weight of {self.name} is {weight}, expected a finite number")
        self.weight = weight

    @abstractmethod
    def near(self, view: View, hands: PosedHand) -> Value:
        """The value as a function of grasps that stay near some given ones, row by row.

        Args:
            view: The view of the object; it serves for all calls.
            hands: The given grasps. Search for points near them here, once.

        Returns:
            The function, which is called with the same grasps moved within the trust region; differentiable if the
            optimizer climbs by gradient.
        """

    def accepts(self, view: View, hand: Hand, before: Trajectory, after: Trajectory) -> Bool[Tensor, " grasp"]:
        """Whether grasps may be replaced, as far as this term is concerned. All may, by default.

        Args:
            view: The view of the object.
            hand: The hand.
            before: The given grasps, world frame.
            after: Their replacements.
        """
        return torch.ones(len(before), dtype=torch.bool)


class LogOdds(Term):
    """Log-odds of success.

    Args:
        evaluator: The evaluator.
        weight: As in `Term`.
    """

    name = "log_odds"

    def __init__(self, evaluator: GraspEvaluator, weight: float = WEIGHTS["log_odds"]) -> None:
        super().__init__(weight)
        self.evaluator = evaluator

    def near(self, view: View, hands: PosedHand) -> Value:
        """See `Term.near`."""
        encoded = self.evaluator.prepare(view)
        return lambda moved: moved.once(encoded, lambda: encoded.logit_and_spread(moved.grasps))[0]


class Spread(Term):
    """Standard deviation of the log-odds among the members of an ensemble; 0 for a single model.

    Args:
        evaluator: The ensemble.
        weight: As in `Term`.
    """

    name = "spread"

    def __init__(self, evaluator: GraspEvaluator, weight: float = WEIGHTS["spread"]) -> None:
        super().__init__(weight)
        self.evaluator = evaluator

    def near(self, view: View, hands: PosedHand) -> Value:
        """See `Term.near`."""
        encoded = self.evaluator.prepare(view)
        return lambda moved: moved.once(encoded, lambda: encoded.logit_and_spread(moved.grasps))[1]


class Prior(Term):
    """Log-density of the grasp under the generator that proposed it.

    Args:
        density: The generator's density for the view.
        weight: As in `Term`.
    """

    name = "prior"

    def __init__(self, density: GraspDensity, weight: float = WEIGHTS["prior"]) -> None:
        super().__init__(weight)
        self.density = density

    def near(self, view: View, hands: PosedHand) -> Value:
        """See `Term.near`."""
        value = self.density.near(hands.grasps)
        return lambda moved: value(moved.grasps)


class Penetration(Term):
    """Meters that the deepest observed point of the object lies in each link, summed over links and moments.

    Args:
        weight: As in `Term`.
    """

    name = "penetration"

    def __init__(self, weight: float = WEIGHTS["penetration"]) -> None:
        super().__init__(weight)

    def near(self, view: View, hands: PosedHand) -> Value:
        """See `Term.near`."""
        return _depth_in_links(hands.nearest(view.observed, AT_OBJECT))


class Shadow(Term):
    """Like `Penetration`, of points shortly behind the observed surface, where the object is taken to go on.

    Args:
        weight: As in `Term`.
    """

    name = "shadow"

    def __init__(self, weight: float = WEIGHTS["shadow"]) -> None:
        super().__init__(weight)

    def near(self, view: View, hands: PosedHand) -> Value:
        """See `Term.near`."""
        return _depth_in_links(hands.nearest(view.shadow, AT_OBJECT))


class Table(Term):
    """Clearance in meters that links lack from the table and things on it, summed over links and moments.

    A grasp is not replaced by one that lacks more than a millimeter more of it on the whole approach.

    Args:
        weight: As in `Term`.
    """

    name = "table"

    def __init__(self, weight: float = WEIGHTS["table"]) -> None:
        super().__init__(weight)

    def near(self, view: View, hands: PosedHand) -> Value:
        """See `Term.near`."""
        points = hands.nearest(view.obstructions)
        return lambda moved: _lack_of_clearance(moved, points)

    @torch.no_grad()
    def accepts(self, view: View, hand: Hand, before: Trajectory, after: Trajectory) -> Bool[Tensor, " grasp"]:
        """See `Term.accepts`."""
        every = view.obstructions[None, None]

        def lack(grasps: Trajectory) -> Tensor:
            parts = [_lack_of_clearance(PosedHand(hand, part, APPROACH), every) for part in grasps.split(_TOGETHER)]
            return torch.cat(parts)

        return lack(after) < lack(before) + MAX_LACK


class SelfCollision(Term):
    """Meters that links overlap at the grip, summed over pairs.

    Args:
        weight: As in `Term`.
    """

    name = "self_collision"

    def __init__(self, weight: float = WEIGHTS["self_collision"]) -> None:
        super().__init__(weight)

    def near(self, view: View, hands: PosedHand) -> Value:
        """See `Term.near`."""
        return lambda moved: moved.hand.self_overlap(moved.links[:, -1]).sum(-1)


def default_terms(evaluator: GraspEvaluator, prior: GraspDensity | None) -> list[Term]:
    """The terms that `refine` climbs if it is given none.

    Args:
        evaluator: The evaluator that guides.
        prior: The generator's density, or None to do without.

    Returns:
        Log-odds, spread, prior and the penalties, with their default weights.
    """
    rewards = [LogOdds(evaluator), Spread(evaluator), *([] if prior is None else [Prior(prior)])]
    return [*rewards, Penetration(), Shadow(), Table(), SelfCollision()]


def _depth_in_links(points: Float[Tensor, "grasp moment near 3"]) -> Value:
    return lambda moved: (-moved.closest(points, AT_OBJECT)).clamp_min(0).sum((-1, -2))


def _lack_of_clearance(hands: PosedHand, points: Float[Tensor, "#grasp #moment near 3"]) -> Float[Tensor, " grasp"]:
    # the third row of a pose is the table's plane in the palm frame
    clearance = hands.hand.clearance(hands.links, hands.wrist[..., 2, :])
    clearance = torch.minimum(clearance, hands.closest(points) - AROUND)
    return (MIN_CLEARANCE - clearance).clamp_min(0).sum((-1, -2))

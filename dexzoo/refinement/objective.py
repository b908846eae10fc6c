"""What refinement climbs: log-odds of success, what speaks for them, and what a grasp pays for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from dexzoo.camera import Observation
from dexzoo.generators.density import GraspDensity
from dexzoo.hand import Hand
from dexzoo.models.evaluator import PreparedView
from dexzoo.refinement.penalties import AT_OBJECT, WAY, Posed, Prior, Surroundings

_TOGETHER = 8
"""Grasps whose whole ways are looked at together, with all points near them; bounds memory."""
Terms = dict[str, Float[Tensor, " grasp"]]
"""log_odds, and the terms of `Weights` that are asked for, by name."""


@dataclass(frozen=True)
class Weights:
    """Log-odds, as the evaluator gives them before calibration, that a unit of each term counts; 0 leaves a term out.

    spread: standard deviation of log-odds among an ensemble's members. prior: the generator's log-density of the grip.
    penetration, shadow: metres of observed points, and of what hides behind them, in the links. table: metres that
    links come too near to the table or to what stands on it. self_collision: metres that links overlap.
    The prior is added, the others are subtracted. Raises ValueError for a negative weight.
    """

    spread: float = 1.0
    prior: float = 0.05
    penetration: float = 50.0
    shadow: float = 15.0
    table: float = 300.0
    self_collision: float = 50.0

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not 0 <= value < torch.inf:
                raise ValueError(f"the weight of {name} is {value}, expected 0 or more")


class Objective:
    """log-odds - spread + prior - penalties of waypoints in the world frame, on one view.

    density: the generator's, needed where the prior has a weight.
    """

    def __init__(
        self, view: PreparedView, observation: Observation, hand: Hand, weights: Weights, density: GraspDensity | None
    ) -> None:
        self.view, self.hand, self.weights, self.density = view, hand, weights, density
        self.surroundings = Surroundings(observation)

    def near(self, waypoints: Float[Tensor, "grasp 10 28"]) -> Callable[[Tensor], Terms]:
        """The terms as a function of waypoints that stay near these: differentiable, grasp by grasp."""
        weights, around = self.weights, self.surroundings
        posed = Posed(self.hand, waypoints)
        looked: dict[str, Callable[[Posed], Tensor]] = {}
        if weights.penetration:
            looked["penetration"] = partial(Posed.penetration, near=posed.nearest(around.observed, AT_OBJECT))
        if weights.shadow:
            looked["shadow"] = partial(Posed.penetration, near=posed.nearest(around.shadow, AT_OBJECT))
        if weights.table:
            looked["table"] = partial(Posed.table, near=posed.nearest(around.others))
        if weights.self_collision:
            looked["self_collision"] = Posed.self_collision
        prior = Prior(self.density, waypoints) if weights.prior and self.density else None

        def terms(waypoints: Tensor) -> Terms:
            if weights.spread:
                logit, spread = self.view.logit_and_spread(waypoints)
                found = {"log_odds": logit, "spread": spread}
            else:
                found = {"log_odds": self.view.logit(waypoints)}
            if prior is not None:
                found["prior"] = prior(waypoints)
            if looked:
                now = Posed(self.hand, waypoints)
                found |= {name: look(now) for name, look in looked.items()}
            return found

        return terms

    @torch.no_grad()
    def lacks(self, waypoints: Float[Tensor, "grasp 10 28"]) -> Float[Tensor, " grasp"]:
        """The term "table" on the whole way to the grip; 0 where it has no weight."""
        if not self.weights.table:
            return waypoints.new_zeros(len(waypoints))
        every = self.surroundings.others[None, None]
        return torch.cat([Posed(self.hand, part, WAY).table(every) for part in waypoints.split(_TOGETHER)])

    def value(self, terms: Terms) -> Float[Tensor, " grasp"]:
        """What the terms add up to."""
        total = terms["log_odds"]
        for name, weight in asdict(self.weights).items():
            if name in terms:
                total = total + (weight if name == "prior" else -weight) * terms[name]
        return total

"""Optimizers of many grasps at once, each grasp for itself, on states between -1 and 1.

Each takes a `Search`, which evaluates states and remembers the best, and calls it `num_steps` times: on equal terms,
since evaluations take the time. `moves` is 1 for the numbers that may move, 0 for the others. `step_size` is the
share of the box that a step moves a number by. Random ones take their draws as `noise` and `chance`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from dexzoo.refinement.objective import Values

State = Float[Tensor, "grasp number"]
EDGE = 0.98
"""The farthest state that Adam starts from; at 1 the tangent that squashes its steps has no slope."""
TEMPERATURE = 0.1
"""Objective that Metropolis-Hastings loses with probability 1/e."""
MEMORY = 5
"""Steps that L-BFGS remembers."""


class Draws(NamedTuple):
    """Random numbers of each grasp and step, drawn beforehand.

    Attributes:
        noise: Normal numbers, (grasp, step, number).
        chance: Uniform numbers, (grasp, step).
    """

    noise: Tensor
    chance: Tensor

    @classmethod
    def draw(cls, num_steps: int, size: int, generators: Sequence[torch.Generator]) -> Draws:
        """Draw from one random stream per grasp, so that results do not depend on the batch.

        Args:
            num_steps: Number of steps.
            size: Numbers of a state.
            generators: One for each grasp.
        """
        noise = torch.stack([torch.randn(num_steps, size, generator=generator) for generator in generators])
        return cls(noise, torch.stack([torch.rand(num_steps, generator=generator) for generator in generators]))


class Search:
    """Evaluates states and keeps the best of each grasp, with its gradient.

    A grasp whose objective or gradient is not finite keeps its last good state, is marked in `failed`, and gets a
    gradient of zero.

    Args:
        evaluate: Gives the objective of states, and the values of its terms.
        start: States to start from.
        with_gradient: Whether gradients are taken.
        on_state: Called with each further state that is evaluated, and its objective.
    """

    def __init__(
        self,
        evaluate: Callable[[Tensor], tuple[Tensor, Values]],
        start: State,
        with_gradient: bool,
        on_state: Callable[[Tensor, Tensor], None],
    ) -> None:
        self.evaluate, self.with_gradient, self.on_state = evaluate, with_gradient, on_state
        self.best, self.gradient = start, torch.zeros_like(start)
        self.value = start.new_full((len(start),), -torch.inf)
        self.failed = torch.zeros(len(start), dtype=torch.bool)
        self.values: Values = {}
        self._look(start)

    def __call__(self, state: State) -> tuple[Float[Tensor, " grasp"], State]:
        """Objective, -inf if it is no number, and gradient of states."""
        value, gradient = self._look(state)
        self.on_state(state.detach(), value)
        return value, gradient

    def _look(self, state: State) -> tuple[Float[Tensor, " grasp"], State]:
        state = state.detach()
        if self.with_gradient:
            state = state.requires_grad_()
            with torch.enable_grad():
                value, values = self.evaluate(state)
                gradient = torch.autograd.grad(value.sum(), state)[0]
        else:
            with torch.no_grad():
                value, values = self.evaluate(state)
            gradient = torch.zeros_like(state)
        state, value = state.detach(), value.detach()
        good = torch.isfinite(value)
        self.failed |= ~(good & torch.isfinite(gradient).all(-1))
        value = torch.where(good, value, -torch.inf)
        gradient = torch.where(self.failed[:, None], 0.0, gradient)
        better = value > self.value
        self.best = torch.where(better[:, None], state, self.best)
        self.gradient = torch.where(better[:, None], gradient, self.gradient)
        self.value = torch.where(better, value, self.value)
        self.values = {
            name: torch.where(better, term.detach(), self.values[name]) if self.values else term.detach()
            for name, term in values.items()
        }
        return value, gradient


Optimizer = Callable[[Search, Float[Tensor, " number"], int, float, Draws], None]


def adam(search: Search, moves: Tensor, num_steps: int, step_size: float, draws: Draws) -> None:
    """Gradient ascent by Adam (Kingma and Ba 2015) on numbers that tanh squashes into the box.

    Args:
        search: Evaluates states and keeps the best.
        moves: 1 for the numbers that may move, 0 for the others.
        num_steps: Number of steps.
        step_size: Share of the box that a step moves a number by.
        draws: Random numbers.
    """
    start, gradient = search.best, search.gradient
    free = torch.atanh(start.clamp(-EDGE, EDGE))
    mean, square = torch.zeros_like(free), torch.zeros_like(free)
    for step in range(1, num_steps + 1):
        slope = moves * gradient * (1 - torch.tanh(free).square())
        mean = 0.9 * mean + 0.1 * slope
        square = 0.999 * square + 0.001 * slope.square()
        free = free + step_size * mean / (1 - 0.9**step) / ((square / (1 - 0.999**step)).sqrt() + 1e-8)
        _, gradient = search(torch.where(moves > 0, torch.tanh(free), start))


def lbfgs(search: Search, moves: Tensor, num_steps: int, step_size: float, draws: Draws) -> None:
    """Limited-memory BFGS in a box, by projection (after Byrd et al. 1995): numbers that are pulled over a border rest.

    Each grasp has its own memory and its own length of step: whole after one that helped, a quarter after one that did
    not. The first is `step_size`, and none is longer than half the box.

    Args:
        search: Evaluates states and keeps the best.
        moves: 1 for the numbers that may move, 0 for the others.
        num_steps: Number of steps.
        step_size: Share of the box that a step moves a number by.
        draws: Random numbers.
    """
    state, value, gradient = search.best, search.value, search.gradient
    length = torch.ones_like(value)
    pairs: list[tuple[Tensor, Tensor]] = []
    for _ in range(num_steps):
        held = (moves == 0) | (state >= 1) & (gradient > 0) | (state <= -1) & (gradient < 0)
        slope = torch.where(held, 0.0, gradient)
        ahead = torch.where(held, 0.0, _two_loops(slope, pairs))
        ahead = torch.where(((ahead * slope).sum(-1) > 0)[:, None], ahead, slope)
        longest = 1.0 if pairs else step_size
        size = ahead.abs().amax(-1, keepdim=True).clamp_min(1e-12)
        ahead = ahead * ((longest / size).clamp_max(1) if pairs else longest / size)
        proposal = (state + length[:, None] * ahead).clamp(-1, 1)
        new, there = search(proposal)
        pairs = [*pairs[1 - MEMORY :], (proposal - state, gradient - there)]
        better = new > value
        state = torch.where(better[:, None], proposal, state)
        gradient = torch.where(better[:, None], there, gradient)
        value = torch.where(better, new, value)
        length = torch.where(better, 1.0, length / 4)


def _two_loops(slope: Tensor, pairs: list[tuple[Tensor, Tensor]]) -> Tensor:
    """The slope times the inverse curvature estimated from pairs of steps and falls of the slope (Nocedal 1980)."""
    ahead, scale = slope, torch.ones_like(slope[:, :1])
    kept = []
    for step, fall in reversed(pairs):
        bend = (step * fall).sum(-1, keepdim=True)
        share = torch.where(bend > 1e-10, 1 / bend.clamp_min(1e-10), 0.0)  # no use where the slope does not fall
        along = share * (step * ahead).sum(-1, keepdim=True)
        ahead = ahead - along * fall
        kept.append((step, fall, share, along))
    for _, fall, share, _ in reversed(kept):  # the latest that is of use sets the scale
        scale = torch.where(share > 0, 1 / (share * fall.square().sum(-1, keepdim=True)).clamp_min(1e-10), scale)
    ahead = scale * ahead
    for step, fall, share, along in reversed(kept):
        ahead = ahead + step * (along - share * (fall * ahead).sum(-1, keepdim=True))
    return ahead


def metropolis(
    search: Search, moves: Tensor, num_steps: int, step_size: float, draws: Draws, temperature: float = TEMPERATURE
) -> None:
    """A random walk that goes up always and down now and then (Metropolis-Hastings), reflected at the borders.

    Args:
        search: Evaluates states and keeps the best.
        moves: 1 for the numbers that may move, 0 for the others.
        num_steps: Number of steps.
        step_size: Share of the box that a step moves a number by.
        draws: Random numbers.
        temperature: Objective that is lost with probability 1/e.
    """
    state, value = search.best, search.value
    for step in range(num_steps):
        proposal = state + step_size * moves * draws.noise[:, step]
        proposal = 1 - (torch.remainder(proposal + 1, 4) - 2).abs()
        new, _ = search(proposal)
        taken = draws.chance[:, step].log() * temperature < new - value
        state = torch.where(taken[:, None], proposal, state)
        value = torch.where(taken, new, value)


def random(search: Search, moves: Tensor, num_steps: int, step_size: float, draws: Draws) -> None:
    """A random step that is kept if it helps: Metropolis-Hastings that never goes down.

    Args:
        search: Evaluates states and keeps the best.
        moves: 1 for the numbers that may move, 0 for the others.
        num_steps: Number of steps.
        step_size: Share of the box that a step moves a number by.
        draws: Random numbers.
    """
    metropolis(search, moves, num_steps, step_size, draws, temperature=0.0)


OPTIMIZERS: dict[str, Optimizer] = {"adam": adam, "lbfgs": lbfgs, "metropolis": metropolis, "random": random}
BY_GRADIENT = ("adam", "lbfgs")

"""One climb: grasps, what may be moved of them, an optimiser; out come the best states, and what they are worth."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from numbers import Integral
from threading import Barrier, Lock

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dexzoo.refinement.objective import Objective, Terms
from dexzoo.refinement.optimisers import BY_GRADIENT, OPTIMISERS, Draws, Search
from dexzoo.refinement.variables import VARIABLES, Region, Variables, make_variables

CHUNK = 50
"""Grasps in work together; bounds each thread's memory, and keeps what lies between layers in cache."""
OnStep = Callable[[int, Float[Tensor, " grasp"]], None]


@dataclass(frozen=True)
class Trace:
    """All that was tried, step by step, the given grasps first.

    waypoints: (step, grasp, 10, 28) in the frame of the grasps. objective: (step, grasp), -inf where it was no number.
    """

    waypoints: Float[Tensor, "step grasp 10 28"]
    objective: Float[Tensor, "step grasp"]


@dataclass(frozen=True)
class Settings:
    """How to climb: arguments of `dexzoo.refine`, explained there. Raises ValueError for what they cannot be."""

    optimiser: str
    variables: str
    region: Region
    num_steps: int
    step_size: float

    def __post_init__(self) -> None:
        for what, value, known in (
            ("optimiser", self.optimiser, tuple(OPTIMISERS)),
            ("variables", self.variables, VARIABLES),
        ):
            if value not in known:
                raise ValueError(f"{what} {value!r} is unknown, use one of {', '.join(known)}")
        if not isinstance(self.num_steps, Integral) or self.num_steps < 0:
            raise ValueError(f"num_steps is {self.num_steps}, expected a whole number, 0 or more")
        if not 0 < self.step_size <= 1:
            raise ValueError(
                f"a step_size of {self.step_size} leaves the trust region; give a share of it, above 0 and at most 1"
            )


@dataclass(frozen=True)
class Climb:
    """What came of some grasps: waypoints in the world frame, terms of the given and of these, by how much they rose.

    failed: whether the objective was no finite number on the way. trace: in the world frame, if asked for.
    """

    waypoints: Float[Tensor, "grasp 10 28"]
    before: Terms
    after: Terms
    rise: Float[Tensor, " grasp"]
    failed: Bool[Tensor, " grasp"]
    trace: Trace | None


def climb(
    objective: Objective,
    waypoints: Float[Tensor, "grasp 10 28"],
    settings: Settings,
    seed: int,
    keep_trace: bool = False,
    on_step: OnStep | None = None,
) -> Climb:
    """Climb from waypoints in the world frame, at most `CHUNK` grasps together.

    Each of torch's threads takes chunks of its own: threads that share small operators gain little by it.
    """
    threads, num_chunks = torch.get_num_threads(), math.ceil(len(waypoints) / CHUNK)
    seeds = torch.randint(2**62, (len(waypoints),), generator=torch.Generator().manual_seed(seed))
    workers = min(threads, num_chunks)
    run = partial(_climb_chunk, objective, settings, keep_trace, None if on_step is None else _one_by_one(on_step))
    started = Barrier(workers + 1)

    def start() -> None:
        torch.set_num_threads(threads // workers)
        started.wait()

    with ThreadPoolExecutor(workers, initializer=start) as pool:
        parts = pool.map(run, waypoints.chunk(num_chunks), seeds.chunk(num_chunks))
        started.wait()
        torch.set_num_threads(threads)  # for threads to come, which would take after the pool's
        return _join(list(parts))


def _one_by_one(on_step: OnStep) -> OnStep:
    lock = Lock()

    def told(step: int, value: Tensor) -> None:
        with lock:
            on_step(step, value)

    return told


def _climb_chunk(
    objective: Objective, settings: Settings, keep_trace: bool, on_step: OnStep | None, given: Tensor, seeds: Tensor
) -> Climb:
    moved = make_variables(settings.variables, given, objective.hand, settings.region)
    generators = [torch.Generator().manual_seed(seed) for seed in seeds.tolist()]
    states: list[Tensor] = []
    values: list[Tensor] = []

    def told(state: Tensor, value: Tensor) -> None:
        if on_step is not None:
            on_step(len(values), value)
        values.append(value)
        if keep_trace:
            states.append(moved(state))

    terms_near = objective.near(given)
    with torch.no_grad():
        before = terms_near(given)
    value = objective.value(before)
    told(moved.start, torch.where(torch.isfinite(value), value, -torch.inf))
    best, failed, after = moved.start, torch.zeros(len(given), dtype=torch.bool), before
    later = settings.num_steps // 2
    for moves, num_steps in zip(moved.stages, (settings.num_steps - later, later), strict=True):
        if not num_steps:
            continue
        if best is not moved.start:  # what is near may no longer be
            terms_near = objective.near(moved(best))
        evaluate = partial(_evaluate, objective, terms_near, moved)
        search = Search(evaluate, best, settings.optimiser in BY_GRADIENT, told)
        draws = Draws.draw(num_steps, len(moves), generators)
        OPTIMISERS[settings.optimiser](search, moves, num_steps, settings.step_size, draws)
        best, failed, after = search.best, failed | search.failed, search.terms
    rise = objective.value(after) - value
    trace = Trace(torch.stack([given, *states[1:]]), torch.stack(values)) if keep_trace else None
    return Climb(moved(best), before, after, rise, failed, trace)


def _evaluate(
    objective: Objective, terms_near: Callable[[Tensor], Terms], moved: Variables, state: Tensor
) -> tuple[Tensor, Terms]:
    terms = terms_near(moved(state))
    return objective.value(terms), terms


def _join(parts: list[Climb]) -> Climb:
    traces = [part.trace for part in parts if part.trace is not None]
    trace = None
    if traces:
        trace = Trace(torch.cat([t.waypoints for t in traces], 1), torch.cat([t.objective for t in traces], 1))
    return Climb(
        torch.cat([part.waypoints for part in parts]),
        {name: torch.cat([part.before[name] for part in parts]) for name in parts[0].before},
        {name: torch.cat([part.after[name] for part in parts]) for name in parts[0].after},
        torch.cat([part.rise for part in parts]),
        torch.cat([part.failed for part in parts]),
        trace,
    )

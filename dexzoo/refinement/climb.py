"""One climb: grasps, the variables that move them and an optimizer give the best states found, and their values."""

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

from dexzoo.grasp import Trajectory
from dexzoo.refinement.objective import Objective, Values
from dexzoo.refinement.optimizers import BY_GRADIENT, OPTIMIZERS, Draws, Search
from dexzoo.refinement.trust_region import TrustRegion
from dexzoo.refinement.variables import MakeVariables, Variables

CHUNK = 50
"""Grasps in work together; bounds each thread's memory, and keeps activations in cache."""
OnStep = Callable[[int, Float[Tensor, " grasp"]], None]


@dataclass(frozen=True)
class Trace:
    """All states that were tried, step by step, the given grasps first.

    Attributes:
        grasps: Trajectories in the world frame, (step, grasp).
        objective: Their objective, -inf where it was no number, (step, grasp).
    """

    grasps: Trajectory
    objective: Float[Tensor, "step grasp"]


@dataclass(frozen=True)
class Settings:
    """How to climb: arguments of `dexzoo.refine`, explained there.

    Raises:
        ValueError: A value cannot be used.
    """

    optimizer: str
    make_variables: MakeVariables
    trust_region: TrustRegion
    num_steps: int
    step_size: float

    def __post_init__(self) -> None:
        if self.optimizer not in OPTIMIZERS:
            raise ValueError(f"optimizer {self.optimizer!r} is unknown, use one of {', '.join(OPTIMIZERS)}")
        if not isinstance(self.num_steps, Integral) or self.num_steps < 0:
            raise ValueError(f"num_steps is {self.num_steps}, expected a whole number, 0 or more")
        if not 0 < self.step_size <= 1:
            raise ValueError(
                f"a step_size of {self.step_size} leaves the trust region; give a share of it, above 0 and at most 1"
            )


@dataclass(frozen=True)
class Climb:
    """The result of a climb.

    Attributes:
        grasps: The best states found, world frame.
        before: Values of the terms of the given grasps.
        after: Values of the terms of the best states.
        rise: By how much the objective rose.
        failed: Whether the objective was no finite number on the way.
        trace: All states, if asked for.
    """

    grasps: Trajectory
    before: Values
    after: Values
    rise: Float[Tensor, " grasp"]
    failed: Bool[Tensor, " grasp"]
    trace: Trace | None


def climb(
    objective: Objective,
    grasps: Trajectory,
    settings: Settings,
    seed: int,
    keep_trace: bool = False,
    on_step: OnStep | None = None,
) -> Climb:
    """Climb from some grasps, at most `CHUNK` of them together.

    Each of torch's threads takes chunks of its own: threads that share small operators gain little by it.

    Args:
        objective: The objective.
        grasps: Grasps in the world frame; at least one.
        settings: How to climb.
        seed: Seed of the random optimizers.
        keep_trace: Whether all states are kept.
        on_step: Called with the step and the objective of a chunk, from one thread at a time.

    Returns:
        The best states.
    """
    threads, num_chunks = torch.get_num_threads(), math.ceil(len(grasps) / CHUNK)
    seeds = torch.randint(2**62, (len(grasps),), generator=torch.Generator().manual_seed(seed))
    size = math.ceil(len(grasps) / num_chunks)
    workers = min(threads, num_chunks)
    run = partial(_climb_chunk, objective, settings, keep_trace, None if on_step is None else _one_by_one(on_step))
    started = Barrier(workers + 1)

    def start() -> None:
        torch.set_num_threads(threads // workers)
        started.wait()

    with ThreadPoolExecutor(workers, initializer=start) as pool:
        parts = pool.map(run, grasps.split(size), seeds.split(size))
        started.wait()
        torch.set_num_threads(threads)  # for threads to come, which would take after the pool's
        return _join(list(parts))


def _one_by_one(on_step: OnStep) -> OnStep:
    lock = Lock()

    def locked(step: int, value: Tensor) -> None:
        with lock:
            on_step(step, value)

    return locked


def _climb_chunk(
    objective: Objective, settings: Settings, keep_trace: bool, on_step: OnStep | None, given: Trajectory, seeds: Tensor
) -> Climb:
    variables = settings.make_variables(given, objective.hand, settings.trust_region)
    generators = [torch.Generator().manual_seed(seed) for seed in seeds.tolist()]
    states: list[Trajectory] = [given]
    objectives: list[Tensor] = []

    def on_state(state: Tensor, value: Tensor) -> None:
        if on_step is not None:
            on_step(len(objectives), value)
        if keep_trace and objectives:
            states.append(variables(state))
        objectives.append(value)

    values_near = objective.near(given)
    with torch.no_grad():
        before = values_near(given)
    start = objective.total(before)
    on_state(variables.start, torch.where(torch.isfinite(start), start, -torch.inf))
    best, failed, after = variables.start, torch.zeros(len(given), dtype=torch.bool), before
    later = settings.num_steps // 2
    for moves, num_steps in zip(variables.stages, (settings.num_steps - later, later), strict=True):
        if not num_steps:
            continue
        if best is not variables.start:  # points that were near may no longer be
            values_near = objective.near(variables(best))
        evaluate = partial(_evaluate, objective, values_near, variables)
        search = Search(evaluate, best, settings.optimizer in BY_GRADIENT, on_state)
        draws = Draws.draw(num_steps, len(moves), generators)
        OPTIMIZERS[settings.optimizer](search, moves, num_steps, settings.step_size, draws)
        best, failed, after = search.best, failed | search.failed, search.values
    rise = objective.total(after) - start
    trace = Trace(Trajectory.stack(states), torch.stack(objectives)) if keep_trace else None
    return Climb(variables(best), before, after, rise, failed, trace)


def _evaluate(
    objective: Objective, values_near: Callable[[Trajectory], Values], variables: Variables, state: Tensor
) -> tuple[Tensor, Values]:
    values = values_near(variables(state))
    return objective.total(values), values


def _join(parts: list[Climb]) -> Climb:
    traces = [part.trace for part in parts if part.trace is not None]
    trace = None
    if traces:
        trace = Trace(Trajectory.cat([t.grasps for t in traces], 1), torch.cat([t.objective for t in traces], 1))
    return Climb(
        Trajectory.cat([part.grasps for part in parts]),
        {name: torch.cat([part.before[name] for part in parts]) for name in parts[0].before},
        {name: torch.cat([part.after[name] for part in parts]) for name in parts[0].after},
        torch.cat([part.rise for part in parts]),
        torch.cat([part.failed for part in parts]),
        trace,
    )

"""What benchmarks/refine.py keeps of each scene, and the figures that it makes of that."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from generator_figures import Counts, Tried, beside_first, change_of, mean, rate, resampled, share

from dexzoo.grasp import Grasps
from dexzoo.hand import Hand
from dexzoo.refinement import RANKINGS, rank

GENERATOR = "generator"
"""The rule that takes the generator's own first."""


@dataclass(frozen=True)
class Given(Tried):
    """The generator's grasps of a scene, best first, and what became of them.

    wrist, joints, grasp_type: as in `dexzoo.Grasps`. outcome: (n, 4) bool, columns FLAGS. penetration: (n,) meters.
    """

    object: str
    category: str
    wrist: np.ndarray
    joints: np.ndarray
    grasp_type: np.ndarray
    outcome: np.ndarray
    penetration: np.ndarray

    def __len__(self) -> int:
        return len(self.wrist)

    def grasps(self, hand: Hand) -> Grasps:
        """The grasps of the hand, without their likelihood."""
        return Grasps(*(torch.tensor(array) for array in (self.wrist, self.joints, self.grasp_type)), hand)


@dataclass(frozen=True)
class Refined(Tried):
    """What one variant made of them, all (n,) but outcome (n, 4); the judge's scores are NaN where there was none.

    cost: (2,) seconds of wall and of processor time.
    """

    replaced: np.ndarray
    failed: np.ndarray
    score_before: np.ndarray
    score_after: np.ndarray
    judge_before: np.ndarray
    judge_after: np.ndarray
    outcome: np.ndarray
    penetration: np.ndarray
    cost: np.ndarray

    def first(self, rule: str) -> int:
        """The row that a rule ranks first."""
        return 0 if rule == GENERATOR else int(rank(self._scores(), rule)[0])

    def first_unrefined(self, rule: str) -> int:
        """The row that the rule would rank first had nothing been refined."""
        if rule == GENERATOR:
            return 0
        return int(rank(self._scores(refined=False), rule)[0])

    def _scores(self, *, refined: bool = True) -> "Scores":
        """What ranking looks at; of the given grasps alone where nothing had been refined."""
        after, judge = (self.score_after, self.judge_after) if refined else (self.score_before, self.judge_before)
        known = not np.isnan(judge).any()
        return Scores(torch.tensor(self.score_before), torch.tensor(after), torch.tensor(judge) if known else None)


class Scores(NamedTuple):
    """The scores of a scene's grasps, as ranking takes them."""

    score_before: torch.Tensor
    score_after: torch.Tensor
    judge_after: torch.Tensor | None


def compared(given: dict[int, Given], done: dict[str, dict[int, Refined]]) -> dict[str, dict[str, Any]]:
    """The figures of each variant, and on the scenes that it shares with the first one by how much it differs."""

    def figures(rows: dict[int, Refined]) -> dict[str, Any]:
        return summarize([given[number] for number in rows], list(rows.values()))

    return beside_first(done, figures, {"success": share})


def summarize(given: list[Given], rows: list[Refined]) -> dict[str, Any]:
    before, after = share(given), share(rows)
    was, now = (np.concatenate([row.success for row in some]) for some in (given, rows))
    hit = np.concatenate([row.collided for row in rows])
    was_hit = np.concatenate([row.collided for row in given])
    fell, rose = int((was & ~now).sum()), int((~was & now).sum())
    deep, then = (np.concatenate([row.penetration for row in some]) for some in (given, rows))
    cost = np.array([row.cost for row in rows])
    judged = not any(np.isnan(row.judge_before).any() for row in rows)
    rules = [GENERATOR, *(name for name in RANKINGS if judged or name not in ("judge", "mean"))]
    return {
        "scenes": len(rows),
        "objects": len({row.object for row in given}),
        "grasps": len(was),
        "success_before": rate(resampled(before)),
        "success_after": rate(resampled(after)),
        "change": change_of(after, before),
        "transitions": transitions(was, now, hit),
        "gains_per_loss": rose / fell if fell else None,
        "collided_before": int(was_hit.sum()),
        "collided_after": int(hit.sum()),
        "replaced": mean(np.concatenate([row.replaced for row in rows])),
        "failed": int(np.concatenate([row.failed for row in rows]).sum()),
        "score_higher": mean(np.concatenate([row.score_after > row.score_before for row in rows])),
        "score_before": mean(np.concatenate([row.score_before for row in rows])),
        "score_after": mean(np.concatenate([row.score_after for row in rows])),
        "penetration_before": mean(deep),
        "penetration_after": mean(then),
        "penetration_change": change_of(*(depths(some) for some in (rows, given))),
        "top1": {rule: top1(given, rows, rule) for rule in rules},
        **{
            name: {"median": float(np.median(spent)), "per_100_grasps": float(100 * spent.sum() / len(was))}
            for name, spent in zip(("seconds", "processor_seconds"), cost.T, strict=True)
        },
    }


def transitions(was: np.ndarray, now: np.ndarray, hit: np.ndarray) -> dict[str, int]:
    """How many grasps went where (thesis, Tables 4.2 and 4.3)."""
    fail = ~now & ~hit
    return {
        "success_to_success": int((was & now).sum()),
        "success_to_fail": int((was & fail).sum()),
        "success_to_collided": int((was & hit).sum()),
        "fail_to_success": int((~was & now).sum()),
        "fail_to_fail": int((~was & fail).sum()),
        "fail_to_collided": int((~was & hit).sum()),
    }


def depths(rows: list[Any]) -> Counts:
    """Meters in all and grasps of each scene, whose quotient is the mean."""
    return np.array([row.penetration.sum() for row in rows]), np.array([len(row.penetration) for row in rows])


def top1(given: list[Given], rows: list[Refined], rule: str) -> dict[str, Any]:
    """How often the grasp that a rule ranks first holds: refined, and had nothing been refined; and the first's fate.

    The transitions are those of the grasps chosen after refinement (thesis, Tables 4.4 to 4.6).
    """
    pairs = list(zip(given, rows, strict=True))
    first = [row.first(rule) for row in rows]
    ones = np.ones(len(rows))
    plain = np.array([g.success[row.first_unrefined(rule)] for g, row in pairs], float), ones
    was = np.array([g.success[i] for (g, _), i in zip(pairs, first, strict=True)])
    now = np.array([row.success[i] for row, i in zip(rows, first, strict=True)])
    hit = np.array([row.collided[i] for row, i in zip(rows, first, strict=True)])
    refined = now.astype(float), ones
    return {
        "unrefined": rate(resampled(plain)),
        "refined": rate(resampled(refined)),
        "change": change_of(refined, plain),
        "transitions": transitions(was, now, hit),
    }

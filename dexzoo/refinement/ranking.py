"""Rules by which refined grasps are ranked; validation says which is best.

In the thesis the score after refinement picked those grasps whose score had inflated most: 72 % of them held, of those
picked by the score before 90 % (Table 4.6 and section 5).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor


@runtime_checkable
class Scored(Protocol):
    """Scores that rules look at: a `Refinement`, or as much of it. Tensors are (grasp,)."""

    @property
    def score_before(self) -> Tensor:
        """The evaluator's score of the given grasps."""

    @property
    def score_after(self) -> Tensor:
        """The evaluator's score of the returned grasps."""

    @property
    def judge_after(self) -> Tensor | None:
        """The judge's score of the returned grasps, if there was one."""


def before(result: Scored) -> Float[Tensor, " grasp"]:
    """The evaluator's score of the given grasp: refinement changes grasps, not their order.

    Args:
        result: The refinement.
    """
    return result.score_before


def after(result: Scored) -> Float[Tensor, " grasp"]:
    """The evaluator's score of the returned grasp.

    Args:
        result: The refinement.
    """
    return result.score_after


def lesser(result: Scored) -> Float[Tensor, " grasp"]:
    """The lesser of both scores.

    Args:
        result: The refinement.
    """
    return torch.minimum(result.score_before, result.score_after)


def judge(result: Scored) -> Float[Tensor, " grasp"]:
    """The judge's score of the returned grasp.

    Args:
        result: The refinement.

    Raises:
        ValueError: There was no judge.
    """
    check_ranking("judge", result.judge_after is not None)
    assert result.judge_after is not None
    return result.judge_after


def mean(result: Scored) -> Float[Tensor, " grasp"]:
    """The mean log-odds of the returned grasp: of the evaluator and, if there was one, the judge.

    Args:
        result: The refinement.
    """
    scores = [result.score_after] if result.judge_after is None else [result.score_after, result.judge_after]
    return torch.stack([torch.logit(score, 1e-6) for score in scores]).mean(0).sigmoid()


RANKINGS: dict[str, Callable[[Scored], Tensor]] = {
    "before": before,
    "after": after,
    "lesser": lesser,
    "judge": judge,
    "mean": mean,
}


def check_ranking(by: str, judged: bool) -> None:
    """Refuse a rule that cannot be used.

    Args:
        by: Name of the rule.
        judged: Whether there is a judge.

    Raises:
        ValueError: The rule is unknown, or needs a judge and there is none.
    """
    if by not in RANKINGS:
        raise ValueError(f"ranking {by!r} is unknown, use one of {', '.join(RANKINGS)}")
    if by == "judge" and not judged:
        raise ValueError('ranking by "judge" needs a refinement with a judge')


def best_first(score: Float[Tensor, " grasp"]) -> Tensor:
    """Indices from the highest score to the lowest; ties stay in order, NaN comes last.

    Args:
        score: Scores.
    """
    return torch.where(score.isnan(), -torch.inf, score).argsort(descending=True, stable=True)


def rank(result: Scored, by: str = "before") -> Tensor:
    """Indices of the returned grasps, best first.

    Args:
        result: The refinement.
        by: A name in `RANKINGS`.

    Raises:
        ValueError: The rule is unknown, or needs a judge and there was none.
    """
    check_ranking(by, result.judge_after is not None)
    return best_first(RANKINGS[by](result))

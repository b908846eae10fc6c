"""The objective of refinement: a weighted sum of terms."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dexzoo.grasp import Trajectory
from dexzoo.hand import Hand
from dexzoo.perception import View
from dexzoo.refinement.posed_hand import PosedHand
from dexzoo.refinement.terms import Term

Values = dict[str, Float[Tensor, " grasp"]]
"""Values of the terms by their names."""


class Objective:
    """A sum of terms on one view.

    Args:
        terms: The terms; at least one.
        view: The view of the object.
        hand: The hand.

    Raises:
        ValueError: There is no term, or two have one name.
    """

    def __init__(self, terms: Sequence[Term], view: View, hand: Hand) -> None:
        names = [term.name for term in terms]
        if not names or len(set(names)) < len(names):
            raise ValueError(
                f"the terms are {', '.join(names) or 'none'}; give at least one, each with a name of its own"
            )
        self.terms, self.view, self.hand = list(terms), view, hand

    def near(self, grasps: Trajectory) -> Callable[[Trajectory], Values]:
        """The values of all terms as a function of grasps that stay near these; differentiable, grasp by grasp.

        Args:
            grasps: Grasps in the world frame.
        """
        hands = PosedHand(self.hand, grasps)
        values = {term.name: term.near(self.view, hands) for term in self.terms}

        def evaluate(moved: Trajectory) -> Values:
            now = PosedHand(self.hand, moved)
            return {name: value(now) for name, value in values.items()}

        return evaluate

    def total(self, values: Values) -> Float[Tensor, " grasp"]:
        """The weighted sum.

        Args:
            values: Values of the terms.
        """
        first, *others = (term.weight * values[term.name] for term in self.terms)
        return sum(others, first)

    def accepts(self, before: Trajectory, after: Trajectory) -> Bool[Tensor, " grasp"]:
        """Whether no term objects to a replacement.

        Args:
            before: The given grasps.
            after: Their replacements.
        """
        accepted = torch.ones(len(before), dtype=torch.bool)
        for term in self.terms:
            accepted &= term.accepts(self.view, self.hand, before, after)
        return accepted

"""Refinement: better grasps near those that were proposed, by evaluators alone; the simulator is not asked.

refinement.py  `refine`: climb, and accept a grasp that rose, if no term and no judge objects
terms.py       the terms of the objective: log-odds, prior, penalties, or one of your own
objective.py   the weighted sum of terms
variables.py   the numbers that are moved, and the trust region
posed_hand.py  the hand at some waypoints, which terms look at
optimizers.py  Adam, L-BFGS, Metropolis-Hastings, random
climb.py       one climb: variables, objective and optimizer together, chunk by chunk
ranking.py     how refined grasps are ranked
"""

from dexzoo.refinement.climb import Trace
from dexzoo.refinement.objective import Objective
from dexzoo.refinement.optimizers import OPTIMIZERS
from dexzoo.refinement.ranking import RANKINGS, rank
from dexzoo.refinement.refinement import Refinement, refine
from dexzoo.refinement.terms import Term, default_terms
from dexzoo.refinement.trust_region import TrustRegion

__all__ = [
    "OPTIMIZERS",
    "RANKINGS",
    "Objective",
    "Refinement",
    "Term",
    "Trace",
    "TrustRegion",
    "default_terms",
    "rank",
    "refine",
]

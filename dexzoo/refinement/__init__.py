"""Refinement: better grasps near those that were proposed, judged by evaluators alone; the simulator is not asked.

method.py      `refine`: propose by climbing, accept what rose, and what a second evaluator agrees to
climb.py       one climb: variables, objective and optimiser brought together, chunk by chunk
variables.py   what may be moved, within the trust region by construction
objective.py   what is climbed: log-odds, prior, penalties, and their weights
penalties.py   the terms of it that come from the hand, the view and the generator
optimisers.py  Adam, L-BFGS, Metropolis-Hastings, random
ranking.py     how refined grasps are ranked
thesis.py      the thesis' groups A, B and C, to be compared with
"""

from dexzoo.refinement.climb import Trace
from dexzoo.refinement.method import Refinement, refine
from dexzoo.refinement.objective import Weights
from dexzoo.refinement.optimisers import OPTIMISERS
from dexzoo.refinement.ranking import RANKINGS, rank
from dexzoo.refinement.variables import Region

__all__ = ["OPTIMISERS", "RANKINGS", "Refinement", "Region", "Trace", "Weights", "rank", "refine"]

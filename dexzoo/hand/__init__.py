"""The hand: its tables, kinematics, coupling, limits and distances, all differentiable."""

from dexzoo.hand.hand import Hand
from dexzoo.hand.spec import HandSpec, Side
from dexzoo.hand.tables import Inertia, Joint, Pad, Primitive

__all__ = ["Hand", "HandSpec", "Inertia", "Joint", "Pad", "Primitive", "Side"]

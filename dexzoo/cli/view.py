"""`view`: show a hand in the browser."""

from __future__ import annotations

from typing import Literal

from dexzoo.cli.arguments import HAND_HELP, Parser, count_or_none
from dexzoo.cli.output import Result


def add_options(parser: Parser) -> None:
    """Add the options of this command.

    Args:
        parser: Parser of the command.
    """
    parser.add_argument("--hand", default="dlr2", help=HAND_HELP)
    parser.add_argument("--side", default="right", choices=("right", "left"), help="side of the hand")
    parser.add_argument("--port", type=count_or_none, default=8080, help="local port; 0 selects a free one")


def run(hand: str, side: Literal["right", "left"], port: int, seed: int) -> Result:
    """Serve the page until interrupted.

    Args:
        hand: Name or folder of the hand.
        side: Side of the hand.
        port: Port; 0 takes any free one.
        seed: Seed of everything random.

    Returns:
        Values for machines, and a table for people.
    """
    from dexzoo.viewing.hand_page import view

    view(hand, side, port, seed)
    return Result({}, None)

"""Results of commands, for machines and for people; progress goes to standard error, on a terminal only."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from rich.console import Console
from rich.progress import track
from rich.table import Table

if TYPE_CHECKING:
    from torch import Tensor

Item = TypeVar("Item")
errors = Console(stderr=True)


class Result(NamedTuple):
    """The result of a command.

    Attributes:
        values: Plain values, ready for JSON.
        table: Output without --json, if any.
    """

    values: dict[str, Any]
    table: Table | None


def followed(items: Iterable[Item], title: str, total: int | None = None) -> Iterator[Item]:
    """Show a progress bar while items are worked through.

    Args:
        items: The items.
        title: Title of the bar.
        total: Number of items, if `items` has no length.

    Returns:
        The items.
    """
    yield from track(items, title, total, console=errors, disable=not errors.is_terminal)


def pairs(title: str, values: dict[str, Any]) -> Table:
    """A table of names and values.

    Args:
        title: Title of the table.
        values: Values by name.
    """
    table = Table("", "", title=title, show_header=False)
    for name, value in values.items():
        table.add_row(name.replace("_", " "), f"{value:.3f}" if isinstance(value, float) else str(value))
    return table


def rounded(values: Tensor) -> list[float | None]:
    """Numbers to four digits; None if not finite, since JSON has no such numbers.

    Args:
        values: Numbers, (n,).
    """
    return [round(value, 4) if math.isfinite(value) else None for value in values.tolist()]

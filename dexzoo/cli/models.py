"""`models`: list the evaluative models."""

from __future__ import annotations

from rich.table import Table

from dexzoo.cli.arguments import Parser
from dexzoo.cli.output import Result
from dexzoo.models.registry import MODELS, how_to_get, shipped_card


def add_options(parser: Parser) -> None:
    """Add the options of this command: none.

    Args:
        parser: Parser of the command.
    """


def run(seed: int) -> Result:
    """List the models.

    Args:
        seed: Not used.

    Returns:
        Name, summary, weights and validation AUROC of each.
    """
    rows, missing = [], []
    table = Table(title="evaluative models", caption_justify="left")
    for heading in ("name", "summary", "weights", "validation AUROC"):
        table.add_column(heading)
    for name, entry in MODELS.items():
        card = shipped_card(name)
        auroc = None if card is None else card.get("metrics", {}).get("validation_auroc")
        rows.append({"name": name, "what": entry.summary, "shipped": card is not None, "validation_auroc": auroc})
        weights = "none" if card is None else "shipped"
        table.add_row(name, entry.summary, weights, "" if auroc is None else f"{auroc:.3f}")
        if card is None:
            missing.append(f"{name}: {how_to_get(name)}")
    table.caption = "\n".join(missing)
    return Result({"models": rows}, table)

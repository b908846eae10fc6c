"""Shared by the scripts that write figures into the docs: reading of results, rounding, tables."""

import json
from pathlib import Path
from typing import Any

from dexzoo.comparison.report import table as table

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "benchmarks" / "results"
BEGIN, END = "<!-- figures: benchmarks/report.py -->", "<!-- end of figures -->"


def read(name: str) -> dict[str, Any]:
    return json.loads((RESULTS / f"{name}.json").read_text())


def with_figures(text: str, figures: str) -> str:
    """The text with the part between the markers replaced."""
    before, rest = text.split(BEGIN)
    return f"{before}{BEGIN}\n{figures}{END}{rest.split(END)[1]}"


def percent(value: float) -> str:
    return f"{100 * value:.1f} %"


def span(interval: list[float], scale: float = 1.0, digits: int = 3) -> str:
    return f"{scale * interval[0]:.{digits}f} to {scale * interval[1]:.{digits}f}"

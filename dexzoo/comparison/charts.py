"""Charts of a comparison, drawn from its plain values."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dexzoo.comparison.scores import COIN, GM

Rows = dict[str, dict[str, Any]]
_GRAYS = {GM: "0.35", COIN: "0.7"}
_MIN_GRASPS = 10
"""Fewer in a bin say nothing of its success rate."""


def draw_charts(result: dict[str, Any], folder: Path) -> list[Path]:
    """Write rank.png, reliability.png and categories.png of the first source, the generated grasps.

    Args:
        result: As of `compare`.
        folder: Folder to write to.

    Returns:
        Their paths.
    """
    section = next(iter(result["sources"].values()))
    rows = dict(section["rows"])
    rank = save(rank_chart(rows, section["success_rate"]), folder / "rank.png")
    del rows[COIN]  # a coin has nothing to say of probabilities and categories
    reliability = save(reliability_chart(rows), folder / "reliability.png")
    return [rank, reliability, save(category_chart(rows), folder / "categories.png")]


def rank_chart(rows: Rows, base: float) -> Figure:
    """Success by tenth of rank (thesis, Fig. 3.13), with 95 % bands.

    Args:
        rows: Rows by name.
        base: Success rate of all grasps.
    """
    figure, axes = _axes(6.4, 4.2)
    tenth = np.arange(1, 11)
    for name, row in rows.items():
        rate = _column([part["value"] for part in row["by_rank"]])
        axes.plot(tenth, 100 * rate, marker="o", markersize=4, label=name, **_style(name, rows))
        low, high = _column([part["interval"] or (None, None) for part in row["by_rank"]]).T
        axes.fill_between(tenth, 100 * low, 100 * high, alpha=0.12, linewidth=0, color=_style(name, rows)["color"])
    axes.axhline(100 * base, color="0.5", linewidth=0.8, linestyle=":", label="all grasps")
    axes.set(xlabel="tenth of each scene's ranking, best first", ylabel="grasps that hold, %", ylim=(0, 100))
    axes.set_xticks(tenth)
    axes.set_title("Success by place in the ranking", fontsize=11)
    axes.legend(frameon=False, fontsize=9)
    return figure


def reliability_chart(rows: Rows) -> Figure:
    """Success rate against predicted probability, for the rows that predict one.

    Args:
        rows: Rows by name.
    """
    figure, axes = _axes(4.8, 4.8)
    axes.plot([0, 100], [0, 100], color="0.5", linewidth=0.8, linestyle=":", label="as predicted")
    for name, row in rows.items():
        bins = [part for part in row["reliability"] or [] if part["grasps"] >= _MIN_GRASPS]
        if bins:
            x, y = (_column([part[key] for part in bins]) for key in ("probability", "success_rate"))
            area = 4 + 150 * _column([part["grasps"] for part in bins]) / sum(part["grasps"] for part in bins)
            style = _style(name, rows)
            axes.plot(100 * x, 100 * y, label=name, **style)
            axes.scatter(100 * x, 100 * y, area, color=style["color"])
    axes.set(xlabel="predicted probability of success, %", ylabel="grasps that hold, %", xlim=(0, 100), ylim=(0, 100))
    axes.set_aspect("equal")
    axes.set_title("Calibration (larger dots: more grasps)", fontsize=11)
    axes.legend(frameon=False, fontsize=9)
    return figure


def category_chart(rows: Rows) -> Figure:
    """Success of the first grasp by category, the most difficult at the bottom.

    Args:
        rows: Rows by name.
    """
    categories = next(iter(rows.values()))["by_category"]
    order = sorted(categories, key=lambda name: categories[name]["success_rate"])
    figure, axes = _axes(6.4, 1.4 + 0.3 * len(order))
    place = np.arange(len(order))
    offsets = np.linspace(0.25, -0.25, len(rows)) if len(rows) > 1 else [0.0]
    base = _column([categories[name]["success_rate"] for name in order])
    axes.barh(place, 100 * base, color="0.93", height=0.8, label="all grasps")
    for (name, row), offset in zip(rows.items(), offsets, strict=True):
        first = _column([row["by_category"][category]["top1"] for category in order])
        axes.plot(100 * first, place + offset, "o", markersize=5, color=_style(name, rows)["color"], label=name)
    axes.set_yticks(place, [f"{name} ({categories[name]['scenes']})" for name in order])
    axes.set(xlabel="scenes whose first grasp holds, %", xlim=(-3, 103))
    axes.set_title("First grasp by category (number of scenes)", fontsize=11)
    axes.legend(frameon=False, fontsize=9, loc="center left", bbox_to_anchor=(1, 0.5))
    return figure


def save(figure: Figure, path: Path) -> Path:
    """Write a chart as PNG.

    Args:
        figure: The chart.
        path: File to write.

    Returns:
        The path.
    """
    figure.savefig(path, dpi=120, bbox_inches="tight", metadata={"Software": None})
    return path


def _axes(width: float, height: float) -> tuple[Figure, Axes]:
    figure = Figure((width, height), layout="constrained")
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _style(name: str, rows: Rows) -> dict[str, Any]:
    if name in _GRAYS:
        return {"color": _GRAYS[name], "linewidth": 1.2, "linestyle": "--"}
    return {"color": f"C{list(rows).index(name)}", "linewidth": 1.6}


def _column(values: list[Any]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Numbers, with nan for None."""
    return np.array(values, np.float64)

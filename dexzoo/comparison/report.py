"""A comparison for people: tables in Markdown, and the folder with everything."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich import box
from rich.table import Table

from dexzoo.comparison.charts import draw_charts
from dexzoo.comparison.figures import by_top1
from dexzoo.comparison.scores import EM2, GM


class Cells(NamedTuple):
    """A table."""

    head: list[str]
    rows: list[list[str]]


class _Column(NamedTuple):
    heading: str
    scale: float
    digits: int
    higher_is_better: bool = True
    with_interval: bool = False


_COLUMNS = {
    "accuracy": _Column("accuracy", 100, 1, with_interval=True),
    "balanced_accuracy": _Column("balanced", 100, 1),
    "auroc": _Column("AUROC", 1, 3, with_interval=True),
    "scene_auroc": _Column("in scenes", 1, 3),
    "average_precision": _Column("AP", 1, 3),
    "brier": _Column("Brier", 1, 3, higher_is_better=False),
    "calibration_error": _Column("calibration", 1, 3, higher_is_better=False),
    "top1": _Column("top-1", 100, 1, with_interval=True),
    "top5": _Column("top-5", 100, 1),
}
_BRIEF = ("accuracy", "auroc", "scene_auroc", "calibration_error", "top1", "top5")
_COUNTS = ("tp", "fp", "tn", "fn")
_COST = {
    "parameters": "parameters",
    "megabytes": "MB",
    "trunk_megabytes": "MB of its trunk",
    "milliseconds_per_view": "ms per view",
    "milliseconds_per_1000_grasps": "ms per 1,000 grasps",
    "threads": "threads",
    "processor": "processor",
}
_MILLISECONDS = ("milliseconds_per_view", "milliseconds_per_1000_grasps")
NOTES = """\
Accuracy, balanced accuracy (mean of the true positive and the true negative rate) and the success rates of the first
grasp (top-1) and of the first five grasps (top-5) of each scene are in %. AUROC is over all grasps; "in scenes" is
the AUROC within scenes, averaged. AP is the average precision. For the Brier score and the expected calibration
error, lower is better. Intervals are 95 % bootstrap over scenes. Several scenes show the same object; over objects,
intervals would be somewhat wider and p larger. p is McNemar's exact test of top-1 against gm, the generator's own
order. The threshold of gm, if it has one, was chosen on validation. The best value of each column is bold.
"""
AGAINST_EM2 = """\
Gain of each row over em2 on the same grasps: percentage points of accuracy and of top-1, and the share of em2's top-1
failures that it removes, less those that it adds, in %. Then the cross table of scenes by the success of the first
grasp, and McNemar's exact p.
"""


CATEGORIES = """\
By category, the most difficult last: accuracy, and the share of scenes in which the first grasp holds, in %. A row
without predicted outcomes has only the latter.
"""


def main_table(section: dict[str, Any], brief: bool = False) -> Cells:
    """The figures of one source, the best of each column between asterisks.

    Args:
        section: Entry of `sources`, as of `compare`.
        brief: Whether only those are shown that fit into a terminal, without intervals.
    """
    rows: dict[str, Any] = section["rows"]
    columns = {name: column for name, column in _COLUMNS.items() if not brief or name in _BRIEF}
    found = Cells(["", *(column.heading for column in columns.values()), "p"], [])
    best = {name: _best([row["figures"].get(name) for row in rows.values()], name) for name in columns}
    for label, row in rows.items():
        cells = []
        for name, column in columns.items():
            figure = row["figures"].get(name, {"value": None})
            cell = _number(figure["value"], column)
            if figure["value"] is not None and figure["value"] == best[name]:
                cell = f"**{cell}**"
            if column.with_interval and not brief and figure.get("interval"):
                cell += " ({} to {})".format(*(_number(end, column) for end in figure["interval"]))
            cells.append(cell)
        found.rows.append([label, *cells, _p(row.get("against_gm", {}).get("top1"))])
    return found


def terminal_table(result: dict[str, Any]) -> Table:
    """The main table of the first source, the generated grasps, and `advice`, for a terminal of 80 columns.

    Args:
        result: As of `compare`.
    """
    source, section = next(iter(result["sources"].items()))
    head, rows = main_table(section, brief=True)
    shown = Table(*head, title=title(source, section), box=box.SIMPLE, caption=advice(result), caption_justify="left")
    for row in rows:
        shown.add_row(*(re.sub(r"\*\*(.*?)\*\*", r"[bold]\1[/bold]", cell) for cell in row))
    return shown


def advice(result: dict[str, Any]) -> str:
    """One sentence on the first source: which model to use and why, or how a single model compares with gm.

    It is the model with the highest top-1 or, if its lead over the next is not significant, the faster of the two.

    Args:
        result: As of `compare`.

    Returns:
        The sentence; empty if there is nothing to compare.
    """
    rows, cost = next(iter(result["sources"].values()))["rows"], result["cost"]
    models = by_top1(rows)
    best, other, *_ = [*models, *([GM] if models and GM in rows else []), "", ""]
    if not other:
        return ""
    cross = rows[best][f"against_{other}"]["top1"]
    lead, sure = 100 * cross["difference"]["value"], cross["p"] < 0.05
    why = (
        f"{best}'s first grasp holds in {100 * rows[best]['figures']['top1']['value']:.1f} % of the scenes, "
        f"{abs(lead):.1f} points {'less' if lead < 0 else 'more'} than {other}'s (only {best}'s in "
        f"{cross['only_this']:,} scenes, only {other}'s in {cross[f'only_{other}']:,}); the difference is "
        f"{'significant' if sure else 'not significant'} (p {_p(cross)})"
    )
    if other == GM:
        return f"{why}."
    alone = rows[best].get("against_gm", {}).get("top1")
    doubt = ""
    if alone and not (alone["p"] < 0.05 and alone["difference"]["value"] > 0):
        doubt = f" {best} is not significantly better than gm, the generator's own order (p {_p(alone)})."
    if sure:
        return f"Use {best}: {why}.{doubt}"
    time = {name: sum(cost[name][part] for part in _MILLISECONDS) for name in (best, other)}
    quick, slow = sorted(time, key=time.__getitem__)
    spent = f"{time[quick]:,.0f} ms for a view and 1,000 grasps, against {time[slow]:,.0f}"
    return f"Use {quick}: {why}, and {quick} is faster ({spent}).{doubt}"


def counts_table(section: dict[str, Any]) -> Cells:
    """True and false positives and negatives (thesis, Table 3.3), and the cross table of top-1 with gm (Table 3.4).

    Args:
        section: Entry of `sources`, as of `compare`.
    """
    names = _cross(GM)
    found = Cells(["", *_COUNTS, *names.values()], [])
    for label, row in section["rows"].items():
        counts, cross = row["counts"] or {}, row.get("against_gm", {}).get("top1", {})
        cells = [*(counts.get(name) for name in _COUNTS), *(cross.get(name) for name in names)]
        found.rows.append([label, *("" if cell is None else f"{cell:,}" for cell in cells)])
    return found


def against_em2(section: dict[str, Any]) -> list[str]:
    """Gains of each row over em2 and the cross table of top-1, in Markdown; empty if em2 is not compared.

    Args:
        section: Entry of `sources`, as of `compare`.
    """
    names = _cross(EM2)
    rows = []
    for label, row in section["rows"].items():
        if "against_em2" in row:
            accuracy, top1 = (row["against_em2"][name] for name in ("accuracy", "top1"))
            gains = [accuracy and accuracy["difference"], top1["difference"], top1["failures_removed"]]
            rows.append([label, *map(_gain, gains), *(f"{top1[name]:,}" for name in names), _p(top1)])
    head = ["against em2", "accuracy", "top-1", "failures removed", *names.values(), "p"]
    return [AGAINST_EM2, table(head, rows)] if rows else []


def cost_table(cost: dict[str, dict[str, Any]]) -> Cells:
    """Size and speed of the models.

    Args:
        cost: Entry `cost`, as of `compare`.
    """

    def formatted(value: object) -> str:
        return f"{value:,}" if isinstance(value, int | float) else str(value)

    return Cells(
        ["", *_COST.values()], [[label, *(formatted(row[name]) for name in _COST)] for label, row in cost.items()]
    )


def category_table(section: dict[str, Any]) -> Cells:
    """Accuracy, and in how many % of the scenes the first grasp holds, by category, the most difficult last.

    Args:
        section: Entry of `sources`, as of `compare`.
    """
    rows = section["rows"]
    categories = next(iter(rows.values()))["by_category"]
    found = Cells(["category", "scenes", "grasps", "hold", *rows], [])
    for name in sorted(categories, key=lambda name: -categories[name]["success_rate"]):
        cells = [f"{categories[name]['scenes']:,}", f"{categories[name]['grasps']:,}"]
        cells.append(_number(categories[name]["success_rate"], _COLUMNS["accuracy"]))
        for row in rows.values():
            figures = [_number(row["by_category"][name].get(key), _COLUMNS[key]) for key in ("accuracy", "top1")]
            cells.append(", ".join(filter(None, figures)))
        found.rows.append([name, *cells])
    return found


def title(source: str, section: dict[str, Any]) -> str:
    """Title of a table.

    Args:
        source: Source of the grasps.
        section: Entry of `sources`, as of `compare`.
    """
    return (
        f"{section['grasps']:,} {source} grasps of {section['objects']} objects in {section['scenes']:,} scenes, "
        f"{100 * section['success_rate']:.1f} % hold"
    )


def markdown(result: dict[str, Any]) -> str:
    """The whole comparison: `advice`, for each source its tables, then the cost.

    Args:
        result: As of `compare`.
    """
    parts = [f"# Comparison on the {result['split']} split\n", f"{advice(result)}\n", NOTES]
    for source, section in result["sources"].items():
        parts += [f"## {title(source, section)}\n", table(*main_table(section)), table(*counts_table(section))]
        parts += [*against_em2(section), CATEGORIES, table(*category_table(section))]
    parts += ["## Cost\n", table(*cost_table(result["cost"]))]
    return "\n".join(parts)


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table in Markdown.

    Args:
        head: Headings.
        rows: Cells of each row.
    """
    first, *others = (f"| {' | '.join(map(str, row))} |" for row in (head, *rows))
    return "\n".join([first, "|" + "---|" * len(head), *others]) + "\n"


def write(result: dict[str, Any], folder: Path, pictures: Iterable[Path] = ()) -> None:
    """Write comparison.md, comparison.json and the charts into a folder.

    Args:
        result: As of `compare`.
        folder: Folder to write to.
        pictures: Pictures that are there already, to be shown in comparison.md after the charts.
    """
    folder.mkdir(parents=True, exist_ok=True)
    shown = [f"![{path.stem}]({path.name})\n" for path in (*draw_charts(result, folder), *pictures)]
    (folder / "comparison.md").write_text("\n".join([markdown(result), "## Pictures\n", *shown]))
    (folder / "comparison.json").write_text(json.dumps(result, indent=2, allow_nan=False) + "\n")


def _best(figures: list[dict[str, Any] | None], name: str) -> float | None:
    values = [figure["value"] for figure in figures if figure and figure["value"] is not None]
    return (max if _COLUMNS[name].higher_is_better else min)(values, default=None)


def _number(value: float | None, column: _Column) -> str:
    return "" if value is None else f"{column.scale * value:.{column.digits}f}"


def _cross(other: str) -> dict[str, str]:
    return {"both": "both hold", "only_this": "only this", f"only_{other}": f"only {other}", "neither": "neither"}


def _gain(figure: dict[str, Any] | None) -> str:
    if figure is None or figure["value"] is None:
        return ""
    return "{:+.1f} ({:+.1f} to {:+.1f})".format(*(100 * x for x in (figure["value"], *figure["interval"])))


def _p(cross: dict[str, Any] | None) -> str:
    if not cross:
        return ""
    return "< 0.0001" if cross["p"] < 1e-4 else f"{cross['p']:.4f}"

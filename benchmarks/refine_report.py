"""What benchmarks/report.py writes of refinement, from the JSON of benchmarks/refine.py."""

from typing import Any

from generator_report import points, rate, share
from tables import RESULTS, read, table

RULES = {
    "generator": "generator's first",
    "before": "score before",
    "after": "score after",
    "lesser": "lesser of both",
    "judge": "judge",
    "mean": "mean of evaluator and judge",
}
GROUP = "group "
"""How the names of the thesis' groups begin in the benchmark."""
HEADS = {
    "refinement": "",
    "refinement_ablation": "### What each term is worth, and other weights as guides\n\n",
    "refinement_validation": "### With a judge and without, on validation objects\n\n",
    "refinement_meshes": "### On objects from elsewhere\n\n",
}
"""What stands over each run of the benchmark."""


def refinement() -> str:
    """What has been measured of refinement; each part as soon as its benchmark has been run."""
    parts = [head + whole(read(name)) for name, head in HEADS.items() if (RESULTS / f"{name}.json").exists()]
    if (RESULTS / "refinement_cost.json").exists():
        parts.append(cost(read("refinement_cost")))
    return "\n".join(parts)


def whole(found: dict[str, Any]) -> str:
    """The tables of one run of the benchmark."""
    variants = found["variants"]
    name, first = next(iter(variants.items()))
    judge = f", and if `{found['judge']}` agrees" if found["judge"] else ""
    none = f"; in {found['without_grasp']} more scenes it found none" if found["without_grasp"] else ""
    several = first["scenes"] > first["objects"]
    alike = "; several are of one object, so that for objects they are somewhat too narrow" if several else ""
    went = heads(first["transitions"])
    rules = first["top1"]
    every = [rule for rule in RULES if any(rule in row["top1"] for row in variants.values())]
    return "\n".join(
        [
            f"`benchmarks/refine.py`; {first['scenes']} scenes of {first['objects']} objects ({found['split']}), at "
            f"most {found['num_grasps']} grasps of the Kopicki generator each, {first['grasps']:,} in all{none}. "
            f"`{name}` is guided by `{found['evaluator']}`, and replaces a grasp where the objective rises and the way "
            f"keeps its clearance{judge}; so do the others but for what their names say, and the thesis' groups, which "
            "replace all. The same trials before and after; the simulator selects nothing. Intervals are over "
            f"scenes{alike}. \"against the first\" compares with the first row; \"gains for a loss\" are failures that "
            "come to hold for each success that is lost.\n",
            outcomes(variants),
            "How deep at most any link lies in what is seen, up to the grip, and the probability of success by what "
            "guides; \"failed\" are grasps whose objective was no number; 30 steps on one thread:\n",
            ways(variants),
            "Where the grasps went (thesis, Tables 4.2 and 4.3):\n",
            table(("variant", *went), [(other, *row["transitions"].values()) for other, row in variants.items()]),
            f"The grasp that each rule ranks first in a scene, by `{name}`, and what became of those chosen (thesis, "
            "Tables 4.4 to 4.6):\n",
            table(
                ("ranked by", "holds unrefined", "holds refined", "change", *went),
                [
                    (RULES[rule], rate(row["unrefined"]), rate(row["refined"]), points(row["change"]),
                     *row["transitions"].values())
                    for rule, row in rules.items()
                ],
            ),
            "The first of each scene after refinement, by variant:\n",
            table(
                ("variant", *(RULES[rule] for rule in every)),
                [
                    (other, *(rate(row["top1"][rule]["refined"]) if rule in row["top1"] else "" for rule in every))
                    for other, row in variants.items()
                ],
            ),
            *groups(variants),
        ]
    )  # fmt: skip


def groups(variants: dict[str, Any]) -> list[str]:
    """What became of the first of each scene in the thesis' groups; nothing where none was run."""
    rows = [
        (other, RULES[rule], *row["top1"][rule]["transitions"].values())
        for other, row in variants.items()
        for rule in row["top1"]
        if GROUP in other
    ]
    head = ("variant", "ranked by", *heads(next(iter(variants.values()))["transitions"]))
    return ["What became of the first of each scene in the thesis' groups:\n", table(head, rows)] if rows else []


def heads(names: dict[str, Any]) -> tuple[str, ...]:
    return tuple(name.replace("_to_", " to ") for name in names)


def outcomes(variants: dict[str, Any]) -> str:
    """What held before and after."""
    head = (
        "variant", "grasps", "hold before", "hold after", "change", "against the first", "gains for a loss", "replaced",
        "hit the table before", "after",
    )  # fmt: skip
    rows = [
        (
            name,
            f"{row['grasps']:,}",
            rate(row["success_before"]),
            rate(row["success_after"]),
            points(row["change"]),
            points(row["against"]["success"]) if "against" in row else "",
            "" if row["gains_per_loss"] is None else f"{row['gains_per_loss']:.1f}",
            share(row["replaced"]),
            row["collided_before"],
            row["collided_after"],
        )
        for name, row in variants.items()
    ]
    return table(head, rows)


def ways(variants: dict[str, Any]) -> str:
    """How deep the links lie in what is seen, what the evaluator thinks, and what it costs."""
    head = (
        "variant", "penetration before, mm", "after", "change", "mean score before", "after", "score rises for",
        "failed", "processor seconds for 100",
    )  # fmt: skip
    rows = [
        (
            name,
            *(f"{1000 * row[key]:.2f}" for key in ("penetration_before", "penetration_after")),
            millimetres(row["penetration_change"]),
            *(f"{row[key]:.3f}" for key in ("score_before", "score_after")),
            share(row["score_higher"]),
            row["failed"],
            f"{row['processor_seconds']['per_100_grasps']:.1f}",
        )
        for name, row in variants.items()
    ]
    return table(head, rows)


def millimetres(change: dict[str, Any]) -> str:
    """A change of metres with its interval."""
    return "{:+.2f} ({:+.2f} to {:+.2f})".format(*(1000 * x for x in (change["rate"], *change["interval"])))


def cost(found: dict[str, Any]) -> str:
    whole, alone, density = (found[name] for name in ("whole", "evaluator_alone", "density"))
    terms = found["processor_seconds_of_terms"]
    keys = {"seconds": 1, "processor_seconds": 1, "peak_megabytes": 0}
    rows = [(f"{row['grasps']:,}", *(f"{row[key]:.{n}f}" for key, n in keys.items())) for row in found["growth"]]
    return "\n".join(
        [
            f"### Cost\n\n`benchmarks/refine_cost.py`; guided by `{found['evaluator']}`, {found['threads']} threads. "
            f"100 grasps x {found['num_steps']} steps take {whole['seconds']:.1f} s and at most "
            f"{whole['peak_megabytes']:.0f} MB with all that is loaded; the evaluator alone takes "
            f"{alone['seconds']:.1f} s. The density behind the prior is made once for a view, in "
            f"{density['seconds']:.1f} s. Processor seconds that each term adds, as the difference of two runs, to the "
            f"evaluator's {alone['processor_seconds']:.1f}:\n",
            table(tuple(name.replace("_", " ") for name in terms), [tuple(f"{value:.2f}" for value in terms.values())]),
            f"In {found['few_steps']} steps:\n",
            table(("grasps", "seconds", "processor seconds", "MB at most"), rows),
        ]
    )

"""Text and tables about refinement for benchmarks/report.py, from the JSON of benchmarks/refine.py."""

from typing import Any

from generator_report import points, rate, share
from tables import RESULTS, read, table

RULES = {
    "generator": "generator's order",
    "before": "score before",
    "after": "score after",
    "lesser": "lesser of both",
    "judge": "judge",
    "mean": "mean of evaluator and judge",
}
GROUP = "group "
"""Prefix of the groups of Zhao (2019) among the benchmark's variants."""
HEADS = {
    "refinement": "",
    "refinement_ablation": "### Ablations: terms of the objective and other evaluators\n\n",
    "refinement_validation": "### With and without a judge, on validation objects\n\n",
    "refinement_meshes": "### On external objects\n\n",
}
"""Heading of each run of the benchmark."""


def refinement() -> str:
    """All measurements of refinement; each part if its benchmark has been run."""
    parts = [head + whole(read(name)) for name, head in HEADS.items() if (RESULTS / f"{name}.json").exists()]
    if (RESULTS / "refinement_cost.json").exists():
        parts.append(cost(read("refinement_cost")))
    return "\n".join(parts)


def whole(found: dict[str, Any]) -> str:
    """The tables of one run of the benchmark."""
    variants = found["variants"]
    name, first = next(iter(variants.items()))
    judge = f", and if `{found['judge']}` agrees" if found["judge"] else ""
    none = f"; in {found['without_grasp']} more scenes the generator found none" if found["without_grasp"] else ""
    several = first["scenes"] > first["objects"]
    alike = "; several scenes show the same object, so for objects they are somewhat too narrow" if several else ""
    went = heads(first["transitions"])
    rules = first["top1"]
    every = [rule for rule in RULES if any(rule in row["top1"] for row in variants.values())]
    return "\n".join(
        [
            f"`benchmarks/refine.py`; {first['scenes']} scenes of {first['objects']} objects ({found['split']}), at "
            f"most {found['num_grasps']} grasps of the Kopicki generator each, {first['grasps']:,} in all{none}. "
            f"`{name}` uses the evaluator `{found['evaluator']}`, and replaces a grasp if the objective rises and the "
            f"approach keeps its clearance{judge}. The other variants differ from it as named; the groups of Zhao "
            "(2019) "
            "replace all grasps. The trials before and after are the same, and the simulator does not select grasps. "
            f"Intervals are over scenes{alike}. \"against the first\" is the difference to the first row; \"gains per "
            "loss\" is the number of failures that come to hold for each success that is lost.\n",
            outcomes(variants),
            "Maximum penetration of observed points into a link, up to the grip, and mean predicted probability of "
            "success; "
            "\"failed\" counts grasps with a non-finite objective; 30 steps on one thread:\n",
            ways(variants),
            "Transitions of outcomes (Zhao 2019, Tables 4.2 and 4.3):\n",
            table(("variant", *went), [(other, *row["transitions"].values()) for other, row in variants.items()]),
            f"Success of the first grasp of each scene by ranking rule, with `{name}`, and transitions of its outcome "
            "(Zhao 2019, Tables 4.4 to 4.6):\n",
            table(
                ("ranked by", "holds unrefined", "holds refined", "change", *went),
                [
                    (RULES[rule], rate(row["unrefined"]), rate(row["refined"]), points(row["change"]),
                     *row["transitions"].values())
                    for rule, row in rules.items()
                ],
            ),
            "Success of the first grasp of each scene after refinement, by variant:\n",
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
    """Transitions of the first grasp of each scene in the groups of Zhao (2019); empty if none was run."""
    rows = [
        (other, RULES[rule], *row["top1"][rule]["transitions"].values())
        for other, row in variants.items()
        for rule in row["top1"]
        if GROUP in other
    ]
    head = ("variant", "ranked by", *heads(next(iter(variants.values()))["transitions"]))
    return (
        ["Transitions of the first grasp of each scene in the groups of Zhao (2019):\n", table(head, rows)]
        if rows
        else []
    )


def heads(names: dict[str, Any]) -> tuple[str, ...]:
    return tuple(name.replace("_to_", " to ") for name in names)


def outcomes(variants: dict[str, Any]) -> str:
    """Success before and after."""
    head = (
        "variant", "grasps", "hold before", "hold after", "change", "against the first", "gains per loss", "replaced",
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
    """Depth of the links in the observed points, scores of the evaluator, and cost."""
    head = (
        "variant", "penetration before, mm", "after", "change", "mean score before", "after", "score rises for",
        "failed", "processor seconds per 100",
    )  # fmt: skip
    rows = [
        (
            name,
            *(f"{1000 * row[key]:.2f}" for key in ("penetration_before", "penetration_after")),
            millimeters(row["penetration_change"]),
            *(f"{row[key]:.3f}" for key in ("score_before", "score_after")),
            share(row["score_higher"]),
            row["failed"],
            f"{row['processor_seconds']['per_100_grasps']:.1f}",
        )
        for name, row in variants.items()
    ]
    return table(head, rows)


def millimeters(change: dict[str, Any]) -> str:
    """A change in meters, as millimeters with its interval."""
    return "{:+.2f} ({:+.2f} to {:+.2f})".format(*(1000 * x for x in (change["rate"], *change["interval"])))


def cost(found: dict[str, Any]) -> str:
    whole, alone, density = (found[name] for name in ("whole", "evaluator_alone", "density"))
    terms = found["processor_seconds_of_terms"]
    keys = {"seconds": 1, "processor_seconds": 1, "peak_megabytes": 0}
    rows = [(f"{row['grasps']:,}", *(f"{row[key]:.{n}f}" for key, n in keys.items())) for row in found["growth"]]
    return "\n".join(
        [
            f"### Cost\n\n`benchmarks/refine_cost.py`; evaluator `{found['evaluator']}`, {found['threads']} threads. "
            f"100 grasps x {found['num_steps']} steps take {whole['seconds']:.1f} s, and the whole process at most "
            f"{whole['peak_megabytes']:.0f} MB. The evaluator alone takes {alone['seconds']:.1f} s. The density of the "
            f"prior is computed once per view, in {density['seconds']:.1f} s. Processor seconds that each term adds "
            "to the "
            f"{alone['processor_seconds']:.1f} of the evaluator, as the difference of two runs:\n",
            table(tuple(name.replace("_", " ") for name in terms), [tuple(f"{value:.2f}" for value in terms.values())]),
            f"With {found['few_steps']} steps:\n",
            table(("grasps", "seconds", "processor seconds", "peak MB"), rows),
        ]
    )

"""Text and tables about the generators for benchmarks/report.py, from the JSON of benchmarks/generator.py."""

import math
from typing import Any

from tables import RESULTS, percent, read, span, table


def generator() -> str:
    """All measurements of the generators; each part if its benchmark has been run."""
    parts = {
        "generator": generators,
        "generator_ablation": ablation,
        "generator_meshes": other_objects,
        "generator_growth": growth,
    }
    return "\n".join(write(read(name)) for name, write in parts.items() if (RESULTS / f"{name}.json").exists())


def generators(found: dict[str, Any]) -> str:
    variants = found["variants"]
    name, first = next(iter(variants.items()))
    tables = [
        outcomes(variants),
        table(
            ("generator", "processor seconds", "longest", "MB", "wrist distance, mm", "wrist angle, degrees"),
            [
                (
                    name,
                    *(f"{row['processor_seconds'][of]:.1f}" for of in ("median", "max")),
                    f"{row['peak_megabytes']['max']:.0f}",
                    f"{1000 * row['wrist_distance']:.0f}",
                    f"{math.degrees(row['wrist_angle']):.0f}",
                )
                for name, row in variants.items()
            ],
        ),
        table(
            ("grasp type", *(f"{name}: {what}" for name in variants for what in ("grasps", "hold"))),
            [
                (kind, *(cell for row in variants.values() for cell in counted(row["types"][kind])))
                for kind in first["types"]
            ],
        ),
        table(
            ("category", "scenes", *(f"{name}: {what}" for name in variants for what in ("hold", "first holds"))),
            [
                (
                    kind,
                    row["scenes"],
                    *(
                        share(other["categories"][kind][key])
                        for other in variants.values()
                        for key in ("success", "top1")
                    ),
                )
                for kind, row in first["categories"].items()
            ],
        ),
    ]
    against = [
        f"`{other}` against `{row['against']['variant']}` on the same {row['against']['scenes']} scenes: "
        f"{points(row['against']['success'])} for all grasps, {points(row['against']['top1'])} for the first.\n"
        for other, row in variants.items()
        if "against" in row
    ]
    return "\n".join(
        [
            f"`benchmarks/generator.py`; {first['scenes']} scenes of {first['objects']} {found['split']} objects, one "
            f"view and at most {found['num_grasps']} grasps each, one trial of each grasp; intervals are 95 % "
            f"bootstrap over scenes. The successful grasps of `{name}` have {first['types_among_successes']} types. "
            "The "
            f"success rate of the first grasp of a scene exceeds that of all grasps by "
            f"{points(first['top1_above_all'])}.\n",
            *tables[:1],
            *against,
            f"Processor time per view, median and longest (threads: {found['threads']}; for wall times see Cost), peak "
            "memory of the whole process, and mean difference between the wrist poses of two grasps of a scene:\n",
            *tables[1:],
        ]
    )


def outcomes(variants: dict[str, Any]) -> str:
    """Success of each variant's grasps; a scene without a grasp counts as a failure of the first grasp."""
    head = ("generator", "scenes", "without a grasp", "grasps", "hold", "first holds", "first five hold")
    rows = [
        (
            name,
            row["scenes"],
            row["without_grasp"],
            f"{row['grasps']:,}",
            *(rate(row[key]) for key in ("success", "top1", "top5")),
            share(row["collided"]),
            share(row["starts_inside"]),
            *("" if row[key] is None else f"{row[key]:.3f}" for key in ("auroc", "auroc_within_scenes")),
        )
        for name, row in variants.items()
    ]
    return table((*head, "hit the table", "start inside", "AUROC of the likelihood", "within scenes"), rows)


def ablation(found: dict[str, Any]) -> str:
    first = next(iter(found["variants"].values()))
    rows = [
        (
            name,
            points(row["against"]["success"]),
            points(row["against"]["top1"]),
            row["without_grasp"],
            f"{row['processor_seconds']['median']:.1f}",
        )
        for name, row in found["variants"].items()
        if "against" in row
    ]
    return (
        "### Ablations\n\n"
        f"On {first['scenes']} scenes, at most {found['num_grasps']} grasps each; all variants are compared with the "
        "complete generator on the same scenes.\n\n"
        + outcomes(found["variants"])
        + "\n"
        + table(
            ("against the complete generator", "hold", "first holds", "scenes without a grasp", "processor seconds"),
            rows,
        )
    )


def other_objects(found: dict[str, Any]) -> str:
    variants = found["variants"]
    first = next(iter(variants.values()))
    keys = ("grasps", "success", "top1")
    rows = [
        (
            name,
            *(
                row["categories"][name][key] if key == "grasps" else share(row["categories"][name][key])
                for row in variants.values()
                for key in keys
            ),
        )
        for name in first["categories"]
    ]
    head = tuple(f"{name}: {what}" for name in variants for what in ("grasps", "hold", "first holds"))
    return (
        "### On external objects\n\n"
        f"{first['objects']} scans and CAD models of household objects that are not part of dexzoo, {first['scenes']} "
        "scenes, 0.2 kg, friction 0.7.\n\n" + outcomes(variants) + "\n" + table(("object", *head), rows)
    )


def growth(found: dict[str, Any]) -> str:
    rows = [
        (
            name,
            f"{row[name]:,}",
            f"{row['seconds']:.1f}",
            f"{row['processor_seconds']:.1f}",
            f"{row['peak_megabytes']:.0f}",
        )
        for name in ("num_samples", "num_kernels")
        for row in found[name]
    ]
    return (
        f"### Cost\n\nMedian over {found['scenes']} views; threads: {found['threads']}. The other parameter keeps its "
        "default. Memory is the peak of the whole process.\n\n"
        + table(("", "number", "seconds", "processor seconds", "peak MB"), rows)
    )


def counted(row: dict[str, Any]) -> tuple[str, str]:
    return f"{row['grasps']:,}", share(row["success"])


def share(value: float | None) -> str:
    """A share in percent; empty for None."""
    return "" if value is None else percent(value)


def rate(found: dict[str, Any]) -> str:
    """A rate with its interval."""
    return f"{share(found['rate'])} ({span(found['interval'], 100, 1)})"


def points(change: dict[str, Any]) -> str:
    return f"{100 * change['rate']:+.1f} ({span(change['interval'], 100, 1)}) points"

"""What benchmarks/report.py writes of the generators, from the JSON of benchmarks/generator.py."""

import math
from typing import Any

from tables import RESULTS, percent, read, span, table


def generator() -> str:
    """What has been measured of the generators; each part as soon as its benchmark has been run."""
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
            ("generator", "processor seconds", "longest", "MB", "wrists apart, mm", "and degrees"),
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
            f"bootstrap over scenes. The grasps of `{name}` that hold are of {first['types_among_successes']} types, "
            f"and the first of a scene holds {points(first['top1_above_all'])} more often than all do.\n",
            *tables[:1],
            *against,
            f"Time of a view, median and longest (threads: {found['threads']}; wall times stand under Cost), most "
            "memory of the process with all that it has loaded, and how far the wrists of two grasps of a scene differ "
            "on average:\n",
            *tables[1:],
        ]
    )


def outcomes(variants: dict[str, Any]) -> str:
    """How often the grasps of each variant hold; a scene without a grasp counts as a first that fails."""
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
        "### Without its parts\n\n"
        f"On {first['scenes']} scenes, at most {found['num_grasps']} grasps each; all against the whole on the same "
        "scenes.\n\n"
        + outcomes(found["variants"])
        + "\n"
        + table(("against the whole", "hold", "first holds", "scenes without a grasp", "processor seconds"), rows)
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
        "### On objects from elsewhere\n\n"
        f"{first['objects']} scanned and CAD household objects that are no part of dexzoo, {first['scenes']} scenes, "
        "0.2 kg, friction 0.7.\n\n" + outcomes(variants) + "\n" + table(("object", *head), rows)
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
        f"### Cost\n\nMedian over {found['scenes']} views; threads: {found['threads']}. The other number stays at its "
        "default. Memory is that of the process with all that it has loaded.\n\n"
        + table(("", "number", "seconds", "processor seconds", "MB at most"), rows)
    )


def counted(row: dict[str, Any]) -> tuple[str, str]:
    return f"{row['grasps']:,}", share(row["success"])


def share(value: float | None) -> str:
    """In percent; nothing where there was nothing to count."""
    return "" if value is None else percent(value)


def rate(found: dict[str, Any]) -> str:
    """With its interval."""
    return f"{share(found['rate'])} ({span(found['interval'], 100, 1)})"


def points(change: dict[str, Any]) -> str:
    return f"{100 * change['rate']:+.1f} ({span(change['interval'], 100, 1)}) points"

"""Write the numbers of README.md and docs/results.md from benchmarks/results/*.json.

python benchmarks/report.py
"""

from typing import Any

from evaluator_report import evaluators, valued
from generator_report import generator, points, rate
from refine_report import refinement
from tables import ROOT, percent, read, table, with_figures


def main() -> None:
    readme = ROOT / "README.md"
    readme.write_text(with_figures(readme.read_text(), summary()))
    (ROOT / "docs" / "results.md").write_text(page())
    card = ROOT / "docs" / "data.md"
    card.write_text(with_figures(card.read_text(), counts()))
    views = ROOT / "docs" / "sensor.md"
    views.write_text(with_figures(views.read_text(), sensor()))
    sheet = ROOT / "docs" / "objects.md"
    sheet.write_text(with_figures(sheet.read_text(), objects()))
    shapes = ROOT / "docs" / "families.md"
    shapes.write_text(with_figures(shapes.read_text(), families()))
    grasps = ROOT / "docs" / "generator.md"
    grasps.write_text(with_figures(grasps.read_text(), generator()))
    refined = ROOT / "docs" / "refinement.md"
    refined.write_text(with_figures(refined.read_text(), refinement()))


def summary() -> str:
    generated = read("comparison")["sources"]["generated"]
    best, gm = (generated["rows"][name]["figures"] for name in ("em_fk", "gm"))
    refined = read("refinement")["variants"]
    method, ascent = refined["method"], refined["group A"]
    meshes = read("refinement_meshes")["variants"]["method"]
    first = method["top1"]["before"]

    def of_hundred(figure: dict[str, Any]) -> str:
        return rate(figure | {"rate": figure["value"]})

    rows = [
        (
            f"success rate of all generated grasps, in {generated['scenes']} scenes with at least one grasp that holds",
            percent(generated["success_rate"]),
        ),
        ("success rate of the first grasp of each scene, in the generator's order", of_hundred(gm["top1"])),
        ("the same, in the order of `em_fk`", of_hundred(best["top1"])),
        ("accuracy of `em_fk` on all generated grasps", of_hundred(best["accuracy"])),
        ("AUROC of `em_fk`", valued(best["auroc"], 1, 3)),
        (
            f"success rate of all {method['grasps']:,} generated grasps in {method['scenes']} scenes",
            rate(method["success_before"]),
        ),
        ("the same grasps, refined", rate(method["success_after"])),
        ("change", points(method["change"])),
        ("change by the gradient ascent of Zhao (2019), group A", points(ascent["change"])),
        (
            "success rate of the first grasp of each scene in the order of `em_fk`, as generated",
            rate(first["unrefined"]),
        ),
        ("the same, refined", rate(first["refined"])),
        ("change", points(first["change"])),
        (
            "grasps that hit the table or a block, as generated and refined",
            f"{method['collided_before']} and {method['collided_after']}",
        ),
        (
            f"success rate of {meshes['grasps']} grasps on {meshes['objects']} external objects (scans and CAD models)",
            rate(meshes["success_before"]),
        ),
        ("the same, refined", rate(meshes["success_after"])),
    ]
    return table(("measure, on test objects", "value (95 % interval over scenes)"), rows)


def counts() -> str:
    data = read("data")
    objects = ", ".join(f"{count} {split}" for split, count in data["objects"].items())
    lines = [
        f"{data['grasps']:,} grasps in {data['scenes']:,} scenes with {data['views']:,} views, {data['megabytes']:.0f} "
        f"MB; objects: {objects}. {percent(data['hold'])} hold; {data['collided']:,} hit the table or a block, "
        f"{data['starts_inside']} start inside the object, {data['unstable']} are unstable. "
        f"{data['duplicates']} are duplicates, {data['outside_limits']} exceed the joint limits.\n",
        f"Skipped scenes: {skipped(data['skipped'])}. With their grasps, {percent(data['hold_of_all_generated'])} "
        "of all generated grasps hold.\n",
    ]
    names = {
        "split": "split",
        "source": "source and split",
        "category": "category",
        "type": "type",
        "rank": "rank",
    }
    for name, head in names.items():
        rows = [(value, f"{row['grasps']:,}", percent(row["hold"])) for value, row in data[f"by_{name}"].items()]
        lines.append(table((head, "grasps" if name in ("split", "source") else "generated grasps", "hold"), rows))
    again = data.get("tried_again")
    if again:
        lines.append(
            f"{again['grasps']} grasps tried again: {percent(again['agree_at_working_setting'])} of the labels are "
            f"reproduced at the working setting, {percent(again['agree_at_reference_setting'])} at the reference "
            f"setting ({1000 * again['reference']['timestep']:g} ms).\n"
        )
    made = data["configuration"]
    physics = ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in made["physics"].items())
    lines.append(
        f"Settings: generator {made['generator']}, {made['num_grasps']} requested grasps and {made['num_views']} "
        "views per "
        f"scene, seed {made['seed']}, {made['trials']} trial(s) of each grasp; physics: {physics}.\n"
    )
    return "\n".join(lines)


def skipped(reasons: dict[str, int]) -> str:
    return ", ".join(f"{count} ({reason})" for reason, count in reasons.items()) or "none"


def sensor() -> str:
    frames, views = read("sensor"), read("views")
    real, simulated = frames["real"], frames["simulated"]
    measures = {
        "depth_std_mm": "deviation from the table's plane, std, mm",
        "local_std_mm": "the same without variation over more than about 20 pixels",
        "local_std_disparity": "the latter in pixels of disparity (focal length 574 pixels, baseline 75 mm)",
        "correlation_length_x": "correlation length along a row (to one half), pixels",
        "correlation_length_y": "correlation length along a column, pixels",
        "step_mm": "step between neighboring depth values, mm",
    }
    noise = [
        (name if key == "depth_std_mm" else "", label, row[key], simulated["table"][name][key])
        for name, row in real["table"].items()
        for key, label in measures.items()
    ]
    shares = [(name, percent(value), percent(simulated["missing"][name])) for name, value in real["missing"].items()]
    holes = [
        (f"holes, {name}", value, simulated["holes"][name])
        if name.startswith("number")
        else (name, percent(value), percent(simulated["holes"][name]))
        for name, value in real["holes"].items()
    ]
    times = [(name, *row.values()) for name, row in views["milliseconds"].items()]
    return "\n".join(
        [
            f"`benchmarks/sensor.py`: {frames['real_frames']} real frames, {frames['simulated_frames']} simulated "
            "frames "
            "of mugs, bowls and bottles with the same intrinsics, height, angle and distance.\n",
            table(("noise on the table at", "", "real", "simulated"), noise),
            table(("pixels without a reading", "real", "simulated"), shares),
            table(("within objects", "real", "simulated"), holes),
            "`benchmarks/views.py`: one object of each of the 20 categories, "
            f"{views['views_of_each']} views of each, one core. The rays of an ideal 460 x 460 view alone take "
            f"{views['rays alone by mujoco.mj_multiRay, 460 x 460']} ms with MuJoCo's ray caster.\n",
            table(("milliseconds per view", "median", "slowest category's median", "slowest view"), times),
        ]
    )


def objects() -> str:
    found = read("objects")
    rows = [
        (
            name,
            row["train"],
            row["validation"],
            row["test"],
            between(row["longest_side_mm"]),
            between(row["shortest_side_mm"]),
            between(row["parts"]),
            row["worst_surface_distance_mm"],
        )
        for name, row in found["categories"].items()
    ]
    head = ("train", "validation", "test", "longest side, mm", "shortest side, mm", "convex parts", "distance, mm")
    return (
        f"`benchmarks/objects.py`: {found['objects']} objects with at most {found['most_parts']} convex parts each. "
        "The "
        f"surface of the parts is within {found['worst_surface_distance_mm']:.2f} mm of the mesh everywhere (two-sided "
        f"Hausdorff distance). All objects take {found['seconds_to_make_all']:.0f} s to make.\n\n"
    ) + table(("category", *head), rows)


def families() -> str:
    found = read("families")
    rows = [
        (
            f"[{name}](families/{name}.png)",
            row["seconds_each"],
            between(row["parts"][::2]),
            between([round(length) for length in row["longest_side_mm"][::2]]),
            row["worst_surface_distance_mm"],
            percent(row["rests"]),
            percent(row["can_be_spanned"]),
        )
        for name, row in found["families"].items()
    ]
    head = (
        "s per object",
        "convex parts",
        "longest side, mm",
        "distance, mm",
        "come to rest",
        "fit between the fingers",
    )
    return f"`benchmarks/families.py`, {found['seeds']} objects of each family.\n\n" + table(("family", *head), rows)


def between(values: list[int]) -> str:
    low, high = values
    return str(low) if low == high else f"{low} to {high}"


def labels(found: dict[str, Any]) -> str:
    """Reliability of the labels, and speed of the trials."""
    curves, timed, creep = found["agreement_with_itself_when_moved"], found["timed"], found["creep"]
    slid, true = creep["working"], creep["reference"]
    names = {
        "working": "working setting, used for labels",
        "reference": "reference setting",
        "plain, same steps": "plain loop over one MjData, steps of the working setting",
        "plain, uniform steps": "plain loop, 2 ms and noslip from start to end",
    }
    moved = [
        (name, *(f"{percent(curve[offset]['agree'])} of {curve[offset]['grasps']:,}" for offset in curve))
        for name, curve in curves.items()
    ]
    speed = [
        (
            names[name],
            f"{row['trials_per_second']:.1f}",
            f"{row['processor_seconds_per_trial']:.3f}",
            f"{row['working_is_faster_by']:.1f}",
            f"{row['processor_seconds_per_trial'] / timed['ways']['working']['processor_seconds_per_trial']:.2f}",
            percent(row["agrees_with_working"]),
        )
        for name, row in timed["ways"].items()
    ]
    batches = found["processor_seconds_per_trial_in_batches_of"]
    categories = [(name, *row.values()) for name, row in found["categories"].items()]
    return "\n".join(
        [
            f"`benchmarks/simulator.py`; {found['grasps']:,} grasps of {found['objects']} objects, "
            f"{percent(found['hold'])} hold; {found['unstable']} are unstable. The working setting (2 ms until the "
            "lift, then 4 ms, ends when the object is lost) and the reference setting (1 ms, noslip, to the end) agree "
            f"on {percent(found['working_agrees_with_reference'])} of the labels; "
            f"{found['held_at_the_reference_only']} grasps hold at the reference setting only, "
            f"{found['held_at_the_working_setting_only']} at the working setting only. The agreement of a setting with "
            "itself after small displacements of the wrist measures the reliability of labels:\n",
            table(("displacement", *curves["working"]), moved),
            f"{timed['grasps']} grasps of {timed['objects']} objects, {percent(timed['hold'])} hold, on "
            f"{timed['threads']} "
            "threads (the plain loops on one):\n",
            table(
                (
                    "trials of the same grasps",
                    "per second",
                    "processor seconds each",
                    "time relative to working",
                    "processor time relative to working",
                    "labels equal to working",
                ),
                speed,
            ),
            "Processor seconds per trial by batch size:\n",
            table(tuple(batches), [tuple(f"{cost:.3f}" for cost in batches.values())]),
            f"The objects of {creep['grasps']} grasps, held for another {creep['seconds']:.0f} s, slide by "
            f"{slid['median_mm']:.2f} mm in the median; {percent(slid['share_below_2_mm'])} slide by less than 2 mm, "
            f"and the maximum is {slid['farthest_mm']:.1f} mm. At the reference setting the values are "
            f"{true['median_mm']:.2f} mm, {percent(true['share_below_2_mm'])} and {true['farthest_mm']:.1f} mm.\n",
            "Share of the time of a step, with the object held:\n",
            table(tuple(found["profile"]), [tuple(percent(share) for share in found["profile"].values())]),
            "Grasps by category, and number of grasps on which the two settings disagree:\n",
            table(("category", "objects", "grasps", "hold", "disagree"), categories),
        ]
    )


def page() -> str:
    kinematics, collect = read("kinematics"), read("collect")
    parts = [
        "# Results\n\n`benchmarks/report.py` writes this page from the JSON in `benchmarks/results/`. Intervals are "
        "95 % "
        "bootstrap over scenes.\n",
        evaluators(),
        "## Refinement\n\nSee [refinement.md](refinement.md).\n",
        "## Labels\n\n" + labels(read("simulator")),
        f"## The hand\n\n`benchmarks/kinematics.py`, {kinematics['threads']} threads; all links of "
        f"{kinematics['kinematics']['batch']:,} postures, against pytorch_kinematics "
        f"{kinematics['pytorch_kinematics']} in the same run.\n",
        table(
            ("postures per second", "dexzoo", "pytorch_kinematics", "ratio"),
            [
                (
                    name.replace("_", " "),
                    f"{row['ours']:,}",
                    f"{row['pytorch_kinematics']:,}",
                    kinematics["kinematics"]["ratio"][name],
                )
                for name, row in kinematics["kinematics"]["postures_per_second"].items()
            ],
        ),
        f"Distances of {kinematics['distances']['grasps']} grasps x {kinematics['distances']['waypoints']} waypoints "
        f"to {kinematics['distances']['points']:,} points, among the links and to the table:\n",
        table(
            ("seconds", "forward", "with gradient"),
            [
                (name.replace("_", " "), row["forward"], row["forward_and_backward"])
                for name, row in kinematics["distances"]["seconds"].items()
            ],
        ),
        f"## Collection\n\n`benchmarks/collect.py`; {collect['scenes']} small scenes with the {collect['generator']} "
        f"generator on {collect['processors']} processors.\n",
        table(
            ("scenes made by", "per hour", "same files as with one worker"),
            [
                (name, f"{value:,.0f}", {True: "yes", False: "no", None: ""}[same])
                for (name, value), same in zip(
                    collect["scenes_per_hour"].items(),
                    (None, collect["same_files_as_1_worker"]["2"], collect["same_files_as_1_worker"]["ray"]),
                    strict=True,
                )
            ],
        ),
        f"Speedup with two workers: {collect['two_over_one']:.2f}. After {len(collect['kills'])} kills at random "
        "moments and "
        "restarts, the collection ended with "
        f"{'the same' if collect['same_files_as_1_worker']['killed'] else 'other'} files. Grasps loaded per second, by "
        "batch size: "
        + ", ".join(f"{size}: {value:,.0f}" for size, value in collect["grasps_loaded_per_second"].items())
        + ".\n",
    ]
    return "\n".join(parts)


if __name__ == "__main__":
    main()

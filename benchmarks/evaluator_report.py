"""What benchmarks/report.py writes of the evaluators, from the JSON of several benchmarks."""

from collections.abc import Iterable
from typing import Any

from generator_report import share
from tables import RESULTS, percent, read, span, table

from dexzoo.comparison.compare import GENERATED
from dexzoo.comparison.report import NOTES, against_em2, cost_table, counts_table, main_table, title
from dexzoo.models.zoo import shipped_card

THESIS = {
    "gm": {"top1": 1070 / 1539},
    "em1": {"accuracy": 76906 / 99521, "top1": 1350 / 1539, "failures_removed": (330 - 50) / 469},
    "em2": {"accuracy": 78286 / 99521, "top1": 1381 / 1539, "failures_removed": (354 - 43) / 469},
}
"""The thesis' Tables 3.3 and 3.4: 99,521 grasps of unseen objects in 1,539 scenes, 51,711 of which hold."""
WITHOUT, LESS_DATA, VARIANT = "-", "@", "+"
"""In the name of a run of benchmarks/ablation.py: without an ingredient, on so many percent of the data, otherwise."""


def evaluators() -> str:
    """All that has been measured of the evaluators; each part as soon as its benchmark has been run."""
    parts = {
        "comparison": comparison,
        "repeated": repeated,
        "evaluators_meshes": meshes,
        "ablation": ablation,
        "training": training,
    }
    return "\n".join(write(read(name)) for name, write in parts.items() if (RESULTS / f"{name}.json").exists())


def comparison(found: dict[str, Any]) -> str:
    """The comparison's own tables, and its charts."""
    chosen_on = read("data")["by_source"][f"{GENERATED}, validation"]
    parts = [
        "## Evaluators\n",
        f"`benchmarks/comparison.py`. {NOTES}",
        f"Probabilities were calibrated on {chosen_on['grasps']:,} {GENERATED} grasps of the validation objects, "
        f"{percent(chosen_on['hold'])} of which hold.\n",
        *of_other_data(found),
    ]
    for source, section in found["sources"].items():
        parts += [f"{title(source, section)}:\n", table(*main_table(section))]
        if source == GENERATED:
            parts += [grasps_seen(section["rows"]), table(*counts_table(section))]
            parts += [*against_em2(section), beside_thesis(section)]
    parts += [
        table(*cost_table(found["cost"])),
        "![Success by place in the ranking](comparison/rank.png)\n",
        "![Calibration](comparison/reliability.png)\n",
        "![Success of the first grasp by category](comparison/categories.png)\n",
        "What `em2` makes of an image: its three channels, and the feature maps of the frozen trunk that vary most "
        "(thesis, Fig. 3.5).\n",
        "![Feature maps of em2](comparison/em2_maps.png)\n",
        "The same image in `em_fk`, whose small pyramid was trained with the rest.\n",
        "![Feature maps of em_fk](comparison/em_fk_maps.png)\n",
        "About a thousand grasps as first two principal components: as the 280 numbers that `em2` is given, and as "
        "what its hand branch makes of them (Fig. 3.6), by outcome and by type. The branch sees no image.\n",
        "![Grasps in em2](comparison/em2_grasps.png)\n",
        "The same of `em_fk`, which has no such branch: what its last layer is given, where grasp and image are "
        "joined.\n",
        "![Grasps in em_fk](comparison/em_fk_grasps.png)\n",
    ]
    return "\n".join(parts)


def beside_thesis(section: dict[str, Any]) -> str:
    """The thesis' figures and those of its models here."""
    rows = []
    for name, thesis in THESIS.items():
        if name in section["rows"]:
            row = section["rows"][name]
            here = {key: row["figures"][key]["value"] for key in ("accuracy", "top1")}
            if "against_gm" in row:
                here["failures_removed"] = row["against_gm"]["top1"]["failures_removed"]["value"]
            keys = ("accuracy", "top1", "failures_removed")
            rows.append([name, *(share(some.get(key)) for key in keys for some in (thesis, here))])
    head = ("", "accuracy, thesis", "here", "top-1, thesis", "here", "gm's top-1 failures removed, thesis", "here")
    return (
        "Beside the thesis, whose test set has 99,521 grasps in 1,539 scenes, 52.0 % of which hold (its Tables 3.3 and "
        f"3.4), where here {percent(section['success_rate'])} do. In training its networks saw 19 million grasps:\n\n"
    ) + table(head, rows)


def grasps_seen(names: Iterable[str]) -> str:
    """How many grasps each model saw in training, as far as its card tells."""
    cards = {name: found for name in names if (found := shipped_card(name)) and found.get("grasps_seen")}
    seen = ", ".join(f"`{name}` {found['grasps_seen']:,}" for name, found in cards.items())
    return f"Grasps seen in training, each time that one was drawn counted: {seen}.\n"


def of_other_data(found: dict[str, Any]) -> list[str]:
    """What has to be known of models that have learnt from another grasp set than the one compared on."""
    told = []
    for name in found["weights"]:
        data = (shipped_card(name) or {}).get("data", {})
        if data and data.get("sha256") != found["data"]["sha256"]:
            told.append(f"`{name}` has learnt from {data['train_grasps']:,} grasps of another, earlier set.\n")
    return told


def repeated(found: dict[str, Any]) -> str:
    """How far an outcome can be foreseen, and how far evaluators do."""
    return (
        f"### How far an outcome can be foreseen\n\n`benchmarks/repeated.py`; {found['grasps']:,} generated grasps in "
        f"{found['scenes']} scenes of {found['objects']} test objects, each tried {found['trials']} times under drawn "
        f"mass, friction and wrist error: {percent(found['always_the_same'])} always hold or always fail, the mean "
        f"rate is {percent(found['mean_rate'])}, and {percent(found['hold_as_they_are'])} hold when tried as they are. "
        "Every trial is a label; what foresees it best lies between the rate of all trials, which knows the trial "
        "itself, and that of the others. Evaluators have learnt from trials of grasps as they are.\n\n"
    ) + table(
        ("foreseen by", "accuracy, %", "AUROC", "Brier", "calibration error"),
        [
            (
                name,
                valued(row["accuracy"], 100, 1),
                *(valued(row[key], 1, 3) for key in ("auroc", "brier")),
                f"{row['calibration_error']['value']:.3f}",
            )
            for name, row in found["rows"].items()
        ],
    )


def meshes(found: dict[str, Any]) -> str:
    """The comparison on objects that are no part of dexzoo, and what became of each object's grasps."""
    section, objects = found["sources"][GENERATED], found["objects"]
    rows = section["rows"]
    scenes, tried = (sum(one[key] for one in objects.values()) for key in ("with_one_that_holds", "with_grasps"))
    without = "; ".join(f"{name} ({', '.join(why)})" for name, why in found["objects_without_grasps"].items())
    return "\n".join(
        [
            "### On objects from elsewhere\n\n`benchmarks/meshes.py`; scanned and CAD household objects that are no "
            "part of dexzoo, 0.2 kg, friction 0.7, the default generator's grasps on one view of each scene. At least "
            f"one grasp holds in {scenes} of {tried} scenes with grasps, which bounds every top-1. There is no "
            "validation split to choose a threshold for gm on; scenes of one object are alike, so that intervals are "
            "too narrow. "
            f"Objects without any grasp: {without or 'none'}.\n\n"
            f"{title(GENERATED, section)}:\n",
            table(*main_table(section)),
            table(
                ("object", "scenes", "grasps", "hold", "hit the table", *(f"first of {name} holds" for name in rows)),
                [
                    (
                        name,
                        one["scenes"],
                        one["grasps"],
                        one["hold"],
                        one["collided"],
                        *(first(row["by_category"].get(name)) for row in rows.values()),
                    )
                    for name, one in objects.items()
                ],
            ),
        ]
    )


def first(of_object: dict[str, Any] | None) -> str:
    return f"{of_object['top1'] * of_object['scenes']:.0f} of {of_object['scenes']}" if of_object else ""


def ablation(found: dict[str, Any]) -> str:
    """Ingredients, the learning curve, and variants."""
    runs = found["runs"]
    texts = {
        WITHOUT: "What each ingredient brings; a minus stands for without:",
        LESS_DATA: "With 10, 30 and 100 % of the training scenes:",
        VARIANT: "With refined grasps besides; with another seed, which tells what chance brings; with the width of "
        "the thesis' table; with the thesis' dropout, 0.5; and by the thesis' recipe, cut to as many grasps as the "
        "others see:",
    }
    sizes = ", ".join(f"{size['grasps']:,} {source}" for source, size in found["test"].items())
    seen = " or ".join(f"{count:,}" for count in sorted({row["grasps_seen"] for row in runs.values()}))
    parts = [
        f"### Ingredients, data, width and recipe\n\n`benchmarks/ablation.py`; each run sees {seen} grasps in "
        f"training, the weights are the best on validation; test objects, {sizes} grasps. Changes are from the run "
        "that stands first of its kind, with their intervals over the same draws of scenes; one seed each.\n"
    ]
    for mark, text in texts.items():
        changed = sorted(name for name in runs if mark in name)
        wholes = dict.fromkeys(name.split(mark)[0] for name in changed)
        names = [name for whole in wholes for name in (whole, *changed) if name.split(mark)[0] == whole]
        if names:
            parts += [text + "\n", runs_table({name: runs[name] for name in names if name in runs})]
        if mark == WITHOUT:
            parts += ingredients(runs)
        if mark == LESS_DATA:
            parts += account(runs)
    return "\n".join(parts)


def ingredients(runs: dict[str, Any]) -> list[str]:
    """Which of em_fk's ingredients it is the worse without, by the interval of the change in AUROC."""
    changes = {
        name.removeprefix(f"em_fk{WITHOUT}"): row["change"][GENERATED]["auroc"]
        for name, row in runs.items()
        if name.startswith(f"em_fk{WITHOUT}")
    }

    def told(worse: bool) -> str:
        some = [(change["value"], name) for name, change in changes.items() if (change["interval"][1] < 0) == worse]
        return ", ".join(f"`{name}` ({value:+.3f})" for value, name in sorted(some)) or "none of the others"

    if not changes:
        return []
    other = runs.get("em_fk+seed")
    chance = f" Another seed alone changes it by {other['change'][GENERATED]['auroc']['value']:+.3f}." if other else ""
    return [
        f"The AUROC of `em_fk` falls by more than the scenes' chance without {told(True)}; in training of this length "
        f"it does not without {told(False)}.{chance}\n"
    ]


def account(runs: dict[str, Any]) -> list[str]:
    """Why em1 and em2 stay below the thesis' figures; nothing before the learning curve of one has been run."""
    curves = {name: (f"{name}@10", f"{name}@30", name) for name in ("em1", "em2")}
    curves = {name: curve for name, curve in curves.items() if set(curve) <= set(runs)}
    if not curves:
        return []
    section = read("comparison")["sources"][GENERATED]
    once = read("repeated")["rows"]["its one trial without disturbance"]
    told, gains = [], []
    for name, curve in curves.items():
        values = [runs[run]["figures"][GENERATED]["auroc"]["value"] for run in curve]
        shipped, card = section["rows"][name]["figures"]["auroc"]["value"], shipped_card(name) or {}
        by_scenes, by_length = values[-1] - values[0], shipped - values[-1]
        gains.append((by_scenes, by_length))
        told.append(
            f"of `{name}` is {', '.join(f'{value:.3f}' for value in values)}, so that ten times the scenes bring "
            f"{by_scenes:+.3f}; that of its shipped weights, which saw {card['grasps_seen']:,} grasps in "
            f"place of {runs[name]['grasps_seen']:,}, refined ones among them, is {shipped:.3f}, {by_length:+.3f}"
        )
    limit = (
        "the length of training limits more here than the number of scenes"
        if all(by_length > by_scenes for by_scenes, by_length in gains)
        else "the number of scenes limits at least as much here as the length of training"
    )
    gm, best = (section["rows"][name]["figures"] for name in ("gm", "em_fk"))
    return [
        "Why `em1` and `em2` stay below the thesis' figures. The grasps are harder to tell apart: the generator's own "
        f"order, which learns from no outcome, is right first in {percent(gm['top1']['value'])} of the scenes, in the "
        f"thesis in {percent(THESIS['gm']['top1'])}. The labels are not what limits: one trial foretells another of "
        f"the same grasp in {percent(once['accuracy']['value'])}, `em_fk` is right in "
        f"{percent(best['accuracy']['value'])}. With 10, 30 and 100 % of the training scenes the AUROC "
        f"{'; '.join(told)}. The thesis trained on 20,025 scenes with 1,081,332 grasps, and saw each some 18 times: "
        f"{limit}.\n"
    ]


def runs_table(runs: dict[str, Any]) -> str:
    head = (
        "run", "training grasps", "validation AUROC", "accuracy", "AUROC", "change", "top-1", "change",
        "AUROC on perturbed", "change",
    )  # fmt: skip
    return table(
        head,
        [
            (
                name,
                f"{row['train_grasps']:,}",
                f"{row['validation_auroc']:.3f}",
                figure(row, "figures", GENERATED, "accuracy", 100, 1),
                *(figure(row, key, GENERATED, "auroc", 1, 3) for key in ("figures", "change")),
                *(figure(row, key, GENERATED, "top1", 100, 1) for key in ("figures", "change")),
                *(figure(row, key, "perturbed", "auroc", 1, 3) for key in ("figures", "change")),
            )
            for name, row in runs.items()
        ],
    )


def figure(row: dict[str, Any], key: str, source: str, name: str, scale: float, digits: int) -> str:
    """A figure with its interval; a change with its sign."""
    found = row.get(key, {}).get(source)
    if found is None:
        return ""
    return valued(found[name], scale, digits, "+" if key == "change" else "")


def valued(found: dict[str, Any], scale: float, digits: int, sign: str = "") -> str:
    return f"{scale * found['value']:{sign}.{digits}f} ({span(found['interval'], scale, digits)})"


def training(found: dict[str, Any]) -> str:
    """What encoding a view once is worth."""
    learning, scoring = found["training"], found["scoring"]
    rows = [
        ("training" if part is learning else "scoring", name, f"{value:.1f}")
        for part in (learning, scoring)
        for name, value in part["seconds_for_1000_grasps"].items()
    ]
    return (
        f"### A view encoded once\n\n`benchmarks/training.py`; EM2, {found['threads']} thread(s) of "
        f"{found['processor']}. Training with kept features is {learning['ratio']:.0f} times faster than with the "
        f"trunk in the loop, and {learning['ratio_in_the_first_epoch']:.0f} times in the first epoch, which encodes "
        f"all views; scoring grasps on one view is {scoring['ratio']:.0f} times faster than pair by pair.\n\n"
    ) + table(("", "1,000 grasps with", "processor seconds"), rows)

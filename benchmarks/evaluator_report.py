"""Text and tables about the evaluators for benchmarks/report.py, from the JSON of several benchmarks."""

from collections.abc import Iterable
from typing import Any

from generator_report import share
from tables import RESULTS, percent, read, span, table

from dexzoo.comparison.compare import GENERATED
from dexzoo.comparison.report import NOTES, against_em2, cost_table, counts_table, main_table, title
from dexzoo.models.registry import shipped_card

THESIS = {
    "gm": {"top1": 1070 / 1539},
    "em1": {"accuracy": 76906 / 99521, "top1": 1350 / 1539, "failures_removed": (330 - 50) / 469},
    "em2": {"accuracy": 78286 / 99521, "top1": 1381 / 1539, "failures_removed": (354 - 43) / 469},
}
"""Zhao (2019), Tables 3.3 and 3.4: 99,521 grasps of unseen objects in 1,539 scenes; 51,711 hold."""
WITHOUT, LESS_DATA, VARIANT = "-", "@", "+"
"""Marks in the name of a run of benchmarks/ablation.py: without a component; with a percentage of the data; variant."""


def evaluators() -> str:
    """All measurements of the evaluators; each part if its benchmark has been run."""
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
        f"of which {percent(chosen_on['hold'])} hold.\n",
        *of_other_data(found),
    ]
    for source, section in found["sources"].items():
        parts += [f"{title(source, section)}:\n", table(*main_table(section))]
        if source == GENERATED:
            parts += [grasps_seen(section["rows"]), table(*counts_table(section))]
            parts += [*against_em2(section), beside_thesis(section)]
    parts += [
        table(*cost_table(found["cost"])),
        "![Success by rank](comparison/rank.png)\n",
        "![Calibration](comparison/reliability.png)\n",
        "![Success of the first grasp by category](comparison/categories.png)\n",
        "Features of `em2` for one image: its three channels, and the feature maps of the frozen trunk with the "
        "largest "
        "variance (Zhao 2019, Fig. 3.5).\n",
        "![Feature maps of em2](comparison/em2_maps.png)\n",
        "The same image in `em_fk`. Its small pyramid was trained with the rest of the model.\n",
        "![Feature maps of em_fk](comparison/em_fk_maps.png)\n",
        "First two principal components of about a thousand grasps, by outcome and by type: of the 280 input numbers "
        "of "
        "`em2`, and of the output of its hand branch (Zhao 2019, Fig. 3.6). The branch does not see the image.\n",
        "![Grasps in em2](comparison/em2_grasps.png)\n",
        "The same for `em_fk`. It has no hand branch; the second picture shows the input of its last layer, which "
        "combines "
        "grasp and image.\n",
        "![Grasps in em_fk](comparison/em_fk_grasps.png)\n",
    ]
    return "\n".join(parts)


def beside_thesis(section: dict[str, Any]) -> str:
    """The figures of Zhao (2019) and of the same models here."""
    rows = []
    for name, thesis in THESIS.items():
        if name in section["rows"]:
            row = section["rows"][name]
            here = {key: row["figures"][key]["value"] for key in ("accuracy", "top1")}
            if "against_gm" in row:
                here["failures_removed"] = row["against_gm"]["top1"]["failures_removed"]["value"]
            keys = ("accuracy", "top1", "failures_removed")
            rows.append([name, *(share(some.get(key)) for key in keys for some in (thesis, here))])
    head = ("", "accuracy, Zhao", "here", "top-1, Zhao", "here", "gm's top-1 failures removed, Zhao", "here")
    return (
        "Comparison with Zhao (2019, Tables 3.3 and 3.4). The test set there has 99,521 grasps in 1,539 scenes, of "
        "which "
        f"52.0 % hold; here {percent(section['success_rate'])} hold. The networks there saw 19 million grasps in "
        "training:\n\n"
    ) + table(head, rows)


def grasps_seen(names: Iterable[str]) -> str:
    """Number of grasps that each model saw in training, if its card has it."""
    cards = {name: found for name in names if (found := shipped_card(name)) and found.get("grasps_seen")}
    seen = ", ".join(f"`{name}` {found['grasps_seen']:,}" for name, found in cards.items())
    return f"Number of grasps seen in training, with repetitions: {seen}.\n"


def of_other_data(found: dict[str, Any]) -> list[str]:
    """A remark on each model that was trained on another grasp set than that of the comparison."""
    told = []
    for name in found["weights"]:
        data = (shipped_card(name) or {}).get("data", {})
        if data and data.get("sha256") != found["data"]["sha256"]:
            told.append(f"`{name}` was trained on {data['train_grasps']:,} grasps of another, earlier set.\n")
    return told


def repeated(found: dict[str, Any]) -> str:
    """Repeatability of outcomes, and its bound on the evaluators' accuracy."""
    return (
        f"### Repeatability of outcomes\n\n`benchmarks/repeated.py`; {found['grasps']:,} generated grasps in "
        f"{found['scenes']} scenes of {found['objects']} test objects, each tried {found['trials']} times under random "
        f"mass, friction and wrist error: {percent(found['always_the_same'])} always hold or always fail, the mean "
        f"success rate is {percent(found['mean_rate'])}, and {percent(found['hold_as_they_are'])} hold without "
        "disturbance. Every trial is a label. The best possible predictor lies between the rate of all trials, which "
        "includes the trial itself, and the rate of the other trials. Evaluators were trained on trials without "
        "disturbance.\n\n"
    ) + table(
        ("predicted by", "accuracy, %", "AUROC", "Brier", "calibration error"),
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
    """The comparison on external objects, and the outcomes by object."""
    section, objects = found["sources"][GENERATED], found["objects"]
    rows = section["rows"]
    scenes, tried = (sum(one[key] for one in objects.values()) for key in ("with_one_that_holds", "with_grasps"))
    without = "; ".join(f"{name} ({', '.join(why)})" for name, why in found["objects_without_grasps"].items())
    return "\n".join(
        [
            "### On external objects\n\n`benchmarks/meshes.py`; scans and CAD models of household objects that are not "
            "part of dexzoo, 0.2 kg, friction 0.7, the default generator's grasps on one view of each scene. At least "
            f"one grasp holds in {scenes} of {tried} scenes with grasps; this bounds every top-1. There is no "
            "validation split for the threshold of gm. Scenes of one object are correlated, so the intervals are too "
            "narrow. "
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
    """Components, the learning curve, and variants."""
    runs = found["runs"]
    texts = {
        WITHOUT: "Effect of each component; a minus marks a run without it:",
        LESS_DATA: "With 10, 30 and 100 % of the training scenes:",
        VARIANT: "Variants: refined grasps added; another seed, as a measure of chance; the width of Table 3.1, the "
        "dropout of 0.5, or the recipe of Zhao (2019), the latter with the same number of grasps seen as the others:",
    }
    sizes = ", ".join(f"{size['grasps']:,} {source}" for source, size in found["test"].items())
    seen = " or ".join(f"{count:,}" for count in sorted({row["grasps_seen"] for row in runs.values()}))
    parts = [
        f"### Ablations: components, data, width and recipe\n\n`benchmarks/ablation.py`; each run sees {seen} grasps "
        f"in training and keeps the best weights on validation; test objects, {sizes} grasps. Changes are relative to "
        "the first run of each model, with intervals over the same draws of scenes; one seed each.\n"
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
    """Components of em_fk with a significant effect, by the interval of the change in AUROC."""
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
        f"The AUROC of `em_fk` falls significantly without {told(True)}. With training of this length it does not fall "
        f"significantly without {told(False)}.{chance}\n"
    ]


def account(runs: dict[str, Any]) -> list[str]:
    """Why em1 and em2 stay below the figures of Zhao (2019); empty if no learning curve has been run."""
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
            f"of `{name}` is {', '.join(f'{value:.3f}' for value in values)}: ten times the scenes give "
            f"{by_scenes:+.3f}. "
            f"Its shipped weights saw {card['grasps_seen']:,} grasps instead of {runs[name]['grasps_seen']:,}, "
            f"including refined ones; their AUROC is {shipped:.3f}, {by_length:+.3f}"
        )
    limit = (
        "here the length of training is a stronger limit than the number of scenes"
        if all(by_length > by_scenes for by_scenes, by_length in gains)
        else "here the number of scenes is at least as strong a limit as the length of training"
    )
    gm, best = (section["rows"][name]["figures"] for name in ("gm", "em_fk"))
    return [
        "Why `em1` and `em2` stay below the figures of Zhao (2019). First, the grasps are harder to distinguish: the "
        "generator's own order, which is not trained on outcomes, has a top-1 of "
        f"{percent(gm['top1']['value'])} here and {percent(THESIS['gm']['top1'])} there. Second, the labels are not "
        "the "
        "limit: one trial predicts another trial of the same grasp with an accuracy of "
        f"{percent(once['accuracy']['value'])}, `em_fk` reaches {percent(best['accuracy']['value'])}. Third, with "
        "10, 30 "
        f"and 100 % of the training scenes, the AUROC {'; that '.join(told)}. Zhao (2019) trained on 20,025 scenes "
        "with "
        f"1,081,332 grasps and saw each about 18 times; {limit}.\n"
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
    """Gain of encoding a view once."""
    learning, scoring = found["training"], found["scoring"]
    rows = [
        ("training" if part is learning else "scoring", name, f"{value:.1f}")
        for part in (learning, scoring)
        for name, value in part["seconds_for_1000_grasps"].items()
    ]
    return (
        f"### Encoding each view once\n\n`benchmarks/training.py`; EM2, {found['threads']} thread(s) of "
        f"{found['processor']}. Training with cached features is {learning['ratio']:.0f} times faster than with the "
        f"trunk in the loop; in the first epoch, which encodes all views, {learning['ratio_in_the_first_epoch']:.0f} "
        f"times. Scoring grasps on one encoded view is {scoring['ratio']:.0f} times faster than pair by pair.\n\n"
    ) + table(("", "1,000 grasps with", "processor seconds"), rows)

"""What each command of the command line does: options in, a result for machines and a table for people out."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jsonargparse import Namespace
from rich.console import Console
from rich.progress import Progress, track
from rich.table import Table
from torch import Tensor

from dexzoo import plots
from dexzoo.camera import Observation
from dexzoo.comparison.compare import compare, load_models
from dexzoo.comparison.inside import draw_inside
from dexzoo.comparison.report import terminal_table, write
from dexzoo.data.collect import Configuration, collect
from dexzoo.data.datamodule import GraspDataModule
from dexzoo.data.grasp_set import GraspSet
from dexzoo.data.refined import Refining, collect_refined, slices, training_scenes
from dexzoo.data.writer import MANIFEST, read_manifest
from dexzoo.generators.demonstration import SHIPPED, Demonstration
from dexzoo.generators.preshape import close, read_preshapes, read_recording
from dexzoo.grasp import GRASP_TYPES, GRIP, Grasps
from dexzoo.hand import default_hand
from dexzoo.models.zoo import how_to_get, list_models, model_class, shipped_card
from dexzoo.planning import Plan, plan
from dexzoo.refinement import rank, refine
from dexzoo.sim import ObjectModel, Scene
from dexzoo.sim.shapes import make_object
from dexzoo.verification import verify
from dexzoo.viewer import view

NUM_REFINED = 20
Result = tuple[dict[str, Any], Table | None]

_err = Console(stderr=True)


def _plan(options: Namespace) -> Result:
    _check_folder(options.out)
    observation = Observation.load(options.depth, options.camera)
    with _err.status("generating, scoring and refining grasps" if options.refine else "generating and scoring grasps"):
        num_refined = NUM_REFINED if options.refine else 0
        how = options.num_grasps, num_refined, options.seed, options.generator, options.judge, options.ranking
        result = plan(observation, options.evaluator, *how)
    rows = _plan_rows(result)
    if options.out is not None:
        picture = plots.grasp_picture(observation, default_hand(), result.grasps[0])
        options.out.mkdir(parents=True, exist_ok=True)
        result.grasps.save(options.out / "grasps.safetensors")
        summary = {"frame": "camera", "T_world_camera": observation.T_world_camera.tolist(), "grasps": rows}
        (options.out / "plan.json").write_text(json.dumps(summary, indent=2) + "\n")
        plots.save(picture, options.out / "best_grasp.png")
        if options.refine:
            plots.save(_before_and_after(observation, result.given[0], result.grasps[0]), options.out / "refined.png")
    table = Table(title=f"{len(rows)} grasps, the ten best by {options.evaluator}")
    for name in ("rank", "type", "generator's rank", "score", "refined"):
        table.add_column(name, justify="left" if name == "type" else "right")
    for row in rows[:10]:
        scores = ("none" if row[name] is None else f"{row[name]:.3f}" for name in ("score", "refined"))
        table.add_row(str(row["rank"]), row["type"], str(row["generator_rank"]), *scores)
    return {"grasps": rows}, table


def _check_folder(out: Path | None) -> None:
    """Before any work is done."""
    if out is not None and out.exists() and not out.is_dir():
        raise NotADirectoryError(f"--out {out} is a file; give a folder")


def _plan_rows(result: Plan) -> list[dict[str, Any]]:
    palms = result.grasps.position[:, GRIP].tolist()
    parts = zip(
        result.grasps.grasp_type.tolist(),
        result.generator_rank.tolist(),
        _scores(result.score),
        _scores(result.refined_score),
        palms,
        strict=True,
    )
    return [
        {
            "rank": rank,
            "type": GRASP_TYPES[kind],
            "generator_rank": place + 1,
            "score": score,
            "refined": refined,
            "palm": [round(x, 4) for x in palm],
        }
        for rank, (kind, place, score, refined, palm) in enumerate(parts, 1)
    ]


def _scores(values: Tensor) -> list[float | None]:
    """Rounded; None for what is no number, which JSON does not know."""
    return [round(value, 4) if math.isfinite(value) else None for value in values.tolist()]


def _mean(values: Tensor) -> float | None:
    """Of the numbers among the values; None where there are none."""
    known = values[torch.isfinite(values)]
    return float(known.mean()) if len(known) else None


def _refine(options: Namespace) -> Result:
    for name in ("out", "picture"):
        if options[name] is not None and options[name].is_dir():
            raise IsADirectoryError(f"--{name} {options[name]} is a folder; give a file")
    observation = Observation.load(options.depth, options.camera)
    grasps = Grasps.load(options.grasps)
    with Progress(console=_err, transient=True, disable=not _err.is_terminal) as bar:
        task = bar.add_task("refining", total=len(grasps) * (options.num_steps + 1))
        result = refine(
            grasps,
            observation,
            options.evaluator,
            judge=options.judge,
            margin=options.margin,
            optimiser=options.optimiser,
            num_steps=options.num_steps,
            seed=options.seed,
            on_step=lambda _, value: bar.advance(task, len(value)),
        )
    if options.picture is not None and not len(grasps):
        _err.print(f"there are no grasps, so {options.picture} is not drawn", soft_wrap=True)
    elif options.picture is not None:
        best = int(rank(result)[0])
        plots.save(_before_and_after(observation, grasps[best], result.grasps[best]), options.picture)
    if options.out is not None:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        result.grasps.save(options.out)
    summary = {
        "num_grasps": len(grasps),
        "accepted": int(result.accepted.sum()),
        "failed": int(result.failed.sum()),
        "mean_score_before": _mean(result.score_before),
        "mean_score_after": _mean(result.score_after),
    }
    each = {
        "accepted": result.accepted.nonzero().flatten().tolist(),
        "failed": result.failed.nonzero().flatten().tolist(),
        "score_before": _scores(result.score_before),
        "score_after": _scores(result.score_after),
    }
    return summary | each, _pairs("refinement", summary)


def _before_and_after(observation: Observation, given: Grasps, refined: Grasps) -> plots.Image:
    return plots.refinement_picture(observation, default_hand(), given, refined)


def _verify(options: Namespace) -> Result:
    obj = _object(options)
    scene = Scene.place(obj, options.seed)
    observation = scene.observe(options.seed)
    if options.grasps is not None:
        grasps = Grasps.load(options.grasps)
        scores: list[float | None] = [None] * len(grasps)
        if grasps.frame != "world":
            raise ValueError(
                f"{options.grasps} holds grasps in the camera frame; save them with to_frame('world', ...)"
            )
    else:
        with _err.status("generating and scoring grasps"):
            result = plan(observation, options.evaluator, options.num_grasps, 0, options.seed, options.generator)
        grasps, scores = result.grasps, _scores(result.score)
    with _err.status("executing grasps in simulation"):
        outcomes = verify(grasps, scene, options.seed, options.trials)
    held = np.flatnonzero(outcomes.success)
    summary = {
        "object": obj.name,
        "num_grasps": len(outcomes),
        "hold": int(outcomes.success.sum()),
        "collided": int(outcomes.collided.sum()),
        "unstable": int(outcomes.unstable.sum()),
        "success_rate": float(outcomes.success_rate.mean()) if len(outcomes) else None,
        "first_that_holds": int(held[0]) + 1 if len(held) else None,
    }
    rows = [
        {"rank": rank, "type": GRASP_TYPES[kind], "score": score, "success": bool(held), "collided": bool(hit)}
        for rank, (kind, score, held, hit) in enumerate(
            zip(grasps.grasp_type.tolist(), scores, outcomes.success, outcomes.collided, strict=True), 1
        )
    ]
    return {**summary, "grasps": rows}, _pairs(f"verification of {obj.name}", summary)


def _object(options: Namespace) -> ObjectModel:
    if not Path(options.object).exists() and not Path(options.object).suffix:
        named = make_object(options.object)
        mass = named.mass if options.mass is None else options.mass
        friction = named.friction if options.friction is None else options.friction
        return ObjectModel(named.name, named.mesh, named.hulls, mass, friction, named.category)
    mass = 0.2 if options.mass is None else options.mass
    friction = 0.7 if options.friction is None else options.friction
    with _err.status("computing convex parts"):
        return ObjectModel.from_mesh(options.object, mass, friction, options.hulls)


def _collect(options: Namespace) -> Result:
    _check_folder(options.out)
    if options.refine is not None:
        return _collect_refined(options)
    configuration = Configuration(
        options.seed,
        options.split,
        options.generator,
        options.num_grasps,
        options.num_views,
        options.trials,
        options.images,
    )
    lines = collect(options.out, configuration, options.scenes, options.workers, options.ray)
    for _ in track(lines, "collecting scenes", options.scenes, console=_err, disable=not _err.is_terminal):
        pass
    counts = read_manifest((options.out / MANIFEST).read_bytes(), MANIFEST)["counts"]
    summary = {"out": str(options.out), **counts}
    return summary, _pairs("grasp set", {**counts, "skipped": sum(counts["skipped"].values()), "out": options.out})


def _collect_refined(options: Namespace) -> Result:
    how = Refining(options.refine, options.round, options.seed, options.num_grasps)
    lines, total = collect_refined(options.out, how, options.workers), len(slices(training_scenes(options.out)))
    for _ in track(lines, "refining and trying", total, console=_err, disable=not _err.is_terminal):
        pass
    grasps = GraspSet(options.out)
    refined = grasps.source == "refined"
    summary = {
        "out": str(options.out),
        "refined": int(refined.sum()),
        "held": int(grasps.success[refined].sum()),
    }
    return summary, _pairs("refined grasps, of all rounds", summary)


def _compare(options: Namespace) -> Result:
    _check_folder(options.out)
    models, data = load_models(options.models), GraspDataModule(options.data)
    result = compare(models, data, options.split, options.seed)
    if options.out is not None:
        write(result, options.out, draw_inside(models, data, options.split, options.out))
    return result, terminal_table(result)


def _demonstrate(options: Namespace) -> Result:
    _check_folder(options.out)
    if (options.recording is None) != (options.mesh is None) or (options.recording and options.preshapes):
        raise ValueError("demonstrate takes --preshapes, or --recording together with --mesh")
    hand = default_hand()
    if options.recording is not None:
        obj = ObjectModel.from_mesh(options.mesh)
        shown = [(obj, read_recording(options.recording, hand))]
    else:
        preshapes = options.preshapes or SHIPPED / "preshapes.yaml"
        shown = []
        for preshape in read_preshapes(preshapes, hand):
            obj = make_object(preshape.object)
            shown.append((obj, close(preshape, obj.mesh, hand)))
    rows = []
    table = Table("demonstration", "object", "holds", title="demonstrations, each tried ten times")
    for obj, grasp in track(shown, "trying demonstrations", console=_err, disable=not _err.is_terminal):
        name = GRASP_TYPES[int(grasp.grasp_type[0])]
        demonstration = Demonstration.record(grasp, obj.mesh, hand, obj.name)
        scene = Scene.place(obj, options.seed)
        rate = verify(grasp.moved(scene.T_world_object), scene, options.seed, trials=10).success_rate
        options.out.mkdir(parents=True, exist_ok=True)
        demonstration.save(options.out / f"{name}.safetensors")
        rows.append({"name": name, "object": obj.name, "success_rate": round(float(rate[0]), 2)})
        table.add_row(name, obj.name, f"{rate[0]:.0%}")
    return {"demonstrations": rows}, table


def _view(options: Namespace) -> Result:
    view(options.hand, options.side, options.port, options.seed)
    return {}, None


def _models(options: Namespace) -> Result:
    rows = []
    missing = []
    table = Table(title="evaluative models", caption_justify="left")
    for heading in ("name", "what", "weights", "validation AUROC"):
        table.add_column(heading)
    for name in list_models():
        what = (model_class(name).__doc__ or "").splitlines()[0].rstrip(".")
        card = shipped_card(name)
        auroc = None if card is None else card.get("metrics", {}).get("validation_auroc")
        rows.append({"name": name, "what": what, "shipped": card is not None, "validation_auroc": auroc})
        table.add_row(name, what, "none" if card is None else "shipped", "" if auroc is None else f"{auroc:.3f}")
        if card is None:
            missing.append(f"{name}: {how_to_get(name)}")
    table.caption = "\n".join(missing)
    return {"models": rows}, table


def _pairs(title: str, values: dict[str, Any]) -> Table:
    table = Table("", "", title=title, show_header=False)
    for name, value in values.items():
        table.add_row(name.replace("_", " "), f"{value:.3f}" if isinstance(value, float) else str(value))
    return table


COMMANDS: dict[str, Callable[[Namespace], Result]] = {
    "plan": _plan,
    "refine": _refine,
    "verify": _verify,
    "collect": _collect,
    "compare": _compare,
    "demonstrate": _demonstrate,
    "view": _view,
    "models": _models,
}

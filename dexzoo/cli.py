"""The command line: python -m dexzoo COMMAND. Exit status 0 done, 1 the work failed, 2 the call was wrong."""

from __future__ import annotations

import difflib
import json
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jsonargparse import ArgumentError, ArgumentParser, Namespace
from jsonargparse.typing import NonNegativeInt, PositiveInt
from rich.console import Console
from rich.progress import track
from rich.table import Table

from dexzoo import plots, training
from dexzoo.camera import Observation
from dexzoo.comparison.compare import compare, load_models
from dexzoo.comparison.inside import draw_inside
from dexzoo.comparison.report import terminal_table, write
from dexzoo.data.collect import ALL, Configuration, collect
from dexzoo.data.datamodule import GraspDataModule
from dexzoo.data.schema import SPLITS
from dexzoo.data.writer import MANIFEST, read_manifest
from dexzoo.generators import list_generators
from dexzoo.generators.demonstration import SHIPPED, Demonstration
from dexzoo.generators.preshape import close, read_preshapes, read_recording
from dexzoo.grasp import GRASP_TYPES, GRIP, Grasps
from dexzoo.hand import default_hand
from dexzoo.models.zoo import list_models, model_class, shipped_card
from dexzoo.planning import Plan, plan
from dexzoo.refinement import refine
from dexzoo.sim import ObjectModel, Scene
from dexzoo.sim.shapes import make_object
from dexzoo.verification import verify
from dexzoo.viewer import view

GENERATOR = "kopicki, heuristic, or a folder of demonstrations that Kopicki's learns from"
TRAINING = ("fit", "validate", "test", "predict")
OK, FAILED, WRONG_CALL = 0, 1, 2
Result = tuple[dict[str, Any], Table | None]

_out = Console()
_err = Console(stderr=True)


def main(args: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status."""
    args = list(sys.argv[1:] if args is None else args)
    try:
        _check_command(args)
        if args and args[0] in TRAINING:
            training.main(args)
            return OK
        config = _parser().parse_args(args or ["--help"])
        options: Namespace = config[config.subcommand]
        result, table = _COMMANDS[config.subcommand](options)
        if options.json:
            sys.stdout.write(json.dumps(result, indent=2) + "\n")
        elif table is not None:
            _out.print(table)
    except SystemExit as end:  # --help
        return OK if end.code in (0, None) else WRONG_CALL
    except ArgumentError as error:
        # its names of options are those of a configuration file
        message = re.sub(rf'Parser key "(\w+)"|\b(?:{"|".join(_COMMANDS)})\.(\w+)', r"--\1\2", str(error))
        command = args[0] if args[0] in _COMMANDS else "COMMAND"
        return _complain(f"{message}; see python -m dexzoo {command} --help", WRONG_CALL)
    except (ValueError, FileNotFoundError, IsADirectoryError, NotADirectoryError) as error:
        return _complain(error, WRONG_CALL)
    except (RuntimeError, OSError) as error:
        return _complain(error, FAILED)
    except KeyboardInterrupt:
        return _complain("stopped", FAILED)
    return OK


def _check_command(args: Sequence[str]) -> None:
    known = (*TRAINING, *_COMMANDS)
    if args and not args[0].startswith("-") and args[0] not in known:
        near = difflib.get_close_matches(args[0], known, 1)
        hint = f", did you mean {near[0]}?" if near else ";"
        raise ValueError(f"command {args[0]!r} is unknown{hint} use one of {', '.join(known)}")


def _complain(error: Exception | str, status: int) -> int:
    message = " ".join(str(error).split())
    sys.stderr.write(f"dexzoo: {message}\n")
    return status


def _parser() -> ArgumentParser:
    # errors are raised, not printed with a page of usage
    parser = ArgumentParser(
        prog="python -m dexzoo",
        exit_on_error=False,
        description="Grasps for a five-finger hand from one depth image. "
        f"Training: {', '.join(TRAINING)} (each with --config FILE and --help of its own).",
    )
    commands = parser.add_subcommands(dest="subcommand", required=True)

    def add(name: str, text: str) -> ArgumentParser:
        command = ArgumentParser(description=text, exit_on_error=False)
        command.add_argument("--seed", type=NonNegativeInt, default=0, help="the same seed gives the same result")
        command.add_argument("--json", action="store_true", help="print JSON for machines")
        commands.add_subcommand(name, command, help=text)
        return command

    def add_observation(command: ArgumentParser) -> None:
        command.add_argument("--depth", type=Path, required=True, help="16-bit PNG, or .npy in metres")
        command.add_argument(
            "--camera", type=Path, required=True, help="JSON: width, height, fx, fy, cx, cy, depth_scale, table_plane"
        )
        command.add_argument("--evaluator", default="em2", help="name, file, folder or hf:// address of the model")

    command = add("plan", "Propose and rank grasps for one depth image.")
    add_observation(command)
    command.add_argument("--num_grasps", type=PositiveInt, default=100, help="candidates to generate")
    command.add_argument("--generator", default="kopicki", help=GENERATOR)
    command.add_argument("--refine", action="store_true", help="refine the twenty best")
    command.add_argument("--out", type=Path, help="folder for grasps.safetensors, plan.json and pictures")

    command = add("refine", "Improve grasps by gradient on one depth image.")
    add_observation(command)
    command.add_argument("--grasps", type=Path, required=True, help="file of grasps, from plan --out")
    command.add_argument("--variables", default="grip", choices=["grip", "waypoints", "last3"], help="what is moved")
    command.add_argument("--num_steps", type=NonNegativeInt, default=20, help="steps of the ascent")
    command.add_argument("--out", type=Path, help="file for the refined grasps (.safetensors)")

    command = add("verify", "Execute grasps on an object in simulation: close, lift 1 m, hold 2 s.")
    command.add_argument("--object", required=True, help="mesh file in metres, z up; or a name such as mug_03")
    command.add_argument("--hulls", type=Path, nargs="*", help="files of its convex parts; otherwise computed")
    command.add_argument("--mass", type=float, help="kg (default 0.2, or the named object's)")
    command.add_argument("--friction", type=float, help="sliding friction (default 0.7, or the named object's)")
    command.add_argument("--grasps", type=Path, help="file of grasps in the world frame; otherwise they are generated")
    command.add_argument("--num_grasps", type=PositiveInt, default=50, help="candidates to generate from one view")
    command.add_argument("--generator", default="kopicki", help=GENERATOR)
    command.add_argument("--evaluator", default="em2", help="name or path of the model that ranks them")
    command.add_argument(
        "--trials", type=PositiveInt, default=1, help="repetitions under drawn mass, friction and wrist error"
    )

    command = add("collect", "Make a grasp set: scenes, views, grasps and their outcomes. Goes on where it stopped.")
    command.add_argument("--out", type=Path, required=True, help="folder of the grasp set")
    command.add_argument("--scenes", type=PositiveInt, default=100, help="how many scenes")
    command.add_argument("--workers", type=PositiveInt, default=1, help="processes")
    command.add_argument("--ray", help="instead of processes, a Ray cluster: auto, its address, or local for one here")
    command.add_argument("--split", choices=[*SPLITS, ALL], default=ALL, help="whose objects")
    command.add_argument("--generator", choices=list_generators(), default="kopicki", help="what proposes grasps")
    command.add_argument("--num_grasps", type=PositiveInt, default=100, help="grasps to generate in each scene")
    command.add_argument("--num_views", type=PositiveInt, default=4, help="views of each scene")
    command.add_argument("--trials", type=PositiveInt, default=1, help="more than 1: repetitions behind success_rate")
    command.add_argument("--images", action="store_true", help="keep the depth images; else rendered anew")

    command = add("compare", "Compare models, the generator's own order (gm) and a coin on grasps of unseen objects.")
    command.add_argument("models", nargs="*", help="names, files, folders or hf:// addresses; default: all shipped")
    command.add_argument("--data", default="assets/grasps", help="grasp set: a folder, or an address such as s3://...")
    command.add_argument("--split", choices=SPLITS, default="test", help="whose grasps")
    command.add_argument("--out", type=Path, help="folder for comparison.md, comparison.json and pictures")

    command = add("demonstrate", "Make demonstrations for the Kopicki generator, and try each ten times in simulation.")
    command.add_argument("--preshapes", type=Path, help="YAML of preshapes to close; default: those of dlr2")
    command.add_argument(
        "--recording", type=Path, help="JSON of waypoints in the frame of --mesh, in place of preshapes"
    )
    command.add_argument("--mesh", type=Path, help="mesh of the recording's object, metres, z up")
    command.add_argument("--out", type=Path, required=True, help="folder for the demonstrations (.safetensors)")

    command = add("view", "Show a hand in the browser, with a slider for each free joint, until interrupted.")
    command.add_argument("--hand", default="dlr2", help="name in robots/, or a folder with a URDF and a hand.yaml")
    command.add_argument("--side", default="right", choices=["right", "left"], help="which hand")
    command.add_argument("--port", type=NonNegativeInt, default=8080, help="of this machine; 0 takes any free one")

    add("models", "List the evaluative models.")
    return parser


def _plan(options: Namespace) -> Result:
    _check_folder(options.out)
    observation = Observation.load(options.depth, options.camera)
    with _err.status("generating, scoring and refining grasps" if options.refine else "generating and scoring grasps"):
        num_refined = 20 if options.refine else 0
        result = plan(observation, options.evaluator, options.num_grasps, num_refined, options.seed, options.generator)
    rows = _plan_rows(result)
    if options.out is not None:
        picture = plots.grasp_picture(observation, default_hand(), result.grasps[0])
        options.out.mkdir(parents=True, exist_ok=True)
        result.grasps.save(options.out / "grasps.safetensors")
        summary = {"frame": "camera", "T_world_camera": observation.T_world_camera.tolist(), "grasps": rows}
        (options.out / "plan.json").write_text(json.dumps(summary, indent=2) + "\n")
        plots.save(picture, options.out / "best_grasp.png")
    table = Table(title=f"{len(rows)} grasps, the ten best by {options.evaluator}")
    for name in ("rank", "type", "generator's rank", "score", "refined"):
        table.add_column(name, justify="left" if name == "type" else "right")
    for row in rows[:10]:
        table.add_row(
            str(row["rank"]), row["type"], str(row["generator_rank"]), f"{row['score']:.3f}", f"{row['refined']:.3f}"
        )
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
        result.score.tolist(),
        result.refined_score.tolist(),
        palms,
        strict=True,
    )
    return [
        {
            "rank": rank,
            "type": GRASP_TYPES[kind],
            "generator_rank": place + 1,
            "score": round(score, 4),
            "refined": round(refined, 4),
            "palm": [round(x, 4) for x in palm],
        }
        for rank, (kind, place, score, refined, palm) in enumerate(parts, 1)
    ]


def _refine(options: Namespace) -> Result:
    if options.out is not None and options.out.is_dir():
        raise IsADirectoryError(f"--out {options.out} is a folder; give a file")
    observation = Observation.load(options.depth, options.camera)
    grasps = Grasps.load(options.grasps)
    with _err.status("refining"):
        result = refine(
            grasps, observation, options.evaluator, variables=options.variables, num_steps=options.num_steps
        )
    if options.out is not None:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        result.grasps.save(options.out)
    summary = {
        "num_grasps": len(grasps),
        "accepted": int(result.accepted.sum()),
        "mean_score_before": float(result.score_before.mean()) if len(grasps) else None,
        "mean_score_after": float(result.score_after.mean()) if len(grasps) else None,
    }
    return summary, _pairs("refinement", summary)


def _verify(options: Namespace) -> Result:
    obj = _object(options)
    scene = Scene.place(obj, options.seed)
    observation = scene.observe(options.seed)
    if options.grasps is not None:
        grasps = Grasps.load(options.grasps)
        scores = [None] * len(grasps)
        if grasps.frame != "world":
            raise ValueError(
                f"{options.grasps} holds grasps in the camera frame; save them with to_frame('world', ...)"
            )
    else:
        with _err.status("generating and scoring grasps"):
            result = plan(observation, options.evaluator, options.num_grasps, 0, options.seed, options.generator)
        grasps, scores = result.grasps, result.score.tolist()
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


def _compare(options: Namespace) -> Result:
    _check_folder(options.out)
    models, data = load_models(options.models), GraspDataModule(options.data)
    result = compare(models, data, options.split, options.seed)
    if options.out is not None:
        write(result, options.out)
        draw_inside(models, data, options.split, options.out)
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
    table = Table(title="evaluative models")
    for heading in ("name", "what", "weights", "validation AUROC"):
        table.add_column(heading)
    for name in list_models():
        what = (model_class(name).__doc__ or "").splitlines()[0].rstrip(".")
        card = shipped_card(name)
        auroc = None if card is None else card.get("metrics", {}).get("validation_auroc")
        rows.append({"name": name, "what": what, "shipped": card is not None, "validation_auroc": auroc})
        weights = f"none; fit --config {name}.yaml" if card is None else "shipped"
        table.add_row(name, what, weights, "" if auroc is None else f"{auroc:.3f}")
    return {"models": rows}, table


def _pairs(title: str, values: dict[str, Any]) -> Table:
    table = Table("", "", title=title, show_header=False)
    for name, value in values.items():
        table.add_row(name.replace("_", " "), f"{value:.3f}" if isinstance(value, float) else str(value))
    return table


_COMMANDS: dict[str, Callable[[Namespace], Result]] = {
    "plan": _plan,
    "refine": _refine,
    "verify": _verify,
    "collect": _collect,
    "compare": _compare,
    "demonstrate": _demonstrate,
    "view": _view,
    "models": _models,
}

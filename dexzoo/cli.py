"""The command line: python -m dexzoo COMMAND. Exit status 0 done, 1 the work failed, 2 the call was wrong."""

from __future__ import annotations

import difflib
import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from jsonargparse import ArgumentError, ArgumentParser, Namespace
from jsonargparse.typing import NonNegativeInt, PositiveInt
from rich.console import Console

from dexzoo import training
from dexzoo.commands import COMMANDS
from dexzoo.data.collect import ALL
from dexzoo.data.schema import SPLITS
from dexzoo.generators import list_generators
from dexzoo.refinement import OPTIMISERS, RANKINGS
from dexzoo.refinement.method import NUM_STEPS

GENERATOR = "kopicki, heuristic, or a folder of demonstrations that Kopicki's learns from"
TRAINING = ("fit", "validate", "test", "predict")
IDLE: dict[str, tuple[str, tuple[str, ...], tuple[str, ...]]] = {
    "plan": ("refine", (), ("judge", "ranking")),
    "refine": ("judge", (), ("margin",)),
    "collect": ("refine", ("scenes", "ray", "split", "generator", "num_views", "trials", "images"), ("round",)),
}
"""Of a command: the option that decides, the options that are of no use with it, and those that are of none without."""
OK, FAILED, WRONG_CALL = 0, 1, 2

_out = Console()


def main(args: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status."""
    args = list(sys.argv[1:] if args is None else args)
    try:
        _check_command(args)
        if args and args[0] in TRAINING:
            training.main(args)
            return OK
        parser, commands = _parser()
        config = parser.parse_args(args or ["--help"])
        options: Namespace = config[config.subcommand]
        _check_use(config.subcommand, options, commands[config.subcommand].get_defaults())
        result, table = COMMANDS[config.subcommand](options)
        if options.json:
            sys.stdout.write(json.dumps(result, indent=2) + "\n")
        elif table is not None:
            _out.print(table)
    except SystemExit as end:  # --help
        return OK if end.code in (0, None) else WRONG_CALL
    except ArgumentError as error:
        # its names of options are those of a configuration file
        message = re.sub(rf'Parser key "(\w+)"|\b(?:{"|".join(COMMANDS)})\.(\w+)', r"--\1\2", str(error))
        command = args[0] if args[0] in COMMANDS else "COMMAND"
        return _complain(f"{message}; see python -m dexzoo {command} --help", WRONG_CALL)
    except (ValueError, FileNotFoundError, IsADirectoryError, NotADirectoryError) as error:
        return _complain(error, WRONG_CALL)
    except (RuntimeError, OSError) as error:
        return _complain(error, FAILED)
    except KeyboardInterrupt:
        return _complain("stopped", FAILED)
    return OK


def _check_command(args: Sequence[str]) -> None:
    known = (*TRAINING, *COMMANDS)
    if args and not args[0].startswith("-") and args[0] not in known:
        near = difflib.get_close_matches(args[0], known, 1)
        hint = f", did you mean {near[0]}?" if near else ";"
        raise ValueError(f"command {args[0]!r} is unknown{hint} use one of {', '.join(known)}")


def _check_use(command: str, options: Namespace, defaults: Namespace) -> None:
    """ValueError for an option that would do nothing."""
    if command not in IDLE:
        return
    decides, idle_with, idle_without = IDLE[command]
    given = options[decides] != defaults[decides]
    use, hint = ("with", "leave it out") if given else ("without", "add that, or leave it out")
    for name in idle_with if given else idle_without:
        if options[name] != defaults[name]:
            raise ValueError(f"--{name} does nothing {use} --{decides}; {hint}")


def _complain(error: Exception | str, status: int) -> int:
    message = " ".join(str(error).split())
    sys.stderr.write(f"dexzoo: {message}\n")
    return status


def _parser() -> tuple[ArgumentParser, dict[str, ArgumentParser]]:
    """The parser, and that of each command."""
    # errors are raised, not printed with a page of usage
    parser = ArgumentParser(
        prog="python -m dexzoo",
        exit_on_error=False,
        description="Grasps for a five-finger hand from one depth image. "
        f"Training: {', '.join(TRAINING)} (each with --config FILE and --help of its own).",
    )
    commands = parser.add_subcommands(dest="subcommand", required=True)
    made: dict[str, ArgumentParser] = {}

    def add(name: str, text: str) -> ArgumentParser:
        command = ArgumentParser(description=text, exit_on_error=False)
        command.add_argument("--seed", type=NonNegativeInt, default=0, help="the same seed gives the same result")
        command.add_argument("--json", action="store_true", help="print JSON for machines")
        commands.add_subcommand(name, command, help=text)
        made[name] = command
        return command

    def add_observation(command: ArgumentParser) -> None:
        command.add_argument("--depth", type=Path, required=True, help="16-bit PNG, or .npy in metres")
        command.add_argument(
            "--camera",
            type=Path,
            required=True,
            help="JSON: width, height, fx, fy, cx, cy, depth_scale; where known table_plane or T_world_camera",
        )
        command.add_argument("--evaluator", default="em_fk", help="name, file, folder or hf:// address of the model")

    command = add("plan", "Propose and rank grasps for one depth image.")
    add_observation(command)
    command.add_argument("--num_grasps", type=PositiveInt, default=100, help="candidates to generate")
    command.add_argument("--generator", default="kopicki", help=GENERATOR)
    command.add_argument("--refine", action="store_true", help="refine the twenty best")
    command.add_argument("--judge", help="model that a refined grasp must please too; as --evaluator")
    command.add_argument("--ranking", default="before", choices=list(RANKINGS), help="score that orders refined grasps")
    command.add_argument("--out", type=Path, help="folder for grasps.safetensors, plan.json and pictures")

    command = add("refine", "Improve grasps on one depth image.")
    add_observation(command)
    command.add_argument("--grasps", type=Path, required=True, help="file of grasps, from plan --out")
    command.add_argument("--judge", help="model that a refined grasp must please too; as --evaluator")
    command.add_argument("--margin", type=float, default=0.0, help="log-odds by which the judge must find it better")
    command.add_argument("--optimiser", default="adam", choices=list(OPTIMISERS), help="how the objective is climbed")
    command.add_argument("--num_steps", type=NonNegativeInt, default=NUM_STEPS, help="evaluations of each grasp")
    command.add_argument("--out", type=Path, help="file for the refined grasps (.safetensors)")
    command.add_argument("--picture", type=Path, help="file for the best grasp before and after (.png)")

    command = add("verify", "Execute grasps on an object in simulation: close, lift 1 m, hold 2 s.")
    command.add_argument("--object", required=True, help="mesh file in metres, z up; or a name such as mug_03")
    command.add_argument("--hulls", type=Path, nargs="*", help="files of its convex parts; otherwise computed")
    command.add_argument("--mass", type=float, help="kg (default 0.2, or the named object's)")
    command.add_argument("--friction", type=float, help="sliding friction (default 0.7, or the named object's)")
    command.add_argument("--grasps", type=Path, help="file of grasps in the world frame; otherwise they are generated")
    command.add_argument("--num_grasps", type=PositiveInt, default=50, help="candidates to generate from one view")
    command.add_argument("--generator", default="kopicki", help=GENERATOR)
    command.add_argument("--evaluator", default="em_fk", help="name or path of the model that ranks them")
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
    command.add_argument("--refine", help="instead, add to a set that is there: refine by this model, try, keep")
    command.add_argument("--round", type=PositiveInt, default=1, help="of refining; its grasps have files of their own")

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
    return parser, made

"""The command line: python -m dexzoo COMMAND. Exit status 0 done, 1 the work failed, 2 the call was wrong."""

from __future__ import annotations

import difflib
import importlib
import json
import sys
from collections.abc import Sequence

from dexzoo.cli.arguments import CallError, Formatter, Parser, count_or_none

TRAINING = ("fit", "validate", "test", "predict")
COMMANDS = {
    "plan": "Propose and rank grasps for one depth image.",
    "refine": "Improve grasps on one depth image.",
    "verify": "Execute grasps on an object in simulation: close, lift 1 m, hold 2 s.",
    "collect": "Make a grasp set: scenes, views, grasps and their outcomes. Continues where it stopped.",
    "collect_refined": "Add refined grasps of the training scenes and their outcomes to a grasp set.",
    "compare": "Compare models, the generator's own order (gm) and a coin on grasps of unseen objects.",
    "demonstrate": "Make demonstrations for Kopicki's generator, and try each ten times in simulation.",
    "view": "Show a hand in the browser, with a slider for each free joint, until interrupted.",
    "models": "List the evaluative models.",
}
"""Each is a module of this package with `add_options` and `run`."""
OK, FAILED, WRONG_CALL = 0, 1, 2


def main(args: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        args: Arguments, the command first; by default those of the process.

    Returns:
        The exit status.
    """
    args = list(sys.argv[1:] if args is None else args)
    try:
        if not args or args[0] in ("-h", "--help"):
            sys.stdout.write(usage())
            return OK
        return _run(args[0], args[1:])
    except SystemExit as end:  # --help
        return OK if end.code in (0, None) else WRONG_CALL
    except (ValueError, FileNotFoundError, IsADirectoryError, NotADirectoryError) as error:
        return _complain(error, WRONG_CALL)
    except (RuntimeError, OSError) as error:
        return _complain(error, FAILED)
    except KeyboardInterrupt:
        return _complain("stopped", FAILED)


def usage() -> str:
    """The help of the program: all commands."""
    width = max(map(len, COMMANDS)) + 2
    lines = [
        "usage: python -m dexzoo COMMAND [options]",
        "",
        "Grasps for a five-finger hand from one depth image.",
        "",
        *(f"  {name:{width}}{summary}" for name, summary in COMMANDS.items()),
        "",
        f"Training: {', '.join(TRAINING)}, each with --config FILE.",
        "Every command has --help, --seed and --json.",
    ]
    return "\n".join(lines) + "\n"


def _run(command: str, args: list[str]) -> int:
    if command in TRAINING:
        from dexzoo.training import command_line

        command_line.main([command, *args])
        return OK
    if command not in COMMANDS:
        known = (*TRAINING, *COMMANDS)
        near = difflib.get_close_matches(command, known, 1)
        hint = f", did you mean {near[0]}?" if near else ";"
        raise CallError(f"command {command!r} is unknown{hint} use one of {', '.join(known)}")
    module = importlib.import_module(f"dexzoo.cli.{command}")
    parser = Parser(
        prog=f"python -m dexzoo {command}",
        description=COMMANDS[command],
        formatter_class=Formatter,
        allow_abbrev=False,
    )
    module.add_options(parser)
    parser.add_argument(
        "--seed", type=count_or_none, default=0, help="random seed; the same seed gives the same result"
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    options = vars(parser.parse_args(args))
    as_json = options.pop("json")
    result = module.run(**options)
    if as_json:
        sys.stdout.write(json.dumps(result.values, indent=2) + "\n")
    elif result.table is not None:
        from rich.console import Console

        Console().print(result.table)
    return OK


def _complain(error: Exception | str, status: int) -> int:
    sys.stderr.write(f"dexzoo: {' '.join(str(error).split())}\n")
    return status

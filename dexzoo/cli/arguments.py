"""Parsers and checks that the commands share. Nothing here loads torch, so that help and errors come at once."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NoReturn

SPLITS = ("train", "validation", "test")
GENERATOR_HELP = "kopicki, heuristic, or a folder of demonstrations for Kopicki's generator"
EVALUATOR_HELP = "name, file, folder or hf:// address of the model"
HAND_HELP = "name of the hand in robots/, or a folder with a URDF and a hand.yaml"


class CallError(ValueError):
    """A command line that cannot be understood."""


class Parser(argparse.ArgumentParser):
    """Options of a command; wrong ones raise `CallError` instead of a page of usage."""

    def error(self, message: str) -> NoReturn:
        """Raise `CallError`.

        Args:
            message: The mistake.
        """
        raise CallError(f"{message}; see {self.prog} --help")


class Formatter(argparse.ArgumentDefaultsHelpFormatter):
    """Help with the defaults of options."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        if action.default is None or action.default is False or action.default == [] or action.required:
            return action.help
        return super()._get_help_string(action)


def count(text: str) -> int:
    """A whole number, 1 or more.

    Args:
        text: The user's text.

    Raises:
        argparse.ArgumentTypeError: It is none.
    """
    return _whole(text, 1)


def count_or_none(text: str) -> int:
    """A whole number, 0 or more.

    Args:
        text: The user's text.

    Raises:
        argparse.ArgumentTypeError: It is none.
    """
    return _whole(text, 0)


def _whole(text: str, least: int) -> int:
    if not text.isdecimal() or int(text) < least:
        raise argparse.ArgumentTypeError(f"expected a whole number, {least} or more, got {text!r}")
    return int(text)


def add_observation(parser: Parser) -> None:
    """Add the options that name a depth image and a model.

    Args:
        parser: Parser of the command.
    """
    parser.add_argument("--depth", type=Path, required=True, help="depth image: 16-bit PNG, or .npy in meters")
    parser.add_argument(
        "--camera",
        type=Path,
        required=True,
        help="JSON file: width, height, fx, fy, cx, cy, depth_scale; optional: table_plane or T_world_camera",
    )
    parser.add_argument("--evaluator", default="em_fk", help=EVALUATOR_HELP)


def check_folder(out: Path | None) -> None:
    """Refuse an output folder that is a file, before any work is done.

    Args:
        out: The folder; it need not exist.

    Raises:
        NotADirectoryError: It is a file.
    """
    if out is not None and out.exists() and not out.is_dir():
        raise NotADirectoryError(f"--out {out} is a file; give a folder")


def check_file(out: Path | None, option: str) -> None:
    """Refuse an output file that is a folder, before any work is done.

    Args:
        out: The file; it need not exist.
        option: Name of the option.

    Raises:
        IsADirectoryError: It is a folder.
    """
    if out is not None and out.is_dir():
        raise IsADirectoryError(f"--{option} {out} is a folder; give a file")

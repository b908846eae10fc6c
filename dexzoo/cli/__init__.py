"""The command line: one file for each command, with its options and one function of keywords."""

from dexzoo.cli.main import main

__all__ = ["main"]

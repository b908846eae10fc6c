"""`compare`: compare models on grasps of unseen objects."""

from __future__ import annotations

from pathlib import Path

from dexzoo.cli.arguments import SPLITS, Parser, check_folder
from dexzoo.cli.output import Result


def add_options(parser: Parser) -> None:
    """Add the options of this command.

    Args:
        parser: Parser of the command.
    """
    parser.add_argument(
        "models",
        nargs="*",
        default=[],
        help="names, files, folders or hf:// addresses of models (default: all shipped)",
    )
    parser.add_argument("--data", default="assets/grasps", help="grasp set: a folder, or an address such as s3://...")
    parser.add_argument("--split", choices=SPLITS, default="test", help="split of the grasps")
    parser.add_argument("--out", type=Path, help="folder for comparison.md, comparison.json and pictures")


def run(models: list[str], data: str, split: str, out: Path | None, seed: int) -> Result:
    """Compare models.

    Args:
        models: Models; none for all shipped.
        data: Grasp set.
        split: Split of the objects.
        out: Folder to write to; None writes nothing.
        seed: Seed of everything random.

    Returns:
        Values for machines, and a table for people.
    """
    check_folder(out)
    from dexzoo.collection.rendering import render
    from dexzoo.comparison.compare import compare, load_models
    from dexzoo.comparison.inside import draw_inside
    from dexzoo.comparison.report import terminal_table, write
    from dexzoo.data.datamodule import GraspDataModule

    loaded, source = load_models(models), GraspDataModule(data)
    source.renderer = render
    result = compare(loaded, source, split, seed)
    if out is not None:
        write(result, out, draw_inside(loaded, source, split, out))
    return Result(result, terminal_table(result))

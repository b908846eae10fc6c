"""`collect_refined`: add refined grasps of the training scenes, and their outcomes, to a grasp set."""

from __future__ import annotations

from pathlib import Path

from dexzoo.cli.arguments import EVALUATOR_HELP, Parser, check_folder, count
from dexzoo.cli.output import Result, followed, pairs


def add_options(parser: Parser) -> None:
    """Add the options of this command.

    Args:
        parser: Parser of the command.
    """
    parser.add_argument("--out", type=Path, required=True, help="folder of the grasp set")
    parser.add_argument("--evaluator", default="em_fk", help=f"evaluator that guides: {EVALUATOR_HELP}")
    parser.add_argument("--round", type=count, default=1, help="number of the round; each round has its own files")
    parser.add_argument("--num_grasps", type=count, default=40, help="number of grasps to refine in each scene")
    parser.add_argument("--workers", type=count, default=1, help="number of processes")


def run(out: Path, evaluator: str, round: int, num_grasps: int, workers: int, seed: int) -> Result:
    """Refine and try grasps.

    Args:
        out: Folder to write to.
        evaluator: Name, file, folder or hf:// address of the model.
        round: Number of the round.
        num_grasps: Number of grasps.
        workers: Number of processes.
        seed: Seed of everything random.

    Returns:
        Values for machines, and a table for people.
    """
    check_folder(out)
    from dexzoo.collection.refined import Refining, collect_refined, slices, training_scenes
    from dexzoo.data.grasp_set import GraspSet

    how = Refining(evaluator, round, seed, num_grasps)
    lines, total = collect_refined(out, how, workers), len(slices(training_scenes(out)))
    for _ in followed(lines, "refining and trying", total):
        pass
    grasps = GraspSet(out)
    refined = grasps.source == "refined"
    summary = {"out": str(out), "refined": int(refined.sum()), "held": int(grasps.success[refined].sum())}
    return Result(summary, pairs("refined grasps, of all rounds", summary))

"""`collect`: make a grasp set."""

from __future__ import annotations

from pathlib import Path

from dexzoo.cli.arguments import HAND_HELP, SPLITS, Parser, check_folder, count
from dexzoo.cli.output import Result, followed, pairs

GENERATORS = ("kopicki", "heuristic")


def add_options(parser: Parser) -> None:
    """Add the options of this command.

    Args:
        parser: Parser of the command.
    """
    parser.add_argument("--out", type=Path, required=True, help="folder of the grasp set")
    parser.add_argument("--scenes", type=count, default=100, help="number of scenes")
    parser.add_argument("--workers", type=count, default=1, help="number of processes")
    parser.add_argument("--ray", help="Ray cluster instead of processes: auto, its address, or local (on this machine)")
    parser.add_argument("--split", choices=(*SPLITS, "all"), default="all", help="split of the objects")
    parser.add_argument("--generator", choices=GENERATORS, default="kopicki", help="generator of the grasps")
    parser.add_argument("--hand", default="dlr2", help=HAND_HELP)
    parser.add_argument("--num_grasps", type=count, default=100, help="number of grasps to generate in each scene")
    parser.add_argument("--num_views", type=count, default=4, help="number of views of each scene")
    parser.add_argument("--trials", type=count, default=1, help="trials of each grasp; more than 1 give success_rate")
    parser.add_argument("--images", action="store_true", help="store the depth images; otherwise rendered again")


def run(
    out: Path,
    scenes: int,
    workers: int,
    ray: str | None,
    split: str,
    generator: str,
    hand: str,
    num_grasps: int,
    num_views: int,
    trials: int,
    images: bool,
    seed: int,
) -> Result:
    """Collect scenes.

    Args:
        out: Folder to write to.
        scenes: Number of scenes.
        workers: Number of processes.
        ray: Address of a Ray cluster, or None.
        split: Split of the objects.
        generator: Name of the generator.
        hand: Name or folder of the hand.
        num_grasps: Number of grasps.
        num_views: Views of each scene.
        trials: Number of trials.
        images: Whether depth images are kept.
        seed: Seed of everything random.

    Returns:
        Values for machines, and a table for people.
    """
    check_folder(out)
    from dexzoo.collection.collect import Configuration, collect
    from dexzoo.data.writer import MANIFEST, read_manifest

    configuration = Configuration(
        seed=seed,
        split=split,
        generator=generator,
        num_grasps=num_grasps,
        num_views=num_views,
        trials=trials,
        images=images,
        hand=hand,
    )
    for _ in followed(collect(out, configuration, scenes, workers, ray), "collecting scenes", scenes):
        pass
    counts = read_manifest((out / MANIFEST).read_bytes(), MANIFEST)["counts"]
    shown = {**counts, "skipped": sum(counts["skipped"].values()), "out": out}
    return Result({"out": str(out), **counts}, pairs("grasp set", shown))

"""`refine`: improve grasps on one depth image."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from rich.progress import Progress

from dexzoo.cli.arguments import EVALUATOR_HELP, HAND_HELP, Parser, add_observation, check_file, count_or_none
from dexzoo.cli.output import Result, errors, pairs, rounded

if TYPE_CHECKING:
    from torch import Tensor

OPTIMIZERS = ("adam", "lbfgs", "metropolis", "random")
NUM_STEPS = 30


def add_options(parser: Parser) -> None:
    """Add the options of this command.

    Args:
        parser: Parser of the command.
    """
    add_observation(parser)
    parser.add_argument(
        "--grasps", type=Path, required=True, help="file of grasps for this depth image, as written by plan"
    )
    parser.add_argument("--hand", help=f"{HAND_HELP} (default: that of the file)")
    parser.add_argument("--judge", help=f"second evaluator that must also predict an improvement: {EVALUATOR_HELP}")
    parser.add_argument("--prior", default="kopicki", choices=("kopicki", "none"), help="density used as the prior")
    parser.add_argument("--optimizer", default="adam", choices=OPTIMIZERS, help="optimizer of the objective")
    parser.add_argument(
        "--num_steps", type=count_or_none, default=NUM_STEPS, help="number of evaluations of each grasp"
    )
    parser.add_argument("--out", type=Path, help="file for the refined grasps (.safetensors)")
    parser.add_argument("--picture", type=Path, help="picture of the best grasp before and after (.png)")


def run(
    depth: Path,
    camera: Path,
    evaluator: str,
    grasps: Path,
    hand: str | None,
    judge: str | None,
    prior: str,
    optimizer: str,
    num_steps: int,
    out: Path | None,
    picture: Path | None,
    seed: int,
) -> Result:
    """Refine grasps.

    Args:
        depth: Depth image.
        camera: Camera file.
        evaluator: Name, file, folder or hf:// address of the model.
        grasps: File of grasps.
        hand: Name or folder of the hand; None takes the file's.
        judge: Model that must agree, or None.
        prior: "kopicki" or "none".
        optimizer: Name of the optimizer.
        num_steps: Evaluations of each grasp.
        out: File to write; None writes nothing.
        picture: File for a picture, or None.
        seed: Seed of everything random.

    Returns:
        Values for machines, and a table for people.
    """
    check_file(out, "out")
    check_file(picture, "picture")
    from dexzoo.grasp import Grasps
    from dexzoo.hand import Hand
    from dexzoo.perception import Observation
    from dexzoo.refinement import rank, refine
    from dexzoo.viewing import pictures

    observation = Observation.load(depth, camera)
    given = Grasps.load(grasps, Hand.load(hand) if hand else None)
    with Progress(console=errors, transient=True, disable=not errors.is_terminal) as bar:
        task = bar.add_task("refining", total=len(given) * (num_steps + 1))
        result = refine(
            given,
            observation,
            evaluator,
            judge=judge,
            prior=None if prior == "none" else "kopicki",
            optimizer=optimizer,  # type: ignore[arg-type]  # the parser lets no other name through
            num_steps=num_steps,
            seed=seed,
            on_step=lambda _, value: bar.advance(task, len(value)),
        )
    if picture is not None and not len(given):
        errors.print(f"there are no grasps, so {picture} is not drawn", soft_wrap=True)
    elif picture is not None:
        best = int(rank(result)[0])
        pictures.save(pictures.refinement_picture(observation, given[best], result.grasps[best]), picture)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        result.grasps.save(out)
    summary = {
        "num_grasps": len(given),
        "accepted": int(result.accepted.sum()),
        "failed": int(result.failed.sum()),
        "mean_score_before": _mean(result.score_before),
        "mean_score_after": _mean(result.score_after),
    }
    each = {
        "accepted": result.accepted.nonzero().flatten().tolist(),
        "failed": result.failed.nonzero().flatten().tolist(),
        "score_before": rounded(result.score_before),
        "score_after": rounded(result.score_after),
    }
    return Result(summary | each, pairs("refinement", summary))


def _mean(values: Tensor) -> float | None:
    """Mean of the finite values; None if there are none."""
    known = values[values.isfinite()]
    return float(known.mean()) if len(known) else None

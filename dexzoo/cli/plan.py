"""`plan`: propose and rank grasps for one depth image."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table

from dexzoo.cli.arguments import GENERATOR_HELP, HAND_HELP, Parser, add_observation, check_folder, count
from dexzoo.cli.output import Result, errors, rounded

if TYPE_CHECKING:
    from dexzoo.planning import Plan

NUM_REFINED = 20


def add_options(parser: Parser) -> None:
    """Add the options of this command.

    Args:
        parser: Parser of the command.
    """
    add_observation(parser)
    parser.add_argument("--num_grasps", type=count, default=100, help="number of grasps to generate")
    parser.add_argument("--generator", default="kopicki", help=GENERATOR_HELP)
    parser.add_argument("--hand", default="dlr2", help=HAND_HELP)
    parser.add_argument("--refine", action="store_true", help=f"refine the {NUM_REFINED} best grasps")
    parser.add_argument("--out", type=Path, help="folder for grasps.safetensors, plan.json and pictures")


def run(
    depth: Path,
    camera: Path,
    evaluator: str,
    num_grasps: int,
    generator: str,
    hand: str,
    refine: bool,
    out: Path | None,
    seed: int,
) -> Result:
    """Plan grasps.

    Args:
        depth: Depth image.
        camera: Camera file.
        evaluator: Name, file, folder or hf:// address of the model.
        num_grasps: Number of grasps.
        generator: Name of the generator, or a folder of demonstrations.
        hand: Name or folder of the hand.
        refine: Whether the best are refined.
        out: Folder to write to; None writes nothing.
        seed: Seed of everything random.

    Returns:
        Values for machines, and a table for people.
    """
    check_folder(out)
    from dexzoo.perception import Observation
    from dexzoo.planning import plan
    from dexzoo.viewing import pictures

    observation = Observation.load(depth, camera)
    with errors.status("generating, scoring and refining grasps" if refine else "generating and scoring grasps"):
        num_refined = NUM_REFINED if refine else 0
        result = plan(observation, evaluator, num_grasps, num_refined, seed, generator, hand=hand)
    rows = _rows(result)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        result.grasps.save(out / "grasps.safetensors")
        pictures.save(pictures.grasp_picture(observation, result.grasps[0]), out / "best_grasp.png")
        if refine:
            picture = pictures.refinement_picture(observation, result.given[0], result.grasps[0])
            pictures.save(picture, out / "refined.png")
        about = {"frame": "world", "T_world_camera": observation.T_world_camera.tolist(), "grasps": rows}
        (out / "plan.json").write_text(json.dumps(about, indent=2) + "\n")
    table = Table(title="the ten best grasps")
    for name in ("rank", "type", "generator rank", "score", "refined"):
        table.add_column(name, justify="left" if name == "type" else "right")
    for row in rows[:10]:
        scores = ("none" if row[name] is None else f"{row[name]:.3f}" for name in ("score", "refined"))
        table.add_row(str(row["rank"]), row["type"], str(row["generator_rank"]), *scores)
    return Result({"grasps": rows}, table)


def _rows(plan: Plan) -> list[dict[str, Any]]:
    from dexzoo.grasp import GRASP_TYPES, GRIP

    columns = zip(
        plan.grasps.grasp_type.tolist(),
        plan.generator_rank.tolist(),
        rounded(plan.score),
        rounded(plan.refined_score),
        plan.grasps.position[:, GRIP].tolist(),
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
        for rank, (kind, place, score, refined, palm) in enumerate(columns, 1)
    ]

"""`verify`: execute grasps on an object in simulation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from dexzoo.cli.arguments import EVALUATOR_HELP, GENERATOR_HELP, HAND_HELP, Parser, count
from dexzoo.cli.output import Result, errors, pairs, rounded

if TYPE_CHECKING:
    from dexzoo.sim import ObjectModel


def add_options(parser: Parser) -> None:
    """Add the options of this command.

    Args:
        parser: Parser of the command.
    """
    parser.add_argument(
        "--object", required=True, help="mesh file in meters, z up; or the name of an object, such as mug_03"
    )
    parser.add_argument("--hulls", type=Path, nargs="*", help="mesh files of its convex parts (default: computed)")
    parser.add_argument("--mass", type=float, help="mass in kg (default: 0.2, or that of the named object)")
    parser.add_argument("--friction", type=float, help="sliding friction (default: 0.7, or that of the named object)")
    parser.add_argument(
        "--grasps", type=Path, help="file of grasps in the world frame of the scene (default: generated)"
    )
    parser.add_argument("--num_grasps", type=count, default=50, help="number of grasps to generate from one view")
    parser.add_argument("--generator", default="kopicki", help=GENERATOR_HELP)
    parser.add_argument("--hand", help=f"{HAND_HELP} (default: that of the file, or dlr2)")
    parser.add_argument("--evaluator", default="em_fk", help=f"evaluator that ranks the grasps: {EVALUATOR_HELP}")
    parser.add_argument(
        "--trials", type=count, default=1, help="trials of each grasp; more than 1 vary mass, friction and wrist pose"
    )


def run(
    object: str,
    hulls: list[Path] | None,
    mass: float | None,
    friction: float | None,
    grasps: Path | None,
    num_grasps: int,
    generator: str,
    hand: str | None,
    evaluator: str,
    trials: int,
    seed: int,
) -> Result:
    """Verify grasps.

    Args:
        object: Mesh file, or name of an object.
        hulls: Files of convex parts, or None.
        mass: Kilograms, or None for the default.
        friction: Sliding coefficient, or None for the default.
        grasps: File of grasps; None generates them.
        num_grasps: Number of grasps.
        generator: Name of the generator, or a folder of demonstrations.
        hand: Name or folder of the hand; None takes the file's, or dlr2.
        evaluator: Name, file, folder or hf:// address of the model.
        trials: Number of trials.
        seed: Seed of everything random.

    Returns:
        Values for machines, and a table for people.
    """
    import numpy as np

    from dexzoo.grasp import GRASP_TYPES, Grasps
    from dexzoo.hand import Hand
    from dexzoo.planning import plan
    from dexzoo.sim import Scene
    from dexzoo.verification import verify

    model = _object(object, hulls, mass, friction)
    scene = Scene.place(model, seed)
    if grasps is not None:
        tried = Grasps.load(grasps, Hand.load(hand) if hand else None)
        scores: list[float | None] = [None] * len(tried)
    else:
        with errors.status("generating and scoring grasps"):
            result = plan(scene.observe(seed), evaluator, num_grasps, 0, seed, generator, hand=hand or "dlr2")
        tried, scores = result.grasps, rounded(result.score)
    with errors.status("executing grasps in simulation"):
        outcomes = verify(tried, scene, seed, trials)
    held = np.flatnonzero(outcomes.success)
    summary = {
        "object": model.name,
        "num_grasps": len(outcomes),
        "hold": int(outcomes.success.sum()),
        "collided": int(outcomes.collided.sum()),
        "unstable": int(outcomes.unstable.sum()),
        "success_rate": float(outcomes.success_rate.mean()) if len(outcomes) else None,
        "first_that_holds": int(held[0]) + 1 if len(held) else None,
    }
    columns = zip(tried.grasp_type.tolist(), scores, outcomes.success, outcomes.collided, strict=True)
    rows = [
        {"rank": rank, "type": GRASP_TYPES[kind], "score": score, "success": bool(success), "collided": bool(collided)}
        for rank, (kind, score, success, collided) in enumerate(columns, 1)
    ]
    return Result({**summary, "grasps": rows}, pairs(f"verification of {model.name}", summary))


def _object(name: str, hulls: list[Path] | None, mass: float | None, friction: float | None) -> ObjectModel:
    """The object of a mesh file, or of a name of the grasp set."""
    from dexzoo.sim import ObjectModel
    from dexzoo.sim.shapes import make_object

    if not Path(name).exists() and not Path(name).suffix:
        named = make_object(name)
        return replace(
            named,
            mass=named.mass if mass is None else mass,
            friction=named.friction if friction is None else friction,
        )
    with errors.status("computing convex parts"):
        return ObjectModel.from_mesh(name, 0.2 if mass is None else mass, 0.7 if friction is None else friction, hulls)

"""`demonstrate`: make demonstrations for Kopicki's generator."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table

from dexzoo.cli.arguments import HAND_HELP, Parser, check_folder
from dexzoo.cli.output import Result, followed

if TYPE_CHECKING:
    from dexzoo.grasp import Grasps
    from dexzoo.hand import Hand
    from dexzoo.sim import ObjectModel

TRIALS = 10


def add_options(parser: Parser) -> None:
    """Add the options of this command.

    Args:
        parser: Parser of the command.
    """
    parser.add_argument("--out", type=Path, required=True, help="folder for the demonstrations (.safetensors)")
    parser.add_argument("--hand", default="dlr2", help=HAND_HELP)
    parser.add_argument("--preshapes", type=Path, help="YAML file of preshapes (default: those of the hand)")
    parser.add_argument(
        "--recording", type=Path, help="JSON file of waypoints in the frame of --mesh, instead of preshapes"
    )
    parser.add_argument("--mesh", type=Path, help="mesh of the recorded object, in meters, z up")


def run(out: Path, hand: str, preshapes: Path | None, recording: Path | None, mesh: Path | None, seed: int) -> Result:
    """Make demonstrations.

    Args:
        out: Folder to write to.
        hand: Name or folder of the hand.
        preshapes: YAML of preshapes, or None.
        recording: JSON of a recorded grasp, or None.
        mesh: Mesh of the recording's object, or None.
        seed: Seed of everything random.

    Returns:
        Values for machines, and a table for people.
    """
    check_folder(out)
    if (recording is None) != (mesh is None) or (recording and preshapes):
        raise ValueError("demonstrate takes --preshapes, or --recording together with --mesh")
    from dexzoo.generators.demonstration import Demonstration
    from dexzoo.grasp import GRASP_TYPES
    from dexzoo.hand import Hand
    from dexzoo.sim import Scene
    from dexzoo.verification import verify

    rows = []
    table = Table("demonstration", "object", "holds", title="demonstrations, each tried ten times")
    for obj, grasp in followed(_shown(Hand.load(hand), preshapes, recording, mesh), "trying demonstrations"):
        name = GRASP_TYPES[int(grasp.grasp_type[0])]
        demonstration = Demonstration.record(grasp, obj.mesh, obj.name)
        scene = Scene.place(obj, seed)
        rate = verify(grasp.transformed(scene.T_world_object), scene, seed, trials=TRIALS).success_rate
        out.mkdir(parents=True, exist_ok=True)
        demonstration.save(out / f"{name}.safetensors")
        rows.append({"name": name, "object": obj.name, "success_rate": round(float(rate[0]), 2)})
        table.add_row(name, obj.name, f"{rate[0]:.0%}")
    return Result({"demonstrations": rows}, table)


def _shown(
    hand: Hand, preshapes: Path | None, recording: Path | None, mesh: Path | None
) -> list[tuple[ObjectModel, Grasps]]:
    """Objects, and a grasp of each in its own frame."""
    from dexzoo.generators.demonstration import shipped_demonstrations
    from dexzoo.generators.preshape import close, read_preshapes, read_recording
    from dexzoo.sim import ObjectModel
    from dexzoo.sim.shapes import make_object

    if recording is not None and mesh is not None:
        return [(ObjectModel.from_mesh(mesh), read_recording(recording, hand))]
    shown = []
    for preshape in read_preshapes(preshapes or shipped_demonstrations(hand) / "preshapes.yaml", hand):
        obj = make_object(preshape.object)
        shown.append((obj, close(preshape, obj.mesh, hand)))
    return shown

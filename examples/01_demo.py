"""The main job from end to end: place an unseen object, look once, propose, rank, refine, verify, draw.

python examples/01_demo.py --out out/demo
"""

import argparse
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import dexzoo
from dexzoo.grasp import GRASP_TYPES
from dexzoo.perception.camera import look_at
from dexzoo.sim import trial
from dexzoo.sim.shapes import make_object
from dexzoo.viewing import pictures

NUM_REFINED = 10
console = Console()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--object", default="bottle_07", help="a test object of the grasp set")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--num_grasps", type=int, default=60)
    parser.add_argument("--out", type=Path, default=Path("out/demo"))
    options = parser.parse_args()

    console.print(f"Placing {options.object}, which no model has seen, and taking one depth image ...")
    scene = dexzoo.sim.Scene.place(make_object(options.object), seed=options.seed)
    observation = scene.observe(seed=options.seed)

    console.print("Generating candidates, ranking them by em_fk, refining the best ...")
    plan = dexzoo.plan(observation, "em_fk", options.num_grasps, NUM_REFINED, options.seed)

    console.print("Executing all of them in MuJoCo ...")
    outcomes = dexzoo.verify(plan.grasps, scene, seed=options.seed)

    table = Table(title=f"{len(plan.grasps)} grasps of {options.object}; the {NUM_REFINED} best were refined")
    for name in ("rank", "type", "score before", "score after", "verified"):
        table.add_column(name, justify="right")
    verdict = np.where(outcomes.success, "holds", np.where(outcomes.collided, "hits the table", "fails"))
    for i in range(NUM_REFINED):
        kind = GRASP_TYPES[int(plan.grasps.grasp_type[i])]
        table.add_row(str(i + 1), kind, f"{plan.score[i]:.3f}", f"{plan.refined_score[i]:.3f}", verdict[i])
    console.print(table)
    console.print(f"Of all {len(plan.grasps)} grasps {int(outcomes.success.sum())} hold.")

    best = int(np.flatnonzero(outcomes.success)[0]) if outcomes.success.any() else 0
    pictures.save(pictures.grasp_picture(observation, plan.grasps[best]), options.out / "grasp.png")
    pictures.save(lift_picture(scene, plan.grasps[best]), options.out / "lift.png")
    console.print(f"Pictures of the grasp ranked {best + 1}: {options.out / 'grasp.png'}, {options.out / 'lift.png'}")


def lift_picture(scene: dexzoo.sim.Scene, grasp: dexzoo.Grasps) -> pictures.Image:
    """The trial at five moments, seen from the side."""
    moments = {"pre-grasp": -1.4, "grip": -0.5, "squeeze": -0.02, "lifted by half": 1.0, "held": 3.9}
    camera = dexzoo.Camera(300, 400, 380, 380, 150, 200)
    cells = []
    for moment in trial.replay(scene, grasp, list(moments.values())):
        mesh = scene.object.mesh.copy().apply_transform(moment.T_world_object)
        solids = [
            pictures.Solid(mesh, pictures.OBJECT_COLOR),
            pictures.hand_solid(grasp.hand, moment.wrist, moment.joints),
        ]
        target = np.array([0, 0, max(0.12, float(moment.wrist[2]) - 0.08)])
        cells.append(pictures.render(solids, camera, look_at(target, 0.75, 0.6, 0.3))[0])
    return pictures.grid(cells, list(moments), columns=len(moments))


if __name__ == "__main__":
    main()

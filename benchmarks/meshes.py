"""The whole job on meshes that dexzoo did not make: place, observe, generate 50, rank, verify.

python benchmarks/meshes.py FOLDER [NAME ...] --out benchmarks/results/meshes.json
FOLDER holds a folder per object with mesh.obj and, where there are any, hull_*.obj. The first observation that sees the
object is used. Mass 0.2 kg and friction 0.7 for all.
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np

import dexzoo


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--evaluator", default="em2")
    parser.add_argument("--num_grasps", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    names = options.names or sorted(path.parent.name for path in options.folder.glob("*/mesh.obj"))
    model = dexzoo.load(options.evaluator)
    rows = []
    for name in names:
        folder = options.folder / name
        hulls = sorted(folder.glob("hull_*.obj")) or None
        row = attempt(name, folder / "mesh.obj", hulls, model, options.num_grasps, options.seed)
        sys.stderr.write(json.dumps(row) + "\n")
        rows.append(row)
    held = [row for row in rows if row.get("hold")]
    result = {"evaluator": options.evaluator, "objects": rows, "objects_with_a_grasp_that_holds": len(held)}
    text = json.dumps(result, indent=2)
    if options.out:
        options.out.write_text(text + "\n")
    sys.stdout.write(text + "\n")


def attempt(name, mesh, hulls, model, num_grasps, seed) -> dict[str, object]:  # noqa: ANN001, see main
    try:
        obj = dexzoo.sim.ObjectModel.from_mesh(mesh, mass=0.2, friction=0.7, hulls=hulls, name=name)
        scene = dexzoo.sim.Scene.place(obj, seed)
        observation = scene.observe(seed)
        plan = dexzoo.plan(observation, model, num_grasps, seed=seed)
    except (RuntimeError, ValueError) as error:
        return {"object": name, "error": str(error)}
    outcomes = dexzoo.verify(plan.grasps, scene, seed)
    held = np.flatnonzero(outcomes.success)
    in_generator_order = outcomes.success[plan.generator_rank.argsort().numpy()]
    return {
        "object": name,
        "grasps": len(outcomes),
        "hold": len(held),
        "collided": int(outcomes.collided.sum()),
        "first_that_holds_by_evaluator": int(held[0]) + 1 if len(held) else None,
        "first_that_holds_by_generator": int(in_generator_order.argmax()) + 1 if len(held) else None,
    }


if __name__ == "__main__":
    main()

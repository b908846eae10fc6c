"""Which evaluator to use on objects that dexzoo did not make: a recorded grasp set of meshes, and the comparison on it.

python benchmarks/meshes.py FOLDER [MODEL ...] --set out/meshes --out benchmarks/results/evaluators_meshes.json
FOLDER holds a folder per object with mesh.obj, in meters, z up, and, where there are any, hull_*.obj. Each object is
put down `--scenes` times, seen once, and the default generator's grasps for that view are tried once each. The set
keeps images and outcomes and goes on where it stopped. Mass 0.2 kg and friction 0.7 for all. There is nothing to choose
gm's threshold on, so that gm has no accuracy. Scenes in which no grasp holds count, as failures of every ranking.
"""

import argparse
import json
import sys
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from generator import MESH_FRICTION, MESH_MASS, set_scene

import dexzoo
from dexzoo.comparison.compare import compare, load_models
from dexzoo.comparison.report import markdown
from dexzoo.data.datamodule import GraspDataModule
from dexzoo.data.schema import decode_path, encode_path, encode_view
from dexzoo.data.writer import GraspSetWriter, SceneRows, scene_rows
from dexzoo.sim import trial


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("models", nargs="*", help="as for `python -m dexzoo compare`")
    parser.add_argument("--set", type=Path, required=True, help="folder of the recorded grasp set")
    parser.add_argument("--scenes", type=int, default=3, help="of each object")
    parser.add_argument("--num_grasps", type=int, default=50)
    parser.add_argument("--out", type=Path, help="file for the JSON; the tables go to standard output")
    options = parser.parse_args()
    names = sorted(path.parent.name for path in options.folder.glob("*/mesh.obj"))
    if not names:
        parser.error(f"folder {options.folder} holds no NAME/mesh.obj; give a folder of objects' folders")
    record(options.set, options.folder, names, options.scenes, options.num_grasps)
    result = compare(load_models(options.models), GraspDataModule(str(options.set))) | outcomes(options.set)
    if options.out:
        options.out.write_text(json.dumps(result, indent=2, allow_nan=False) + "\n")
    sys.stdout.write(markdown(result))


def record(folder: Path, meshes: Path, names: list[str], scenes: int, num_grasps: int) -> None:
    """Write what is missing of the grasp set, the objects in turn."""
    made = {"dexzoo": version("dexzoo"), "objects": names, "generator": "kopicki", "num_grasps": num_grasps}
    with GraspSetWriter(folder, made, scenes * len(names)) as writer:
        for number in sorted(set(range(writer.num_scenes)) - writer.done):
            name = names[number % len(names)]
            # the object's name stands for its category, so that the comparison has figures of each
            row = {"scene": number, "object": name, "category": name, "split": "test", "trials": 1}
            rows = tried(row, partial(set_scene, "test", meshes, number), num_grasps)
            writer.write(rows)
            state = rows["scenes"].to_pylist()[0]
            told = state["skipped"] or f"{state['held']} of {state['generated']} hold"
            sys.stderr.write(f"{number} {name}: {told}\n")


def tried(row: dict[str, Any], setting: partial[Any], num_grasps: int) -> SceneRows:
    """Rows of a scene: its view with the image, all grasps and what became of them; or why there are none."""
    row |= {"mass": MESH_MASS, "friction": MESH_FRICTION, "generated": 0, "held": 0}
    try:
        scene, view, seed, _ = setting()
        grasps = dexzoo.generate(view, num_grasps, seed)
    except (ValueError, RuntimeError) as error:
        return scene_rows(row | {"skipped": str(error)})
    path = encode_path(grasps)
    # what is simulated is what will be read, to the last bit
    found = trial.run(scene, decode_path(path, grasps.grasp_type, grasps.hand))
    columns = {
        "view": [0] * len(path),
        "grasp_type": grasps.grasp_type.numpy(),
        "source": ["generated"] * len(path),
        "rank": np.arange(len(path)),
        "log_likelihood": grasps.log_likelihood.numpy(),
        "path": path,
        **{name: getattr(found, name) for name in ("success", "collided", "starts_inside", "unstable")},
    }
    row |= {"generated": len(path), "held": int(found.success.sum())}
    return scene_rows(row, [encode_view(view.aimed())], columns)


def outcomes(folder: Path) -> dict[str, Any]:
    """For each object its scenes, grasps and outcomes; which objects have no grasp at all, and why."""
    scenes = pq.read_table(folder / "scenes").to_pandas()
    collided = pq.read_table(folder / "grasps", columns=["scene", "collided"]).to_pandas()
    collided = collided.groupby("scene")["collided"].sum()
    objects, without = {}, {}
    for name, part in scenes.groupby("object"):
        if not part["generated"].any():
            without[name] = sorted(part["skipped"].unique())
        objects[name] = {
            "scenes": len(part),
            "with_grasps": int((part["generated"] > 0).sum()),
            "with_one_that_holds": int((part["held"] > 0).sum()),
            "grasps": int(part["generated"].sum()),
            "hold": int(part["held"].sum()),
            "collided": int(collided.reindex(part["scene"], fill_value=0).sum()),
        }
    return {"objects": objects, "objects_without_grasps": without}


if __name__ == "__main__":
    main()

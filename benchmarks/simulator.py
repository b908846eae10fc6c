"""How far the labels can be trusted: the working setting against the reference, and each label against itself.

python benchmarks/simulator.py --num_grasps 300 --out benchmarks/results/simulator.json
Grasps are drawn from the grasp set, over all categories and half of them such as hold. Each is executed at the working
setting, at the reference setting (1 ms, noslip, no early stopping), and at the working setting with the wrist moved by
0.1, 1 and 3 mm.
"""

import argparse
import json
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from dexzoo.data.grasp_set import GraspSet
from dexzoo.grasp import Grasps
from dexzoo.hand import default_hand
from dexzoo.sim import Scene, trial
from dexzoo.sim.shapes import make_object
from dexzoo.sim.world import REFERENCE, WORKING

OFFSETS = (0.0001, 0.001, 0.003)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=Path("assets/grasps"))
    parser.add_argument("--num_grasps", type=int, default=300)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    data = GraspSet(options.data)
    rows = draw(data, options.num_grasps)
    labels: dict[str, list[np.ndarray]] = {}
    seconds = dict.fromkeys(("working", "reference"), 0.0)
    rng = np.random.default_rng(0)
    for scene_row in np.unique(data.grasp_scene[rows]):
        here = rows[data.grasp_scene[rows] == scene_row]
        scene = rebuild(data, int(scene_row))
        grasps = Grasps(data.world_grasps.waypoints[torch.tensor(here)], "world")
        runs = {"stored": data.success[here]}
        for name, physics in (("working", WORKING), ("reference", REFERENCE)):
            start = time.perf_counter()
            runs[name] = trial.run(scene, grasps, default_hand(), physics=physics).success
            seconds[name] += time.perf_counter() - start
        for offset in OFFSETS:
            moved = grasps.waypoints.clone()
            step = rng.normal(size=(len(here), 1, 3))
            moved[..., :3] += torch.tensor(offset * step / np.linalg.norm(step, axis=-1, keepdims=True)).float()
            runs[f"moved {1000 * offset:g} mm"] = trial.run(scene, Grasps(moved, "world"), default_hand()).success
        for name, values in runs.items():
            labels.setdefault(name, []).append(values)
        sys.stderr.write(f"{sum(len(part) for part in labels['stored'])} of {len(rows)}\n")
    joined = {name: np.concatenate(parts) for name, parts in labels.items()}
    result = {
        "grasps": len(rows),
        "hold": float(joined["stored"].mean()),
        "agreement_with_working": {
            name: float((values == joined["working"]).mean()) for name, values in joined.items() if name != "working"
        },
        "trials_per_second": {name: len(rows) / value for name, value in seconds.items()},
    }
    text = json.dumps(result, indent=2)
    if options.out:
        options.out.write_text(text + "\n")
    sys.stdout.write(text + "\n")


def draw(data: GraspSet, num: int) -> np.ndarray:
    """As many that hold as that fail, from every fifth scene, so that each model serves several trials."""
    rng = np.random.default_rng(0)
    some = data.grasp_scene % 5 == 0
    held, failed = np.flatnonzero(data.success & some), np.flatnonzero(~data.success & some)
    return np.sort(
        np.concatenate((rng.choice(held, num // 2, replace=False), rng.choice(failed, num // 2, replace=False)))
    )


def rebuild(data: GraspSet, row: int) -> Scene:
    """The scene of a row of scenes.parquet."""
    stored = data.scenes.slice(row, 1).to_pylist()[0]
    obj = make_object(stored["object"]).scaled(stored["scale"])
    obj = replace(obj, mass=stored["mass"], friction=stored["friction"])
    return Scene(obj, np.array(stored["T_world_object"]).reshape(4, 4))


if __name__ == "__main__":
    main()

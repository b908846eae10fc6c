"""Count the contents of a grasp set, and check them.

python benchmarks/data.py --out benchmarks/results/data.json
python benchmarks/data.py --data DIR --again 500 --views out/views.png
--again tries that many grasps again, at the working setting and at the reference; --views draws some views for
inspection.
"""

import argparse
import json
import sys
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import torch

from dexzoo.collection.collect import NEIGHBOR_RATIO, SCALE_RANGE
from dexzoo.collection.rendering import rebuild, render
from dexzoo.data.grasp_set import GraspSet
from dexzoo.data.schema import SPLITS
from dexzoo.data.writer import MANIFEST
from dexzoo.grasp import GRASP_TYPES
from dexzoo.sim import trial
from dexzoo.sim.world import REFERENCE, WORKING
from dexzoo.verification import FRICTION

RANKS = (0, 1, 5, 10, 25, 50, 100)
GRASPS_A_SCENE = 5
COLUMNS, ROWS = 8, 6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("assets/grasps"))
    parser.add_argument("--again", type=int, default=0)
    parser.add_argument("--views", type=Path)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    data = GraspSet(options.data, renderer=render)
    result = count(data, json.loads((options.data / MANIFEST).read_text()))
    if options.again:
        result["tried_again"] = agreement(data, options.again)
    if options.views:
        options.views.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(options.views), picture(data))
    text = json.dumps(result, indent=2)
    if options.out:
        options.out.write_text(text + "\n")
    sys.stdout.write(text + "\n")


def count(data: GraspSet, manifest: dict) -> dict[str, object]:
    category = np.array(data.scenes["category"].to_pylist())[data.grasp_scene]
    kind = np.array(GRASP_TYPES)[data.grasps["grasp_type"].to_numpy()]
    objects = np.array(data.scenes["object"].to_pylist())
    split = np.array(data.scenes["split"].to_pylist())
    rank = data.grasps["rank"].to_numpy()
    generated = data.source == "generated"

    def by(values: np.ndarray, chosen: np.ndarray) -> dict[str, dict[str, float]]:
        return {str(value): share((values == value) & chosen) for value in sorted(set(values[chosen]))}

    def share(chosen: np.ndarray) -> dict[str, float]:
        return {"grasps": int(chosen.sum()), "hold": float(data.success[chosen].mean())}

    every, splits = np.ones_like(generated), np.array(SPLITS)[data.grasp_split]
    ranks = {
        f"{low + 1} to {high}" if high > low + 1 else str(high): generated & (low <= rank) & (rank < high)
        for low, high in pairwise(RANKS)
    }
    return {
        "configuration": manifest["configuration"],
        "scale": SCALE_RANGE,
        "friction": FRICTION,
        "neighbors_per_generated": NEIGHBOR_RATIO,
        "grasps": len(data.success),
        "scenes": data.scenes.num_rows,
        "skipped": manifest["counts"]["skipped"],
        "hold_of_all_generated": manifest["counts"]["held"] / max(manifest["counts"]["generated"], 1),
        "views": data.views.num_rows,
        "megabytes": sum(path.stat().st_size for path in Path(data.address).rglob("*.parquet")) / 1e6,
        "objects": {name: len(set(objects[split == name])) for name in SPLITS},
        "hold": float(data.success.mean()),
        "collided": int(np.sum(data.grasps["collided"].to_numpy())),
        "starts_inside": int(np.sum(np.nan_to_num(data.grasps["starts_inside"].to_numpy().astype(float)))),
        "unstable": int(np.sum(data.grasps["unstable"].to_numpy())),
        "duplicates": len(data.paths) - len(np.unique(data.paths, axis=0)),
        "outside_limits": outside_limits(data),
        "by_split": by(splits, every),
        "by_source": by(np.char.add(np.char.add(data.source.astype(str), ", "), splits), every),
        "by_category": by(category, generated),
        "by_type": by(kind, generated),
        "by_rank": {name: share(chosen) for name, chosen in ranks.items() if chosen.any()},
    }


def outside_limits(data: GraspSet) -> int:
    """Grasps with a waypoint whose joints leave their limits."""
    hand, joints = data.hand, data.world_grasps.joints
    wrong = (joints < hand.lower - 1e-4) | (joints > hand.upper + 1e-4)
    return int(wrong.flatten(1).any(1).sum())


def agreement(data: GraspSet, num: int) -> dict[str, object]:
    """Agreement between the labels of grasps drawn from all scenes and those of repeated trials."""
    rng = np.random.default_rng(0)
    scenes = rng.permutation(data.scenes.num_rows)[: -(-num // GRASPS_A_SCENE)]
    labels: dict[str, list[np.ndarray]] = {"stored": [], "working": [], "reference": []}
    for done, number in enumerate(scenes, 1):
        rows = rng.permutation(np.flatnonzero(data.grasp_scene == number))[:GRASPS_A_SCENE]
        scene = rebuild(data.scenes.slice(number, 1).to_pylist()[0])
        grasps = data.world_grasps[torch.tensor(rows)]
        labels["stored"].append(data.success[rows])
        for name, physics in (("working", WORKING), ("reference", REFERENCE)):
            labels[name].append(trial.run(scene, grasps, physics=physics).success)
        sys.stderr.write(f"{done} of {len(scenes)} scenes tried again\n")
    joined = {name: np.concatenate(parts) for name, parts in labels.items()}
    return {
        "grasps": len(joined["stored"]),
        "hold": {name: float(values.mean()) for name, values in joined.items()},
        "agree_at_working_setting": float((joined["stored"] == joined["working"]).mean()),
        "agree_at_reference_setting": float((joined["stored"] == joined["reference"]).mean()),
        "reference": asdict(REFERENCE),
    }


def picture(data: GraspSet) -> np.ndarray:
    """Random views of the set: near is bright; black means no reading, or not the object."""
    rng = np.random.default_rng(0)
    chosen = np.sort(rng.permutation(data.views.num_rows)[: COLUMNS * ROWS])
    tiles = []
    for view in chosen:
        seen = data.observation(int(view))
        near, far = seen.depth[seen.mask].min(), seen.depth[seen.mask].max()
        gray = np.where(seen.mask, 255 - 200 * (seen.depth - near) / max(far - near, 1e-6), 0).astype(np.uint8)
        name = data.scenes["object"][int(data.view_scene[view])].as_py()
        tiles.append(cv2.putText(np.ascontiguousarray(gray), name, (6, 216), cv2.FONT_HERSHEY_SIMPLEX, 0.5, 255))
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % COLUMNS)
    return np.vstack([np.hstack(tiles[i : i + COLUMNS]) for i in range(0, len(tiles), COLUMNS)])


if __name__ == "__main__":
    main()

"""Count what a grasp set holds.

python benchmarks/data.py --out benchmarks/results/data.json
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from dexzoo.data.schema import SPLITS, GraspSet
from dexzoo.grasp import GRASP_TYPES


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=Path("assets/grasps"))
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    text = json.dumps(count(GraspSet(options.data)), indent=2)
    if options.out:
        options.out.write_text(text + "\n")
    sys.stdout.write(text + "\n")


def count(data: GraspSet) -> dict[str, object]:
    category = np.array(data.scenes["category"].to_pylist())[data.grasp_scene]
    kind = np.array(GRASP_TYPES)[data.grasps["grasp_type"].to_numpy()]
    objects = np.array(data.scenes["object"].to_pylist())
    split = np.array(data.scenes["split"].to_pylist())
    paths = data.grasps["path"].combine_chunks().flatten().to_numpy().reshape(-1, 66)

    def by(values: np.ndarray) -> dict[str, dict[str, float]]:
        return {
            str(value): {"grasps": int((values == value).sum()), "hold": float(data.success[values == value].mean())}
            for value in np.unique(values)
        }

    return {
        "grasps": len(data.success),
        "scenes": data.scenes.num_rows,
        "views": data.views.num_rows,
        "objects": {name: len(set(objects[split == name])) for name in SPLITS},
        "hold": float(data.success.mean()),
        "collided": int(np.sum(data.grasps["collided"].to_numpy(zero_copy_only=False))),
        "unstable": int(np.sum(data.grasps["unstable"].to_numpy(zero_copy_only=False))),
        "duplicates": len(paths) - len(np.unique(paths, axis=0)),
        "by_split": by(np.array(SPLITS)[data.grasp_split]),
        "by_source": by(data.source),
        "by_category": by(category),
        "by_type": by(kind),
    }


if __name__ == "__main__":
    main()

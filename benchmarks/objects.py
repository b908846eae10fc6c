"""The objects by category: how many, how large, how many convex parts, how well these fit, how long they take.

python benchmarks/objects.py --out benchmarks/results/objects.json
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

from dexzoo.sim.fit import surface_distance
from dexzoo.sim.shapes import NUM_OBJECTS, make_object, object_names, split_of


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    categories = {}
    for category in NUM_OBJECTS:
        categories[category] = row(category)
        sys.stderr.write(f"{category}\n")
    rows = list(categories.values())
    result = {
        "objects": len(object_names()),
        "worst_surface_distance_mm": max(row["worst_surface_distance_mm"] for row in rows),
        "most_parts": max(row["parts"][1] for row in rows),
        "seconds_to_make_all": round(sum(row["seconds_to_make"] for row in rows), 1),
        "categories": categories,
    }
    text = json.dumps(result, indent=2)
    if options.out:
        options.out.write_text(text + "\n")
    sys.stdout.write(text + "\n")


def row(category: str) -> dict[str, object]:
    names = [name for name in object_names() if name.startswith(f"{category}_")]
    start = time.process_time()
    models = [make_object(name) for name in names]
    seconds = time.process_time() - start
    sizes = np.array([np.sort(model.mesh.extents)[::-1] for model in models])
    splits = [split_of(name) for name in names]
    return {
        **{split: splits.count(split) for split in ("train", "validation", "test")},
        "longest_side_mm": span(sizes[:, 0] * 1000),
        "shortest_side_mm": span(sizes[:, 2] * 1000),
        "parts": span(np.array([len(model.hulls) for model in models])),
        "faces": span(np.array([len(model.mesh.faces) for model in models])),
        "worst_surface_distance_mm": round(1000 * max(surface_distance(model) for model in models), 2),
        "seconds_to_make": round(seconds, 2),
    }


def span(values: np.ndarray) -> list[int]:
    return [round(values.min()), round(values.max())]


if __name__ == "__main__":
    main()

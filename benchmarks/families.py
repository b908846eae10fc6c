"""The families of shapes: how many parts, how well these fit, how many are drawn again, how long it takes, rest, grip.

python benchmarks/families.py --num 30 --out benchmarks/results/families.json
A width can be spanned where the object is at most 85 mm wide along x or y, or across in any level direction.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

from dexzoo import sim
from dexzoo.sim import families
from dexzoo.sim.fit import surface_distance
from dexzoo.sim.objects import ObjectModel

SPAN = 0.085


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num", type=int, default=30, help="seeds of each family")
    parser.add_argument("--families", nargs="*", default=families.family_names())
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    result = {}
    for family in options.families:
        result[family] = row(family, options.num)
        sys.stderr.write(f"{family} {result[family]}\n")
    text = json.dumps({"seeds": options.num, "families": result}, indent=2)
    if options.out:
        options.out.write_text(text + "\n")
    sys.stdout.write(text + "\n")


def row(family: str, num: int) -> dict[str, object]:
    models, seconds, tries = [], 0.0, 0
    for seed in range(num):
        for attempt in range(40):
            start = time.process_time()
            model = families.draw_shape(families.shape_name(family, seed), attempt)
            seconds += time.process_time() - start
            tries += 1
            if model is not None:
                models.append(model)
                break
    return {
        "made": len(models),
        "seconds_each": round(seconds / len(models), 2),
        "drawn_again": round(1 - len(models) / tries, 2),
        "parts": np.percentile([len(model.hulls) for model in models], [0, 50, 100]).round().astype(int).tolist(),
        "longest_side_mm": np.percentile([1000 * m.mesh.extents.max() for m in models], [0, 50, 100]).round().tolist(),
        "worst_surface_distance_mm": round(1000 * float(max(surface_distance(m, 6000, 1, 0.0015) for m in models)), 2),
        "rests": round(float(np.mean([rests(model) for model in models])), 2),
        "can_be_spanned": round(float(np.mean([width(model) <= SPAN for model in models])), 2),
    }


def rests(model: ObjectModel) -> bool:
    try:
        sim.Scene.place(model, seed=0)
    except ValueError:
        return False
    return True


def width(model: ObjectModel) -> float:
    """The least width of the object along level directions."""
    angle = np.linspace(0, np.pi, 36, endpoint=False)
    along = model.mesh.vertices[:, :2] @ np.stack((np.cos(angle), np.sin(angle)))
    return float(np.ptp(along, axis=0).min())


if __name__ == "__main__":
    main()

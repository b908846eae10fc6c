"""What refinement does to the verified success: the same trials before and after, on test objects.

python benchmarks/refine.py --out benchmarks/results/refine.json
Each group of variables is refined and executed apart; transitions are counted grasp by grasp.
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np

import dexzoo
from dexzoo.sim.shapes import make_object, object_names, split_of

GROUPS = {
    "A: 2 steps, all waypoints": ("waypoints", 2),
    "B: 2 steps, last three": ("last3", 2),
    "C: 20 steps, last three": ("last3", 20),
    "grip: 20 steps, wrist and 15 joints": ("grip", 20),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--evaluator", default="em2")
    parser.add_argument("--scenes", type=int, default=24)
    parser.add_argument("--num_grasps", type=int, default=30)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    model = dexzoo.load(options.evaluator)
    objects = [name for name in object_names() if split_of(name) == "test"]
    before: list[np.ndarray] = []
    after: dict[str, list[np.ndarray]] = {name: [] for name in GROUPS}
    collided: dict[str, int] = dict.fromkeys(GROUPS, 0)
    rise: dict[str, list[float]] = {name: [] for name in GROUPS}
    for index in range(options.scenes):
        scene = dexzoo.sim.Scene.place(make_object(objects[index % len(objects)]), seed=1000 + index)
        observation = scene.observe(seed=index)
        try:
            grasps = dexzoo.generate(observation, options.num_grasps, seed=index)
        except RuntimeError:
            continue
        before.append(dexzoo.verify(grasps, scene).success)
        for name, (variables, steps) in GROUPS.items():
            rate = 0.2 if variables == "grip" else 0.01
            result = dexzoo.refine(grasps, observation, model, variables=variables, num_steps=steps, learning_rate=rate)
            outcomes = dexzoo.verify(result.grasps, scene)
            after[name].append(outcomes.success)
            collided[name] += int(outcomes.collided.sum())
            rise[name] += (result.score_after - result.score_before).tolist()
        sys.stderr.write(f"{index + 1} of {options.scenes} scenes\n")
    was = np.concatenate(before)
    result = {
        "evaluator": options.evaluator,
        "scenes": len(before),
        "grasps": len(was),
        "success_before": float(was.mean()),
        "groups": {name: row(before, after[name], collided[name], float(np.mean(rise[name]))) for name in GROUPS},
    }
    text = json.dumps(result, indent=2)
    if options.out:
        options.out.write_text(text + "\n")
    sys.stdout.write(text + "\n")


def row(before: list[np.ndarray], after: list[np.ndarray], collided: int, rise: float) -> dict[str, object]:
    was, now = np.concatenate(before), np.concatenate(after)
    rng = np.random.default_rng(0)
    draws = [rng.integers(len(before), size=len(before)) for _ in range(1000)]
    change = [
        np.concatenate([after[i] for i in draw]).mean() - np.concatenate([before[i] for i in draw]).mean()
        for draw in draws
    ]
    return {
        "success_after": float(now.mean()),
        "change": float(now.mean() - was.mean()),
        "change_interval": [float(x) for x in np.percentile(change, [2.5, 97.5])],
        "success_to_fail": int((was & ~now).sum()),
        "fail_to_success": int((~was & now).sum()),
        "collided": collided,
        "mean_rise_of_score": rise,
    }


if __name__ == "__main__":
    main()

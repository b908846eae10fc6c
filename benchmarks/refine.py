"""What refinement does to the verified success: the same trials before and after, of the Kopicki generator's grasps.

python benchmarks/refine.py --evaluator RUN --judge OTHER_RUN --out benchmarks/results/refinement.json
The objects of a split come round in turn, each scene with its own drawn mass and friction, in which a grasp is tried as
given and as refined. `--folder` keeps what was done in each scene, so that a run can be continued: take a new one when
the program, the meshes or what a try's name means has changed. Hyper-parameters are chosen with `--split validation`
and `--tries FILE`: JSON of names, and for each the arguments of `dexzoo.refine` that differ. Intervals are 95 %
bootstrap over scenes; OMP_NUM_THREADS bounds the threads. The simulator selects nothing.
"""

import argparse
import json
import math
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from generator import Setting, set_scene
from generator_figures import FLAGS
from refine_figures import Given, Refined, compared

import dexzoo
from dexzoo import Grasps, Observation
from dexzoo.generators.density import GraspDensity
from dexzoo.generators.kopicki import KopickiGenerator
from dexzoo.grasp import GRIP
from dexzoo.hand import default_hand
from dexzoo.models.evaluator import GraspEvaluator
from dexzoo.refinement import Refinement, Region, Weights, method, thesis
from dexzoo.sim import Scene, trial

METHOD = "method"
SPLITS = ("test", "validation")
NUM_POINTS = 500
"""Observed points by which penetration is measured."""
Variant = Callable[[Grasps, Observation, GraspDensity], Refinement]


def by_refine(evaluator: GraspEvaluator, judge: GraspEvaluator | None, **arguments: Any) -> Variant:  # noqa: ANN401
    def run(grasps: Grasps, view: Observation, density: GraspDensity) -> Refinement:
        return dexzoo.refine(grasps, view, evaluator, judge=judge, density=density, **arguments)

    return run


def whatever_rises(run: Variant) -> Variant:
    """The variant without acceptance: what the climb found is taken wherever the objective rose."""

    def taken(grasps: Grasps, view: Observation, density: GraspDensity) -> Refinement:
        with patch.object(method, "MAX_LACK", math.inf):
            return run(grasps, view, density)

    return taken


def by_thesis(evaluator: GraspEvaluator, group: str) -> Variant:
    return lambda grasps, view, _: thesis.ascend(grasps, view, evaluator, group=group)


def variants(
    model: GraspEvaluator, judge: GraspEvaluator | None, others: dict[str, GraspEvaluator], tries: Path | None
) -> dict[str, Variant]:
    """All that can be run, by name, the method first."""
    by = partial(by_refine, model, judge)
    known = {
        METHOD: by(),
        **{f"group {name}": by_thesis(model, name) for name in thesis.GROUPS},
        "L-BFGS": by(optimiser="lbfgs"),
        "Metropolis-Hastings": by(optimiser="metropolis"),
        "random search": by(optimiser="random"),
        "no prior": by(weights=Weights(prior=0.0)),
        "no penetration or shadow": by(weights=Weights(penetration=0.0, shadow=0.0)),
        "no table, nor its test": by(weights=Weights(table=0.0)),
        "no self-collision": by(weights=Weights(self_collision=0.0)),
        "no coupling": by(variables="uncoupled"),
        "no acceptance": whatever_rises(by_refine(model, None)),
        "280 free numbers": by(variables="waypoints"),
    }
    if judge is None:
        known["judge ffh"] = by_refine(model, dexzoo.load("ffh"))

    def add(source: str, name: str, variant: Variant) -> None:
        if name in known:
            raise ValueError(f"{source}: the name {name!r} is taken; use another")
        known[name] = variant

    for label, other in others.items():
        add("--others", label, by_refine(other, judge))
        for group in thesis.GROUPS:
            add("--others", f"group {group} by {label}", by_thesis(other, group))
    if tries:
        for name, arguments in json.loads(tries.read_text()).items():
            for key, kind in (("region", Region), ("weights", Weights)):
                if key in arguments:
                    arguments[key] = kind(**arguments[key])
            add(str(tries), name, by(**arguments))
    return known


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--evaluator", default="em_fk", help="what guides: name, file or folder")
    parser.add_argument("--judge", help="what accepts, the same")
    parser.add_argument(
        "--others", nargs="*", default=[], metavar="NAME=MODEL", help="evaluators that guide in its place, as variants"
    )
    parser.add_argument("--tries", type=Path, help="JSON of further variants")
    parser.add_argument("--variants", nargs="+", metavar="NAME", help="default: all")
    parser.add_argument("--split", default="test", choices=SPLITS)
    parser.add_argument(
        "--meshes", type=Path, help="folder of objects, as benchmarks/meshes.py takes it, for the split"
    )
    parser.add_argument("--scenes", type=int, default=150)
    parser.add_argument("--num_grasps", type=int, default=40)
    parser.add_argument("--done", action="store_true", help="try nothing more, sum up what the folder holds")
    parser.add_argument("--folder", type=Path, default=Path("out/refine"))
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    model = dexzoo.load(options.evaluator)
    judge = dexzoo.load(options.judge) if options.judge else None
    if unnamed := [other for other in options.others if "=" not in other]:
        parser.error(f"--others takes NAME=MODEL, got {', '.join(unnamed)}")
    others = {name: dexzoo.load(other) for name, other in (one.split("=", 1) for one in options.others)}
    try:
        known = variants(model, judge, others, options.tries)
    except ValueError as error:
        parser.error(str(error))
    names = options.variants or list(known)
    if unknown := set(names) - set(known):
        parser.error(f"variants {', '.join(sorted(unknown))} are unknown; use some of {', '.join(known)}")
    if options.meshes and not any(options.meshes.glob("*/mesh.obj")):
        parser.error(f"folder {options.meshes} holds no NAME/mesh.obj; give a folder of objects' folders")
    source = "meshes" if options.meshes else options.split
    folder = options.folder / f"{source}_{options.num_grasps}"
    # what was refined depends on who guided and who judged
    refined = folder / "_".join(one.digest[:8] if one else "nobody" for one in (model, judge))
    if not options.done:
        chosen = {name: known[name] for name in names}
        run(
            chosen,
            partial(set_scene, options.split, options.meshes),
            folder,
            refined,
            options.scenes,
            options.num_grasps,
        )
    given = Given.load_all(folder / "given", options.scenes)
    done = {name: Refined.load_all(refined / name, options.scenes) for name in names}
    if not any(done.values()):
        parser.error(f"folder {refined} holds nothing of {', '.join(names)}; run without --done first")
    result = {
        "evaluator": options.evaluator,
        "judge": options.judge,
        "digest": {"evaluator": model.digest, "judge": judge.digest if judge else None},
        "others": {name: other.digest for name, other in others.items()},
        "defaults": method.default_settings(),
        "split": source,
        "num_grasps": options.num_grasps,
        "without_grasp": sum(not len(row) for row in given.values()),
        "threads": torch.get_num_threads(),
        "variants": compared(given, done),
    }
    text = json.dumps(result, indent=2)
    if options.out:
        options.out.write_text(text + "\n")
    sys.stdout.write(text + "\n")


def run(
    chosen: dict[str, Variant], setting: Setting, folder: Path, refined: Path, scenes: int, num_grasps: int
) -> None:
    """Try what is not yet there, all variants on a scene before the next scene."""
    generator = KopickiGenerator()
    for number in range(scenes):
        paths = {name: refined / name / f"{number:03d}.npz" for name in chosen}
        missing = {name: path for name, path in paths.items() if not path.exists()}
        if not missing:
            continue
        try:
            scene, view, seed, _ = setting(number)
        except ValueError as error:
            sys.stderr.write(f"{error}\n")
            continue
        path = folder / "given" / f"{number:03d}.npz"
        if not path.exists():
            give(generator, scene, view, seed, num_grasps).save(path)
        given = Given.load(path)
        if not len(given):
            sys.stderr.write(f"{number} {given.object}: no grasp is found\n")
            continue
        density = generator.density(view, seed)
        grasps = Grasps(torch.tensor(given.waypoints), "world")
        for name, path in missing.items():
            row = attempt(chosen[name], grasps, given, scene, view, density)
            row.save(path)
            held = f"{given.success.sum()} of {len(given)} held, then {row.success.sum()}"
            sys.stderr.write(f"{number} {given.object}, {name}: {held}\n")


def give(generator: KopickiGenerator, scene: Scene, view: Observation, seed: int, num_grasps: int) -> Given:
    """The generator's grasps of a view, tried; none where it gives up."""
    try:
        grasps = generator.generate(view, num_grasps, seed).to_frame("world", view.T_world_camera)
    except (RuntimeError, ValueError):  # as the interface says
        grasps = Grasps(torch.zeros(0, 10, 28), "world")
    obj = scene.object
    return Given(
        obj.name, obj.category or obj.name, grasps.waypoints.numpy(), tried(scene, grasps), depth(view, grasps)
    )


def attempt(
    variant: Variant, grasps: Grasps, given: Given, scene: Scene, view: Observation, density: GraspDensity
) -> Refined:
    """Refine and try; a grasp that was not replaced is not tried again, since its trial is the same to the last bit."""
    start = np.array([time.perf_counter(), time.process_time()])
    result = variant(grasps, view, density)
    cost = np.array([time.perf_counter(), time.process_time()]) - start
    replaced = result.accepted.numpy()
    outcome, deepest = given.outcome.copy(), given.penetration.copy()
    after = result.grasps[np.flatnonzero(replaced)]
    outcome[replaced], deepest[replaced] = tried(scene, after), depth(view, after)
    return Refined(
        replaced,
        result.failed.numpy(),
        *(_numbers(score, len(grasps)) for score in (result.score_before, result.score_after)),
        *(_numbers(score, len(grasps)) for score in (result.judge_before, result.judge_after)),
        outcome,
        deepest,
        cost,
    )


def tried(scene: Scene, grasps: Grasps) -> np.ndarray:
    """(n, 4) bool, columns FLAGS."""
    outcomes = trial.run(scene, grasps, default_hand(), torch.get_num_threads())
    return np.stack([getattr(outcomes, flag) for flag in FLAGS], -1)


def depth(view: Observation, grasps: Grasps) -> np.ndarray:
    """(n,) metres that an observed point lies at most in a link, up to the grip."""
    hand, points = default_hand(), torch.from_numpy(view.points_world)
    points = points[torch.linspace(0, len(points) - 1, min(NUM_POINTS, len(points))).long()]
    deepest: list[float] = []
    for row in range(len(grasps)):
        links = grasps.wrist_pose[row, : GRIP + 1, None] @ hand.forward_kinematics(grasps.joints[row, : GRIP + 1])
        deepest.append(float(-hand.signed_distance(links, points).amin().clamp_max(0)))
    return np.array(deepest)


def _numbers(values: torch.Tensor | None, count: int) -> np.ndarray:
    return np.full(count, np.nan) if values is None else values.numpy()


if __name__ == "__main__":
    main()

"""What refinement does to the verified success: the same trials before and after, of the Kopicki generator's grasps.

python benchmarks/refine.py --evaluator RUN --judge OTHER_RUN --out benchmarks/results/refinement.json
The objects of a split come round in turn, each scene with its own drawn mass and friction, in which a grasp is tried as
given and as refined. `--folder` keeps what was done in each scene, so that a run can be continued: take a new one when
the program, the meshes or what a try's name means has changed. Hyper-parameters are chosen with `--split validation`
and `--tries FILE`: JSON of names, and for each the arguments of `dexzoo.refine` that differ, where `weights` holds
weights of terms by name, 0 to do without, and `variables` is "grip", "uncoupled" or "waypoints". Intervals are 95 %
bootstrap over scenes; OMP_NUM_THREADS bounds the threads. The simulator selects nothing.
"""

import argparse
import inspect
import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from generator import HAND, Setting, kopicki, set_scene
from generator_figures import FLAGS
from refine_figures import Given, Refined, compared

import dexzoo
from dexzoo import Grasps, Observation
from dexzoo.generators import GraspDensity, GraspGenerator
from dexzoo.generators.generator import MIN_CLEARANCE
from dexzoo.grasp import GRIP, Trajectory
from dexzoo.hand import Hand
from dexzoo.models.evaluator import GraspEvaluator
from dexzoo.perception import View
from dexzoo.perception.view import SHADOW_DEPTHS, SUPPORT_SHARE
from dexzoo.refinement import Refinement, Term, TrustRegion, default_terms
from dexzoo.refinement.refinement import NUM_STEPS, STEP_SIZE
from dexzoo.refinement.terms import AROUND, MAX_LACK, Penetration, Prior, SelfCollision, Shadow, Spread, Table
from dexzoo.refinement.variables import GripVariables
from dexzoo.sim import Scene, trial
from experiments import thesis_ascent
from experiments.variables import UncoupledVariables, WaypointVariables

METHOD = "method"
SPLITS = ("test", "validation")
NUM_POINTS = 500
"""Observed points by which penetration is measured."""
WEIGHED = (Spread, Prior, Penetration, Shadow, Table, SelfCollision)
"""The terms beside the log-odds, in the order of a record."""
VARIABLES = {"grip": GripVariables, "uncoupled": UncoupledVariables, "waypoints": WaypointVariables}
Variant = Callable[[Grasps, Observation, GraspDensity], Refinement]
Choice = Callable[[list[Term]], list[Term]]
"""What is climbed in place of the default terms."""


def by_refine(
    evaluator: GraspEvaluator,
    judge: GraspEvaluator | None,
    terms: Choice = list,
    **arguments: Any,  # noqa: ANN401, whatever refine takes
) -> Variant:
    def run(grasps: Grasps, view: Observation, density: GraspDensity) -> Refinement:
        chosen = terms(default_terms(evaluator, density))
        return dexzoo.refine(grasps, view, evaluator, judge=judge, terms=chosen, **arguments)

    return run


def without(*names: str) -> Choice:
    """All terms but some."""
    return lambda terms: [term for term in terms if term.name not in names]


def weighed(weights: dict[str, float]) -> Choice:
    """The terms with other weights, some by name; one of weight 0 is left out. ValueError for a name there is not."""
    known = {"log_odds", *(term.name for term in WEIGHED)}
    if unknown := set(weights) - known:
        raise ValueError(f"terms {', '.join(sorted(unknown))} are unknown; use some of {', '.join(sorted(known))}")

    def choose(terms: list[Term]) -> list[Term]:
        for term in terms:
            term.weight = weights.get(term.name, term.weight)
        return [term for term in terms if term.weight]

    return choose


class Untested(Table):
    """The term without its test: what the climb found is taken wherever the objective rose."""

    def accepts(self, view: View, hand: Hand, before: Trajectory, after: Trajectory) -> torch.Tensor:
        """All may be replaced."""
        return Term.accepts(self, view, hand, before, after)


def whatever_rises(terms: list[Term]) -> list[Term]:
    """The terms, none of which objects to a replacement."""
    return [Untested(term.weight) if isinstance(term, Table) else term for term in terms]


def by_thesis(evaluator: GraspEvaluator, group: str) -> Variant:
    return lambda grasps, view, _: thesis_ascent.ascend(grasps, view, evaluator, group=group)


def default_settings() -> dict[str, Any]:
    """What is set where no argument is given, and the lengths that terms and acceptance go by: for a record.

    Weights are told without their sign: the prior is added, the others are subtracted.
    """
    return {
        "region": asdict(TrustRegion()),
        "weights": {term.name: abs(inspect.signature(term).parameters["weight"].default) for term in WEIGHED},
        "num_steps": NUM_STEPS,
        "step_size": STEP_SIZE,
        "clearance": {"table": MIN_CLEARANCE, "around": AROUND, "middle": SUPPORT_SHARE, "lack": MAX_LACK},
        "shadow": list(SHADOW_DEPTHS),
    }


def variants(
    model: GraspEvaluator, judge: GraspEvaluator | None, others: dict[str, GraspEvaluator], tries: Path | None
) -> dict[str, Variant]:
    """All that can be run, by name, the method first."""
    by = partial(by_refine, model, judge)
    known = {
        METHOD: by(),
        **{f"group {name}": by_thesis(model, name) for name in thesis_ascent.GROUPS},
        "L-BFGS": by(optimizer="lbfgs"),
        "Metropolis-Hastings": by(optimizer="metropolis"),
        "random search": by(optimizer="random"),
        "no prior": by(without("prior")),
        "no penetration or shadow": by(without("penetration", "shadow")),
        "no table, nor its test": by(without("table")),
        "no self-collision": by(without("self_collision")),
        "no coupling": by(variables=UncoupledVariables),
        "no acceptance": by_refine(model, None, whatever_rises),
        "280 free numbers": by(variables=WaypointVariables),
    }
    if judge is None:
        known["judge ffh"] = by_refine(model, dexzoo.load("ffh"))

    def add(source: str, name: str, variant: Variant) -> None:
        if name in known:
            raise ValueError(f"{source}: the name {name!r} is taken; use another")
        known[name] = variant

    for label, other in others.items():
        add("--others", label, by_refine(other, judge))
        for group in thesis_ascent.GROUPS:
            add("--others", f"group {group} by {label}", by_thesis(other, group))
    if tries:
        for name, arguments in json.loads(tries.read_text()).items():
            if "trust_region" in arguments:
                arguments["trust_region"] = TrustRegion(**arguments["trust_region"])
            if "variables" in arguments:
                kind = arguments["variables"]
                if kind not in VARIABLES:
                    raise ValueError(f"{tries}: variables {kind!r} are unknown; use one of {', '.join(VARIABLES)}")
                arguments["variables"] = VARIABLES[kind]
            add(str(tries), name, by(weighed(arguments.pop("weights", {})), **arguments))
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
        "defaults": default_settings(),
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
    generator = kopicki()
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
        grasps = given.grasps(HAND)
        for name, path in missing.items():
            row = attempt(chosen[name], grasps, given, scene, view, density)
            row.save(path)
            held = f"{given.success.sum()} of {len(given)} held, then {row.success.sum()}"
            sys.stderr.write(f"{number} {given.object}, {name}: {held}\n")


def give(generator: GraspGenerator, scene: Scene, view: Observation, seed: int, num_grasps: int) -> Given:
    """The generator's grasps of a view, tried; none where it gives up."""
    try:
        grasps = generator.generate(view, num_grasps, seed)
    except (RuntimeError, ValueError):  # as the interface says
        grasps = Grasps.none(generator.hand)
    obj = scene.object
    arrays = (value.numpy() for value in (grasps.wrist, grasps.joints, grasps.grasp_type))
    return Given(obj.name, obj.category or obj.name, *arrays, tried(scene, grasps), depth(view, grasps))


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
    outcomes = trial.run(scene, grasps, torch.get_num_threads())
    return np.stack([getattr(outcomes, flag) for flag in FLAGS], -1)


def depth(view: Observation, grasps: Grasps) -> np.ndarray:
    """(n,) meters that an observed point lies at most in a link, up to the grip."""
    points = torch.from_numpy(view.points_world)
    points = points[torch.linspace(0, len(points) - 1, min(NUM_POINTS, len(points))).long()]
    deepest: list[float] = []
    for row in range(len(grasps)):
        posture = grasps.hand.forward_kinematics(grasps.joints[row, : GRIP + 1])
        links = grasps.wrist_pose[row, : GRIP + 1, None] @ posture
        deepest.append(float(-grasps.hand.signed_distance(links, points).amin().clamp_max(0)))
    return np.array(deepest)


def _numbers(values: torch.Tensor | None, count: int) -> np.ndarray:
    return np.full(count, np.nan) if values is None else values.numpy()


if __name__ == "__main__":
    main()

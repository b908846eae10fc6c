"""What the generators' grasps are worth: one view of each scene, every grasp tried once in the simulator.

python benchmarks/generator.py --out benchmarks/results/generator.json --pictures docs
The objects of a split come round in turn; scale, mass and friction are drawn as for the grasp set. `--folder` keeps
what each variant did in each scene, so that a run can be continued: take a new one when the generator has changed.
Intervals are 95 % bootstrap over scenes. The first of `--variants` is what the others are compared with, on the scenes
they share. OMP_NUM_THREADS bounds the threads. `--growth` takes the time for more and more kernels and samples instead.
"""

import argparse
import json
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import generator_pictures
import numpy as np
import torch
from generator_figures import COSTS, FLAGS, TOP, Trials, compared
from torch import Tensor

from dexzoo import verification
from dexzoo.collection.collect import SCALE_RANGE, object_of
from dexzoo.generators import GraspGenerator
from dexzoo.generators.approach import ApproachMotion
from dexzoo.generators.contact_density import ContactDensity, Grips
from dexzoo.generators.demonstration import load_demonstrations
from dexzoo.generators.heuristic import HeuristicGenerator
from dexzoo.generators.kopicki import KopickiGenerator
from dexzoo.grasp import GRIP, NUM_TYPES, Grasps
from dexzoo.hand import Hand
from dexzoo.perception import Observation
from dexzoo.sim import ObjectModel, Scene, trial
from dexzoo.sim.shapes import MASS_RANGE, make_object

TRIES = 5
"""Times that a scene is drawn anew when its object does not come to rest or is not seen."""
MESH_MASS, MESH_FRICTION = 0.2, 0.7
"""Of objects that dexzoo did not make, whose own are not known."""
ORIGINAL_STEPS = (50, 450)
"""Kopicki's steps of annealing before and after the best are chosen."""
KERNELS, SAMPLES = (3_000, 10_000, 30_000, 100_000), (1_000, 3_000, 10_000, 30_000)
NUM_GROWTH = 3
HAND = Hand.load()
FORGET_PEAK = Path("/proc/self/clear_refs")
"""Where Linux is told to count the most memory held anew."""
Setting = Callable[[int], tuple[Scene, Observation, int, int]]
"""A scene by its number, a view of it, the generator's seed, and how many scenes were drawn in vain before."""


class Replaced(GraspGenerator):
    """The Kopicki generator with one method of one of its parts replaced; fails where there is no such method."""

    def __init__(self, part: type, method: str, by: Callable[..., Tensor]) -> None:
        self.generator, self.part, self.method, self.by = kopicki(), part, method, by
        self.hand = self.generator.hand

    def generate(self, observation: Observation, num_grasps: int = 100, seed: int = 0) -> Grasps:
        """As the Kopicki generator."""
        with patch.object(self.part, self.method, self.by):
            return self.generator.generate(observation, num_grasps, seed)


def kopicki(**settings: Any) -> KopickiGenerator:  # noqa: ANN401, whatever the generator takes
    """The generator that learns from the shipped demonstrations."""
    return KopickiGenerator(load_demonstrations(HAND), **settings)


def any_posture(_: ContactDensity, grips: Grips) -> Tensor:
    """Every posture is as likely; samples are still drawn along the demonstrated path."""
    return grips.joints.new_zeros(len(grips.demo))


@cache
def without_type(grasp_type: int) -> KopickiGenerator:
    return KopickiGenerator([d for d in load_demonstrations(HAND) if d.grasp_type != grasp_type])


def variants(practised: Path | None) -> dict[str, Callable[[int], GraspGenerator]]:
    """For each variant, the generator of a scene by its number; made once where it is the same for all."""
    fixed = {
        "kopicki": kopicki,
        "heuristic": partial(HeuristicGenerator, HAND),
        "without C": partial(Replaced, ContactDensity, "log_posture", any_posture),
        # the table stays in the way
        "without collision cost": partial(Replaced, ApproachMotion, "cost", ApproachMotion.table_cost),
        "without improvement": partial(kopicki, num_steps=(0, 0)),
        "annealing": partial(kopicki, search="annealing", num_steps=ORIGINAL_STEPS),
    }
    if practised:
        fixed["practised"] = lambda: KopickiGenerator(load_demonstrations(HAND, str(practised)))
    made = {name: cache(make) for name, make in fixed.items()}
    each = {name: lambda _, make=make: make() for name, make in made.items()}
    return each | {"one demonstration left out": lambda number: without_type(number % NUM_TYPES)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--variants", nargs="+", default=["kopicki", "heuristic"], metavar="NAME")
    parser.add_argument("--demonstrations", type=Path, help="folder that the variant 'practised' learns from")
    parser.add_argument("--split", default="test", choices=("test", "validation"))
    parser.add_argument(
        "--meshes", type=Path, help="folder of objects, as benchmarks/meshes.py takes it, for the split"
    )
    parser.add_argument("--scenes", type=int, default=100)
    parser.add_argument("--num_grasps", type=int, default=100)
    parser.add_argument("--done", action="store_true", help="try nothing more, sum up what the folder holds")
    parser.add_argument("--growth", action="store_true", help="time and memory against kernels and samples instead")
    parser.add_argument("--folder", type=Path, default=Path("out/generator"))
    parser.add_argument("--out", type=Path)
    parser.add_argument("--pictures", type=Path, help="folder for the pictures")
    options = parser.parse_args()
    known = variants(options.demonstrations)
    if unknown := set(options.variants) - set(known):
        parser.error(f"variants {', '.join(sorted(unknown))} are unknown; use some of {', '.join(known)}")
    if options.meshes and not any(options.meshes.glob("*/mesh.obj")):
        parser.error(f"folder {options.meshes} holds no NAME/mesh.obj; give a folder of objects' folders")
    setting = partial(set_scene, options.split, options.meshes)
    if options.growth:
        result = growth(setting)
        if options.pictures:
            generator_pictures.cost(result, options.pictures / "generator_cost.png")
    else:
        folder = options.folder / f"{'meshes' if options.meshes else options.split}_{options.num_grasps}"
        if not options.done:
            run({name: known[name] for name in options.variants}, setting, folder, options.scenes, options.num_grasps)
        done = {name: Trials.load_all(folder / name, options.scenes) for name in options.variants}
        if not done[options.variants[0]]:
            parser.error(f"folder {folder} holds nothing of {options.variants[0]}; run without --done first")
        result = {
            "split": "meshes" if options.meshes else options.split,
            "scenes": options.scenes,
            "num_grasps": options.num_grasps,
            "threads": torch.get_num_threads(),
            "variants": compared(done),
        }
        if options.pictures:
            generator_pictures.rank(result["variants"], options.pictures / "generator_rank.png")
            first = done[options.variants[0]]
            generator_pictures.top(first, setting, HAND, TOP, options.pictures / "generated.png")
    text = json.dumps(result, indent=2)
    if options.out:
        options.out.write_text(text + "\n")
    sys.stdout.write(text + "\n")


def set_scene(split: str, meshes: Path | None, number: int) -> tuple[Scene, Observation, int, int]:
    """A `Setting` of a split, or of a folder of meshes; ValueError where five draws are in vain."""
    for attempt in range(TRIES):
        rng = np.random.default_rng([number, attempt])
        obj = drawn(object_of(number, split), rng) if meshes is None else read_mesh(meshes, number)
        try:
            scene = Scene.place(obj, int(rng.integers(2**31)))
            view = scene.observe(int(rng.integers(2**31)))
            view.aimed()  # which segments it
        except ValueError as error:
            reason = error
            continue
        return scene, view, int(rng.integers(2**31)), attempt
    raise ValueError(f"scene {number} is left out: {reason}")


def drawn(name: str, rng: np.random.Generator) -> ObjectModel:
    obj = make_object(name)
    scale, mass = float(rng.uniform(*SCALE_RANGE)), float(rng.uniform(*MASS_RANGE[obj.category]))
    return replace(obj.scaled(scale), mass=mass, friction=float(rng.uniform(*verification.FRICTION)))


def read_mesh(folder: Path, number: int) -> ObjectModel:
    places = sorted(path.parent for path in folder.glob("*/mesh.obj"))
    where = places[number % len(places)]
    hulls = sorted(where.glob("hull_*.obj")) or None
    return ObjectModel.from_mesh(where / "mesh.obj", MESH_MASS, MESH_FRICTION, hulls, where.name)


def run(
    chosen: dict[str, Callable[[int], GraspGenerator]],
    setting: Setting,
    folder: Path,
    scenes: int,
    num_grasps: int,
) -> None:
    """Try what is not yet in the folder, all variants on a scene before the next scene."""
    for number in range(scenes):
        missing = {name: folder / name / f"{number:03d}.npz" for name in chosen}
        missing = {name: path for name, path in missing.items() if not path.exists()}
        if not missing:
            continue
        try:
            scene, view, seed, redrawn = setting(number)
        except ValueError as error:
            sys.stderr.write(f"{error}\n")
            continue
        for name, path in missing.items():
            row = attempt(chosen[name](number), scene, view, seed, redrawn, num_grasps)
            row.save(path)
            sys.stderr.write(f"{number} {row.object}, {name}: {row.success.sum()} of {len(row)} hold {row.error}\n")


def attempt(
    generator: GraspGenerator, scene: Scene, view: Observation, seed: int, redrawn: int, num_grasps: int
) -> Trials:
    """Generate and try; no grasps where the generator gives up."""
    grasps, cost, error = timed(generator, view, seed, num_grasps)
    outcomes = trial.run(scene, grasps, torch.get_num_threads())
    obj, likelihood = scene.object, grasps.log_likelihood
    return Trials(
        obj.name,
        obj.category or obj.name,
        redrawn,
        error,
        cost,
        grasps.wrist[:, GRIP].numpy(),
        grasps.joints[:, GRIP].numpy(),
        grasps.grasp_type.numpy(),
        np.zeros(0, np.float32) if likelihood is None else likelihood.numpy(),
        np.stack([getattr(outcomes, flag) for flag in FLAGS], -1),
    )


def timed(generator: GraspGenerator, view: Observation, seed: int, num: int) -> tuple[Grasps, np.ndarray, str]:
    """Grasps; seconds of wall and of processor time, and megabytes at most; why there are none."""
    FORGET_PEAK.write_text("5")
    start = np.array([time.perf_counter(), time.process_time(), 0])
    try:
        grasps, error = generator.generate(view, num, seed), ""
    except (RuntimeError, ValueError) as reason:  # as the interface says
        grasps, error = Grasps.none(generator.hand), str(reason)
    megabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return grasps, np.array([time.perf_counter(), time.process_time(), megabytes]) - start, error


def growth(setting: Setting) -> dict[str, Any]:
    """What a view costs with more and more samples and kernels, by the median of the first scenes."""
    views = [setting(number)[1] for number in range(NUM_GROWTH)]
    timed(kopicki(), views[0], 0, 100)  # what is loaded and compiled on the way counts for none
    result: dict[str, Any] = {"scenes": NUM_GROWTH, "threads": torch.get_num_threads()}
    for name, sizes in (("num_samples", SAMPLES), ("num_kernels", KERNELS)):
        rows = []
        for size in sizes:
            generator = kopicki(**{name: size})
            cost = np.median([timed(generator, view, 0, 100)[1] for view in views], axis=0)
            rows.append({name: size} | dict(zip(COSTS, cost.tolist(), strict=True)))
        result[name] = rows
    return result


if __name__ == "__main__":
    main()

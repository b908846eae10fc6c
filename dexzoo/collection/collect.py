"""Make a grasp set: object, scene, views, generated grasps, trials, simulated neighbors, trials, rows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields, replace
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from dexzoo import verification
from dexzoo.collection.neighbors import choose, perturb
from dexzoo.collection.workers import in_processes, on_ray
from dexzoo.data.schema import SPLITS, decode_path, encode_path, encode_view
from dexzoo.data.writer import GraspSetWriter, SceneRows, scene_rows
from dexzoo.generators import GENERATORS, make_generator
from dexzoo.grasp import Grasps
from dexzoo.hand import Hand
from dexzoo.perception.observation import Observation
from dexzoo.sim import Outcomes, Scene, trial
from dexzoo.sim.shapes import MASS_RANGE, make_object, object_names, split_of
from dexzoo.sim.world import WORKING

MIN_GENERATED = 10
"""A scene with fewer generated grasps is skipped, and so is one where none of them holds (thesis, section 3.2)."""
NEIGHBOR_RATIO = 0.6
"""Simulated neighbors for each generated grasp."""
SCALE_RANGE = (0.95, 1.05)
VIEW_TRIES = 3
ALL = "all"
TEST_EVERY = 6
"""With all splits, every sixth scene is of a test object, which is about their share of the objects."""


@dataclass(frozen=True)
class Configuration:
    """Settings that the rows of a set depend on, besides the program.

    Attributes:
        seed: The same seed gives the same rows.
        split: Split of the objects: train, validation, test or all.
        generator: Name of the generator, which sees view 0.
        num_grasps: Grasps to generate in each scene.
        num_views: Views of each scene.
        trials: Repetitions behind success_rate; 1 for none.
        images: Whether depth images are kept in the set, instead of rendering them again when it is read.
        hand: Name of the hand in robots/.

    Raises:
        ValueError: A setting cannot be.
    """

    seed: int = 0
    split: str = ALL
    generator: str = "kopicki"
    num_grasps: int = 100
    num_views: int = 4
    trials: int = 1
    images: bool = False
    hand: str = "dlr2"

    def __post_init__(self) -> None:
        if self.split not in (*SPLITS, ALL):
            raise ValueError(f"split {self.split!r} is unknown; use one of {', '.join((*SPLITS, ALL))}")
        if self.generator not in GENERATORS:
            raise ValueError(f"generator {self.generator!r} is unknown; use one of {', '.join(GENERATORS)}")
        if self.num_grasps < MIN_GENERATED:
            raise ValueError(f"num_grasps is {self.num_grasps}, but scenes of fewer than {MIN_GENERATED} are skipped")
        if self.num_views < 1 or self.trials < 1:
            raise ValueError(f"num_views is {self.num_views} and trials {self.trials}, expected at least 1 of each")


def collect(
    folder: Path, configuration: Configuration, num_scenes: int, workers: int = 1, ray: str | None = None
) -> Iterator[str]:
    """Write the scenes that are not yet in a folder.

    The files are the same byte for byte on any number of workers. Killing it loses no more than the scenes in flight.

    Args:
        folder: Folder of the set.
        configuration: Settings of the set.
        num_scenes: The set shall hold scenes 0 to num_scenes - 1.
        workers: Processes of this machine.
        ray: Address of a Ray cluster instead, see `workers.on_ray`.

    Returns:
        A line on each scene, those that were there first.

    Raises:
        ValueError: As in `GraspSetWriter`.
        RuntimeError: As in `GraspSetWriter` and `workers`.
        OSError: As in `GraspSetWriter`.
    """
    with GraspSetWriter(folder, _describe(configuration), num_scenes, _objects(configuration.split)) as writer:
        missing = [number for number in range(num_scenes) if number not in writer.done]
        yield from (f"scene {number} is there already" for number in range(num_scenes) if number in writer.done)
        make = partial(make_scene, configuration)
        made = in_processes(make, missing, workers) if ray is None else on_ray(make, missing, ray)
        for rows in made if missing else ():
            writer.write(rows)
            yield _report(rows)


def make_scene(configuration: Configuration, number: int) -> SceneRows:
    """Make the rows of one scene, which depend on nothing else.

    A scene that gives no grasps is one row with the reason in its column `skipped`.

    Args:
        configuration: Settings of the set.
        number: Number of the scene.
    """
    rng = np.random.default_rng([configuration.seed, number])
    name = object_of(number, configuration.split)
    obj = make_object(name)
    scale = float(rng.uniform(*SCALE_RANGE))
    mass, friction = float(rng.uniform(*MASS_RANGE[obj.category])), float(rng.uniform(*verification.FRICTION))
    obj = replace(obj.scaled(scale), mass=mass, friction=friction)
    row: dict[str, Any] = {
        "scene": number,
        "object": name,
        "category": obj.category,
        "split": split_of(name),
        "scale": scale,
        "mass": mass,
        "friction": friction,
        "seed": configuration.seed,
        "trials": configuration.trials,
        "generated": 0,
        "held": 0,
    }
    try:
        scene = Scene.place(obj, _seed(rng))
    except ValueError:
        return scene_rows(row | {"skipped": "the object does not come to rest"})
    row["T_world_object"] = scene.T_world_object.reshape(-1).tolist()
    if scene.support is not None:
        row |= {"support_half": list(scene.support.half), "support_yaw": scene.support.yaw}
    views = _look(scene, configuration.num_views, rng)
    if len(views) < configuration.num_views:
        return scene_rows(row | {"skipped": "the object is not seen"})
    generated = _generate(configuration, views[0][1], _seed(rng))
    row["generated"] = len(generated)
    if len(generated) < MIN_GENERATED:
        return scene_rows(row | {"skipped": f"fewer than {MIN_GENERATED} grasps are generated"})
    hand = generated.hand
    # simulate exactly the grasps that will be read, to the last bit
    path = encode_path(generated)
    outcomes = trial.run(scene, decode_path(path, generated.grasp_type, hand), num_threads=1)
    row["held"] = int(outcomes.success.sum())
    if not row["held"]:
        return scene_rows(row | {"skipped": "no generated grasp holds"})
    parents = choose(outcomes.success, round(NEIGHBOR_RATIO * len(path)), rng)
    near = encode_path(perturb(generated[parents], rng))
    neighbors = decode_path(near, generated.grasp_type[parents], hand)
    outcomes = Outcomes.concatenate([outcomes, trial.run(scene, neighbors, num_threads=1)])
    rank = np.concatenate((np.arange(len(path)), parents))
    path = np.concatenate((path, near))
    grasp_type = generated.grasp_type[rank]
    columns = {
        **{field.name: getattr(outcomes, field.name) for field in fields(Outcomes)},
        "view": rng.integers(configuration.num_views, size=len(path)),
        "grasp_type": grasp_type.numpy(),
        "source": ["generated"] * len(generated) + ["perturbed"] * len(near),
        "rank": rank,
        "log_likelihood": _likelihood(generated) + [None] * len(near),
        "path": path,
        "success_rate": _success_rate(decode_path(path, grasp_type, hand), scene, configuration.trials, _seed(rng)),
    }
    rows = [encode_view(view.aimed(), seed, configuration.images) for seed, view in views]
    return scene_rows(row, rows, columns)


def object_of(number: int, split: str) -> str:
    """The object of a scene; the objects come round in turn, the categories mixed, so that any first part is balanced.

    With all splits, five scenes are of training or validation objects, then one is of a test object.

    Args:
        number: Number of the scene.
        split: Split of the objects, or all.
    """
    if split != ALL:
        names = _mixed((split,))
        return names[number % len(names)]
    turn, place = divmod(number, TEST_EVERY)
    if place == TEST_EVERY - 1:
        return object_of(turn, "test")
    names = _mixed(("train", "validation"))
    return names[(turn * (TEST_EVERY - 1) + place) % len(names)]


@cache
def _mixed(splits: tuple[str, ...]) -> list[str]:
    """The objects of some splits, those of each category spread evenly over the list."""
    by_category: dict[str, list[str]] = {}
    for split in splits:
        for name in object_names(split):
            by_category.setdefault(_category(name), []).append(name)
    places = [
        ((place + 0.5) / len(names), category, name)
        for category, names in by_category.items()
        for place, name in enumerate(names)
    ]
    return [name for *_, name in sorted(places)]


def _category(name: str) -> str:
    return name.rpartition("_")[0]


def _objects(split: str) -> list[dict[str, Any]]:
    """Rows of the table of objects."""
    rows = []
    for name in object_names(None if split == ALL else split):
        low, high = MASS_RANGE[_category(name)]
        row = {"object": name, "category": _category(name), "split": split_of(name)}
        rows.append({**row, "mass_min": low, "mass_max": high})
    return rows


def _describe(configuration: Configuration) -> dict[str, Any]:
    """Entries of the manifest on the making of the rows."""
    return {"dexzoo": version("dexzoo"), **asdict(configuration), "physics": asdict(WORKING)}


def _look(scene: Scene, num: int, rng: np.random.Generator) -> list[tuple[int, Observation]]:
    """Views with their seeds; fewer than `num` where a try in three still does not show the object."""
    views: list[tuple[int, Observation]] = []
    for _ in range(VIEW_TRIES * num):
        seed = _seed(rng)
        try:
            view = scene.observe(seed)
            view.aimed()  # which segments it
        except ValueError:
            continue
        views.append((seed, view))
        if len(views) == num:
            break
    return views


def _generate(configuration: Configuration, observation: Observation, seed: int) -> Grasps:
    """Grasps that are generated for a view; none if the generator gives up."""
    hand = Hand.load(configuration.hand)
    try:
        return make_generator(configuration.generator, hand).generate(observation, configuration.num_grasps, seed)
    except (ValueError, RuntimeError):  # as the interface says
        return Grasps.none(hand)


def _likelihood(grasps: Grasps) -> list[float | None]:
    value: Tensor | None = grasps.log_likelihood
    return [None] * len(grasps) if value is None else value.tolist()


def _success_rate(grasps: Grasps, scene: Scene, trials: int, seed: int) -> list[float] | list[None]:
    if trials == 1:
        return [None] * len(grasps)
    rate: list[float] = verification.verify(grasps, scene, seed, trials, 1).success_rate.tolist()
    return rate


def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(2**31))


def _report(rows: SceneRows) -> str:
    row = rows["scenes"].to_pylist()[0]
    name = f"scene {row['scene']} {row['object']}"
    if row["skipped"]:
        return f"{name}: skipped, {row['skipped']}"
    held = rows["grasps"]["success"].to_numpy().mean()
    return f"{name}: {rows['grasps'].num_rows} grasps, {held:.0%} hold"

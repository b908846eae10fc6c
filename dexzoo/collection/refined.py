"""Learning from its own output: refined grasps of training objects, tried in simulation, become part of a grasp set.

An evaluator is wrong about grasps unlike any that it has seen, and climbing it leads to such grasps (thesis, section
4.4). It learns next from the outcomes of the grasps that it scored best.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import torch

from dexzoo.collection.rendering import rebuild
from dexzoo.collection.workers import in_processes
from dexzoo.data.grasp_set import GraspSet
from dexzoo.data.schema import SCHEMAS, decode_path, encode_path
from dexzoo.data.writer import GraspSetWriter, grasp_rows
from dexzoo.generators import make_generator
from dexzoo.models.evaluator import GraspEvaluator
from dexzoo.models.zoo import load
from dexzoo.perception import View
from dexzoo.refinement import refine
from dexzoo.refinement.refinement import default_settings
from dexzoo.sim import Outcomes, trial

SLICE_SCENES = 20
"""Scenes of consecutive numbers whose refined grasps share a file."""


@dataclass(frozen=True)
class Refining:
    """Settings that refined grasps depend on, besides the program and the set.

    Attributes:
        evaluator: Evaluator that guides, as `dexzoo.load` takes it.
        round: Number of the round; each evaluator has its own.
        seed: The same seed gives the same grasps.
        num_grasps: Grasps of each scene, drawn among the generated ones.
    """

    evaluator: str
    round: int = 1
    seed: int = 0
    num_grasps: int = 40

    @property
    def name(self) -> str:
        """Name of the round in the manifest and in names of files."""
        return f"refined{self.round}"

    def part(self, number: int) -> str:
        """Name of the file of a slice.

        Args:
            number: Number of the slice.
        """
        return f"{self.name}_{number:05d}"

    def describe(self, num_scenes: int) -> dict[str, Any]:
        """Settings of a round in the manifest; for the evaluator, the checksum of its weights.

        Args:
            num_scenes: Training scenes of the set.
        """
        return {
            "evaluator": load(self.evaluator).digest,
            "seed": self.seed,
            "num_grasps": self.num_grasps,
            "num_scenes": num_scenes,
            **default_settings(),
        }


def collect_refined(folder: Path, how: Refining, workers: int = 1) -> Iterator[str]:
    """Refine grasps of a set's training scenes, try them and add them, slice by slice.

    Slices that are there are left alone, so that a round can be continued. The files are the same on any number of
    workers. A refined grasp is paired with the view that it was refined on. Grasps that refinement did not replace are
    in the set already.

    Args:
        folder: Folder of the set.
        how: Settings of the round.
        workers: Processes of this machine.

    Returns:
        A line on each slice.

    Raises:
        FileNotFoundError: As in `GraspSet` and `dexzoo.load`.
        ValueError: The set has no simulated training scenes, or a round of the same number was made with other
            settings, such as another evaluator, or before the set grew.
        RuntimeError: As in `GraspSetWriter` and `workers`.
    """
    scenes = training_scenes(folder)
    made = how.describe(len(scenes))
    numbers = slices(scenes)
    with GraspSetWriter(folder, {}, 0) as writer:
        try:
            writer.settle(how.name, made)
        except ValueError as error:
            raise ValueError(f"{error}; start another --round") from None
        there = [number for number in numbers if f"grasps/{how.part(number)}.parquet" in writer.manifest["files"]]
        missing = [number for number in numbers if number not in there]
        yield from (f"{how.part(number)} is there already" for number in there)
        if missing:
            for number, table in in_processes(partial(make_slice, folder, how), missing, workers):
                writer.add_grasps(how.part(number), table)
                held = table["success"].to_numpy().sum()
                yield f"{how.part(number)}: {table.num_rows} refined grasps, {held} of which hold"


def training_scenes(folder: Path) -> list[int]:
    """Numbers of the training scenes of a set.

    Args:
        folder: Folder of the set.

    Raises:
        ValueError: There are none.
    """
    scenes = GraspSet(folder).scenes
    pairs = zip(scenes["scene"].to_pylist(), scenes["split"].to_pylist(), strict=True)
    found = [scene for scene, split in pairs if split == "train"]
    if not found:
        raise ValueError(f"grasp set {folder} has no scenes of training objects; only these are refined")
    return found


def slices(scenes: list[int]) -> list[int]:
    """Numbers of the slices that hold some scenes.

    Args:
        scenes: Numbers of the scenes.
    """
    return sorted({scene // SLICE_SCENES for scene in scenes})


def make_slice(folder: Path, how: Refining, number: int) -> tuple[int, pa.Table]:
    """Refine grasps of a slice's training scenes.

    Args:
        folder: Folder of the set.
        how: Settings of the round.
        number: Number of the slice.

    Returns:
        The number again, and rows of the table of grasps.
    """
    grasp_set = _open(folder)
    parts = [SCHEMAS["grasps"].empty_table()]
    for row, scene in enumerate(grasp_set.scenes.to_pylist()):
        if scene["split"] == "train" and scene["scene"] // SLICE_SCENES == number:
            parts.append(refined_rows(grasp_set, row, how))
    return number, pa.concat_tables(parts)


def refined_rows(grasp_set: GraspSet, row: int, how: Refining) -> pa.Table:
    """Refine grasps of one scene.

    Args:
        grasp_set: The set.
        row: Row of the scene.
        how: Settings of the round.

    Returns:
        Rows of the table of grasps; none if the view shows too little of the object.

    Raises:
        ValueError: The scene was not simulated.
    """
    scene = grasp_set.scenes.slice(row, 1).to_pylist()[0]
    rng = np.random.default_rng([how.seed, how.round, scene["scene"]])
    generated = np.flatnonzero((grasp_set.grasp_scene == row) & (grasp_set.source == "generated"))
    chosen = np.sort(rng.choice(generated, min(how.num_grasps, len(generated)), replace=False))
    view = grasp_set.views.slice(int(rng.choice(np.flatnonzero(grasp_set.view_scene == row))), 1).to_pylist()[0]
    stage = rebuild(scene)
    if view["seed"] is None:
        raise ValueError(f"view {view['view']} of scene {scene['scene']} has no seed, so it cannot be seen again")
    seen, hand = View(stage.observe(view["seed"])), grasp_set.hand
    try:
        prior = make_generator("kopicki", hand).density(seen)
    except ValueError:  # too few points
        return SCHEMAS["grasps"].empty_table()
    columns = grasp_set.grasps.take(pa.array(chosen))
    kinds, ranks = (torch.tensor(columns[name].to_numpy()) for name in ("grasp_type", "rank"))
    given = decode_path(grasp_set.paths[chosen], kinds, hand)
    result = refine(given, seen, _load(how.evaluator), prior=prior, seed=how.seed)
    kinds, ranks = kinds[result.accepted], ranks[result.accepted]
    # simulate exactly the grasps that will be read, to the last bit
    path = encode_path(result.grasps[result.accepted])
    outcomes = trial.run(stage, decode_path(path, kinds, hand), num_threads=1)
    found: dict[str, Any] = {field.name: getattr(outcomes, field.name) for field in fields(Outcomes)}
    return grasp_rows(
        scene["scene"],
        found
        | {
            "view": [view["view"]] * len(path),
            "grasp_type": kinds.numpy(),
            "source": ["refined"] * len(path),
            "rank": ranks.numpy(),
            "path": path,
            "success_rate": [None] * len(path),
        },
    )


@cache
def _open(folder: Path) -> GraspSet:
    return GraspSet(folder)


@cache
def _load(evaluator: str) -> GraspEvaluator:
    return load(evaluator)

"""Make a grasp set: scene, views, generated grasps and their simulated neighbours, trials, rows."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from torch import Tensor

from dexzoo import rotation
from dexzoo.data.schema import SCHEMAS, decode_path, encode_path, encode_view, write_scene
from dexzoo.generators.heuristic import HeuristicGenerator
from dexzoo.grasp import Grasps
from dexzoo.hand import Hand, default_hand
from dexzoo.sim import Outcomes, Scene, trial
from dexzoo.sim.shapes import MASS_RANGE, make_object, object_names, split_of

NUM_VIEWS = 4
NUM_GENERATED = 48
NUM_NEIGHBOURS = 48


def collect(folder: Path, num_scenes: int, workers: int = 1, seed: int = 0) -> Iterator[str]:
    """Write scenes 0...num_scenes - 1 that are not yet in `folder`; yields a line on each, those kept first.

    The same seed makes the same files on any number of workers. Killing it loses the scenes in flight.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for unfinished in folder.glob(".scene_*"):  # of a run that was killed
        shutil.rmtree(unfinished)
    there = {i for i in range(num_scenes) if (folder / f"scene_{i:06d}").exists()}
    missing = [i for i in range(num_scenes) if i not in there]
    yield from (f"scene {i} is there already" for i in sorted(there))
    if workers == 1:
        for index in missing:
            yield collect_scene(folder, seed, index)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        for job in as_completed([pool.submit(partial(collect_scene, folder, seed), index) for index in missing]):
            yield job.result()


def collect_scene(folder: Path, seed: int, index: int) -> str:
    """Make and write one scene; returns what to tell of it."""
    torch.set_num_threads(1)
    rng = np.random.default_rng([seed, index])
    names = object_names()
    name = names[index % len(names)]
    obj = make_object(name)
    scale = float(rng.uniform(0.95, 1.05))
    obj = replace(
        obj.scaled(scale), mass=float(rng.uniform(*MASS_RANGE[obj.category])), friction=float(rng.uniform(0.5, 1.0))
    )
    scene = Scene.place(obj, seed=int(rng.integers(2**31)))
    observations = [scene.observe(seed=int(rng.integers(2**31))) for _ in range(NUM_VIEWS)]
    hand = default_hand()
    try:
        generated = HeuristicGenerator().generate(observations[0], NUM_GENERATED, int(rng.integers(2**31)))
        grasps = generated.to_frame("world", observations[0].T_world_camera)
    except RuntimeError:  # no feasible grasp from this view: a scene of no rows
        grasps = Grasps(torch.zeros(0, 10, 28), "world", torch.zeros(0))
    outcomes = trial.run(scene, grasps, hand, num_threads=1)
    source = ["generated"] * len(grasps)
    likelihood = torch.zeros(0) if grasps.log_likelihood is None else grasps.log_likelihood
    if len(grasps):
        neighbours = perturb(choose(outcomes, NUM_NEIGHBOURS, rng), grasps, hand, rng)
        outcomes = Outcomes.concatenate([outcomes, trial.run(scene, neighbours, hand, num_threads=1)])
        grasps = Grasps.concatenate([replace(grasps, log_likelihood=None), neighbours])
        source += ["perturbed"] * len(neighbours)
        likelihood = torch.cat((likelihood, torch.full((len(neighbours),), torch.nan)))
    row: dict[str, Any] = {
        "scene": index,
        "object": name,
        "category": obj.category,
        "split": split_of(name),
        "mass": obj.mass,
        "friction": obj.friction,
        "scale": scale,
        "seed": seed,
        "T_world_object": scene.T_world_object.reshape(-1).tolist(),
    }
    views = [{"scene": index, "view": i, **encode_view(o.aimed())} for i, o in enumerate(observations)]
    write_scene(folder, row, views, _rows(index, grasps, outcomes, source, likelihood, hand, rng))
    held = outcomes.success.mean() if len(outcomes) else 0.0
    return f"scene {index} {name}: {len(grasps)} grasps, {held:.0%} hold"


def choose(outcomes: Outcomes, num: int, rng: np.random.Generator) -> np.ndarray:
    """Indices of grasps whose neighbours are to be tried: two thirds around those that hold, if any do."""
    held, failed = np.flatnonzero(outcomes.success), np.flatnonzero(~outcomes.success)
    share = 2 * num // 3 if len(held) and len(failed) else num if len(held) else 0
    parts = [
        rng.choice(held, share) if share else held[:0],
        rng.choice(failed, num - share) if num > share else failed[:0],
    ]
    return np.concatenate(parts)


def perturb(index: np.ndarray, grasps: Grasps, hand: Hand, rng: np.random.Generator) -> Grasps:
    """Neighbours of grasps: the wrist moved by 2 to 15 mm and 0.03 to 0.2 rad, each joint by up to 0.03 to 0.15 rad.

    The whole path moves with the wrist; the joints of grip and squeeze change alike, those of the pre-grasp do not.
    """
    near = grasps[index]
    n = len(near)
    key = torch.tensor(encode_path(near, hand)).unflatten(-1, (3, 22))

    def direction() -> Tensor:
        return torch.nn.functional.normalize(torch.tensor(rng.normal(size=(n, 3)), dtype=torch.float32), dim=-1)

    def size(low: float, high: float) -> Tensor:
        return torch.tensor(rng.uniform(low, high, (n, 1)), dtype=torch.float32)

    position = key[..., :3] + (direction() * size(0.002, 0.015))[:, None]
    step = rotation.exp(direction() * size(0.03, 0.2))
    quaternion = rotation.normalize(rotation.multiply(key[..., 3:7], step[:, None]))
    change = size(0.03, 0.15) * torch.tensor(rng.uniform(-1, 1, (n, 15)), dtype=torch.float32)
    joints = key[..., 7:].clone()
    joints[:, 1:] += change[:, None]
    joints = hand.clamp(joints)
    return decode_path(torch.cat((position, quaternion, joints), -1).flatten(1), near.grasp_type, hand)


def _rows(
    index: int,
    grasps: Grasps,
    outcomes: Outcomes,
    source: list[str],
    likelihood: Tensor,
    hand: Hand,
    rng: np.random.Generator,
) -> pa.Table:
    count = len(grasps)
    path = encode_path(grasps, hand).reshape(-1)
    return pa.table(
        {
            "scene": np.full(count, index, np.int32),
            "view": rng.integers(NUM_VIEWS, size=count).astype(np.int16),
            "grasp_type": grasps.grasp_type.numpy().astype(np.int8),
            "source": pa.array(source, pa.string()),
            "log_likelihood": likelihood.numpy(),
            "path": pa.FixedSizeListArray.from_arrays(pa.array(path), 66),
            "success": outcomes.success,
            "collided": outcomes.collided,
            "unstable": outcomes.unstable,
            "shift": outcomes.shift,
            "rotation": outcomes.rotation,
        },
        schema=SCHEMAS["grasps"],
    )

"""How far the labels can be trusted, and how fast they come.

python benchmarks/simulator.py --out benchmarks/results/simulator.json
Every `--every`-th object of each category is placed and seen; grasps of the first generator that finds any that hold,
and neighbors of those, are tried, and up to `--num_grasps` an object are kept, half of which hold where there are so
many. Each is tried at the working and at the reference setting, and again with the wrist moved by 0.1, 1 and 3 mm (the
reference by 1 and 3 mm on the first object of a category only). `--folder` keeps what is done, so that a run can be
continued; then the clock is taken on the first object of eight categories where any holds, against plain loops over one
MjData.
"""

import argparse
import json
import os
import sys
import time
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import torch

from dexzoo.generators import make_generator
from dexzoo.grasp import Grasps
from dexzoo.hand import Hand
from dexzoo.sim import Scene, trial
from dexzoo.sim.execution import Execution
from dexzoo.sim.protocol import END, LIFT_START
from dexzoo.sim.shapes import make_object, object_names
from dexzoo.sim.world import REFERENCE, WORKING, Physics

OFFSETS = (0.0001, 0.001, 0.003)
BATCHES = (1, 10, 100, 1000)
UNIFORM = Physics(0.002, 10, 0.002, 10)
"""One setting from start to end that both closes in small steps and does not creep, as a plain loop would have."""
NUM_TIMED = 8
COPIES = 4
"""How often the working setting is timed on each grasp of an object, in one batch."""
HAND = Hand.load()
Row = dict[str, np.ndarray]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--every", type=int, default=4)
    parser.add_argument("--done", action="store_true", help="measure nothing more, sum up what the folder holds")
    parser.add_argument("--num_grasps", type=int, default=16)
    parser.add_argument("--generators", nargs="+", default=["heuristic", "kopicki"])
    parser.add_argument("--folder", type=Path, default=Path("out/simulator"))
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    names = sorted((name for name in object_names() if number(name) % options.every == 0), key=number)
    if options.done:
        names = [name for name in names if (options.folder / f"{name}.npz").exists()]
    for name in names:
        path = options.folder / f"{name}.npz"
        if not path.exists():
            np.savez(path, **measure(name, options.num_grasps, options.generators, thorough=number(name) == 0))
            sys.stderr.write(f"{name}\n")
    rows = {name: dict(np.load(options.folder / f"{name}.npz")) for name in names}
    held = {name: row for name, row in rows.items() if len(row["grasp_type"]) and row["working"].any()}
    firsts = {category(name): name for name in reversed(held)}.values()  # the first of each category
    timed = {name: held[name] for name in list(firsts)[:NUM_TIMED]}
    result = summarize(rows) | speed(timed) | growth(timed) | {"creep": creep(timed), "profile": profile(timed)}
    text = json.dumps(result, indent=2)
    if options.out:
        options.out.write_text(text + "\n")
    sys.stdout.write(text + "\n")


def number(name: str) -> int:
    return int(name.rpartition("_")[2])


def category(name: str) -> str:
    return name.rpartition("_")[0]


def scene_of(name: str) -> Scene:
    return Scene.place(make_object(name), seed=0)


def measure(name: str, num: int, generators: list[str], thorough: bool) -> Row:
    """Labels of one object's grasps under all settings; no grasps where it cannot be placed, seen or grasped."""
    try:
        scene = scene_of(name)
        grasps = candidates(scene, num, generators)
    except ValueError as error:
        sys.stderr.write(f"{error}\n")
        grasps = Grasps.none(HAND)
    out = {name: getattr(grasps, name).numpy() for name in ("wrist", "joints", "grasp_type")}
    if not len(grasps):
        return out
    outcomes = trial.run(scene, grasps)
    out |= {"working": outcomes.success, "unstable": outcomes.unstable}
    out["reference"] = trial.run(scene, grasps, physics=REFERENCE).success
    rng = np.random.default_rng(0)
    for offset in OFFSETS:
        near = moved(grasps, offset, rng)
        out[f"working {offset}"] = trial.run(scene, near).success
        if thorough or offset == OFFSETS[0]:
            out[f"reference {offset}"] = trial.run(scene, near, physics=REFERENCE).success
    return out


def grasps_of(row: Row) -> Grasps:
    """The grasps that a row keeps."""
    return Grasps(*(torch.tensor(row[name]) for name in ("wrist", "joints", "grasp_type")), HAND)


def elapsed(start: tuple[float, float]) -> np.ndarray:
    """Seconds of processor and of wall time since then."""
    return np.array([time.process_time() - start[0], time.perf_counter() - start[1]])


def candidates(scene: Scene, num: int, generators: list[str]) -> Grasps:
    """Grasps of which about half hold: of the first generator with such, and neighbors at 1 cm of those that hold."""
    rng = np.random.default_rng(0)
    observation = scene.observe(seed=0)
    for name in generators:
        try:
            grasps = make_generator(name, HAND).generate(observation, 4 * num, seed=0)
        except RuntimeError as error:
            sys.stderr.write(f"{scene.object.name}, {name}: {error}\n")
            continue
        outcomes = trial.run(scene, grasps)
        if outcomes.success.any():
            break
    else:
        return Grasps.none(HAND)
    near = moved(grasps[rng.choice(np.flatnonzero(outcomes.success), 2 * num)], 0.01, rng)
    outcomes = trial.Outcomes.concatenate([outcomes, trial.run(scene, near)])
    tried = ~outcomes.collided & ~outcomes.starts_inside & ~outcomes.unstable
    held, failed = (np.flatnonzero(tried & (outcomes.success == holds)) for holds in (True, False))
    chosen = np.concatenate((rng.permutation(held)[: num // 2], rng.permutation(failed)[: num - num // 2]))
    return Grasps.concatenate([grasps, near])[np.sort(chosen)]


def moved(grasps: Grasps, offset: float, rng: np.random.Generator) -> Grasps:
    step = rng.normal(size=(len(grasps), 1, 3))
    wrist = grasps.wrist.clone()
    wrist[..., :3] += torch.tensor(offset * step / np.linalg.norm(step, axis=-1, keepdims=True)).float()
    return replace(grasps, wrist=wrist, log_likelihood=None)


def plain_loop(scene: Scene, grasps: Grasps, physics: Physics) -> np.ndarray:
    """Which grasps hold by MuJoCo's own step, one after another and each to its end."""
    model = scene.model(HAND.spec, physics)
    data = mujoco.MjData(model)
    start = Execution(scene, grasps, model, physics)
    closing = np.arange(1, round(LIFT_START / physics.timestep) + 1) * physics.timestep
    carrying = np.arange(1, round((END - LIFT_START) / physics.carry_timestep) + 1) * physics.carry_timestep
    wrist, turn, joints = start.motion.at(np.concatenate((closing, LIFT_START + carrying)), start.everyone)
    held = np.zeros(len(grasps), bool)
    for i in range(len(grasps)):
        mujoco.mj_resetData(model, data)
        data.qpos[:] = start.qpos[i]
        rest = data.qpos[start.object_at + 2]
        for step in range(wrist.shape[1]):
            closes = step < len(closing)
            model.opt.timestep = physics.timestep if closes else physics.carry_timestep
            model.opt.noslip_iterations = physics.noslip_iterations if closes else physics.carry_noslip_iterations
            data.ctrl[:] = joints[i, step, start.order]
            data.mocap_pos[0], data.mocap_quat[0] = wrist[i, step], turn[i, step]
            mujoco.mj_step(model, data)
        still = np.linalg.norm(data.qvel[start.object_dof : start.object_dof + 3]) < 0.2
        held[i] = still and data.qpos[start.object_at + 2] - rest > 1.0 - 0.1 - scene.object.radius
    return held


def summarize(rows: dict[str, Row]) -> dict[str, object]:
    """How the settings agree with each other, and each with itself when the wrist is moved."""
    found = [row for row in rows.values() if len(row["grasp_type"])]
    labels = {key: np.concatenate([row[key] for row in found]) for key in ("working", "reference", "unstable")}
    per_category: dict[str, dict[str, int]] = {}
    for name, row in rows.items():
        counts = per_category.setdefault(category(name), {"objects": 0, "grasps": 0, "hold": 0, "disagree": 0})
        counts["objects"] += 1
        if len(row["grasp_type"]):
            counts["grasps"] += len(row["working"])
            counts["hold"] += int(row["working"].sum())
            counts["disagree"] += int((row["working"] != row["reference"]).sum())
    curves: dict[str, dict[str, object]] = {}
    for setting in ("working", "reference"):
        curve: dict[str, object] = {"0 mm": {"grasps": len(labels[setting]), "agree": 1.0}}
        for offset in OFFSETS:
            some = [row for row in found if f"{setting} {offset}" in row]
            same = np.concatenate([row[setting] == row[f"{setting} {offset}"] for row in some])
            curve[f"{1000 * offset:g} mm"] = {"grasps": len(same), "agree": float(same.mean())}
        curves[setting] = curve
    working, reference = labels["working"], labels["reference"]
    return {
        "objects": len(rows),
        "grasps": len(working),
        "hold": float(working.mean()),
        "unstable": int(labels["unstable"].sum()),
        "working_agrees_with_reference": float((working == reference).mean()),
        "held_at_the_reference_only": int((reference & ~working).sum()),
        "held_at_the_working_setting_only": int((working & ~reference).sum()),
        "agreement_with_itself_when_moved": curves,
        "categories": dict(sorted(per_category.items())),
    }


def speed(rows: dict[str, Row]) -> dict[str, object]:
    """Trials a second on all cores, in batches as large as collection has them, and by plain loops."""
    names = ("working", "reference", "plain, same steps", "plain, uniform steps")
    processor, wall = dict.fromkeys(names, 0.0), dict.fromkeys(names, 0.0)
    same: dict[str, list[np.ndarray]] = {name: [] for name in names}
    for name, row in rows.items():
        scene, grasps = scene_of(name), grasps_of(row)
        many = grasps[np.tile(np.arange(len(grasps)), COPIES)]
        ways = (
            lambda scene=scene, many=many: trial.run(scene, many).success,
            lambda scene=scene, grasps=grasps: trial.run(scene, grasps, physics=REFERENCE).success,
            lambda scene=scene, grasps=grasps: plain_loop(scene, grasps, WORKING),
            lambda scene=scene, grasps=grasps: plain_loop(scene, grasps, UNIFORM),
        )
        for key, way in zip(names, ways, strict=True):
            start = time.process_time(), time.perf_counter()
            held = way()
            spent = elapsed(start) / (len(held) / len(grasps))
            processor[key] += spent[0]
            wall[key] += spent[1]
            same[key].append(held == np.resize(row["working"], len(held)))
    count = sum(len(row["grasp_type"]) for row in rows.values())
    return {
        "timed": {
            "objects": len(rows),
            "grasps": count,
            "hold": float(np.concatenate([row["working"] for row in rows.values()]).mean()),
            "threads": os.cpu_count(),
            "ways": {
                name: {
                    "trials_per_second": count / wall[name],
                    "processor_seconds_per_trial": processor[name] / count,
                    "working_is_faster_by": wall[name] / wall["working"],
                    "agrees_with_working": float(np.concatenate(same[name]).mean()),
                }
                for name in names
            },
        }
    }


def growth(rows: dict[str, Row]) -> dict[str, object]:
    """Processor time of a trial in batches of more and more copies of one object's grasps."""
    name, row = next((name, row) for name, row in rows.items() if 0.4 < row["working"].mean() < 0.6)
    scene, grasps = scene_of(name), grasps_of(row)
    cost = {}
    for size in BATCHES:
        many = grasps[torch.arange(max(size, 100)) % len(grasps)]  # the same mix for each size
        start = time.process_time(), time.perf_counter()
        for first in range(0, len(many), size):
            trial.run(scene, many[first : first + size])
        cost[str(size)] = elapsed(start)[0] / len(many)
    return {"processor_seconds_per_trial_in_batches_of": cost}


def creep(rows: dict[str, Row], seconds: float = 10.0) -> dict[str, object]:
    """How far what is held slides in the hand when it is held for longer, at both settings.

    What slides at the reference as well is no creep of the working setting.
    """
    slid: dict[str, list[np.ndarray]] = {"working": [], "reference": []}
    for name, row in rows.items():
        scene, grasps = scene_of(name), grasps_of(row)[row["working"]]
        for setting, physics in (("working", WORKING), ("reference", REFERENCE)):
            execution = Execution(scene, grasps, scene.model(HAND.spec, physics), physics)
            for time_reached in (LIFT_START, END):
                execution.advance(execution.everyone, time_reached)
            before = execution.in_palm(execution.everyone)
            execution.advance(execution.everyone, END + seconds)
            after = execution.in_palm(execution.everyone)
            slid[setting].append(1000 * np.linalg.norm((after - before)[:, :3], axis=1))
    working, reference = (np.concatenate(slid[setting]) for setting in ("working", "reference"))
    return {
        "seconds": seconds,
        "grasps": len(working),
        **{
            setting: {
                "median_mm": float(np.median(distances)),
                "share_below_2_mm": float((distances < 2).mean()),
                "farthest_mm": float(distances.max()),
            }
            for setting, distances in (("working", working), ("reference", reference))
        },
        "of_those_beyond_2_mm_also_at_the_reference": float((reference[working >= 2] >= 2).mean()),
    }


def profile(rows: dict[str, Row]) -> dict[str, float]:
    """Shares of a step's time by MuJoCo's own timers, over one held grasp of each object."""
    timers = {
        "collision": mujoco.mjtTimer.mjTIMER_POS_COLLISION,
        "rest of position": mujoco.mjtTimer.mjTIMER_POSITION,
        "velocity": mujoco.mjtTimer.mjTIMER_VELOCITY,
        "actuation": mujoco.mjtTimer.mjTIMER_ACTUATION,
        "constraint solver": mujoco.mjtTimer.mjTIMER_CONSTRAINT,
        "integration": mujoco.mjtTimer.mjTIMER_ADVANCE,
    }
    spent = dict.fromkeys(timers, 0.0)
    for name, row in rows.items():
        scene = scene_of(name)
        grasp = grasps_of(row)[row["working"]][:1]
        execution = Execution(scene, grasp, scene.model(HAND.spec), WORKING)
        data, model = mujoco.MjData(execution.batch.model), execution.batch.model
        execution.advance(execution.everyone, LIFT_START)
        execution.batch.get_data(0, data)
        for _ in range(200):
            mujoco.mj_step(model, data)
        for part, timer in timers.items():
            spent[part] += data.timer[timer].duration
    spent["rest of position"] -= spent["collision"]
    return {part: value / sum(spent.values()) for part, value in spent.items()}


if __name__ == "__main__":
    main()

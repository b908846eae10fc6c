"""How far the labels can be trusted, and how fast they come.

python benchmarks/simulator.py --out benchmarks/results/simulator.json
Every `--every`-th object is placed and seen; the generator's grasps and neighbours of those that hold are tried, and up
to `--num_grasps` an object are kept, half of which hold where there are so many. Each is tried at the working setting,
at the reference setting and in a plain loop over one MjData, and again with the wrist moved by 0.1, 1 and 3 mm (the
reference by 1 and 3 mm on every sixteenth object only). `--folder` keeps what is done, so that a run can be continued.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import mujoco
import numpy as np
import torch

from dexzoo.data.neighbours import perturb
from dexzoo.generators.heuristic import HeuristicGenerator
from dexzoo.grasp import Grasps
from dexzoo.hand import default_hand
from dexzoo.sim import Scene, trial
from dexzoo.sim.execution import Execution
from dexzoo.sim.motion import END, LIFT_START
from dexzoo.sim.shapes import make_object, object_names
from dexzoo.sim.world import REFERENCE, WORKING

OFFSETS = (0.0001, 0.001, 0.003)
BATCHES = (1, 10, 100, 1000)
THOROUGH = 16
HAND = default_hand()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--every", type=int, default=2)
    parser.add_argument("--num_grasps", type=int, default=10)
    parser.add_argument("--folder", type=Path, default=Path("out/simulator"))
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    numbered = list(enumerate(object_names()))[:: options.every]
    names = [name for _, name in numbered]
    for number, name in numbered:
        path = options.folder / f"{name}.npz"
        if not path.exists():
            np.savez(path, **measure(name, options.num_grasps, thorough=number % THOROUGH == 0))
            sys.stderr.write(f"{name}\n")
    rows = [dict(np.load(options.folder / f"{name}.npz")) for name in names]
    result = summarise(names, rows) | growth(names, rows) | {"profile": profile(names, rows)}
    text = json.dumps(result, indent=2)
    if options.out:
        options.out.write_text(text + "\n")
    sys.stdout.write(text + "\n")


def scene_of(name: str) -> Scene:
    return Scene.place(make_object(name), seed=0)


def measure(name: str, num: int, thorough: bool) -> dict[str, np.ndarray]:
    """Labels and seconds of one object's grasps under all settings; none where it cannot be placed, seen or grasped."""
    try:
        scene = scene_of(name)
        grasps = candidates(scene, num)
    except (RuntimeError, ValueError) as error:
        sys.stderr.write(f"{error}\n")
        return {"waypoints": np.zeros((0, 10, 28), np.float32)}
    out = {"waypoints": grasps.waypoints.numpy()}
    if not len(grasps):
        return out
    start = time.process_time(), time.perf_counter()
    outcomes = trial.run(scene, grasps, HAND)
    out |= {"working_seconds": elapsed(start), "working": outcomes.success, "unstable": outcomes.unstable}
    start = time.process_time(), time.perf_counter()
    out |= {"plain": plain_loop(scene, grasps), "plain_seconds": elapsed(start)}
    start = time.process_time(), time.perf_counter()
    out |= {"reference": trial.run(scene, grasps, HAND, physics=REFERENCE).success, "reference_seconds": elapsed(start)}
    rng = np.random.default_rng(0)
    for offset in OFFSETS:
        near = moved(grasps, offset, rng)
        out[f"working {offset}"] = trial.run(scene, near, HAND).success
        if thorough or offset == OFFSETS[0]:
            out[f"reference {offset}"] = trial.run(scene, near, HAND, physics=REFERENCE).success
    return out


def elapsed(start: tuple[float, float]) -> np.ndarray:
    """Seconds of processor and of wall time."""
    return np.array([time.process_time() - start[0], time.perf_counter() - start[1]])


def candidates(scene: Scene, num: int) -> Grasps:
    """Grasps of which about half hold: generated ones, and neighbours of those that hold."""
    rng = np.random.default_rng(0)
    observation = scene.observe(seed=0)
    grasps = HeuristicGenerator().generate(observation, 4 * num, seed=0).to_frame("world", scene.T_world_camera)
    outcomes = trial.run(scene, grasps, HAND)
    held = np.flatnonzero(outcomes.success)
    if len(held):
        near = perturb(grasps[rng.choice(held, 2 * num)], HAND, rng)
        outcomes = trial.Outcomes.concatenate([outcomes, trial.run(scene, near, HAND)])
        grasps = Grasps.concatenate([Grasps(grasps.waypoints, "world"), near])
    tried = ~outcomes.collided & ~outcomes.starts_inside & ~outcomes.unstable
    held, failed = np.flatnonzero(outcomes.success & tried), np.flatnonzero(~outcomes.success & tried)
    held = rng.permutation(held)[: num // 2]
    return grasps[np.sort(np.concatenate((held, rng.permutation(failed)[: max(len(held), 1)])))]


def moved(grasps: Grasps, offset: float, rng: np.random.Generator) -> Grasps:
    step = rng.normal(size=(len(grasps), 1, 3))
    waypoints = grasps.waypoints.clone()
    waypoints[..., :3] += torch.tensor(offset * step / np.linalg.norm(step, axis=-1, keepdims=True)).float()
    return Grasps(waypoints, "world")


def plain_loop(scene: Scene, grasps: Grasps) -> np.ndarray:
    """Which grasps hold by MuJoCo's own step, one after another and each to its end."""
    model = scene.model(HAND.spec)
    data = mujoco.MjData(model)
    start = Execution(scene, grasps, HAND, model, WORKING)
    closing = np.arange(1, round(LIFT_START / WORKING.timestep) + 1) * WORKING.timestep
    carrying = np.arange(1, round((END - LIFT_START) / WORKING.carry_timestep) + 1) * WORKING.carry_timestep
    wrist, turn, joints = start.motion.at(np.concatenate((closing, LIFT_START + carrying)), start.everyone)
    held = np.zeros(len(grasps), bool)
    for i in range(len(grasps)):
        mujoco.mj_resetData(model, data)
        data.qpos[:] = start.qpos[i]
        rest = data.qpos[start.object_at + 2]
        for step in range(wrist.shape[1]):
            closes = step < len(closing)
            model.opt.timestep = WORKING.timestep if closes else WORKING.carry_timestep
            model.opt.noslip_iterations = WORKING.noslip_iterations if closes else WORKING.carry_noslip_iterations
            data.ctrl[:] = joints[i, step, start.order]
            data.mocap_pos[0], data.mocap_quat[0] = wrist[i, step], turn[i, step]
            mujoco.mj_step(model, data)
        still = np.linalg.norm(data.qvel[start.object_dof : start.object_dof + 3]) < 0.2
        held[i] = still and data.qpos[start.object_at + 2] - rest > 1.0 - 0.1 - scene.object.radius
    return held


def summarise(names: list[str], rows: list[dict[str, np.ndarray]]) -> dict[str, object]:
    found = [row for row in rows if len(row["waypoints"])]
    labels = {key: np.concatenate([row[key] for row in found]) for key in ("working", "reference", "plain", "unstable")}
    categories = sorted({name.rpartition("_")[0] for name in names})
    with_held = {n.rpartition("_")[0] for n, row in zip(names, rows, strict=True) if row.get("working", no()).any()}
    curves: dict[str, dict[str, object]] = {}
    for setting in ("working", "reference"):
        curve: dict[str, object] = {"0 mm": {"grasps": len(labels[setting]), "agree": 1.0}}
        for offset in OFFSETS:
            some = [row for row in found if f"{setting} {offset}" in row]
            same = np.concatenate([row[setting] == row[f"{setting} {offset}"] for row in some])
            curve[f"{1000 * offset:g} mm"] = {"grasps": len(same), "agree": float(same.mean())}
        curves[setting] = curve
    seconds = {key: sum(row[f"{key}_seconds"] for row in found) for key in ("working", "plain", "reference")}
    count = len(labels["working"])
    lost, gained = labels["reference"] & ~labels["working"], ~labels["reference"] & labels["working"]
    return {
        "objects": len(rows),
        "grasps": count,
        "hold": float(labels["working"].mean()),
        "categories": len(categories),
        "categories_where_nothing_holds": [c for c in categories if c not in with_held],
        "unstable": int(labels["unstable"].sum()),
        "working_agrees_with_reference": float((labels["working"] == labels["reference"]).mean()),
        "held_at_the_reference_only": int(lost.sum()),
        "held_at_the_working_setting_only": int(gained.sum()),
        "agreement_with_itself_when_moved": curves,
        "working_agrees_with_plain_loop": float((labels["working"] == labels["plain"]).mean()),
        "trials_per_second": {key: count / value[1] for key, value in seconds.items()},
        "processor_seconds_per_trial": {key: value[0] / count for key, value in seconds.items()},
        "times_faster_than_plain_loop": seconds["plain"][1] / seconds["working"][1],
    }


def no() -> np.ndarray:
    return np.zeros(1, bool)


def growth(names: list[str], rows: list[dict[str, np.ndarray]]) -> dict[str, object]:
    """Processor time of a trial in batches of more and more copies of one object's grasps."""
    name, row = next((n, r) for n, r in zip(names, rows, strict=True) if r.get("working", no()).sum() >= 2)
    scene, waypoints = scene_of(name), torch.tensor(row["waypoints"])
    cost = {}
    for size in BATCHES:
        many = Grasps(waypoints[torch.arange(max(size, 100)) % len(waypoints)], "world")  # the same mix for each size
        start = time.process_time(), time.perf_counter()
        for first in range(0, len(many), size):
            trial.run(scene, many[first : first + size], HAND)
        cost[str(size)] = elapsed(start)[0] / len(many)
    return {"processor_seconds_per_trial_in_batches_of": cost}


def profile(names: list[str], rows: list[dict[str, np.ndarray]]) -> dict[str, float]:
    """Shares of a step's time by MuJoCo's own timers, over one held grasp of every tenth object."""
    timers = {
        "collision": mujoco.mjtTimer.mjTIMER_POS_COLLISION,
        "rest of position": mujoco.mjtTimer.mjTIMER_POSITION,
        "velocity": mujoco.mjtTimer.mjTIMER_VELOCITY,
        "actuation": mujoco.mjtTimer.mjTIMER_ACTUATION,
        "constraint solver": mujoco.mjtTimer.mjTIMER_CONSTRAINT,
        "integration": mujoco.mjtTimer.mjTIMER_ADVANCE,
    }
    spent = dict.fromkeys(timers, 0.0)
    for name, row in list(zip(names, rows, strict=True))[::10]:
        if not row.get("working", no()).any():
            continue
        scene = scene_of(name)
        grasp = Grasps(torch.tensor(row["waypoints"][row["working"]][:1]), "world")
        execution = Execution(scene, grasp, HAND, scene.model(HAND.spec), WORKING)
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

"""Record what the whole way from a depth image to a verified grasp gives: python tests/golden/pipeline.py

Nine cases: five test scenes of the shipped grasp set, the three real frames where they are at hand, and one mesh.
tests/test_golden.py computes the same again and compares. Record anew only when a figure is meant to change, and say
why in the commit. The file holds plain arrays, so that it outlives every class of ours:

- CASE.waypoints (grasp, 10, 28): generated, world frame: position, quaternion wxyz, 20 joints, type; CASE.likelihood
- CASE.density: log-density of these; CASE.logit.MODEL: log-odds by each shipped model
- CASE.refined.*: the ten best by em_fk, refined: waypoints, accepted, scores, and each penalty
- CASE.outcome.*: what the trial found, where there is a simulated scene
- plan.*: one whole plan, refined; heuristic.*: the other generator; decoded: 200 rows of the set as waypoints
- labels.*: 200 rows of the set, tried again; trial: the trial's own constants (metadata, JSON)

pipeline.json beside it tells the processor that recorded, and how it rounds.
"""

from __future__ import annotations

import json
import sys
from dataclasses import fields
from hashlib import sha256
from pathlib import Path

import numpy as np
import torch
import trimesh
from safetensors.torch import save_file
from torch import Tensor

import dexzoo
from dexzoo.collection.rendering import rebuild, render
from dexzoo.comparison.scores import processor
from dexzoo.data.grasp_set import GraspSet
from dexzoo.generators import make_generator
from dexzoo.grasp import Grasps, Trajectory, read_trajectory
from dexzoo.hand import Hand
from dexzoo.perception import Observation
from dexzoo.sim import ObjectModel, Outcomes, Scene, protocol, trial
from dexzoo.sim.world import WORKING

PATH = Path(__file__).with_suffix(".safetensors")
PROCESSOR = Path(__file__).with_suffix(".json")
REAL = Path(__file__).parents[3] / "shared" / "real"
SCENES = (5, 17, 41, 47, 77)
"""Numbers of test scenes of the set; among their objects are such as lie on a block."""
FRAMES = ("blue_mug", "green_bowl", "mustard")
NUM_GRASPS, NUM_REFINED, NUM_ROWS = 30, 10, 200
ROOT = Path(__file__).parents[2]


def grasp_set() -> GraspSet:
    return GraspSet(ROOT / "assets" / "grasps", renderer=render)


def names() -> list[str]:
    frames = [f"frame_{name}" for name in FRAMES if REAL.is_dir()]
    return [f"scene_{number}" for number in SCENES] + frames + ["mesh"]


def case(name: str) -> tuple[Observation, Scene | None]:
    """The observation of a case, and the scene behind it where it is simulated."""
    kind, _, which = name.partition("_")
    if kind == "frame":
        return Observation.load(REAL / f"{which}_depth.png", REAL / f"{which}.json"), None
    if kind == "mesh":
        handle = trimesh.creation.torus(0.03, 0.006).apply_translation([0.0, 0.045, 0.06])
        parts = [trimesh.creation.cylinder(0.035, 0.12).apply_translation([0, 0, 0.06]), handle.convex_hull]
        mesh = trimesh.util.concatenate(parts)
        scene = Scene.place(ObjectModel.from_mesh(mesh, 0.25, 0.7, parts, "cup"), seed=3)
        return scene.observe(seed=4), scene
    known = grasp_set()
    row = known.scenes["scene"].to_pylist().index(int(which))
    scene = rebuild(known.scenes.slice(row, 1).to_pylist()[0])
    view = int(np.flatnonzero(known.view_scene == row)[0])
    return scene.observe(known.views["seed"][view].as_py()), scene


def plain(grasps: Trajectory) -> Tensor:
    """(grasp, 10, 28): position, quaternion, joints, type."""
    types = grasps.grasp_type.float()[:, None, None].expand(-1, 10, 1)
    return torch.cat((grasps.wrist, grasps.joints, types), -1)


def grasps_of(waypoints: Tensor) -> Grasps:
    return Grasps.of(read_trajectory({"waypoints": waypoints}), Hand.load())


def generated(observation: Observation, generator: str = "kopicki") -> dict[str, Tensor]:
    grasps = dexzoo.generate(observation, NUM_GRASPS, seed=0, generator=generator)
    assert grasps.log_likelihood is not None
    return {"waypoints": plain(grasps), "likelihood": grasps.log_likelihood}


def density(observation: Observation, waypoints: Tensor) -> Tensor:
    found = make_generator("kopicki", Hand.load()).density(observation)
    assert found is not None
    return found.log_density(grasps_of(waypoints))


def log_odds(observation: Observation, waypoints: Tensor, model: str) -> Tensor:
    with torch.no_grad():
        return dexzoo.load(model).prepare(observation).logit(grasps_of(waypoints).trajectory)


def refined(observation: Observation, waypoints: Tensor, logit: Tensor) -> dict[str, Tensor]:
    best = logit.argsort(descending=True, stable=True)[:NUM_REFINED]
    result = dexzoo.refine(grasps_of(waypoints[best]), observation, "em_fk")
    found = {"waypoints": plain(result.grasps), "accepted": result.accepted}
    found |= {"score_before": result.score_before, "score_after": result.score_after}
    return found | {f"penalty.{name}": value for name, value in result.penalties.items()}


def outcomes(scene: Scene, waypoints: Tensor) -> dict[str, Tensor]:
    return _plain(dexzoo.verify(grasps_of(waypoints), scene))


def planned(observation: Observation) -> dict[str, Tensor]:
    plan = dexzoo.plan(observation, "em_fk", NUM_GRASPS, NUM_REFINED, seed=1)
    return {
        "waypoints": plain(plan.grasps),
        "score": plan.score,
        "refined_score": plan.refined_score,
        "rank": plan.generator_rank,
    }


def decoded() -> Tensor:
    return plain(grasp_set().world_grasps[label_rows()])


def label_rows() -> Tensor:
    """Rows of the set's table of grasps: twenty of each of ten scenes, evenly spread."""
    known = grasp_set()
    scenes = np.linspace(0, len(known.scenes) - 1, 10).astype(int)
    each = NUM_ROWS // len(scenes)
    rows = [np.flatnonzero(known.grasp_scene == scene) for scene in scenes]
    return torch.tensor(np.concatenate([row[np.linspace(0, len(row) - 1, each).astype(int)] for row in rows]))


def labels(rows: Tensor) -> dict[str, Tensor]:
    """What the trial finds for some rows of the set, which must all be there."""
    known = grasp_set()
    parts = []
    for scene in np.unique(known.grasp_scene[rows]):
        some = rows[torch.from_numpy(known.grasp_scene[rows] == scene)]
        stage = rebuild(known.scenes.slice(scene, 1).to_pylist()[0])
        parts.append(trial.run(stage, known.world_grasps[some], num_threads=1))
    return _plain(Outcomes.concatenate(parts))


def constants() -> dict[str, object]:
    """The trial's own: times, heights, and the compiled model's gains and contacts."""
    scene = case("mesh")[1]
    assert scene is not None
    model = scene.model(Hand.load().spec)
    times = {
        "APPROACH_DISTANCE": protocol.APPROACH_DISTANCE,
        "APPROACH": protocol.APPROACH_TIME,
        "CLOSE": protocol.CLOSE_TIME,
        "SQUEEZE_TIME": protocol.SQUEEZE_TIME,
        "PAUSE": protocol.PAUSE_TIME,
        "LIFT": protocol.LIFT_TIME,
        "HOLD": protocol.HOLD_TIME,
        "LIFT_HEIGHT": protocol.LIFT_HEIGHT,
    }
    arrays = {
        "actuator_gain": model.actuator_gainprm[:, 0],
        "actuator_bias": model.actuator_biasprm[:, :3],
        "actuator_force": model.actuator_forcerange,
        "joint_damping": model.dof_damping,
        "joint_armature": model.dof_armature,
        "friction": model.geom_friction,
        "priority": model.geom_priority,
        "condim": model.geom_condim,
        "solver": np.array([model.opt.impratio, model.opt.timestep, model.opt.cone, model.opt.integrator]),
        "equality": model.eq_solref,
        "body_mass": model.body_mass,
    }
    found: dict[str, object] = dict(times)
    found |= {name: np.asarray(value, float).round(9).tolist() for name, value in arrays.items()}
    return found | {"physics": {field.name: getattr(WORKING, field.name) for field in fields(WORKING)}}


def _plain(found: Outcomes) -> dict[str, Tensor]:
    return {field.name: torch.from_numpy(getattr(found, field.name)) for field in fields(Outcomes)}


def rounding() -> str:
    """A digest of sums, functions and convolutions that involve no code of ours: equal where libraries round alike.

    The name of a processor does not tell: two generations, or two sizes of cache, may sum in another order.
    """
    torch.set_num_threads(1)
    draw = torch.Generator().manual_seed(0)
    wide, tall = torch.randn(300, 512, generator=draw), torch.randn(512, 70, generator=draw)
    image, kernel = torch.randn(2, 16, 40, 40, generator=draw), torch.randn(32, 16, 3, 3, generator=draw)
    half = torch.bfloat16
    found = [wide @ tall, wide.double() @ tall.double(), wide.half() @ tall.half(), wide.to(half) @ tall.to(half)]
    found += [torch.conv2d(image, kernel), torch.conv2d(image.to(half), kernel.to(half)), wide.sum(), wide.cumsum(1)]
    found += [
        wide.exp(),
        wide.sin(),
        wide.sigmoid(),
        wide.logsumexp(1),
        wide.abs().log(),
        torch.linalg.inv(wide[:, :300]),
    ]
    arrays = [value.float().numpy() for value in found] + [wide.double().numpy() @ tall.double().numpy()]
    vectors = torch.backends.cpu.get_cpu_capability().encode()
    return sha256(vectors + b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()


def main() -> None:
    torch.set_num_threads(1)
    record: dict[str, Tensor] = {}

    def add(prefix: str, values: dict[str, Tensor]) -> None:
        record.update({f"{prefix}.{name}": value for name, value in values.items()})

    for name in names():
        observation, scene = case(name)
        add(name, generated(observation))
        waypoints = record[f"{name}.waypoints"]
        record[f"{name}.density"] = density(observation, waypoints)
        for model in dexzoo.list_models():
            record[f"{name}.logit.{model}"] = log_odds(observation, waypoints, model)
        add(f"{name}.refined", refined(observation, waypoints, record[f"{name}.logit.em_fk"]))
        if scene is not None:
            add(f"{name}.outcome", outcomes(scene, waypoints))
        sys.stdout.write(f"{name}: {len(waypoints)} grasps\n")
    observation, _ = case("mesh")
    add("plan", planned(observation))
    add("heuristic", generated(observation, "heuristic"))
    record["decoded"] = decoded()
    add("labels", {"row": label_rows()} | labels(label_rows()))
    save_file({n: value.contiguous() for n, value in record.items()}, PATH, {"trial": json.dumps(constants())})
    PROCESSOR.write_text(json.dumps({"processor": processor(), "rounding": rounding()}, indent=2) + "\n")


if __name__ == "__main__":
    main()

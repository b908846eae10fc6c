"""How long a view takes, on one core and without OpenGL: one object of each category and a few of its views.

python benchmarks/views.py --out benchmarks/results/views.json
Times are of the process's own clock, after one view to warm up.
"""

import argparse
import json
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import torch

from dexzoo.perception.camera import Camera
from dexzoo.sim import Scene
from dexzoo.sim.robot import to_quaternion
from dexzoo.sim.shapes import NUM_OBJECTS, make_object

CAMERAS = {"460 x 460": Camera(460, 460, 574.0, 574.0, 230.0, 230.0), "640 x 480": Camera()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--views", type=int, default=10, help="of each object")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows, multiray = {}, []
    for category in NUM_OBJECTS:
        scene = Scene.place(make_object(f"{category}_00"), seed=0)
        row: dict[str, object] = {"faces": len(scene.object.mesh.faces)}
        for name, camera in CAMERAS.items():
            for kind in ("ideal", "noisy"):
                row[f"{name}, {kind}"] = milliseconds(
                    lambda seed, c=camera, k=kind: scene.observe(seed, c, ideal=k == "ideal"),  # noqa: B023, run at once
                    options.views,
                )
        row["460 x 460, noisy, with the evaluator's image"] = milliseconds(
            lambda seed: scene.observe(seed, CAMERAS["460 x 460"]).aimed().image(),  # noqa: B023, run at once
            options.views,
        )
        rows[category] = row
        multiray.append(with_mujoco(scene, CAMERAS["460 x 460"]))
        sys.stderr.write(f"{category}: {row}\n")
    names = [name for name in rows["can"] if name != "faces"]
    result = {
        "views_of_each": options.views,
        "machine": platform.machine(),
        "milliseconds": {
            name: {
                "median": round(float(np.median([row[name]["median"] for row in rows.values()])), 1),
                "slowest category's median": max(row[name]["median"] for row in rows.values()),
                "slowest view": max(row[name]["max"] for row in rows.values()),
            }
            for name in names
        },
        "rays alone by mujoco.mj_multiRay, 460 x 460": round(float(np.median(multiray)), 1),
        "categories": rows,
    }
    text = json.dumps(result, indent=2)
    if options.out:
        options.out.write_text(text + "\n")
    sys.stdout.write(text + "\n")


def milliseconds(job: Callable[[int], object], count: int) -> dict[str, float]:
    job(0)
    times = []
    for seed in range(count):
        start = time.process_time()
        job(seed)
        times.append(1e3 * (time.process_time() - start))
    return {"median": round(float(np.median(times)), 1), "max": round(max(times), 1)}


def with_mujoco(scene: Scene, camera: Camera) -> float:
    """Milliseconds that MuJoCo's own ray caster takes for the same rays, without noise and shadow, to compare."""
    mesh, T = scene.object.mesh, scene.T_world_object
    world = mujoco.MjSpec()
    world.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[2, 2, 0.1])
    world.add_mesh(
        name="object",
        uservert=mesh.vertices.astype(np.float32).ravel(),
        userface=mesh.faces.astype(np.int32).ravel(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    body = world.worldbody.add_body(pos=T[:3, 3], quat=to_quaternion(T[:3, :3]))
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="object")
    model = world.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    pose = scene.observe(0, camera).T_world_camera
    rays = (camera.directions() @ pose[:3, :3].T).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    count = len(rays)
    geom, distance, normal = np.zeros(count, np.int32), np.zeros(count), np.zeros(3 * count)
    start = time.process_time()
    mujoco.mj_multiRay(model, data, pose[:3, 3], rays.ravel(), None, True, -1, geom, distance, normal, count, 3.0)
    return 1e3 * (time.process_time() - start)


if __name__ == "__main__":
    main()

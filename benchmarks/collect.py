"""How fast grasps are collected and loaded, and whether a collection that is killed goes on to the same files.

python benchmarks/collect.py --out benchmarks/results/collect.json
Scenes are small, of 20 grasps each, so that many fit into minutes. Processes and Ray make the same scenes of seed 0,
and all files are compared byte for byte. Ten times a run is killed (SIGKILL) at a random moment and started again.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from dexzoo.collection.collect import Configuration, collect
from dexzoo.collection.rendering import render
from dexzoo.data.batches import GraspDataset
from dexzoo.data.datamodule import GraspDataModule

NUM_KILLS = 10
LONGEST = 15.0
"""Seconds that a run lives at most before it is killed."""
FEATURES = 512


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=40)
    parser.add_argument("--generator", default="heuristic")
    parser.add_argument("--data", default="assets/grasps")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    configuration = Configuration(generator=options.generator, num_grasps=20, num_views=2)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rates = {
            "1 worker": rate(folder / "1", configuration, options.scenes, 1, None),
            "2 workers": rate(folder / "2", configuration, options.scenes, 2, None),
            "ray": rate(folder / "ray", configuration, options.scenes, 0, "local"),
        }
        kills = resume(folder / "killed", configuration, options.scenes)
        same = {other: contents(folder / "1") == contents(folder / other) for other in ("2", "ray", "killed")}
    result = {
        "processors": os.cpu_count(),
        "scenes": options.scenes,
        "generator": options.generator,
        "scenes_per_hour": rates,
        "two_over_one": rates["2 workers"] / rates["1 worker"],
        "same_files_as_1_worker": same,
        "kills": kills,
        "grasps_loaded_per_second": {str(size): loading(options.data, size) for size in (64, 1024)},
    }
    text = json.dumps(result, indent=2)
    if options.out:
        options.out.write_text(text + "\n")
    sys.stdout.write(text + "\n")


def rate(folder: Path, configuration: Configuration, num_scenes: int, workers: int, ray: str | None) -> float:
    """Scenes an hour, from when all workers have made their first, so that their start does not count."""
    skip = 2 * max(workers, 2)
    times = [time.perf_counter() for _ in collect(folder, configuration, num_scenes, workers, ray)]
    return 3600 * (num_scenes - skip) / (times[-1] - times[skip - 1])


def resume(folder: Path, configuration: Configuration, num_scenes: int) -> list[dict[str, float]]:
    """Kill the command NUM_KILLS times, then let it end; what was there after each kill."""
    command = [sys.executable, "-m", "dexzoo", "collect", "--out", str(folder), "--scenes", str(num_scenes)]
    command += ["--num_grasps", str(configuration.num_grasps), "--num_views", str(configuration.num_views)]
    command += ["--generator", configuration.generator, "--workers", "2", "--json"]
    rng = np.random.default_rng(0)
    kills = []
    for _ in range(NUM_KILLS):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        seconds = rng.uniform(0, LONGEST)
        time.sleep(seconds)
        process.kill()
        process.wait()
        kills.append({"after_seconds": round(seconds, 1), "scenes": len(finished(folder))})
    subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
    return kills


def finished(folder: Path) -> list[Path]:
    """Scenes that wait for their shard to be complete."""
    return list(folder.glob(".scenes/0*"))


def contents(folder: Path) -> dict[str, bytes]:
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def loading(folder: str, batch_size: int) -> float:
    """Grasps a second of an epoch of balanced batches, whose views are encoded already, on two threads."""
    torch.set_num_threads(2)
    data = GraspDataModule(folder, batch_size)
    data.renderer = render
    source = data.source
    encoded = {"features": torch.zeros(source.views.num_rows, FEATURES, dtype=torch.float16)}
    success, scene, view, view_scene = (
        torch.from_numpy(array) for array in (source.success, source.grasp_scene, source.grasp_view, source.view_scene)
    )
    grasps = source.world_grasps.trajectory
    dataset = GraspDataset(grasps, success.float(), scene, view, encoded, view_scene, data.T_aimed_world)
    fastest = 0.0
    for _ in range(3):
        start = time.perf_counter()
        loaded = sum(len(batch.success) for batch in data.loader(dataset, balanced=True))
        fastest = max(fastest, loaded / (time.perf_counter() - start))
    return fastest


if __name__ == "__main__":
    main()

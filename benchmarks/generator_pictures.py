"""The pictures of benchmarks/generator.py: rank against success, the first grasps on ten objects, cost against size."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
from torch import Tensor

from dexzoo.hand import Hand
from dexzoo.perception import Camera, Observation
from dexzoo.perception.camera import look_at
from dexzoo.sim import Scene
from dexzoo.viewing import pictures

THESIS_ALL, THESIS_FIRST = 0.485, 0.693
"""Success of all of its generator's grasps, and of the first of each scene (thesis, chapter 3)."""
HOLDS, FAILS = (70, 160, 80), (205, 70, 60)
NUM_OBJECTS = 10
SIZE, FOCAL = 180, 310


def rank(variants: dict[str, dict[str, Any]], path: Path) -> None:
    """How many hold in each tenth of the generator's order, with intervals, and what of it is known of the thesis."""
    figure, axes = plt.subplots(figsize=(6.4, 4), layout="constrained")
    for name, found in variants.items():
        tenths = {10 * i + 5: row for i, row in enumerate(found["tenths"]) if row["grasps"]}
        middle, mid = list(tenths), [100 * row["rate"] for row in tenths.values()]
        low, high = 100 * np.array([row["interval"] for row in tenths.values()]).T
        (line,) = axes.plot(middle, mid, marker="o", label=f"{name}, {found['scenes']} scenes")
        axes.fill_between(middle, low, high, color=line.get_color(), alpha=0.2, linewidth=0)
        axes.plot(0, 100 * found["top1"]["rate"], marker="*", markersize=11, color=line.get_color(), clip_on=False)
    axes.axhline(100 * THESIS_ALL, color="black", linestyle="--", linewidth=1, label="thesis, all grasps")
    axes.plot(0, 100 * THESIS_FIRST, "k*", markersize=11, clip_on=False, label="first of each scene (black: thesis)")
    axes.set(xlim=(0, 100), ylim=(0, 100), xlabel="place in the generator's order, % of the scene's grasps")
    axes.set(ylabel="hold, % (band: 95 % interval)")
    axes.grid(alpha=0.3)
    axes.legend(loc="upper right", fontsize=8)
    written(figure, path)


def cost(growth: dict[str, Any], path: Path) -> None:
    """Seconds against the number of samples and of kernels."""
    figure, panels = plt.subplots(1, 2, figsize=(8, 3.4), sharey=True, layout="constrained")
    for axes, name in zip(panels, ("num_samples", "num_kernels"), strict=True):
        size = [row[name] for row in growth[name]]
        for key, label in (("processor_seconds", "processor time"), ("seconds", "wall time")):
            axes.plot(size, [row[key] for row in growth[name]], marker="o", label=label)
        axes.axhline(5, color="black", linestyle="--", linewidth=1, label="5 s")
        axes.set(xscale="log", xlabel=name)
        axes.set_xticks(size, [f"{value:,}" for value in size], minor=False)
        axes.minorticks_off()
        axes.grid(alpha=0.3)
    panels[0].set_ylim(0)  # once both are drawn
    panels[0].set_ylabel(f"seconds a view, threads: {growth['threads']}")
    panels[0].legend(fontsize=8)
    written(figure, path)


def written(figure: plt.Figure, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def top(
    scenes: dict[int, Any],
    setting: Callable[[int], tuple[Scene, Observation, int, int]],
    hand: Hand,
    num: int,
    path: Path,
) -> None:
    """The first grasps on the first scene of each of ten categories, seen from where the camera stood.

    scenes: the Trials of generator.py by the scene's number; setting: makes the scene again. A generator that found
    fewer grasps leaves cells blank.
    """
    firsts: dict[str, int] = {}
    for number, row in scenes.items():
        firsts.setdefault(row.category, number)
    cells, titles = [], []
    for number in list(firsts.values())[:NUM_OBJECTS]:
        row, (scene, view, _, _) = scenes[number], setting(number)
        for place in range(num):
            name = f"{place + 1}:" if place else f"{row.object}, 1:"
            if place < len(row):
                holds = bool(row.success[place])
                wrist, joints = torch.tensor(row.wrist[place]), torch.tensor(row.joints[place])
                cells.append(shown(scene, view.T_world_camera, hand, wrist, joints, holds))
                titles.append(f"{name} {'holds' if holds else 'fails'}")
            else:
                cells.append(np.full((SIZE, SIZE, 3), 255, np.uint8))
                titles.append(f"{name} none")
    pictures.save(pictures.grid(cells, titles, columns=2 * num), path)


def shown(
    scene: Scene, T_world_camera: np.ndarray, hand: Hand, wrist: Tensor, joints: Tensor, holds: bool
) -> pictures.Image:
    """The object and the hand at the grip, green where the trial held and red where not."""
    mesh = scene.object.mesh.copy().apply_transform(scene.T_world_object)
    solids = [pictures.Solid(mesh, pictures.OBJECT_COLOR)]
    if scene.support is not None:
        solids.append(pictures.Solid(scene.support.mesh, (150, 150, 150)))
    solids.append(pictures.hand_solid(hand, wrist, joints, HOLDS if holds else FAILS))
    target = (mesh.bounds.mean(0) + wrist[:3].numpy()) / 2
    away = T_world_camera[:3, 3] - mesh.bounds.mean(0)
    pose = look_at(target, 0.6, float(np.arctan2(away[1], away[0])), 0.6)
    return pictures.render(solids, Camera(SIZE, SIZE, FOCAL, FOCAL, SIZE / 2, SIZE / 2), pose)[0]

"""What benchmarks/generator.py keeps of each scene, and the figures that it makes of that."""

import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from scipy.stats import mannwhitneyu

from dexzoo import rotation
from dexzoo.grasp import GRASP_TYPES

NUM_BOOTSTRAP = 2000
TOP = 5
FLAGS = ("success", "collided", "starts_inside", "unstable")
COSTS = ("seconds", "processor_seconds", "peak_megabytes")


class Kept:
    """Arrays that go to a file for each scene."""

    def save(self, path: Path) -> None:
        """Write aside and rename, so that a file is there only when it is whole."""
        path.parent.mkdir(parents=True, exist_ok=True)
        aside = path.with_name(f".{os.getpid()}_{path.name}")
        np.savez(aside, **{field.name: getattr(self, field.name) for field in fields(self)})  # type: ignore[arg-type]
        aside.rename(path)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what `save` wrote."""
        with np.load(path) as stored:
            return cls(**{name: stored[name] if stored[name].ndim else stored[name].item() for name in stored})

    @classmethod
    def load_all(cls, folder: Path, scenes: int) -> dict[int, Self]:
        """What was done in the first so many scenes, by the scene's number."""
        paths = {number: folder / f"{number:03d}.npz" for number in range(scenes)}
        return {number: cls.load(path) for number, path in paths.items() if path.exists()}


class Tried(Kept):
    """Grasps that were tried. outcome: (n, 4) bool, columns FLAGS."""

    outcome: np.ndarray

    @property
    def success(self) -> np.ndarray:
        """Which hold, (n,)."""
        return self.outcome[:, FLAGS.index("success")]

    @property
    def collided(self) -> np.ndarray:
        """Which hit the table or what stands on it, (n,)."""
        return self.outcome[:, FLAGS.index("collided")]


@dataclass(frozen=True)
class Trials(Tried):
    """What became of one variant's grasps in one scene, best first.

    wrist: (n, 7) poses at the grip in the world frame, position and quaternion. joints: (n, joint) angles there.
    grasp_type: (n,) indices into GRASP_TYPES. outcome: (n, 4) bool, columns FLAGS.
    redrawn: scenes drawn before this one that could not be set or seen. cost: (3,) COSTS of generating.
    """

    object: str
    category: str
    redrawn: int
    error: str
    cost: np.ndarray
    wrist: np.ndarray
    joints: np.ndarray
    grasp_type: np.ndarray
    log_likelihood: np.ndarray
    outcome: np.ndarray

    def __len__(self) -> int:
        return len(self.wrist)


Counts = tuple[np.ndarray, np.ndarray]
"""Of each scene, how many hold and of how many."""


def compared(done: dict[str, dict[int, Trials]]) -> dict[str, dict[str, Any]]:
    """The figures of each variant, and by how much it differs from the first one."""
    return beside_first(done, lambda scenes: summarize(list(scenes.values())), {"success": share, "top1": top1})


def beside_first(
    done: dict[str, dict[int, Any]],
    figures: Callable[[dict[int, Any]], dict[str, Any]],
    counts: dict[str, Callable[[list[Any]], Counts]],
) -> dict[str, dict[str, Any]]:
    """The figures of each variant, and on the scenes that it shares with the first one by how much counts differ."""
    base_name, base = next(iter(done.items()))
    result = {}
    for name, scenes in done.items():
        if not scenes:
            sys.stderr.write(f"{name}: nothing is done yet\n")
            continue
        result[name] = figures(scenes)
        shared = sorted(scenes.keys() & base.keys())
        if name != base_name and shared:
            here, there = ([rows[number] for number in shared] for rows in (scenes, base))
            change = {key: change_of(of(here), of(there)) for key, of in counts.items()}
            result[name]["against"] = {"variant": base_name, "scenes": len(shared), **change}
    return result


def share(rows: Sequence[Tried]) -> Counts:
    return np.array([row.success.sum() for row in rows]), np.array([len(row.success) for row in rows])


def top(num: int, rows: list[Trials]) -> Counts:
    """Of the first few of each scene, or of all where there are fewer; none holds where there are none."""
    return np.array([row.success[:num].mean() if len(row) else 0.0 for row in rows]), np.ones(len(rows))


top1 = partial(top, 1)


def resampled(counts: Counts) -> np.ndarray:
    """The rate over all scenes, and those of the bootstrap's samples of scenes, the same for the same number."""
    held, count = counts
    draws = np.random.default_rng(0).integers(len(held), size=(NUM_BOOTSTRAP, len(held)))
    draws = np.concatenate((np.arange(len(held))[None], draws))
    return held[draws].sum(1) / np.maximum(count[draws].sum(1), 1)


def rate(values: np.ndarray) -> dict[str, Any]:
    return {"rate": float(values[0]), "interval": np.percentile(values[1:], [2.5, 97.5]).tolist()}


def change_of(here: Counts, there: Counts) -> dict[str, Any]:
    return rate(resampled(here) - resampled(there))


def summarize(rows: list[Trials]) -> dict[str, Any]:
    outcome, kind = (np.concatenate([getattr(row, name) for row in rows]) for name in ("outcome", "grasp_type"))
    success = outcome[:, 0]
    cost = np.array([row.cost for row in rows])
    apart = np.array([apartness(row) for row in rows if len(row) > 1])
    within = [auroc(row.log_likelihood, row.success) for row in rows if 0 < row.success.sum() < len(row)]
    categories = {name: [row for row in rows if row.category == name] for name in sorted({r.category for r in rows})}
    return {
        "scenes": len(rows),
        "objects": len({row.object for row in rows}),
        "redrawn": sum(row.redrawn for row in rows),
        "without_grasp": sum(not len(row) for row in rows),
        "grasps": len(success),
        "success": rate(resampled(share(rows))),
        "top1": rate(resampled(top1(rows))),
        f"top{TOP}": rate(resampled(top(TOP, rows))),
        "top1_above_all": change_of(top1(rows), share(rows)),
        **{flag: mean(outcome[:, FLAGS.index(flag)]) for flag in FLAGS[1:]},
        "auroc": auroc(np.concatenate([row.log_likelihood for row in rows]), success),
        "auroc_within_scenes": mean(within),
        "scenes_with_an_auroc": len(within),
        "types_among_successes": len(np.unique(kind[success])),
        "types": {
            name: {"grasps": int((kind == i).sum()), "success": mean(success[kind == i])}
            for i, name in enumerate(GRASP_TYPES)
        },
        "categories": {
            name: {
                "scenes": len(some),
                "grasps": int(share(some)[1].sum()),
                "success": mean(np.concatenate([row.success for row in some])),
                "top1": float(resampled(top1(some))[0]),
            }
            for name, some in categories.items()
        },
        "wrist_distance": mean(apart[:, 0]) if len(apart) else None,
        "wrist_angle": mean(apart[:, 1]) if len(apart) else None,
        "tenths": [{"grasps": int(counts[1].sum()), **rate(resampled(counts))} for counts in tenths(rows)],
        **{
            name: {"median": float(np.median(spent)), "max": float(spent.max())}
            for name, spent in zip(COSTS, cost.T, strict=True)
        },
    }


def mean(values: np.ndarray | list[float]) -> float | None:
    return float(np.mean(values)) if len(values) else None


def auroc(score: np.ndarray, success: np.ndarray) -> float | None:
    """The chance that a grasp that holds scores above one that fails; a tie counts half."""
    held, failed = score[success].astype(float), score[~success].astype(float)
    if not len(held) or not len(failed):
        return None
    return float(mannwhitneyu(held, failed).statistic / (len(held) * len(failed)))


def apartness(row: Trials) -> tuple[float, float]:
    """Mean distance in meters and angle in radians between the wrists of two grasps of a scene."""
    first, second = np.triu_indices(len(row), 1)
    position, quaternion = row.wrist[:, :3], torch.tensor(row.wrist[:, 3:])
    distance = np.linalg.norm(position[first] - position[second], axis=1)
    return float(distance.mean()), float(rotation.angle(quaternion[first], quaternion[second]).mean())


def tenths(rows: list[Trials]) -> list[Counts]:
    """Of the first to the last tenth of each scene's order (thesis, Figure 3.13)."""
    place = [((np.arange(len(row)) + 0.5) / max(len(row), 1) * 10).astype(int) for row in rows]
    at = [[where == tenth for where in place] for tenth in range(10)]
    return [
        (np.array([r.success[w].sum() for r, w in zip(rows, x, strict=True)]), np.array([w.sum() for w in x]))
        for x in at
    ]

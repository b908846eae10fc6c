"""The sensor model beside real depth images: noise, steps, missing pixels, holes; and a page of sample views.

python benchmarks/sensor.py FOLDER --out benchmarks/results/sensor.json --picture docs/views.png
FOLDER holds real frames: NAME_depth.png, NAME.json (a camera file with the table's plane), NAME_mask.png (the object)
and NAME_color.jpg. The simulated ones are of mugs, bowls and bottles of our own, seen by a camera of the same
intrinsics from the same height and angle, and at the same distance.
"""

import argparse
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy import ndimage

from dexzoo.models.encoders import colorize
from dexzoo.perception.camera import IMAGE_SIZE, Camera
from dexzoo.perception.observation import Observation
from dexzoo.sim import Scene
from dexzoo.sim.rays import RayCaster
from dexzoo.sim.sensor import BASELINE, read_depth
from dexzoo.sim.shapes import make_object
from dexzoo.viewing import pictures

LIKE_THE_REAL = ("mug", "bowl", "bottle")
OBJECTS_EACH = 4
SAMPLES = ("mug_01", "bowl_02", "bottle_03", "teapot_01", "cup_03", "spoon_02", "pan_01", "scissors_01")
DISTANCES = ((0.35, 0.45), (0.45, 0.55), (0.55, 0.7), (0.7, 0.9))
BANDS = ((0, 2), (2, 4), (4, 8))
SIDES = ("left", "right", "top", "bottom")


@dataclass
class Frame:
    """A depth image and what is known of it."""

    observation: Observation
    mask: np.ndarray


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    names = sorted(path.stem for path in options.folder.glob("*.json"))
    real = [load(options.folder, name) for name in names]
    simulated = [
        simulate(f"{category}_{i:02d}", frame, options.seed + i)
        for frame in real
        for category in LIKE_THE_REAL
        for i in range(OBJECTS_EACH)
    ]
    result = {
        "real_frames": len(real),
        "simulated_frames": len(simulated),
        "real": measures(real),
        "simulated": measures(simulated),
    }
    text = json.dumps(result, indent=2)
    if options.out:
        options.out.write_text(text + "\n")
    sys.stdout.write(text + "\n")
    if options.picture:
        pictures.save(picture(options.folder, names, real, options.seed), options.picture)


def load(folder: Path, name: str) -> Frame:
    observation = Observation.load(folder / f"{name}_depth.png", folder / f"{name}.json")
    return Frame(observation, cv2.imread(str(folder / f"{name}_mask.png"), cv2.IMREAD_GRAYSCALE) > 0)


def simulate(name: str, like: Frame, seed: int) -> Frame:
    """A frame of one of our objects in the place of a real one, without calibration error."""
    pose = like.observation.T_world_camera.copy()
    cloud = like.observation.camera.directions()[like.mask] * like.observation.depth[like.mask][:, None]
    middle = cloud[cloud[:, 2] > 0].mean(0) @ pose[:3, :3].T + pose[:3, 3]
    pose[:2, 3] -= middle[:2]
    scene = Scene.place(make_object(name), seed)
    caster = RayCaster(scene.object.mesh.copy().apply_transform(scene.T_world_object), None)
    camera = like.observation.camera
    depth, mask = caster.depth(camera, pose)
    lit = caster.lit(depth, camera, pose, pose[:3, 3] + BASELINE * pose[:3, 0])
    return Frame(Observation(read_depth(depth, lit, camera, np.random.default_rng(seed)), camera, pose), mask)


def measures(frames: list[Frame]) -> dict[str, object]:
    table = {}
    for low, high in DISTANCES:
        rows = [row for frame in frames if (row := table_noise(frame, low, high))]
        table[f"{low} to {high} m"] = {key: round(float(np.mean([row[key] for row in rows])), 3) for key in rows[0]}
    return {"table": table, "missing": missing(frames), "holes": holes(frames)}


def table_noise(frame: Frame, low: float, high: float) -> dict[str, float]:
    """Of depth against the table's plane, where that is between two distances."""
    observation = frame.observation
    plane = table_depth(observation)
    away = ~ndimage.binary_dilation(frame.mask, iterations=15)
    chosen = away & (observation.depth > 0) & (plane > low) & (plane < high)
    chosen &= np.abs(observation.height) < 0.006
    if chosen.sum() < 500:
        return {}
    error = np.where(chosen, observation.depth - plane, 0)
    weight = ndimage.gaussian_filter(chosen.astype(float), 12)
    local = np.where(chosen, error - ndimage.gaussian_filter(error, 12) / np.maximum(weight, 1e-3), 0)
    disparity = Camera().fx * BASELINE * local / np.where(chosen, plane, 1) ** 2
    levels = np.unique(np.round(observation.depth[chosen], 6))
    inner = levels[(levels > np.quantile(levels, 0.4)) & (levels < np.quantile(levels, 0.6))]
    return {
        "depth_std_mm": 1e3 * float(error[chosen].std()),
        "local_std_mm": 1e3 * float(local[chosen].std()),
        "local_std_disparity": float(disparity[chosen].std()),
        "correlation_length_x": correlation_length(local, chosen, 1),
        "correlation_length_y": correlation_length(local, chosen, 0),
        "step_mm": 1e3 * float(np.median(np.diff(inner))),
    }


def correlation_length(error: np.ndarray, chosen: np.ndarray, axis: int) -> float:
    """Pixels until the correlation of errors falls to a half, between whole pixels by a straight line."""
    before = 1.0
    for step in range(1, 40):
        pair = np.moveaxis(error, axis, 0), np.moveaxis(chosen, axis, 0)
        both = pair[1][step:] & pair[1][:-step]
        now = float((pair[0][step:] * pair[0][:-step])[both].mean() / (error[chosen] ** 2).mean())
        if now < 0.5:
            return step - 1 + (before - 0.5) / (before - now)
        before = now
    return float("inf")


def table_depth(observation: Observation) -> np.ndarray:
    """Depth of the bare table at each pixel, inf above its horizon."""
    slope = observation.camera.directions() @ observation.table[:3]
    return np.where(slope < 0, -observation.table[3] / np.minimum(slope, -1e-9), np.inf)


def missing(frames: list[Frame]) -> dict[str, float]:
    """Share of pixels without a reading, by distance in pixels from the object's outline.

    Beside the object, only where the bare table would be seen nearer than 0.8 m: farther off the real one ends.
    """

    def share(select: Callable[[Frame, np.ndarray, np.ndarray], np.ndarray]) -> float:
        lost = total = 0
        for frame in frames:
            outside, index = ndimage.distance_transform_edt(~frame.mask, return_indices=True)
            signed = np.where(frame.mask, 0.5 - ndimage.distance_transform_edt(frame.mask), outside - 0.5)
            offset = np.indices(frame.mask.shape) - index
            chosen = select(frame, signed, offset)
            lost += int((frame.observation.depth[chosen] == 0).sum())
            total += int(chosen.sum())
        return round(lost / max(total, 1), 4)

    def inside(low: float, high: float) -> Callable[[Frame, np.ndarray, np.ndarray], np.ndarray]:
        return lambda frame, signed, offset: (signed <= -low) & (signed > -high)

    def beside(side: str, low: float, high: float) -> Callable[[Frame, np.ndarray, np.ndarray], np.ndarray]:
        sign, axis = (-1 if side in ("left", "top") else 1), (1 if side in ("left", "right") else 0)
        return lambda frame, signed, offset: (
            (signed > low)
            & (signed <= high)
            & (sign * offset[axis] > np.abs(offset[1 - axis]))
            & (table_depth(frame.observation) < 0.8)
        )

    found = {f"object, {low} to {high} px from its outline": share(inside(low, high)) for low, high in BANDS}
    found["object, farther in"] = share(inside(8, np.inf))
    for side in SIDES:
        for low, high in BANDS:
            found[f"table {side} of it, {low} to {high} px"] = share(beside(side, low, high))
    return found


def holes(frames: list[Frame]) -> dict[str, float]:
    """Connected patches without a reading within objects."""
    sizes: list[int] = []
    area = 0
    for frame in frames:
        labels, count = ndimage.label(frame.mask & (frame.observation.depth == 0))
        sizes += ndimage.sum_labels(labels > 0, labels, range(1, count + 1)).astype(int).tolist()
        area += int(frame.mask.sum())
    found = {"number per 10,000 pixels": round(1e4 * len(sizes) / area, 2)}
    for low, high in ((1, 3), (4, 15), (16, 63), (64, 10**6)):
        name = f"share of the object in holes of {low} " + (f"to {high} pixels" if high < 10**6 else "pixels and more")
        found[name] = round(sum(size for size in sizes if low <= size <= high) / area, 4)
    return found


def picture(folder: Path, names: list[str], real: list[Frame], seed: int) -> pictures.Image:
    """Rows of real and simulated frames: photograph or ideal depth, depth as read, and the three channels."""
    cells: list[pictures.Image] = []
    titles: list[str] = []
    for name, frame in zip(names, real, strict=True):
        observation = Observation(
            frame.observation.depth, frame.observation.camera, table=frame.observation.table, mask=frame.mask
        )
        photograph = cv2.imread(str(folder / f"{name}_color.jpg"))[..., ::-1]
        cells += [crop(photograph, frame.mask), *views(observation)]
        titles += [f"REAL {name}: photo", "depth as read", *channel_names()]
    for view, name in enumerate(SAMPLES, seed):
        scene = Scene.place(make_object(name), seed + 2)  # where the cup tumbles
        cells += [pictures.depth_picture(scene.observe(view, ideal=True).aimed()), *views(scene.observe(view))]
        titles += [f"SIMULATED {name}: ideal", "depth as read", *channel_names()]
    return pictures.grid(cells, titles, columns=5)


def channel_names() -> list[str]:
    return ["channel 1: depth", "2: mean curvature", "3: Gaussian curvature"]


def views(observation: Observation) -> list[pictures.Image]:
    """The aimed view, and what an evaluator sees of it."""
    aimed = observation.aimed()
    channels = colorize(aimed.image()[:1])[0].numpy()
    seen = aimed.mask
    depth = channels[0]
    low, high = depth[seen].min(), depth[seen].max()
    grays = [np.where(seen, 30 + 200 * (depth - low) / max(high - low, 1e-3), 255)]
    for channel in channels[1:]:
        size = np.quantile(np.abs(channel[seen]), 0.98)
        grays.append(np.where(seen, 128 + 120 * np.clip(channel / max(size, 1e-6), -1, 1), 255))
    return [pictures.depth_picture(aimed), *(np.repeat(gray[..., None], 3, -1).astype(np.uint8) for gray in grays)]


def crop(photograph: np.ndarray, mask: np.ndarray) -> pictures.Image:
    """A square around the object."""
    rows, columns = np.nonzero(mask)
    half = 150
    row = int(np.clip(rows.mean(), half, mask.shape[0] - half))
    column = int(np.clip(columns.mean(), half, mask.shape[1] - half))
    square = photograph[row - half : row + half, column - half : column + half]
    return cv2.resize(np.ascontiguousarray(square), (IMAGE_SIZE, IMAGE_SIZE), interpolation=cv2.INTER_AREA)


if __name__ == "__main__":
    main()

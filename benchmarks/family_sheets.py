"""Objects of the families, a page for each family, with the first seeds and their largest extents.

python benchmarks/family_sheets.py --out docs/families [--families body tool] [--num 48]
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from dexzoo.perception.camera import Camera, look_at
from dexzoo.sim.families import family_names, make_shape, shape_name, split_of_shape
from dexzoo.viewing import pictures

COLUMNS, CELL, LABEL, HEADING = 8, 124, 16, 28
COLORS = {"train": (226, 160, 62), "validation": (96, 170, 96), "test": (92, 142, 214)}
INK, FONT = (30, 30, 30), cv2.FONT_HERSHEY_SIMPLEX


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--families", nargs="*", default=family_names())
    parser.add_argument("--num", type=int, default=48)
    options = parser.parse_args()
    for family in options.families:
        save(page(family, options.num), options.out / f"{family}.png")


def page(family: str, num: int) -> np.ndarray:
    """All objects of one family, row by row."""
    names = [shape_name(family, seed) for seed in range(num)]
    rows = -(-num // COLUMNS)
    sheet = np.full((HEADING + rows * (CELL + LABEL), COLUMNS * CELL, 3), 255, np.uint8)
    text = f"{family} ({split_of_shape(names[0])}), seeds 0 to {num - 1}; each fills its cell, its largest extent below"
    cv2.putText(sheet, text, (8, 19), FONT, 0.5, INK, 1, cv2.LINE_AA)
    for index, name in enumerate(names):
        top, left = HEADING + index // COLUMNS * (CELL + LABEL), index % COLUMNS * CELL
        sheet[top : top + CELL, left : left + CELL] = portrait(name)
        size = f"{100 * make_shape(name).mesh.extents.max():.0f} cm"
        cv2.putText(sheet, size, (left + CELL // 2 - 18, top + CELL + 10), FONT, 0.38, INK, 1, cv2.LINE_AA)
    return sheet


def save(picture: np.ndarray, path: Path) -> None:
    """Write a PNG of 96 colors, which is a third as large as one of all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).quantize(96, dither=Image.Dither.NONE).save(path, optimize=True)


def portrait(name: str) -> np.ndarray:
    """One object from in front and above, as large as its cell."""
    mesh = make_shape(name).mesh
    size = 2 * CELL  # drawn twice as large and scaled down, for smooth edges
    flat = mesh.extents[2] < 0.25 * mesh.extents[:2].max()
    pose = look_at(mesh.bounds.mean(0), 1.2, np.deg2rad(-60), np.deg2rad(60 if flat else 38))
    seen = (mesh.vertices - pose[:3, 3]) @ pose[:3, :3]
    image = seen[:, :2] / seen[:, 2:]
    low, high = image.min(0), image.max(0)
    focal = 0.92 * size / (high - low).max()
    middle = size / 2 - focal * (low + high) / 2
    camera = Camera(size, size, focal, focal, *middle.tolist())
    picture, _ = pictures.render([pictures.Solid(mesh, COLORS[split_of_shape(name)])], camera, pose, table=False)
    return cv2.resize(picture, (CELL, CELL), interpolation=cv2.INTER_AREA)


if __name__ == "__main__":
    main()

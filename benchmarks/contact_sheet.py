"""All 294 objects of the grasp set in one picture, by category and colored by split.

python benchmarks/contact_sheet.py --out docs/objects.png
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

from dexzoo.perception.camera import Camera, look_at
from dexzoo.sim.shapes import NUM_OBJECTS, make_object, object_names, split_of
from dexzoo.viewing import pictures

COLUMNS, CELL, HEADING, MARGIN = 26, 92, 26, 10
COLORS = {"train": (226, 160, 62), "validation": (96, 170, 96), "test": (92, 142, 214)}
INK, FONT = (30, 30, 30), cv2.FONT_HERSHEY_SIMPLEX


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    shelves = pack()
    height = HEADING + 2 * MARGIN + len(shelves) * (HEADING + CELL)
    sheet = np.full((height, COLUMNS * CELL + 2 * MARGIN, 3), 255, np.uint8)
    legend(sheet)
    for row, shelf in enumerate(shelves):
        top, column = HEADING + 2 * MARGIN + row * (HEADING + CELL), 0
        for category in shelf:
            left = MARGIN + column * CELL
            write(sheet, f"{category} ({NUM_OBJECTS[category]})", left + 4, top + 18)
            cv2.line(sheet, (left + 2, top + 23), (left + NUM_OBJECTS[category] * CELL - 6, top + 23), (200,) * 3, 1)
            for name in (name for name in object_names() if name.startswith(f"{category}_")):
                left = MARGIN + column * CELL
                sheet[top + HEADING : top + HEADING + CELL, left : left + CELL] = portrait(name)
                column += 1
    pictures.save(sheet, options.out)


def pack() -> list[list[str]]:
    """Categories side by side where they fit on a row."""
    shelves: list[list[str]] = []
    for category, count in NUM_OBJECTS.items():
        for shelf in shelves:
            if sum(NUM_OBJECTS[other] for other in shelf) + count <= COLUMNS:
                shelf.append(category)
                break
        else:
            shelves.append([category])
    return shelves


def portrait(name: str) -> np.ndarray:
    """One object from in front and above, as large as its cell."""
    mesh = make_object(name).mesh
    size = 2 * CELL  # drawn twice as large and scaled down, for smooth edges
    long = mesh.extents[2] < 0.3 * mesh.extents[0] and mesh.extents[1] < 0.7 * mesh.extents[0]
    azimuth, elevation = (-48, 62) if long else (-60, 38)  # what is long lies along the diagonal
    pose = look_at(mesh.bounds.mean(0), 1.2, np.deg2rad(azimuth), np.deg2rad(elevation))
    seen = (mesh.vertices - pose[:3, 3]) @ pose[:3, :3]
    image = seen[:, :2] / seen[:, 2:]
    low, high = image.min(0), image.max(0)
    focal = 0.92 * size / (high - low).max()
    middle = size / 2 - focal * (low + high) / 2
    camera = Camera(size, size, focal, focal, *middle.tolist())
    picture, _ = pictures.render([pictures.Solid(mesh, COLORS[split_of(name)])], camera, pose, table=False)
    return cv2.resize(picture, (CELL, CELL), interpolation=cv2.INTER_AREA)


def legend(sheet: np.ndarray) -> None:
    write(sheet, "Each object fills its cell, whatever its size.  Split:", MARGIN + 4, MARGIN + 18)
    left = 460
    for split, color in COLORS.items():
        cv2.rectangle(sheet, (left, MARGIN + 5), (left + 16, MARGIN + 21), color, -1)
        write(sheet, f"{split} ({len(object_names(split))})", left + 22, MARGIN + 18)
        left += 170


def write(sheet: np.ndarray, text: str, left: int, baseline: int) -> None:
    cv2.putText(sheet, text, (left, baseline), FONT, 0.55, INK, 1, cv2.LINE_AA)


if __name__ == "__main__":
    main()

"""All 294 objects of the grasp set in one picture, by category and colored by split.

python benchmarks/contact_sheet.py --out docs/objects.png
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
from portraits import COLORS, FONT, INK, portrait

from dexzoo.sim.shapes import NUM_OBJECTS, make_object, object_names, split_of
from dexzoo.viewing import pictures

COLUMNS, CELL, HEADING, MARGIN = 26, 92, 26, 10


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
                sheet[top + HEADING : top + HEADING + CELL, left : left + CELL] = drawn(name)
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


def drawn(name: str) -> np.ndarray:
    """One object; a long one lies along the diagonal."""
    mesh = make_object(name).mesh
    long = mesh.extents[2] < 0.3 * mesh.extents[0] and mesh.extents[1] < 0.7 * mesh.extents[0]
    azimuth, elevation = (-48, 62) if long else (-60, 38)
    return portrait(mesh, COLORS[split_of(name)], CELL, azimuth, elevation)


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

"""Objects of the families, a page for each family, with the first seeds and their largest extents.

python benchmarks/family_sheets.py --out docs/families [--families body tool] [--num 48]
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from portraits import COLORS, FONT, INK, portrait

from dexzoo.sim.families import family_names, make_shape, shape_name, split_of_shape

COLUMNS, CELL, LABEL, HEADING = 8, 124, 16, 28


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
        sheet[top : top + CELL, left : left + CELL] = drawn(name)
        size = f"{100 * make_shape(name).mesh.extents.max():.0f} cm"
        cv2.putText(sheet, size, (left + CELL // 2 - 18, top + CELL + 10), FONT, 0.38, INK, 1, cv2.LINE_AA)
    return sheet


def save(picture: np.ndarray, path: Path) -> None:
    """Write a PNG of 96 colors, which is a third as large as one of all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).quantize(96, dither=Image.Dither.NONE).save(path, optimize=True)


def drawn(name: str) -> np.ndarray:
    """One object; a flat one is seen from higher up."""
    mesh = make_shape(name).mesh
    flat = mesh.extents[2] < 0.25 * mesh.extents[:2].max()
    return portrait(mesh, COLORS[split_of_shape(name)], CELL, -60, 60 if flat else 38)


if __name__ == "__main__":
    main()

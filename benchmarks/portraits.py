"""Objects as they are drawn on sheets: one to a cell, colored by split."""

import cv2
import numpy as np

from dexzoo.perception.camera import Camera, look_at
from dexzoo.sim.objects import Mesh
from dexzoo.viewing import pictures

COLORS = {"train": (226, 160, 62), "validation": (96, 170, 96), "test": (92, 142, 214)}
INK, FONT = (30, 30, 30), cv2.FONT_HERSHEY_SIMPLEX


def portrait(mesh: Mesh, color: tuple[int, int, int], cell: int, azimuth: float, elevation: float) -> np.ndarray:
    """A mesh in a square cell that it fills, seen from two angles in degrees."""
    size = 2 * cell  # drawn twice as large and scaled down, for smooth edges
    pose = look_at(mesh.bounds.mean(0), 1.2, np.deg2rad(azimuth), np.deg2rad(elevation))
    seen = (mesh.vertices - pose[:3, 3]) @ pose[:3, :3]
    image = seen[:, :2] / seen[:, 2:]
    low, high = image.min(0), image.max(0)
    focal = 0.92 * size / (high - low).max()
    middle = size / 2 - focal * (low + high) / 2
    camera = Camera(size, size, focal, focal, *middle.tolist())
    picture, _ = pictures.render([pictures.Solid(mesh, color)], camera, pose, table=False)
    return cv2.resize(picture, (cell, cell), interpolation=cv2.INTER_AREA)

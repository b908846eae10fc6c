"""Convex parts of a mesh by CoACD (Wei et al. 2022), as a program of its own: what it does to a bad mesh stays there.

python decompose.py MESH.npz PARTS.npz, where MESH holds vertices and faces, and PARTS vertices_0, faces_0, ...
"""

import sys

import coacd
import numpy as np

MAX_PARTS = 24


def main(source: str, target: str) -> None:
    """Read, cut, write."""
    mesh = np.load(source)
    coacd.set_log_level("error")
    surface = coacd.Mesh(mesh["vertices"], mesh["faces"])
    parts = coacd.run_coacd(surface, threshold=0.05, max_convex_hull=MAX_PARTS, seed=0)
    arrays: dict[str, np.ndarray] = {}
    for index, (vertices, faces) in enumerate(parts):
        arrays |= {f"vertices_{index}": vertices, f"faces_{index}": faces}
    np.savez(target, **arrays)


if __name__ == "__main__":
    main(*sys.argv[1:])

"""Convex parts of a mesh by CoACD (Wei et al. 2022), in a process of its own, since a bad mesh can crash it.

python decompose.py MESH.npz PARTS.npz, where MESH holds vertices and faces, and PARTS vertices_0, faces_0, ...
"""

import sys

import coacd
import numpy as np

MAX_PARTS = 24


def main(source: str, target: str) -> None:
    """Read, cut, write.

    Args:
        source: File of the mesh.
        target: File for the parts.
    """
    mesh = np.load(source)
    coacd.set_log_level("error")
    surface = coacd.Mesh(mesh["vertices"], mesh["faces"])
    parts = coacd.run_coacd(surface, threshold=0.05, max_convex_hull=MAX_PARTS, seed=0)
    arrays = {f"vertices_{i}": vertices for i, (vertices, _) in enumerate(parts)}
    arrays |= {f"faces_{i}": faces for i, (_, faces) in enumerate(parts)}
    np.savez(target, allow_pickle=False, **arrays)


if __name__ == "__main__":
    main(*sys.argv[1:])

"""A picture of the ten demonstrations: each at the pre-grasp, the grip and the squeeze.

python benchmarks/demonstrations.py --out docs/demonstrations.png
"""

import argparse
from pathlib import Path

import numpy as np

from dexzoo.generators.demonstration import load_demonstrations
from dexzoo.grasp import GRASP_TYPES, GRIP, PREGRASP, SQUEEZE
from dexzoo.hand import Hand
from dexzoo.perception.camera import Camera, look_at
from dexzoo.sim import Scene
from dexzoo.sim.shapes import make_object
from dexzoo.viewing import pictures

SIZE = 220
AZIMUTHS = {"power_tube": 4.2, "pinch_support": 2.2, "lateral": 4.6, "edge": 4.4, "handle": 2.4}
"""From where the picture shows a grasp that 0.5 rad would hide behind the hand."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/demonstrations.png"))
    options = parser.parse_args()
    camera = Camera(SIZE, SIZE, 1.2 * SIZE, 1.2 * SIZE, SIZE / 2, SIZE / 2)
    cells, titles = [], []
    for one in sorted(load_demonstrations(Hand.load()), key=lambda shown: shown.grasp_type):
        scene = Scene.place(make_object(one.object), seed=0)
        mesh = scene.object.mesh.copy().apply_transform(scene.T_world_object)
        solids = [pictures.Solid(mesh, pictures.OBJECT_COLOR)]
        if scene.support is not None:
            solids.append(pictures.Solid(scene.support.mesh, (150, 150, 150)))
        grasp = one.grasp.transformed(scene.T_world_object)
        name = GRASP_TYPES[one.grasp_type]
        target = np.append(grasp.position[0, GRIP, :2].numpy() * 0.5, mesh.bounds[:, 2].mean() + 0.03)
        pose = look_at(target, 0.48, AZIMUTHS.get(name, 0.5), 0.45)
        for moment, waypoint in (("", PREGRASP), ("grip", GRIP), ("squeeze", SQUEEZE)):
            drawn = [*solids, pictures.grasp_solid(grasp, waypoint)]
            cells.append(pictures.render(drawn, camera, pose)[0])
            titles.append(moment or f"{name}: {one.object}")
    pictures.save(pictures.grid(cells, titles, columns=6), options.out)


if __name__ == "__main__":
    main()

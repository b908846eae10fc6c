"""Weight, friction and pose of an object, drawn apart from its shape."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dexzoo.sim.objects import ObjectModel
from dexzoo.sim.poses import set_down, stable_poses

Array = NDArray[np.float64]
DENSITY, MASS, FRICTION = (40.0, 1500.0), (0.02, 1.2), (0.3, 1.2)
"""Ranges that a density in kg/m3 is drawn from, a mass in kg is kept in, and a friction is drawn from."""
MAX_OFFSET = 0.3
"""How far the center of mass may be from the middle of the parts, as a share of the way to the hull's surface."""
MIN_TILT = 0.05
"""Radians that an object must bear to be put down in a pose; one that bears less in all of them has the best."""


@dataclass(frozen=True)
class Properties:
    """What an object weighs, how rough it is, and how it lies.

    mass in kg; friction: sliding coefficient. center: center of mass (3,) in m in the object's frame. turn: rotation
    (3, 3) from the object's frame to the world, in which it rests on the table; its yaw is not drawn here.
    probability: that a fall ends in this pose rather than in another one.
    """

    mass: float
    friction: float
    center: Array
    turn: Array
    probability: float


def draw_properties(model: ObjectModel, seed: int) -> Properties:
    """Properties of an object, always the same for a seed.

    The mass follows from a density, as likely to be doubled as halved, and the volume of the parts. The center of mass
    is off the middle in any direction. A stable pose is drawn by how probable it is after a fall.

    Args:
        model: The object; its own mass and friction do not count.
        seed: Of the draw.

    Returns:
        The properties.
    """
    rng = np.random.default_rng(seed)
    density = float(np.exp(rng.uniform(*np.log(DENSITY))))
    mass = float(np.clip(density * sum(hull.volume for hull in model.hulls), *MASS))
    friction = float(rng.uniform(*FRICTION))
    center = _off_middle(model, rng)
    poses = stable_poses(model.mesh, center)
    sure = [pose for pose in poses if pose.tilt >= MIN_TILT] or [max(poses, key=lambda pose: pose.tilt)]
    weights = np.array([pose.probability for pose in sure])
    pose = sure[int(rng.choice(len(sure), p=weights / weights.sum()))]
    return Properties(mass, friction, center, pose.turn, pose.probability)


def with_properties(model: ObjectModel, properties: Properties) -> ObjectModel:
    """The object with that mass and friction, turned as it is to lie, its lowest point at z = 0.

    Its center of mass stays that of parts of one density, since an `ObjectModel` knows no other.

    Args:
        model: The object.
        properties: Drawn for it.

    Returns:
        The object in its new frame, the middle of its bounds on the z axis.
    """
    turned = set_down(model, properties.turn)
    return replace(turned, mass=properties.mass, friction=properties.friction)


def _off_middle(model: ObjectModel, rng: np.random.Generator) -> Array:
    """A center of mass (3,) inside the hull, off that of parts of one density."""
    middle = model.inertia[0]
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    shell = model.mesh.convex_hull
    height = ((shell.triangles[:, 0] - middle) * shell.face_normals).sum(1)
    speed = shell.face_normals @ direction
    reach = float((height[speed > 1e-9] / speed[speed > 1e-9]).min())
    return np.asarray(middle + rng.uniform(0, MAX_OFFSET) * reach * direction, np.float64)

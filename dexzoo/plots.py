"""Pictures: meshes shaded by ray casting (no graphics card needed), hands over depth images, grids of pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from dexzoo.camera import Camera, Observation
from dexzoo.grasp import GRIP, JOINTS, PREGRASP, SQUEEZE, Grasps, pose_matrix
from dexzoo.hand import Hand

Image = NDArray[np.uint8]
OBJECT_COLOUR = (214, 150, 60)
HAND_COLOUR = (70, 120, 200)
TABLE_COLOUR = (225, 225, 220)
OUTLINE_COLOUR = (200, 30, 30)


@dataclass(frozen=True)
class Solid:
    """A mesh in the world frame and its colour (red, green, blue; 0...255)."""

    mesh: trimesh.Trimesh
    colour: tuple[int, int, int]


def hand_solid(hand: Hand, waypoint: torch.Tensor, colour: tuple[int, int, int] = HAND_COLOUR) -> Solid:
    """The hand's primitives at one waypoint (28,), in the waypoint's frame."""
    waypoint = waypoint.detach().double()
    wrist = pose_matrix(waypoint[:3], waypoint[3:7])
    poses = (wrist @ hand.shape_poses(hand.forward_kinematics(waypoint[JOINTS]))).numpy()
    meshes = [shape.mesh().apply_transform(T) for shape, T in zip(hand.shapes, poses, strict=True)]
    return Solid(_joined(meshes), colour)


def _joined(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    joined = trimesh.util.concatenate(meshes)
    assert isinstance(joined, trimesh.Trimesh)  # what meshes alone make
    return joined


def render(
    solids: Sequence[Solid], camera: Camera, T_world_camera: NDArray[np.float64], table: bool = True
) -> tuple[Image, NDArray[np.float64]]:
    """An RGB picture and the depth (m, inf where nothing is hit) of solids over a table at z = 0."""
    rays = camera.directions()
    length = np.linalg.norm(rays, axis=-1).ravel()
    directions = rays.reshape(-1, 3) @ T_world_camera[:3, :3].T
    origin = T_world_camera[:3, 3]
    colour = np.full((len(directions), 3), 255.0)
    depth = np.full(len(directions), np.inf)
    shade = np.ones(len(directions))
    if table:
        with np.errstate(divide="ignore"):
            t = -origin[2] / directions[:, 2]
        hit = (t > 0) & (t < 5)
        point = origin + t[hit, None] * directions[hit]
        squares = (np.floor(point[:, 0] / 0.1) + np.floor(point[:, 1] / 0.1)) % 2
        depth[hit] = t[hit]
        colour[hit] = np.array(TABLE_COLOUR) - 10 * squares[:, None]
    mesh = _joined([solid.mesh for solid in solids])
    faces = np.concatenate([np.full(len(solid.mesh.faces), i) for i, solid in enumerate(solids)])
    triangle, ray, point = mesh.ray.intersects_id(
        np.broadcast_to(origin, directions.shape), directions, multiple_hits=False, return_locations=True
    )[:3]
    distance = np.linalg.norm(point - origin, axis=1) / length[ray]
    front = distance < depth[ray]
    triangle, ray, distance = triangle[front], ray[front], distance[front]
    depth[ray] = distance
    colour[ray] = np.array([solid.colour for solid in solids])[faces[triangle]]
    facing = np.abs((mesh.face_normals[triangle] * directions[ray]).sum(1)) / length[ray]
    above = mesh.face_normals[triangle][:, 2]
    shade[ray] = 0.35 + 0.45 * facing + 0.2 * np.clip(above, 0, 1)
    picture = np.clip(colour * shade[:, None], 0, 255).astype(np.uint8)
    return picture.reshape(camera.height, camera.width, 3), depth.reshape(camera.height, camera.width)


def depth_picture(observation: Observation) -> Image:
    """The depth image in grey: near is dark, no reading is white; the object tinted."""
    depth = observation.depth
    near, far = np.percentile(depth[depth > 0], [1, 99])
    grey = np.where(depth > 0, 60 + 170 * np.clip((depth - near) / max(far - near, 1e-3), 0, 1), 255)
    picture = np.repeat(grey[..., None], 3, axis=-1)
    picture[observation.mask] = 0.55 * picture[observation.mask] + 0.45 * np.array(OBJECT_COLOUR)
    return picture.astype(np.uint8)


def overlay_hand(observation: Observation, hand: Hand, grasp: Grasps, waypoint: int) -> Image:
    """The depth image with the hand of one grasp drawn over it at a waypoint; hidden parts faint."""
    world = grasp.to_frame("world", observation.T_world_camera)
    drawn, depth = render(
        [hand_solid(hand, world.waypoints[0, waypoint])], observation.camera, observation.T_world_camera, table=False
    )
    picture = depth_picture(observation).astype(np.float64)
    seen = np.isfinite(depth)
    behind = seen & (observation.depth > 0) & (depth > observation.depth + 0.005)
    alpha = np.where(behind, 0.25, 0.85)[..., None] * seen[..., None]
    return np.asarray((1 - alpha) * picture + alpha * drawn, np.uint8)


def grasp_picture(observation: Observation, hand: Hand, grasp: Grasps) -> Image:
    """The depth image around the object, with the hand of one grasp at pre-grasp, grip and squeeze."""
    moments = {"pre-grasp": PREGRASP, "grip": GRIP, "squeeze": SQUEEZE}
    world = grasp.to_frame("world", observation.T_world_camera)
    aimed = observation.aimed(460)
    pictures = [overlay_hand(aimed, hand, world, waypoint) for waypoint in moments.values()]
    return grid(pictures, list(moments), columns=3)


def refinement_picture(observation: Observation, hand: Hand, before: Grasps, after: Grasps) -> Image:
    """One grasp before and after refinement at pre-grasp, grip and squeeze; a line shows where the hand was before."""
    moments = {"pre-grasp": PREGRASP, "grip": GRIP, "squeeze": SQUEEZE}
    first, then = (grasp.to_frame("world", observation.T_world_camera) for grasp in (before, after))
    aimed = observation.aimed(460)
    given = [overlay_hand(aimed, hand, first, waypoint) for waypoint in moments.values()]
    refined = []
    for waypoint in moments.values():
        picture = overlay_hand(aimed, hand, then, waypoint).copy()
        shape = hand_solid(hand, first.waypoints[0, waypoint])
        seen = np.isfinite(render([shape], aimed.camera, aimed.T_world_camera, table=False)[1]).astype(np.uint8)
        outline, _ = cv2.findContours(seen, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        refined.append(np.asarray(cv2.drawContours(picture, outline, -1, OUTLINE_COLOUR, 1), np.uint8))
    titles = [f"{name}, {when}" for when in ("as given", "refined; line: as given") for name in moments]
    return grid(given + refined, titles, columns=3)


def grid(pictures: Sequence[Image], titles: Sequence[str], columns: int) -> Image:
    """Pictures of one size, side by side, each with its title above."""
    cells = []
    for picture, title in zip(pictures, titles, strict=True):
        bar = np.full((28, picture.shape[1], 3), 255, np.uint8)
        cv2.putText(bar, title, (6, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (20, 20, 20), 1, cv2.LINE_AA)
        cells.append(np.concatenate((bar, picture)))
    blank = np.full_like(cells[0], 255)
    cells += [blank] * (-len(cells) % columns)
    rows = [np.concatenate(cells[i : i + columns], axis=1) for i in range(0, len(cells), columns)]
    return np.concatenate(rows)


def save(picture: Image, path: Path) -> None:
    """Write an RGB picture as PNG."""
    done, png = cv2.imencode(".png", picture[..., ::-1])
    if not done:
        raise OSError(f"picture {path} could not be encoded as PNG")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(png.tobytes())

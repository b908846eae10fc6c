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

from dexzoo.grasp import GRIP, PREGRASP, SQUEEZE, Grasps
from dexzoo.hand import Hand
from dexzoo.perception.camera import Camera
from dexzoo.perception.observation import Observation
from dexzoo.rotation import pose_matrix

Image = NDArray[np.uint8]
OBJECT_COLOR = (214, 150, 60)
HAND_COLOR = (70, 120, 200)
TABLE_COLOR = (225, 225, 220)
OUTLINE_COLOR = (200, 30, 30)
MOMENTS = {"pre-grasp": PREGRASP, "grip": GRIP, "squeeze": SQUEEZE}
"""Waypoints that a picture of a grasp shows, by their titles."""


@dataclass(frozen=True)
class Solid:
    """A mesh and its color.

    Attributes:
        mesh: Mesh in the world frame.
        color: Red, green, blue; 0...255.
    """

    mesh: trimesh.Trimesh
    color: tuple[int, int, int]


def hand_solid(
    hand: Hand, wrist: torch.Tensor, joints: torch.Tensor, color: tuple[int, int, int] = HAND_COLOR
) -> Solid:
    """The primitives of a hand in one posture.

    Args:
        hand: The hand.
        wrist: Wrist pose, position and quaternion, (7,).
        joints: Joint angles in radians, (joint,).
        color: Red, green, blue; 0...255.

    Returns:
        The solid, in the frame of the wrist pose.
    """
    pose = pose_matrix(wrist[:3], wrist[3:]).detach().double()
    poses = (pose @ hand.shape_poses(hand.forward_kinematics(joints.detach().double()))).numpy()
    meshes = [shape.mesh().apply_transform(T) for shape, T in zip(hand.shapes, poses, strict=True)]
    return Solid(_joined(meshes), color)


def grasp_solid(grasp: Grasps, waypoint: int) -> Solid:
    """The hand of one grasp at a waypoint, in the world frame.

    Args:
        grasp: One grasp.
        waypoint: The waypoint.
    """
    return hand_solid(grasp.hand, grasp.wrist[0, waypoint], grasp.joints[0, waypoint])


def _joined(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    joined = trimesh.util.concatenate(meshes)
    assert isinstance(joined, trimesh.Trimesh)  # what meshes alone make
    return joined


def render(
    solids: Sequence[Solid], camera: Camera, T_world_camera: NDArray[np.float64], table: bool = True
) -> tuple[Image, NDArray[np.float64]]:
    """Draw solids over a table at z = 0.

    Args:
        solids: The solids; at least one.
        camera: The camera.
        T_world_camera: Its pose, (4, 4).
        table: Whether the table is drawn.

    Returns:
        RGB picture (height, width, 3), and depth in meters (height, width), inf if nothing is hit.
    """
    rays = camera.directions()
    length = np.linalg.norm(rays, axis=-1).ravel()
    directions = rays.reshape(-1, 3) @ T_world_camera[:3, :3].T
    origin = T_world_camera[:3, 3]
    color = np.full((len(directions), 3), 255.0)
    depth = np.full(len(directions), np.inf)
    shade = np.ones(len(directions))
    if table:
        with np.errstate(divide="ignore"):
            t = -origin[2] / directions[:, 2]
        hit = (t > 0) & (t < 5)
        point = origin + t[hit, None] * directions[hit]
        squares = (np.floor(point[:, 0] / 0.1) + np.floor(point[:, 1] / 0.1)) % 2
        depth[hit] = t[hit]
        color[hit] = np.array(TABLE_COLOR) - 10 * squares[:, None]
    mesh = _joined([solid.mesh for solid in solids])
    faces = np.concatenate([np.full(len(solid.mesh.faces), i) for i, solid in enumerate(solids)])
    triangle, ray, point = mesh.ray.intersects_id(
        np.broadcast_to(origin, directions.shape), directions, multiple_hits=False, return_locations=True
    )[:3]
    distance = np.linalg.norm(point - origin, axis=1) / length[ray]
    front = distance < depth[ray]
    triangle, ray, distance = triangle[front], ray[front], distance[front]
    depth[ray] = distance
    color[ray] = np.array([solid.color for solid in solids])[faces[triangle]]
    facing = np.abs((mesh.face_normals[triangle] * directions[ray]).sum(1)) / length[ray]
    above = mesh.face_normals[triangle][:, 2]
    shade[ray] = 0.35 + 0.45 * facing + 0.2 * np.clip(above, 0, 1)
    picture = np.clip(color * shade[:, None], 0, 255).astype(np.uint8)
    return picture.reshape(camera.height, camera.width, 3), depth.reshape(camera.height, camera.width)


def depth_picture(observation: Observation) -> Image:
    """The depth image in gray: near is dark, no reading is white; the object is tinted.

    Args:
        observation: The depth image.
    """
    depth = observation.depth
    near, far = np.percentile(depth[depth > 0], [1, 99])
    gray = np.where(depth > 0, 60 + 170 * np.clip((depth - near) / max(far - near, 1e-3), 0, 1), 255)
    picture = np.repeat(gray[..., None], 3, axis=-1)
    picture[observation.mask] = 0.55 * picture[observation.mask] + 0.45 * np.array(OBJECT_COLOR)
    return picture.astype(np.uint8)


def overlay_hand(observation: Observation, grasp: Grasps, waypoint: int) -> Image:
    """Draw the hand of one grasp over the depth image; hidden parts are faint.

    Args:
        observation: The depth image.
        grasp: One grasp in its world frame.
        waypoint: The waypoint at which the hand is drawn.

    Returns:
        The picture.
    """
    drawn, depth = render([grasp_solid(grasp, waypoint)], observation.camera, observation.T_world_camera, table=False)
    picture = depth_picture(observation).astype(np.float64)
    seen = np.isfinite(depth)
    behind = seen & (observation.depth > 0) & (depth > observation.depth + 0.005)
    alpha = np.where(behind, 0.25, 0.85)[..., None] * seen[..., None]
    return np.asarray((1 - alpha) * picture + alpha * drawn, np.uint8)


def grasp_picture(observation: Observation, grasp: Grasps) -> Image:
    """The depth image around the object, with the hand of one grasp at pre-grasp, grip and squeeze.

    Args:
        observation: The depth image.
        grasp: One grasp in its world frame.

    Returns:
        Three pictures side by side.
    """
    aimed = observation.aimed(460)
    return grid([overlay_hand(aimed, grasp, waypoint) for waypoint in MOMENTS.values()], list(MOMENTS), columns=3)


def refinement_picture(observation: Observation, before: Grasps, after: Grasps) -> Image:
    """One grasp before and after refinement at pre-grasp, grip and squeeze; a line shows where the hand was before.

    Args:
        observation: The depth image.
        before: The given grasp in its world frame.
        after: The refined grasp.

    Returns:
        Two rows of three pictures.
    """
    aimed = observation.aimed(460)
    given = [overlay_hand(aimed, before, waypoint) for waypoint in MOMENTS.values()]
    refined = []
    for waypoint in MOMENTS.values():
        picture = overlay_hand(aimed, after, waypoint).copy()
        shape = grasp_solid(before, waypoint)
        seen = np.isfinite(render([shape], aimed.camera, aimed.T_world_camera, table=False)[1]).astype(np.uint8)
        outline, _ = cv2.findContours(seen, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        refined.append(np.asarray(cv2.drawContours(picture, outline, -1, OUTLINE_COLOR, 1), np.uint8))
    titles = [f"{name}, {when}" for when in ("as given", "refined; line: as given") for name in MOMENTS]
    return grid(given + refined, titles, columns=3)


def grid(pictures: Sequence[Image], titles: Sequence[str], columns: int) -> Image:
    """Pictures of one size, side by side, each with its title above.

    Args:
        pictures: The pictures; at least one.
        titles: Their titles.
        columns: Pictures in a row.
    """
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
    """Write an RGB picture as PNG.

    Args:
        picture: The picture.
        path: File to write.

    Raises:
        OSError: The picture cannot be encoded or written.
    """
    done, png = cv2.imencode(".png", picture[..., ::-1])
    if not done:
        raise OSError(f"picture {path} could not be encoded as PNG")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(png.tobytes())

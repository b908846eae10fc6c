"""The geometry that an evaluator's image holds: table, surface, normals and a cloud, batched over views.

All in the frame of the aimed camera, whose intrinsics are fixed (`Camera.aimed`) and whose x axis is level.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from dexzoo.perception.camera import Camera

MAP_SIZE = 112
"""Pixels of the maps in each direction: half the image's, which averages the sensor's noise."""
SMOOTHING = 5
"""Pixels of the window that normals are taken from; 18 mm at half a meter."""
MAX_DEPTH = 2.0
_RIDGE = 1e-12


class ViewGeometry(NamedTuple):
    """Geometry of the surface in each view; meters.

    Attributes:
        depth: Depth of the first surface along each pixel's ray: the object's, else the table's, (view, 112, 112).
        mask: Share of the pixel that the object covers, (view, 112, 112).
        normals: Unit normals, towards the camera, (view, 3, 112, 112).
        table: Plane of the table, normal . p + offset = height, (view, 4).
        center: Mean of the object's points, (view, 3).
    """

    depth: Tensor
    mask: Tensor
    normals: Tensor
    table: Tensor
    center: Tensor

    @property
    def points(self) -> Float[Tensor, "view 112 112 3"]:
        """The points that the pixels of `depth` show."""
        return _rays(MAP_SIZE).to(self.depth) * self.depth[..., None]

    @property
    def center_and_height(self) -> Float[Tensor, "view 4"]:
        """The object's center, and its height over the table."""
        height = (self.center * self.table[:, :3]).sum(1, keepdim=True) + self.table[:, 3:]
        return torch.cat((self.center, height), 1)


def view_geometry(images: Float[Tensor, "view 2 224 224"]) -> ViewGeometry:
    """Geometry of images as evaluators get them.

    Args:
        images: The object's depth and its height over the table in meters, 0 elsewhere.
    """
    table = table_plane(images)
    seen = F.avg_pool2d((images[:, :1] > 0).to(images), 2)
    depth = F.avg_pool2d(images[:, :1], 2) / seen.clamp_min(0.25)
    rays = _rays(MAP_SIZE).to(images)
    points = rays.movedim(-1, 0) * depth
    weight = seen.sum((2, 3)).clamp_min(1)
    center = (points * seen).sum((2, 3)) / weight
    slope = torch.einsum("hwi,vi->vhw", rays, table[:, :3])
    fall = torch.maximum(-slope, table[:, 3, None, None] / MAX_DEPTH)
    ground = table[:, 3, None, None] / fall
    mask = seen[:, 0]
    normals = torch.where(seen > 0, _normals(points, seen, rays), table[:, :3, None, None])
    return ViewGeometry(torch.where(mask > 0, depth[:, 0], ground), mask, normals, table, center)


def table_plane(images: Float[Tensor, "view 2 224 224"]) -> Float[Tensor, "view 4"]:
    """The plane that the heights were taken over: unit normal and offset, such that normal . p + offset = height.

    Least squares over the object's pixels. The aimed camera stands upright, so the normal has no x component; points
    in one plane leave the rest open by a line, on which a faint pull to a camera 45 degrees high decides.

    Args:
        images: As in `view_geometry`.
    """
    depth, height = images.flatten(2).double().unbind(1)
    rays = _rays(images.shape[-1]).to(depth).flatten(0, 1)
    seen = (depth > 0).to(depth)
    rows = torch.stack((seen, rays[:, 1] * depth, rays[:, 2] * depth, height * seen), 1)
    sums = rows @ rows.mT  # of y, z and height, and of their products, over the object's pixels
    count = sums[:, 0, 0].clamp_min(1)
    mean = sums[:, 0, 1:] / count[:, None]
    spread = sums[:, 1:, 1:] / count[:, None, None] - mean[:, :, None] * mean[:, None]
    pull = depth.new_full((2,), -(0.5**0.5))
    normal_matrix = spread[:, :2, :2] + _RIDGE * torch.eye(2).to(depth)
    moment = spread[:, :2, 2] + _RIDGE * pull
    normal = torch.linalg.solve(normal_matrix, moment)
    normal = normal / normal.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    offset = mean[:, 2] - (normal * mean[:, :2]).sum(1)
    return torch.stack((torch.zeros_like(offset), normal[:, 0], normal[:, 1], offset), -1).to(images)


def upright_axes(table: Float[Tensor, "view 4"]) -> Float[Tensor, "view 3 3"]:
    """Rotations from the camera's frame to one with z up, x along the camera's and y level and away from it.

    Args:
        table: Planes of the table, as of `table_plane`.
    """
    up = table[:, :3]
    right = torch.eye(3)[0].to(table).expand_as(up)
    return torch.stack((right, torch.cross(up, right, dim=-1), up), dim=1)


def cloud(geometry: ViewGeometry, count: int) -> Float[Tensor, "view {count} 6"]:
    """Points of the object, spread over the image, with their normals.

    Every so-many-th of the object's pixels along a curve that fills the plane (Morton 1966) is taken, which needs no
    search and is as even as the pixels are; small objects repeat some.

    Args:
        geometry: Geometry of the views.
        count: Number of points.
    """
    order = _morton(MAP_SIZE).to(geometry.mask.device)
    rank = (geometry.mask.flatten(1)[:, order] > 0).long().cumsum(1)
    total = rank[:, -1:].clamp_min(1)
    wanted = torch.arange(count, device=rank.device) * total // count + 1
    pixel = order[torch.searchsorted(rank, wanted).clamp_max(len(order) - 1)]
    both = torch.cat((geometry.points.movedim(-1, 1), geometry.normals), 1).flatten(2)
    return both.take_along_dim(pixel[:, None], dim=2).mT


def _normals(points: Tensor, seen: Tensor, rays: Tensor) -> Tensor:
    """(view, 3, height, width) from central differences of the object's points, smoothed within the object."""
    weight = _smooth(seen)
    smooth = _smooth(points * seen) / weight.clamp_min(1e-6)
    smooth = F.pad(torch.where(weight > 0, smooth, points), (1, 1, 1, 1), mode="replicate")
    known = F.pad(weight > 0, (1, 1, 1, 1))
    middle = smooth[..., 1:-1, 1:-1]

    def step(ahead: tuple[slice, slice], behind: tuple[slice, slice]) -> Tensor:
        after = torch.where(known[..., *ahead], smooth[..., *ahead], middle)
        before = torch.where(known[..., *behind], smooth[..., *behind], middle)
        return after - before

    inside = slice(1, -1)
    across = step((inside, slice(2, None)), (inside, slice(None, -2)))
    down = step((slice(2, None), inside), (slice(None, -2), inside))
    normal = torch.cross(across, down, dim=1)
    length = normal.square().sum(1, keepdim=True).sqrt()  # several times faster than norm, over three numbers
    toward = F.normalize(-rays, dim=-1).movedim(-1, 0).contiguous()  # where one pixel stands alone it faces the camera
    normal = torch.where(length > 1e-10, normal / length.clamp_min(1e-10), toward)
    return torch.where((normal * toward).sum(1, keepdim=True) < 0, -normal, normal)


def _smooth(maps: Tensor) -> Tensor:
    """Means over a square window, zero beyond the image."""
    pad = SMOOTHING // 2
    return F.avg_pool2d(F.avg_pool2d(maps, (SMOOTHING, 1), 1, (pad, 0)), (1, SMOOTHING), 1, (0, pad))


@lru_cache(maxsize=4)
def _rays(size: int) -> Tensor:
    return torch.tensor(Camera.aimed(size).directions())


@lru_cache(maxsize=2)
def _morton(size: int) -> Tensor:
    """Pixel indices of a square image in the order of a Z-shaped curve."""
    index = torch.arange(size)
    spread = sum(((index >> bit) & 1) << (2 * bit) for bit in range(size.bit_length()))
    assert isinstance(spread, Tensor)
    return (2 * spread[:, None] + spread).flatten().argsort()

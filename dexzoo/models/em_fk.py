"""EM-FK: the hand's own geometry enters. Points of all links, placed by forward kinematics, look at the view."""

from __future__ import annotations

import itertools
from typing import ClassVar, Unpack

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from dexzoo import rotation
from dexzoo.grasp import GRIP, PREGRASP, SQUEEZE, Trajectory
from dexzoo.hand.surface_points import surface_points
from dexzoo.models.batch import Encoding
from dexzoo.models.evaluator import EvaluatorOptions, GraspEvaluator
from dexzoo.models.view_geometry import cloud, upright_axes, view_geometry
from dexzoo.perception.camera import Camera

STAGES = [PREGRASP, GRIP // 2, GRIP, SQUEEZE]
"""The waypoints at which the hand is placed."""
NUM_POINTS = 6
"""Points on each primitive of the hand."""
NUM_CLOUD = 192
NEAR, FAR = 0.01, 0.05
"""Scales in meters of the squashed features: contact and approach."""
MIN_DEPTH = 0.05
"""Points nearer to the camera's plane than this, or behind it, are projected as if they were there."""
FEATURES = {"hand": 9, "table": 2, "depth": 5, "cloud": 5, "image": 32}
"""Numbers of each ingredient for a point."""
_PART = 1024
"""Points that are looked up together, so that the distances stay in cache."""


class EMFK(GraspEvaluator):
    """Ours: points of the hand, placed by forward kinematics, look at the observed surface around them.

    Six points on the grasping side of each of the hand's primitives are placed by forward kinematics at the pre-grasp,
    half way, at the grip and at the squeeze, which reaches into the object by as much as it will press. The
    features of a point are its place; its height over the table; its distance to the observed surface along its ray and
    along the surface's normal; the nearest point of the object; and the features of a small convolutional pyramid,
    encoded once for each view, at its projection. A primitive's points at all stages make its token; attention
    among tokens, and from one query to all, makes one logit. All of it is differentiable in the grasp.

    Args:
        width: Width of the tokens.
        num_blocks: Rounds of attention.
        dropout: Probability of dropping a unit.
        image: Whether the convolutional pyramid is used.
        depth: Whether the distance to the observed surface is used.
        cloud: Whether the nearest point of the object is used.
        table: Whether the height over the table is used.
        motion: Whether the hand is looked at at all four waypoints, or at the grip alone.
        attention: Whether tokens attend to each other and are pooled by attention; otherwise their mean is taken.
        options: Arguments of `GraspEvaluator`.
    """

    architecture: ClassVar[str] = "em_fk"
    points: Tensor
    """(2, shape, point, 3): points and normals in the frame of their primitive, float64."""

    def __init__(
        self,
        width: int = 128,
        num_blocks: int = 3,
        dropout: float = 0.1,
        image: bool = True,
        depth: bool = True,
        cloud: bool = True,
        table: bool = True,
        motion: bool = True,
        attention: bool = True,
        **options: Unpack[EvaluatorOptions],
    ) -> None:
        super().__init__(**options)
        self.width, self.num_blocks, self.dropout = width, num_blocks, dropout
        self.image, self.depth, self.cloud, self.table = image, depth, cloud, table
        self.motion, self.attention = motion, attention
        self.stages = STAGES if motion else [GRIP]
        self.register_buffer("points", torch.stack(surface_points(self.known_hands[0], NUM_POINTS)), persistent=False)
        shapes, stages = self.points.shape[1], len(self.stages)
        if image:
            self.pyramid = Pyramid(FEATURES["image"])
            self.context = nn.Linear(self.pyramid.context_size, width)
        asked = {"hand": True, "table": table, "depth": depth, "cloud": cloud, "image": image}
        size = sum(FEATURES[name] for name, used in asked.items() if used)
        self.place = nn.Parameter(0.02 * torch.randn(stages, shapes, NUM_POINTS, 64))
        self.point_in = nn.Linear(size, 64)
        self.point_out = nn.Linear(64, 32)
        self.token = nn.Linear(stages * NUM_POINTS * 32, width)
        self.shape_embedding = nn.Parameter(0.02 * torch.randn(shapes, width))
        self.blocks = nn.ModuleList(Block(width, dropout, attention) for _ in range(num_blocks))
        self.norm = nn.LayerNorm(width)
        self.query = nn.Linear(width, 1) if attention else None
        self.head = nn.Sequential(nn.Linear(width, width), nn.GELU(), nn.Dropout(dropout), nn.Linear(width, 1))

    def encode(self, images: Float[Tensor, "view 2 224 224"]) -> Encoding:
        """Maps, cloud, the upright frame that they are expressed in, and the pyramid's features.

        The upright frame has its origin in the object's center, z up and x along the camera's. "maps": depth of the
        surface, the object's share and normals (view, 5, 112, 112). "cloud": points and normals (view, 192, 6).
        "axes": rotation from the camera's frame. "center": the origin in it, and its height over the table (view, 4).

        Args:
            images: Depth and height over the table in meters, 0 where the object is not; see `GraspEvaluator.encode`.
        """
        with torch.autocast(images.device.type, enabled=False), torch.no_grad():
            geometry = view_geometry(images.float())
            axes = upright_axes(geometry.table)
            points, normals = cloud(geometry, NUM_CLOUD).split(3, -1)
            height = (geometry.points @ geometry.table[:, None, :3, None])[..., 0] + geometry.table[:, 3, None, None]
            turned = torch.einsum("vij,vjhw->vihw", axes, geometry.normals)
            maps = torch.cat((geometry.depth[:, None], geometry.mask[:, None], turned), 1)
            encoding = {
                "maps": maps,
                "cloud": torch.cat(((points - geometry.center[:, None]) @ axes.mT, normals @ axes.mT), -1),
                "axes": axes,
                "center": geometry.center_and_height,
            }
            relative = ((maps[:, :1] - geometry.center[:, 2, None, None, None]) / 0.1).clamp(-3, 3)
            seen = torch.cat((relative, maps[:, 1:], height[:, None] / 0.1), 1)
        if self.image:
            encoding["features"], context = self.pyramid(seen)
            encoding["context"] = self.context(context)
        return encoding

    def logit(self, encoding: Encoding, grasps: Trajectory) -> Float[Tensor, "view grasp"]:
        """Log-odds of success.

        Args:
            encoding: Result of `encode`.
            grasps: Trajectories (view, grasp), in the frame of each view's aimed camera.
        """
        with torch.autocast(grasps.wrist.device.type, enabled=False):  # a millimeter is beyond bfloat16
            features = self.look({name: value.to(grasps.wrist) for name, value in encoding.items()}, grasps)
        point = F.gelu(self.point_out(F.gelu(self.point_in(features) + self.place)))
        x = self.token(point.transpose(2, 3).flatten(3)) + self.shape_embedding
        if self.image:
            context = encoding["context"].to(x)[:, None, None].expand(-1, x.shape[1], -1, -1)
            x = torch.cat((x, context), dim=2)
        views, count = x.shape[:2]
        x = x.flatten(0, 1)
        for block in self.blocks:
            x = block(x)
        x = self.norm(x)
        pooled = x.mean(1) if self.query is None else (self.query(x).softmax(1) * x).sum(1)
        log_odds: Tensor = self.head(pooled).view(views, count)
        return log_odds

    def look(self, encoding: Encoding, grasps: Trajectory) -> Float[Tensor, "view grasp stage shape point feature"]:
        """Features of the points on the hand, squashed to the order of one.

        Args:
            encoding: Result of `encode`, in the precision of the grasps.
            grasps: As in `logit`.

        Returns:
            Features, at the stages of the motion at which the hand is placed.
        """
        hand, placed = self.known_hands[0], grasps.waypoint(self.stages)
        in_palm = hand.shape_poses(hand.forward_kinematics(placed.joints))
        points, normals = torch.einsum("vgwsij,asnj->avgwsni", in_palm[..., :3, :3], self.points.to(placed.wrist))
        points = points + in_palm[..., None, :3, 3]
        # into the upright frame, see `encode`; there height over the table is z, but for that of the origin
        axes, center = encoding["axes"][:, None, None], encoding["center"][:, None, None]
        origin = (axes @ (placed.position - center[..., :3])[..., None]).mT
        turn = (axes @ rotation.to_matrix(rotation.normalize(placed.quaternion))).mT
        p = (points.flatten(3, 4) @ turn + origin).flatten(1, -2)  # (view, grasp * stage * shape * point, 3)
        n = (normals.flatten(3, 4) @ turn).flatten(1, -2)
        features = [p / 0.1, n, points.flatten(1, -2) / 0.1]
        if self.table:
            height = p[..., 2:] + encoding["center"][:, None, 3:]
            features.append(torch.cat((torch.tanh(height / NEAR), torch.tanh(height / 0.2)), -1))
        if self.depth or self.image:
            in_camera = p @ encoding["axes"] + encoding["center"][:, None, :3]
            pixel = project(in_camera)
        if self.depth:
            ray = (in_camera / in_camera[..., 2:].clamp_min(MIN_DEPTH)) @ encoding["axes"].mT
            features.append(before_surface(in_camera[..., 2:], ray, n, sample(encoding["maps"], pixel)))
        if self.cloud:
            features.append(nearest(p, n, encoding["cloud"]))
        if self.image:
            features.append(sample(encoding["features"], pixel))
        every: Tensor = torch.cat(features, -1).unflatten(1, points.shape[1:-1])
        return every


class Pyramid(nn.Module):
    """A small convolutional pyramid over the maps of a view, with one fine output (Lin et al. 2017).

    Args:
        channels: Channels of the output.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        sizes = [6, 32, 64, 96]
        self.context_size = sizes[-1]
        self.down = nn.ModuleList(
            nn.Sequential(*_convolution(a, b, 2), *_convolution(b, b, 1)) for a, b in itertools.pairwise(sizes)
        )
        self.lateral = nn.ModuleList(nn.Conv2d(size, channels, 1) for size in sizes[1:])
        self.out = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(
        self, x: Float[Tensor, "view 6 112 112"]
    ) -> tuple[Float[Tensor, "view channel 56 56"], Float[Tensor, "view context"]]:
        """Features at every second pixel, and the mean of the coarsest.

        Args:
            x: Maps of the views.
        """
        levels = []
        for stage in self.down:
            x = stage(x)
            levels.append(x)
        y = self.lateral[-1](levels[-1])
        for lateral, level in zip(self.lateral[-2::-1], levels[-2::-1], strict=True):
            y = lateral(level) + F.interpolate(y, scale_factor=2.0)
        return self.out(y).float(), x.mean((2, 3))


class Block(nn.Module):
    """A pre-norm transformer block (Xiong et al. 2020).

    Args:
        width: Width of the tokens.
        dropout: Probability of dropping a unit.
        attention: Whether tokens attend to each other.
    """

    def __init__(self, width: int, dropout: float, attention: bool) -> None:
        super().__init__()
        self.attend = nn.MultiheadAttention(width, 4, dropout, batch_first=True) if attention else None
        self.norms = nn.ModuleList((nn.LayerNorm(width) if attention else nn.Identity(), nn.LayerNorm(width)))
        self.mlp = nn.Sequential(
            nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width), nn.Dropout(dropout)
        )

    def forward(self, x: Float[Tensor, "batch token width"]) -> Float[Tensor, "batch token width"]:
        """Tokens after one round.

        Args:
            x: Tokens before it.
        """
        if self.attend is not None:
            y = self.norms[0](x)
            x = x + self.attend(y, y, y, need_weights=False)[0]
        out: Tensor = x + self.mlp(self.norms[1](x))
        return out


def _convolution(before: int, after: int, stride: int) -> list[nn.Module]:
    return [nn.Conv2d(before, after, 3, stride, 1, bias=False), nn.GroupNorm(8, after), nn.ReLU()]


def project(p: Float[Tensor, "view point 3"]) -> Float[Tensor, "view point 2"]:
    """Places in the image, -1 to 1 over the pixels' outer borders.

    Args:
        p: Points in the frame of the aimed camera, meters.
    """
    camera = Camera.aimed()
    z = p[..., 2:].clamp_min(MIN_DEPTH)
    return p[..., :2] / z * (2 * camera.fx / camera.width)  # the principal point is the image's middle


def sample(maps: Float[Tensor, "view channel row column"], pixel: Float[Tensor, "view point 2"]) -> Tensor:
    """(view, point, channel) bilinear values; outside the image those at its border.

    Args:
        maps: Maps of the views.
        pixel: Places, as of `project`.
    """
    values = F.grid_sample(maps, pixel[:, None], padding_mode="border", align_corners=False)
    return values[:, :, 0].mT


def before_surface(z: Tensor, ray: Tensor, n: Tensor, seen: Tensor) -> Tensor:
    """Gap to the surface along the ray, at two scales, and along its normal; object or table; how normals meet.

    Args:
        z: Depth of the points in meters, (view, point, 1).
        ray: Directions to them, of depth 1, (view, point, 3).
        n: Outward normals of the hand at them, (view, point, 3).
        seen: Values of the maps at their pixels, (view, point, 5).
    """
    depth, mask, normal = seen[..., :1], seen[..., 1:2], seen[..., 2:]
    gap = depth - z
    along = -gap * (ray * normal).sum(-1, keepdim=True)
    meet = (n * normal).sum(-1, keepdim=True)
    return torch.cat((torch.tanh(gap / NEAR), torch.tanh(gap / FAR), torch.tanh(along / NEAR), mask, meet), -1)


def nearest(p: Tensor, n: Tensor, seen: Float[Tensor, "view cloud 6"]) -> Tensor:
    """Distance to the nearest observed point at two scales, whether it is faced, its surface's side and normal.

    Args:
        p: Points on the hand in the upright frame, meters, (view, point, 3).
        n: Their outward normals.
        seen: Observed points and their normals.
    """
    rows = torch.stack([nearest_rows(a, b) for a, b in zip(p, seen[..., :3], strict=True)])
    found = seen.take_along_dim(rows[..., None], dim=1)
    offset, normal = found[..., :3] - p, found[..., 3:]
    distance = (offset.square().sum(-1, keepdim=True) + 1e-8).sqrt()  # smooth where they meet, within 0.1 mm
    facing = (offset * n).sum(-1, keepdim=True) / distance
    side = -(offset * normal).sum(-1, keepdim=True)
    meet = (n * normal).sum(-1, keepdim=True)
    return torch.cat(
        (torch.tanh(distance / NEAR), torch.tanh(distance / FAR), facing, torch.tanh(side / NEAR), meet), -1
    )


@torch.no_grad()
def nearest_rows(p: Float[Tensor, "point 3"], cloud: Float[Tensor, "cloud 3"]) -> Tensor:
    """(point,) rows of the nearest in a cloud that lies about the origin, part by part.

    Args:
        p: Points, meters.
        cloud: The cloud, meters.
    """
    half = -0.5 * cloud.square().sum(1)
    return torch.cat([_argmax(torch.addmm(half, part, cloud.mT)) for part in p.split(_PART)])


def _argmax(values: Float[Tensor, "row column"]) -> Tensor:
    """(row,) places of the greatest; on a processor by NumPy, which is eight times as fast at it as torch."""
    if values.device.type != "cpu":
        return values.argmax(1)
    return torch.from_numpy(values.numpy().argmax(1))

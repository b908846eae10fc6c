"""EM-FK: the hand's own geometry enters. Points of all links, placed by forward kinematics, look at the view."""

from __future__ import annotations

import itertools
from typing import ClassVar, Unpack

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from dexzoo import rotation
from dexzoo.camera import Camera
from dexzoo.grasp import GRIP, JOINTS, POSITION, PREGRASP, QUATERNION, SQUEEZE
from dexzoo.hand import default_hand
from dexzoo.models.evaluator import GraspEvaluator, Scene, TrainingOptions
from dexzoo.models.hand_points import surface_points
from dexzoo.models.view_geometry import cloud, upright_axes, view_geometry

STAGES = [PREGRASP, GRIP // 2, GRIP, SQUEEZE]
"""The waypoints at which the hand is placed."""
NUM_POINTS = 6
"""Points on each primitive of the hand."""
NUM_CLOUD = 192
NEAR, FAR = 0.01, 0.05
"""Metres over which lengths are told apart: the scales of the squashed features, contact and approach."""
MIN_DEPTH = 0.05
"""Points nearer to the camera's plane than this, or behind it, are projected as if they were there."""
FEATURES = {"hand": 9, "table": 2, "depth": 5, "cloud": 5, "image": 32}
"""Numbers that each ingredient tells of a point."""
_PART = 1024
"""Points whose nearest are looked for at once, so that the distances stay in cache."""


class EMFK(GraspEvaluator):
    """Ours: what each link touches, computed by forward kinematics, and what the image shows there.

    Six points on the grasping side of each of the hand's primitives are placed by forward kinematics at the pre-grasp,
    half way, at the grip and at the squeeze, which reaches into the object by as much as it will press. Each point
    tells where it is; its height over the table; how far before or behind the observed surface it is along its ray
    and along the surface's normal; where the nearest point of the object is; and what a small convolutional pyramid,
    encoded once for each view, shows at its projection. A primitive's points at all stages make its token; attention
    among tokens, and from one query to all, makes one logit. All of it is differentiable in the grasp.

    image, depth, cloud, table: whether these ingredients enter. way: whether the hand is looked at at all four
    waypoints, or at the grip alone. attention: whether tokens attend to each other and are pooled by attention, or each
    goes alone and the mean is taken.
    width: of the tokens. num_blocks: rounds of attention. dropout: probability of dropping a unit.
    The other arguments are `GraspEvaluator`'s.
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
        way: bool = True,
        attention: bool = True,
        **training: Unpack[TrainingOptions],
    ) -> None:
        super().__init__(**training)
        self.width, self.num_blocks, self.dropout = width, num_blocks, dropout
        self.image, self.depth, self.cloud, self.table = image, depth, cloud, table
        self.way, self.attention = way, attention
        self.stages = STAGES if way else [GRIP]
        self.register_buffer("points", torch.stack(surface_points(default_hand(), NUM_POINTS)), persistent=False)
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

    def encode(self, images: Float[Tensor, "view 2 224 224"]) -> Scene:
        """Maps, cloud, where the upright frame is that they are told in, and the pyramid's features.

        The upright frame has its origin in the object's centre, z up and x along the camera's. "maps": depth of the
        surface, the object's share and normals (view, 5, 112, 112). "cloud": points and normals (view, 192, 6).
        "axes": rotation from the camera's frame. "centre": the origin in it, and its height over the table (view, 4).
        """
        with torch.autocast(images.device.type, enabled=False), torch.no_grad():
            geometry = view_geometry(images.float())
            axes = upright_axes(geometry.table)
            points, normals = cloud(geometry, NUM_CLOUD).split(3, -1)
            height = (geometry.points @ geometry.table[:, None, :3, None])[..., 0] + geometry.table[:, 3, None, None]
            turned = torch.einsum("vij,vjhw->vihw", axes, geometry.normals)
            maps = torch.cat((geometry.depth[:, None], geometry.mask[:, None], turned), 1)
            scene = {
                "maps": maps,
                "cloud": torch.cat(((points - geometry.centre[:, None]) @ axes.mT, normals @ axes.mT), -1),
                "axes": axes,
                "centre": geometry.centre_and_height,
            }
            relative = ((maps[:, :1] - geometry.centre[:, 2, None, None, None]) / 0.1).clamp(-3, 3)
            seen = torch.cat((relative, maps[:, 1:], height[:, None] / 0.1), 1)
        if self.image:
            scene["features"], context = self.pyramid(seen)
            scene["context"] = self.context(context)
        return scene

    def logit(self, scene: Scene, grasps: Float[Tensor, "view grasp 10 28"]) -> Float[Tensor, "view grasp"]:
        """Log-odds of success."""
        with torch.autocast(grasps.device.type, enabled=False):  # a millimetre is beyond bfloat16
            told = self.look({name: value.to(grasps) for name, value in scene.items()}, grasps)
        point = F.gelu(self.point_out(F.gelu(self.point_in(told) + self.place)))
        x = self.token(point.transpose(2, 3).flatten(3)) + self.shape_embedding
        if self.image:
            context = scene["context"].to(x)[:, None, None].expand(-1, x.shape[1], -1, -1)
            x = torch.cat((x, context), dim=2)
        views, count = x.shape[:2]
        x = x.flatten(0, 1)
        for block in self.blocks:
            x = block(x)
        x = self.norm(x)
        pooled = x.mean(1) if self.query is None else (self.query(x).softmax(1) * x).sum(1)
        log_odds: Tensor = self.head(pooled).view(views, count)
        return log_odds

    def look(
        self, scene: Scene, grasps: Float[Tensor, "view grasp 10 28"]
    ) -> Float[Tensor, "view grasp stage shape point feature"]:
        """What each point tells, squashed to the order of one."""
        hand = default_hand()
        way = grasps[:, :, self.stages]
        in_palm = hand.shape_poses(hand.forward_kinematics(way[..., JOINTS]))
        points, normals = torch.einsum("vgwsij,asnj->avgwsni", in_palm[..., :3, :3], self.points.to(grasps))
        points = points + in_palm[..., None, :3, 3]
        # into the upright frame, see `encode`; there height over the table is z, but for that of the origin
        axes, centre = scene["axes"][:, None, None], scene["centre"][:, None, None]
        origin = (axes @ (way[..., POSITION] - centre[..., :3])[..., None]).mT
        turn = (axes @ rotation.to_matrix(rotation.normalize(way[..., QUATERNION]))).mT
        p = (points.flatten(3, 4) @ turn + origin).flatten(1, -2)  # (view, grasp * stage * shape * point, 3)
        n = (normals.flatten(3, 4) @ turn).flatten(1, -2)
        told = [p / 0.1, n, points.flatten(1, -2) / 0.1]
        if self.table:
            height = p[..., 2:] + scene["centre"][:, None, 3:]
            told.append(torch.cat((torch.tanh(height / NEAR), torch.tanh(height / 0.2)), -1))
        if self.depth or self.image:
            in_camera = p @ scene["axes"] + scene["centre"][:, None, :3]
            pixel = project(in_camera)
        if self.depth:
            ray = (in_camera / in_camera[..., 2:].clamp_min(MIN_DEPTH)) @ scene["axes"].mT
            told.append(before_surface(in_camera[..., 2:], ray, n, sample(scene["maps"], pixel)))
        if self.cloud:
            told.append(nearest(p, n, scene["cloud"]))
        if self.image:
            told.append(sample(scene["features"], pixel))
        features: Tensor = torch.cat(told, -1).unflatten(1, points.shape[1:-1])
        return features


class Pyramid(nn.Module):
    """A small convolutional pyramid over the maps of a view, with one fine output (Lin et al. 2017)."""

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
        """Features at every second pixel, and the mean of the coarsest."""
        levels = []
        for stage in self.down:
            x = stage(x)
            levels.append(x)
        y = self.lateral[-1](levels[-1])
        for lateral, level in zip(self.lateral[-2::-1], levels[-2::-1], strict=True):
            y = lateral(level) + F.interpolate(y, scale_factor=2.0)
        return self.out(y).float(), x.mean((2, 3))


class Block(nn.Module):
    """A pre-norm transformer block; without attention each token goes alone (Xiong et al. 2020)."""

    def __init__(self, width: int, dropout: float, attention: bool) -> None:
        super().__init__()
        self.attend = nn.MultiheadAttention(width, 4, dropout, batch_first=True) if attention else None
        self.norms = nn.ModuleList((nn.LayerNorm(width) if attention else nn.Identity(), nn.LayerNorm(width)))
        self.mlp = nn.Sequential(
            nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width), nn.Dropout(dropout)
        )

    def forward(self, x: Float[Tensor, "batch token width"]) -> Float[Tensor, "batch token width"]:
        """Tokens after one round."""
        if self.attend is not None:
            y = self.norms[0](x)
            x = x + self.attend(y, y, y, need_weights=False)[0]
        out: Tensor = x + self.mlp(self.norms[1](x))
        return out


def _convolution(before: int, after: int, stride: int) -> list[nn.Module]:
    return [nn.Conv2d(before, after, 3, stride, 1, bias=False), nn.GroupNorm(8, after), nn.ReLU()]


def project(p: Float[Tensor, "view point 3"]) -> Float[Tensor, "view point 2"]:
    """Places in the image, -1 to 1 over the pixels' outer borders."""
    camera = Camera.aimed()
    z = p[..., 2:].clamp_min(MIN_DEPTH)
    return p[..., :2] / z * (2 * camera.fx / camera.width)  # the principal point is the image's middle


def sample(maps: Float[Tensor, "view channel row column"], pixel: Float[Tensor, "view point 2"]) -> Tensor:
    """(view, point, channel) bilinear values; outside the image those at its border."""
    values = F.grid_sample(maps, pixel[:, None], padding_mode="border", align_corners=False)
    return values[:, :, 0].mT


def before_surface(z: Tensor, ray: Tensor, n: Tensor, seen: Tensor) -> Tensor:
    """Gap to the surface along the ray, at two scales, and along its normal; object or table; how normals meet.

    z: (view, point, 1) depth of the points; ray: (view, point, 3) directions to them, of depth 1.
    """
    depth, mask, normal = seen[..., :1], seen[..., 1:2], seen[..., 2:]
    gap = depth - z
    along = -gap * (ray * normal).sum(-1, keepdim=True)
    meet = (n * normal).sum(-1, keepdim=True)
    return torch.cat((torch.tanh(gap / NEAR), torch.tanh(gap / FAR), torch.tanh(along / NEAR), mask, meet), -1)


def nearest(p: Tensor, n: Tensor, seen: Float[Tensor, "view cloud 6"]) -> Tensor:
    """Distance to the nearest observed point at two scales, whether it is faced, its surface's side and normal."""
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
    """(point,) rows of the nearest in a cloud that lies about the origin, part by part."""
    half = -0.5 * cloud.square().sum(1)
    return torch.cat([_argmax(torch.addmm(half, part, cloud.mT)) for part in p.split(_PART)])


def _argmax(values: Float[Tensor, "row column"]) -> Tensor:
    """(row,) places of the greatest; on a processor by NumPy, which is eight times as fast at it as torch."""
    if values.device.type != "cpu":
        return values.argmax(1)
    return torch.from_numpy(values.numpy().argmax(1))

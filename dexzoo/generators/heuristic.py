"""Heuristic grasps: the thumb opposite the fingers across a graspable width of the observed cloud.

This is the baseline of hand-made grasp procedures, not a learned model. The object's hidden side is guessed by turning
the cloud half round about the vertical axis through its middle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from dexzoo import rotation
from dexzoo.generators.generator import MAX_REACH, MIN_CLEARANCE, GraspGenerator, spread
from dexzoo.grasp import GRASP_TYPES, Grasps, Trajectory
from dexzoo.hand import Hand
from dexzoo.perception import Observation, View
from dexzoo.perception.hidden_side import guess_hidden_side
from dexzoo.perception.table import MIN_POINTS
from dexzoo.rotation import pose_matrix

MAX_WIDTH = 0.085
"""Widest thing in meters that fits between open thumb and fingers."""
MAX_PENETRATION = 0.002
STANDOFF = 0.09
SQUEEZE_TRAVEL = 0.35
"""Radians that mcp and pip go on from the grip to the squeeze."""
_LEVELS = 12
_CHUNK = 128


@dataclass(frozen=True)
class GraspTemplate:
    """How the hand opens and closes for one type of grasp. Angles are radians of (abd, mcp, pip).

    Attributes:
        grasp_type: Index into `GRASP_TYPES`.
        open: Angles of the open fingers.
        closed: Angles of the closed fingers.
        fingers: Fingers that take part.
        reach: Bounds in meters from the wrist to the object's middle along the fingers.
        aside: Bounds in meters towards the thumb's side.
    """

    grasp_type: int
    open: tuple[float, float, float]
    closed: tuple[float, float, float]
    fingers: tuple[str, ...]
    reach: tuple[float, float]
    aside: tuple[float, float]


_TEMPLATES = (
    GraspTemplate(
        GRASP_TYPES.index("power"),
        (0.0, 0.0, 0.15),
        (0.0, 1.4, 1.1),
        ("index", "middle", "ring", "little"),
        (0.11, 0.17),
        (-0.02, 0.03),
    ),
    GraspTemplate(
        GRASP_TYPES.index("top"),
        (0.0, 0.0, 0.3),
        (0.0, 1.2, 0.8),
        ("index", "middle", "ring", "little"),
        (0.15, 0.20),
        (-0.02, 0.03),
    ),
    GraspTemplate(
        GRASP_TYPES.index("tripod"),
        (0.0, 0.1, 0.35),
        (0.0, 1.2, 0.7),
        ("index", "middle"),
        (0.165, 0.205),
        (0.0, 0.045),
    ),
    GraspTemplate(
        GRASP_TYPES.index("pinch"), (0.0, 0.1, 0.35), (0.0, 1.2, 0.7), ("index",), (0.17, 0.205), (0.02, 0.055)
    ),
)
_RESTING = (0.0, 0.1, 0.2)  # of fingers that take no part


class HeuristicGenerator(GraspGenerator):
    """Grasps across graspable widths with power, top, tripod and pinch preshapes.

    Args:
        hand: The hand; its joints and links are named by finger as those of dlr2.
        num_samples: Candidates drawn before those that collide are dropped.
    """

    def __init__(self, hand: Hand, num_samples: int = 3000) -> None:
        self.num_samples = num_samples
        self.hand = hand

    def generate(self, observation: Observation | View, num_grasps: int = 100, seed: int = 0) -> Grasps:
        """Propose grasps, those with the best opposition first.

        Args:
            observation: The view of the object.
            num_grasps: Most grasps to propose.
            seed: The same seed gives the same grasps.

        Returns:
            Grasps in the world frame of the observation.

        Raises:
            ValueError: Too little of the object is seen.
            RuntimeError: No feasible grasp is found.
        """
        if num_grasps < 1:
            raise ValueError(f"num_grasps is {num_grasps}, expected at least 1")
        seen = View.of(observation).observation
        rng = np.random.default_rng(seed)
        cloud, normals = complete(seen, rng)
        position, quaternion, shape = self._sample(cloud, normals, rng)
        observed = seen.points_world[:: max(1, len(seen.points_world) // 500)]
        grasps, score = self._close(cloud, normals, observed, position, quaternion, shape)
        if not len(grasps):
            raise RuntimeError("no feasible grasp is found: the object may be too large, too flat or out of reach")
        order = spread(grasps, score, num_grasps)
        return Grasps.of(grasps.trajectory[order], self.hand, score[order])

    def _sample(
        self, cloud: NDArray[np.float32], normals: NDArray[np.float32], rng: np.random.Generator
    ) -> tuple[Tensor, Tensor, NDArray[np.int64]]:
        """Wrist poses whose palm x lies along a graspable width, with the preshape of each."""
        n = self.num_samples
        seed_point = rng.integers(len(cloud), size=n)
        thin = rng.random(n) < 0.3  # take the wall that a point near the top lies on, as at a rim
        upper = np.flatnonzero(cloud[:, 2] > cloud[:, 2].max() - 0.025)
        seed_point[thin] = rng.choice(upper, thin.sum())
        point = cloud[seed_point]
        # the width is measured along the surface normal, leveled in half of the cases
        across = normals[seed_point] + 0.15 * rng.normal(size=(n, 3))
        across[rng.random(n) < 0.5, 2] = 0
        across /= np.linalg.norm(across, axis=1, keepdims=True) + 1e-9
        low, high = _extent(cloud, point, across, 0.012)
        wall_low, wall_high = _extent(cloud, point, across, 0.012, gap=0.012)
        low, high = np.where(thin, wall_low, low), np.where(thin, wall_high, high)
        width = high - low
        middle = point + across * ((low + high) / 2)[:, None]
        shape = rng.integers(len(_TEMPLATES), size=n)

        # the fingers point along `along`, square to the width, from the side or from above
        tilt = np.where(thin, rng.uniform(1.0, np.pi / 2 + 0.2, n), rng.uniform(-0.3, np.pi / 2 + 0.2, n))
        level = np.cross(across, [0, 0, 1.0]) * rng.choice([-1, 1], n)[:, None]
        level /= np.linalg.norm(level, axis=1, keepdims=True) + 1e-9
        down = np.cross(across, level)
        down *= -np.sign(down[:, 2:] + 1e-9)
        along = np.cos(tilt)[:, None] * level + np.sin(tilt)[:, None] * down
        x = across * rng.choice([-1, 1], n)[:, None]
        y = np.cross(along, x)
        turn = np.stack((x, y, along), axis=-1)
        reach, aside = np.array([_TEMPLATES[i].reach for i in shape]), np.array([_TEMPLATES[i].aside for i in shape])
        center = np.stack(
            (
                width / 2 + rng.uniform(0.008, 0.045, n),
                rng.uniform(aside[:, 0], aside[:, 1]),
                rng.uniform(reach[:, 0], reach[:, 1]),
            ),
            axis=-1,
        )
        position = middle - (turn @ center[..., None])[..., 0]
        keep = (width < MAX_WIDTH) & (np.abs(np.linalg.norm(along, axis=1) - 1) < 1e-3)
        matrix = torch.tensor(turn[keep], dtype=torch.float32)
        return torch.tensor(position[keep], dtype=torch.float32), rotation.from_matrix(matrix), shape[keep]

    def _close(
        self,
        cloud: NDArray[np.float32],
        normals: NDArray[np.float32],
        observed: NDArray[np.float32],
        position: Tensor,
        quaternion: Tensor,
        shape: NDArray[np.int64],
    ) -> tuple[Grasps, Tensor]:
        """Drop colliding candidates, close each finger until it touches the cloud, and score the opposition."""
        hand, points = self.hand, torch.tensor(cloud)
        opened = torch.stack([self._posture(p, 0.0) for p in _TEMPLATES])
        closed = torch.stack([self._posture(p, 1.0) for p in _TEMPLATES])
        table = torch.tensor([0.0, 0, 1, 0])
        kept: list[Grasps] = []
        scores: list[Tensor] = []
        levels = torch.linspace(0, 1, _LEVELS)
        for start in range(0, len(position), _CHUNK):
            chunk = slice(start, start + _CHUNK)
            wrist = pose_matrix(position[chunk], quaternion[chunk])
            preshape = torch.tensor(shape[chunk])
            links = wrist[:, None] @ hand.forward_kinematics(hand.expand(opened[preshape]))
            free = hand.clearance(links, table).amin(-1) > MIN_CLEARANCE
            wrist, preshape, links = wrist[free], preshape[free], links[free]
            free = hand.signed_distance(links, points).amin((-1, -2)) > -MAX_PENETRATION
            wrist, preshape = wrist[free], preshape[free]
            if not len(wrist):
                continue
            posture = opened[preshape, None] + levels[:, None] * (closed - opened)[preshape, None]
            links = wrist[:, None, None] @ hand.forward_kinematics(hand.expand(posture))
            distance, nearest = hand.signed_distance(links, points).min(-1)  # (grasp, level, solid)
            grip, touched, contact = self._stop(posture, distance, nearest, preshape)
            score = _opposition(points, torch.tensor(normals), touched, contact)
            links = wrist[:, None] @ hand.forward_kinematics(hand.expand(grip))
            clear = hand.clearance(links, table).amin(-1)
            reach = (points.mean(0) - wrist[:, :3, 3]).norm(dim=-1)
            good = (score > 0) & (clear > MIN_CLEARANCE) & (reach < 0.25)
            if good.any():
                far = torch.cdist(wrist[good, :3, 3], torch.tensor(observed)).amin(-1)
                standoff = (MAX_REACH - far).clamp(0.0, STANDOFF)
                kept.append(
                    self._path(wrist[good], opened[preshape[good]], grip[good], contact[good], preshape[good], standoff)
                )
                scores.append(score[good])
        if not kept:
            return Grasps.none(hand), torch.zeros(0)
        return Grasps.concatenate(kept), torch.cat(scores)

    def _posture(self, preshape: GraspTemplate, level: float) -> Tensor:
        """Free joints at a level of closing between 0 and 1; fingers that take no part rest."""
        angles = []
        for name in self.hand.freedoms:
            finger, joint = name.split("_")
            index = ("abd", "mcp", "pip").index(joint)
            a, b = preshape.open[index], preshape.closed[index]
            if finger == "thumb":
                angles.append(level * b)
            elif finger in preshape.fingers:
                angles.append(a + level * (b - a))
            else:
                angles.append(_RESTING[index])
        return torch.tensor(angles)

    def _stop(
        self, posture: Tensor, distance: Tensor, nearest: Tensor, preshape: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Each finger's posture where it first touches, the cloud point it touches, and whether it does."""
        count = len(posture)
        grip = posture[:, -1].clone()
        touched = torch.zeros(count, 5, dtype=torch.long)
        contact = torch.zeros(count, 5, dtype=torch.bool)
        rows = torch.arange(count)
        for index, finger in enumerate(self.hand.fingers):
            solids = [i for i, name in enumerate(self.hand.solid_names) if name.startswith(finger)]
            gap, which = distance[:, :, solids].min(-1)
            hit = gap < 0.001
            first = torch.where(hit.any(1), hit.int().argmax(1), _LEVELS - 1)
            joints = [i for i, name in enumerate(self.hand.freedoms) if name.startswith(finger)]
            grip[:, joints] = posture[rows, first][:, joints]
            takes_part = torch.tensor([finger == "thumb" or finger in p.fingers for p in _TEMPLATES])[preshape]
            contact[:, index] = hit.any(1) & (first > 0) & takes_part
            solid = torch.tensor(solids)[which[rows, first]]
            touched[:, index] = nearest[rows, first, solid]
        return grip, touched, contact

    def _path(
        self, wrist: Tensor, opened: Tensor, grip: Tensor, contact: Tensor, preshape: Tensor, standoff: Tensor
    ) -> Grasps:
        """Pre-grasp drawn back along the fingers and the palm, grip, squeeze with the fingers that touch."""
        hand = self.hand
        quaternion = rotation.from_matrix(wrist[:, :3, :3])
        back = torch.nn.functional.normalize(torch.tensor([-0.5, 0.0, -1.0]), dim=0) * standoff[:, None]
        pregrasp = wrist[:, :3, 3] + rotation.rotate(quaternion, back)
        pregrasp[:, 2] = torch.maximum(pregrasp[:, 2], wrist[:, 2, 3])
        position = torch.stack((pregrasp, wrist[:, :3, 3], wrist[:, :3, 3]), 1)
        finger = [self.hand.fingers.index(name.split("_")[0]) for name in hand.freedoms]
        flexes = torch.tensor([not name.endswith("_abd") for name in hand.freedoms])
        press = SQUEEZE_TRAVEL * (contact[:, finger] & flexes)
        squeeze = hand.clamp(grip + press)
        joints = hand.expand(torch.stack((opened, grip, squeeze), 1))
        types = torch.tensor([p.grasp_type for p in _TEMPLATES])[preshape]
        motion = Trajectory.from_keyframes(position, quaternion[:, None].expand(-1, 3, -1), joints, types)
        return Grasps.of(motion, hand)


def complete(observation: Observation, rng: np.random.Generator) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The observed cloud and a guess of its hidden side.

    Args:
        observation: The view of the object.
        rng: Chooses the points.

    Returns:
        At most 440 points in the world frame, and their outward normals.

    Raises:
        ValueError: Too little of the object is seen.
    """
    cloud = observation.points_world
    if len(cloud) < MIN_POINTS:
        raise ValueError(f"the object has {len(cloud)} points, fewer than the {MIN_POINTS} a grasp can be planned on")
    cloud = cloud[rng.permutation(len(cloud))[:1500]]
    tree = cKDTree(cloud)
    neighbors = cloud[tree.query(cloud, k=20)[1]]
    centered = neighbors - neighbors.mean(1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", centered, centered))[1][:, :, 0]
    camera = observation.T_world_camera[:3, 3]
    normals *= np.sign(((camera - cloud) * normals).sum(1, keepdims=True) + 1e-12)
    chosen = rng.permutation(len(cloud))[:220]
    cloud, normals = cloud[chosen], normals[chosen]
    turned_points, may_be_there = guess_hidden_side(observation, torch.from_numpy(cloud))
    turned, hidden = turned_points.numpy(), may_be_there.numpy()
    turned_normals = normals * np.array([-1, -1, 1])
    return (
        np.concatenate((cloud, turned[hidden])).astype(np.float32),
        np.concatenate((normals, turned_normals[hidden])).astype(np.float32),
    )


def _extent(
    cloud: NDArray[np.float32],
    point: NDArray[np.float32],
    direction: NDArray[np.float64],
    radius: float,
    gap: float | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lowest and highest coordinate of the cloud along lines through `point`, within `radius` of them.

    gap: stop where the cloud has a hole of that many meters.
    """
    offset = cloud[None] - point[:, None]
    along = np.einsum("npi,ni->np", offset, direction)
    aside = (offset**2).sum(-1) - along**2
    along = np.where(aside < radius**2, along, np.nan)
    if gap is None:
        return np.nanmin(along, 1), np.nanmax(along, 1)
    ordered = np.sort(along, axis=1)  # NaN last
    step = np.diff(ordered, axis=1)
    zero = (np.abs(ordered)).argsort(1)[:, 0]
    columns = np.arange(step.shape[1])
    broken = ~(step < gap)
    last_before = np.where(broken & (columns < zero[:, None]), columns + 1, 0).max(1)
    first_after = np.where(broken & (columns >= zero[:, None]), columns, step.shape[1]).min(1)
    rows = np.arange(len(ordered))
    return ordered[rows, last_before], ordered[rows, first_after]


def _opposition(points: Tensor, normals: Tensor, touched: Tensor, contact: Tensor) -> Tensor:
    """How well the thumb's and the fingers' contacts face each other, plus the share of fingers that touch.

    An antipodal grasp has both inward normals along the line that joins the contacts (Nguyen 1988): the lesser of the
    two cosines counts. Zero where the thumb or all fingers miss. The line is taken between the fingers' middles, 1 cm
    over the surface, so that it is defined at a thin wall too.
    """
    normal = normals[touched]  # (grasp, 5, 3)
    at = points[touched] + 0.01 * normal
    weight = contact[:, 1:, None].float()
    total = weight.sum(1).clamp_min(1)
    finger_at = (at[:, 1:] * weight).sum(1) / total
    finger_normal = torch.nn.functional.normalize((normal[:, 1:] * weight).sum(1), dim=-1)
    line = torch.nn.functional.normalize(finger_at - at[:, 0], dim=-1)
    cosine = torch.minimum(-(normal[:, 0] * line).sum(-1), (finger_normal * line).sum(-1))
    off_center = ((finger_at + at[:, 0]) / 2 - points.mean(0)).norm(dim=-1)
    score = cosine + 0.15 * contact[:, 1:].sum(-1) - 3 * off_center + 0.5
    return torch.where(contact[:, 0] & contact[:, 1:].any(-1) & (cosine > 0.5), score.clamp_min(0.01), 0.0)

"""Kopicki's densities: contact models, hand-configuration model and query densities (thesis, section 3.1).

A demonstration says where each link lay on the surface (M, contact models) and how the fingers were bent (C). Carried
over to the features of a new surface, each contact model becomes a density Q of poses of its link there. A grasp's
likelihood is the product of these experts (thesis, equation 3.2).

Kernels are those of Kopicki et al. 2016: exp(-|p - p'|^2 / s^2) over positions and exp(-k (1 - |q . q'|)) over
orientations, which takes q and -q as one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy.stats import vonmises_fisher
from torch import Tensor

from dexzoo import rotation
from dexzoo.generators.demonstration import Demonstration
from dexzoo.generators.features import Features
from dexzoo.grasp import GRIP, PREGRASP, Grasps, pose_matrix
from dexzoo.hand import Hand


@dataclass(frozen=True)
class Bandwidths:
    """Widths of kernels and fields; the defaults are Kopicki's.

    position: s of the position kernel, m. concentration: k of the orientation kernel. joint: of the posture kernel,
    rad. curvature: of the feature kernel, in standard deviations of the contact's own curvatures. contact: how far in
    metres from a link the surface counts as under it, and decay: by which squared distance is weighed there, 1/m^2.
    """

    position: float = 0.005
    concentration: float = 200.0
    joint: float = 0.015708
    curvature: float = 50.0
    contact: float = 0.01
    decay: float = 50.0


MIN_CONTACT = 50
"""Surface points under a link from which on it counts as in contact."""
MAX_CONTACT = 400
"""Kernels of a contact model; more points are thinned out."""
REFERENCE_KERNELS = 5000
"""Kernels that a query density's weights add up to, however many it is made of; Kopicki's number."""
FLOOR = 6e-6
"""Likelihood under which a link counts as away from the surface: that at three and a half bandwidths."""
LINK_POWER = 0.75
"""The sum over n links counts divided by n to this power: they move together, so that n are not n witnesses."""
_CHUNK = 256


@dataclass(frozen=True)
class Grips:
    """Grips under way: demo (n,) rows of the density, wrist (n, 4, 4) poses, joints (n, 15) freedoms."""

    demo: Tensor
    wrist: Tensor
    joints: Tensor

    def __getitem__(self, index: Tensor) -> Grips:
        return Grips(self.demo[index], self.wrist[index], self.joints[index])


@dataclass(frozen=True)
class ContactModel:
    """M(u, r) of one link: its pose u relative to the frame of a surface feature, with the feature's curvature r.

    position: (n, 3), quaternion: (n, 4), curvature: (n, 2), weight: (n,).
    """

    link: int
    position: Tensor
    quaternion: Tensor
    curvature: Tensor
    weight: Tensor


def contact_models(demonstration: Demonstration, hand: Hand, widths: Bandwidths) -> list[ContactModel]:
    """The contact models of all links that touch at the grip, in the order of the hand's links."""
    surface, grasp = demonstration.surface, demonstration.grasp
    links = grasp.wrist_pose[0, GRIP] @ hand.forward_kinematics(grasp.joints[0, GRIP])
    points = surface.points.clone().requires_grad_()
    distance = hand.signed_distance(links, points)
    slope = torch.stack([torch.autograd.grad(row.sum(), points, retain_graph=True)[0] for row in distance])
    distance = distance.detach()
    # outside, the slope of the distance points from the link to the surface point, whose outside must face the link
    facing = -(slope * surface.normals).sum(-1) >= 0
    under = (distance < 0) | ((distance <= widths.contact) & facing)
    models = []
    for solid, name in enumerate(hand.solid_names):
        rows = under[solid].nonzero().squeeze(-1)
        if len(rows) < MIN_CONTACT:
            continue
        rows = rows[torch.linspace(0, len(rows) - 1, min(len(rows), MAX_CONTACT)).long()]
        link = hand.link_index(name)
        frame = rotation.conjugate(surface.quaternion[rows])
        models.append(
            ContactModel(
                link,
                rotation.rotate(frame, links[link, :3, 3] - surface.points[rows]),
                rotation.normalize(rotation.multiply(frame, rotation.from_matrix(links[link, :3, :3]))),
                surface.curvature[rows],
                torch.exp(-widths.decay * distance[solid, rows].clamp_min(0).square()),
            )
        )
    return models


class GraspDensity:
    """The product of experts over grasps of one observed surface, for several demonstrations at once.

    Demonstrations are rows d, their links in contact columns l (padded), kernels k. All in the frame of the surface.
    kernel_position: (d, l, k, 3), kernel_turn: (d, l, k, 9) rotation matrices, log_weight: (d, l, k).
    """

    def __init__(
        self,
        demonstrations: Sequence[Demonstration],
        models: Sequence[Sequence[ContactModel]],
        surface: Features,
        hand: Hand,
        num_kernels: int = 5000,
        widths: Bandwidths | None = None,
        floor: float = FLOOR,
        generator: torch.Generator | None = None,
    ) -> None:
        self.widths = widths or Bandwidths()
        self.hand, self.floor = hand, floor
        self.demonstrations, self.surface = list(demonstrations), surface
        generator = generator or torch.Generator().manual_seed(0)
        most = max(len(row) for row in models)
        count = len(models)
        self.links = torch.zeros(count, most, dtype=torch.long)
        self.active = torch.zeros(count, most, dtype=torch.bool)
        self.kernel_position = torch.zeros(count, most, num_kernels, 3)
        self.kernel_quaternion = torch.zeros(count, most, num_kernels, 4)
        self.kernel_quaternion[..., 0] = 1
        self.log_weight = torch.zeros(count, most, num_kernels)
        for row, links in enumerate(models):
            for column, model in enumerate(links):
                self.links[row, column], self.active[row, column] = model.link, True
                position, quaternion, weight = _query(model, surface, num_kernels, self.widths.curvature, generator)
                self.kernel_position[row, column] = position
                self.kernel_quaternion[row, column] = quaternion
                self.log_weight[row, column] = (REFERENCE_KERNELS * weight / weight.sum()).log()
        self.kernel_turn = rotation.to_matrix(self.kernel_quaternion).flatten(-2)
        joints = torch.cat([d.grasp.joints[:, [PREGRASP, GRIP]] for d in demonstrations])
        self.grip, self.closing = joints[:, 1], joints[:, 1] - joints[:, 0]

    def sample(self, num: int, generator: torch.Generator) -> Grips:
        """Draw `num` grips of each demonstration, demonstration by demonstration.

        The query density of one link in contact, drawn at random, gives that link's pose, C the posture, and forward
        kinematics the wrist.
        """
        rows = torch.arange(len(self.demonstrations)).repeat_interleave(num)
        column = _draw(self.active.float(), rows, generator)
        width = self.links.shape[1]
        kernel = _draw(self.log_weight.exp().flatten(0, 1), rows * width + column, generator)
        place = (rows, column, kernel)
        step = torch.randn(len(rows), 3, generator=generator)
        away = self.widths.position * torch.randn(len(rows), 1, generator=generator)
        position = self.kernel_position[place] + torch.nn.functional.normalize(step, dim=-1) * away
        seed = int(torch.randint(2**31, (1,), generator=generator))
        turn = vonmises_fisher([1.0, 0, 0, 0], self.widths.concentration).rvs(len(rows), random_state=seed)
        quaternion = rotation.multiply(self.kernel_quaternion[place], torch.tensor(turn, dtype=torch.float32))
        # t of the path is normal, and lies on the path
        t = torch.fmod(torch.randn(len(rows), generator=generator), 1.0)
        middle = self.hand.reduce(self.grip[rows] + t[:, None] * self.closing[rows])
        noise = torch.randn(len(rows), len(self.hand.freedoms), generator=generator)
        free = self.hand.clamp(middle + self.widths.joint * noise)
        relative = self.hand.forward_kinematics(self.hand.expand(free))[
            torch.arange(len(rows)), self.links[rows, column]
        ]
        wrist = pose_matrix(position, rotation.normalize(quaternion)) @ torch.linalg.inv(relative)
        return Grips(rows, wrist, free)

    def screen(self, grips: Grips, num: int = 150) -> Float[Tensor, " grip"]:
        """A quick estimate of the likelihood, from the first `num` kernels, which are as random as the rest."""
        position, turn = self._link_poses(grips)
        total = self.log_posture(grips)
        scale = self.log_weight.new_tensor(self.log_weight.shape[-1] / num).log()
        for demo in grips.demo.unique().tolist():
            rows = (grips.demo == demo).nonzero().squeeze(-1)
            columns = self.active[demo].nonzero().squeeze(-1).tolist()
            for column in columns:
                logs = self.log_weight[demo, column, :num] + _log_kernel(
                    position[rows, column], turn[rows, column], self.kernel_position[demo, column, :num],
                    self.kernel_turn[demo, column, :num], self.widths,
                )  # fmt: skip
                total[rows] += self._saturated(logs.logsumexp(-1) + scale) / len(columns) ** LINK_POWER
        return total

    @torch.no_grad()
    def neighbours(self, grips: Grips, num: int = 12) -> tuple[Tensor, Tensor, Tensor]:
        """The kernels that matter near each grip: positions (n, l, num, 3), turns (.., 9), ln weights (n, l, num).

        A kernel five bandwidths away weighs e^-25: so few are enough, and they serve as long as the grip stays near.
        """
        shape = (len(grips.demo), self.links.shape[1], min(num, self.log_weight.shape[-1]))
        index = torch.zeros(shape, dtype=torch.long)
        position, turn = self._link_poses(grips)
        for demo in grips.demo.unique().tolist():
            rows = (grips.demo == demo).nonzero().squeeze(-1)
            for column in self.active[demo].nonzero().squeeze(-1).tolist():
                kernels = (demo, column)
                for part in rows.split(_CHUNK):
                    logs = self.log_weight[kernels] + _log_kernel(
                        position[part, column], turn[part, column], self.kernel_position[kernels],
                        self.kernel_turn[kernels], self.widths,
                    )  # fmt: skip
                    index[part, column] = logs.topk(shape[-1], sorted=False).indices
        place = (grips.demo[:, None, None], torch.arange(shape[1])[:, None], index)
        return self.kernel_position[place], self.kernel_turn[place], self.log_weight[place]

    def log_density(self, grasps: Grasps) -> Float[Tensor, " grasp"]:
        """Ln of the likelihood of grasps in the frame of the surface (the world), by their grips; differentiable.

        Where several demonstrations are of a grasp's type their likelihoods add up; where none is, it is -inf.
        """
        if grasps.frame != "world":
            raise ValueError('log_density takes grasps in the "world" frame; use to_frame first')
        wrist, joints = grasps.wrist_pose[:, GRIP], self.hand.reduce(grasps.joints[:, GRIP])
        types = torch.tensor([d.grasp_type for d in self.demonstrations])
        like = grasps.grasp_type[:, None] == types
        grasp, demo = like.nonzero(as_tuple=True)
        each = self.log_likelihood(Grips(demo, wrist[grasp], joints[grasp]))
        return torch.full(like.shape, -torch.inf).index_put((grasp, demo), each).logsumexp(-1)

    def log_likelihood(self, grips: Grips, near: tuple[Tensor, Tensor, Tensor] | None = None) -> Float[Tensor, " grip"]:
        """Ln of the product of experts (thesis, equation 3.2); differentiable in the grips."""
        near = self.neighbours(grips) if near is None else near
        position, turn = self._link_poses(grips)
        apart = (near[0] - position[..., None, :]).square().sum(-1) / self.widths.position**2
        cosine = (((near[1] * turn[..., None, :]).sum(-1) + 1) / 4).clamp_min(1e-6).sqrt()
        logs = near[2] - apart - self.widths.concentration * (1 - cosine)
        active = self.active[grips.demo]
        contact = torch.where(active, self._saturated(logs.logsumexp(-1)), 0.0).sum(-1) / active.sum(-1) ** LINK_POWER
        return contact + self.log_posture(grips)

    def _saturated(self, log_link: Tensor) -> Tensor:
        """What one link's ln Q adds: from 0 far from all contact models up to -ln floor, where it is in contact.

        (Q + floor) / (1 + Q) in place of Q: a link that the new object has no place for does not rule the others out,
        and how many features are alike where it has one, as on a plane, says nothing more.
        """
        log_floor = log_link.new_tensor(self.floor).log()
        return torch.logaddexp(log_link, log_floor) - torch.nn.functional.softplus(log_link) - log_floor

    def log_posture(self, grips: Grips) -> Float[Tensor, " grip"]:
        """Ln C: how near the posture is to the demonstrated path, and how near on it to the grip.

        The path runs from t = -1 at the pre-grasp by the grip at 0 as far again to t = 1, with weight exp(-|t|), and
        Gaussian kernels stand on it without gaps: what counts is the nearest.
        """
        closing = self.closing[grips.demo]
        away = self.hand.expand(grips.joints) - self.grip[grips.demo]
        t = ((away * closing).sum(-1) / closing.square().sum(-1).clamp_min(1e-6)).clamp(-1, 1)
        apart = (away - t[:, None] * closing).square().sum(-1) / self.widths.joint**2
        return -t.abs() - apart

    def _link_poses(self, grips: Grips) -> tuple[Tensor, Tensor]:
        """Positions (n, l, 3) and rotation matrices (n, l, 9) of the links in contact."""
        links = self.hand.forward_kinematics(self.hand.expand(grips.joints))[..., :3, :]
        relative = torch.take_along_dim(links, self.links[grips.demo][..., None, None], 1)
        # one product for all links of a grip, which is far quicker than one for each
        turned = grips.wrist[:, :3, :3] @ relative.transpose(1, 2).flatten(-2)
        turned = turned.unflatten(-1, (-1, 4)).transpose(1, 2)
        return turned[..., 3] + grips.wrist[:, None, :3, 3], turned[..., :3].flatten(-2)


def _log_kernel(
    position: Tensor, turn: Tensor, kernel_position: Tensor, kernel_turn: Tensor, widths: Bandwidths
) -> Float[Tensor, "n kernel"]:
    """Ln of all kernels at all poses, by two matrix products."""
    s = 1 / widths.position
    a, b = position * s, kernel_position * s
    apart = a.square().sum(-1)[:, None] + b.square().sum(-1) - 2 * a @ b.T
    cosine = ((turn @ kernel_turn.T + 1) / 4).clamp_min_(0).sqrt_()
    return cosine.sub_(1).mul_(widths.concentration).sub_(apart)


def _query(
    model: ContactModel, surface: Features, num: int, bandwidth: float, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Kernels of Q by Monte Carlo: surface features drawn evenly, for each a contact of like curvature.

    The weight of a kernel is that of its feature under M (how much of the contact model is like it there).
    """
    which = torch.randint(len(surface), (num,), generator=generator)
    spread = bandwidth * model.curvature.std(0).clamp_min(1e-4)
    unlike = ((surface.curvature[:, None] - model.curvature) / spread).square().sum(-1)
    likeness = (model.weight * torch.exp(-unlike)).clamp_min(1e-10 / len(model.weight))
    chosen = _draw(likeness, which, generator)
    turn = rotation.multiply(surface.quaternion[which], surface[which].ambiguous_turn(generator))
    position = surface.points[which] + rotation.rotate(turn, model.position[chosen])
    quaternion = rotation.normalize(rotation.multiply(turn, model.quaternion[chosen]))
    return position, quaternion, likeness.sum(1)[which]


def _draw(weight: Float[Tensor, "row n"], rows: Tensor, generator: torch.Generator) -> Tensor:
    """An index drawn by the weights of each of the rows given; by inversion of one cumulative sum over all rows."""
    share = weight.double() / weight.double().sum(1, keepdim=True)
    bounds = share.cumsum(1).clamp_max(1) + torch.arange(len(weight))[:, None]
    value = rows + torch.rand(len(rows), generator=generator, dtype=torch.float64) * (1 - 1e-9)
    index = torch.searchsorted(bounds.flatten(), value, right=True) - rows * weight.shape[1]
    return index.clamp(0, weight.shape[1] - 1)

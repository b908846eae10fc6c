"""Kopicki's densities: contact models, hand-configuration model and query densities (thesis, section 3.1).

A demonstration says where each link lay on the surface (M, contact models) and how the fingers were bent (C). Carried
over to the features of a new surface, each contact model becomes a density Q of poses of its link there. A grasp's
likelihood is the product of these experts (thesis, equation 3.2).

Kernels are those of Kopicki et al. 2016: exp(-|p - p'|^2 / s^2) over positions and exp(-k (1 - |q . q'|)) over
orientations, which takes q and -q as one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy.stats import vonmises_fisher
from torch import Tensor

from dexzoo import rotation
from dexzoo.generators.contact_models import Bandwidths, ContactModel
from dexzoo.generators.demonstration import Demonstration
from dexzoo.generators.generator import GraspDensity
from dexzoo.grasp import GRIP, PREGRASP, Trajectory
from dexzoo.hand import Hand
from dexzoo.perception.surface import SurfaceFeatures
from dexzoo.rotation import pose_matrix

REFERENCE_KERNELS = 5000
"""Kernels that a query density's weights add up to, however many it is made of; Kopicki's number."""
FLOOR = 6e-6
"""Likelihood under which a link counts as away from the surface: that at three and a half bandwidths."""
LINK_POWER = 0.75
"""The sum over n links counts divided by n to this power: they move together, so that n are not n witnesses."""
_CHUNK = 256


@dataclass(frozen=True)
class Grips:
    """Grips that are being searched for.

    Attributes:
        demo: Row of the demonstration in the density, (grip,).
        wrist: Wrist poses in the world frame, (grip, 4, 4).
        joints: Free joints in radians, (grip, freedom).
    """

    demo: Tensor
    wrist: Tensor
    joints: Tensor

    def __getitem__(self, index: Tensor) -> Grips:
        return Grips(self.demo[index], self.wrist[index], self.joints[index])


class ContactDensity(GraspDensity):
    """The product of experts over grasps of one observed surface, for several demonstrations at once.

    Demonstrations are rows d, their links in contact columns l (padded), kernels k. All in the frame of the surface.

    Args:
        demonstrations: The demonstrations.
        models: Contact models of each.
        surface: Features of the observed surface.
        hand: The hand.
        num_kernels: Kernels of a link's query density.
        widths: Widths of the kernels.
        floor: Likelihood under which a link counts as away from the surface.
        generator: Draws the kernels.

    Attributes:
        kernel_position: Positions of the links, (d, l, k, 3).
        kernel_turn: Rotation matrices of the links, (d, l, k, 9).
        log_weight: Logarithms of the kernels' weights, (d, l, k).
    """

    def __init__(
        self,
        demonstrations: Sequence[Demonstration],
        models: Sequence[Sequence[ContactModel]],
        surface: SurfaceFeatures,
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

        Args:
            num: Grips of each demonstration.
            generator: Source of randomness.
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
        """A quick estimate of the likelihood from some kernels, which are as random as the rest.

        Args:
            grips: Grips.
            num: Number of kernels of each link.
        """
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
    def neighbors(self, grips: Grips, num: int = 12) -> tuple[Tensor, Tensor, Tensor]:
        """The kernels that matter near each grip: positions (n, l, num, 3), turns (.., 9), ln weights (n, l, num).

        A kernel five bandwidths away weighs e^-25: so few are enough, and they serve as long as the grip stays near.

        Args:
            grips: Grips.
            num: Number of kernels of each link.
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

    def log_density(self, grasps: Trajectory) -> Float[Tensor, " grasp"]:
        """Log of the likelihood of grasps by their grips; differentiable.

        Where several demonstrations are of a grasp's type their likelihoods add up; where none is, it is -inf.

        Args:
            grasps: Grasps in the world frame, which is that of the surface.

        Returns:
            Log-likelihoods.
        """
        return self._by_demonstration(grasps).logsumexp(-1)

    @torch.no_grad()
    def near(self, grasps: Trajectory) -> Callable[[Trajectory], Float[Tensor, " grasp"]]:
        """The log-likelihood near some grasps, each by the demonstration that it is likeliest to come from.

        Args:
            grasps: Grasps in the world frame.

        Returns:
            The function; 0 for grasps of a type without demonstration.
        """
        each = self._by_demonstration(grasps)
        known = torch.isfinite(each).any(-1).nonzero().squeeze(-1)
        demo = each[known].argmax(-1)
        if not len(known):
            return lambda moved: moved.wrist.new_zeros(len(moved))
        kernels = self.neighbors(self._grips(grasps[known], demo))

        def value(moved: Trajectory) -> Tensor:
            found = self.log_likelihood(self._grips(moved[known], demo), kernels)
            return moved.wrist.new_zeros(len(moved)).index_put((known,), found)

        return value

    def _by_demonstration(self, grasps: Trajectory) -> Float[Tensor, "grasp demo"]:
        """Log-likelihood of each grasp by each demonstration; -inf for those of another type."""
        types = torch.tensor([demonstration.grasp_type for demonstration in self.demonstrations])
        like = grasps.grasp_type[:, None] == types
        grasp, demo = like.nonzero(as_tuple=True)
        each = self.log_likelihood(self._grips(grasps[grasp], demo))
        return torch.full(like.shape, -torch.inf).index_put((grasp, demo), each)

    def _grips(self, grasps: Trajectory, demo: Tensor) -> Grips:
        return Grips(demo, grasps.wrist_pose[:, GRIP], self.hand.reduce(grasps.joints[:, GRIP]))

    def log_likelihood(self, grips: Grips, near: tuple[Tensor, Tensor, Tensor] | None = None) -> Float[Tensor, " grip"]:
        """Logarithm of the product of experts (thesis, equation 3.2); differentiable in the grips.

        Args:
            grips: Grips.
            near: Kernels that matter, as of `neighbors`; sought if not given.
        """
        near = self.neighbors(grips) if near is None else near
        position, turn = self._link_poses(grips)
        apart = (near[0] - position[..., None, :]).square().sum(-1) / self.widths.position**2
        cosine = (((near[1] * turn[..., None, :]).sum(-1) + 1) / 4).clamp_min(1e-6).sqrt()
        logs = near[2] - apart - self.widths.concentration * (1 - cosine)
        active = self.active[grips.demo]
        contact = torch.where(active, self._saturated(logs.logsumexp(-1)), 0.0).sum(-1) / active.sum(-1) ** LINK_POWER
        return contact + self.log_posture(grips)

    def _saturated(self, log_link: Tensor) -> Tensor:
        """Contribution of one link's ln Q: from 0 far from all contact models up to -ln floor, where it is in contact.

        (Q + floor) / (1 + Q) in place of Q: a link that the new object has no place for does not rule the others out,
        and how many features are alike where it has one, as on a plane, says nothing more.
        """
        log_floor = log_link.new_tensor(self.floor).log()
        return torch.logaddexp(log_link, log_floor) - torch.nn.functional.softplus(log_link) - log_floor

    def log_posture(self, grips: Grips) -> Float[Tensor, " grip"]:
        """Logarithm of C: how near the posture is to the demonstrated path, and how near on it to the grip.

        The path runs from t = -1 at the pre-grasp by the grip at 0 as far again to t = 1, with weight exp(-|t|), and
        Gaussian kernels stand on it without gaps: the nearest counts.

        Args:
            grips: Grips.
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
    model: ContactModel, surface: SurfaceFeatures, num: int, bandwidth: float, generator: torch.Generator
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

"""Improve grips on a density: by simulated annealing, as Kopicki's generator does, or by gradient through the hand."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from scipy.stats import vonmises_fisher
from torch import Tensor

from dexzoo import rotation
from dexzoo.generators.contact_density import ContactDensity, Grips
from dexzoo.rotation import pose_matrix, step_pose

WRIST_STEP, TURN_CONCENTRATION, JOINT_STEP = 0.003, 500.0, 0.015708
"""Proposals of the annealing at full temperature: meters, concentration on the sphere of quaternions, radians."""
TEMPERATURE = 0.05
"""Loss of log-likelihood that is accepted with probability 1/e at full temperature."""
RATES = (0.002, 0.02, 0.01)
"""Adam's steps: meters and radians of the wrist, radians of the joints."""
REFRESH = 25
"""Steps for which the neighboring kernels of a grip are kept."""

CostNear = Callable[[Grips], Callable[[Grips], Tensor]]
"""Given grips, their cost as a function that serves as long as they stay near."""


def ascend(density: ContactDensity, grips: Grips, cost_near: CostNear, num_steps: int) -> Grips:
    """Gradient ascent (Adam) on log-likelihood - cost, over the wrist's tangent space and the free joints.

    Args:
        density: The density.
        grips: Grips to start from.
        cost_near: Gives their cost.
        num_steps: Number of steps.

    Returns:
        The improved grips.
    """
    tangent = torch.zeros(len(grips.demo), 6, requires_grad=True)
    change = torch.zeros_like(grips.joints, requires_grad=True)
    scale = torch.tensor([RATES[0]] * 3 + [RATES[1]] * 3)
    optimizer = torch.optim.Adam([tangent, change], lr=1.0)

    def moved() -> Grips:
        joints = density.hand.clamp(grips.joints + RATES[2] * change)
        return Grips(grips.demo, step_pose(grips.wrist, scale * tangent), joints)

    for step in range(num_steps):
        if step % REFRESH == 0:
            with torch.no_grad():
                near, cost = density.neighbors(moved()), cost_near(moved())
        for group in optimizer.param_groups:
            group["lr"] = 1 - 0.9 * step / num_steps
        optimizer.zero_grad()
        now = moved()
        loss = cost(now).sum() - density.log_likelihood(now, near).sum()
        loss.backward()
        optimizer.step()
    with torch.no_grad():
        return moved()


def anneal(
    density: ContactDensity, grips: Grips, cost_near: CostNear, num_steps: int, generator: torch.Generator
) -> Grips:
    """Simulated annealing as Kopicki's: the temperature falls linearly from 1 to 0.1, and with it the steps.

    Args:
        density: The density.
        grips: Grips to start from.
        cost_near: Gives their cost.
        num_steps: Number of steps.
        generator: Source of randomness.

    Returns:
        The improved grips.
    """
    count = len(grips.demo)
    rng = np.random.default_rng(int(torch.randint(2**31, (1,), generator=generator)))
    for step in range(num_steps):
        heat = 1 - 0.9 * step / max(num_steps - 1, 1)
        if step % REFRESH == 0:
            near, cost = density.neighbors(grips), cost_near(grips)
            value = density.log_likelihood(grips, near) - cost(grips)
        shift = heat * WRIST_STEP * torch.randn(count, 3, generator=generator)
        turn = vonmises_fisher([1.0, 0, 0, 0], TURN_CONCENTRATION).rvs(count, random_state=rng)
        turn = rotation.exp(heat * rotation.log(rotation.normalize(torch.tensor(turn, dtype=torch.float32))))
        wrist = grips.wrist @ pose_matrix(torch.zeros(count, 3), turn)
        wrist[:, :3, 3] += shift
        joints = density.hand.clamp(
            grips.joints + heat * JOINT_STEP * torch.randn(grips.joints.shape, generator=generator)
        )
        proposal = Grips(grips.demo, wrist, joints)
        proposed = density.log_likelihood(proposal, near) - cost(proposal)
        accept = torch.rand(count, generator=generator) < ((proposed - value) / (TEMPERATURE * heat)).exp()
        grips = Grips(
            grips.demo,
            torch.where(accept[:, None, None], proposal.wrist, grips.wrist),
            torch.where(accept[:, None], proposal.joints, grips.joints),
        )
        value = torch.where(accept, proposed, value)
    return grips

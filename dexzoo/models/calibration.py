"""Calibration: from log-odds to probabilities that match the rate of success."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F


def fit_calibration(logit: Float[Tensor, " grasp"], success: Float[Tensor, " grasp"]) -> tuple[float, float]:
    """Fit temperature and offset by the likelihood of grasps that were not trained on.

    The temperature takes back overconfidence (Guo et al. 2017). The offset brings log-odds that were learned on as many
    successes as failures to the grasps' own rate (Platt 1999). Ranks do not change.

    Args:
        logit: Log-odds of success.
        success: Outcomes, 0 or 1.

    Returns:
        Temperature, positive, and offset: the probability is sigmoid(logit / temperature + offset).

    Raises:
        ValueError: The grasps have one outcome only.
    """
    if not 0 < success.sum() < len(success):
        raise ValueError("calibration needs grasps that hold and grasps that fail")
    logit, success = logit.detach().double(), success.double()
    slope_and_offset = torch.tensor([0.0, 0.0], dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS([slope_and_offset], max_iter=100, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimizer.zero_grad()
        log_slope, offset = slope_and_offset  # the temperature stays positive: the order is not turned
        value = F.binary_cross_entropy_with_logits(logit * log_slope.exp() + offset, success)
        value.backward()
        return value

    with torch.enable_grad():
        optimizer.step(loss)
    return (-slope_and_offset[0]).exp().item(), slope_and_offset[1].item()

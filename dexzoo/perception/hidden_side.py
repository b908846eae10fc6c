"""A guess of the object's hidden side."""

from __future__ import annotations

import cv2
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dexzoo.perception.observation import Observation


def guess_hidden_side(
    observation: Observation, points: Float[Tensor, "point 3"]
) -> tuple[Float[Tensor, "point 3"], Bool[Tensor, " point"]]:
    """Turn points of the object half round about the vertical through the middle of its footprint.

    A turned point in plain view of the camera would have been seen, so it is not there.

    Args:
        observation: The view of the object.
        points: Points of the object in the world frame, meters.

    Returns:
        The turned points, and which of them may be there.
    """
    (x, y), _, _ = cv2.minAreaRect(points[:, :2].float().contiguous().numpy())
    turned = points * points.new_tensor([-1.0, -1, 1]) + points.new_tensor([2 * x, 2 * y, 0])
    return turned, torch.from_numpy(~observation.would_see(turned.numpy()))

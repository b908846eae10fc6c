"""Batches as training gives them to evaluators."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from dexzoo.grasp import Trajectory

Encoding = dict[str, Tensor]
"""Tensors that an architecture keeps of its views; their first dimension is the view."""


class Batch(NamedTuple):
    """Grasps with the view each is paired with.

    Attributes:
        views: The views that occur, encoded, or, where the encoder is trained, as images (view, 2, 224, 224). Each of
            them is paired with a grasp, and some may occur more than once.
        view: Row in `views` that each grasp is paired with, (grasp,).
        grasps: The grasps, each in the frame of its view's aimed camera.
        success: 0 or 1, (grasp,).
        scene_index: Scene of the set, (grasp,).
    """

    views: Encoding | Tensor
    view: Tensor
    grasps: Trajectory
    success: Tensor
    scene_index: Tensor

"""EM3: EM2 with a ResNet-50."""

from __future__ import annotations

from typing import ClassVar, Unpack

from dexzoo.models.em2 import EM2
from dexzoo.models.evaluator import EvaluatorOptions


class EM3(EM2):
    """EM2 with ResNet-50 in place of VGG-16: our reading of the third model of Aktas et al. (arXiv 1908.04293).

    Args:
        width: As in `EM2`.
        trunk: "resnet50_views", trained here on rendered views, or "resnet50", ImageNet weights fetched by torchvision.
        dropout: As in `EM2`.
        gain: As in `EM2`.
        options: Arguments of `GraspEvaluator`.
    """

    architecture: ClassVar[str] = "em3"

    def __init__(
        self,
        width: int = 2048,
        trunk: str = "resnet50_views",
        dropout: float = 0.5,
        gain: float = 1.0,
        **options: Unpack[EvaluatorOptions],
    ) -> None:
        super().__init__(width, trunk, dropout, gain, **options)

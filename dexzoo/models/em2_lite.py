"""EM2 with a trunk that is fast."""

from __future__ import annotations

from typing import ClassVar, Unpack

from dexzoo.models.em2 import EM2
from dexzoo.models.evaluator import EvaluatorOptions


class EM2Lite(EM2):
    """EM2 with EfficientNet-lite0, whose ImageNet weights come with dexzoo, in place of VGG-16; ours.

    Args:
        width: As in `EM2`.
        trunk: As in `EM2`.
        dropout: As in `EM2`.
        gain: As in `EM2`.
        options: Arguments of `GraspEvaluator`.
    """

    architecture: ClassVar[str] = "em2_lite"

    def __init__(
        self,
        width: int = 2048,
        trunk: str = "lite0",
        dropout: float = 0.5,
        gain: float = 1.0,
        **options: Unpack[EvaluatorOptions],
    ) -> None:
        super().__init__(width, trunk, dropout, gain, **options)

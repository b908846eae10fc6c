"""EM2 with a trunk that is fast."""

from __future__ import annotations

from typing import ClassVar, Unpack

from dexzoo.models.em2 import EM2
from dexzoo.models.evaluator import TrainingOptions


class EM2Lite(EM2):
    """EM2 with EfficientNet-lite0, whose ImageNet weights come with dexzoo, in place of VGG-16; ours.

    The arguments are `EM2`'s.
    """

    architecture: ClassVar[str] = "em2_lite"

    def __init__(
        self,
        width: int = 2048,
        trunk: str = "lite0",
        dropout: float = 0.5,
        gain: float = 1.0,
        **training: Unpack[TrainingOptions],
    ) -> None:
        super().__init__(width, trunk, dropout, gain, **training)

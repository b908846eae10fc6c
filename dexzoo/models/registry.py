"""Names of the evaluative models, where their classes are, and the cards of those that come with weights.

Nothing here loads torch, so the command line can list models at once.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

from dexzoo.resources import resource

CARD_FORMAT = "dexzoo.evaluator.1"


class Entry(NamedTuple):
    """A model of the zoo.

    Attributes:
        path: Import path of its class.
        summary: Description in one line.
    """

    path: str
    summary: str


MODELS = {
    "em1": Entry("dexzoo.models.em1.EM1", "First evaluative model of the thesis: image and hand features added"),
    "em2": Entry(
        "dexzoo.models.em2.EM2", "Second evaluative model of the thesis: image and hand features concatenated"
    ),
    "em2_lite": Entry("dexzoo.models.em2_lite.EM2Lite", "EM2 with EfficientNet-lite0 in place of VGG-16"),
    "em3": Entry("dexzoo.models.em3.EM3", "EM2 with ResNet-50 in place of VGG-16"),
    "ffh": Entry(
        "dexzoo.models.ffh.FFH", "Basis point set of the object and the hand's pose and joints (after FFHNet)"
    ),
    "em_fk": Entry("dexzoo.models.em_fk.EMFK", "Points of all links, placed by forward kinematics, look at the view"),
    "ensemble": Entry("dexzoo.models.ensemble.Ensemble", "Mean log-odds of several evaluators, and their spread"),
}


def list_models() -> list[str]:
    """Names of all evaluative models, also of those without shipped weights."""
    return list(MODELS)


def shipped_weights(name: str) -> Path:
    """Path of the weights that come with dexzoo under a name; the file may be missing.

    Args:
        name: A name of `list_models`.
    """
    return resource("checkpoints") / f"{name}.safetensors"


def shipped_card(name: str) -> dict[str, Any] | None:
    """Card of the weights that come with dexzoo.

    Args:
        name: A name of `list_models`.

    Returns:
        The card, or None if the model comes without weights.

    Raises:
        FileNotFoundError: The weights have no card beside them.
        ValueError: The card is damaged.
    """
    path = shipped_weights(name)
    return read_card(path) if path.is_file() else None


def read_card(weights: Path) -> dict[str, Any]:
    """Read the card beside a file of weights.

    Args:
        weights: The .safetensors file.

    Returns:
        The card; `architecture` is a string and `arguments` a mapping.

    Raises:
        FileNotFoundError: There is no card.
        ValueError: The card is not one of an evaluator.
    """
    path = weights.with_suffix(".json")
    if not path.is_file():
        raise FileNotFoundError(f"{weights} has no card {path.name} beside it; keep both files together")
    try:
        card = json.loads(path.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"card {path} is not JSON: {error}") from None
    if not isinstance(card, dict) or card.get("format") != CARD_FORMAT:
        raise ValueError(f"card {path} is not of an evaluator (format {CARD_FORMAT}); write it with save")
    for key, kind in (("architecture", str), ("arguments", dict)):
        if not isinstance(card.get(key), kind):
            raise ValueError(f"card {path} has no {key}; write it with save")
    return card


def how_to_get(name: str) -> str:
    """How to obtain the weights of a model that comes without.

    Args:
        name: A name of `list_models`.
    """
    ours = f"{name}-adamw.yaml"
    config = ours if (resource("configs") / ours).is_file() else f"{name}.yaml"
    return f"train them with `python -m dexzoo fit --config {config}` and load the run's folder"

"""Names of evaluative models, and the weights behind them."""

from __future__ import annotations

import difflib
import hashlib
import importlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file

from dexzoo.models.evaluator import CARD_FORMAT, GraspEvaluator, TrainingOptions
from dexzoo.resources import resource

_MODELS = {
    "em1": "dexzoo.models.em1.EM1",
    "em2": "dexzoo.models.em2.EM2",
    "em2_lite": "dexzoo.models.em2_lite.EM2Lite",
    "em3": "dexzoo.models.em3.EM3",
    "ffh": "dexzoo.models.ffh.FFH",
    "em_fk": "dexzoo.models.em_fk.EMFK",
    "ensemble": "dexzoo.models.ensemble.Ensemble",
}
_PICKLE_SUFFIXES = {".ckpt", ".pt", ".pth", ".pkl", ".pickle", ".bin"}
_PICKLE_STARTS = (b"PK\x03\x04", b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05")
_HUB = "hf://"


def list_models() -> list[str]:
    """Names of all evaluative models, those without shipped weights too."""
    return list(_MODELS)


def model_class(name: str) -> type[GraspEvaluator]:
    """The class behind a name of `list_models`, or a subclass of `GraspEvaluator` that has been imported.

    ValueError with the nearest and all names for one that is not known.
    """
    if name not in _MODELS:
        for imported in _subclasses(GraspEvaluator):
            if vars(imported).get("architecture") == name:
                return imported
        near = difflib.get_close_matches(name, _MODELS, 1, cutoff=0.3)
        hint = f", did you mean {near[0]}?" if near else ";"
        raise ValueError(f"model {name!r} is unknown{hint} known are {', '.join(_MODELS)}; import your own first")
    module, cls = _MODELS[name].rsplit(".", 1)
    found: type[GraspEvaluator] = getattr(importlib.import_module(module), cls)
    return found


def _subclasses(cls: type[GraspEvaluator]) -> Iterator[type[GraspEvaluator]]:
    """All that are imported, the latest of one parent first: a notebook may define a class again."""
    for sub in reversed(cls.__subclasses__()):
        yield sub
        yield from _subclasses(sub)


def load(name_or_path: str | Path) -> GraspEvaluator:
    """An evaluator with its weights, in eval mode, float32, on the CPU.

    name_or_path: a name of `list_models`; a .safetensors file with its .json card beside it, or a folder that holds
    one such pair; or hf://ORGANISATION/REPOSITORY, with huggingface_hub installed. Weights of an architecture of your
    own need its class to be imported. Nothing is ever unpickled.

    Raises FileNotFoundError or ValueError, in one line, that says what is wrong and what to do.
    """
    text = str(name_or_path)
    if text.startswith(_HUB):
        return _read(_only_weights(_from_hub(text)))
    if text in _MODELS:  # before folders, lest one of that name in the working folder hide the model
        return _read(_shipped(text))
    path = Path(name_or_path)
    if path.is_dir():
        return _read(_only_weights(path))
    if not path.is_file() and path.name == text and not path.suffix:
        model_class(text)
    return _read(path)


def shipped_card(name: str) -> dict[str, Any] | None:
    """The card of the weights that come with dexzoo under a name of `list_models`; None where there are none."""
    path = resource("checkpoints") / f"{name}.safetensors"
    return _read_card(path) if path.is_file() else None


def _shipped(name: str) -> Path:
    path = resource("checkpoints") / f"{name}.safetensors"
    if not path.is_file():
        raise FileNotFoundError(f"model {name} comes without weights; {how_to_get(name)}")
    return path


def how_to_get(name: str) -> str:
    """What to do for weights of a name of `list_models` that comes without."""
    ours = f"{name}-adamw.yaml"
    config = ours if (resource("configs") / ours).is_file() else f"{name}.yaml"
    return f"train them with `python -m dexzoo fit --config {config}` and load the run's folder"


def _only_weights(folder: Path) -> Path:
    found = sorted(folder.glob("*.safetensors"))
    if len(found) != 1:
        names = ", ".join(path.name for path in found) or "none"
        raise FileNotFoundError(f"folder {folder} must hold one .safetensors file of weights, found {names}")
    return found[0]


def _from_hub(address: str) -> Path:
    repository = address.removeprefix(_HUB)
    if repository.count("/") != 1:
        raise ValueError(f"hub address {address} must be hf://ORGANISATION/REPOSITORY")
    try:
        hub = importlib.import_module("huggingface_hub")
    except ImportError:
        raise ValueError(f"{address} needs huggingface_hub; install it with `pip install dexzoo[hub]`") from None
    try:
        return Path(hub.snapshot_download(repository, allow_patterns=["*.safetensors", "*.json"]))
    except Exception as error:  # the hub's errors have no common base but this one
        raise FileNotFoundError(f"{address} cannot be fetched: {str(error).splitlines()[0]}") from None


def _read(path: Path) -> GraspEvaluator:
    if not path.is_file():
        raise FileNotFoundError(f"weights {path} do not exist; give a model's name ({', '.join(_MODELS)}) or a file")
    with path.open("rb") as file:
        start = file.read(4)
    if path.suffix in _PICKLE_SUFFIXES or start.startswith(_PICKLE_STARTS):
        raise ValueError(f"{path} is a pickle, which could run code, and was not read; give a .safetensors file")
    card = _read_card(path)
    try:
        weights = load_file(path)
    except SafetensorError as error:
        raise ValueError(f"{path} is truncated or not a safetensors file ({error}); fetch or save it again") from None
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    if sha256 != card.get("sha256"):
        raise ValueError(f"{path} does not match the sha256 in its card; fetch or save both again")
    cls = model_class(card["architecture"])
    try:
        evaluator = cls(**card["arguments"])
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path.with_suffix('.json')}: {cls.__name__} refuses its arguments: {error}") from None
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{path.with_suffix('.json')} names what is not there: {error}") from None
    load_weights(evaluator, weights, path)
    evaluator.sha256, evaluator.num_bytes = sha256, path.stat().st_size
    return evaluator.eval()


def _read_card(path: Path) -> dict[str, Any]:
    card_path = path.with_suffix(".json")
    if not card_path.is_file():
        raise FileNotFoundError(f"{path} has no card {card_path.name} beside it; keep both files together")
    try:
        card = json.loads(card_path.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"card {card_path} is not JSON: {error}") from None
    if not isinstance(card, dict) or card.get("format") != CARD_FORMAT:
        raise ValueError(f"card {card_path} is not of an evaluator (format {CARD_FORMAT}); write it with save")
    for key, kind in (("architecture", str), ("arguments", dict)):
        if not isinstance(card.get(key), kind):
            raise ValueError(f"card {card_path} has no {key}; write it with save")
    return card


def load_weights(
    evaluator: GraspEvaluator,
    weights: Mapping[str, torch.Tensor],
    path: str | Path,
    arguments: Mapping[str, Any] | None = None,
) -> None:
    """Put weights into an evaluator. ValueError that names the file when they are of another architecture or size.

    arguments: those of the evaluator that the weights come from, where it is of the same class; the error names those
    that differ.
    """
    own = evaluator.state_dict()
    uncalibrated = {"temperature": torch.ones(()), "offset": torch.zeros(())}  # as saved before there was calibration
    weights = uncalibrated | dict(weights)

    def size(tensors: Mapping[str, torch.Tensor], name: str) -> str:
        return " x ".join(map(str, tensors[name].shape)) if name in tensors else "absent"

    odd = [name for name in sorted(set(own) | set(weights)) if size(own, name) != size(weights, name)]
    if odd:
        asked = evaluator.arguments
        # rates, shares and scales are floats, and shape nothing
        differ = [
            f"{name}, {value} in the file and {asked.get(name)} as configured"
            for name, value in (arguments or {}).items()
            if value != asked.get(name) and name not in TrainingOptions.__annotations__ and not isinstance(value, float)
        ]
        tensors = f"{len(odd)} tensors such as {odd[0]}, {size(weights, odd[0])} in the file and {size(own, odd[0])}"
        raise ValueError(
            f"{path} holds another architecture than {evaluator.architecture} as configured, by "
            f"{'; '.join(differ) or f'{tensors} as configured'}; use the configuration that it was trained with"
        )
    evaluator.load_state_dict({name: value.to(own[name].dtype) for name, value in weights.items()})

"""Load evaluative models by name, from a file or from a hub."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Iterator
from pathlib import Path

from dexzoo.models.evaluator import GraspEvaluator
from dexzoo.models.files import read_evaluator
from dexzoo.models.registry import MODELS, how_to_get, shipped_weights

_HUB = "hf://"


def model_class(name: str) -> type[GraspEvaluator]:
    """The class of a model.

    Args:
        name: A name of `list_models`, or the `architecture` of a subclass of `GraspEvaluator` that has been imported.

    Returns:
        The class.

    Raises:
        ValueError: No class has that name; the error names the nearest and all names.
    """
    if name not in MODELS:
        for imported in _subclasses(GraspEvaluator):
            if vars(imported).get("architecture") == name:
                return imported
        near = difflib.get_close_matches(name, MODELS, 1, cutoff=0.3)
        hint = f", did you mean {near[0]}?" if near else ";"
        raise ValueError(f"model {name!r} is unknown{hint} known are {', '.join(MODELS)}; import your own first")
    module, cls = MODELS[name].path.rsplit(".", 1)
    found: type[GraspEvaluator] = getattr(importlib.import_module(module), cls)
    return found


def _subclasses(cls: type[GraspEvaluator]) -> Iterator[type[GraspEvaluator]]:
    """All that are imported, the latest of one parent first: a notebook may define a class again."""
    for sub in reversed(cls.__subclasses__()):
        yield sub
        yield from _subclasses(sub)


def load(name_or_path: str | Path) -> GraspEvaluator:
    """Load an evaluator with its weights. Nothing is ever unpickled.

    Args:
        name_or_path: A name of `list_models`; a .safetensors file with its .json card beside it, or a folder that holds
            one such pair; or hf://ORGANIZATION/REPOSITORY, with huggingface_hub installed. Weights of an architecture
            of your own need its class to be imported.

    Returns:
        The evaluator in eval mode, float32, on the CPU.

    Raises:
        FileNotFoundError: The weights do not exist or cannot be fetched.
        ValueError: The name is unknown, or the files are damaged or refused.
    """
    text = str(name_or_path)
    if text.startswith(_HUB):
        return read_evaluator(_only_weights(_from_hub(text)), model_class)
    if text in MODELS:  # before folders, lest one of that name in the working folder hide the model
        return read_evaluator(_shipped(text), model_class)
    path = Path(name_or_path)
    if path.is_dir():
        return read_evaluator(_only_weights(path), model_class)
    if not path.is_file() and path.name == text and not path.suffix:
        model_class(text)
    return read_evaluator(path, model_class)


def _shipped(name: str) -> Path:
    path = shipped_weights(name)
    if not path.is_file():
        raise FileNotFoundError(f"model {name} comes without weights; {how_to_get(name)}")
    return path


def _only_weights(folder: Path) -> Path:
    found = sorted(folder.glob("*.safetensors"))
    if len(found) != 1:
        names = ", ".join(path.name for path in found) or "none"
        raise FileNotFoundError(f"folder {folder} must hold one .safetensors file of weights, found {names}")
    return found[0]


def _from_hub(address: str) -> Path:
    repository = address.removeprefix(_HUB)
    if repository.count("/") != 1:
        raise ValueError(f"hub address {address} must be hf://ORGANIZATION/REPOSITORY")
    try:
        hub = importlib.import_module("huggingface_hub")
    except ImportError:
        raise ValueError(f"{address} needs huggingface_hub; install it with `pip install dexzoo[hub]`") from None
    try:
        return Path(hub.snapshot_download(repository, allow_patterns=["*.safetensors", "*.json"]))
    except Exception as error:  # the hub's errors have no common base but this one
        raise FileNotFoundError(f"{address} cannot be fetched: {str(error).splitlines()[0]}") from None

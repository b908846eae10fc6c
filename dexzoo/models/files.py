"""Evaluators on disk: weights as safetensors, and a JSON card beside them. Nothing is ever unpickled."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from dexzoo.models.registry import CARD_FORMAT, MODELS, read_card

if TYPE_CHECKING:
    from dexzoo.models.evaluator import GraspEvaluator

_PICKLE_SUFFIXES = {".ckpt", ".pt", ".pth", ".pkl", ".pickle", ".bin"}
_PICKLE_STARTS = (b"PK\x03\x04", b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05")


def save_evaluator(
    evaluator: GraspEvaluator, path: str | Path, *, half: bool = True, card: Mapping[str, Any] | None = None
) -> Path:
    """Write the weights and the card of an evaluator.

    Args:
        evaluator: The model. A shared trunk is not stored.
        path: A folder, for NAME.safetensors and NAME.json named by the architecture, or the .safetensors file itself.
        half: Whether weights are stored in float16; statistics stay float32.
        card: Further entries of the card, such as data, metrics, seed and command.

    Returns:
        Path of the weights.
    """
    path = Path(path)
    if path.suffix != ".safetensors":
        path = path / f"{evaluator.architecture}.safetensors"
    path.parent.mkdir(parents=True, exist_ok=True)
    trained = {name for name, _ in evaluator.named_parameters()}
    tensors = {
        name: (value.half() if half and name in trained else value).detach().cpu().contiguous()
        for name, value in evaluator.state_dict().items()
    }
    temporary = path.with_name(f".{path.name}.partial")
    save_file(tensors, temporary)
    temporary.chmod(0o644)
    temporary.rename(path)
    content = {
        "format": CARD_FORMAT,
        "architecture": evaluator.architecture,
        "arguments": evaluator.arguments,
        "precision": "float16" if half else "float32",
        **(card or {}),
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
    }
    path.with_suffix(".json").write_text(json.dumps(content, indent=2) + "\n")
    return path


def read_evaluator(path: Path, find_class: Callable[[str], type[GraspEvaluator]]) -> GraspEvaluator:
    """Read the files of `save_evaluator`.

    Args:
        path: The .safetensors file; its card lies beside it.
        find_class: Gives the class of an architecture by its name.

    Returns:
        The evaluator in eval mode, float32, on the CPU.

    Raises:
        FileNotFoundError: The weights, their card, or a file that they need do not exist.
        ValueError: The file is a pickle, damaged, not the card's, or of another architecture than the card says.
    """
    if not path.is_file():
        raise FileNotFoundError(f"weights {path} do not exist; give a model's name ({', '.join(MODELS)}) or a file")
    with path.open("rb") as file:
        start = file.read(4)
    if path.suffix in _PICKLE_SUFFIXES or start.startswith(_PICKLE_STARTS):
        raise ValueError(f"{path} is a pickle, which could run code, and was not read; give a .safetensors file")
    card = read_card(path)
    try:
        weights = load_file(path)
    except SafetensorError as error:
        raise ValueError(f"{path} is truncated or not a safetensors file ({error}); fetch or save it again") from None
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    if sha256 != card.get("sha256"):
        raise ValueError(f"{path} does not match the sha256 in its card; fetch or save both again")
    cls = find_class(card["architecture"])
    try:
        evaluator = cls(**card["arguments"])
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path.with_suffix('.json')}: {cls.__name__} refuses its arguments: {error}") from None
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{path.with_suffix('.json')} names what is not there: {error}") from None
    load_weights(evaluator, weights, path)
    evaluator.sha256, evaluator.num_bytes = sha256, path.stat().st_size
    return evaluator.eval()


def load_weights(
    evaluator: GraspEvaluator,
    weights: Mapping[str, torch.Tensor],
    path: str | Path,
    arguments: Mapping[str, Any] | None = None,
) -> None:
    """Put weights into an evaluator.

    Args:
        evaluator: The model that takes them.
        weights: Tensors by name.
        path: File that the weights come from, for errors.
        arguments: Constructor arguments of the evaluator that the weights come from, if it is of the same class; an
            error names those that differ.

    Raises:
        ValueError: The weights are of another architecture or size.
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
            if value != asked.get(name) and name != "optimizer" and not isinstance(value, float)
        ]
        tensors = f"{len(odd)} tensors such as {odd[0]}, {size(weights, odd[0])} in the file and {size(own, odd[0])}"
        raise ValueError(
            f"{path} holds another architecture than {evaluator.architecture} as configured, by "
            f"{'; '.join(differ) or f'{tensors} as configured'}; use the configuration that it was trained with"
        )
    evaluator.load_state_dict({name: value.to(own[name].dtype) for name, value in weights.items()})

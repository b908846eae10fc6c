"""Write docs/cards/NAME.md for every model that comes with weights.

python benchmarks/cards.py
The description comes from the docstring of the class, training data and limits from assets/checkpoints/NAME.json, the
frozen trunk from the trunk's own card there, and the figures from benchmarks/results/comparison.json.
"""

import inspect
from typing import Any

from tables import ROOT, read, table

from dexzoo.comparison.report import cost_table, main_table, title
from dexzoo.comparison.scores import COIN, GM
from dexzoo.models.registry import list_models, shipped_card
from dexzoo.models.trunks import trunk_card
from dexzoo.models.zoo import load, model_class

CARDS = ROOT / "docs" / "cards"
TRUNK = ("trunk", "source", "license", "paper", "data", "sha256")
"""Entries of a trunk's card that are shown, if it has them."""
SECTIONS = ("Args:", "Attributes:", "Raises:")
"""Headings that end the description of the model in a class's docstring."""
USE = """\
```python
evaluator = dexzoo.load("{name}")
p = evaluator.score(grasps, observation)  # (num_grasps,) probabilities of success
logit = evaluator.prepare(observation).logit(grasps)
```

Input: one depth image with its camera (`dexzoo.Observation`) and grasps (`dexzoo.Grasps`) in the world frame of the
observation. The object is segmented and the camera is turned to it; the network receives 224 x 224 pixels of depth and
of height over the table, in meters. A grasp has a type and ten waypoints with the wrist position in meters, the wrist
quaternion wxyz and 20 joint angles in radians. Output: the probability that each grasp holds. `logit` returns log-odds,
differentiable in the grasps.
"""


def main() -> None:
    CARDS.mkdir(exist_ok=True)
    for name in shipped():
        (CARDS / f"{name}.md").write_text(page(name))


def shipped() -> list[str]:
    """Names of the models that come with weights."""
    return [name for name in list_models() if shipped_card(name)]


def page(name: str) -> str:
    """The whole card."""
    card, found = shipped_card(name), read("comparison")
    assert card is not None
    summary, *rest = (inspect.getdoc(model_class(name)) or "").split("\n\n")
    # the part before the arguments; if they have no heading, the last paragraph lists them
    end = next((i for i, paragraph in enumerate(rest) if paragraph.startswith(SECTIONS)), len(rest) - 1)
    parts = [
        f"# {name}\n\n{summary}\n",
        *(f"{paragraph}\n" for paragraph in rest[:end]),
        "`benchmarks/cards.py` writes this card. Comparison with other models: [results](../results.md). Meaning of "
        "the "
        'columns: [comparing](../comparing.md). "The thesis" is Zhao 2019, see the [README](../../README.md).\n',
        "## Use\n",
        USE.format(name=name),
        "## Trained on\n",
        training(card),
        *trunk(card["arguments"]),
        "## On test objects\n",
        figures(name, found),
        calibration(name),
        "## Limits\n",
        "".join(f"- {limit}\n" for limit in card["limits"]),
        "## File\n",
        f"`assets/checkpoints/{name}.safetensors`, {card['precision']}"
        f"{', without the shared trunk' if 'trunk' in card['arguments'] else ''}; SHA-256 `{card['sha256']}`. "
        f"Arguments: {listed(card['arguments'])}.\n",
    ]
    return "\n".join(parts)


def training(card: dict[str, Any]) -> str:
    """Data, run and validation."""
    data = card["data"]
    settings = {f"{part}, {name}": value for part, own in card.get("config", {}).items() for name, value in own.items()}
    seen = f"{card['grasps_seen']:,}, with repetitions"
    rows = [
        ("grasps", f"{data['train_grasps']:,}"),
        ("grasps seen", seen if card["grasps_seen"] else "by its members only; validation grasps calibrate it"),
        ("grasp set", f"format {data['version']}, SHA-256 of its tables `{data['sha256']}`"),
        ("command", f"`{card['command']}`"),
        ("seed", card["seed"]),
        ("validation", listed({name.removeprefix("validation_"): value for name, value in card["metrics"].items()})),
        *((name, value) for name, value in settings.items() if value is not None),
    ]
    return table(("training", ""), rows)


def trunk(arguments: dict[str, Any]) -> list[str]:
    """Description of the frozen trunk, for a model that has one."""
    if "trunk" not in arguments:
        return []
    name = arguments["trunk"]
    card = trunk_card(name) or {"trunk": f"{name}, downloaded by torchvision"}
    rows = [(key, listed(card[key]) if isinstance(card[key], dict) else card[key]) for key in TRUNK if key in card]
    return [
        "## Frozen trunk\n",
        "Its input is the colorized depth image. No part of it was trained with grasps.\n",
        table(("entry", ""), rows),
    ]


def figures(name: str, found: dict[str, Any]) -> str:
    """Rows of the model, gm and the coin in the comparison; size and speed."""
    if name not in found["cost"]:
        return "Not compared yet: `python benchmarks/comparison.py`.\n"
    parts = ["Intervals are 95 % bootstrap over scenes; p is against gm, the generator's own order.\n"]
    for source, section in found["sources"].items():
        rows = {label: row for label, row in section["rows"].items() if label in (name, GM, COIN)}
        parts += [f"{title(source, section)}:\n", table(*main_table(section | {"rows": rows}))]
    return "\n".join([*parts, table(*cost_table({name: found["cost"][name]}))])


def calibration(name: str) -> str:
    """Conversion of log-odds to probabilities."""
    model = load(name)
    return (
        f"Calibration: probability = sigmoid(logit / temperature + offset), temperature {model.temperature:.3f}, "
        f"offset {model.offset:.3f}.\n"
    )


def listed(values: dict[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in values.items())


if __name__ == "__main__":
    main()

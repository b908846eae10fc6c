"""Write docs/cards/NAME.md for every model that comes with weights.

python benchmarks/cards.py
What it is comes from the class, what it was trained on and its limits from assets/checkpoints/NAME.json, what its
frozen trunk is from the trunk's own card there, its figures from benchmarks/results/comparison.json.
"""

import inspect
from typing import Any

from tables import ROOT, read, table

from dexzoo.comparison.report import cost_table, main_table, title
from dexzoo.comparison.scores import COIN, GM
from dexzoo.models.trunks import trunk_card
from dexzoo.models.zoo import list_models, load, model_class, shipped_card

CARDS = ROOT / "docs" / "cards"
TRUNK = ("trunk", "source", "licence", "paper", "data", "sha256")
"""What is told of a trunk, as far as its card has it."""
USE = """\
```python
evaluator = dexzoo.load("{name}")
p = evaluator.score(observation, grasps)  # (num_grasps,) probabilities of success
logit = evaluator.prepare(observation).logit(grasps.to_frame("world", observation.T_world_camera).waypoints)
```

In: one depth image with its camera (`dexzoo.Observation`; the object is segmented and the camera turned to it: 224 x
224 pixels of depth and of height over the table, metres), and grasps (`dexzoo.Grasps`, (num_grasps, 10, 28): ten
waypoints of wrist position in metres, quaternion wxyz, 20 joint angles in radians, and a type) in the world frame or
the camera's. Out: the probability that each grasp holds; `logit` gives log-odds, differentiable in the grasps.
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
    parts = [
        f"# {name}\n\n{summary}\n",
        *(f"{paragraph}\n" for paragraph in rest[:-1]),  # the last one lists the arguments
        "Written by `benchmarks/cards.py`. How it compares: [results](../results.md). What the columns are: "
        "[comparing](../comparing.md). Which thesis: [README](../../README.md).\n",
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
    seen = f"{card['grasps_seen']:,}, each time that one was drawn counted"
    rows = [
        ("grasps", f"{data['train_grasps']:,}"),
        ("grasps seen", seen if card["grasps_seen"] else "by its members alone; the grasps of validation calibrate it"),
        ("grasp set", f"format {data['version']}, SHA-256 of its tables `{data['sha256']}`"),
        ("command", f"`{card['command']}`"),
        ("seed", card["seed"]),
        ("validation", listed({name.removeprefix("validation_"): value for name, value in card["metrics"].items()})),
        *((name, value) for name, value in settings.items() if value is not None),
    ]
    return table(("what", ""), rows)


def trunk(arguments: dict[str, Any]) -> list[str]:
    """What the frozen trunk is, for a model that has one."""
    if "trunk" not in arguments:
        return []
    name = arguments["trunk"]
    card = trunk_card(name) or {"trunk": f"{name}, fetched by torchvision"}
    rows = [(key, listed(card[key]) if isinstance(card[key], dict) else card[key]) for key in TRUNK if key in card]
    return [
        "## Frozen trunk\n",
        "It sees the colourised depth image; nothing of it was trained with grasps.\n",
        table(("what", ""), rows),
    ]


def figures(name: str, found: dict[str, Any]) -> str:
    """Its rows of the comparison, with gm and the coin beside it; size and speed."""
    if name not in found["cost"]:
        return "Not compared yet: `python benchmarks/comparison.py`.\n"
    parts = ["95 % bootstrap intervals over scenes; p against gm, the generator's own order.\n"]
    for source, section in found["sources"].items():
        rows = {label: row for label, row in section["rows"].items() if label in (name, GM, COIN)}
        parts += [f"{title(source, section)}:\n", table(*main_table(section | {"rows": rows}))]
    return "\n".join([*parts, table(*cost_table({name: found["cost"][name]}))])


def calibration(name: str) -> str:
    """How log-odds become probabilities."""
    model = load(name)
    return (
        f"Calibration: probability = sigmoid(logit / temperature + offset), temperature {model.temperature:.3f}, "
        f"offset {model.offset:.3f}.\n"
    )


def listed(values: dict[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in values.items())


if __name__ == "__main__":
    main()

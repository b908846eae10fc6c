"""Features inside a model: maps of an image (thesis, Fig. 3.5) and principal components of grasps (Fig. 3.6)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor, nn

from dexzoo.comparison.charts import save
from dexzoo.comparison.scores import encoded_views, first_image, one_view
from dexzoo.data.batches import GraspDataset
from dexzoo.data.datamodule import GraspDataModule
from dexzoo.grasp import GRASP_TYPES, Trajectory
from dexzoo.models.encoders import GraspVector, colorize
from dexzoo.models.evaluator import GraspEvaluator

NUM_GRASPS = 1000
BRANCH = "hand_branch"
"""The name of the module, in models that have one, that sees the grasp alone."""
_COLUMNS = 5


def draw_inside(models: Mapping[str, GraspEvaluator], data: GraspDataModule, split: str, folder: Path) -> list[Path]:
    """Write NAME_maps.png and NAME_grasps.png, each for the models that have such maps or features.

    Args:
        models: Models by name.
        data: The grasp set.
        split: Split that is shown.
        folder: Folder to write to.

    Returns:
        Their paths.
    """
    folder.mkdir(parents=True, exist_ok=True)
    image, drawn = first_image(data, split), []
    for name, model in models.items():
        stem = name.strip("/").replace("/", "_")
        maps = feature_maps(model, image)
        if maps is not None:
            drawn.append(save(maps_picture(image, maps), folder / f"{stem}_maps.png"))
        dataset = data.dataset(split, model)
        found = grasp_features(model, dataset)
        if found is not None:
            rows, features = found
            where = "after the hand branch" if BRANCH in dict(model.named_modules()) else "before the last layer"
            picture = components_picture(dataset.aimed(rows), features, dataset.success[rows] > 0.5, where)
            drawn.append(save(picture, folder / f"{stem}_grasps.png"))
    return drawn


@torch.no_grad()
def feature_maps(model: GraspEvaluator, image: Float[Tensor, "1 2 224 224"]) -> Float[Tensor, "channel h w"] | None:
    """The last feature maps that a module of the model gives while it encodes an image.

    Args:
        model: The model.
        image: Image of one view.

    Returns:
        The maps; None if no module gives any.
    """
    with _recorded(list(model.modules())) as outputs:
        model.encode(image.to(model.device))
    maps = [output for output in outputs if output.ndim == 4 and min(output.shape[2:]) > 1]
    return maps[-1][0].float().cpu() if maps else None


@torch.no_grad()
def grasp_features(
    model: GraspEvaluator, dataset: GraspDataset
) -> tuple[Tensor, Float[Tensor, "grasp feature"]] | None:
    """Features of about a thousand grasps.

    They are the output of the module `hand_branch`, or, in a model without, the input of its last linear layer,
    where grasp and image are already joined.

    Args:
        model: The model.
        dataset: The grasps.

    Returns:
        Rows of the grasps, and their features; None if grasps pass neither, as in an ensemble, whose members are
            no modules of its own.
    """
    branch = dict(model.named_modules()).get(BRANCH)
    linear: list[nn.Module] = [module for module in model.modules() if isinstance(module, nn.Linear)]
    rows, features = [], []
    step = max(1, len(dataset) // NUM_GRASPS)
    with _recorded([branch] if branch else linear, inputs=branch is None) as recorded:
        for i, (part, encoding) in enumerate(encoded_views(model, dataset)):
            if i % step == 0:
                recorded.clear()
                model.logit(encoding, one_view(dataset.aimed(part).to(model.device)))
                if not recorded:
                    return None
                rows.append(part)
                features.append(recorded[-1].float().cpu().reshape(len(part), -1))
    return torch.cat(rows), torch.cat(features)


def maps_picture(image: Float[Tensor, "1 2 224 224"], maps: Float[Tensor, "channel h w"]) -> Figure:
    """The image's three channels, and the maps that vary most over it.

    Args:
        image: Image of one view.
        maps: Feature maps of it.
    """
    channels = dict(zip(("depth", "mean curvature", "Gaussian curvature"), colorize(image[:, 0])[0], strict=True))
    shown = maps.flatten(1).std(1).argsort(descending=True, stable=True)[: 4 * _COLUMNS - len(channels)]
    panels = channels | {f"channel {int(i)}": maps[i] for i in shown}
    figure = Figure((2 * _COLUMNS, 8.6), layout="constrained")
    for place, (title, panel) in enumerate(panels.items(), 1):
        axes = figure.add_subplot(4, _COLUMNS, place)
        seen = panel[image[0, 0] > 0] if title in channels else panel
        low, high = np.percentile(seen.numpy(), [1, 99])
        axes.imshow(
            panel.numpy(), cmap="gray" if title in channels else "viridis", vmin=low, vmax=max(high, low + 1e-9)
        )
        axes.set_title(title, fontsize=9)
        axes.set_axis_off()
    return figure


def components_picture(
    grasps: Trajectory, features: Float[Tensor, "grasp feature"], held: Tensor, where: str
) -> Figure:
    """First two principal components of grasps as 280 numbers and as a model's features, by outcome and by type.

    Args:
        grasps: The grasps.
        features: Their features.
        held: Whether each held, (grasp,).
        where: Title of the features.
    """
    vectors = GraspVector.flatten(grasps)
    spaces = {"as 280 numbers": principal_components(vectors), where: principal_components(features)}
    kind = grasps.grasp_type
    colorings = (
        {name: held == value for name, value in (("fails", False), ("holds", True))},
        {GRASP_TYPES[int(value)]: kind == value for value in kind.unique()},
    )
    figure = Figure((9.5, 8), layout="constrained")
    for i, coloring in enumerate(colorings):
        for j, (title, points) in enumerate(spaces.items()):
            axes = figure.add_subplot(2, 2, 1 + 2 * i + j)
            for label, chosen in coloring.items():
                x, y = points[chosen].numpy().T
                axes.scatter(x, y, s=7, alpha=0.6, linewidth=0, label=label)
            axes.set(xticks=[], yticks=[], title=title)
            if j:
                axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5), markerscale=2)
    return figure


def principal_components(values: Float[Tensor, "row column"]) -> Float[Tensor, "row 2"]:
    """The first two principal components of standardized columns; a column that does not vary counts for nothing.

    Args:
        values: Values.
    """
    values = values.double()
    spread = values.std(0)
    values = (values - values.mean(0)) / torch.where(spread > 1e-6, spread, torch.inf)
    # by the rows' inner products: there are fewer rows than features
    power, vectors = torch.linalg.eigh(values @ values.mT)
    first = vectors[:, -2:].flip(1) * power[-2:].flip(0).clamp_min(0).sqrt()
    turned: Tensor = first * torch.where(first.sum(0) < 0, -1.0, 1.0)  # the sign is the solver's whim
    return turned


@contextmanager
def _recorded(modules: list[nn.Module], inputs: bool = False) -> Iterator[list[Tensor]]:
    """The outputs, or the first inputs, of some modules in the order in which they are called."""
    found: list[Tensor] = []

    def keep(_: nn.Module, given: tuple[object, ...], output: object) -> None:
        parts = given[:1] if inputs else output if isinstance(output, tuple) else (output,)
        found.extend(part for part in parts if isinstance(part, Tensor))

    handles = [module.register_forward_hook(keep) for module in modules]
    try:
        yield found
    finally:
        for handle in handles:
            handle.remove()

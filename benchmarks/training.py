"""What encoding a view once is worth, in training and in scoring: ratios of times taken in one run.

python benchmarks/training.py --out benchmarks/results/training.json
EM2 takes a few steps of training with the trunk's features kept, and with each grasp's view going through the trunk in
every step; the first epoch also encodes all views of the set. Then grasps on one view are scored at once, and one by
one, each with the view encoded anew. Times are of the processor, so that other programs do not count; OMP_NUM_THREADS
bounds the threads.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch.nn import functional as F

import dexzoo
from dexzoo.collection.rendering import render
from dexzoo.comparison.scores import one_view, processor
from dexzoo.data.batches import Draw
from dexzoo.data.datamodule import GraspDataModule
from dexzoo.grasp import Trajectory
from dexzoo.models.batch import Batch
from dexzoo.models.em2 import EM2
from dexzoo.models.encoders import fast_bfloat16
from dexzoo.models.evaluator import CHUNK

KEPT_STEPS, TRUNK_STEPS = 16, 2
NUM_VIEWS = 16
NUM_GRASPS, NUM_PAIRS = 1000, 24
NUM_SCENES = 8
"""Training scenes: the time of a step does not depend on how many there are."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", default="assets/grasps")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    data = GraspDataModule(options.data, num_scenes=NUM_SCENES)
    data.renderer = render
    machine = {"threads": torch.get_num_threads(), "processor": processor()}
    result = machine | {"training": training(data), "scoring": scoring(data)}
    text = json.dumps(result, indent=2)
    if options.out:
        options.out.write_text(text + "\n")
    sys.stdout.write(text + "\n")


class TrunkInTheLoop(EM2):
    """EM2 whose views stay images."""

    frozen_encoder = False


def training(data: GraspDataModule) -> dict[str, Any]:
    """Processor seconds for 1,000 grasps of training with features kept and with the trunk in the loop."""
    torch.manual_seed(0)
    model = EM2(gain=1.4142, optimizer="adamw", learning_rate=0.0003, weight_decay=0.01)
    data.fit_statistics(model)
    optimizer = model.configure_optimizers()
    features, images = data.dataset("train", model), data.dataset("train", TrunkInTheLoop())
    batches = list(data.loader(features, balanced=True).sampler)

    def step(batch: Batch) -> None:
        with torch.autocast("cpu", torch.bfloat16, enabled=fast_bfloat16(torch.device("cpu"))):
            loss = F.binary_cross_entropy_with_logits(model.batch_logit(batch), batch.success)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    def with_trunk(draw: Draw) -> None:
        batch = images[draw]
        step(batch._replace(views=model.encode(batch.views[batch.view]), view=torch.arange(len(draw.rows))))

    def per_grasp(work: Callable[[Draw], object], some: list[Draw]) -> float:
        return seconds(work, some) / sum(len(draw.rows) for draw in some)

    kept = per_grasp(lambda draw: step(features[draw]), batches[:KEPT_STEPS])
    trunk = per_grasp(with_trunk, batches[:TRUNK_STEPS])
    view = seconds(lambda row: model.encode(images[row].views), [[row] for row in range(NUM_VIEWS)]) / NUM_VIEWS
    encoding = view * data.source.views.num_rows / data.source.grasps.num_rows  # its part in a grasp of the first epoch
    return {
        "batch_size": data.batch_size,
        "seconds_for_1000_grasps": {"features kept": 1000 * kept, "trunk in the loop": 1000 * trunk},
        "ratio": trunk / kept,
        "ratio_in_the_first_epoch": trunk / (kept + encoding),
    }


def scoring(data: GraspDataModule) -> dict[str, Any]:
    """Processor seconds for 1,000 grasps on one view, at once and pair by pair."""
    model = dexzoo.load("em2")
    image = data.source.images([0])[torch.tensor([0])]
    grasps = data.aimed_grasps[torch.arange(NUM_GRASPS) % len(data.aimed_grasps)]

    @torch.no_grad()
    def score(part: Trajectory) -> None:
        encoding = model.encode(image)
        for some in part.split(CHUNK):
            model.logit(encoding, one_view(some))

    once = seconds(score, [grasps])
    pairs = NUM_GRASPS / NUM_PAIRS * seconds(score, grasps[:NUM_PAIRS].split(1))
    return {"seconds_for_1000_grasps": {"view encoded once": once, "pair by pair": pairs}, "ratio": pairs / once}


def seconds(work: Callable[[Any], object], parts: list[Any]) -> float:
    """Processor seconds of the work on all parts, after it was done once on the first."""
    work(parts[0])
    start = time.process_time()
    for part in parts:
        work(part)
    return time.process_time() - start


if __name__ == "__main__":
    main()

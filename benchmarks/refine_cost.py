"""What refinement costs: time and memory against the number of grasps, and the time of each term.

python benchmarks/refine_cost.py --evaluator RUN --out benchmarks/results/refinement_cost.json
One view of a fork on a block, so that every term has something to look at; its grasps over and over where more are
wanted. The density behind the prior is made once for a view and stands apart. OMP_NUM_THREADS bounds the threads; run
it with nothing else at work.
"""

import argparse
import json
import resource
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from generator import FORGET_PEAK, kopicki, set_scene
from generator_figures import COSTS

import dexzoo
from dexzoo.refinement import Term, default_terms

SCENE = 3
NUM_STEPS, FEW_STEPS = 20, 2
SIZES = (100, 300, 1_000, 3_000, 10_000)
"""Numbers of grasps, refined in few steps."""
REPEATS = 3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--evaluator", default="em_fk", help="name, file or folder")
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    _, view, seed, _ = set_scene("test", None, SCENE)
    generator = kopicki()
    grasps = generator.generate(view, 100, seed)
    model = dexzoo.load(options.evaluator)
    density = generator.density(view, seed)

    def refine(num: int = 100, num_steps: int = NUM_STEPS, terms: list[Term] | None = None) -> None:
        some = grasps[np.arange(num) % len(grasps)]
        dexzoo.refine(some, view, model, num_steps=num_steps, terms=terms, prior=density)

    refine(num_steps=FEW_STEPS)  # what is loaded and compiled on the way counts for none
    log_odds, *others = default_terms(model, density)
    alone = least(partial(refine, terms=[log_odds]))
    terms = {}
    for term in others:
        only = least(partial(refine, terms=[log_odds, term]))
        terms[term.name] = only["processor_seconds"] - alone["processor_seconds"]
    result = {
        "evaluator": options.evaluator,
        "threads": torch.get_num_threads(),
        "num_steps": NUM_STEPS,
        "few_steps": FEW_STEPS,
        "density": least(lambda: generator.density(view, seed)),
        "whole": least(refine),
        "evaluator_alone": alone,
        "processor_seconds_of_terms": terms,
        "growth": [{"grasps": num} | measured(partial(refine, num, FEW_STEPS)) for num in options.sizes],
    }
    text = json.dumps(result, indent=2)
    if options.out:
        options.out.write_text(text + "\n")
    sys.stdout.write(text + "\n")


def least(work: Callable[[], Any]) -> dict[str, float]:
    """The quickest of several runs."""
    return min((measured(work) for _ in range(REPEATS)), key=lambda cost: cost["processor_seconds"])


def measured(work: Callable[[], Any]) -> dict[str, float]:
    FORGET_PEAK.write_text("5")
    start = time.perf_counter(), time.process_time()
    work()
    megabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    spent = time.perf_counter() - start[0], time.process_time() - start[1], megabytes
    return dict(zip(COSTS, spent, strict=True))


if __name__ == "__main__":
    main()

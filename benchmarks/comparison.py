"""Which evaluator to use: the table of docs/results.md, on the test objects of a grasp set.

python benchmarks/comparison.py                 # all models that come with weights
python benchmarks/comparison.py em2 runs/em_fk/version_0 --data my_grasps
Writes benchmarks/results/comparison.json, and the pictures to docs/comparison. The same as `python -m dexzoo compare`.
"""

import argparse
import json
import sys
from pathlib import Path

from dexzoo.collection.rendering import render
from dexzoo.comparison.charts import draw_charts
from dexzoo.comparison.compare import compare, load_models
from dexzoo.comparison.inside import draw_inside
from dexzoo.comparison.report import markdown
from dexzoo.data.datamodule import GraspDataModule
from dexzoo.data.schema import SPLITS

ROOT = Path(__file__).parent.parent
SHOWN = ("em2", "em_fk")
"""Whose inside is drawn: the thesis' (its Fig. 3.5 and 3.6) and ours."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*")
    parser.add_argument("--data", default="assets/grasps")
    parser.add_argument("--split", default="test", choices=SPLITS)
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "comparison.json")
    parser.add_argument("--charts", type=Path, default=ROOT / "docs" / "comparison")
    options = parser.parse_args()
    models, data = load_models(options.models), GraspDataModule(options.data)
    data.renderer = render
    result = compare(models, data, options.split)
    options.out.write_text(json.dumps(result, indent=2, allow_nan=False) + "\n")
    options.charts.mkdir(parents=True, exist_ok=True)
    draw_charts(result, options.charts)
    draw_inside({name: model for name, model in models.items() if name in SHOWN}, data, options.split, options.charts)
    sys.stdout.write(markdown(result))


if __name__ == "__main__":
    main()

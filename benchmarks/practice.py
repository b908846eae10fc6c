"""Autonomous training: let the Kopicki generator practise on training objects, and keep what held as demonstrations.

python benchmarks/practice.py --out out/practised --num_objects 60
Objects that were practised on already are passed over, so that a run can be continued. At the end, `--out` holds the
shipped demonstrations and those that differ from them and from each other.
"""

import argparse
import shutil
import sys
from pathlib import Path

from dexzoo.collection.collect import object_of
from dexzoo.collection.practice import practise
from dexzoo.generators.demonstration import distinct, load_demonstrations
from dexzoo.generators.kopicki import KopickiGenerator
from dexzoo.grasp import GRASP_TYPES
from dexzoo.hand import Hand


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--num_objects", type=int, default=60)
    parser.add_argument("--max_per_type", type=int, default=8)
    options = parser.parse_args()
    shipped = load_demonstrations(hand := Hand.load())
    generator = KopickiGenerator(shipped, num_per_type=20)
    for number in range(options.num_objects):
        name = object_of(number, "train")
        folder = options.out / "tried" / f"{number:03d}_{name}"
        if folder.exists():
            continue
        unfinished = folder.with_name(f".{folder.name}")
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.mkdir(parents=True)
        learned = list(practise(generator, name, seed=number))
        for place, one in enumerate(learned):
            one.save(unfinished / f"{place}.safetensors")
        unfinished.rename(folder)
        sys.stderr.write(f"{name}: {len(learned)}\n")
    found = [
        one
        for folder in sorted((options.out / "tried").iterdir())
        if any(folder.glob("*.safetensors"))
        for one in load_demonstrations(hand, str(folder))
    ]
    for number, one in enumerate(distinct([*shipped, *found], options.max_per_type)):
        one.save(options.out / f"{number:03d}_{GRASP_TYPES[one.grasp_type]}.safetensors")


if __name__ == "__main__":
    main()

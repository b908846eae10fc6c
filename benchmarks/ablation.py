"""What each ingredient, more data, width and recipe bring: runs of `dexzoo fit`, and their figures on the test objects.

python benchmarks/ablation.py --list
python benchmarks/ablation.py --runs em_fk em_fk-image --folder runs/ablation     # any of them, in any order, anywhere
python benchmarks/ablation.py --done                                              # sum up the runs that are finished
Each run has a folder of its own: one that was killed goes on from its last checkpoint. Of a finished run there is a
file in `--results` with its log-odds on the test grasps; it is not repeated, and its folder is needed no longer. The
figures of all go into a JSON beside `--results`.
All see as many grasps, `--grasps`, in batches of their configurations' size, whatever data they have; ten times on
the way the averaged weights are validated, and the best are kept. The test objects choose nothing. Intervals are 95 %
bootstrap over scenes, also of the difference from the run that a row is compared with.
"""

import argparse
import json
import shutil
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import yaml
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.torch import save_file

import dexzoo
from dexzoo.collection.rendering import render
from dexzoo.comparison.figures import draw_scenes, figures, with_interval
from dexzoo.comparison.scores import Labels, Scores, model_scores, read_labels
from dexzoo.data.datamodule import GraspDataModule
from dexzoo.data.schema import SOURCES
from dexzoo.resources import resource
from dexzoo.training import command_line

NUM_VALIDATIONS = 10
REFINED = "refined"
THESIS_DROPOUT = 0.5
Replicates = NDArray[np.float64]
FIGURES = ("accuracy", "auroc", "scene_auroc", "average_precision", "calibration_error", "top1", "top5")


class Run(NamedTuple):
    """config: its file. changes: what differs from it, by PART.NAME. against: the run that it is compared with."""

    config: str
    changes: dict[str, Any]
    against: str | None = None


def runs() -> dict[str, Run]:
    """All runs by name: whole models, then NAME-WHAT without an ingredient, NAME@PERCENT on less data, NAME+VARIANT.

    But for em_fk+refined they go without refined grasps, which were made with the help of all training scenes; the
    thesis' recipe takes generated grasps alone.
    """
    base = {"data.sources": [source for source in SOURCES if source != REFINED]}
    whole = {"em_fk": "em_fk.yaml", "em2": "em2-adamw.yaml", "em1": "em1-adamw.yaml"}
    known = {name: Run(config, base) for name, config in whole.items()}
    for part in ("image", "depth", "cloud", "table", "motion", "attention"):
        known[f"em_fk-{part}"] = Run("em_fk.yaml", base | {f"model.{part}": False}, "em_fk")
    known["em_fk-perturbed"] = Run("em_fk.yaml", {"data.sources": SOURCES[:1]}, "em_fk")
    for share in (10, 30):
        for name, config in whole.items():
            known[f"{name}@{share}"] = Run(config, base | {"data.train_share": share / 100}, name)
    known["em_fk+refined"] = Run("em_fk.yaml", {"data.sources": SOURCES}, "em_fk")
    known["em_fk+seed"] = Run("em_fk.yaml", base | {"seed_everything": 1, "data.seed": 1}, "em_fk")
    known["em2+4096"] = Run("em2-adamw.yaml", base | {"model.width": 4096}, "em2")
    for name in ("em1", "em2"):
        known[f"{name}+dropout"] = Run(whole[name], base | {"model.dropout": THESIS_DROPOUT}, name)
    known["em1+thesis"] = Run("em1.yaml", {}, "em1")
    known["em2+thesis"] = Run("em2.yaml", {}, "em2")
    return known


def main() -> None:
    known = runs()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", nargs="+", metavar="NAME", default=list(known), help="default: all, in this order")
    parser.add_argument("--done", action="store_true", help="run nothing more, sum up what the results hold")
    parser.add_argument("--list", action="store_true", help="name the runs, and which are finished")
    parser.add_argument("--grasps", type=int, default=150_000, help="that each run sees in training")
    parser.add_argument("--data", default="assets/grasps")
    parser.add_argument("--folder", type=Path, default=Path("runs/ablation"))
    parser.add_argument("--results", type=Path, default=Path("benchmarks/results/ablation"))
    options = parser.parse_args()
    if unknown := set(options.runs) - set(known):
        parser.error(f"runs {', '.join(sorted(unknown))} are unknown; use some of {', '.join(known)}")
    if options.list:
        for name in known:
            sys.stdout.write(f"{name:16} {'finished' if result(options.results, name).exists() else ''}\n")
        return
    if options.done:
        figures_of_all = measured(options.results, known, options.data)
        options.results.with_suffix(".json").write_text(json.dumps(figures_of_all, indent=2, allow_nan=False) + "\n")
        return
    for name in options.runs:
        path = result(options.results, name)
        if not path.exists():
            fit(options.folder / name, known[name], options.data, options.grasps)
            keep(options.folder / name, options.results, options.data)
        elif read(path)[0]["config"] != configuration(known[name], options.data, options.grasps):
            parser.error(f"{path} differs from what is asked for; go on with the same options or give other --results")


def result(results: Path, name: str) -> Path:
    """The file of a finished run."""
    return results / f"{name}.safetensors"


def read(path: Path) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """What the run of such a file was, and its log-odds by source."""
    with safe_open(path, "pt") as file:
        return json.loads(file.metadata()["row"]), {source: file.get_tensor(source) for source in file.keys()}  # noqa: SIM118


def finished(folder: Path) -> bool:
    """Whether fit has written the run's card, which comes last."""
    return any(folder.glob("*.safetensors")) and any(folder.glob("*.json"))


def asked(folder: Path) -> Path:
    """The file with what was asked of a run, beside its folder."""
    return folder.with_name(f"{folder.name}.yaml")


def fit(folder: Path, run: Run, data: str, grasps: int) -> None:
    """Do a run, or what is left of it. ValueError where the folder holds a run of another configuration."""
    file, text = asked(folder), yaml.safe_dump(configuration(run, data, grasps), sort_keys=False)
    if file.exists() and file.read_text() != text:
        raise ValueError(f"{file} differs from what is asked for; go on with the same options or give another --folder")
    if finished(folder):
        return
    last = folder / "checkpoints" / "last.ckpt"
    resumed = ["--ckpt_path", str(last)] if last.exists() else []
    if not resumed:
        shutil.rmtree(folder, ignore_errors=True)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    place = {"save_dir": folder.parent, "name": "", "version": folder.name}
    logger = [f"--trainer.logger.init_args.{name}={value}" for name, value in place.items()]
    command_line.main(["fit", "--config", str(file), *logger, *resumed])


def configuration(run: Run, data: str, grasps: int) -> dict[str, Any]:
    """The shipped configuration with the run's changes, its length counted in grasps, not stopped early."""
    config: dict[str, Any] = yaml.safe_load((resource("configs") / run.config).read_text())
    for key, value in run.changes.items():
        part, _, name = key.rpartition(".")
        place = {"": config, "data": config["data"], "model": config["model"]["init_args"]}[part]
        place[name] = value
    config["data"]["folder"] = data
    steps = max(1, grasps // config["data"]["batch_size"])
    interval = max(1, steps // NUM_VALIDATIONS)
    trainer = config["trainer"]
    trainer |= {"max_epochs": -1, "max_steps": steps, "val_check_interval": interval, "check_val_every_n_epoch": None}
    trainer["callbacks"] = [one for one in trainer["callbacks"] if "EarlyStopping" not in one["class_path"]]
    for one in trainer["callbacks"]:
        one["init_args"]["enable_version_counter"] = False  # what a killed part left is written over
        if one["init_args"]["filename"] == "last":
            one["init_args"]["every_n_train_steps"] = interval
    return config


def opened(address: str) -> GraspDataModule:
    """A grasp set whose views are rendered where it keeps no images."""
    data = GraspDataModule(address)
    data.renderer = render
    return data


def keep(folder: Path, results: Path, address: str) -> None:
    """Write what a run was, and its log-odds on the test grasps of each source, into the results.

    ValueError for a run that saw another grasp set.
    """
    data = opened(address)
    card = json.loads(next(folder.glob("*.json")).read_text())
    if card["data"]["sha256"] != data.source.sha256:
        raise ValueError(f"{folder} was trained on another grasp set than {data.folder}; run it anew")
    model = dexzoo.load(folder)
    row = {
        "config": yaml.safe_load(asked(folder).read_text()),
        "data": card["data"]["sha256"],
        "train_grasps": card["data"]["train_grasps"],
        "validation_auroc": card["metrics"]["validation_auroc"],
        "temperature": float(model.temperature),
        "offset": float(model.offset),
    }
    logits = {
        source: torch.from_numpy(model_scores(model, data.dataset("test", model, [source]), folder.name).score)
        for source in SOURCES
        if len(data.rows("test", [source]))
    }
    path = result(results, folder.name)
    results.mkdir(parents=True, exist_ok=True)
    save_file(logits, path.with_suffix(".part"), {"row": json.dumps(row)})
    path.with_suffix(".part").replace(path)


def measured(results: Path, known: dict[str, Run], address: str) -> dict[str, Any]:
    """The figures of all finished runs on the test objects. ValueError for a run on other data or of another kind."""
    data = opened(address)
    labels = {source: found for source in SOURCES if (found := read_labels(data, "test", source))}
    replicates: dict[str, dict[str, Replicates]] = {}
    rows: dict[str, Any] = {}
    for name in [name for name in known if result(results, name).exists()]:
        row, logits = read(result(results, name))
        config = row["config"]
        grasps_seen = config["trainer"]["max_steps"] * config["data"]["batch_size"]
        if row["data"] != data.source.sha256:
            raise ValueError(f"{result(results, name)} is of another grasp set than {data.folder}; run it anew")
        if config != configuration(known[name], config["data"]["folder"], grasps_seen):
            raise ValueError(f"{result(results, name)} differs from what is asked for now; remove it and run it anew")
        replicates[name] = {
            source: replicated(labels[source], logit, torch.sigmoid(logit / row["temperature"] + row["offset"]))
            for source, logit in logits.items()
        }
        rows[name] = {
            "grasps_seen": grasps_seen,
            "train_grasps": row["train_grasps"],
            "validation_auroc": row["validation_auroc"],
            "figures": {source: with_intervals(found) for source, found in replicates[name].items()},
        }
    for name, row in rows.items():
        against = known[name].against
        if against in rows:
            differences = {
                source: {key: found[key] - replicates[against][source][key] for key in FIGURES}
                for source, found in replicates[name].items()
            }
            row |= {"against": against, "change": {key: with_intervals(one) for key, one in differences.items()}}
    sizes = {source: {"grasps": len(one.success), "scenes": one.num_scenes} for source, one in labels.items()}
    return {"data": data.source.sha256, "test": sizes, "runs": rows}


def replicated(labels: Labels, logit: torch.Tensor, probability: torch.Tensor) -> dict[str, Replicates]:
    """Each figure (1 + draw,), first of the scenes as they are, then of each draw of scenes."""
    scores = Scores(logit.numpy(), 0.5, probability.numpy())
    found = figures(labels, scores, draw_scenes(labels.num_scenes, seed=0))
    return {key: found[key] for key in FIGURES}


def with_intervals(found: dict[str, Replicates]) -> dict[str, Any]:
    """Value and 95 % interval of each figure."""
    return {key: with_interval(replicates) for key, replicates in found.items()}


if __name__ == "__main__":
    main()

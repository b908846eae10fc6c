"""The command line, called in-process: results for people and machines, and one line for each wrong call."""

import importlib
import inspect
import json
import os
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import synthetic
import torch
import trimesh
from safetensors.torch import load_file, save_file
from torch import Tensor

from dexzoo import planning, verification
from dexzoo.cli import arguments
from dexzoo.cli import collect as collect_command
from dexzoo.cli import refine as refine_command
from dexzoo.cli.main import COMMANDS, TRAINING, main
from dexzoo.collection import collect as collecting
from dexzoo.comparison import scores
from dexzoo.data import schema
from dexzoo.generators import GENERATORS, HeuristicGenerator
from dexzoo.grasp import GRASP_TYPES, GRIP, Grasps, Trajectory
from dexzoo.hand import Hand
from dexzoo.models import registry
from dexzoo.models.batch import Encoding
from dexzoo.models.em2 import EM2
from dexzoo.perception import Observation
from dexzoo.refinement import OPTIMIZERS, refinement
from dexzoo.sim import Scene
from dexzoo.training import command_line

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a command; gives the exit status, what it wrote and its errors."""

    def call(*args: object) -> tuple[int, str, str]:
        status = main([str(arg) for arg in args])
        return status, *capsys.readouterr()

    return call


@pytest.fixture(autouse=True)
def fewer_candidates(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planning, "make_generator", lambda name, hand: HeuristicGenerator(hand, 500))


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An EM2 that has learned nothing yet."""
    torch.manual_seed(0)
    return EM2(width=16).save(tmp_path_factory.mktemp("weights"))


@pytest.fixture(scope="session")
def frame(can_view: Observation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with depth.npy in meters, depth.png in tenths of a millimeter, and a camera file for each."""
    folder = tmp_path_factory.mktemp("frame")
    np.save(folder / "depth.npy", can_view.depth)
    cv2.imwrite(str(folder / "depth.png"), (can_view.depth / 1e-4).round().astype(np.uint16))
    camera = can_view.camera
    values = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    values["T_world_camera"] = can_view.T_world_camera.tolist()
    (folder / "camera.json").write_text(json.dumps(values))
    (folder / "scaled.json").write_text(json.dumps(values | {"depth_scale": 1e-4}))
    return folder


@pytest.fixture
def observed(frame: Path, weights: Path) -> list[object]:
    """The options that name the observation and the model."""
    return ["--depth", frame / "depth.npy", "--camera", frame / "camera.json", "--evaluator", weights]


@pytest.fixture(scope="session")
def some_grasps(can_grasps: Grasps, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file with six grasps of the can."""
    path = tmp_path_factory.mktemp("grasps") / "grasps.safetensors"
    can_grasps[:6].save(path)
    return path


# plan


def test_plan_ranks_grasps(run: Run, observed: list[object], can_scene: Scene) -> None:
    status, out, err = run("plan", *observed, "--num_grasps", 12, "--json")
    assert (status, err) == (0, "")
    rows = json.loads(out)["grasps"]
    assert 0 < len(rows) <= 12
    assert [row["rank"] for row in rows] == list(range(1, len(rows) + 1))
    scores = [row["score"] for row in rows]
    assert scores == sorted(scores, reverse=True)
    assert all(0 <= score <= 1 for score in scores)
    assert sorted(row["generator_rank"] for row in rows) == list(range(1, len(rows) + 1))
    assert {row["type"] for row in rows} <= set(GRASP_TYPES)
    assert all(row["refined"] == row["score"] for row in rows)
    palms = np.array([row["palm"] for row in rows])
    assert (palms[:, 2] > 0).all(), "above the table"
    assert (np.linalg.norm(palms - can_scene.T_world_object[:3, 3], axis=1) < 0.35).all(), "at the object"


def test_plan_writes_a_folder(
    run: Run, frame: Path, weights: Path, tmp_path: Path, can_view: Observation, hand: Hand
) -> None:
    out = tmp_path / "new" / "plan"
    observation = ["--depth", frame / "depth.png", "--camera", frame / "scaled.json", "--evaluator", weights]
    status, text, err = run("plan", *observation, "--num_grasps", 8, "--refine", "--out", out)
    assert (status, err) == (0, "")
    assert "the ten best" in text
    written = ["best_grasp.png", "grasps.safetensors", "plan.json", "refined.png"]
    assert sorted(path.name for path in out.iterdir()) == written
    plan = json.loads((out / "plan.json").read_text())
    grasps = Grasps.load(out / "grasps.safetensors")
    assert plan["frame"] == "world"
    np.testing.assert_array_equal(plan["T_world_camera"], can_view.T_world_camera)
    assert grasps.hand == hand
    assert len(grasps) == len(plan["grasps"])
    np.testing.assert_allclose(grasps.position[:, GRIP], [row["palm"] for row in plan["grasps"]], atol=1e-4)
    picture = cv2.imread(str(out / "best_grasp.png"))
    assert picture.shape[1] > 2 * picture.shape[0]


def test_a_plan_is_refined_and_verified_as_it_is(
    run: Run, observed: list[object], can_scene: Scene, tmp_path: Path
) -> None:
    """The three commands agree on the frame: what plan writes holds in the scene that was observed."""
    assert run("plan", *observed, "--num_grasps", 30, "--out", tmp_path / "plan")[0] == 0
    grasps = ["--grasps", tmp_path / "plan" / "grasps.safetensors"]
    refined = tmp_path / "refined.safetensors"
    status, out, err = run("refine", *observed, *grasps, "--num_steps", 2, "--out", refined, "--json")
    assert (status, err) == (0, "")
    planned = json.loads((tmp_path / "plan" / "plan.json").read_text())["grasps"]
    assert json.loads(out)["score_before"] == pytest.approx([row["score"] for row in planned], abs=2e-4)
    for path in (grasps[1], refined):
        status, out, err = run("verify", "--object", can_scene.object.name, "--grasps", path, "--json")
        assert (status, err) == (0, "")
        rows = json.loads(out)["grasps"]
        assert [row["type"] for row in rows] == [row["type"] for row in planned]
        held = verification.verify(Grasps.load(path), can_scene).success
        assert [row["success"] for row in rows] == held.tolist()
        assert held.any()


def test_plan_repeats_itself(run: Run, observed: list[object]) -> None:
    first, again, other = (run("plan", *observed, "--num_grasps", 5, "--json", "--seed", seed) for seed in (1, 1, 2))
    assert first == again
    assert first[1] != other[1]


def test_no_feasible_grasp_is_a_failure_of_the_work(
    run: Run, observed: list[object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(planning, "make_generator", lambda name, hand: HeuristicGenerator(hand, 1))
    status, out, err = run("plan", *observed, "--out", tmp_path / "out")
    assert (status, out) == (1, "")
    assert err == "dexzoo: no feasible grasp is found: the object may be too large, too flat or out of reach\n"
    assert not (tmp_path / "out").exists()


# refine, verify, collect, models


def test_refine_improves_a_file_of_grasps(run: Run, observed: list[object], some_grasps: Path, tmp_path: Path) -> None:
    args = ["--grasps", some_grasps, "--num_steps", 3, "--out", tmp_path / "new" / "better"]
    status, out, err = run("refine", *observed, *args, "--json")
    assert (status, err) == (0, "")
    result = json.loads(out)
    assert result["num_grasps"] == 6
    assert set(result["accepted"]) <= set(range(6))
    assert result["failed"] == []
    assert len(result["score_before"]) == len(result["score_after"]) == 6
    assert result["mean_score_before"] == pytest.approx(np.mean(result["score_before"]), abs=1e-4)
    assert len(Grasps.load(tmp_path / "new" / "better")) == 6


def test_refine_asks_a_judge_and_draws_what_it_did(
    run: Run, observed: list[object], some_grasps: Path, tmp_path: Path
) -> None:
    args = ["--grasps", some_grasps, "--optimizer", "random", "--num_steps", 4, "--seed", 3]
    picture = tmp_path / "new" / "before and after.png"
    indifferent = EM2(width=16)
    with torch.no_grad():
        for parameter in indifferent.parameters():
            parameter.zero_()
    judge = ["--judge", indifferent.save(tmp_path / "judge")]
    status, out, err = run("refine", *observed, *args, *judge, "--picture", picture, "--json")
    assert (status, err) == (0, "")
    assert json.loads(out)["accepted"] == []  # it finds no grasp better
    assert cv2.imread(str(picture)).shape[1] > 2 * 460
    first, again = (run("refine", *observed, *args, "--json") for _ in range(2))
    assert first == again
    assert json.loads(first[1])["accepted"]
    refused(
        run("refine", *observed, *args, "--judge", observed[-1]), "the judge is, or shares a member with, what guides"
    )


def test_refine_does_without_a_prior_if_asked(
    run: Run, observed: list[object], some_grasps: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_generator(name: str, hand: Hand) -> None:
        raise RuntimeError(f"the prior is that of {name}")

    monkeypatch.setattr(refinement, "make_generator", no_generator)
    args = ["--grasps", some_grasps, "--num_steps", 0]
    assert run("refine", *observed, *args, "--prior", "none")[0] == 0
    assert run("refine", *observed, *args) == (1, "", "dexzoo: the prior is that of kopicki\n")


def test_scores_that_are_none_are_null_in_json(
    run: Run, observed: list[object], some_grasps: Path, weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def valid(text: str) -> Any:  # noqa: ANN401
        return json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))

    everywhere, whole = False, EM2.logit

    def broken(model: EM2, encoding: Encoding, grasps: Trajectory) -> Tensor:
        logit = whole(model, encoding, grasps)
        return logit + torch.nan if everywhere else logit + torch.where(logit == logit[:, :1], torch.nan, 0.0)

    monkeypatch.setattr(EM2, "logit", broken)
    args = ["--grasps", some_grasps, "--num_steps", 0, "--json"]
    result = valid(run("refine", *observed, *args)[1])
    assert result["score_before"][0] is None
    assert result["mean_score_before"] == pytest.approx(np.mean(result["score_before"][1:]), abs=1e-4)
    everywhere = True
    assert valid(run("refine", *observed, *args)[1])["mean_score_after"] is None
    assert valid(run("plan", *observed, "--num_grasps", 3, "--json")[1])["grasps"][0]["score"] is None
    assert "none" in run("plan", *observed, "--num_grasps", 3)[1]
    args = ["--object", "can_02", "--num_grasps", 2, "--evaluator", weights, "--json"]
    assert valid(run("verify", *args)[1])["grasps"][0]["score"] is None


def test_verify_generates_and_tries(run: Run, weights: Path) -> None:
    args = ["--object", "can_02", "--num_grasps", 10, "--evaluator", weights]
    status, out, err = run("verify", *args, "--json")
    assert (status, err) == (0, "")
    result = json.loads(out)
    rows = result["grasps"]
    assert result["object"] == "can_02"
    assert result["num_grasps"] == len(rows) == 10
    assert result["hold"] == sum(row["success"] for row in rows)
    assert result["success_rate"] == pytest.approx(result["hold"] / 10)
    held = [row["rank"] for row in rows if row["success"]]
    assert result["first_that_holds"] == (held[0] if held else None)


def test_verify_tries_a_file_of_grasps_on_a_mesh(run: Run, some_grasps: Path, tmp_path: Path) -> None:
    mesh = tmp_path / "tin.stl"
    trimesh.creation.cylinder(0.035, 0.1, sections=24).export(mesh)
    args = ["--object", mesh, "--hulls", mesh, "--mass", 0.1, "--grasps", some_grasps]
    status, out, err = run("verify", *args, "--trials", 2)
    assert (status, err) == (0, "")
    assert "verification of tin" in out
    assert "success rate" in out


def test_collect_makes_a_set_and_goes_on(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(collecting, "make_generator", lambda name, hand: HeuristicGenerator(hand, 300))
    monkeypatch.setattr(collecting, "object_of", lambda number, split: "can_02")
    monkeypatch.setattr(collecting, "in_processes", lambda function, numbers, workers: map(function, numbers))
    args = ["collect", "--out", tmp_path, "--num_grasps", 10, "--num_views", 1]
    for count in (1, 2):
        status, out, err = run(*args, "--scenes", count, "--json")
        assert (status, err) == (0, "")
        counts = json.loads(out)
        assert counts["out"] == str(tmp_path)
        assert counts["scenes"] + sum(counts["skipped"].values()) == count
    assert {path.name for path in tmp_path.iterdir()} == {"manifest.json", "objects", "scenes", "views", "grasps"}
    status, out, err = run(*args, "--scenes", 2, "--seed", 1)
    assert (status, out) == (2, "")
    assert "was made with seed 0, not 1" in err


def test_models_are_listed(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    status, out, err = run("models", "--json")
    assert (status, err) == (0, "")
    rows = json.loads(out)["models"]
    assert [row["name"] for row in rows] == registry.list_models()
    assert all(row["shipped"] for row in rows)
    status, out, err = run("models")
    assert (status, err) == (0, "")
    assert all(name in out for name in registry.list_models())
    monkeypatch.setattr(registry, "shipped_weights", lambda name: Path("none.safetensors"))
    status, out, err = run("models")
    assert (status, err) == (0, "")
    assert registry.how_to_get("em3") in " ".join(out.split())


# help


@pytest.mark.parametrize("args", [["--help"], []])
def test_help_lists_all_commands(run: Run, args: list[str]) -> None:
    status, out, err = run(*args)
    assert (status, err) == (0, "")
    for command in (*TRAINING, *COMMANDS):
        assert command in out


@pytest.mark.parametrize("command", [*COMMANDS, "fit"])
def test_each_command_has_help(run: Run, command: str) -> None:
    status, out, err = run(command, "--help")
    assert (status, err) == (0, "")
    assert "--seed" in out
    assert "--json" in out


def test_help_tells_defaults(run: Run) -> None:
    words = " ".join(run("refine", "--help")[1].split())
    for default in ("em_fk", "kopicki", "adam", "30", "0"):
        assert f"(default: {default})" in words
    assert "(default: None)" not in words
    assert "(default: False)" not in words


@pytest.mark.parametrize("command", COMMANDS)
def test_options_are_the_keywords_of_a_commands_function(
    run: Run, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    parsers: list[arguments.Parser] = []
    whole = arguments.Parser.parse_args

    def remembered(parser: arguments.Parser, args: list[str]) -> object:
        parsers.append(parser)
        return whole(parser, args)

    monkeypatch.setattr(arguments.Parser, "parse_args", remembered)
    assert run(command, "--help")[0] == 0
    options = {action.dest for action in parsers[0]._actions} - {"help"}
    keywords = set(inspect.signature(importlib.import_module(f"dexzoo.cli.{command}").run).parameters)
    assert options == keywords | {"json"}


def test_choices_are_those_of_the_package() -> None:
    """They are written out again in the command line, so that help comes without torch."""
    assert arguments.SPLITS == schema.SPLITS
    assert collect_command.GENERATORS == GENERATORS
    assert tuple(OPTIMIZERS) == refine_command.OPTIMIZERS
    assert refine_command.NUM_STEPS == refinement.NUM_STEPS
    assert TRAINING == command_line.SUBCOMMANDS


# seconds to load, so only what needs them does
HEAVY = {"torch", "mujoco", "lightning"}


def loaded_by(*args: str) -> set[str]:
    """Heavy packages that a run of Python loads."""
    show = "import atexit, sys; atexit.register(lambda: print(*sys.modules, file=sys.stderr))"
    code = f"{show}; sys.argv = ['dexzoo', *{args[1:]}]; {args[0]}"
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    modules = set(done.stderr.split())
    assert "dexzoo" in modules, done.stderr
    return HEAVY & modules


@pytest.mark.parametrize("args", [["--help"], ["models"], ["plan", "--help"], ["pln"], ["plan", "--speed", "3"]])
def test_help_and_errors_come_at_once(args: list[str]) -> None:
    assert loaded_by("import runpy; runpy.run_module('dexzoo', run_name='__main__')", *args) == set()


def test_the_package_itself_loads_nothing_heavy() -> None:
    assert loaded_by("import dexzoo") == set()
    assert "torch" in loaded_by("import dexzoo; dexzoo.Grasps")


def test_the_package_is_a_program(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["dexzoo", "models", "--json"])
    with pytest.raises(SystemExit) as end:
        runpy.run_module("dexzoo", run_name="__main__")
    assert end.value.code == 0
    assert json.loads(capsys.readouterr().out)["models"]


# wrong calls


def refused(result: tuple[int, str, str], message: str) -> None:
    """Exit status 2, nothing but one line of error, which holds the message."""
    status, out, err = result
    assert (status, out) == (2, ""), err
    assert err.count("\n") == 1
    assert err.startswith("dexzoo: ")
    assert message in err


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["verfy"], "command 'verfy' is unknown, did you mean verify? use one of fit, validate, test, predict, plan"),
        (["--json", "models"], "command '--json' is unknown; use one of fit, validate, test, predict, plan"),
        (["plan"], "required: --depth, --camera; see python -m dexzoo plan --help"),
        (["plan", "--depth"], "--depth: expected one argument"),
        (["plan", "--depth", "d", "--camera", "c", "--speed", "3"], "unrecognized arguments: --speed 3"),
        (
            ["plan", "--depth", "d", "--camera", "c", "--num_grasps", "0"],
            "--num_grasps: expected a whole number, 1 or more, got '0'",
        ),
        (
            ["plan", "--depth", "d", "--camera", "c", "--seed", "-1"],
            "--seed: expected a whole number, 0 or more, got '-1'",
        ),
        (["refine", "--depth", "d", "--camera", "c"], "required: --grasps"),
        (
            ["refine", "--depth", "d", "--camera", "c", "--grasps", "g", "--optimizer", "sgd"],
            "--optimizer: invalid choice: 'sgd'",
        ),
        (["verify"], "required: --object"),
        (
            ["verify", "--object", "can_02", "--trials", "two"],
            "--trials: expected a whole number, 1 or more, got 'two'",
        ),
        (["verify", "--object", "can_99"], "object 'can_99' is unknown; known are bottle_00...24"),
        (["verify", "--object", "none.obj"], "mesh none.obj does not exist"),
        (["verify", "--object", "can_02", "--mass", "-1"], "object can_02 has a mass of -1.0 kg; give a positive one"),
        (["verify", "--object", "can_02", "--friction", "3"], "has a friction of 3.0; give one in (0, 2]"),
        (["collect"], "required: --out"),
        (["collect", "--out", "o", "--split", "val"], "--split: invalid choice: 'val' (choose from 'train'"),
        (["collect", "--out", "o", "--generator", "magic"], "--generator: invalid choice: 'magic'"),
        (["collect", "--out", "o", "--round", "2"], "unrecognized arguments: --round 2"),
        (["collect_refined"], "required: --out"),
        (["collect_refined", "--out", "o", "--images"], "unrecognized arguments: --images"),
        (["collect_refined", "--out", "o", "--round", "0"], "--round: expected a whole number, 1 or more, got '0'"),
        (["plan", "--depth", "d", "--camera", "c", "--refin"], "unrecognized arguments: --refin; see"),
        (["view", "--side", "both"], "--side: invalid choice: 'both'"),
        (["fit"], "fit needs a configuration that says what the model is; add --config em2.yaml"),
        (["fit", "--config", "em9.yaml"], "configuration em9.yaml does not exist"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_wrong_calls_get_one_line(
    run: Run, args: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    refused(run(*args), message)
    assert not list(tmp_path.iterdir())


def change_camera(folder: Path, frame: Path, **values: object) -> None:
    camera = json.loads((frame / "camera.json").read_text()) | values
    (folder / "camera.json").write_text(
        json.dumps({name: value for name, value in camera.items() if value is not None})
    )


BAD_DEPTHS: dict[str, tuple[Callable[[np.ndarray], np.ndarray], str]] = {
    "of another size": (lambda depth: depth[:-1], "depth is 640 x 479 pixels, but the camera is 640 x 480"),
    "in millimeters": (lambda depth: depth * 1000, "looks like millimeters; give meters"),
    "zero": (lambda depth: depth * 0, "depth holds no reading: every pixel is zero, negative, NaN or infinite"),
    "NaN": (lambda depth: depth * np.nan, "depth holds no reading"),
    "infinite": (lambda depth: depth + np.inf, "depth holds no reading"),
    "three-dimensional": (lambda depth: np.stack([depth] * 3), "has 3 dimensions, expected one channel of depth"),
    "in integers": (lambda depth: (depth * 1000).astype(np.uint16), "has no depth_scale (meters per unit"),
}


@pytest.mark.parametrize("kind", BAD_DEPTHS)
def test_bad_depth_gets_one_line(run: Run, frame: Path, weights: Path, tmp_path: Path, kind: str) -> None:
    change, message = BAD_DEPTHS[kind]
    with np.errstate(invalid="ignore"):
        np.save(tmp_path / "depth.npy", change(np.load(frame / "depth.npy")))
    args = ["--depth", tmp_path / "depth.npy", "--camera", frame / "camera.json", "--evaluator", weights]
    refused(run("plan", *args, "--out", tmp_path / "out"), message)
    assert not (tmp_path / "out").exists()


def test_a_table_without_object_gets_one_line(
    run: Run, can_view: Observation, frame: Path, weights: Path, tmp_path: Path
) -> None:
    T = can_view.T_world_camera
    np.save(tmp_path / "depth.npy", -T[2, 3] / (can_view.camera.directions() @ T[2, :3]))
    args = ["--depth", tmp_path / "depth.npy", "--camera", frame / "camera.json", "--evaluator", weights]
    refused(run("plan", *args, "--out", tmp_path / "out"), "no object is seen above the table")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"fx": None}, "camera.json has no fx; it needs width, height, fx, fy, cx, cy"),
        ({"fy": "wide"}, "camera.json: fy is 'wide', expected a number"),
        ({"T_world_camera": [[1, 0], [0, 1]]}, "camera.json: T_world_camera must be a finite 4 x 4 matrix"),
    ],
)
def test_a_bad_camera_gets_one_line(
    run: Run, frame: Path, weights: Path, tmp_path: Path, values: dict[str, object], message: str
) -> None:
    change_camera(tmp_path, frame, **values)
    args = ["--depth", frame / "depth.npy", "--camera", tmp_path / "camera.json", "--evaluator", weights]
    refused(run("plan", *args), message)


def test_files_that_are_missing_or_unreadable_get_one_line(
    run: Run, frame: Path, weights: Path, some_grasps: Path, tmp_path: Path
) -> None:
    text = tmp_path / "text"
    text.write_text("neither picture, nor JSON, nor tensors")
    depth, camera, grasps = frame / "depth.npy", frame / "camera.json", some_grasps
    cases = [
        (tmp_path / "none.npy", camera, grasps, "none.npy does not exist"),
        (text, camera, grasps, "text cannot be read; give a 16-bit PNG or a .npy file in meters"),
        (depth, tmp_path / "none.json", grasps, "camera file"),
        (depth, text, grasps, "text is not JSON"),
        (depth, camera, tmp_path / "none", "none does not exist"),
        (depth, camera, text, "text is not a safetensors file of grasps"),
        (depth, camera, weights, "there is no tensor wrist; write the file with Grasps.save"),
        (tmp_path, camera, grasps, "does not exist"),
    ]
    for d, c, g, message in cases:
        out = tmp_path / "out"
        args = ["--depth", d, "--camera", c, "--grasps", g, "--evaluator", weights, "--out", out]
        refused(run("refine", *args), message)
        assert not out.exists()


def test_models_that_are_not_to_be_had_get_one_line(
    run: Run, frame: Path, weights: Path, tmp_path: Path, observed: list[object]
) -> None:
    def plan(evaluator: object) -> tuple[int, str, str]:
        return run("plan", *observed[:4], "--evaluator", evaluator, "--out", tmp_path / "out")

    refused(plan("em22"), "model 'em22' is unknown, did you mean em2? known are em1, em2")
    refused(plan(tmp_path / "none.safetensors"), "none.safetensors do not exist; give a model's name")
    (tmp_path / "em2.json").write_text(weights.with_suffix(".json").read_text())
    (tmp_path / "em2.safetensors").write_bytes(weights.read_bytes()[:-9])
    refused(plan(tmp_path / "em2.safetensors"), "em2.safetensors is truncated or not a safetensors file")
    (tmp_path / "model.pt").write_bytes(b"\x80\x04K\x01.")
    refused(plan(tmp_path / "model.pt"), "model.pt is a pickle, which could run code, and was not read")
    assert not (tmp_path / "out").exists()


CHANGES: dict[str, tuple[str, Callable[[Tensor], Tensor], str]] = {
    "shape": ("wrist", lambda w: w[:, :5], "wrist of grasps has shape (6, 5, 7), expected (num_grasps, 10, 7)"),
    "number of joints": ("joints", lambda q: q[..., :16], "(6, 10, 16), expected (6, 10, 20)"),
    "quaternion": (
        "wrist",
        lambda w: torch.cat((w[..., :3], 2 * w[..., 3:]), -1),
        "has length 2.000, expected 1 (wxyz",
    ),
    "joints": ("joints", lambda q: q + 2, "outside its limits"),
    "type": ("grasp_type", lambda kind: kind + 20, "expected 0 to 9"),
    "nan": ("wrist", lambda w: w * torch.nan, "wrist of grasp 0 holds a number that is not finite"),
}


@pytest.mark.usefixtures("as_users_run_it")
@pytest.mark.parametrize("kind", CHANGES)
def test_bad_grasps_get_one_line(
    run: Run, observed: list[object], some_grasps: Path, tmp_path: Path, kind: str
) -> None:
    name, change, message = CHANGES[kind]
    tensors = load_file(some_grasps)
    tensors[name] = change(tensors[name]).contiguous()
    path = tmp_path / "grasps.safetensors"
    save_file(tensors, path, metadata={"frame": "world"})
    refused(run("verify", "--object", "can_02", "--grasps", path), message)
    refused(run("refine", *observed, "--grasps", path, "--out", tmp_path / "out"), message)
    assert not (tmp_path / "out").exists()


def test_files_of_the_first_edition_are_read_in_the_world_frame_only(
    run: Run, observed: list[object], some_grasps: Path, tmp_path: Path
) -> None:
    grasps = Grasps.load(some_grasps)
    kind = grasps.grasp_type[:, None, None].expand(-1, 10, 1)
    waypoints = torch.cat((grasps.wrist, grasps.joints, kind), -1).contiguous()
    for frame in ("world", "camera"):
        save_file({"waypoints": waypoints}, tmp_path / frame, metadata={"frame": frame})
    for args in (["refine", *observed, "--num_steps", 0], ["verify", "--object", "can_07"]):
        first, new = (run(*args, "--grasps", path, "--json") for path in (tmp_path / "world", some_grasps))
        assert first == new
        assert first[0] == 0
        message = "the grasps are in the camera frame, expected the world frame"
        refused(run(*args, "--grasps", tmp_path / "camera"), message)


def test_hands_that_do_not_fit_get_one_line(
    run: Run, observed: list[object], some_grasps: Path, tmp_path: Path
) -> None:
    refused(run("plan", *observed, "--hand", "claw"), "claw")
    grasps, left = Grasps.load(some_grasps), Hand.load("dlr2", "left")
    Grasps.of(grasps.trajectory, left).save(tmp_path / "left")
    message = "evaluator em2 knows the hand dlr2 (right), not dlr2 (left)"
    refused(run("refine", *observed, "--grasps", tmp_path / "left"), message)
    unknown = {"frame": "world", "hand": "claw", "side": "right", "digest": "0"}
    save_file(load_file(some_grasps), tmp_path / "claw", metadata=unknown)
    refused(
        run("verify", "--object", "can_02", "--grasps", tmp_path / "claw"), "a hand 'claw', which is not in robots/"
    )
    save_file(load_file(some_grasps), tmp_path / "changed", metadata=unknown | {"hand": "dlr2"})
    refused(run("verify", "--object", "can_02", "--grasps", tmp_path / "changed"), "(right) as it is now")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: trimesh.creation.box([80.0, 60.0, 100.0]), "is 100.0 m large and looks like millimeters"),
        (lambda: trimesh.creation.box([0.1, 0.1, 1e-6]), "is flat"),
    ],
    ids=["millimeters", "flat"],
)
def test_a_bad_mesh_gets_one_line(run: Run, tmp_path: Path, make: Callable[[], trimesh.Trimesh], message: str) -> None:
    make().export(tmp_path / "thing.stl")
    refused(run("verify", "--object", tmp_path / "thing.stl"), message)
    (tmp_path / "empty.obj").write_text("")
    refused(run("verify", "--object", tmp_path / "empty.obj"), "empty.obj is empty")


def test_out_must_be_of_the_right_kind(
    run: Run, observed: list[object], some_grasps: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is looked at before the work is done."""
    monkeypatch.setattr(planning, "plan", lambda *_, **__: pytest.fail("the work was done"))
    (tmp_path / "file").write_text("kept")
    refused(run("plan", *observed, "--out", tmp_path / "file"), "file is a file; give a folder")
    for command in ("collect", "collect_refined", "compare", "demonstrate"):
        refused(run(command, "--out", tmp_path / "file"), "file is a file; give a folder")
    args = ["--grasps", some_grasps, "--out", tmp_path]
    refused(run("refine", *observed, *args), f"--out {tmp_path} is a folder; give a file")
    refused(
        run("refine", *observed, *args[:2], "--picture", tmp_path), f"--picture {tmp_path} is a folder; give a file"
    )
    assert (tmp_path / "file").read_text() == "kept"


def test_failures_of_the_machine_are_status_1(
    run: Run, observed: list[object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError("no space left\non the device")

    monkeypatch.setattr(planning, "plan", full)
    status, out, err = run("plan", *observed)
    assert (status, out, err) == (1, "", "dexzoo: no space left on the device\n")

    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(planning, "plan", stopped)
    assert run("plan", *observed) == (1, "", "dexzoo: stopped\n")


# compare


def test_compare_tells_which_model_to_use(
    run: Run, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scores, "NUM_TIMED", 8)  # a thousand take EM2 seconds
    grasps, out = synthetic.write(tmp_path / "grasps", num_grasps=8), tmp_path / "new" / "out"
    status, text, err = run("compare", weights, "--data", grasps, "--out", out)
    assert (status, err) == (0, "")
    assert "8 generated grasps of 1 objects in 1 scenes" in " ".join(text.split())
    for name in ("accuracy", "AUROC", "calibration", "top-1", weights.stem, "gm", "coin"):
        assert name in text
    assert max(len(line) for line in text.splitlines()) <= 80
    written = {path.name for path in out.iterdir()}
    assert written == {
        "comparison.md",
        "comparison.json",
        "rank.png",
        "reliability.png",
        "categories.png",
        "em2_maps.png",
        "em2_grasps.png",
    }
    status, text, err = run("compare", weights, "--data", grasps, "--json")
    assert (status, err) == (0, "")
    again, first = json.loads(text), json.loads((out / "comparison.json").read_text())
    assert again["sources"] == first["sources"]


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["emm2"], "did you mean em2"),
        (["nosuch.safetensors"], "do not exist"),
        (["em2", "--data", "nosuch"], "grasp set nosuch"),
        (["em2", "--split", "val"], "--split"),
        (["em2", "--out", "pyproject.toml"], "--out pyproject.toml is a file"),
    ],
)
def test_wrong_comparisons_are_told_in_one_line(run: Run, args: list[str], message: str) -> None:
    status, out, err = run("compare", *args)
    assert (status, out) == (2, "")
    assert message in err
    assert err.count("\n") == 1

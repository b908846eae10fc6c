"""Comparisons of a grasp set, with evaluators of which the outcome is known."""

import json
import runpy
from pathlib import Path
from typing import Any, ClassVar, Unpack

import cv2
import numpy as np
import pyarrow as pa
import pytest
import synthetic
import torch
from sklearn.decomposition import PCA
from torch import Tensor, nn

from dexzoo.comparison.compare import compare, load_models
from dexzoo.comparison.inside import draw_inside, feature_maps, grasp_features, principal_components
from dexzoo.comparison.report import advice, category_table, main_table, markdown, terminal_table, write
from dexzoo.comparison.scores import encoded_views, first_image, measure, model_scores, one_view
from dexzoo.data.datamodule import GraspDataModule
from dexzoo.data.schema import SPLITS
from dexzoo.grasp import SQUEEZE, Trajectory
from dexzoo.hand import Hand
from dexzoo.models.batch import Encoding
from dexzoo.models.em1 import EM1
from dexzoo.models.em2 import EM2
from dexzoo.models.ensemble import Ensemble
from dexzoo.models.evaluator import EvaluatorOptions, GraspEvaluator

ROOT = Path(__file__).parent.parent


class Closure(GraspEvaluator):
    """Knows the rule of the synthetic set: a grasp closed enough holds. With a negative gain it is always wrong."""

    architecture: ClassVar[str] = "closure"

    def __init__(self, gain: float = 50.0, **options: Unpack[EvaluatorOptions]) -> None:
        super().__init__(**options)
        self.gain = gain
        self.head = nn.Linear(15, 1)
        nn.init.constant_(self.head.weight, gain / 15)
        nn.init.constant_(self.head.bias, -gain * synthetic.CLOSED)

    def encode(self, images: Tensor) -> Encoding:
        return {"nothing": images.new_zeros(len(images), 1)}

    def logit(self, encoding: Encoding, grasps: Trajectory) -> Tensor:
        return self.head(closed(self.known_hands[0], grasps))[..., 0]


def closed(hand: Hand, grasps: Trajectory) -> Tensor:
    """Share of its range at which each freedom ends."""
    low, high = hand.reduce(hand.lower), hand.reduce(hand.upper)
    return (hand.reduce(grasps.joints[..., SQUEEZE, :]) - low) / (high - low)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return synthetic.write(tmp_path_factory.mktemp("grasps"), num_grasps=40)


@pytest.fixture
def data(folder: Path, tmp_path: Path) -> GraspDataModule:
    """The synthetic set with five scenes for testing and one for validation, and every fourth grasp perturbed."""
    module = GraspDataModule(str(folder), cache=str(tmp_path / "cache"))
    source = module.source
    source.grasp_split[:] = np.where(source.grasp_scene == 4, SPLITS.index("validation"), SPLITS.index("test"))
    source.source[::4] = "perturbed"
    place = source.grasps.schema.get_field_index("log_likelihood")
    likelihood = [None if kind == "perturbed" else x for kind, x in zip(source.source, np.sin(range(240)), strict=True)]
    source.grasps = source.grasps.set_column(place, "log_likelihood", pa.array(likelihood, pa.float32()))
    return module


@pytest.fixture
def ensemble(tmp_path: Path) -> Ensemble:
    """Two members, which hold their weights in files of their own."""
    files = [Closure(gain).save(tmp_path / f"{gain}.safetensors") for gain in (50.0, 20.0)]
    return Ensemble(members=[str(path) for path in files]).eval()


@pytest.fixture
def models() -> dict[str, GraspEvaluator]:
    return {"right": Closure(), "wrong": Closure(-50.0)}


def without_times(result: dict[str, Any]) -> str:
    return json.dumps({name: value for name, value in result.items() if name != "cost"})


def test_who_knows_is_told_from_who_errs(data: GraspDataModule, models: dict[str, GraspEvaluator]) -> None:
    result = compare(models, data)
    generated, perturbed = result["sources"]["generated"], result["sources"]["perturbed"]
    assert list(result["sources"]) == ["generated", "perturbed"]
    assert list(generated["rows"]) == ["right", "wrong", "gm", "coin"]
    assert list(perturbed["rows"]) == ["right", "wrong", "coin"]  # nobody knows the likelihood of a perturbed grasp
    assert (generated["scenes"], generated["objects"], generated["grasps"]) == (5, 5, 150)
    right, wrong = (generated["rows"][name]["figures"] for name in models)
    for name in ("accuracy", "balanced_accuracy", "auroc", "scene_auroc", "average_precision"):
        assert right[name]["value"] == pytest.approx(1), name
    for name in ("accuracy", "auroc", "scene_auroc", "top1"):
        assert wrong[name]["value"] == pytest.approx(0), name
    assert right["top1"] == {"value": 1, "interval": [1, 1]}
    assert wrong["brier"]["value"] > 0.5 > 0.1 > right["brier"]["value"]
    against = generated["rows"]["right"]["against_gm"]["top1"]
    assert against["only_gm"] == against["neither"] == 0
    assert against["both"] + against["only_this"] == 5


def test_the_weights_that_were_compared_are_named(data: GraspDataModule, ensemble: Ensemble, tmp_path: Path) -> None:
    path = ensemble.save(tmp_path / "both")
    files = [path, *(Path(member) for member in ensemble.members)]
    sha256 = [json.loads(file.with_suffix(".json").read_text())["sha256"] for file in files]
    result = compare(load_models([str(path), ensemble.members[0]]) | {"made": Closure()}, data)
    assert result["weights"] == {"ensemble": sha256, "50.0": [sha256[1]], "made": [None]}


def test_the_threshold_of_gm_comes_from_validation(data: GraspDataModule) -> None:
    rows = (data.source.grasp_scene == 4) & (data.source.source == "generated")
    held = data.source.success[rows]
    likelihood = np.array(data.source.grasps["log_likelihood"].to_pylist(), float)[rows]
    gm = compare({}, data)["sources"]["generated"]["rows"]["gm"]
    best = max(((likelihood > x) == held).mean() for x in [-2, *likelihood])
    assert ((likelihood > gm["threshold"]) == held).mean() == best


def test_the_same_call_gives_the_same_result(data: GraspDataModule, models: dict[str, GraspEvaluator]) -> None:
    first, again, other = (without_times(compare(models, data, seed=seed)) for seed in (0, 0, 1))
    assert first == again
    assert first != other


def test_each_grasp_is_scored_in_its_own_view(data: GraspDataModule) -> None:
    torch.manual_seed(0)
    model = EM2(width=16, gain=1.5)  # a gain that lets grasps come through an untrained network
    source = data.source
    model.fit_statistics(source.images([0, 1])[torch.arange(2)], data.aimed_grasps)
    model.eval()
    scores = model_scores(model, data.dataset("validation", model), "scoring")
    rows = np.flatnonzero((source.grasp_scene == 4) & (source.source == "generated"))
    assert len(np.unique(source.grasp_view[rows])) == 2
    for row, probability in zip(rows[::5], scores.probability[::5], strict=True):
        expected = model.score(source.world_grasps[row], source.observation(int(source.grasp_view[row])))
        assert probability == pytest.approx(float(expected), abs=2e-3)  # views are cached in half precision
    assert np.ptp(scores.probability) > 0.02


def test_dropout_is_off_where_a_model_is_scored_and_timed(
    data: GraspDataModule, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = Closure().train()
    modes = set()
    logit = model.logit
    monkeypatch.setattr(model, "logit", lambda *given: modes.add(model.training) or logit(*given))
    compare({"right": model}, data)
    assert modes == {False}
    assert model.training


def test_views_are_encoded_once_each(data: GraspDataModule, monkeypatch: pytest.MonkeyPatch) -> None:
    model = Closure()
    calls: list[int] = []
    encode = model.encode
    monkeypatch.setattr(model, "encode", lambda images: calls.append(len(images)) or encode(images))
    dataset = data.dataset("test", model)
    rows = torch.cat([part for part, _ in encoded_views(model, dataset)])
    assert calls == [1] * 10
    assert sorted(rows.tolist()) == list(range(len(dataset)))


def test_scores_that_are_no_numbers_are_refused(data: GraspDataModule) -> None:
    with pytest.raises(ValueError, match="broken on generated grasps: 150 of 150 scores are nan"):
        compare({"broken": Closure(float("nan"))}, data)


def test_fewer_scenes_are_compared_alike(data: GraspDataModule, models: dict[str, GraspEvaluator]) -> None:
    data.num_scenes = 2
    assert compare(models, data)["sources"]["generated"]["scenes"] == 2


def test_a_split_without_generated_grasps_is_refused(data: GraspDataModule) -> None:
    with pytest.raises(ValueError, match="no generated grasps in its train split"):
        compare({}, data, "train")


def test_models_are_named_shortly_where_that_is_clear(tmp_path: Path) -> None:
    files = [EM2(width=16).save(tmp_path / name) for name in ("a", "b", "gm", "em2-lr0.001")]
    assert list(load_models([str(tmp_path / "a"), str(tmp_path / "b"), str(tmp_path / "a")])) == ["a", "b"]
    assert list(load_models([str(path) for path in files])) == [str(path) for path in files]
    assert list(load_models([str(tmp_path / "gm")])) == [str(tmp_path / "gm")]
    assert list(load_models([str(tmp_path / "em2-lr0.001"), str(files[0])])) == ["em2-lr0.001", "em2"]
    assert "em2" in load_models([])


def test_the_folder_holds_tables_numbers_and_pictures(
    data: GraspDataModule, models: dict[str, GraspEvaluator], tmp_path: Path
) -> None:
    result = compare(models, data)
    write(result, tmp_path, [tmp_path / "em2_maps.png"])
    assert json.loads((tmp_path / "comparison.json").read_text()) == result
    page = (tmp_path / "comparison.md").read_text()
    assert page.startswith(markdown(result))
    assert page.count("![") == 4
    assert "![em2_maps](em2_maps.png)" in page
    for name in ("rank", "reliability", "categories"):
        picture = cv2.imread(str(tmp_path / f"{name}.png"))
        assert min(picture.shape[:2]) > 200
        assert np.ptp(picture) > 100
    cost = result["cost"]["right"]
    assert cost["parameters"] == 16
    assert 0 < cost["milliseconds_per_1000_grasps"] < 10_000


def test_the_best_of_a_column_is_bold(data: GraspDataModule, models: dict[str, GraspEvaluator]) -> None:
    head, (right, wrong, gm, _) = main_table(compare(models, data)["sources"]["generated"])
    for name in ("accuracy", "AUROC", "top-1", "Brier"):
        assert right[head.index(name)].startswith("**"), name
        assert not wrong[head.index(name)].startswith("**"), name
    assert right[head.index("accuracy")] == "**100.0** (100.0 to 100.0)"
    assert gm[head.index("Brier")] == ""


def test_every_category_has_a_row(data: GraspDataModule, models: dict[str, GraspEvaluator]) -> None:
    section = compare(models, data)["sources"]["generated"]
    head, rows = category_table(section)
    assert head == ["category", "scenes", "grasps", "hold", "right", "wrong", "gm", "coin"]
    shares = [float(row[3]) for row in rows]
    assert shares == sorted(shares, reverse=True)
    assert sum(int(row[1]) for row in rows) == 5
    assert sum(int(row[2]) for row in rows) == 150
    assert {tuple(row[4:6]) for row in rows} == {("100.0, 100.0", "0.0, 0.0")}


def test_a_trunk_is_counted_once_and_apart(data: GraspDataModule, tmp_path: Path) -> None:
    em2 = EM2(width=16)
    pair = Ensemble(members=[str(em2.save(tmp_path / "a")), str(em2.save(tmp_path / "b"))])
    file = ROOT / "assets" / "checkpoints" / "vgg16_hed.safetensors"
    grasps = data.dataset("test", Closure()).aimed(torch.arange(2))
    image = first_image(data, "test")
    for model in (em2, pair):
        assert measure(model, image, grasps).trunk_megabytes == round(file.stat().st_size / 1e6, 1)
    assert measure(Closure(), image, grasps).trunk_megabytes == 0


def summary(top1: dict[str, float], held: tuple[int, int], p: float) -> dict[str, Any]:
    """What `advice` reads of a result: rows with their top-1, and the first set against the second."""
    best, other, *_ = top1
    rows: dict[str, Any] = {name: {"figures": {"top1": {"value": value}}} for name, value in top1.items()}
    cross = {"only_this": held[0], f"only_{other}": held[1], "p": p}
    rows[best][f"against_{other}"] = {"top1": cross | {"difference": {"value": top1[best] - top1[other]}}}
    cost = {
        name: {"milliseconds_per_view": 40, "milliseconds_per_1000_grasps": 1000 * value}
        for name, value in top1.items()
    }
    return {"sources": {"generated": {"rows": rows}}, "cost": cost}


@pytest.mark.parametrize(
    ("top1", "held", "p", "before", "after"),
    [
        (
            {"a": 0.9, "b": 0.8, "gm": 0.5, "coin": 0.95},
            (40, 12),
            0.0003,
            "Use a: a's first grasp holds in 90.0 % of the scenes, 10.0 points more than b's (only a's in 40 scenes, ",
            "only b's in 12); the difference is significant (p 0.0003).",
        ),
        (
            {"a": 0.9, "b": 0.8, "gm": 0.5},
            (5, 2),
            0.4531,
            "Use b: a's first grasp holds in 90.0 % of the scenes, 10.0 points more than b's (only a's in 5 scenes, ",
            "only b's in 2); the difference is not significant (p 0.4531), and b is faster (840 ms for a view and "
            "1,000 grasps, against 940).",
        ),
        (
            {"a": 0.4, "gm": 0.5},
            (2, 30),
            1e-6,
            "a's first grasp holds in 40.0 % of the scenes, 10.0 points less than gm's (only a's in 2 scenes, only ",
            "gm's in 30); the difference is significant (p < 0.0001).",
        ),
    ],
)
def test_a_sentence_says_which_to_use(
    top1: dict[str, float], held: tuple[int, int], p: float, before: str, after: str
) -> None:
    assert advice(summary(top1, held, p)) == before + after


@pytest.mark.parametrize(
    ("value", "p", "doubted"), [(0.5, 0.01, False), (0.5, 0.07, True), (0.95, 1e-6, True)], ids=["more", "same", "less"]
)
def test_the_sentence_doubts_what_is_not_surely_better_than_the_generator(
    value: float, p: float, doubted: bool
) -> None:
    result = summary({"a": 0.9, "b": 0.8, "gm": value}, (40, 12), 0.0003)
    rows = result["sources"]["generated"]["rows"]
    rows["a"]["against_gm"] = {"top1": {"p": p, "difference": {"value": 0.9 - value}}}
    doubt = " a is not significantly better than gm, the generator's own order (p "
    assert (doubt in advice(result)) == doubted


def test_the_best_is_set_against_the_next(data: GraspDataModule, models: dict[str, GraspEvaluator]) -> None:
    result = compare({"wrong": models["wrong"], "right": models["right"]}, data)
    rows = result["sources"]["generated"]["rows"]
    assert rows["right"]["against_wrong"]["top1"]["only_this"] == 5
    assert "against_right" not in rows["wrong"]
    assert advice(result) in markdown(result)
    assert advice(result) == terminal_table(result).caption
    assert advice(compare({}, data)) == ""


def test_all_are_set_against_em2_where_it_is_compared(
    data: GraspDataModule, models: dict[str, GraspEvaluator], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "against em2" not in markdown(compare(models, data))
    result = compare({"em_fk": models["right"], "em2": models["wrong"]}, data)
    rows = result["sources"]["generated"]["rows"]
    assert [name for name in rows if "against_em2" in rows[name]] == ["em_fk", "gm", "coin"]
    assert rows["em_fk"]["against_em2"]["top1"]["failures_removed"] == {"value": 1, "interval": [1, 1]}
    line = "| em_fk | +100.0 (+100.0 to +100.0) | +100.0 (+100.0 to +100.0) | +100.0 (+100.0 to +100.0) |"
    line += " 0 | 5 | 0 | 0 | 0.0625 |"
    assert markdown(result).count(line) == 2  # of generated and of perturbed grasps
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    page = runpy.run_path(str(ROOT / "benchmarks" / "evaluator_report.py"))["comparison"](result)
    assert page.count(line) == 1


def test_a_look_inside(data: GraspDataModule, hand: Hand, tmp_path: Path) -> None:
    torch.manual_seed(0)
    em2 = EM2(width=16).eval()
    image = data.source.images([0])[torch.tensor([0])]
    assert feature_maps(em2, image).shape == (512, 14, 14)
    assert feature_maps(Closure(), image) is None
    dataset = data.dataset("test", em2)
    rows, features = grasp_features(em2, dataset)
    joined = []
    em2.head.register_forward_hook(lambda _, given, __: joined.append(given[0][..., -512:]))
    em2.logit(em2.encode(image), one_view(dataset.aimed(rows[:3])))
    torch.testing.assert_close(features[:3], joined[0][0], atol=1e-4, rtol=1e-4)
    em1 = EM1().eval()
    assert grasp_features(em1, data.dataset("test", em1))[1].shape == (len(rows), 1024)
    rows, features = grasp_features(Closure(), dataset)
    torch.testing.assert_close(features, closed(hand, dataset.grasps[rows]))
    drawn = draw_inside({"em2": em2, "runs/closure": Closure()}, data, "test", tmp_path)
    assert [path.name for path in drawn] == ["em2_maps.png", "em2_grasps.png", "runs_closure_grasps.png"]
    assert set(drawn) == set(tmp_path.glob("*.png"))


def test_what_has_nothing_inside_is_left_out(data: GraspDataModule, ensemble: Ensemble, tmp_path: Path) -> None:
    assert grasp_features(ensemble, data.dataset("test", ensemble)) is None
    draw_inside({"ensemble": ensemble, "right": Closure()}, data, "test", tmp_path)
    assert {path.name for path in tmp_path.glob("*.png")} == {"right_grasps.png"}


def test_principal_components_agree_with_scikit_learn() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(size=(60, 5)) @ rng.normal(size=(5, 90)) + 3
    values[:, 7] = 1.0
    spread = values.std(0, ddof=1)
    scaled = (values - values.mean(0)) / np.where(spread > 1e-6, spread, np.inf)
    expected = PCA(2, svd_solver="full").fit_transform(scaled)
    found = principal_components(torch.tensor(values)).numpy()
    np.testing.assert_allclose(np.abs(found), np.abs(expected), atol=1e-6)

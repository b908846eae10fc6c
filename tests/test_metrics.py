import doctest
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from sklearn.calibration import calibration_curve
from sklearn.metrics import roc_auc_score
from torchmetrics import Metric
from torchmetrics.classification import BinaryCalibrationError

from dexzoo import metrics
from dexzoo.metrics import CalibrationError, SceneAUROC, SuccessByRank, TopKSuccess


def reference(scores: np.ndarray, success: np.ndarray, scene: np.ndarray, k: int) -> float:
    rates = []
    for name in np.unique(scene):
        rows = np.flatnonzero(scene == name)
        best = rows[np.argsort(-scores[rows])[:k]]
        rates.append(success[best].mean())
    return float(np.mean(rates))


@given(st.integers(0, 10_000), st.integers(1, 60), st.integers(1, 8), st.integers(1, 5), st.integers(1, 4))
def test_top_k_agrees_with_numpy_however_the_grasps_come(seed: int, size: int, scenes: int, k: int, calls: int) -> None:
    rng = np.random.default_rng(seed)
    scores = rng.permutation(size).astype(np.float32)  # without ties
    success, scene = rng.integers(0, 2, size), rng.integers(0, scenes, size) * 7
    metric = TopKSuccess(k)
    for part in np.array_split(np.arange(size), calls):
        metric.update(torch.tensor(scores[part]), torch.tensor(success[part]), torch.tensor(scene[part]))
    assert float(metric.compute()) == pytest.approx(reference(scores, success, scene, k), abs=1e-6)


@pytest.mark.parametrize("calls", [1, 3])
def test_a_constant_score_is_as_good_as_chance(calls: int) -> None:
    success = np.random.default_rng(0).random((500, 10)) < np.linspace(0.9, 0.1, 10)  # as a generator orders them
    success, scene = torch.tensor(success.ravel()), torch.arange(500).repeat_interleave(10)
    metrics = [TopKSuccess(1), TopKSuccess(5), SuccessByRank(5), SceneAUROC()]
    for metric in metrics:
        for part in torch.arange(5000).chunk(calls):
            metric.update(torch.full((len(part),), 0.3), success[part], scene[part])
        figures = metric.compute()
        torch.testing.assert_close(figures, torch.full_like(figures, 0.5), atol=0.06, rtol=0)
    again = TopKSuccess(1)
    again.update(torch.zeros(5000), success, scene)
    assert again.compute() == metrics[0].compute()


def test_processes_are_joined_by_concatenation() -> None:
    halves = []
    for rows in ([0, 1, 2], [3, 4]):
        metric = TopKSuccess(2)
        scores, success = torch.tensor([0.1, 0.9, 0.3, 0.8, 0.7]), torch.tensor([1, 0, 1, 1, 0])
        metric.update(scores[rows], success[rows], torch.tensor([0, 0, 1, 0, 1])[rows])
        halves.append(metric)
    whole = halves[0]
    whole.merge_state(halves[1])
    assert float(whole.compute()) == pytest.approx(0.5)  # scene 0: 0.9 and 0.8; scene 1: both


@pytest.mark.filterwarnings("ignore:The ``compute`` method:UserWarning")
@pytest.mark.parametrize("make", [TopKSuccess, SuccessByRank, SceneAUROC, CalibrationError])
def test_no_grasps_no_figure(make: Callable[[], Metric]) -> None:
    assert make().compute().isnan().all()


def test_wrong_use_is_refused() -> None:
    for make, name in ((TopKSuccess, "k"), (SuccessByRank, "num_parts"), (CalibrationError, "num_bins")):
        with pytest.raises(ValueError, match=f"{name} is 0"):
            make(0)
    with pytest.raises(ValueError, match=r"TopKSuccess: .* must have one shape"):
        TopKSuccess().update(torch.zeros(3), torch.zeros(2), torch.zeros(3))
    with pytest.raises(ValueError, match=r"CalibrationError: .* must have one shape"):
        CalibrationError().update(torch.zeros(3), torch.zeros(2))


@given(st.integers(0, 10_000), st.integers(1, 60), st.integers(1, 8), st.integers(1, 12))
def test_success_by_rank_agrees_with_numpy(seed: int, size: int, scenes: int, parts: int) -> None:
    rng = np.random.default_rng(seed)
    scores = rng.permutation(size).astype(np.float32)  # without ties
    success, scene = rng.integers(0, 2, size), rng.integers(0, scenes, size) * 7
    rates: list[list[float]] = [[] for _ in range(parts)]
    for name in np.unique(scene):
        rows = np.flatnonzero(scene == name)
        ranked = success[rows[np.argsort(-scores[rows])]]
        for part in range(parts):
            here = [held for place, held in enumerate(ranked) if int(place * parts / len(ranked)) == part]
            rates[part] += [np.mean(here)] if here else []
    metric = SuccessByRank(parts)
    metric.update(torch.tensor(scores), torch.tensor(success), torch.tensor(scene))
    expected = [np.mean(rate) if rate else np.nan for rate in rates]
    np.testing.assert_allclose(metric.compute(), expected, atol=1e-6)


@given(st.integers(0, 10_000), st.integers(1, 80), st.integers(1, 6))
def test_scene_auroc_agrees_with_scikit_learn(seed: int, size: int, scenes: int) -> None:
    rng = np.random.default_rng(seed)
    scores = np.round(rng.normal(size=size), 1).astype(np.float32)
    success, scene = rng.integers(0, 2, size), rng.integers(0, scenes, size)
    metric = SceneAUROC()
    metric.update(torch.tensor(scores), torch.tensor(success), torch.tensor(scene))
    expected = [
        roc_auc_score(success[scene == name], scores[scene == name]) if np.ptp(success[scene == name]) else np.nan
        for name in np.unique(scene)
    ]
    np.testing.assert_allclose(metric.by_scene(), expected, atol=1e-6)
    if np.isfinite(expected).any():
        assert float(metric.compute()) == pytest.approx(np.nanmean(expected), abs=1e-6)


@given(st.integers(0, 10_000), st.integers(1, 200), st.integers(1, 20))
def test_calibration_agrees_with_torchmetrics_and_scikit_learn(seed: int, size: int, num_bins: int) -> None:
    rng = np.random.default_rng(seed)
    probability = rng.random(size, np.float32)
    success = rng.random(size) < probability**2
    metric = CalibrationError(num_bins)
    for rows in np.array_split(np.arange(size), 3):
        metric.update(torch.tensor(probability[rows]), torch.tensor(success[rows]))
    expected = BinaryCalibrationError(num_bins, norm="l1")(torch.tensor(probability), torch.tensor(success).int())
    assert float(metric.compute()) == pytest.approx(float(expected), abs=1e-6)
    rate, mean = calibration_curve(success, probability, n_bins=num_bins)
    bins = metric.bins().numpy()
    np.testing.assert_allclose(bins[bins[:, 0] > 0, 1:], np.stack((mean, rate), 1), atol=1e-6)
    assert bins[:, 0].sum() == size


def test_calibration_takes_the_ends_of_the_range_and_nothing_beyond() -> None:
    metric = CalibrationError(4)
    metric.update(torch.tensor([0.0, 1.0]), torch.tensor([0, 1]))
    assert float(metric.compute()) == 0
    for wrong in (1.5, -0.1, float("nan")):
        with pytest.raises(ValueError, match="between 0 and 1"):
            metric.update(torch.tensor([wrong]), torch.tensor([1]))


METRICS: list[Callable[[], Metric]] = [lambda: TopKSuccess(3), SuccessByRank, SceneAUROC, CalibrationError]


def sample() -> dict[str, torch.Tensor]:
    """Grasps of nine scenes, in no order."""
    rng = np.random.default_rng(5)
    preds = torch.tensor(rng.random(400, np.float32))
    target, indexes = torch.tensor(rng.integers(0, 2, 400)), torch.tensor(rng.integers(0, 9, 400))
    return {"preds": preds, "target": target, "indexes": indexes}


def update(metric: Metric, rows: slice) -> Metric:
    values = {name: value[rows] for name, value in sample().items()}
    if isinstance(metric, CalibrationError):
        del values["indexes"]
    metric.update(**values)
    return metric


@pytest.mark.parametrize("make", METRICS)
def test_two_halves_merged_are_the_whole(make: Callable[[], Metric]) -> None:
    whole = update(make(), slice(None)).compute()
    half = update(make(), slice(150))
    half.merge_state(update(make(), slice(150, None)))
    torch.testing.assert_close(half.compute(), whole)
    assert not torch.allclose(update(make(), slice(150)).compute(), whole)


def work_in_process(rank: int, folder: str) -> None:
    """One of two processes that have half of the grasps each."""
    torch.distributed.init_process_group("gloo", init_method=f"file://{folder}/meet", rank=rank, world_size=2)
    half = slice(150) if rank == 0 else slice(150, None)
    torch.save([update(make(), half).compute() for make in METRICS], f"{folder}/{rank}.pt")
    torch.distributed.destroy_process_group()


@pytest.mark.slow
def test_two_processes_reach_what_one_does(tmp_path: Path) -> None:
    torch.multiprocessing.spawn(work_in_process, (str(tmp_path),), nprocs=2)
    whole = [update(make(), slice(None)).compute() for make in METRICS]
    for rank in range(2):
        for found, expected in zip(torch.load(tmp_path / f"{rank}.pt", weights_only=True), whole, strict=True):
            torch.testing.assert_close(found, expected)


def test_examples_in_the_docstrings_hold() -> None:
    failed, tried = doctest.testmod(metrics)
    assert tried
    assert not failed

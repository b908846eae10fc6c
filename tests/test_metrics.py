import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dexzoo.metrics import TopKSuccess


def reference(scores: np.ndarray, success: np.ndarray, scene: np.ndarray, k: int) -> float:
    rates = []
    for name in np.unique(scene):
        rows = np.flatnonzero(scene == name)
        best = rows[np.argsort(-scores[rows], kind="stable")[:k]]
        rates.append(success[best].mean())
    return float(np.mean(rates))


@given(st.integers(0, 10_000), st.integers(1, 60), st.integers(1, 8), st.integers(1, 5), st.integers(1, 4))
def test_top_k_agrees_with_numpy_however_the_grasps_come(seed: int, size: int, scenes: int, k: int, calls: int) -> None:
    rng = np.random.default_rng(seed)
    scores = np.round(rng.random(size), 1).astype(np.float32)  # rounded, so that there are ties
    success, scene = rng.integers(0, 2, size), rng.integers(0, scenes, size) * 7
    metric = TopKSuccess(k)
    for part in np.array_split(np.arange(size), calls):
        metric.update(torch.tensor(scores[part]), torch.tensor(success[part]), torch.tensor(scene[part]))
    assert float(metric.compute()) == pytest.approx(reference(scores, success, scene, k), abs=1e-6)


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
def test_no_grasps_no_figure() -> None:
    assert TopKSuccess().compute().isnan()


def test_wrong_use_is_refused() -> None:
    with pytest.raises(ValueError, match="k is 0"):
        TopKSuccess(0)
    with pytest.raises(ValueError, match="must have one shape"):
        TopKSuccess().update(torch.zeros(3), torch.zeros(2), torch.zeros(3))

"""The figures of a comparison against scikit-learn and torchmetrics, with and without weights."""

import math
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from sklearn import metrics as sk
from torchmetrics.classification import BinaryCalibrationError

from dexzoo.comparison.figures import NUM_BINS, against, cross_table, describe, draw_scenes, figures, gains
from dexzoo.comparison.scores import Labels, Scores, best_threshold, coin_scores, likelihood_scores


def make(seed: int, num_scenes: int = 12, size: int = 150, digits: int = 1) -> tuple[Labels, Scores]:
    """Grasps in no order, scored better than by chance, with ties where the scores have few digits."""
    rng = np.random.default_rng(seed)
    scene = np.concatenate((np.arange(num_scenes), rng.integers(0, num_scenes, size - num_scenes)))
    success = rng.random(size) < 0.45
    score = np.round(rng.normal(size=size) + success, digits).astype(np.float32)
    probability = torch.tensor(score).sigmoid().numpy()
    names = np.array([f"object_{i // 2}" for i in range(num_scenes)])
    category = np.array([("mug", "can", "box")[i // 2 % 3] for i in range(num_scenes)])
    labels = Labels(success, scene, names, category, rng.normal(size=size).astype(np.float32))
    return labels, Scores(score, 0.5, probability)


def expected(labels: Labels, scores: Scores, weight: np.ndarray) -> dict[str, float]:
    """What scikit-learn makes of grasps with weights."""
    held, predicted = labels.success, scores.probability > 0.5
    return {
        "accuracy": sk.accuracy_score(held, predicted, sample_weight=weight),
        "balanced_accuracy": sk.balanced_accuracy_score(held, predicted, sample_weight=weight),
        "auroc": sk.roc_auc_score(held, scores.score, sample_weight=weight),
        "average_precision": sk.average_precision_score(held, scores.score, sample_weight=weight),
        "brier": sk.brier_score_loss(held, scores.probability, sample_weight=weight),
    }


@given(st.integers(0, 10_000), st.sampled_from([1, 9]))
def test_figures_agree_with_scikit_learn_and_torchmetrics(seed: int, digits: int) -> None:
    labels, scores = make(seed, digits=digits)
    found = figures(labels, scores, np.ones((1, labels.num_scenes)))
    for name, value in expected(labels, scores, np.ones(len(labels.success))).items():
        assert found[name][0] == pytest.approx(value, abs=1e-6), name
    error = BinaryCalibrationError(NUM_BINS)(torch.tensor(scores.probability), torch.tensor(labels.success).int())
    assert found["calibration_error"][0] == pytest.approx(float(error), abs=1e-6)
    if digits == 1:
        return  # among ties chance ranks
    scenes = [np.flatnonzero(labels.scene == i) for i in range(labels.num_scenes)]
    ranked = [rows[np.argsort(-scores.score[rows])] for rows in scenes]
    for k in (1, 5):
        assert found[f"top{k}"][0] == pytest.approx(np.mean([labels.success[rows[:k]].mean() for rows in ranked]))


@given(st.integers(0, 10_000), st.sampled_from([1, 9]))
def test_a_scene_drawn_twice_counts_twice(seed: int, digits: int) -> None:
    labels, scores = make(seed, digits=digits)
    draws = draw_scenes(labels.num_scenes, seed, 3)
    found = figures(labels, scores, draws)
    for draw, weights in enumerate(draws):
        for name, value in expected(labels, scores, weights[labels.scene]).items():
            assert found[name][draw] == pytest.approx(value, abs=1e-6), name
        copies = np.repeat(np.arange(labels.num_scenes), weights.astype(int))
        rows = [np.flatnonzero(labels.scene == scene) for scene in copies]
        taken, scene = np.concatenate(rows), np.repeat(np.arange(len(rows)), [len(part) for part in rows])
        copied = Labels(
            labels.success[taken], scene, labels.objects[copies], labels.category[copies], np.zeros(0, np.float32)
        )
        once = figures(copied, scores[taken], np.ones((1, len(copies))))
        for name, value in once.items():
            if digits == 1 and name in ("top1", "top5"):
                continue  # among ties chance ranks
            assert found[name][draw] == pytest.approx(value[0], abs=1e-6, nan_ok=True), name


def test_draws_take_as_many_scenes_as_there_are() -> None:
    draws = draw_scenes(30, 0)
    assert draws.shape == (1001, 30)
    assert (draws[0] == 1).all()
    assert (draws.sum(1) == 30).all()
    np.testing.assert_allclose(draws.mean(0), 1, atol=0.15)
    np.testing.assert_array_equal(draws, draw_scenes(30, 0))
    assert (draws != draw_scenes(30, 1)).any()


def test_intervals_are_those_of_a_plain_bootstrap() -> None:
    labels, scores = make(3, num_scenes=40, size=800)
    row = describe(labels, scores, draw_scenes(labels.num_scenes, 0))
    rng = np.random.default_rng(9)
    members = [np.flatnonzero(labels.scene == scene) for scene in range(labels.num_scenes)]
    replicates = []
    for _ in range(1000):
        rows = np.concatenate([members[scene] for scene in rng.integers(0, 40, 40)])
        replicates.append(sk.roc_auc_score(labels.success[rows], scores.score[rows]))
    np.testing.assert_allclose(row["figures"]["auroc"]["interval"], np.percentile(replicates, [2.5, 97.5]), atol=0.004)


def test_a_row_says_everything() -> None:
    labels, scores = make(0)
    row = describe(labels, scores, draw_scenes(labels.num_scenes, 0))
    (tn, fp), (fn, tp) = sk.confusion_matrix(labels.success, scores.probability > 0.5)
    assert row["counts"] == {"tp": tp, "fp": fp, "tn": tn, "fn": fn}
    assert len(row["by_rank"]) == 10
    assert row["by_rank"][0]["value"] > row["by_rank"][-1]["value"]
    assert sum(part["grasps"] for part in row["reliability"]) == len(labels.success)
    assert sum(part["grasps"] for part in row["by_category"].values()) == len(labels.success)
    mugs = labels.category[labels.scene] == "mug"
    mug = row["by_category"]["mug"]
    assert mug["scenes"] == (labels.category == "mug").sum()
    assert mug["auroc"] == pytest.approx(sk.roc_auc_score(labels.success[mugs], scores.score[mugs]), abs=1e-6)
    for figure in row["figures"].values():
        assert figure["interval"][0] <= figure["value"] <= figure["interval"][1]


def test_what_is_not_defined_is_left_empty() -> None:
    labels, scores = make(0)
    all_hold = replace(labels, success=np.ones_like(labels.success))
    row = describe(all_hold, Scores(scores.score, None, None), draw_scenes(labels.num_scenes, 0))
    assert row["figures"]["auroc"] == row["figures"]["scene_auroc"] == {"value": None, "interval": None}
    assert row["figures"]["top1"]["value"] == 1
    assert not {"accuracy", "balanced_accuracy", "brier", "calibration_error"} & set(row["figures"])
    assert row["counts"] is row["reliability"] is row["threshold"] is None


def test_the_cross_table_is_mcnemars() -> None:
    # the thesis' trials on the robot (Table 3.5): 23 good by both, 15 by the evaluator only, 5 by the generator only
    right = np.repeat([True, True, False, False], [23, 15, 5, 6])
    other = np.repeat([True, False, True, False], [23, 15, 5, 6])
    found = cross_table(right, other, "gm")
    assert (found["both"], found["only_this"], found["only_gm"], found["neither"]) == (23, 15, 5, 6)
    assert found["p"] == pytest.approx(2 * sum(math.comb(20, i) for i in range(6)) / 2**20)
    assert cross_table(right, right, "gm")["p"] == 1


def test_rows_are_set_against_another_by_scene_and_by_grasp() -> None:
    labels, scores = make(1, num_scenes=30, size=600)
    gm, draws = likelihood_scores(labels, labels), draw_scenes(30, 0)
    assert gm is not None
    found = against(labels, scores, gm, "gm", draws)
    cells = ("both", "only_this", "only_gm", "neither")
    assert sum(found["top1"][cell] for cell in cells) == 30
    assert sum(found["accuracy"][cell] for cell in cells) == 600
    right, gm_right = scores.predicted == labels.success, gm.predicted == labels.success
    assert found["accuracy"]["only_this"] == (right & ~gm_right).sum()
    assert found["accuracy"]["only_gm"] == (gm_right & ~right).sum()
    all_own, all_other = (figures(labels, row, draws) for row in (scores, gm))
    for name in found:
        own, other = all_own[name], all_other[name]
        for key, replicates in (("difference", own - other), ("failures_removed", (own - other) / (1 - other))):
            interval = np.percentile(replicates[1:], [2.5, 97.5])
            np.testing.assert_allclose(found[name][key]["interval"], interval, atol=2e-6, err_msg=f"{name} {key}")
    top1 = found["top1"]
    removed = (top1["only_this"] - top1["only_gm"]) / (top1["only_this"] + top1["neither"])
    assert top1["failures_removed"]["value"] == pytest.approx(removed, abs=1e-6)
    assert against(labels, scores, Scores(gm.score, None, None), "gm", draws)["accuracy"] is None


def test_who_never_fails_has_no_failures_to_remove() -> None:
    right, scene = np.array([True, False, True]), np.arange(3)
    found = gains(right, np.ones(3, bool), scene, draw_scenes(3, 0))
    assert found["failures_removed"] == {"value": None, "interval": None}
    assert found["difference"]["value"] == pytest.approx(-1 / 3, abs=1e-6)


@given(st.integers(0, 10_000), st.integers(1, 30))
def test_the_best_threshold_is_the_best(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    score = rng.integers(0, 6, size).astype(np.float32)
    success = rng.random(size) < 0.5
    reached = ((score > best_threshold(score, success)) == success).mean()
    assert reached == max(((score > threshold) == success).mean() for threshold in np.arange(-1, 7))
    assert math.isfinite(best_threshold(score, success))


def test_gm_needs_likelihoods_and_for_predictions_validation() -> None:
    labels, _ = make(0)
    unknown = np.full_like(labels.log_likelihood, np.nan)
    without = replace(labels, log_likelihood=unknown)
    assert likelihood_scores(without, labels) is None
    for validation in (None, without):
        gm = likelihood_scores(labels, validation)
        assert gm is not None
        assert gm.predicted is None


def test_the_coin_is_fair_and_drawn_with_the_seed() -> None:
    labels, _ = make(0, num_scenes=300, size=20_000)
    coin = coin_scores(labels, 0)
    found = figures(labels, coin, np.ones((1, labels.num_scenes)))
    assert found["accuracy"][0] == pytest.approx(0.5, abs=0.02)
    assert found["scene_auroc"][0] == pytest.approx(0.5, abs=0.02)
    assert (coin.score == coin_scores(labels, 0).score).all()
    assert (coin.score != coin_scores(labels, 1).score).any()


def test_a_thousand_draws_take_a_second_or_so() -> None:
    labels, scores = make(0, num_scenes=200, size=15_000, digits=6)
    start = time.process_time()
    describe(labels, scores, draw_scenes(labels.num_scenes, 0))
    assert time.process_time() - start < 5  # it takes half a second; one draw at a time would take a minute

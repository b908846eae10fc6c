"""The benchmark of refinement: what it tries, and its figures against a count by hand."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dexzoo.generators import make_generator
from dexzoo.grasp import Grasps
from dexzoo.hand import Hand
from dexzoo.models.em2 import EM2
from dexzoo.refinement import Refinement, default_terms
from dexzoo.refinement.terms import Table, Term

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch):  # noqa: ANN201, a module
    monkeypatch.syspath_prepend(BENCHMARKS)
    import refine_figures

    yield refine_figures
    for name in ("refine", "generator", "refine_figures", "generator_figures"):
        sys.modules.pop(name, None)


def scene(figures, before: str, after: str, scores: list[float], later: list[float]):  # noqa: ANN001, ANN201
    """A scene's grasps as given and refined: s holds, f fails, c hits the table."""

    def outcome(letters: str) -> np.ndarray:
        return np.array([[x == "s", x == "c", False, False] for x in letters])

    count = len(before)
    arrays = np.zeros((count, 10, 7)), np.zeros((count, 10, 20)), np.zeros(count, int)
    given = figures.Given("can_00", "can", *arrays, outcome(before), np.full(count, 0.002))
    nan, flag = np.full(count, np.nan), np.zeros(count, bool)
    cost = np.array([2.0, 3.0])
    row = figures.Refined(
        ~flag, flag, np.array(scores), np.array(later), nan, nan, outcome(after), np.full(count, 0.001), cost
    )
    return given, row


def test_outcomes_are_counted_as_in_the_thesis(figures, tmp_path: Path) -> None:  # noqa: ANN001
    first = scene(figures, "sffs", "sscf", [0.1, 0.4, 0.3, 0.2], [0.2, 0.1, 0.9, 0.3])
    second = scene(figures, "fs", "fc", [0.5, 0.6], [0.7, 0.6])
    for number, (given, row) in enumerate((first, second)):
        given.save(tmp_path / "given" / f"{number:03d}.npz")
        row.save(tmp_path / "method" / f"{number:03d}.npz")
    given = figures.Given.load_all(tmp_path / "given", 5)
    found = figures.compared(given, {"method": figures.Refined.load_all(tmp_path / "method", 5), "new": {}})
    assert list(found) == ["method"]
    row = found["method"]
    assert row["grasps"] == 6
    assert row["success_before"]["rate"] == pytest.approx(3 / 6)
    assert row["success_after"]["rate"] == pytest.approx(2 / 6)
    assert row["change"]["rate"] == pytest.approx(-1 / 6)
    assert row["change"]["interval"] == pytest.approx([-1 / 2, 0])  # one scene twice, or the other
    assert list(row["transitions"].values()) == [1, 1, 1, 1, 1, 1]
    assert row["gains_per_loss"] == pytest.approx(1 / 2)
    assert (row["collided_before"], row["collided_after"]) == (0, 2)
    assert (row["penetration_before"], row["penetration_after"]) == pytest.approx((0.002, 0.001))
    assert row["processor_seconds"]["per_100_grasps"] == pytest.approx(100)
    top = row["top1"]
    assert set(top) == {"generator", "before", "after", "lesser"}  # there was no judge
    assert [top[rule]["refined"]["rate"] for rule in ("generator", "before", "after")] == [0.5, 0.5, 0.0]
    assert [top[rule]["unrefined"]["rate"] for rule in ("generator", "before", "after")] == [0.5, 0.5, 0.5]
    assert top["before"]["transitions"]["fail_to_success"] == 1
    assert top["before"]["transitions"]["success_to_collided"] == 1
    assert top["after"]["transitions"]["fail_to_collided"] == 1


@pytest.mark.usefixtures("figures")
def test_variants_leave_terms_out_or_weigh_them_otherwise(tmp_path: Path) -> None:
    import refine

    def told(choice: refine.Choice) -> dict[str, float]:
        return {term.name: term.weight for term in choice(default_terms(EM2(width=8), None))}

    known = told(list)
    assert told(refine.without("penetration", "shadow")) == {
        name: weight for name, weight in known.items() if name not in ("penetration", "shadow")
    }
    assert told(refine.weighed({"spread": -2.0, "table": 0})) == {
        name: -2.0 if name == "spread" else weight for name, weight in known.items() if name != "table"
    }
    assert told(refine.whatever_rises) == known
    (table,) = (term for term in refine.whatever_rises(default_terms(EM2(width=8), None)) if isinstance(term, Table))
    assert type(table).accepts is not Table.accepts
    assert isinstance(table, Term)
    with pytest.raises(ValueError, match="terms speed are unknown"):
        refine.weighed({"speed": 1.0})
    tries = tmp_path / "tries.json"
    tries.write_text(json.dumps({"odd": {"variables": "odd"}}))
    with pytest.raises(ValueError, match="variables 'odd' are unknown; use one of grip, uncoupled, waypoints"):
        refine.variants(EM2(width=8), EM2(width=16), {}, tries)


@pytest.mark.usefixtures("figures")
def test_the_record_of_what_is_set_is_that_of_the_results() -> None:
    import refine

    kept = json.loads((BENCHMARKS / "results" / "refinement_ablation.json").read_text())["defaults"]
    assert refine.default_settings() == kept


@pytest.mark.slow
@pytest.mark.usefixtures("figures")
def test_only_what_was_replaced_is_tried_again(hand: Hand) -> None:
    import refine

    world, view, seed, _ = refine.set_scene("validation", None, 2)
    generator = make_generator("kopicki", hand)
    given = refine.give(generator, world, view, seed, num_grasps=6)
    assert len(given) == 6
    assert given.success.any()
    grasps, replaced = given.grasps(hand), np.array([True, False] * 3)

    def sunk(some: Grasps, *_: object) -> Refinement:
        wrist = some.wrist.clone()
        wrist[..., 2] -= 0.2  # also those not accepted, which a second trial would tell
        score, flag = torch.full((len(some),), 0.5), torch.tensor(replaced)
        return Refinement(replace(some, wrist=wrist), score, score, flag, ~flag & False, {})

    row = refine.attempt(sunk, grasps, given, world, view, generator.density(view, seed))
    assert (row.outcome[~replaced] == given.outcome[~replaced]).all()
    assert (row.penetration[~replaced] == given.penetration[~replaced]).all()
    assert row.collided[replaced].all()
    assert not row.success[replaced].any()
    assert np.isnan(row.judge_after).all()

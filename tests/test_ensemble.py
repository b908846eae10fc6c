"""An ensemble is the mean of its members, and knows how far they are apart."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import synthetic
import torch
from safetensors.torch import load_file

from dexzoo.comparison import scores
from dexzoo.data.datamodule import GraspDataModule
from dexzoo.grasp import Grasps
from dexzoo.models import zoo
from dexzoo.models.em_fk import EMFK
from dexzoo.models.ensemble import Ensemble
from dexzoo.models.evaluator import GraspEvaluator
from dexzoo.models.ffh import FFH
from dexzoo.perception.camera import look_at
from dexzoo.perception.observation import Observation
from dexzoo.training.command_line import main

CENTER = np.array([0.0, 0, 0.04])


@pytest.fixture(scope="module")
def members(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Two of one kind and one of another, the last with a calibration."""
    folder = tmp_path_factory.mktemp("members")
    torch.manual_seed(0)
    made = [EMFK(width=16, num_blocks=1), EMFK(width=16, num_blocks=1), FFH(width=16)]
    made[2].temperature.fill_(2.0)
    made[2].offset.fill_(0.5)
    return [str(model.save(folder / f"{i}.safetensors", half=False)) for i, model in enumerate(made)]


@pytest.fixture(scope="module")
def view() -> Observation:
    return synthetic.render("ball", np.full(3, 0.04), CENTER, look_at(CENTER, 0.5, 0.3, 0.8))


@pytest.fixture(scope="module")
def grasps() -> Grasps:
    return synthetic.draw_grasps(CENTER, 6, np.random.default_rng(0))[0]


def test_mean_and_spread_are_those_of_the_members(members: list[str], view: Observation, grasps: Grasps) -> None:
    every = []
    for member in members:
        model = zoo.load(member)
        logit = model.prepare(view).logit(grasps)
        every.append(logit / model.temperature + model.offset)
    ensemble = Ensemble(members=members).eval()
    mean, spread = ensemble.prepare(view).logit_and_spread(grasps)
    torch.testing.assert_close(mean, torch.stack(every).mean(0))
    torch.testing.assert_close(spread, torch.stack(every).std(0, correction=0))
    torch.testing.assert_close(ensemble.score(grasps, view), mean.sigmoid())


def test_spread_has_a_slope_even_where_members_agree(members: list[str], view: Observation, grasps: Grasps) -> None:
    for names, varies in (([members[0]] * 2, False), (members, True)):
        wrist, joints = grasps.wrist.clone().requires_grad_(), grasps.joints.clone().requires_grad_()
        trajectory = replace(grasps.trajectory, wrist=wrist, joints=joints)
        _, spread = Ensemble(members=names).eval().prepare(view).logit_and_spread(trajectory)
        for slope in torch.autograd.grad(spread.sum(), (wrist, joints)):
            assert torch.isfinite(slope).all()
            assert bool(slope.any()) == varies


def test_a_model_alone_has_no_spread(members: list[str], view: Observation, grasps: Grasps) -> None:
    prepared = zoo.load(members[0]).prepare(view)
    logit, spread = prepared.logit_and_spread(grasps)
    torch.testing.assert_close(logit, prepared.logit(grasps))
    assert not spread.any()


def test_the_cost_is_that_of_all_members(
    members: list[str], view: Observation, grasps: Grasps, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scores, "NUM_TIMED", 6)
    image, trajectory = view.aimed().image()[None], grasps.trajectory
    every = [scores.measure(zoo.load(member), image, trajectory) for member in members]
    assert [one.megabytes for one in every] == [round(Path(member).stat().st_size / 1e6, 1) for member in members]
    pair = Ensemble(members=members[:2]).save(tmp_path)
    for ensemble in (Ensemble(members=members), Ensemble(members=[str(pair), members[2]])):
        cost = scores.measure(ensemble.eval(), image, trajectory)
        assert cost.parameters == sum(one.parameters for one in every)
        assert cost.megabytes == pytest.approx(sum(one.megabytes for one in every), abs=0.2)  # each is rounded


def test_a_saved_ensemble_is_a_list_of_members(
    members: list[str], view: Observation, grasps: Grasps, tmp_path: Path
) -> None:
    ensemble = Ensemble(members=members).eval()
    ensemble.calibrate(torch.tensor([-1.0, 0.5, 1.0, 2.0]), torch.tensor([0.0, 1, 0, 1]))
    path = ensemble.save(tmp_path)
    assert set(load_file(path)) == {"temperature", "offset"}
    again = zoo.load(tmp_path)
    assert again.arguments["members"] == members
    torch.testing.assert_close(again.score(grasps, view), ensemble.score(grasps, view))


def test_fit_calibrates_it_on_validation_scenes(members: list[str], tmp_path: Path) -> None:
    folder, cache = str(synthetic.write(tmp_path / "grasps", num_grasps=40)), str(tmp_path / "cache")
    options = {"model.members": json.dumps(members[:2]), "data.folder": folder, "data.cache": cache}
    options |= {"trainer.logger.save_dir": str(tmp_path), "trainer.enable_progress_bar": "false"}
    main(["fit", "--config", "ensemble.yaml", *(f"--{name}={value}" for name, value in options.items())])
    made, card = zoo.load(tmp_path / "ensemble" / "version_0"), tmp_path / "ensemble" / "version_0" / "ensemble.json"
    assert json.loads(card.read_text())["grasps_seen"] == 0
    dataset = GraspDataModule(folder, cache=cache).dataset("validation", made)

    def probability(ensemble: GraspEvaluator) -> torch.Tensor:
        with torch.no_grad():
            return ensemble.probability(ensemble.batch_logit(dataset[list(range(len(dataset)))]))

    loss = torch.nn.functional.binary_cross_entropy
    before, after = (probability(ensemble) for ensemble in (Ensemble(members=members[:2]).eval(), made))
    assert loss(after, dataset.success) < loss(before, dataset.success)
    # where the likelihood is greatest
    torch.testing.assert_close(after.mean(), dataset.success.mean(), atol=1e-3, rtol=0)


def test_the_digest_is_that_of_all_weights(members: list[str]) -> None:
    digests = {Ensemble(members=names).digest for names in (members, members[:2], members[1:2], members[:1])}
    assert len(digests) == 4
    assert Ensemble(members=members).digest in digests
    calibrated = Ensemble(members=members)
    calibrated.offset.fill_(0.1)
    assert calibrated.digest not in digests
    EMFK(width=16, num_blocks=1).bfloat16().digest  # has one  # noqa: B018


def test_members_that_are_not_there_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"weights .*gone\.safetensors do not exist"):
        Ensemble(members=[str(tmp_path / "gone.safetensors")])
    gone = FFH(width=8).save(tmp_path / "gone.safetensors")
    saved = Ensemble(members=[str(gone)]).save(tmp_path / "both")
    gone.unlink()
    with pytest.raises(FileNotFoundError, match=r"both.ensemble\.json names what .*gone\.safetensors do not exist"):
        zoo.load(saved)
    with pytest.raises(ValueError, match="needs at least one member"):
        Ensemble(members=[])

import itertools
import json
import pickle
import runpy
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import synthetic
import torch
import torchvision
import yaml
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.plugins.precision import MixedPrecision
from safetensors.torch import load_file
from sklearn.preprocessing import StandardScaler

from dexzoo.comparison.scores import one_view
from dexzoo.data.datamodule import GraspDataModule
from dexzoo.grasp import Grasps, Trajectory
from dexzoo.hand import Hand
from dexzoo.models import encoders, evaluator, registry, trunks, zoo
from dexzoo.models.em1 import EM1
from dexzoo.models.em2 import EM2
from dexzoo.models.em_fk import EMFK
from dexzoo.models.evaluator import GraspEvaluator
from dexzoo.perception import Observation, View
from dexzoo.resources import resource
from dexzoo.training.command_line import CommandLine, main

SMOKE = ["--config=smoke.yaml", "--trainer.max_steps=3", "--trainer.val_check_interval=3", "--model.width=64", "--json"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return synthetic.write(tmp_path_factory.mktemp("grasps"))


@pytest.fixture(scope="module")
def data(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> GraspDataModule:
    return GraspDataModule(str(folder), cache=str(tmp_path_factory.mktemp("cache")))


@pytest.fixture(scope="module", autouse=True)
def resnet_trunk() -> Iterator[None]:
    """ResNet-50 with drawn weights where those trained here are not beside the tests."""
    if (resource("checkpoints") / "resnet50_views.safetensors").is_file():
        yield
        return
    torch.manual_seed(0)
    weights = torchvision.models.resnet50(zero_init_residual=True).state_dict()
    weights = {name: value for name, value in weights.items() if not name.startswith("fc.")}
    with pytest.MonkeyPatch.context() as patch:
        drawn = trunks.TRUNKS["resnet50_views"]._replace(weights=lambda: weights)
        patch.setitem(trunks.TRUNKS, "resnet50_views", drawn)
        yield


EXAMPLE = Path(__file__).parent.parent / "examples" / "02_your_architecture.py"
YOURS: type[GraspEvaluator] = runpy.run_path(str(EXAMPLE), run_name="example")["TwoBranches"]
"""The example's architecture is no part of the zoo and keeps the same contract."""


@pytest.fixture(scope="module", params=[*registry.list_models(), YOURS.architecture])
def model(request: pytest.FixtureRequest, data: GraspDataModule) -> GraspEvaluator:
    torch.manual_seed(0)
    made = zoo.model_class(request.param)()
    data.fit_statistics(made)
    return made.eval()


@pytest.fixture(scope="module")
def observation(data: GraspDataModule) -> Observation:
    return data.source.observation(0)


@pytest.fixture(scope="module")
def grasps(data: GraspDataModule) -> Grasps:
    return data.source.world_grasps[:12]


# every model of the zoo


def test_a_model_is_registered_under_its_own_name(model: GraspEvaluator) -> None:
    assert zoo.model_class(model.architecture) is type(model)
    assert set(model.arguments) >= {"optimizer", "learning_rate", "weight_decay", "average_decay"}
    assert all(isinstance(value, (str, int, float, bool, list)) for value in model.arguments.values())


def test_shapes(model: GraspEvaluator, data: GraspDataModule) -> None:
    images = torch.stack([data.source.observation(view).image() for view in range(2)])
    encoding = model.encode(images)
    assert all(len(value) == 2 for value in encoding.values())
    assert model.logit(encoding, Trajectory.stack(data.aimed_grasps[:6].split(3))).shape == (2, 3)


def test_views_and_grasps_do_not_mix(model: GraspEvaluator, data: GraspDataModule) -> None:
    encoding = model.encode(torch.stack([data.source.observation(view).image() for view in (0, 3)]))
    grasps = data.aimed_grasps[:6]
    whole = model.logit(encoding, Trajectory.stack(grasps.split(3)))
    one = model.logit({name: value[1:] for name, value in encoding.items()}, one_view(grasps[5]))
    torch.testing.assert_close(whole[1, 2], one[0, 0], atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("paired", [[2, 0, 1, 0, 2, 2], [0, 0, 0], [1, 0]])
@pytest.mark.parametrize("encoded", [True, False])
def test_a_batch_is_its_grasps_one_by_one(
    model: GraspEvaluator, data: GraspDataModule, paired: list[int], encoded: bool
) -> None:
    images = torch.stack([data.source.observation(view).image() for view in range(max(paired) + 1)])
    view, grasps = torch.tensor(paired), data.aimed_grasps[: len(paired)]
    with torch.no_grad():
        encoding = model.encode(images)
        batch = evaluator.Batch(encoding if encoded else images, view, grasps, torch.zeros(len(view)), view)
        alone = [
            model.logit({name: value[v, None] for name, value in encoding.items()}, one_view(grasp)).item()
            for v, grasp in zip(paired, grasps.split(1), strict=True)
        ]
        found = model.batch_logit(batch)
    torch.testing.assert_close(found, torch.tensor(alone), atol=1e-4, rtol=1e-4)


def test_logits_follow_every_part_of_a_grasp(model: GraspEvaluator, data: GraspDataModule) -> None:
    encoding = model.encode(data.source.observation(0).image()[None])
    grasps = one_view(data.aimed_grasps[:3])
    parts = (grasps.wrist.requires_grad_(), grasps.joints.requires_grad_())
    wrist, joints = torch.autograd.grad(model.logit(encoding, grasps).sum(), parts)
    for slope in (wrist[..., :3], wrist[..., 3:], joints):
        assert (slope.abs().sum((-1, -2)) > 0).all()


def test_slopes_agree_with_finite_differences(model: GraspEvaluator, data: GraspDataModule) -> None:
    exact = zoo.model_class(model.architecture)(**model.arguments).double().eval()
    exact.load_state_dict(model.state_dict())
    encoding = {name: value.double() for name, value in model.encode(data.source.observation(0).image()[None]).items()}
    grasps = one_view(data.aimed_grasps[:2]).to(torch.float64)
    parts = (grasps.wrist.requires_grad_(), grasps.joints.requires_grad_())
    slopes = torch.autograd.grad(exact.logit(encoding, grasps).sum(), parts)
    generator = torch.Generator().manual_seed(0)
    for _ in range(5):
        ways = [torch.randn(part.shape, generator=generator, dtype=torch.float64) for part in parts]

        def moved(step: float, ways: list[torch.Tensor] = ways) -> torch.Tensor:
            wrist, joints = (part + step * way for part, way in zip(parts, ways, strict=True))
            return exact.logit(encoding, Trajectory(wrist, joints, grasps.grasp_type)).sum()

        with torch.no_grad():
            rise = (moved(1e-8) - moved(-1e-8)) / 2e-8  # short: a ReLU may lie nearer than that to its kink
        expected = sum((slope * way).sum() for slope, way in zip(slopes, ways, strict=True))
        assert float(rise) == pytest.approx(float(expected), rel=0.02, abs=2e-6)


def test_scores_are_probabilities_of_grasps_in_the_world_frame(
    model: GraspEvaluator, observation: Observation, grasps: Grasps
) -> None:
    p = model.score(grasps, observation)
    assert p.shape == (12,)
    assert ((p > 0) & (p < 1)).all()
    aimed = observation.aimed()
    in_camera = grasps.trajectory.transformed(np.linalg.inv(aimed.T_world_camera))
    with torch.no_grad():
        logits = model.logit(model.encode(aimed.image()[None]), one_view(in_camera))[0]
    torch.testing.assert_close(logits.sigmoid(), p, atol=1e-4, rtol=0)
    logits = model.prepare(observation).logit(grasps)
    torch.testing.assert_close(logits.sigmoid(), p, atol=1e-5, rtol=0)
    torch.testing.assert_close(model.score(observation, grasps), p)
    assert model.score(grasps[:0], observation).shape == (0,)


def test_a_hand_that_the_model_does_not_know_is_refused(
    model: GraspEvaluator, observation: Observation, grasps: Grasps
) -> None:
    left = Grasps.of(grasps.trajectory, Hand.load("dlr2", side="left"))
    message = rf"^evaluator {model.architecture} knows the hand dlr2 \(right\), not dlr2 \(left\)$"
    with pytest.raises(ValueError, match=message):
        model.score(left, observation)
    with pytest.raises(ValueError, match=message):
        model.score(left[:0], observation)


def test_the_image_is_encoded_once(
    model: GraspEvaluator, observation: Observation, grasps: Grasps, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []
    encode = model.encode
    whole = model.score(grasps, observation)
    monkeypatch.setattr(model, "encode", lambda images: calls.append(tuple(images.shape)) or encode(images))
    monkeypatch.setattr(evaluator, "CHUNK", 5)
    view = View(observation)
    for _ in range(2):
        torch.testing.assert_close(model.score(grasps, view), whole, atol=1e-5, rtol=0)
        assert calls == [(1, 2, 224, 224)]


def test_scoring_drops_nothing_and_leaves_the_mode(
    model: GraspEvaluator, observation: Observation, grasps: Grasps
) -> None:
    quiet = model.score(grasps, observation)
    model.train()
    *_, still = model.modules()
    still.eval()
    torch.testing.assert_close(model.score(grasps, observation), quiet)
    torch.testing.assert_close(model.probability(model.prepare(observation).logit(grasps)), quiet, atol=1e-5, rtol=0)
    assert model.training
    assert not still.training
    model.eval()


def test_saving_and_loading_keep_the_scores(
    model: GraspEvaluator, observation: Observation, grasps: Grasps, tmp_path: Path
) -> None:
    before = model.score(grasps, observation)
    path = model.save(tmp_path, half=False, card={"seed": 3})
    assert path.name == f"{model.architecture}.safetensors"
    again = zoo.load(tmp_path)
    assert type(again) is type(model)
    assert not again.training
    torch.testing.assert_close(again.score(grasps, observation), before, atol=1e-6, rtol=0)
    model.save(tmp_path)
    torch.testing.assert_close(zoo.load(path).score(grasps, observation), before, atol=5e-3, rtol=0)
    card = json.loads(path.with_suffix(".json").read_text())
    assert card["arguments"] == model.arguments
    assert not any("trunk" in name for name in load_file(path))


def test_a_world_laid_out_otherwise_changes_nothing(
    model: GraspEvaluator, observation: Observation, grasps: Grasps
) -> None:
    motion = torch.eye(4, dtype=torch.float64)
    motion[:2, :2] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
    motion[:2, 3] = torch.tensor([0.3, -2.0])
    moved = Observation(
        observation.depth, observation.camera, motion.numpy() @ observation.T_world_camera, mask=observation.mask
    )
    expected = model.score(grasps, observation)
    torch.testing.assert_close(model.score(grasps.transformed(motion), moved), expected, atol=1e-3, rtol=0)


def test_a_half_turn_of_sign_in_a_quaternion_changes_nothing(model: GraspEvaluator, data: GraspDataModule) -> None:
    encoding = model.encode(data.source.observation(0).image()[None])
    grasps = one_view(data.aimed_grasps[:4])
    flipped = replace(grasps, wrist=torch.cat((grasps.position, -grasps.quaternion), -1))
    torch.testing.assert_close(model.logit(encoding, flipped), model.logit(encoding, grasps))


def test_what_a_model_is_asked_wrongly_gets_one_line(observation: Observation, grasps: Grasps) -> None:
    assert EM2(width=8).hands == ["dlr2"]
    with pytest.raises(ValueError, match=r"^hands is empty; name at least one hand of robots/$"):
        EM2(width=8, hands=[])
    with pytest.raises(FileNotFoundError, match="two_thumbs"):
        EM2(width=8, hands=["two_thumbs"])
    for pair in ((grasps, grasps), (observation, View(observation))):
        with pytest.raises(ValueError, match=r"^score takes grasps and an observation$"):
            EM2(width=8).score(*pair)


def test_your_own_architecture_needs_no_more_than_a_subclass(tmp_path: Path) -> None:
    assert YOURS.architecture not in registry.list_models()
    path = YOURS(width=8).save(tmp_path)
    assert isinstance(zoo.load(path), YOURS)
    change_card(path, architecture="three_branches")
    with pytest.raises(ValueError, match=r"model 'three_branches' is unknown.*import your own first"):
        zoo.load(path)


# the thesis' architectures


def count(module: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def test_em1_has_the_thesis_sizes() -> None:
    with torch.device("meta"):
        image, hand = 512 * 7 * 7 * 1024 + 1024, 280 * 1024 + 1024
        assert count(EM1()) == image + hand + 4 * (1024 * 1024 + 1024) + 2 * 1024 + 2 == 30_179_330


@pytest.mark.parametrize(("width", "total"), [(2048, 11_206_978), (4096, 25_895_234)])
def test_em2_has_the_thesis_sizes(width: int, total: int) -> None:
    sizes = [1, 64, 64, 128, 128, 256, 256, 256, *[512] * 6]
    hand = sum(3 * a * b + b for a, b in itertools.pairwise(sizes))
    head = 1024 * width + width + width * width + width + 2 * width + 2
    with torch.device("meta"):
        assert count(EM2(width=width)) == hand + head == total


def test_280_numbers_are_one_hot_type_then_ten_times_27(data: GraspDataModule) -> None:
    grasps = data.aimed_grasps[:5]
    vector = encoders.GraspVector.flatten(grasps)
    assert vector.shape == (5, 280)
    assert torch.equal(vector[:, :10].argmax(1), grasps.grasp_type)
    assert torch.equal(vector[:, :10].sum(1), torch.ones(5))
    torch.testing.assert_close(vector[:, 10:].reshape(5, 10, 27), torch.cat((grasps.wrist, grasps.joints), -1))


def test_inputs_are_standardized_and_constant_ones_survive(data: GraspDataModule) -> None:
    layer = encoders.GraspVector()
    wrist = data.aimed_grasps.wrist.clone()
    wrist[..., 0] = 0.3
    grasps = replace(data.aimed_grasps, wrist=wrist)
    layer.fit_statistics(grasps)
    vector = layer(grasps)
    varied = vector.std(0) > 0.5
    torch.testing.assert_close(vector.mean(0), torch.zeros(280), atol=1e-4, rtol=0)
    torch.testing.assert_close(vector[:, varied].std(0), torch.ones(int(varied.sum())), atol=1e-3, rtol=0)
    assert (vector[:, 10].abs() < 1e-5).all()


def test_features_of_a_trunk_are_standardized_over_training_views(data: GraspDataModule) -> None:
    torch.manual_seed(0)
    images = data.source.images(range(4))[torch.arange(4)]
    model = EM2(width=16, standardize=True).eval()
    model.fit_statistics(images, data.aimed_grasps)
    features, grasps = model.encode(images)["features"], Trajectory.stack(data.aimed_grasps[:4].split(1))
    shown = features.clone()
    shown[0] += 10  # far outside what was seen in training
    plain = EM2(width=16).eval()
    plain.load_state_dict({name: value for name, value in model.state_dict().items() if "features." not in name})
    z = torch.from_numpy(StandardScaler().fit(features.double()).transform(shown.double())) * (3 / 4) ** 0.5
    assert z[0].min() > 3 > z[1:].abs().max()
    expected = plain.logit({"features": z.float().clamp(-3, 3)}, grasps)
    torch.testing.assert_close(model.logit({"features": shown}, grasps), expected, atol=1e-3, rtol=1e-3)


def test_gradients_can_be_clipped_where_precision_is_mixed() -> None:
    model = EM2(width=8, optimizer="adamw")
    model.trainer = Trainer(gradient_clip_val=1.0, logger=False, enable_checkpointing=False)
    for parameter in model.parameters():
        parameter.grad = torch.ones_like(parameter)
    MixedPrecision("bf16-mixed", "cpu").clip_gradients(model.configure_optimizers(), 1.0)
    size = torch.stack([parameter.grad.square().sum() for parameter in model.parameters()]).sum().sqrt()
    assert float(size) == pytest.approx(1.0, rel=1e-3)


def test_xavier(data: GraspDataModule) -> None:
    layer = EM2(width=512).head[3]
    assert isinstance(layer, torch.nn.Linear)
    assert float(layer.weight.detach().var()) == pytest.approx(2 / (512 + 512), rel=0.02)
    assert not layer.bias.detach().any()


# the command line


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def arguments(data: GraspDataModule) -> list[str]:
    return ["--data.folder", str(data.folder), "--data.cache", str(data.cache)]


@pytest.mark.parametrize("config", sorted(path.name for path in resource("configs").glob("*.yaml")))
@pytest.mark.usefixtures("here")
def test_every_configuration_runs(config: str, arguments: list[str]) -> None:
    main(["fit", "--config", config, *arguments, "--trainer.fast_dev_run", "1"])


@pytest.mark.parametrize("name", ["em1", "em2"])
def test_the_recipe_of_the_thesis_is_kept(name: str) -> None:
    config = yaml.safe_load((resource("configs") / f"{name}.yaml").read_text())
    section = {"optimizer": "sgd", "learning_rate": 0.001, "average_decay": 0.999, "dropout": 0.5, "gain": 1.0}
    assert config["model"]["init_args"].items() >= section.items()
    assert config["model"]["init_args"]["weight_decay"] == 0
    assert config["data"] == {"folder": "assets/grasps", "batch_size": 64, "sources": ["generated"]}
    assert config["trainer"]["max_steps"] == 300_000


def test_fit_writes_a_run_that_load_and_the_other_commands_take(
    here: Path, arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    main(["fit", *SMOKE, *arguments, "--seed", "5"])
    result = json.loads(capsys.readouterr().out)
    weights = Path(result["weights"])
    assert weights == Path("runs/smoke/version_0/em2.safetensors")
    card = json.loads(weights.with_suffix(".json").read_text())
    assert card["seed"] == 5
    assert card["arguments"]["width"] == 64
    assert card["command"].startswith("python -m dexzoo fit --config=smoke.yaml")
    assert card["data"]["train_grasps"] == 160
    assert card["grasps_seen"] == 3 * 32
    assert card["config"]["data"]["batch_size"] == 32
    assert card["config"]["trainer"]["max_steps"] == 3
    assert "logger" not in card["config"]["trainer"]
    assert card["metrics"].keys() >= {"validation_auroc", "validation_top1", "validation_loss"}
    assert isinstance(zoo.load(weights.parent), EM2)
    assert (weights.parent / "metrics.csv").is_file()

    # what is exported is the average that validation saw best, not the last raw weights
    checkpoint = torch.load(weights.parent / "checkpoints" / "best.ckpt", weights_only=True)
    exported = load_file(weights)
    raw = checkpoint["current_model_state"]
    average = {name: value for name, value in checkpoint["state_dict"].items() if name not in ("temperature", "offset")}
    assert all(torch.equal(exported[name].half(), value.half()) for name, value in average.items())
    assert any(not torch.equal(exported[name].half(), value.half()) for name, value in raw.items())

    figures = []
    for path in (weights.parent / "checkpoints" / "best.ckpt", weights.parent):
        main(["test", *SMOKE, *arguments, "--ckpt_path", str(path)])
        figures.append(json.loads(capsys.readouterr().out)["test_loss"])
    assert figures[0] == pytest.approx(figures[1], abs=1e-2)
    main(["predict", *SMOKE, *arguments, "--ckpt_path", str(weights)])
    predicted = json.loads(Path(json.loads(capsys.readouterr().out)["predictions"]).read_text())
    assert len(predicted["probability"]) == 40

    # resuming goes on from the step it stopped at
    resume = ["fit", *SMOKE, *arguments, "--ckpt_path", str(weights.parent / "checkpoints" / "best.ckpt")]
    main([*resume, "--trainer.max_steps", "5"])
    assert Path(json.loads(capsys.readouterr().out)["weights"]).is_file()


def test_your_own_architecture_is_trained_by_a_configuration(
    here: Path, arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "mypackage.py").write_text(EXAMPLE.read_text().replace('"two_branches"', '"my_net"'))
    monkeypatch.syspath_prepend(here)
    config = yaml.safe_load((resource("configs") / "smoke.yaml").read_text())
    config["model"] = {"class_path": "mypackage.TwoBranches", "init_args": {"width": 16, "optimizer": "adamw"}}
    (here / "my_net.yaml").write_text(yaml.safe_dump(config))
    main(["fit", "--config", "my_net.yaml", *arguments, "--json"])
    weights = Path(json.loads(capsys.readouterr().out)["weights"])
    assert weights.name == "my_net.safetensors"
    main(["test", "--config", "my_net.yaml", *arguments, "--json", "--ckpt_path", str(weights.parent)])
    assert json.loads(capsys.readouterr().out)["test_loss"] > 0


@pytest.mark.usefixtures("here")
def test_the_configuration_beats_what_a_checkpoint_stores(
    arguments: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    main(["fit", *SMOKE, *arguments, "--model.learning_rate", "0.01"])
    path = Path("runs/smoke/version_0/checkpoints/best.ckpt")
    checkpoint = torch.load(path, weights_only=True)
    assert "hyper_parameters" not in checkpoint
    checkpoint["hyper_parameters"] = {"learning_rate": 0.01, "_class_path": "dexzoo.models.em2.EM2"}
    torch.save(checkpoint, path)
    seen = []
    monkeypatch.setattr(CommandLine, "test", lambda self, **_: seen.append(self.model.learning_rate))
    main(["test", *SMOKE, *arguments, "--model.learning_rate", "0.5", "--ckpt_path", str(path)])
    assert seen == [0.5]


class Recorder(Callback):
    """The weights after each step, and those that validation sees."""

    def __init__(self) -> None:
        self.raw: list[torch.Tensor] = []
        self.validated: list[torch.Tensor] = []

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: object) -> None:
        self.raw.append(pl_module.head[0].weight.detach().clone())

    def on_validation_batch_start(self, trainer: Trainer, pl_module: LightningModule, *_: object) -> None:
        self.validated.append(pl_module.head[0].weight.detach().clone())


def test_validation_sees_the_moving_average(data: GraspDataModule) -> None:
    torch.manual_seed(0)
    model = EM2(width=8, optimizer="adamw", average_decay=0.3)
    recorder = Recorder()
    quiet = {
        "logger": False,
        "enable_checkpointing": False,
        "enable_progress_bar": False,
        "enable_model_summary": False,
    }
    steps = {"max_steps": 4, "val_check_interval": 4, "check_val_every_n_epoch": None, "num_sanity_val_steps": 0}
    trainer = Trainer(accelerator="cpu", limit_val_batches=1, callbacks=[recorder], **steps, **quiet)
    trainer.fit(model, datamodule=data)
    average = recorder.raw[0]
    for step, weight in enumerate(recorder.raw[1:], start=1):
        decay = min(0.3, (1 + step) / (10 + step))
        average = decay * average + (1 - decay) * weight
    torch.testing.assert_close(recorder.validated[0], average)
    torch.testing.assert_close(model.head[0].weight.detach(), average)
    trainer.validate(model, datamodule=data, verbose=False)
    torch.testing.assert_close(recorder.validated[-1], average)


@pytest.mark.usefixtures("here")
def test_calls_that_are_wrong_get_one_line(arguments: list[str], tmp_path: Path) -> None:
    wrong: list[tuple[list[str], str]] = [
        ([], "give one of fit, validate, test, predict, got nothing"),
        (["train"], "got train"),
        (["test", "--ckpt_path", "x.ckpt"], "test needs a configuration .*add --config em2.yaml"),
        (["fit", "--config", "em9.yaml"], "configuration em9.yaml does not exist.*em2.yaml"),
        (["fit", "--config", "smoke.yaml", "--model.wdth", "3"], "'wdth' is not accepted"),
        (["fit", "--config=smoke.yaml", "--model.optimizer", "adam"], "optimizer 'adam' is unknown"),
        (["fit", "--config", "smoke.yaml", "--data.folder", "nowhere"], "grasp set nowhere has no scenes/.+parquet"),
        (["test", *SMOKE, *arguments, "--ckpt_path", "x.ckpt"], "checkpoint x.ckpt does not exist"),
    ]
    bad = tmp_path / "bad.ckpt"
    bad.write_bytes(pickle.dumps(Path("harmless"), protocol=2))
    wrong.append((["test", *SMOKE, *arguments, "--ckpt_path", str(bad)], "is not what fit writes, refused"))
    EM2(width=8).save(tmp_path / "narrow.safetensors")
    other = ["test", *SMOKE, *arguments, "--ckpt_path", str(tmp_path / "narrow.safetensors")]
    sizes = r"narrow\.safetensors holds another architecture than em2 .*by width, 8 in the file and 64 as configured;"
    wrong.append((other, sizes))
    EMFK(width=64, cloud=False, dropout=0.3).save(tmp_path / "blind.safetensors")
    both = (
        "than em_fk .*by width, 64 in the file and 128 as configured; cloud, False in the file and True as configured;"
    )
    blind = ["--config=em_fk.yaml", *arguments, "--ckpt_path", str(tmp_path / "blind.safetensors")]
    wrong.append((["fit", *blind], both))
    wrong.append((["test", *SMOKE, *arguments, *blind[-2:]], "than em2 as configured, by [0-9]+ tensors such as"))
    for args, message in wrong:
        with pytest.raises((ValueError, FileNotFoundError), match=message) as caught:
            main(args)
        assert "\n" not in str(caught.value)


@pytest.mark.usefixtures("here")
def test_a_logger_without_its_package_says_how_to_get_it(arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    for package in ("_TENSORBOARD_AVAILABLE", "_TENSORBOARDX_AVAILABLE"):
        monkeypatch.setattr(f"lightning.fabric.loggers.tensorboard.{package}", False)
    for name in ("TensorBoardLogger", "lightning.pytorch.loggers.TensorBoardLogger"):
        with pytest.raises(ValueError, match=r"needs tensorboard; .*`pip install dexzoo\[tensorboard\]`$") as caught:
            main(["fit", *SMOKE, *arguments, f"--trainer.logger={name}"])
        assert "\n" not in str(caught.value)


def test_help_ends_well(capsys: pytest.CaptureFixture[str]) -> None:
    for args in (["fit", "--help"], ["--help"]):
        with pytest.raises(SystemExit) as caught:
            main(args)
        assert caught.value.code == 0
    assert "predict" in capsys.readouterr().out


# files


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return EM2(width=8).save(tmp_path_factory.mktemp("saved"))


def copy(saved: Path, folder: Path) -> Path:
    for suffix in (".safetensors", ".json"):
        (folder / "em2").with_suffix(suffix).write_bytes(saved.with_suffix(suffix).read_bytes())
    return folder / "em2.safetensors"


def change_card(path: Path, **values: object) -> None:
    card = json.loads(path.with_suffix(".json").read_text())
    path.with_suffix(".json").write_text(json.dumps(card | values))


def test_damaged_weights_are_refused_in_one_line(saved: Path, tmp_path: Path) -> None:
    path = copy(saved, tmp_path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"em2\.safetensors is truncated or not a safetensors file"):
        zoo.load(path)
    content = bytearray(saved.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(ValueError, match="does not match the sha256 in its card"):
        zoo.load(path)
    copy(saved, tmp_path)
    change_card(path, architecture="em1", arguments={})
    with pytest.raises(ValueError, match="holds another architecture than em1"):
        zoo.load(path)
    change_card(path, architecture="em7")
    with pytest.raises(ValueError, match="model 'em7' is unknown, did you mean em"):
        zoo.load(path)
    change_card(path, architecture="em2", arguments={"depth": 3})
    with pytest.raises(ValueError, match=r"EM2 refuses its arguments: .*depth"):
        zoo.load(path)
    change_card(path, format="other")
    with pytest.raises(ValueError, match="is not of an evaluator"):
        zoo.load(path)
    path.with_suffix(".json").write_text("{")
    with pytest.raises(ValueError, match="is not JSON"):
        zoo.load(path)
    path.with_suffix(".json").unlink()
    with pytest.raises(FileNotFoundError, match=r"has no card em2\.json beside it"):
        zoo.load(path)


@pytest.mark.parametrize("name", ["weights.ckpt", "weights.pt", "weights.safetensors"])
def test_a_pickle_is_refused_unread(name: str, tmp_path: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple[object, ...]:
            return (Path.touch, (tmp_path / "sprung",))

    (tmp_path / name).write_bytes(pickle.dumps(Trap()))
    with pytest.raises(ValueError, match="is a pickle, which could run code, and was not read"):
        zoo.load(tmp_path / name)
    torch.save({"weight": torch.zeros(1)}, tmp_path / name)
    with pytest.raises(ValueError, match="is a pickle"):
        zoo.load(tmp_path / name)
    assert not (tmp_path / "sprung").exists()


def test_names_and_places_that_do_not_exist(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="model 'em22' is unknown, did you mean em2"):
        zoo.load("em22")
    with pytest.raises(ValueError, match="model 'zzz' is unknown; known are em1, em2"):
        zoo.load("zzz")
    with pytest.raises(FileNotFoundError, match=r"weights .*none\.safetensors do not exist"):
        zoo.load(tmp_path / "none.safetensors")
    with pytest.raises(FileNotFoundError, match=r"must hold one \.safetensors file of weights, found none"):
        zoo.load(tmp_path)
    with pytest.raises(ValueError, match="must be hf://ORGANIZATION/REPOSITORY"):
        zoo.load("hf://em2")
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(ValueError, match=r"needs huggingface_hub; install it with `pip install dexzoo\[hub\]`"):
        zoo.load("hf://someone/em2")
    monkeypatch.setattr(registry, "resource", lambda name: tmp_path if name == "checkpoints" else resource(name))
    for name, how in (
        ("em1", r"train them with .*--config em1-adamw\.yaml"),
        ("ffh", r"train them with .*--config ffh\.yaml"),
        ("em3", r"train them with .*--config em3\.yaml"),
    ):
        with pytest.raises(FileNotFoundError, match=f"model {name} comes without weights; {how}"):
            zoo.load(name)


def test_a_hub_repository_is_a_folder(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def fetch(name: str, allow_patterns: list[str]) -> str:
        asked.append((name, allow_patterns))
        if name == "someone/none":
            raise OSError("no such repository\nsee the documentation")
        return str(saved.parent)

    # what stands in for the package and its network
    monkeypatch.setitem(sys.modules, "huggingface_hub", SimpleNamespace(snapshot_download=fetch))
    loaded = zoo.load("hf://someone/em2").state_dict()
    assert all(torch.equal(value, loaded[name]) for name, value in zoo.load(saved).state_dict().items())
    assert asked == [("someone/em2", ["*.safetensors", "*.json"])]
    with pytest.raises(FileNotFoundError, match=r"^hf://someone/none cannot be fetched: no such repository$"):
        zoo.load("hf://someone/none")

"""Trunks hold the weights that their cards say, converted right, and are frozen."""

import hashlib
import importlib.util
import json
from pathlib import Path

import pytest
import synthetic
import torch
from lightning.pytorch import LightningModule
from safetensors.torch import save_file

from dexzoo.data.grasp_set import GraspSet
from dexzoo.models import trunks
from dexzoo.models.em1 import EM1
from dexzoo.models.em2 import EM2
from dexzoo.models.em3 import EM3
from dexzoo.models.encoders import fast_bfloat16
from dexzoo.resources import resource

SHIPPED = {"hed": ("vgg16_hed", 14_714_688), "lite0": ("efficientnet_lite0", 3_350_000)}


def count(module: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_trunk_is_what_its_card_says(name: str) -> None:
    path = resource("checkpoints") / f"{SHIPPED[name][0]}.safetensors"
    card = json.loads(path.with_suffix(".json").read_text())
    assert hashlib.sha256(path.read_bytes()).hexdigest() == card["sha256"]


# golden/NAME.py computes what the source's own arrays answer; ours are stored in float16
@pytest.mark.parametrize(("name", "size", "scale"), [("hed", 32, 60.0), ("lite0", 64, 0.5)])
def test_a_trunk_is_frozen_and_converted_right(name: str, size: int, scale: float) -> None:
    trunk = trunks.load_trunk(name)
    file, total = SHIPPED[name]
    assert count(trunk) == total
    assert not any(parameter.requires_grad for parameter in trunk.parameters())
    golden = json.loads((Path(__file__).parent / "golden" / f"{file}.json").read_text())
    channel, row, column = torch.meshgrid(torch.arange(3), torch.arange(size), torch.arange(size), indexing="ij")
    features = trunk(scale * torch.sin(0.3 * row + 0.7 * column + channel)[None])[0]
    expected = torch.tensor(golden["features"])
    largest = float(features.max())
    torch.testing.assert_close(features[golden["channels"]], expected, atol=5e-3 * largest, rtol=0)
    assert float(features.mean()) == pytest.approx(golden["mean"], rel=5e-3)


@pytest.mark.parametrize(
    ("abilities", "fast"),
    [
        ({"cpu_name": "AMD EPYC"}, False),
        ({"cpu_name": "AMD EPYC", "avx512_bf16": True}, True),
        ({"cpu_name": "Intel Xeon", "avx512_bf16": True, "amx_bf16": False}, False),
        ({"cpu_name": "Intel Xeon", "avx512_bf16": True, "amx_bf16": True}, True),
        ({"cpu_name": "Neoverse V1", "bf16": True}, True),
    ],
)
def test_where_bfloat16_is_fast(monkeypatch: pytest.MonkeyPatch, abilities: dict[str, object], fast: bool) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: abilities)
    assert fast_bfloat16(torch.device("cpu")) is fast
    assert fast_bfloat16(torch.device("cuda"))


@pytest.mark.parametrize("name", trunks.TRUNKS)
def test_a_trunk_has_the_channels_it_claims(name: str) -> None:
    with torch.device("meta"):
        network = trunks.TRUNKS[name].build()
        assert network(torch.zeros(1, 3, 224, 224)).shape[:2] == (1, trunks.TRUNKS[name].channels)


def test_a_card_tells_where_a_shipped_trunk_comes_from() -> None:
    for name in SHIPPED:
        card = trunks.trunk_card(name)
        assert card is not None
        assert {"trunk", "source", "license", "paper", "sha256"} <= set(card)
    assert trunks.trunk_card("imagenet") is None
    with pytest.raises(ValueError, match="trunk 'resnet' is unknown"):
        trunks.trunk_card("resnet")


def test_a_stranger_trunk_is_named() -> None:
    with pytest.raises(ValueError, match="trunk 'resnet' is unknown; use one of hed, imagenet"):
        EM2(trunk="resnet")
    with pytest.raises(ValueError, match="trunk 'lite0' is no VGG-16"):
        EM1(trunk="lite0")


def test_weights_that_cannot_be_had_are_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    trunks.load_trunk.cache_clear()
    monkeypatch.setattr(trunks, "resource", lambda name: tmp_path)
    with pytest.raises(FileNotFoundError, match=r"trunk weights .*vgg16_hed\.safetensors are missing; use another"):
        trunks.load_trunk("hed")

    def offline(*_: object, **__: object) -> None:
        raise OSError("no network")

    monkeypatch.setattr("torchvision.models._api.load_state_dict_from_url", offline)
    with pytest.raises(FileNotFoundError, match=r"ImageNet weights cannot be fetched .*use a shipped trunk"):
        trunks.load_trunk("resnet50")


def test_each_trunk_is_loaded_once(monkeypatch: pytest.MonkeyPatch) -> None:
    trunks.load_trunk.cache_clear()
    for name in trunks.TRUNKS:
        monkeypatch.setitem(trunks.TRUNKS, name, trunks.Trunk(1, 1.0, torch.nn.Identity, dict))
    first, again = ([trunks.load_trunk(name) for name in trunks.TRUNKS] for _ in range(2))
    trunks.load_trunk.cache_clear()
    assert all(a is b for a, b in zip(first, again, strict=True))


def test_packed_weights_come_back_within_half_a_step(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    whole = {
        name: torch.randn_like(value.float()) for name, value in trunks.TRUNKS["lite0"].build().state_dict().items()
    }
    save_file(trunks.pack(whole), tmp_path / "efficientnet_lite0.safetensors")
    monkeypatch.setattr(trunks, "resource", lambda name: tmp_path)
    trunks.load_trunk.cache_clear()
    loaded = trunks.load_trunk("lite0").state_dict()
    trunks.load_trunk.cache_clear()
    assert loaded.keys() == whole.keys()
    for name, value in whole.items():
        if value.ndim == 1:
            assert torch.equal(loaded[name], value.half().float()), name
        else:
            step = value.flatten(1).abs().amax(1).view(-1, *[1] * (value.ndim - 1)) / 127
            assert ((loaded[name] - value).abs() <= 0.501 * step).all(), name


@pytest.mark.slow
def test_a_trunk_is_trained_on_views(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = Path(__file__).parent.parent / "assets" / "checkpoints" / "train_resnet50.py"
    spec = importlib.util.spec_from_file_location("train_resnet50", script)
    assert spec is not None
    assert spec.loader is not None
    train_resnet50 = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(train_resnet50)
    folder = synthetic.write(tmp_path / "grasps", num_grasps=4)
    asked = ["--data", str(folder), "--epochs", "2", "--batch_size", "4"]
    step = train_resnet50.Pretext.training_step

    def killed(self: LightningModule, rows: torch.Tensor, batch_idx: int) -> torch.Tensor:
        if self.current_epoch == 1:
            raise RuntimeError("killed")
        return step(self, rows, batch_idx)

    for name, kill in (("unbroken", False), ("broken", True)):
        places = ["--folder", str(tmp_path / name), "--out", str(tmp_path)]
        if kill:
            with monkeypatch.context() as patch:
                patch.setattr(train_resnet50.Pretext, "training_step", killed)
                with pytest.raises(RuntimeError, match="killed"):
                    train_resnet50.main([*asked, *places])
        train_resnet50.main([*asked, *places])
        (tmp_path / "resnet50_views.safetensors").rename(tmp_path / f"{name}.safetensors")
    assert (tmp_path / "broken.safetensors").read_bytes() == (tmp_path / "unbroken.safetensors").read_bytes()
    with pytest.raises(ValueError, match="holds a run on other data or with other options; give another --folder"):
        train_resnet50.main([*asked, *places, "--seed", "1"])
    train_resnet50.main([*asked, *places])  # there is nothing left to do but to write the files
    card = json.loads((tmp_path / "resnet50_views.json").read_text())
    assert set(card["in_the_last_epoch"]) == {"right", "normals"}
    monkeypatch.setattr(trunks, "resource", lambda name: tmp_path)
    trunks.load_trunk.cache_clear()
    features = EM3().encode(GraspSet(folder).images([0, 1])[torch.arange(2)])["features"]
    trunks.load_trunk.cache_clear()
    assert features.shape == (2, 2048)
    assert torch.isfinite(features).all()

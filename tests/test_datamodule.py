import shutil
import time
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import synthetic
import torch

from dexzoo.data.batches import GraspDataset
from dexzoo.data.datamodule import GraspDataModule
from dexzoo.data.schema import SOURCES, SPLITS
from dexzoo.grasp import Trajectory
from dexzoo.models.batch import Encoding
from dexzoo.models.em2 import EM2
from dexzoo.models.evaluator import GraspEvaluator


class ImageEvaluator(GraspEvaluator):
    """The smallest architecture whose encoder is trained."""

    architecture = "image"

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(2))

    def encode(self, images: torch.Tensor) -> Encoding:
        return {"mean": images.mean((2, 3)) @ self.weight}

    def logit(self, encoding: Encoding, grasps: Trajectory) -> torch.Tensor:
        return encoding["mean"][:, None] + grasps.position[..., 2].mean(-1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return synthetic.write(tmp_path_factory.mktemp("grasps"))


@pytest.fixture(scope="module")
def data(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> GraspDataModule:
    return GraspDataModule(str(folder), batch_size=16, cache=str(tmp_path_factory.mktemp("cache")))


@pytest.fixture(scope="module")
def em2(data: GraspDataModule) -> EM2:
    model = EM2(width=16)
    data.fit_statistics(model)
    return model


def test_batches_hold_each_grasp_once_in_its_own_view(data: GraspDataModule, em2: EM2) -> None:
    source = data.source
    rows = np.flatnonzero(source.grasp_split == SPLITS.index("test"))
    batches = list(data.loader(data.dataset("test", em2)))
    grasps = Trajectory.cat([batch.grasps for batch in batches])
    assert grasps.wrist.shape == (len(rows), 10, 7)
    assert torch.equal(grasps.joints, source.world_grasps.joints[rows])
    assert torch.equal(grasps.grasp_type, source.world_grasps.grasp_type[rows])
    assert torch.cat([batch.success for batch in batches]).tolist() == source.success[rows].tolist()
    assert torch.cat([batch.scene_index for batch in batches]).tolist() == source.grasp_scene[rows].tolist()
    for i in (0, 17, len(rows) - 1):
        observation = source.observation(int(source.grasp_view[rows[i]]))
        expected = source.world_grasps[rows[i]].transformed(np.linalg.inv(observation.T_world_camera))
        torch.testing.assert_close(grasps[i].wrist, expected.wrist, atol=1e-5, rtol=0)
        features = em2.encode(observation.image()[None])["features"][0]
        batch, row = divmod(i, 16)
        views = batches[batch].views
        assert isinstance(views, dict)
        # half precision, and bfloat16 sums that depend on the size of the batch
        torch.testing.assert_close(views["features"][batches[batch].view[row]].float(), features, atol=0.02, rtol=0.02)


def test_training_is_balanced_and_repeatable(data: GraspDataModule, em2: EM2) -> None:
    dataset = data.dataset("train", em2)
    dataset.success[:] = (torch.arange(len(dataset)) % 10 == 0).float()
    first, again = ([b.success for b in data.loader(dataset, balanced=True)] for _ in range(2))
    assert torch.equal(torch.cat(first), torch.cat(again))
    assert torch.cat(first).mean() == pytest.approx(0.5, abs=0.12)  # 160 draws, three standard deviations


def test_training_sees_a_grasp_in_all_views_of_its_scene(data: GraspDataModule, em2: EM2) -> None:
    dataset, source = data.dataset("train", em2), data.source
    assert isinstance(dataset.views, dict)
    rows = torch.from_numpy(np.flatnonzero(source.grasp_split == 0))
    found: dict[tuple[float, ...], set[int]] = {}
    batches = data.loader(dataset, balanced=True)
    for batch in [batch for _ in range(6) for batch in batches]:
        assert isinstance(batch.views, dict)
        for place, grasp, scene in zip(batch.view, batch.grasps.split(1), batch.scene_index, strict=True):
            feature = batch.views["features"][place]
            (view,) = (dataset.views["features"] == feature).all(1).nonzero()[:, 0].tolist()
            assert dataset.view_scene[view] == scene
            world = grasp.transformed(torch.linalg.inv(dataset.T_aimed_world[view]))
            (row,) = np.flatnonzero((source.grasp_scene == int(scene)) & near(source.world_grasps, world))
            found.setdefault(int(row), set()).add(view)
    assert set(found) <= set(rows.tolist())
    assert len(found) > 0.9 * len(rows)
    assert np.mean([len(views) == 2 for views in found.values()]) > 0.8


def near(grasps: Trajectory, grasp: Trajectory) -> np.ndarray:
    """Which grasps are the same, whatever the signs of their quaternions."""
    return ((grasps.position - grasp.position).abs().flatten(1).amax(1) < 1e-5).numpy()


def test_views_are_encoded_once_ever(
    data: GraspDataModule, folder: Path, em2: EM2, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []
    encode = em2.encode
    monkeypatch.setattr(em2, "encode", lambda images: seen.append(len(images)) or encode(images))
    fresh = GraspDataModule(str(folder), cache=str(data.cache))
    first, second = (fresh.dataset("validation", em2).views for _ in range(2))
    assert seen.count(2) <= 1  # the two views of the split, unless an earlier test did it
    assert seen.count(1) == 2  # the probe image, each time
    assert isinstance(first, dict)
    assert isinstance(second, dict)
    assert torch.equal(first["features"], second["features"])
    em2_other = EM2(width=16)  # the same trunk with other statistics
    seen_other = fresh.dataset("validation", em2_other).views
    assert isinstance(seen_other, dict)
    assert not torch.equal(first["features"], seen_other["features"])


def test_a_damaged_cache_is_made_again(data: GraspDataModule, em2: EM2) -> None:
    before = data.dataset("test", em2).views
    for path in data.cache.rglob("*.safetensors"):
        path.write_bytes(path.read_bytes()[:100])
    after = data.dataset("test", em2).views
    torch.testing.assert_close(before, after)


def test_a_trained_encoder_gets_images(data: GraspDataModule) -> None:
    batch = next(iter(data.loader(data.dataset("train", ImageEvaluator()))))
    assert isinstance(batch.views, torch.Tensor)
    assert batch.views.shape == (len(batch.view.unique()), 2, 224, 224)
    row = int(np.flatnonzero(data.source.grasp_split == 0)[5])
    expected = data.source.observation(int(data.source.grasp_view[row])).image()
    torch.testing.assert_close(batch.views[batch.view[5]], expected, atol=1e-6, rtol=0)


def test_batches_are_loaded_at_once() -> None:
    data = GraspDataModule(batch_size=128)
    count = 20_480
    encoding = {"features": torch.zeros(100, 512, dtype=torch.float16)}
    dataset = GraspDataset(
        Trajectory(torch.ones(count, 10, 7), torch.ones(count, 10, 20), torch.zeros(count, dtype=torch.long)),
        (torch.arange(count) % 2).float(),
        torch.arange(count) % 25,
        torch.arange(count) % 100,
        encoding,
        torch.arange(100) % 25,
        torch.eye(4).expand(100, 4, 4),
    )
    start = time.process_time()
    for row in range(512):
        dataset[[row]]
    alone = (time.process_time() - start) / 512
    start = time.process_time()
    assert sum(len(batch.success) for batch in data.loader(dataset, balanced=True)) == count
    assert alone > 10 * (time.process_time() - start) / count  # batches are gathered at once


def test_wrong_data_is_named(folder: Path, em2: EM2, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"grasp set nowhere has no scenes/\*\.parquet"):
        GraspDataModule("nowhere").dataset("train", em2)
    with pytest.raises(ValueError, match="predict_split 'all' is unknown; use one of train, validation, test"):
        GraspDataModule(predict_split="all")
    with pytest.raises(ValueError, match="batch_size is 0"):
        GraspDataModule(batch_size=0)
    with pytest.raises(ValueError, match=r"train_share is 10\.0, expected more than 0 and at most 1"):
        GraspDataModule(train_share=10.0)
    with pytest.raises(ValueError, match="source 'drawn' is unknown; use some of generated, perturbed, refined"):
        GraspDataModule(sources=["generated", "drawn"])
    data = GraspDataModule(str(folder), cache=str(tmp_path))
    data.source.grasp_split[:] = 0
    with pytest.raises(ValueError, match="has no generated grasps in its test split"):
        data.dataset("test", em2)
    dataset = data.dataset("train", em2)
    dataset.success[:] = 1
    with pytest.raises(ValueError, match="needs both successes and failures"):
        data.loader(dataset, balanced=True)


def test_views_without_images_are_left_to_the_renderer(data: GraspDataModule, tmp_path: Path) -> None:
    depth = data.source.depth(range(12))
    bare = shutil.copytree(data.folder, tmp_path / "bare")
    (bare / "manifest.json").unlink()
    path = bare / "views" / "00000.parquet"
    views = pq.read_table(path)
    for name, values in (("depth", [None] * 12), ("seed", range(12))):
        place = views.schema.get_field_index(name)
        views = views.set_column(place, views.field(name), pa.array(values, views.field(name).type))
    pq.write_table(views, path)
    module = GraspDataModule(str(bare), cache=str(tmp_path))
    module.renderer = lambda scene, seeds, cache: [depth[seed] for seed in seeds]
    images = module.dataset("test", ImageEvaluator()).views[torch.arange(2)]
    assert torch.equal(images, data.dataset("test", ImageEvaluator()).views[torch.arange(2)])


def test_a_folder_is_also_looked_up_beside_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert Path(GraspDataModule("robots/dlr2").folder).is_dir()
    (tmp_path / "robots" / "dlr2").mkdir(parents=True)
    assert GraspDataModule("robots/dlr2").folder == "robots/dlr2"
    assert GraspDataModule("s3://robots/dlr2").folder == "s3://robots/dlr2"


def test_fewer_scenes(folder: Path, em2: EM2, tmp_path: Path) -> None:
    dataset = GraspDataModule(str(folder), num_scenes=2, cache=str(tmp_path)).dataset("train", em2)
    assert dataset.scene_index.unique().tolist() == [0, 1]
    assert len(dataset) == 80


def test_a_share_of_the_training_scenes(folder: Path, em2: EM2, tmp_path: Path) -> None:
    data = GraspDataModule(str(folder), train_share=0.6, cache=str(tmp_path))
    whole = GraspDataModule(str(folder), cache=str(tmp_path))
    assert data.dataset("train", em2).scene_index.unique().tolist() == [0, 1]  # 0.6 of four, rounded
    assert data.describe()["train_grasps"] == 80
    for split in ("validation", "test"):
        part, all_of_it = (module.dataset(split, em2).grasps for module in (data, whole))
        assert torch.equal(part.wrist, all_of_it.wrist)
        assert torch.equal(part.joints, all_of_it.joints)
        assert torch.equal(part.grasp_type, all_of_it.grasp_type)
    statistics = EM2(width=16)
    data.fit_statistics(statistics)
    expected = whole.aimed_grasps[torch.from_numpy(whole.source.grasp_scene) < 2]
    torch.testing.assert_close(statistics.grasp_vector.mean, statistics.grasp_vector.flatten(expected).mean(0))


def test_what_is_trained_on_and_what_is_evaluated_are_chosen_by_source(folder: Path, em2: EM2, tmp_path: Path) -> None:
    data = GraspDataModule(str(folder), cache=str(tmp_path))
    data.source.source[::4] = "perturbed"
    count = {split: len(data.dataset(split, em2)) for split in SPLITS}
    assert count == {"train": 160, "validation": 30, "test": 30}
    assert len(data.dataset("test", em2, ["perturbed"])) == 10
    data.sources, data.evaluation_sources = ["generated"], SOURCES
    count = {split: len(data.dataset(split, em2)) for split in SPLITS}
    assert count == {"train": 120, "validation": 40, "test": 40}
    with pytest.raises(ValueError, match="has no refined grasps in its test split"):
        data.dataset("test", em2, ["refined"])

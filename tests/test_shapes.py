"""The parametric objects: names and splits, sound meshes, convex parts that fit them, open cavities, rest."""

import numpy as np
import pytest

from dexzoo.sim.shapes import MASS_RANGE, NUM_OBJECTS, make_object, object_names, split_of

SPLITS = {"train": 220, "validation": 30, "test": 44}


def test_there_are_294_names_in_twenty_categories() -> None:
    names = object_names()
    assert len(NUM_OBJECTS) == len(MASS_RANGE) == 20
    assert len(set(names)) == len(names) == sum(NUM_OBJECTS.values()) == 294
    assert {"mug_03", "bottle_24", "dustpan_00"} <= set(names)


def test_splits_are_by_object_and_cover_the_categories() -> None:
    by_split = {split: object_names(split) for split in SPLITS}
    assert {split: len(names) for split, names in by_split.items()} == SPLITS
    assert sorted(name for names in by_split.values() for name in names) == sorted(object_names())
    for category, count in NUM_OBJECTS.items():
        of = [split_of(f"{category}_{i:02d}") for i in range(count)]
        assert "train" in of
        assert count == 1 or "test" in of
        assert of.count("test") == pytest.approx(count * 44 / 294, abs=1)
        assert of.count("validation") == pytest.approx(count * 30 / 294, abs=1)


@pytest.mark.parametrize("name", ["mug_99", "mug_3", "teapot", "mug_-1", ""])
def test_unknown_names_are_refused_in_one_line(name: str) -> None:
    known = rf"object '{name}' is unknown; known are bottle_00\.\.\.24, .*dustpan_00\.\.\.00$"
    for ask in (make_object, split_of):
        with pytest.raises(ValueError, match=known):
            ask(name)


@pytest.mark.parametrize("category", NUM_OBJECTS)
def test_every_object_is_sound(category: str) -> None:
    for name in (name for name in object_names() if name.startswith(f"{category}_")):
        model = make_object(name)
        assert (model.name, model.category) == (name, category)
        assert model.mesh.is_watertight, name
        assert model.mesh.is_winding_consistent, name
        assert model.mesh.volume > 0, f"the faces of {name} look outwards"
        assert len(model.hulls) <= 24, name
        assert all(hull.is_convex and hull.is_watertight and hull.volume > 0 for hull in model.hulls), name
        assert model.mesh.bounds[0][2] == pytest.approx(0, abs=1e-9), f"{name} stands on the table"
        np.testing.assert_allclose(model.mesh.bounds[:, :2].mean(0), 0, atol=1e-9)
        assert MASS_RANGE[category][0] <= model.mass <= MASS_RANGE[category][1]
        assert 0.5 <= model.friction <= 1.0

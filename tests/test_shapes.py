"""The parametric objects: names and splits, sound meshes, convex parts that fit them, open cavities, rest."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from dexzoo.sim import ObjectModel, Scene
from dexzoo.sim.fit import covered, surface_distance
from dexzoo.sim.shapes import MASS_RANGE, NUM_OBJECTS, make_object, object_names, split_of

# in one worker, which makes all objects once
pytestmark = pytest.mark.xdist_group("shapes")

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


def test_an_object_is_always_the_same() -> None:
    for name in ("mug_03", "scissors_05", "jug_02"):
        first, second = make_object(name), make_object.__wrapped__(name)
        assert first is not second
        assert first.mesh.vertices.tobytes() == second.mesh.vertices.tobytes()
        assert first.mesh.faces.tobytes() == second.mesh.faces.tobytes()
        assert [hull.vertices.tobytes() for hull in first.hulls] == [hull.vertices.tobytes() for hull in second.hulls]
        assert (first.mass, first.friction) == (second.mass, second.friction)


def test_objects_differ() -> None:
    extents = np.array([make_object(name).mesh.extents for name in object_names()])
    assert len(np.unique(extents.round(6), axis=0)) == len(extents)


# the parts fit the mesh


def test_the_distance_of_surfaces_is_that_of_closed_forms() -> None:
    """A cube of 60 mm against one 1.5 mm smaller on each side, against its three slices, and against two of them."""
    box = trimesh.creation.box
    whole, small = box([0.06] * 3), box([0.057] * 3)
    assert surface_distance(model_of(whole, [whole])) == pytest.approx(0, abs=1e-9)
    assert surface_distance(model_of(whole, [small])) == pytest.approx(0.0015 * np.sqrt(3), rel=0.1)
    slabs = [box([0.02, 0.06, 0.06]).apply_translation([x, 0, 0]) for x in (-0.02, 0, 0.02)]
    assert surface_distance(model_of(whole, slabs)) == pytest.approx(0, abs=1e-9), "cuts are no surface"
    # the middles of the two faces at the gap are 20 mm from the cube's surface
    assert surface_distance(model_of(whole, [slabs[0], slabs[2]])) == pytest.approx(0.02, rel=0.01)


def model_of(mesh: trimesh.Trimesh, parts: list[trimesh.Trimesh]) -> ObjectModel:
    return ObjectModel.from_mesh(mesh, hulls=parts)


@pytest.mark.parametrize("number", range(2))
@pytest.mark.parametrize("category", NUM_OBJECTS)
def test_the_parts_fit_the_mesh(category: str, number: int) -> None:
    if number < NUM_OBJECTS[category]:
        assert surface_distance(make_object(f"{category}_{number:02d}"), num_points=1500) < 0.002


@pytest.mark.slow
@pytest.mark.parametrize("category", NUM_OBJECTS)
def test_the_parts_of_all_objects_fit_their_meshes(category: str) -> None:
    for name in (name for name in object_names() if name.startswith(f"{category}_")):
        assert surface_distance(make_object(name)) < 0.002, name


@pytest.mark.parametrize("category", ["bowl", "cup", "jug", "mug", "pan", "plate", "teacup", "funnel"])
def test_cavities_are_open(category: str) -> None:
    """From the middle of the mouth down to near the floor there is neither a part nor the mesh."""
    for name in (name for name in object_names() if name.startswith(f"{category}_")):
        model = make_object(name)
        axis, mouth, floor = cavity(model)
        heights = np.linspace(mouth, floor, 20)
        points = np.column_stack((np.full(20, axis[0]), np.full(20, axis[1]), heights))
        assert not covered(model, points).any(), name
        assert not model.mesh.contains(points).any(), name
        below = np.array([[*axis, 0.001]])
        assert covered(model, below).all() == (category != "funnel"), f"{name} has a floor"


def cavity(model: ObjectModel) -> tuple[np.ndarray, float, float]:
    """The axis (2,) of a vessel, the middle of its round floor, and the heights of its mouth and above its floor."""
    low = model.mesh.vertices[model.mesh.vertices[:, 2] < 0.0015]
    axis = (low.min(0) + low.max(0))[:2] / 2
    height = model.mesh.bounds[1, 2]
    if model.category == "funnel":
        return axis, height - 1e-4, 1e-4
    rays = np.array([[*axis, height + 0.01]])
    hits = model.mesh.ray.intersects_location(rays, np.array([[0.0, 0, -1]]))[0]
    floor = hits[:, 2].max()
    assert floor < 0.65 * height, "a vessel is deep"
    return axis, height - 1e-4, floor + 2e-3  # within which the parts fit


# they rest


@pytest.mark.parametrize("name", ["bottle_00", "cup_03", "mug_02", "shaker_03", "teapot_04", "jug_03", "pan_01"])
def test_what_stands_stays_upright(name: str) -> None:
    on_the_table = replace(make_object(name), category="")  # cups would tumble, pans lie on a block
    scene = Scene.place(on_the_table, seed=3)
    assert scene.T_world_object[2, 2] > np.cos(np.deg2rad(3))


LYING = ("fork_00", "knife_00", "spoon_04", "scissors_01", "spatula_01", "dustpan_00", "ball_01")


@pytest.mark.parametrize("name", LYING)
def test_what_lies_comes_to_rest(name: str) -> None:
    Scene.place(make_object(name), seed=3)


@pytest.mark.slow
@pytest.mark.parametrize("category", NUM_OBJECTS)
def test_all_objects_come_to_rest(category: str) -> None:
    for name in (name for name in object_names() if name.startswith(f"{category}_")):
        Scene.place(make_object(name), seed=0)


def test_every_object_is_in_one_piece() -> None:
    for name in object_names():
        assert make_object(name).mesh.body_count == 1, name

"""Objects: mass properties against closed forms, convex parts, bad input, and the parametric objects."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from dexzoo.sim import ObjectModel, objects

box = trimesh.creation.box


def solid(mesh: trimesh.Trimesh, mass: float = 0.3) -> ObjectModel:
    """An object of one convex part, which is its mesh."""
    return ObjectModel.from_mesh(mesh, mass, 0.7, [mesh])


# mass properties


def test_box_has_the_inertia_of_the_closed_form() -> None:
    a, b, c, mass = 0.04, 0.06, 0.1, 0.3
    center, inertia = solid(box([a, b, c]).apply_translation([0.1, 0, 0.05]), mass).inertia
    np.testing.assert_allclose(center, [0.1, 0, 0.05], atol=1e-12)
    expected = mass / 12 * np.array([b * b + c * c, a * a + c * c, a * a + b * b])
    np.testing.assert_allclose(inertia, np.diag(expected), atol=1e-12)


def test_cylinder_has_the_inertia_of_the_closed_form() -> None:
    radius, height, mass = 0.03, 0.12, 0.2
    _, inertia = solid(trimesh.creation.cylinder(radius, height, sections=256), mass).inertia
    aside, along = mass / 12 * (3 * radius**2 + height**2), mass / 2 * radius**2
    # a polygon of 256 sides falls short of its circle by 1e-4
    np.testing.assert_allclose(inertia, np.diag([aside, aside, along]), rtol=3e-4, atol=1e-12)


def test_parts_of_one_density_add_up() -> None:
    """A box cut into unequal slices is the box."""
    whole = solid(box([0.05, 0.06, 0.1]))
    slices = [
        box([0.05, 0.06, high - low]).apply_translation([0, 0, (low + high) / 2 - 0.05])
        for low, high in [(0, 0.02), (0.02, 0.05), (0.05, 0.1)]
    ]
    cut = ObjectModel.from_mesh(whole.mesh, whole.mass, 0.7, slices)
    for ours, expected in zip(cut.inertia, whole.inertia, strict=True):
        np.testing.assert_allclose(ours, expected, atol=1e-12)


def test_a_larger_part_draws_the_center() -> None:
    parts = [box([0.06, 0.06, 0.06]), box([0.02, 0.06, 0.06]).apply_translation([0.04, 0, 0])]
    center, _ = ObjectModel.from_mesh(trimesh.util.concatenate(parts), 1.0, 0.7, parts).inertia
    np.testing.assert_allclose(center, [0.01, 0, 0], atol=1e-12)


def test_radius_and_scale() -> None:
    model = solid(box([0.02, 0.04, 0.04]))
    assert model.radius == pytest.approx(0.03)
    larger = model.scaled(1.5)
    assert larger.radius == pytest.approx(0.045)
    assert larger.mass == model.mass
    assert model.mesh.extents.max() == pytest.approx(0.04), "the original stays as it was"
    np.testing.assert_allclose(larger.inertia[1], 1.5**2 * model.inertia[1], rtol=1e-9)


# convex parts


def channel() -> trimesh.Trimesh:
    """A U of 90 x 60 mm outside and 50 x 40 mm inside, 50 mm deep; watertight."""
    outline = np.array([[0, 0], [9, 0], [9, 6], [7, 6], [7, 2], [2, 2], [2, 6], [0, 6]]) / 100
    count = len(outline)
    vertices = np.concatenate([np.column_stack((outline, np.full(count, z))) for z in (0, 0.05)])
    top = [[0, 5, 6], [0, 6, 7], [0, 1, 4], [0, 4, 5], [1, 2, 3], [1, 3, 4]]
    after = [(i, (i + 1) % count) for i in range(count)]
    sides = [[i, j, j + count] for i, j in after] + [[i, j + count, i + count] for i, j in after]
    return trimesh.Trimesh(vertices, [*sides, *(t[::-1] for t in top), *([i + count for i in t] for t in top)])


def covers(model: ObjectModel, points: list[list[float]]) -> np.ndarray:
    """Which points lie in a convex part: behind the planes of all its faces."""
    inside = np.zeros(len(points), bool)
    for hull in model.hulls:
        height = np.einsum("pfk,fk->pf", np.array(points)[:, None] - hull.triangles[:, 0], hull.face_normals)
        inside |= (height < 1e-6).all(1)
    return inside


def test_parts_are_computed_and_leave_the_cavity_open() -> None:
    mesh = channel()
    assert mesh.is_volume
    model = ObjectModel.from_mesh(mesh, 0.2, 0.7)
    assert all(hull.is_convex for hull in model.hulls)
    assert sum(hull.volume for hull in model.hulls) == pytest.approx(mesh.volume, rel=0.05)
    assert not covers(model, [[0.045, 0.045, 0.025], [0.03, 0.03, 0.01], [0.06, 0.055, 0.04]]).any()
    assert covers(model, [[0.01, 0.03, 0.025], [0.08, 0.03, 0.025], [0.045, 0.01, 0.025]]).all()


def test_given_parts_are_taken_as_they_are(tmp_path: Path) -> None:
    part = tmp_path / "part.stl"
    box([0.05, 0.05, 0.05]).export(part)
    model = ObjectModel.from_mesh(channel(), hulls=[part, box([0.02, 0.02, 0.02])])
    assert [len(hull.vertices) for hull in model.hulls] == [8, 8]


def test_slivers_among_the_parts_are_dropped() -> None:
    model = ObjectModel.from_mesh(CUBE, hulls=[SLIVER, CUBE, SLIVER])
    assert len(model.hulls) == 1
    assert model.inertia[0] == pytest.approx([0, 0, 0])


@pytest.mark.parametrize("file", ["cup.obj", "cup.stl", "cup.ply"])
def test_mesh_files_are_read(file: str, tmp_path: Path) -> None:
    path = tmp_path / file
    box([0.05, 0.06, 0.07]).export(path)
    model = ObjectModel.from_mesh(path, hulls=[path])
    assert model.name == "cup"
    np.testing.assert_allclose(model.mesh.extents, [0.05, 0.06, 0.07], atol=1e-7)
    assert len(model.mesh.vertices) == 8


def test_a_file_called_mesh_bears_the_name_of_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "kettle").mkdir()
    monkeypatch.chdir(tmp_path / "kettle")
    box([0.05, 0.06, 0.07]).export("mesh.obj")
    assert ObjectModel.from_mesh("mesh.obj", hulls=["mesh.obj"]).name == "kettle"


# bad input

CUBE = box([0.1, 0.1, 0.1])
SLIVER = box([0.1, 0.1, 1e-7]).apply_transform(trimesh.transformations.rotation_matrix(0.7, [1, 1, 0]))


def not_finite() -> trimesh.Trimesh:
    mesh = CUBE.copy()
    mesh.vertices[0] = np.nan
    return mesh


def tilted_square() -> trimesh.Trimesh:
    corners = np.array([[0, 0, 0], [0.1, 0, 0.02], [0.1, 0.1, 0.02], [0, 0.1, 0]])
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


def faceless_vertex() -> trimesh.Trimesh:
    return trimesh.Trimesh(CUBE.vertices, [[0, 1, 99], [0, 1, 2], [1, 2, 3]], process=False)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: solid(tilted_square()), "mesh object is flat: all its vertices lie in one plane, or nearly so"),
        (lambda: solid(faceless_vertex()), "mesh object has faces of vertices that do not exist"),
        (lambda: solid(trimesh.Trimesh()), "mesh object is empty"),
        (lambda: solid(not_finite()), "mesh object has vertices that are not finite"),
        (
            lambda: solid(CUBE.copy().apply_scale(1000)),
            r"mesh object is 100\.0 m large and looks like millimeters; divide it by 1000",
        ),
        (lambda: solid(box([0.1, 0.1, 1e-5])), r"mesh object is flat: 0\.01 mm thick, expected at least 0\.5 mm"),
        (lambda: solid(CUBE, mass=0.0), r"object object has a mass of 0\.0 kg; give a positive one"),
        (lambda: solid(CUBE, mass=-1.0), r"object object has a mass of -1\.0 kg"),
        (lambda: solid(CUBE, mass=float("nan")), "object object has a mass of nan kg"),
        (
            lambda: ObjectModel.from_mesh(CUBE, friction=2.1, hulls=[CUBE]),
            r"has a friction of 2\.1; give one in \(0, 2\]",
        ),
        (lambda: ObjectModel.from_mesh(CUBE, friction=0.0, hulls=[CUBE]), r"has a friction of 0\.0"),
        (lambda: ObjectModel.from_mesh(CUBE, hulls=[]), "has no convex parts; give hulls=None to have them computed"),
        (lambda: ObjectModel.from_mesh(CUBE, hulls=[trimesh.Trimesh()]), "mesh hull of object is empty"),
        (lambda: ObjectModel.from_mesh(CUBE, hulls=[SLIVER]), "has no convex parts; give hulls=None to have them"),
        (lambda: ObjectModel.from_mesh(CUBE, hulls=[box([100, 100, 100])]), "mesh hull of object is 100.0 m large"),
    ],
)
def test_bad_objects_are_refused_in_one_line(make: Callable[[], ObjectModel], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("empty.obj", "", r"mesh .*empty\.obj is empty"),
        ("text.stl", "this is no mesh", r"mesh .*text\.stl is empty"),
        ("text.xyz", "this is no mesh", r"mesh .*text\.xyz cannot be read"),
        ("mesh.what", "v 0 0 0", r"mesh .*mesh\.what cannot be read"),
        (
            "nan.obj",
            "v 0 0 0\nv 0 nan 0\nv 0.1 0 0\nv 0 0 0.1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n",
            r"nan\.obj has vertices that are not finite",
        ),
    ],
)
def test_bad_files_are_refused_in_one_line(file: str, content: str, message: str, tmp_path: Path) -> None:
    (tmp_path / file).write_text(content)
    with pytest.raises(ValueError, match=message) as caught:
        ObjectModel.from_mesh(tmp_path / file)
    assert "\n" not in str(caught.value)


def inside_out() -> trimesh.Trimesh:
    mesh = CUBE.copy()
    mesh.invert()
    return mesh


def partly_inside_out() -> trimesh.Trimesh:
    faces = CUBE.faces.copy()
    faces[::3] = faces[::3, ::-1]
    return trimesh.Trimesh(CUBE.vertices, faces, process=False)


def littered() -> trimesh.Trimesh:
    """Triangles that share no vertices, some of them twice, some of no area, and a vertex that none uses."""
    corners = np.vstack((CUBE.triangles.reshape(-1, 3), CUBE.triangles[:2].reshape(-1, 3), [[5.0, 5, 5]]))
    faces = np.vstack((np.arange(42).reshape(-1, 3), [[0, 0, 1], [3, 3, 3]]))
    return trimesh.Trimesh(corners, faces, process=False)


def without_a_side() -> trimesh.Trimesh:
    return trimesh.Trimesh(CUBE.vertices, CUBE.faces[2:], process=False)


@pytest.mark.parametrize("make", [inside_out, partly_inside_out, littered, without_a_side])
def test_what_is_safe_to_mend_is_mended(make: Callable[[], trimesh.Trimesh]) -> None:
    bad = make()
    before = bad.faces.copy()
    model = ObjectModel.from_mesh(bad)
    assert model.mesh.is_volume
    assert model.mesh.volume == pytest.approx(1e-3)
    assert model.radius == pytest.approx(0.05 * 3**0.5)
    assert len(model.hulls) == 1
    assert model.hulls[0].volume == pytest.approx(1e-3, rel=0.02)
    np.testing.assert_array_equal(bad.faces, before, err_msg="the caller's mesh stays as it was")


def with_a_fin() -> trimesh.Trimesh:
    """Three faces meet at one edge."""
    edge = CUBE.faces[0, :2]
    return trimesh.Trimesh([*CUBE.vertices, [0.1, 0, 0]], [*CUBE.faces, [*edge, 8]], process=False)


@pytest.mark.slow
def test_a_mesh_that_is_not_closed_is_cut_all_the_same() -> None:
    model = ObjectModel.from_mesh(with_a_fin())
    assert 1 <= len(model.hulls) <= 24


def test_a_mesh_that_crashes_the_decomposition_takes_nothing_else_down(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    crash = tmp_path / "crash.py"
    crash.write_text("import os\nos.abort()\n")
    monkeypatch.setattr(objects, "_DECOMPOSE", crash)
    with pytest.raises(ValueError, match="mesh object cannot be cut into convex parts by CoACD; repair the mesh, or"):
        ObjectModel.from_mesh(CUBE)
    crash.write_text("import time\ntime.sleep(60)\n")
    monkeypatch.setattr(objects, "PATIENCE", 0.5)
    with pytest.raises(ValueError, match=r"mesh object keeps CoACD busy for over 0\.5 s; repair the mesh, or give"):
        ObjectModel.from_mesh(CUBE)


def test_missing_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"mesh .*none\.obj does not exist"):
        ObjectModel.from_mesh(tmp_path / "none.obj")
    with pytest.raises(FileNotFoundError, match=r"mesh .*none\.obj does not exist"):
        ObjectModel.from_mesh(CUBE, hulls=[tmp_path / "none.obj"])

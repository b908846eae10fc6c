"""Weight, friction and pose drawn apart from the shape."""

import numpy as np
import pytest
import trimesh

from dexzoo.sim import ObjectModel, Scene
from dexzoo.sim.properties import DENSITY, FRICTION, MASS, MAX_OFFSET, draw_properties, with_properties


@pytest.fixture(scope="module")
def block() -> ObjectModel:
    mesh = trimesh.creation.box([0.12, 0.07, 0.03]).apply_translation([0, 0, 0.015])
    return ObjectModel.from_mesh(mesh, hulls=[mesh], name="block")


def test_the_same_seed_draws_the_same(block: ObjectModel) -> None:
    first, second, other = (draw_properties(block, seed) for seed in (3, 3, 4))
    assert (first.mass, first.friction) == (second.mass, second.friction)
    np.testing.assert_array_equal(first.center, second.center)
    np.testing.assert_array_equal(first.turn, second.turn)
    assert other.mass != first.mass


def test_draws_fill_their_ranges(block: ObjectModel) -> None:
    drawn = [draw_properties(block, seed) for seed in range(300)]
    mass, friction = (np.array([getattr(each, name) for each in drawn]) for name in ("mass", "friction"))
    volume = 0.12 * 0.07 * 0.03
    assert mass.min() == MASS[0], "a light one is kept at the least mass"
    assert mass.max() <= DENSITY[1] * volume
    assert np.median(mass) == pytest.approx(volume * np.sqrt(np.prod(DENSITY)), rel=0.4)
    assert friction.min() == pytest.approx(FRICTION[0], abs=0.02)
    assert friction.max() == pytest.approx(FRICTION[1], abs=0.02)
    offset = np.abs([each.center - block.inertia[0] for each in drawn]) / [0.06, 0.035, 0.015]
    assert 0.15 < offset.max() <= MAX_OFFSET + 1e-9


def test_poses_are_drawn_by_their_probability(block: ObjectModel) -> None:
    up = np.array([np.abs(draw_properties(block, seed).turn[2]) for seed in range(300)]).round(6)
    shares = (up == 1).mean(0)
    assert shares.sum() == pytest.approx(1), "on one of its faces"
    assert shares[2] > 0.6, "mostly flat"
    assert shares[1] > 0, "sometimes on its side"


def test_what_is_turned_rests_as_it_is(block: ObjectModel) -> None:
    properties = next(each for seed in range(100) if abs((each := draw_properties(block, seed)).turn[2, 1]) > 0.9)
    turned = with_properties(block, properties)
    assert (turned.mass, turned.friction) == (properties.mass, properties.friction)
    np.testing.assert_allclose(turned.mesh.bounds[0, 2], 0, atol=1e-12)
    np.testing.assert_allclose(turned.mesh.extents[2], 0.07)
    assert Scene.place(turned, seed=0).T_world_object[2, 2] > 0.999

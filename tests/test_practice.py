"""Practice turns grasps that hold into demonstrations."""

import pytest

from dexzoo.collection.practice import practise
from dexzoo.generators.demonstration import load_demonstrations
from dexzoo.generators.kopicki import KopickiGenerator
from dexzoo.hand import Hand
from dexzoo.sim import Scene
from dexzoo.sim.shapes import make_object
from dexzoo.verification import verify


@pytest.mark.slow
def test_what_is_learned_on_an_object_holds_there(hand: Hand) -> None:
    shown = [one for one in load_demonstrations(hand) if one.object == "box_09"]
    learned = list(practise(KopickiGenerator(shown), "box_09", num_grasps=12, seed=0))
    assert 0 < len(learned) <= 6
    scene = Scene.place(make_object("box_09"), seed=0)
    assert all(one.object == "box_09" for one in learned)
    assert all(verify(one.grasp.transformed(scene.T_world_object), scene).success[0] for one in learned)

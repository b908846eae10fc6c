"""One thread for each worker, shapes and types checked at every call, no random examples that differ between runs."""

import os
from collections.abc import Iterator
from typing import TYPE_CHECKING

os.environ.setdefault("OMP_NUM_THREADS", "1")

import hypothesis
import jaxtyping
import pytest
import torch

if TYPE_CHECKING:  # at run time only after the hook is installed
    from dexzoo.camera import Observation
    from dexzoo.grasp import Grasps
    from dexzoo.hand import Hand
    from dexzoo.sim import Outcomes, Scene

jaxtyping.install_import_hook("dexzoo", "beartype.beartype")
torch.set_num_threads(1)
hypothesis.settings.register_profile("dexzoo", deadline=None, derandomize=True, max_examples=50)
hypothesis.settings.load_profile("dexzoo")


@pytest.fixture
def as_users_run_it() -> Iterator[None]:
    """Without the checks of shapes and types, so that a wrong argument meets the package's own error."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


# One object looked at, grasped and tried, for all tests that need some. Take care to change none of these in place.


@pytest.fixture(scope="session")
def hand() -> "Hand":
    from dexzoo.hand import default_hand

    return default_hand()


@pytest.fixture(scope="session")
def can_scene() -> "Scene":
    from dexzoo.sim import Scene
    from dexzoo.sim.shapes import make_object

    return Scene.place(make_object("can_05"), seed=0)


@pytest.fixture(scope="session")
def can_view(can_scene: "Scene") -> "Observation":
    return can_scene.observe(seed=1)


@pytest.fixture(scope="session")
def can_grasps(can_view: "Observation") -> "Grasps":
    """Fifty grasps in the frame of the camera, of which about ten hold."""
    from dexzoo.generators.heuristic import HeuristicGenerator

    return HeuristicGenerator(num_samples=800).generate(can_view, 50, seed=0)


@pytest.fixture(scope="session")
def can_outcomes(can_scene: "Scene", can_grasps: "Grasps") -> "Outcomes":
    from dexzoo.verification import verify

    return verify(can_grasps, can_scene)

"""One thread for each worker, shapes and types checked at every call, no random examples that differ between runs."""

import os
from collections.abc import Iterator

os.environ.setdefault("OMP_NUM_THREADS", "1")

import hypothesis
import jaxtyping
import pytest
import torch

jaxtyping.install_import_hook("dexzoo", "beartype.beartype")
torch.set_num_threads(1)
hypothesis.settings.register_profile("dexzoo", deadline=None, derandomize=True, max_examples=50)
hypothesis.settings.load_profile("dexzoo")

# only now, so that the hook reaches them
from dexzoo.generators.heuristic import HeuristicGenerator  # noqa: E402
from dexzoo.grasp import Grasps  # noqa: E402
from dexzoo.hand import Hand  # noqa: E402
from dexzoo.perception import Observation  # noqa: E402
from dexzoo.sim import Outcomes, Scene  # noqa: E402
from dexzoo.sim.shapes import make_object  # noqa: E402
from dexzoo.verification import verify  # noqa: E402


@pytest.fixture
def as_users_run_it() -> Iterator[None]:
    """Without the checks of shapes and types, so that a wrong argument meets the package's own error."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


# One object looked at, grasped and tried, for all tests that need some. Take care to change none of these in place.


@pytest.fixture(scope="session")
def hand() -> Hand:
    return Hand.load()


@pytest.fixture(scope="session")
def can_scene() -> Scene:
    return Scene.place(make_object("can_07"), seed=0)


@pytest.fixture(scope="session")
def can_view(can_scene: Scene) -> Observation:
    return can_scene.observe(seed=1)


@pytest.fixture(scope="session")
def can_grasps(can_view: Observation, hand: Hand) -> Grasps:
    """Fifty grasps, of which about ten hold."""
    return HeuristicGenerator(hand, num_samples=800).generate(can_view, 50, seed=0)


@pytest.fixture(scope="session")
def can_outcomes(can_scene: Scene, can_grasps: Grasps) -> Outcomes:
    return verify(can_grasps, can_scene)

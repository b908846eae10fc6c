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


@pytest.fixture
def as_users_run_it() -> Iterator[None]:
    """Without the checks of shapes and types, so that a wrong argument meets the package's own error."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)

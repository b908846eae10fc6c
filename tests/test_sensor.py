"""What the depth sensor makes of depth that is known exactly, against its parameters."""

import numpy as np
import pytest

from dexzoo.perception.camera import Camera
from dexzoo.sim.sensor import BASELINE, DISPARITY_NOISE, DISPARITY_STEP, read_depth

CAMERA = Camera()
LIT = np.ones((480, 640), bool)


def slope() -> np.ndarray:
    """A wall that recedes to the right, so that rounding falls evenly."""
    return np.tile(np.linspace(0.6, 0.8, 640), (480, 1))


def read(depth: np.ndarray, lit: np.ndarray = LIT, seed: int = 0) -> np.ndarray:
    return read_depth(depth, lit, CAMERA, np.random.default_rng(seed))


def disparity(depth: np.ndarray) -> np.ndarray:
    return CAMERA.fx * BASELINE / depth


def test_disparity_has_the_steps_and_the_noise_of_the_parameters() -> None:
    depth = slope()
    noisy = read(depth)
    assert noisy.dtype == np.float32
    assert (noisy > 0).all()
    steps = disparity(noisy) / DISPARITY_STEP
    np.testing.assert_allclose(steps, np.round(steps), atol=2e-3)
    error = disparity(noisy) - disparity(depth)
    assert abs(error.mean()) < 0.002
    # rounding adds a step's even distribution
    assert error.std() == pytest.approx(np.hypot(DISPARITY_NOISE, DISPARITY_STEP / np.sqrt(12)), rel=0.02)
    assert np.abs(error).max() < 6 * DISPARITY_NOISE


def test_noise_is_alike_in_neighbors_and_not_farther_apart() -> None:
    error = disparity(read(slope())) - disparity(slope())

    def alike(step: int) -> float:
        return float(np.corrcoef(error[:, :-step].ravel(), error[:, step:].ravel())[0, 1])

    # on a grid 1.5 times coarser every other pixel shares its noise with the next; their rounding differs
    assert 0.2 < alike(1) < 0.5
    assert abs(alike(2)) < 0.05
    assert abs(alike(5)) < 0.02


def test_depth_noise_grows_with_the_square_of_the_distance() -> None:
    near, far = (np.std(read(slope() * scale) - slope() * scale) for scale in (0.5, 1.0))
    assert far / near == pytest.approx(4, rel=0.05)


def test_noise_repeats_with_the_seed() -> None:
    a, b, c = (read(slope(), seed=seed) for seed in (1, 1, 2))
    assert a.tobytes() == b.tobytes()
    assert not np.array_equal(a, c)


def test_the_farther_side_of_an_edge_is_lost_and_the_nearer_kept() -> None:
    depth = np.full((480, 640), 0.7)
    depth[:, 320:] = 0.5
    lost = (read(depth) == 0).mean(0)
    assert (lost[320:] == 0).all()
    assert (lost[:316] == 0).all(), "the window reaches four pixels"
    assert 0.6 < lost[319] < 0.95
    assert lost[319] > lost[318] > lost[317] > lost[316]
    assert 1 < lost.sum() < 2, "pixels of the table beside a straight edge"


def test_a_small_step_of_disparity_is_no_edge() -> None:
    depth = np.full((480, 640), 0.7)
    depth[:, 320:] = 0.685  # 1.35 pixels
    assert (read(depth) > 0).all()


def test_what_is_unlit_or_absent_has_no_reading_and_the_shadow_grows_by_a_rim() -> None:
    depth, lit = np.full((480, 640), 0.7), LIT.copy()
    lit[:, 300:340] = False
    depth[:100] = 0
    lost = read(depth, lit) == 0
    assert lost[:100].all()
    assert lost[:, 300:340].all()
    rim = lost[100:, 340:].mean(0)
    assert 1 < rim.sum() < 2
    assert (rim[4:] == 0).all()


def test_a_shadow_takes_no_rim_from_what_casts_it() -> None:
    depth, lit = np.full((480, 640), 0.7), LIT.copy()
    depth[:, 340:] = 0.5
    lit[:, 300:340] = False
    assert (read(depth, lit)[:, 340:] > 0).all()


@pytest.mark.parametrize(("degrees", "is_read"), [(3, False), (5, False), (25, True), (60, True)])
def test_a_surface_at_a_grazing_angle_is_lost(degrees: float, is_read: bool) -> None:
    # a plane 0.6 m away in the image's middle, whose disparity is linear in the row
    rays = CAMERA.directions()
    tilt = np.deg2rad(degrees)
    along = rays[..., 1] * np.cos(tilt) + rays[..., 2] * np.sin(tilt)
    with np.errstate(divide="ignore"):
        depth = 0.6 * np.sin(tilt) / along
    depth[(depth < 0.3) | (depth > 1.4)] = 0
    middle = read(depth)[238:243, 100:500]
    assert (middle > 0).mean() == pytest.approx(float(is_read), abs=0.05)


@pytest.mark.parametrize("shape", [(2, 3), (1, 1), (224, 224)])
def test_images_of_any_size_are_read(shape: tuple[int, int]) -> None:
    camera = Camera(shape[1], shape[0], 280.0, 280.0, shape[1] / 2, shape[0] / 2)
    depth = np.full(shape, 0.5)
    assert (read_depth(depth, depth > 0, camera, np.random.default_rng(0)) > 0).all()

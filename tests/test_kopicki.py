"""The Kopicki generator: feasible, alike for the same seed, and plain about what it cannot do."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from dexzoo.generators import GENERATORS, make_generator
from dexzoo.generators.approach import ApproachMotion
from dexzoo.generators.contact_density import Grips
from dexzoo.generators.demonstration import load_demonstrations, shipped_demonstrations
from dexzoo.generators.kopicki import KopickiGenerator
from dexzoo.generators.search import anneal, ascend
from dexzoo.grasp import GRIP, Grasps
from dexzoo.hand import Hand
from dexzoo.perception import Camera, Observation, View
from dexzoo.perception.camera import look_at
from dexzoo.perception.surroundings import beyond, obstacles, underneath
from dexzoo.sim import Scene
from dexzoo.sim.shapes import make_object

CALL = {"num_samples": 600, "num_kernels": 4000, "num_steps": (5, 10)}


@pytest.fixture(scope="module")
def generator(hand: Hand) -> KopickiGenerator:
    shown = [one for one in load_demonstrations(hand) if one.object in ("shaker_13", "box_09")]
    return KopickiGenerator(shown, num_per_type=4, **CALL)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def grasps(generator: KopickiGenerator, can_view: Observation) -> Grasps:
    return generator.generate(can_view, 20, seed=0)


def test_the_likeliest_come_first_and_no_type_takes_all(grasps: Grasps, generator: KopickiGenerator) -> None:
    assert grasps.hand is generator.hand
    assert grasps.log_likelihood is not None
    assert (grasps.log_likelihood.diff() <= 0).all()
    types, count = grasps.grasp_type.unique(return_counts=True)
    assert count.max() <= 4
    assert set(types.tolist()) <= {one.grasp_type for one in generator.demonstrations}
    assert len(types) >= 3


def test_grasps_keep_the_limits_and_clear_the_table(grasps: Grasps, hand: Hand) -> None:
    hand.check(grasps.joints)
    links = grasps.wrist_pose[:, : GRIP + 1, None] @ hand.forward_kinematics(grasps.joints[:, : GRIP + 1])
    assert hand.clearance(links, torch.tensor([0.0, 0, 1, 0])).min() > 0


def test_the_hand_comes_to_the_object(grasps: Grasps, can_view: Observation, hand: Hand) -> None:
    links = grasps.wrist_pose[:, GRIP, None] @ hand.forward_kinematics(grasps.joints[:, GRIP])
    points = torch.from_numpy(can_view.points_world[::20])
    nearest = hand.signed_distance(links, points).amin((-1, -2))
    assert nearest.median() < 0.005
    assert nearest.max() < 0.05, "what touches the hidden side is not far from the seen one"


def test_the_same_seed_gives_the_same_grasps(
    grasps: Grasps, generator: KopickiGenerator, can_view: Observation
) -> None:
    view = View(can_view)
    again = generator.generate(view, 20, seed=0)
    assert torch.equal(again.wrist, grasps.wrist)
    assert torch.equal(again.joints, grasps.joints)
    assert torch.equal(again.grasp_type, grasps.grasp_type)
    other = generator.generate(can_view, 20, seed=1)
    assert not torch.equal(other.wrist[: len(grasps)], grasps.wrist[: len(other)])
    density = generator.density(view, seed=0)
    assert generator.density(view, seed=0) is density, "made once for each view and seed"
    assert generator.density(view, seed=1) is not density


def test_annealing_and_gradient_both_raise_the_likelihood(generator: KopickiGenerator, can_view: Observation) -> None:
    density = generator.density(can_view, seed=0)
    grips = density.sample(40, torch.Generator().manual_seed(0))

    def free(_: Grips) -> Callable[[Grips], torch.Tensor]:
        return lambda grips: torch.zeros(len(grips.demo))

    before = density.log_likelihood(grips).mean()
    annealed = anneal(density, grips, free, 60, torch.Generator().manual_seed(1))
    climbed = ascend(density, grips, free, 30)
    assert density.log_likelihood(annealed).mean() > before + 1
    assert density.log_likelihood(climbed).mean() > density.log_likelihood(annealed).mean(), "at half the steps"


def test_the_likelihood_of_what_was_generated_is_that_of_the_density_less_costs(
    grasps: Grasps, generator: KopickiGenerator, can_view: Observation
) -> None:
    density = generator.density(can_view, seed=0)
    value = density.log_density(grasps)
    assert grasps.log_likelihood is not None
    assert (value >= grasps.log_likelihood - 0.5).all()


def test_fingers_that_stop_short_of_the_surface_or_in_it_cost_the_thumb_most(hand: Hand) -> None:
    """The demonstrated grip on the demonstrated surface, moved off it by what the cost should then tell."""
    shown = [one for one in load_demonstrations(hand) if one.object == "can_00"]
    generator = KopickiGenerator(shown, **CALL)  # type: ignore[arg-type]
    for demo, one in enumerate(shown):
        motion = ApproachMotion(shown, generator.models, hand, one.surface.points, torch.zeros(0, 3), torch.Generator())
        wrist, joints = one.grasp.wrist_pose[:, GRIP], hand.reduce(one.grasp.joints[:, GRIP])
        at = torch.tensor([demo])
        assert motion.gap_cost(Grips(at, wrist, joints)) < 1.5, "the fingers touch, but for the spacing of the points"
        opened = {}
        for finger in ("thumb", "index"):
            posture = joints.clone()
            posture[:, hand.freedoms.index(f"{finger}_mcp")] -= 0.3
            opened[finger] = float(motion.gap_cost(Grips(at, wrist, posture)))
        assert opened["thumb"] > 1.5 * opened["index"] > 1.5
        away = wrist.clone()
        away[:, 2, 3] += 0.3
        assert motion.gap_cost(Grips(at, away, joints)) > 100


def test_generators_by_name_and_by_folder(hand: Hand) -> None:
    assert GENERATORS[0] == "kopicki"
    assert make_generator("kopicki", hand) is make_generator("kopicki", Hand.load()), "made once for equal hands"
    assert all(make_generator(name, hand).hand == hand for name in GENERATORS)
    named, folder = make_generator("kopicki", hand), make_generator(str(shipped_demonstrations(hand)), hand)
    assert isinstance(named, KopickiGenerator)
    assert isinstance(folder, KopickiGenerator)
    assert [d.grasp_type for d in folder.demonstrations] == [d.grasp_type for d in named.demonstrations]
    with pytest.raises(ValueError, match="generator 'magic' is unknown; use one of kopicki, heuristic, or a folder"):
        make_generator("magic", hand)


def test_demonstrations_of_another_hand_are_refused() -> None:
    with pytest.raises(ValueError, match=r"the hand dlr2 \(right\), not of dlr2 \(left\)"):
        make_generator("kopicki", Hand.load(side="left"))


def test_the_support_of_an_object_is_an_obstacle() -> None:
    scene = Scene.place(make_object("scissors_02"), seed=0)
    seen = obstacles(scene.observe(seed=1, ideal=True))
    assert scene.support is not None
    assert len(seen) > 5
    local = seen @ torch.tensor(scene.support.pose[:3, :3], dtype=torch.float32)
    assert (local[:, :2].abs() < torch.tensor(scene.support.half[:2]) + 0.015).all()


@pytest.mark.parametrize("name", ["plate_05", "knife_02"])
def test_what_carries_an_object_is_guessed_to_be_under_its_middle(name: str, generator: KopickiGenerator) -> None:
    scene = Scene.place(make_object(name), seed=0)
    support = scene.support
    assert support is not None
    guess = underneath(generator.density(scene.observe(seed=1)).surface.points)
    low, half = guess[guess[:, 2] < 0.015], torch.tensor(support.half)
    local = (low @ torch.tensor(support.pose[:3, :3], dtype=torch.float32))[:, :2]
    inside = (local.abs() < half[:2] + 0.01).all(-1)
    assert inside.float().mean() > 0.5, "most of it is where the block is"
    assert (local[inside].abs().amax(0) > half[:2] - 0.01).all(), "and reaches as far"
    assert float(guess[:, 2].max()) == pytest.approx(2 * float(half[2]), abs=0.01)


@pytest.mark.parametrize("name", ["knife_02", "scissors_02", "spatula_01"])
def test_the_hidden_rest_of_what_carries_an_object_is_where_it_is_guessed(name: str) -> None:
    scene = Scene.place(make_object(name), seed=0)
    support = scene.support
    assert support is not None
    view = scene.observe(seed=1)
    camera = torch.tensor(view.T_world_camera[:3, 3], dtype=torch.float32)
    seen = obstacles(view)
    guess = beyond(torch.from_numpy(view.points_world), seen, camera)
    guess = guess[torch.from_numpy(~view.would_see(guess.numpy()))]
    pose, half = torch.tensor(support.pose, dtype=torch.float32), torch.tensor(support.half, dtype=torch.float32)
    inside = (((guess - pose[:3, 3]) @ pose[:3, :3]).abs() < half + 0.01).all(-1)
    assert inside.float().mean() > 0.8
    block = (2 * torch.rand(1000, 3, generator=torch.Generator().manual_seed(0)) - 1) * half
    gap = torch.cdist(block @ pose[:3, :3].T + pose[:3, 3], torch.cat((seen, guess))).amin(1)
    assert (gap < 0.01).float().mean() > 0.9, "and next to nothing of it is left out"


def test_nothing_is_guessed_under_what_stands_on_the_table(generator: KopickiGenerator, can_view: Observation) -> None:
    points = generator.density(can_view).surface.points
    assert not len(underneath(points))
    assert not len(beyond(points, points, torch.tensor([0.0, -0.5, 0.5])))


def test_the_cost_by_the_nearest_points_is_that_by_all(generator: KopickiGenerator) -> None:
    scene = Scene.place(make_object("scissors_02"), seed=0)
    view = scene.observe(seed=1)
    density = generator.density(view)
    others = obstacles(view)
    motion = ApproachMotion(
        generator.demonstrations, generator.models, generator.hand, density.surface.points, others, torch.Generator()
    )
    grips = density.sample(60, torch.Generator().manual_seed(0))
    full = motion.table_cost(grips)
    assert (full > motion.table_cost(grips, others[:0])).any(), "some grips touch the block and not the table"
    torch.testing.assert_close(motion.table_cost_near(grips)(grips), full)


def test_what_cannot_be_grasped_is_said(generator: KopickiGenerator, can_view: Observation) -> None:
    with pytest.raises(ValueError, match="num_grasps is 0"):
        generator.generate(can_view, 0)
    # a slab as large as the table that hides everything below it
    camera = Camera(320, 240, 287.0, 287.0, 160.0, 120.0)
    pose = look_at(np.array([0.0, 0.0, 0.0]), 0.6, 0.3, 1.5)
    down = camera.directions() @ pose[:3, :3].T
    depth = (0.02 - pose[2, 3]) / down[..., 2]
    slab = Observation(depth, camera, pose, mask=np.ones((240, 320), bool))
    with pytest.raises(RuntimeError, match="no feasible grasp"):
        generator.generate(slab, 10)

"""What refinement is made of, against independent references: variables, penalties, prior, optimisers."""

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from torch import Tensor
from torch.autograd import gradcheck

from dexzoo import rotation
from dexzoo.camera import Observation
from dexzoo.generators.density import GraspDensity
from dexzoo.generators.kopicki import KopickiGenerator
from dexzoo.grasp import GRIP, PREGRASP, SQUEEZE, Grasps
from dexzoo.hand import Hand
from dexzoo.refinement.optimisers import OPTIMISERS, Draws, Search
from dexzoo.refinement.penalties import AT_OBJECT, MOMENTS, SHADOW_DEPTHS, Posed, Prior, Surroundings
from dexzoo.refinement.variables import VARIABLES, GripVariables, Region, make_variables


@pytest.fixture(scope="module")
def world(can_grasps: Grasps, can_view: Observation) -> Tensor:
    return can_grasps[:12].to_frame("world", can_view.T_world_camera).waypoints


@pytest.fixture(scope="module")
def around(can_view: Observation) -> Surroundings:
    return Surroundings(can_view)


@pytest.fixture(scope="module")
def density(can_view: Observation) -> GraspDensity:
    return KopickiGenerator(num_kernels=5000).density(can_view)


def some_states(num: int, size: int, seed: int = 0) -> Tensor:
    """States all over the box, its corners among them."""
    generator = torch.Generator().manual_seed(seed)
    states = 2 * torch.rand(num, size, generator=generator) - 1
    states[: num // 2] = states[: num // 2].sign()
    return states


# variables


@pytest.mark.parametrize("name", VARIABLES)
def test_the_start_is_the_given_grasp(world: Tensor, hand: Hand, name: str) -> None:
    moved = make_variables(name, world, hand, Region())
    assert moved.start.abs().max() <= 1 + 1e-6
    torch.testing.assert_close(moved(moved.start), world, atol=2e-6, rtol=0)


@pytest.mark.parametrize("name", VARIABLES)
def test_all_of_the_box_is_in_the_trust_region(world: Tensor, hand: Hand, name: str) -> None:
    region = Region(0.004, 0.06, 0.09, 0.1, 0.2)
    moved = make_variables(name, world, hand, region)
    for seed in range(5):
        after = Grasps(moved(some_states(*moved.start.shape, seed=seed)), "world")
        before = Grasps(world, "world")
        hand.check(after.joints, tolerance=1e-6)
        assert torch.equal(after.grasp_type, before.grasp_type)
        torch.testing.assert_close(after.quaternion.norm(dim=-1), torch.ones(12, 10))
        change = (after.joints - before.joints)[:, GRIP].abs()
        assert float(change.max()) == pytest.approx(0.09, abs=1e-5)
        turn = rotation.conjugate(before.quaternion[:, GRIP])
        step = after.position[:, GRIP] - before.position[:, GRIP]
        turned = rotation.log(rotation.multiply(turn, after.quaternion[:, GRIP]))
        if name == "waypoints":
            assert float(step.abs().max()) == pytest.approx(0.004, abs=1e-5)
            assert float(turned.abs().max()) < 2.1 * 0.06  # where several of the quaternion's numbers are moved
        else:
            assert float(rotation.rotate(turn, step).abs().max()) == pytest.approx(0.004, abs=1e-5)
            assert float(turned.abs().max()) == pytest.approx(0.06, abs=1e-4)
        if name == "grip":
            torch.testing.assert_close(after.joints, hand.expand(hand.reduce(after.joints)))


def test_the_wrist_carries_the_whole_path(world: Tensor, hand: Hand) -> None:
    moved = GripVariables(world, hand, Region())
    after = Grasps(moved(some_states(12, 23)), "world")
    step = after.wrist_pose.double() @ torch.linalg.inv(Grasps(world, "world").wrist_pose.double())
    torch.testing.assert_close(step, step[:, GRIP, None].expand_as(step), atol=3e-6, rtol=0)


def test_opening_and_squeeze_are_shares_of_the_ways_there(world: Tensor, hand: Hand) -> None:
    moved = GripVariables(world, hand, Region(opening=0.2, squeeze=0.3))
    state = moved.start.clone()
    state[:, -2:] = torch.tensor([0.5, -1.0])
    after, before = moved(state)[..., 7:27], world[..., 7:27]
    wider = before[:, PREGRASP] + 0.1 * (before[:, PREGRASP] - before[:, GRIP])
    torch.testing.assert_close(after[:, PREGRASP], hand.clamp(wider), atol=1e-5, rtol=0)
    weaker = before[:, GRIP] + 0.7 * (before[:, SQUEEZE] - before[:, GRIP])
    torch.testing.assert_close(after[:, SQUEEZE], hand.clamp(weaker), atol=1e-5, rtol=0)
    torch.testing.assert_close(after[:, GRIP], before[:, GRIP], atol=1e-5, rtol=0)


@pytest.mark.parametrize("name", VARIABLES)
def test_the_waypoints_are_differentiable(world: Tensor, hand: Hand, name: str) -> None:
    given = world[:2].double()
    given[..., 7:27] = hand.expand((hand.reduce(hand.lower) + hand.reduce(hand.upper)).double() / 2)  # far from limits
    moved = make_variables(name, given, hand, Region())
    states = (0.3 * some_states(*moved.start.shape)).double().requires_grad_()
    assert gradcheck(moved, states, fast_mode=name == "waypoints")


def test_a_region_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match=r"the trust region's turn is 0.0, expected a positive number"):
        Region(turn=0.0)


# penalties


def poses(hand: Hand, waypoints: Tensor, moments: list[int]) -> Tensor:
    """(grasp, moment, link, 4, 4) in the world, float64."""
    grasps = Grasps(waypoints.double(), "world")
    return grasps.wrist_pose[:, moments, None] @ hand.forward_kinematics(grasps.joints[:, moments])


def sunk(world: Tensor, view: Observation, depth: float = 0.03) -> Tensor:
    """The hands moved towards the middle of what is seen."""
    way = world.clone()
    towards = torch.from_numpy(view.points_world).mean(0) - way[:, GRIP, :3]
    way[..., :3] += depth * torch.nn.functional.normalize(towards, dim=-1)[:, None]
    return way


def test_penetration_is_that_of_all_points(
    world: Tensor, can_view: Observation, around: Surroundings, hand: Hand
) -> None:
    """By every observed point and every link by itself, in the world frame, in float64."""
    way = sunk(world, can_view)
    found = Posed(hand, way).penetration(Posed(hand, way).nearest(around.observed, AT_OBJECT))
    links = poses(hand, way, list(MOMENTS[AT_OBJECT:]))
    expected = torch.zeros(len(way), dtype=torch.float64)
    for grasp in range(len(way)):
        for moment in range(links.shape[1]):
            deepest = hand.signed_distance(links[grasp, moment], around.observed.double()).amin(-1)
            expected[grasp] += (-deepest).clamp_min(0).sum()
    assert (expected > 0.003).sum() > 9
    torch.testing.assert_close(found.double(), expected, atol=1e-5, rtol=1e-3)


def test_what_is_near_stays_so_within_the_trust_region(
    world: Tensor, can_view: Observation, around: Surroundings, hand: Hand
) -> None:
    """One stage moves the wrist, the other the fingers; what is near is sought for each."""
    moved = GripVariables(world, hand, Region())
    for stage in moved.stages:
        after = moved(torch.where(stage > 0, some_states(12, 23), moved.start))
        for points in (around.observed, around.shadow):
            kept, anew = (Posed(hand, w).nearest(points, AT_OBJECT) for w in (world, after))
            there = Posed(hand, after)
            found, expected = there.penetration(kept), there.penetration(anew)
            assert float(expected.max()) > 0.005
            assert float((found - expected).abs().mean()) < 0.15 * float(expected.mean())


def test_the_shadow_is_behind_what_is_seen(can_view: Observation, around: Surroundings) -> None:
    shadow = around.shadow.numpy()
    assert len(shadow) > 100
    assert (shadow[:, 2] > 0).all()
    assert can_view.would_see(shadow, margin=-0.002).mean() < 0.05  # at edges the line of sight meets what is before
    camera = can_view.T_world_camera[:3, 3]
    gap = np.linalg.norm(shadow[:, None] - around.observed.numpy(), axis=-1).min(1)
    assert gap.max() < max(SHADOW_DEPTHS) + 0.006  # one point in several is in the sample
    farther = (
        np.linalg.norm(shadow - camera, axis=1).mean() - np.linalg.norm(around.observed.numpy() - camera, axis=1).mean()
    )
    assert farther == pytest.approx(np.mean(SHADOW_DEPTHS), abs=0.003)


def test_the_table_is_what_each_link_lacks_of_its_clearance(world: Tensor, hand: Hand) -> None:
    way = world.clone()
    links = poses(hand, way, [GRIP])
    way[..., 2] -= (hand.clearance(links, torch.tensor([0.0, 0, 1, 0]).double()).amin((-1, -2)) + 0.004)[
        :, None
    ].float()
    found = Posed(hand, way).table(torch.zeros(len(way), len(MOMENTS), 0, 3))
    height = hand.clearance(poses(hand, way, list(MOMENTS)), torch.tensor([0.0, 0, 1, 0]).double())
    torch.testing.assert_close(found.double(), (0.002 - height).clamp_min(0).sum((-1, -2)), atol=1e-5, rtol=1e-4)
    assert float(found.min()) > 0.006 - 1e-5
    point = way[:, GRIP, None, None, :3].expand(-1, len(MOMENTS), 1, 3)  # something stands where the palm is
    assert (Posed(hand, way).table(point) > found + 0.005).all()


def test_self_collision_is_that_of_all_pairs_at_the_grip(world: Tensor, hand: Hand) -> None:
    way = world.clone()
    generator = torch.Generator().manual_seed(1)
    share = torch.rand(len(way), 15, generator=generator)
    low, high = hand.reduce(hand.lower), hand.reduce(hand.upper)
    way[:, GRIP, 7:27] = hand.expand(low + share * (high - low))
    gaps = hand.self_distance(poses(hand, way, [GRIP]))[:, 0]
    expected = (-gaps).clamp_min(0).sum(-1)
    assert float(expected.max()) > 0.001
    torch.testing.assert_close(Posed(hand, way).self_collision().double(), expected, atol=1e-5, rtol=1e-3)


@pytest.mark.parametrize("term", ["penetration", "shadow", "table", "self_collision"])
def test_slopes_of_penalties_are_those_of_finite_differences(
    world: Tensor, can_view: Observation, around: Surroundings, hand: Hand, term: str
) -> None:
    way = sunk(world, can_view, 0.02)
    way[..., 2] -= 0.02
    if term == "self_collision":
        low, high = hand.reduce(hand.lower), hand.reduce(hand.upper)
        share = torch.rand(len(way), 1, 15, generator=torch.Generator().manual_seed(1))
        way[..., 7:27] = hand.expand(low + (0.1 + 0.8 * share) * (high - low))
    way = way.double()
    moved = GripVariables(way, hand, Region())
    near = {
        "penetration": Posed(hand, way).nearest(around.observed, AT_OBJECT),
        "shadow": Posed(hand, way).nearest(around.shadow, AT_OBJECT),
        "table": Posed(hand, way).nearest(around.observed),
    }

    def value(state: Tensor) -> Tensor:
        posed = Posed(hand, moved(state))
        if term == "self_collision":
            return posed.self_collision()
        return posed.table(near[term]) if term == "table" else posed.penetration(near[term])

    state = (0.8 * moved.start).requires_grad_()
    (slope,) = torch.autograd.grad(value(state).sum(), state)
    assert float(slope.abs().max()) > 1e-4
    step = 1e-5
    with torch.no_grad():
        for number in range(state.shape[1]):
            change = torch.zeros_like(state)
            change[:, number] = step
            difference = (value(state + change) - value(state - change)) / (2 * step)
            close = torch.isclose(slope[:, number], difference, atol=2e-6, rtol=1e-3)
            assert close.float().mean() > 0.9  # a kink lies here and there, where another point is the deepest


# prior


def test_the_prior_is_the_generators_density(world: Tensor, density: GraspDensity) -> None:
    grasps = Grasps(world, "world")
    torch.testing.assert_close(Prior(density, world)(world), density.log_density(grasps), atol=1e-3, rtol=1e-3)


def test_a_type_that_nobody_showed_has_no_prior(world: Tensor, density: GraspDensity) -> None:
    few = GraspDensity.__new__(GraspDensity)
    few.__dict__.update(density.__dict__)
    shown = int(world[0, 0, 27])
    rows = [i for i, d in enumerate(density.demonstrations) if d.grasp_type == shown]
    few.demonstrations = [density.demonstrations[i] for i in rows]
    for name in ("links", "active", "kernel_position", "kernel_turn", "log_weight", "grip", "closing"):
        setattr(few, name, getattr(density, name)[rows])
    value = Prior(few, world)(world)
    same = world[:, 0, 27] == shown
    assert 0 < int(same.sum()) < len(world)
    assert (value[~same] == 0).all()
    torch.testing.assert_close(value[same], Prior(density, world)(world)[same], atol=1e-4, rtol=1e-4)
    unknown = world[~same]
    assert (Prior(few, unknown)(unknown) == 0).all()


# optimisers

SIZE = 5


def quadratic(optimum: Tensor):  # noqa: ANN201
    """A curved bowl whose top is known, for three grasps; by how much it is below the top."""
    bend = torch.tensor([[1.0, 4, 2, 9, 3], [8, 1, 5, 2, 1], [2, 2, 7, 1, 4]])

    def value(state: Tensor) -> Tensor:
        off = state - optimum
        return -(bend * off.square()).sum(-1) - 0.5 * off[:, 0] * off[:, 1]

    return value


def run(name: str, function, num_steps: int, step_size: float = 0.2, moves: Tensor | None = None) -> Search:  # noqa: ANN001
    start = torch.zeros(3, SIZE)
    gradient = name in ("adam", "lbfgs")
    search = Search(lambda s: (function(s), {"log_odds": function(s)}), start, gradient, lambda *_: None)
    draws = Draws.draw(num_steps, SIZE, [torch.Generator().manual_seed(seed) for seed in range(3)])
    OPTIMISERS[name](search, torch.ones(SIZE) if moves is None else moves, num_steps, step_size, draws)
    return search


@pytest.mark.parametrize(
    ("name", "num_steps", "short_of"),
    [("adam", 60, 0.02), ("lbfgs", 30, 1e-3), ("metropolis", 400, 0.15), ("random", 400, 0.1)],
)
@pytest.mark.parametrize("scale", [0.6, 1.8], ids=["inside", "outside"])
def test_each_finds_the_top_that_the_box_allows(name: str, num_steps: int, short_of: float, scale: float) -> None:
    """The reference is SciPy's bounded minimiser, grasp by grasp."""
    optimum = scale * (2 * torch.rand(3, SIZE, generator=torch.Generator().manual_seed(3)) - 1)
    function = quadratic(optimum)
    best = []
    for grasp in range(3):

        def cost(x: np.ndarray, grasp: int = grasp) -> float:
            return -float(function(torch.tensor(x, dtype=torch.float32).expand(3, -1))[grasp])

        best.append(
            -minimize(
                cost, np.zeros(SIZE), method="Nelder-Mead", bounds=[(-1, 1)] * SIZE, options={"maxiter": 4000}
            ).fun
        )
    found = run(name, function, num_steps)
    assert found.best.abs().max() <= 1
    gap = torch.tensor(best) - found.value
    assert (gap < short_of * (torch.tensor(best) - function(torch.zeros(3, SIZE)))).all()
    torch.testing.assert_close(found.terms["log_odds"], found.value)
    torch.testing.assert_close(found.value, function(found.best))


@pytest.mark.parametrize("name", OPTIMISERS)
def test_each_evaluates_as_often_as_it_may(name: str) -> None:
    calls = []
    run(name, lambda s: calls.append(len(s)) or quadratic(torch.ones(3, SIZE))(s), 7)
    assert len(calls) == 2 * (1 + 7)  # once as the value, once as the term


@pytest.mark.parametrize("name", OPTIMISERS)
def test_only_what_may_move_moves(name: str) -> None:
    moves = torch.tensor([1.0, 0, 1, 0, 0])
    found = run(name, quadratic(torch.full((3, SIZE), 0.5)), 20, moves=moves)
    assert (found.best[:, moves == 0] == 0).all()
    assert (found.best[:, moves == 1] != 0).any(0).all()


@pytest.mark.parametrize("name", OPTIMISERS)
def test_a_state_without_a_number_is_not_taken(name: str) -> None:
    """The second grasp has none beyond 0.2, on the way to its top."""
    rise = quadratic(torch.full((3, SIZE), 0.7))

    def function(state: Tensor) -> Tensor:
        beyond = (torch.arange(3) == 1) & (state.amax(-1) > 0.2)
        return torch.where(beyond, torch.nan, rise(state))

    found = run(name, function, 30)
    assert found.failed.tolist() == [False, True, False]
    assert float(found.best[1].max()) < 0.2001
    assert torch.isfinite(found.best).all()
    assert torch.isfinite(found.value).all()
    whole = run(name, rise, 30)
    torch.testing.assert_close(found.best[[0, 2]], whole.best[[0, 2]])


def test_metropolis_hastings_leaves_a_top_that_random_steps_do_not() -> None:
    """At a temperature, states below the best one are stepped from."""
    seen = {}
    for name in ("metropolis", "random"):
        values = []
        search = Search(
            lambda s: (-0.1 * s.square().sum(-1), {}),
            torch.zeros(3, SIZE),
            False,
            lambda s, v, values=values: values.append(s),
        )
        draws = Draws.draw(50, SIZE, [torch.Generator().manual_seed(seed) for seed in range(3)])
        OPTIMISERS[name](search, torch.ones(SIZE), 50, 0.1, draws)
        seen[name] = torch.stack(values).abs().amax()
        assert (search.best == 0).all()
    assert seen["metropolis"] > seen["random"]

"""What refinement is made of, against independent references: variables, terms, prior, optimizers."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from torch import Tensor
from torch.autograd import gradcheck

from dexzoo import rotation
from dexzoo.generators.contact_density import ContactDensity
from dexzoo.generators.demonstration import load_demonstrations
from dexzoo.generators.generator import GraspDensity
from dexzoo.generators.kopicki import KopickiGenerator
from dexzoo.grasp import GRIP, PREGRASP, SQUEEZE, Grasps, Trajectory
from dexzoo.hand import Hand
from dexzoo.perception import Observation, View
from dexzoo.perception.view import SHADOW_DEPTHS
from dexzoo.refinement.optimizers import OPTIMIZERS, Draws, Search
from dexzoo.refinement.posed_hand import MOMENTS, PosedHand
from dexzoo.refinement.terms import AT_OBJECT, Penetration, Prior, SelfCollision, Shadow, Table, Term
from dexzoo.refinement.trust_region import TrustRegion
from dexzoo.refinement.variables import GripVariables, MakeVariables
from experiments.variables import UncoupledVariables, WaypointVariables

VARIABLES = (GripVariables, UncoupledVariables, WaypointVariables)
UP = torch.tensor([0.0, 0, 1, 0])


@pytest.fixture(scope="module")
def world(can_grasps: Grasps) -> Trajectory:
    return can_grasps[:12].trajectory


@pytest.fixture(scope="module")
def view(can_view: Observation) -> View:
    return View(can_view)


@pytest.fixture(scope="module")
def density(view: View, hand: Hand) -> ContactDensity:
    return KopickiGenerator(load_demonstrations(hand), num_kernels=5000).density(view)


def some_states(num: int, size: int, seed: int = 0) -> Tensor:
    """States all over the box, its corners among them."""
    generator = torch.Generator().manual_seed(seed)
    states = 2 * torch.rand(num, size, generator=generator) - 1
    states[: num // 2] = states[: num // 2].sign()
    return states


def shifted(grasps: Trajectory, step: Tensor) -> Trajectory:
    """Each grasp moved as a whole, by steps (grasp, 3)."""
    return replace(grasps, wrist=torch.cat((grasps.position + step[:, None], grasps.quaternion), -1))


def value(term: Term, view: View, hand: Hand, grasps: Trajectory, near: Trajectory | None = None) -> Tensor:
    """A term's value of grasps, by what is near them or some others."""
    return term.near(view, PosedHand(hand, near or grasps))(PosedHand(hand, grasps))


# variables


@pytest.mark.parametrize("variables", VARIABLES)
def test_the_start_is_the_given_grasp(world: Trajectory, hand: Hand, variables: MakeVariables) -> None:
    moved = variables(world, hand, TrustRegion())
    assert moved.start.abs().max() <= 1 + 1e-6
    start = moved(moved.start)
    torch.testing.assert_close(start.wrist, world.wrist, atol=2e-6, rtol=0)
    torch.testing.assert_close(start.joints, world.joints, atol=2e-6, rtol=0)


@pytest.mark.parametrize("variables", VARIABLES)
def test_all_of_the_box_is_in_the_trust_region(world: Trajectory, hand: Hand, variables: MakeVariables) -> None:
    moved = variables(world, hand, TrustRegion(0.004, 0.06, 0.09, 0.1, 0.2))
    for seed in range(5):
        after = Grasps.of(moved(some_states(*moved.start.shape, seed=seed)), hand)
        hand.check(after.joints, tolerance=1e-6)
        assert torch.equal(after.grasp_type, world.grasp_type)
        torch.testing.assert_close(after.quaternion.norm(dim=-1), torch.ones(12, 10))
        change = (after.joints - world.joints)[:, GRIP].abs()
        assert float(change.max()) == pytest.approx(0.09, abs=1e-5)
        turn = rotation.conjugate(world.quaternion[:, GRIP])
        step = after.position[:, GRIP] - world.position[:, GRIP]
        turned = rotation.log(rotation.multiply(turn, after.quaternion[:, GRIP]))
        if variables is WaypointVariables:
            assert float(step.abs().max()) == pytest.approx(0.004, abs=1e-5)
            assert float(turned.abs().max()) < 2.1 * 0.06  # where several of the quaternion's numbers are moved
        else:
            assert float(rotation.rotate(turn, step).abs().max()) == pytest.approx(0.004, abs=1e-5)
            assert float(turned.abs().max()) == pytest.approx(0.06, abs=1e-4)
        coupled = torch.isclose(after.joints, hand.expand(hand.reduce(after.joints)), atol=1e-5).all()
        assert bool(coupled) == (variables is GripVariables)


def test_the_wrist_carries_the_whole_path(world: Trajectory, hand: Hand) -> None:
    moved = GripVariables(world, hand, TrustRegion())
    step = moved(some_states(12, 23)).wrist_pose.double() @ torch.linalg.inv(world.wrist_pose.double())
    torch.testing.assert_close(step, step[:, GRIP, None].expand_as(step), atol=3e-6, rtol=0)


def test_opening_and_squeeze_are_shares_of_the_ways_there(world: Trajectory, hand: Hand) -> None:
    moved = GripVariables(world, hand, TrustRegion(opening=0.2, squeeze=0.3))
    state = moved.start.clone()
    state[:, -2:] = torch.tensor([0.5, -1.0])
    after, before = moved(state).joints, world.joints
    wider = before[:, PREGRASP] + 0.1 * (before[:, PREGRASP] - before[:, GRIP])
    torch.testing.assert_close(after[:, PREGRASP], hand.clamp(wider), atol=1e-5, rtol=0)
    weaker = before[:, GRIP] + 0.7 * (before[:, SQUEEZE] - before[:, GRIP])
    torch.testing.assert_close(after[:, SQUEEZE], hand.clamp(weaker), atol=1e-5, rtol=0)
    torch.testing.assert_close(after[:, GRIP], before[:, GRIP], atol=1e-5, rtol=0)


@pytest.mark.parametrize("variables", VARIABLES)
def test_the_grasps_are_differentiable(world: Trajectory, hand: Hand, variables: MakeVariables) -> None:
    middle = hand.expand((hand.reduce(hand.lower) + hand.reduce(hand.upper)).double() / 2)  # far from limits
    given = world[:2].to(torch.float64)
    moved = variables(replace(given, joints=middle.expand_as(given.joints)), hand, TrustRegion())
    states = (0.3 * some_states(*moved.start.shape)).double().requires_grad_()

    def numbers(states: Tensor) -> tuple[Tensor, Tensor]:
        after = moved(states)
        return after.wrist, after.joints

    assert gradcheck(numbers, states, fast_mode=variables is WaypointVariables)


def test_a_region_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match=r"the trust region's turn is 0.0, expected a positive number"):
        TrustRegion(turn=0.0)


# penalties


def poses(hand: Hand, grasps: Trajectory, moments: list[int]) -> Tensor:
    """(grasp, moment, link, 4, 4) in the world, float64."""
    way = grasps.waypoint(moments).to(torch.float64)
    return way.wrist_pose[:, :, None] @ hand.forward_kinematics(way.joints)


def sunk(world: Trajectory, view: View, depth: float = 0.03) -> Trajectory:
    """The hands moved towards the middle of what is seen."""
    towards = view.points.mean(0) - world.position[:, GRIP]
    return shifted(world, depth * torch.nn.functional.normalize(towards, dim=-1))


@pytest.mark.parametrize(("term", "num_deep"), [(Penetration(), 10), (Shadow(), 9)])
def test_penetration_is_that_of_all_points(
    world: Trajectory, view: View, hand: Hand, term: Term, num_deep: int
) -> None:
    """By every point and every link by itself, in the world frame, in float64."""
    way = sunk(world, view)
    points = (view.observed if isinstance(term, Penetration) else view.shadow).double()
    links = poses(hand, way, list(MOMENTS[AT_OBJECT:]))
    expected = torch.zeros(len(way), dtype=torch.float64)
    for grasp in range(len(way)):
        for moment in range(links.shape[1]):
            deepest = hand.signed_distance(links[grasp, moment], points).amin(-1)
            expected[grasp] += (-deepest).clamp_min(0).sum()
    assert (expected > 0.003).sum() >= num_deep
    torch.testing.assert_close(value(term, view, hand, way).double(), expected, atol=1e-5, rtol=1e-3)


def test_what_is_near_stays_so_within_the_trust_region(world: Trajectory, view: View, hand: Hand) -> None:
    """One stage moves the wrist, the other the fingers; what is near is sought for each."""
    moved = GripVariables(world, hand, TrustRegion())
    for stage in moved.stages:
        after = moved(torch.where(stage > 0, some_states(12, 23), moved.start))
        for term in (Penetration(), Shadow()):
            found, expected = value(term, view, hand, after, near=world), value(term, view, hand, after)
            assert float(expected.max()) > 0.005
            assert float((found - expected).abs().mean()) < 0.15 * float(expected.mean())


def test_the_shadow_is_behind_what_is_seen(can_view: Observation, view: View) -> None:
    shadow = view.shadow.numpy()
    assert len(shadow) > 100
    assert (shadow[:, 2] > 0).all()
    assert can_view.would_see(shadow, margin=-0.002).mean() < 0.05  # at edges the line of sight meets what is before
    camera = can_view.T_world_camera[:3, 3]
    gap = np.linalg.norm(shadow[:, None] - view.observed.numpy(), axis=-1).min(1)
    assert gap.max() < max(SHADOW_DEPTHS) + 0.006  # one point in several is in the sample
    farther = (
        np.linalg.norm(shadow - camera, axis=1).mean() - np.linalg.norm(view.observed.numpy() - camera, axis=1).mean()
    )
    assert farther == pytest.approx(np.mean(SHADOW_DEPTHS), abs=0.003)


def test_the_table_is_what_each_link_lacks_of_its_clearance(
    world: Trajectory, can_view: Observation, hand: Hand
) -> None:
    lowest = hand.clearance(poses(hand, world, [GRIP]), UP.double()).amin((-1, -2)).float()
    way = shifted(world, -(lowest + 0.004)[:, None] * UP[:3])
    alone, beside = View(can_view), View(can_view)
    assert not len(alone.obstructions)
    beside.obstructions = way.position[:, GRIP]  # something stands where each palm is
    found = value(Table(), alone, hand, way)
    height = hand.clearance(poses(hand, way, list(MOMENTS)), UP.double())
    torch.testing.assert_close(found.double(), (0.002 - height).clamp_min(0).sum((-1, -2)), atol=1e-5, rtol=1e-4)
    assert float(found.min()) > 0.006 - 1e-5
    assert (value(Table(), beside, hand, way) > found + 0.005).all()


def test_the_table_objects_where_the_approach_lacks_more_clearance(
    world: Trajectory, can_view: Observation, hand: Hand
) -> None:
    """At each waypoint up to the grip, the term itself looks at three of them only; the squeeze may press."""
    lower = {}
    for waypoint in (2, GRIP, SQUEEZE):
        links = poses(hand, world, [waypoint])
        sink = hand.clearance(links, UP.double()).amin((-1, -2)).float() + 0.004
        position = world.position.clone()
        position[:, waypoint, 2] -= sink
        lower[waypoint] = replace(world, wrist=torch.cat((position, world.quaternion), -1))
    view = View(can_view)
    assert Table().accepts(view, hand, world, world).all()
    assert not Table().accepts(view, hand, world, lower[2]).any()
    assert not Table().accepts(view, hand, world, lower[GRIP]).any()
    assert Table().accepts(view, hand, world, lower[SQUEEZE]).all()
    assert Table().accepts(view, hand, lower[2], world).all()


def with_random_joints(hand: Hand, grasps: Trajectory, low: float, high: float) -> Trajectory:
    """All waypoints with one posture, between some shares of the ranges."""
    share = torch.rand(len(grasps), 1, len(hand.freedoms), generator=torch.Generator().manual_seed(1))
    lower, upper = hand.reduce(hand.lower), hand.reduce(hand.upper)
    joints = hand.expand(lower + (low + (high - low) * share) * (upper - lower))
    return replace(grasps, joints=joints.expand_as(grasps.joints))


def test_self_collision_is_that_of_all_pairs_at_the_grip(world: Trajectory, view: View, hand: Hand) -> None:
    bent = with_random_joints(hand, world, 0.0, 1.0).joints[:, GRIP, None]
    joints = torch.cat((world.joints[:, :GRIP], bent, world.joints[:, GRIP + 1 :]), 1)
    way = replace(world, joints=joints)
    gaps = hand.self_distance(poses(hand, way, [GRIP]))[:, 0]
    expected = (-gaps).clamp_min(0).sum(-1)
    assert float(expected.max()) > 0.001
    found = value(SelfCollision(), view, hand, way)
    torch.testing.assert_close(found.double(), expected, atol=1e-5, rtol=1e-3)


@pytest.mark.parametrize("term", [Penetration(), Shadow(), Table(), SelfCollision()])
def test_slopes_of_penalties_are_those_of_finite_differences(
    world: Trajectory, view: View, hand: Hand, term: Term
) -> None:
    way = shifted(sunk(world, view, 0.02), torch.tensor([0, 0, -0.02]).expand(len(world), 3))
    if isinstance(term, SelfCollision):
        way = with_random_joints(hand, way, 0.1, 0.9)
    way = way.to(torch.float64)
    moved = GripVariables(way, hand, TrustRegion())
    near = term.near(view, PosedHand(hand, way))

    def value(state: Tensor) -> Tensor:
        return near(PosedHand(hand, moved(state)))

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


def test_the_prior_is_the_generators_density(
    world: Trajectory, view: View, hand: Hand, density: ContactDensity
) -> None:
    found = value(Prior(density), view, hand, world)
    torch.testing.assert_close(found, density.log_density(world), atol=1e-3, rtol=1e-3)


def test_a_type_that_nobody_showed_has_no_prior(
    world: Trajectory, view: View, hand: Hand, density: ContactDensity
) -> None:
    few = ContactDensity.__new__(ContactDensity)
    few.__dict__.update(density.__dict__)
    shown = int(world.grasp_type[0])
    rows = [i for i, d in enumerate(density.demonstrations) if d.grasp_type == shown]
    few.demonstrations = [density.demonstrations[i] for i in rows]
    for name in ("links", "active", "kernel_position", "kernel_turn", "log_weight", "grip", "closing"):
        setattr(few, name, getattr(density, name)[rows])
    found = value(Prior(few), view, hand, world)
    same = world.grasp_type == shown
    assert 0 < int(same.sum()) < len(world)
    assert (found[~same] == 0).all()
    torch.testing.assert_close(found[same], value(Prior(density), view, hand, world)[same], atol=1e-4, rtol=1e-4)
    assert (value(Prior(few), view, hand, world[~same]) == 0).all()


def test_a_density_of_ones_own_is_a_prior(world: Trajectory, view: View, hand: Hand) -> None:
    """It says what it knows of any grasps; what is near follows."""

    class LowerIsLikelier(GraspDensity):
        def log_density(self, grasps: Trajectory) -> Tensor:
            known = grasps.grasp_type == world.grasp_type[0]
            return torch.where(known, -grasps.position[:, GRIP, 2], -torch.inf)

    height = world.position[:, GRIP, 2]
    moved = shifted(world, torch.tensor([0, 0, 0.01]).expand(len(world), 3))
    found = value(Prior(LowerIsLikelier()), view, hand, moved, near=world)
    torch.testing.assert_close(found, torch.where(world.grasp_type == world.grasp_type[0], -height - 0.01, 0.0))


# optimizers

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
    OPTIMIZERS[name](search, torch.ones(SIZE) if moves is None else moves, num_steps, step_size, draws)
    return search


@pytest.mark.parametrize(
    ("name", "num_steps", "short_of"),
    [("adam", 60, 0.02), ("lbfgs", 30, 1e-3), ("metropolis", 400, 0.15), ("random", 400, 0.1)],
)
@pytest.mark.parametrize("scale", [0.6, 1.8], ids=["inside", "outside"])
def test_each_finds_the_top_that_the_box_allows(name: str, num_steps: int, short_of: float, scale: float) -> None:
    """The reference is SciPy's bounded minimizer, grasp by grasp."""
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
    torch.testing.assert_close(found.values["log_odds"], found.value)
    torch.testing.assert_close(found.value, function(found.best))


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_each_evaluates_as_often_as_it_may(name: str) -> None:
    calls = []
    run(name, lambda s: calls.append(len(s)) or quadratic(torch.ones(3, SIZE))(s), 7)
    assert len(calls) == 2 * (1 + 7)  # once as the value, once as the term


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_only_what_may_move_moves(name: str) -> None:
    moves = torch.tensor([1.0, 0, 1, 0, 0])
    found = run(name, quadratic(torch.full((3, SIZE), 0.5)), 20, moves=moves)
    assert (found.best[:, moves == 0] == 0).all()
    assert (found.best[:, moves == 1] != 0).any(0).all()


@pytest.mark.parametrize("name", OPTIMIZERS)
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
        OPTIMIZERS[name](search, torch.ones(SIZE), 50, 0.1, draws)
        seen[name] = torch.stack(values).abs().amax()
        assert (search.best == 0).all()
    assert seen["metropolis"] > seen["random"]

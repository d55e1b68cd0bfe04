"""Epsilon, singular values and worst wrenches: closed forms, searches, sampling, and scaling laws."""

from __future__ import annotations

from functools import partial
from itertools import combinations

import numpy as np
import pytest
from problems import closure_grasps, random_grasp
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from grasp_env.errors import GraspError
from grasp_env.force import ForceLimits, ForceOptimizer
from grasp_env.grasp import Grasp, presets, wrench
from grasp_env.quality import (
    WrenchBall,
    epsilon,
    force_closure,
    quality,
    singular_values,
    worst_case,
)
from grasp_env.quality.worst_wrench import _solve

UNEVEN = closure_grasps(3)[1]
CUBOID = presets.paper_cuboid()


def scaled(grasp: Grasp) -> np.ndarray:
    """(6, 3N) G with moments divided by the grasp's length."""
    return grasp.matrix / np.repeat([1.0, grasp.length], 3)[:, None]


@pytest.mark.parametrize(("friction", "part"), [(0.5, 0.25), (1.5, 1.2)])
def test_two_opposed_soft_fingers(friction, part):
    """Least: torsion about the axis, or a sideways force at one finger: n = mu a, F_t = M_t = a,
    resisted by mu a."""
    soft = {"contact_model": "soft", "torsional_friction": 0.02 * part}
    pinch = Grasp.from_contacts(
        [[0, 0, -0.02], [0, 0, 0.02]], [[0, 0, 1], [0, 0, -1]], friction, **soft
    )
    found = epsilon(pinch, starts=8)
    exact = min(part, friction / np.sqrt(2.0 + friction**2))
    assert found.lower <= exact * (1 + 1e-9) <= found.upper * (1 + 1e-6)
    assert found.upper / found.lower < 1.01


def test_symmetric_tripod():
    # four directions carried by three contacts each, the moments about x and y by z forces times
    # cosines
    np.testing.assert_allclose(
        singular_values(presets.tripod()), np.sqrt([3, 3, 3, 3, 1.5, 1.5]), rtol=1e-12
    )
    found = quality(presets.tripod(), starts=4)
    again = epsilon(presets.tripod(), starts=4)
    assert (found.isotropy, found.min_singular_value) == pytest.approx((np.sqrt(0.5), np.sqrt(1.5)))
    assert found.closure_margin == force_closure(presets.tripod()).margin == pytest.approx(0.25)
    assert (found.epsilon_sum.lower, found.epsilon_sum.upper) == again[:2]
    # sum <= 1 implies max <= 1, max <= 1 implies sum <= N
    assert (
        found.epsilon_sum.lower
        <= found.epsilon_max.upper
        <= 3 * found.epsilon_sum.upper * (1 + 1e-9)
    )
    # the worst wrench turned by a third is as bad
    third = Rotation.from_euler("z", 120, degrees=True).as_matrix()
    turned = [third @ part for part in found.epsilon_sum.wrench.reshape(2, 3)]
    least = ForceOptimizer(presets.tripod(), method="conic").solve(np.concatenate(turned)).objective
    assert least == pytest.approx(1 / found.epsilon_sum.upper, rel=1e-5)


def frictionless(rng: np.random.Generator) -> Grasp:
    """Eight frictionless contacts with force closure, normals as of a rough surface: an ellipsoid's
    make hardly any moments."""
    while True:
        shape = random_grasp(rng, 8)
        normals = shape.normals + 0.6 * rng.standard_normal((8, 3))
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        grasp = Grasp.from_contacts(shape.positions, normals, 0.0, contact_model="frictionless")
        if force_closure(grasp).margin > 0.01:
            return grasp


def test_frictionless_grasps_have_exact_facets():
    grasp = frictionless(np.random.default_rng(0))
    columns = scaled(grasp)[:, ::3]
    # a zonotope for the largest force: five columns span each of its facets
    normals = np.array(
        [np.linalg.svd(columns[:, list(five)].T)[2][-1] for five in combinations(range(8), 5)]
    )
    zonotope = min(
        np.maximum(sign * normals @ columns, 0.0).sum(axis=1).min() for sign in (-1.0, 1.0)
    )
    hull = (-ConvexHull(columns.T).equations[:, 6]).min()
    for exact, criterion in ((hull, "sum"), (zonotope, "max")):
        found = epsilon(grasp, criterion=criterion, starts=4)
        assert found.lower <= exact * (1 + 1e-9)
        assert exact <= found.upper * (1 + 1e-5) <= found.lower * 1.01 * (1 + 1e-5)


@pytest.mark.parametrize("shape", ["ellipsoid", "product"])
def test_no_wrench_of_the_ball_is_worse(shape):
    ball = WrenchBall(2.0, 0.05, shape)
    worst = worst_case(UNEVEN, ball, starts=8)
    assert worst.lower <= worst.least_force <= worst.upper <= worst.lower * 1.01
    force, moment = (np.linalg.norm(part) for part in worst.wrench.reshape(2, 3))
    inside = (
        max(force / 2.0, moment / 0.05)
        if shape == "product"
        else np.hypot(force / 2.0, moment / 0.05)
    )
    assert inside == pytest.approx(1.0)
    optimizer = ForceOptimizer(UNEVEN, method="conic")
    assert optimizer.solve(worst.wrench).objective == pytest.approx(worst.least_force, rel=1e-6)
    drawn = wrench.sample_ball(np.random.default_rng(5), 500, 2.0, 0.05)
    parts = np.linalg.norm(drawn.reshape(-1, 2, 3), axis=2) / [2.0, 0.05]
    # onto the surface, where the worst ones are
    outward = parts.max(axis=1) if shape == "product" else np.hypot(*parts.T)
    costs = [optimizer.solve(load).objective for load in drawn / outward[:, None]]
    assert max(costs) <= worst.upper
    assert max(costs) >= 0.6 * worst.lower


@pytest.mark.parametrize("criterion", ["sum", "max"])
def test_without_force_closure(criterion):
    palm = Grasp.from_contacts(CUBOID.positions, [[0, 0, 1]] * 4, 0.4)
    assert epsilon(palm, criterion=criterion)[:2] == (0.0, 0.0)
    worst = worst_case(palm, WrenchBall(1.0, 0.05), criterion)
    assert worst.least_force == worst.lower == worst.upper == np.inf
    assert worst.solution.certificate @ worst.wrench > 0.0
    # the weight of the object alone lies on the palm
    assert worst_case(palm, [[0, 0, -1, 0, 0, 0]], criterion).least_force < np.inf


@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning", "ignore:invalid value:RuntimeWarning")
def test_limits():
    ball = WrenchBall(1.0, 0.05, "product")
    free = worst_case(CUBOID, ball, starts=8)
    loose, tight = (
        worst_case(CUBOID, ball, limits=ForceLimits(max_normal=most), starts=2)
        for most in (100.0, 2.0)
    )
    assert loose.lower == pytest.approx(free.lower, rel=1e-4)
    assert free.lower <= loose.upper <= 1.12 * loose.lower
    assert tight.least_force == tight.lower == np.inf


def worst_sampled(optimizer: ForceOptimizer, ball: WrenchBall) -> float:
    """The largest cost on the surface of an ellipsoid, by samples all over it and then ever closer
    around the worst one."""
    rng = np.random.default_rng(6)
    worst = np.zeros(6)
    cost = 0.0
    for spread in (1.0, 0.3, 0.1, 0.03, 0.01):
        drawn = worst + spread * rng.standard_normal((2000, 6))
        drawn /= np.linalg.norm(drawn, axis=1)[:, None]
        costs = optimizer.solve_many(drawn * ball.radii).objective
        if costs.max() > cost:
            worst = drawn[costs.argmax()]
            cost = costs.max()
    return cost


@pytest.mark.parametrize(
    "grasp", [CUBOID, presets.tripod(), UNEVEN], ids=["cuboid", "tripod", "uneven"]
)
@pytest.mark.parametrize("moment", [0.03, 0.02])
def test_the_bound_within_limits_holds_where_the_ascent_fails(grasp, moment, monkeypatch):
    """Without an ascent the lower bound is that of an axis; the upper bound comes from the
    polytope, and has to hold all the same."""
    monkeypatch.setattr(
        "grasp_env.quality.worst_wrench._ascend",
        lambda optimizer, ball, load: _solve(optimizer, load),
    )
    ball = WrenchBall(1.0, moment)
    limits = ForceLimits(max_normal=1e4)
    worst = worst_sampled(ForceOptimizer(grasp, method="conic", limits=limits), ball)
    found = worst_case(grasp, ball, limits=limits, starts=0)
    # 1e-4: the tolerance of the solves. Vertices on the ellipsoid itself would miss 0.4 to 3 %
    assert found.lower < 0.995 * worst
    assert worst * (1.0 - 1e-4) <= found.upper <= 1.13 * worst


@pytest.mark.parametrize("shape", ["ellipsoid", "product"])
def test_ball_reaches_and_its_polytope_encloses_it(shape):
    ball = WrenchBall(2.0, 0.05, shape)
    directions = np.random.default_rng(8).standard_normal((200, 6)) / ball.radii
    reach = ball.reach(directions)
    force, moment = np.linalg.norm((directions * ball.radii).reshape(-1, 2, 3), axis=2).T
    np.testing.assert_allclose(
        reach, force + moment if shape == "product" else np.hypot(force, moment)
    )
    np.testing.assert_allclose([n @ ball.farthest(n) for n in directions], reach)
    assert (ball.reach(1.0 / ball.radii * np.eye(6)) <= 1.0 + 1e-12).all()
    vertices = ball.enclosing() / ball.radii
    unit = WrenchBall(1.0, 1.0, shape)
    force, moment = np.linalg.norm(vertices.reshape(-1, 2, 3), axis=2).T
    beyond = np.maximum(force, moment) if shape == "product" else np.hypot(force, moment)
    assert beyond.max() <= (1.10 if shape == "product" else 1.12)  # the documented reach
    # descend from random directions to those in which the polytope reaches the least beyond the
    # ball, its tightest facets
    directions = np.random.default_rng(8).standard_normal((100, 6))
    rows = np.arange(100)
    ratio = np.ones(100)
    for k in range(60):
        directions /= np.linalg.norm(directions, axis=1)[:, None]
        products = directions @ vertices.T
        reach = unit.reach(directions)
        top = products.argmax(axis=1)
        ratio = products[rows, top] / reach
        assert ratio.min() >= 1.0 - 1e-12  # rounding
        farthest = np.array([unit.farthest(n) for n in directions])
        directions -= 0.3 * 0.93**k * (vertices[top] - ratio[:, None] * farthest) / reach[:, None]
    assert ratio.min() < 1.001  # the descent found a facet that touches the ball


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (partial(WrenchBall, 1.0, 1.0, "cube"), "unknown shape"),
        (partial(WrenchBall, -1.0, 1.0), "force must"),
        (partial(epsilon, UNEVEN, criterion="mean"), "unknown criterion"),
        (partial(epsilon, UNEVEN, length=0.0), "length must"),
        (partial(worst_case, UNEVEN, [1.0, 0, 0, 0, 0, 0]), "wrenches must have shape"),
        (partial(worst_case, UNEVEN, np.zeros((0, 6))), "wrenches must hold at least one"),
        (partial(quality, "grasp"), "a Grasp is needed"),
    ],
)
def test_wrong_input(call, message):
    with pytest.raises(GraspError, match=message):
        call()

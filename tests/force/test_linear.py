"""The linear program against enumeration of all vertices, and against the facets' form of the same pyramids."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from problems import CONIC_LEAST, GRASPS, PAPER_WRENCH, closure_grasps, random_grasp
from scipy.optimize import linprog

from grasp_env.errors import InvalidInputError, NotConvergedError
from grasp_env.force import Status, optimize_force
from grasp_env.force.limits import ForceLimits
from grasp_env.force.linear import linear_forces, pyramid_edges
from grasp_env.force.torques import joint_torques
from grasp_env.grasp import Grasp, presets
from grasp_env.grasp.wrench import sample_ball, sample_magnitudes


def by_enumeration(grasp: Grasp, wrench: np.ndarray, facets: int) -> float:
    """Least sum of normals over all bases of six edges: an optimum of a linear program is at one of them."""
    angles = 2.0 * np.pi * np.arange(facets) / facets
    columns = np.concatenate(
        [
            grasp.matrix[:, 3 * k : 3 * k + 3] @ np.stack([np.ones(facets), mu * np.cos(angles), mu * np.sin(angles)])
            for k, mu in enumerate(grasp.friction)
        ],
        axis=1,
    )
    columns[3:] /= 0.05
    right = -wrench / [1, 1, 1, 0.05, 0.05, 0.05]
    bases = np.array(list(combinations(range(columns.shape[1]), 6)))
    matrices = columns[:, bases].transpose(1, 0, 2)
    regular = np.abs(np.linalg.det(matrices)) > 1e-9
    weights = np.linalg.solve(matrices[regular], np.broadcast_to(right[:, None], (int(regular.sum()), 6, 1)))[..., 0]
    feasible = (weights >= -1e-9).all(axis=1)
    return float(weights[feasible].sum(axis=1).min(initial=np.inf))


def by_facets(grasp: Grasp, wrench: np.ndarray, facets: int, limits: ForceLimits | None = None) -> float:
    """The same problem in the forces themselves, the pyramids and gamma as rows; inf when infeasible."""
    count = grasp.n_contacts
    rows, bound = [], []
    normals = 2.0 * np.pi * (np.arange(facets) + 0.5) / facets
    free: list[tuple[float | None, float | None]] = []
    for k in range(count):
        mu, gamma = grasp.models.friction[k], grasp.models.torsional_friction[k]
        free += [(0.0, None), *[(None, None) if mu.any() else (0.0, 0.0)] * 2, (None, None) if gamma else (0.0, 0.0)]
        for angle in normals if mu.any() else []:
            row = np.zeros(4 * count)
            row[4 * k : 4 * k + 3] = -np.cos(np.pi / facets), np.cos(angle) / mu[0], np.sin(angle) / mu[1]
            rows.append(row)
        for sign in (1.0, -1.0):
            row = np.zeros(4 * count)
            row[4 * k], row[4 * k + 3] = -gamma, sign
            rows.append(row)
    bound = [0.0] * len(rows)
    if limits is not None:
        matrix, least, _ = limits.rows(grasp)
        rows, bound = [*rows, *matrix], [*bound, *least]
    balance = np.zeros((6, 4 * count))
    for axis in range(3):
        balance[:, axis::4] = grasp.matrix[:, axis::3]
    balance[:, 3::4] = grasp.torsion_matrix
    scale = np.array([1, 1, 1, 0.05, 0.05, 0.05])
    answer = linprog(
        np.tile([1.0, 0, 0, 0], count), A_ub=np.array(rows), b_ub=bound, A_eq=balance / scale[:, None],
        b_eq=-wrench / scale, bounds=free, method="highs",
    )  # fmt: skip
    return float(answer.fun) if answer.status == 0 else np.inf


def every_model(rng: np.random.Generator, cap: float = -1.0) -> Grasp:
    plain = random_grasp(rng, 6, cap)
    return Grasp.from_contacts(
        plain.positions, plain.normals, rng.uniform(0.3, 1.0, (6, 2)), torsional_friction=0.008,
        contact_model=["soft", "hard", "soft", "frictionless", "hard", "soft"], tangents=rng.standard_normal((6, 3)),
    )  # fmt: skip


def inside(grasp: Grasp, answer, wrench: np.ndarray) -> None:
    """Balanced, in the true cones and torsional limits, to rounding."""
    size = max(float(np.abs(wrench).max()), answer.objective)
    assert grasp.residual(answer.force, wrench, answer.torsion) < 1e-9 * size
    assert grasp.cone_margin(answer.force) > -1e-12 * size
    normal = answer.force[:, 0]
    assert (np.abs(answer.torsion) <= grasp.models.torsional_friction * normal * (1 + 1e-12) + 1e-15 * size).all()
    assert answer.objective == pytest.approx(float(normal.sum()), rel=1e-14)
    frictionless = np.array([name == "frictionless" for name in grasp.models.names])
    assert (answer.force[frictionless, 1:] == 0.0).all()


@pytest.mark.parametrize(("name", "facets"), [("tripod", 8), ("tripod, uneven", 5), ("cuboid, 4", 4), ("cuboid, 4", 5)])
def test_no_vertex_is_better(name: str, facets: int) -> None:
    grasp = GRASPS[name]
    for wrench in sample_ball(np.random.default_rng(0), 3):
        answer = linear_forces(grasp, wrench, facets=facets)
        assert answer.objective == pytest.approx(by_enumeration(grasp, wrench, facets), rel=1e-8)
        inside(grasp, answer, wrench)


def test_every_contact_model_against_the_facets_form() -> None:
    rng = np.random.default_rng(1)
    outcomes = set()
    for k in range(40):
        grasp = every_model(rng, cap=-1.0 if k % 2 else 0.3)  # half of them hold only one side of the object
        wrench = sample_magnitudes(rng, 1)[0]
        facets = 3 + k % 6
        answer, expected = linear_forces(grasp, wrench, facets=facets), by_facets(grasp, wrench, facets)
        outcomes.add(answer.status)
        assert answer.objective == pytest.approx(expected, rel=1e-6)
        if answer.status is Status.OPTIMAL:
            inside(grasp, answer, wrench)
            assert (answer.torsion[[1, 3, 4]] == 0.0).all()
    assert outcomes == {Status.OPTIMAL, Status.INFEASIBLE}


def test_two_soft_fingers_carry_by_torsion() -> None:
    pinch = Grasp.from_contacts(
        [[0, 0, -0.02], [0, 0, 0.02]], [[0, 0, 1], [0, 0, -1]], 0.5, contact_model="soft", torsional_friction=0.005
    )
    answer = linear_forces(pinch, [0, 0, 0, 0, 0, 0.02])
    # |torsion| <= 0.005 normal at both: 2 N each, and nothing else is needed
    assert answer.objective == pytest.approx(4.0, rel=1e-12)
    np.testing.assert_allclose(answer.torsion, [-0.01, 0.01], atol=1e-12)


def test_limits_against_the_facets_form() -> None:
    rng = np.random.default_rng(2)
    outcomes: list[bool] = []
    for _ in range(60):
        grasp = every_model(rng)
        wrench = sample_ball(rng, 1)[0]
        jac, bias = 0.05 * rng.standard_normal((6, 4, 5)), 0.05 * rng.standard_normal(5)
        limits = ForceLimits(rng.uniform(0, 0.5, 6), rng.uniform(2, 6, 6), jac, rng.uniform(0.1, 0.5, 5), bias)
        free, answer = linear_forces(grasp, wrench), linear_forces(grasp, wrench, limits=limits)
        assert answer.objective == pytest.approx(by_facets(grasp, wrench, 8, limits), rel=1e-6)
        assert answer.objective >= free.objective * (1 - 1e-9)
        outcomes.append(answer.status is Status.OPTIMAL)
        if answer.status is Status.OPTIMAL:
            inside(grasp, answer, wrench)
            assert limits.violations(grasp, answer.force, answer.torsion, 1e-8) == []
            tau = joint_torques(jac, answer.force, bias, torsion=answer.torsion)
            assert (np.abs(tau) <= limits.checked(6).torque_limit + 1e-8).all()
    assert 10 < sum(outcomes) < 50


def test_least_normal_force_without_a_wrench() -> None:
    grasp, limits = presets.tripod(), ForceLimits(min_normal=[1.0, 0.5, 0.5])
    answer = linear_forces(grasp, np.zeros(6), limits=limits)
    inside(grasp, answer, np.zeros(6))
    assert limits.slack(answer.force).min_normal > -1e-9
    assert answer.objective == pytest.approx(by_facets(grasp, np.zeros(6), 8, limits), rel=1e-9)
    assert answer.objective > 2.0  # the limits alone; balance asks for more
    assert linear_forces(presets.tripod(), np.zeros(6)).objective == 0.0


def test_a_joint_that_no_force_reaches() -> None:
    grasp = presets.paper_cuboid()
    jac = np.zeros((4, 3, 2))
    jac[0, 0, 0] = 0.01
    free = linear_forces(grasp, PAPER_WRENCH)
    idle = linear_forces(
        grasp, PAPER_WRENCH, limits=ForceLimits(jacobian=jac, torque_limit=1.0, torque_bias=[0.0, 0.5])
    )
    assert idle.objective == pytest.approx(free.objective, rel=1e-12)
    # its bias alone is more than it can bear
    over = linear_forces(
        grasp, PAPER_WRENCH, limits=ForceLimits(jacobian=jac, torque_limit=1.0, torque_bias=[0.0, 1.5])
    )
    assert over.status is Status.INFEASIBLE


def test_multipliers_are_the_price_of_the_wrench() -> None:
    rng = np.random.default_rng(3)
    for grasp in (GRASPS["cuboid, 4"], GRASPS["tripod, uneven"], every_model(rng)):
        wrench = sample_ball(rng, 1)[0]
        answer = linear_forces(grasp, wrench)
        assert answer.multipliers is not None
        assert -answer.multipliers @ wrench == pytest.approx(answer.objective, rel=1e-9)  # strong duality
        change = 1e-5 * rng.standard_normal(6) * [1, 1, 1, 0.05, 0.05, 0.05]
        more, less = (linear_forces(grasp, wrench + s * change).objective for s in (1.0, -1.0))
        assert more - less == pytest.approx(-2.0 * answer.multipliers @ change, rel=1e-5)
        # dual feasible: no edge brings more than its normal force costs
        edges = pyramid_edges(grasp, 8)
        pull = np.concatenate([grasp.matrix.T @ answer.multipliers, grasp.torsion_matrix.T @ answer.multipliers])
        stacked = np.column_stack([pull[: 3 * grasp.n_contacts].reshape(-1, 3), pull[3 * grasp.n_contacts :]])
        assert (stacked.reshape(-1) @ edges <= edges[0::4].sum(axis=0) + 1e-8).all()


def test_pyramids_cost_more_than_cones() -> None:
    """And so their dual bound is none for the cones."""
    grasp = presets.paper_cuboid()
    costs = [linear_forces(grasp, PAPER_WRENCH, facets=facets) for facets in (4, 8, 16, 32, 256)]
    objectives = [cost.objective for cost in costs]
    assert objectives == sorted(objectives, reverse=True)
    assert objectives[-1] == pytest.approx(CONIC_LEAST, rel=1e-4)
    assert costs[1].multipliers is not None
    assert -costs[1].multipliers @ PAPER_WRENCH > 1.02 * CONIC_LEAST


def test_excess_of_eight_facets() -> None:
    rng = np.random.default_rng(4)
    excess = [
        linear_forces(grasp, wrench).objective / linear_forces(grasp, wrench, facets=64).objective - 1.0
        for name, grasp in GRASPS.items()
        if "uneven" not in name
        for wrench in sample_ball(rng, 20)
    ]
    assert min(excess) > -1e-9  # the edges of 8 facets are among those of 64
    assert 0.02 < np.median(excess) < 0.04
    assert max(excess) < 1.0 / np.cos(np.pi / 8.0) - 1.0  # 8.2 %


def test_least_normal_force_is_below_every_optimum_of_phi() -> None:
    for grasp in closure_grasps()[:8]:
        wrench = sample_ball(np.random.default_rng(5), 1)[0]
        phi = optimize_force(grasp, wrench, method="newton")
        assert linear_forces(grasp, wrench, facets=64).objective <= phi.total_normal_force * 1.0013  # 1 / cos(pi / 64)


def test_forces_jump_where_phi_moves_smoothly() -> None:
    """Four fingers around an object carry its weight by friction: which pair does costs the same."""
    positions = 0.04 * np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    weight = np.array([0, 0, -1.0, 0, 0, 0])
    one, other = (
        Grasp.from_contacts(positions, -positions / 0.04, 0.5 + 1e-6 * np.array([s, s, -s, -s])) for s in (1.0, -1.0)
    )
    jump = np.abs(linear_forces(one, weight).force - linear_forces(other, weight).force).max()
    move = np.abs(
        optimize_force(one, weight, method="newton", tolerance=1e-10).force
        - optimize_force(other, weight, method="newton", tolerance=1e-10).force
    ).max()
    assert jump > 0.9
    assert move < 1e-3


def test_wrenches_of_all_magnitudes() -> None:
    rng = np.random.default_rng(6)
    for wrench in sample_magnitudes(rng, 30, 1e-8, 1e8):
        grasp = presets.five_finger_cuboid()
        answer = linear_forces(grasp, wrench)
        inside(grasp, answer, wrench)
        unit = linear_forces(grasp, wrench / np.abs(wrench).max())
        assert answer.objective == pytest.approx(unit.objective * np.abs(wrench).max(), rel=1e-9)


def test_infeasible_is_a_status_and_other_failures_are_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    grasp = presets.tripod()
    answer = linear_forces(grasp, PAPER_WRENCH, limits=ForceLimits(max_normal=0.01))
    assert answer.status is Status.INFEASIBLE
    assert answer.objective == np.inf
    assert answer.multipliers is None
    assert not answer.force.any()
    assert not answer.torsion.any()

    def stuck(*_: object, **__: object) -> object:
        return type("Answer", (), {"status": 1, "message": "Iteration limit reached"})

    monkeypatch.setattr("grasp_env.force.linear.linprog", stuck)
    with pytest.raises(NotConvergedError, match=r"neither an optimum nor a proof .*Iteration limit reached"):
        linear_forces(grasp, PAPER_WRENCH)


@pytest.mark.parametrize("facets", [2, 8.0, True, "8", -1])
def test_wrong_facets(facets: object) -> None:
    with pytest.raises(InvalidInputError, match="facets must be an integer >= 3"):
        linear_forces(presets.tripod(), PAPER_WRENCH, facets=facets)  # type: ignore[arg-type]


def test_wrong_wrench_and_limits() -> None:
    with pytest.raises(InvalidInputError, match=r"wrench must have shape \(6,\)"):
        linear_forces(presets.tripod(), np.zeros(5))
    with pytest.raises(InvalidInputError, match="max_normal has 4 entries, the grasp 3 contacts"):
        linear_forces(presets.tripod(), PAPER_WRENCH, limits=ForceLimits(max_normal=[1, 1, 1, 1]))

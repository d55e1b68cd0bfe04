"""The paper's flows: full and reduced are one (Eqs. 9-26), both are methods, and every step rule takes the steps that it says."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from math import floor
from typing import Any

import numpy as np
import pytest
from force.named import NAMED
from oracles import full_flow
from oracles.descent import followed
from oracles.reduced_flow import (
    flow_vector,
    landscape,
    picked_columns,
    picked_projector,
    picked_rows,
    reduced_projector,
)
from problems import GRASPS, LIGHT, PAPER_WRENCH, STEP_RULES, closure_grasps
from scipy.optimize import minimize_scalar

from grasp_env.errors import InvalidInputError, UnknownNameError, UnsupportedProblemError
from grasp_env.force import (
    AdaptiveStep,
    ArmijoStep,
    BarzilaiBorweinStep,
    ExactStep,
    FixedStep,
    ForceOptimizer,
    LinearCombination,
    Objective,
    OfflineBasis,
    Status,
)
from grasp_env.force.step_size import StepRule, checked_rule
from grasp_env.grasp import Grasp
from grasp_env.grasp import wrench as wrenches

OBJECTIVE = Objective(1.0, 0.1)
CUBOID = GRASPS["cuboid, 4"]
FLOWS = ("reduced_flow", "full_flow")


def _weights(grasp: Grasp) -> np.ndarray:
    return OBJECTIVE.weights(grasp.n_contacts)


def _start(grasp: Grasp, squeeze: float = 5.0) -> np.ndarray:
    """A start far from the optimum, for many steps: with an internal force added, in units of the rest force."""
    force = LinearCombination(OBJECTIVE)(grasp, LIGHT) + squeeze * OfflineBasis.of(grasp, OBJECTIVE).rest
    return grasp.to_cone(force)


ALL = {**GRASPS, **{name: NAMED[name].grasp for name in ("elliptic", "rough and frictionless")}}


@pytest.mark.parametrize("name", GRASPS)
def test_full_and_reduced_iterates_are_equal(name: str) -> None:
    """By the dense projector, by the entries picked from it, and by the closed form; balance and the structure of P stay."""
    grasp = GRASPS[name]
    # moments in units of the grasp: the projector does not depend on them, its rounding does
    land, start = landscape(grasp.unit_frame @ grasp.cone_matrix, _weights(grasp)), _start(grasp)
    descent, iterates = followed(start, land, AdaptiveStep(0.004, grow=1.01), 240)  # small: not at the optimum before
    assert descent.iterations == 240
    assert descent.values[-1] < 0.9 * descent.values[0]
    q, q_bar = full_flow.projector(grasp.cone_matrix), picked_projector(grasp.cone_matrix)
    whole, reduced = full_flow.start(start), start.reshape(-1)
    for alpha, expected in zip(descent.steps, iterates[1:], strict=True):
        whole = whole + alpha * q @ full_flow.drive(whole, _weights(grasp))
        reduced = reduced + alpha * q_bar @ flow_vector(reduced, _weights(grasp))
        # the picked and the closed-form Q_bar: rounding of Q, contracted by the flow
        for other in (full_flow.cone_coordinates(whole), expected):
            assert np.abs(other - reduced).max() < 1e-10 * np.abs(reduced).max()
    kept = full_flow.constraints(grasp.cone_matrix) @ whole
    assert np.abs(kept - np.append(np.zeros(6 * grasp.n_contacts), -LIGHT)).max() < 1e-11


@pytest.mark.parametrize("method", FLOWS)
@pytest.mark.parametrize("name", ALL)
def test_methods_take_the_steps_of_the_plain_flow(name: str, method: str) -> None:
    grasp = ALL[name]
    rule, count = AdaptiveStep(), 12  # growing and rejected steps; few enough that no decision hangs on rounding
    # moments in units of the grasp: the projector does not depend on them, its rounding does
    land = landscape(grasp.unit_frame @ grasp.cone_matrix, _weights(grasp))
    descent, iterates = followed(_start(grasp), land, rule, count)
    options = {"barrier_weight": 0.1, "step_rule": rule, "max_iterations": count, "tolerance": 1e-300}
    optimizer = ForceOptimizer(grasp, method=method, **options)
    solution = optimizer.solve(LIGHT, initial=grasp.to_force(_start(grasp)), trace=True)
    assert (solution.method, solution.initial, solution.status) == (method, "given", Status.ITERATION_LIMIT)
    assert (solution.iterations, solution.trials) == (count, descent.trials)
    assert descent.trials > count
    np.testing.assert_allclose(solution.objective_trace, descent.values, rtol=1e-10)
    last = grasp.to_cone(solution.force).reshape(-1)
    np.testing.assert_allclose(last, iterates[-1], rtol=0, atol=1e-10 * np.abs(iterates[-1]).max())
    np.testing.assert_array_equal(solution.force[grasp.friction == 0.0, 1:], 0.0)


def test_the_full_flow_is_dense() -> None:
    angles = np.arange(9) * 2.0 * np.pi / 9
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(9)], axis=1)
    with pytest.raises(UnsupportedProblemError, match="the full flow is dense: at most 8 contacts"):
        ForceOptimizer(Grasp.from_contacts(0.05 * ring, -ring, 0.5), method="full_flow")


@pytest.mark.parametrize("grasp", [*GRASPS.values(), *closure_grasps(10)], ids=lambda g: f"{g.n_contacts}")
def test_picked_projector_is_the_closed_form(grasp: Grasp) -> None:
    rows = grasp.unit_frame @ grasp.cone_matrix
    picked, closed = picked_projector(rows), reduced_projector(rows)
    assert picked.shape == (3 * grasp.n_contacts, 9 * grasp.n_contacts)
    # entries are below one; A A^T of random grasps has condition numbers up to 1e4, so a few 1e-12 are rounding
    np.testing.assert_allclose(picked, closed, rtol=0, atol=1e-12 if grasp in GRASPS.values() else 1e-11)
    # it moves along balance only, and is P-orthogonal: a projector once its input is lifted to P
    np.testing.assert_allclose(grasp.cone_matrix @ closed, 0.0, atol=1e-13 * np.abs(grasp.cone_matrix).max())


def test_printed_indices_for_four_fingers() -> None:
    """Eqs. 19 to 21 word for word; floor(a, b) there is the largest integer not greater than a / b."""
    m = [39 * floor((i - 1) / 3) + 2 ** (2 ** (i - 3 * floor((i - 1) / 3) - 1)) - 1 for i in range(1, 13)]
    n = [39 * floor((j - 1) / 3) + 12 * (j - 3 * floor((j - 1) / 3) - 1) + 1 for j in range(1, 13)]
    assert (picked_rows(4) + 1).tolist() == m
    assert (picked_columns(4) + 1).tolist() == [start + k for start in n for k in range(3)]
    q = full_flow.projector(GRASPS["cuboid, 4"].cone_matrix)
    assert q.shape == (144, 144)
    printed = np.array([[q[row - 1, start - 1 + k] for start in n for k in range(3)] for row in m])
    np.testing.assert_array_equal(printed, picked_projector(GRASPS["cuboid, 4"].cone_matrix))


@pytest.mark.parametrize("name", GRASPS)
def test_dense_projector_projects_on_the_constraints(name: str) -> None:
    grasp = GRASPS[name]
    a, q = full_flow.constraints(grasp.cone_matrix), full_flow.projector(grasp.cone_matrix)
    count = grasp.n_contacts
    assert (a.shape, np.linalg.matrix_rank(a)) == ((6 * count + 6, 9 * count**2), 6 * count + 6)
    np.testing.assert_allclose(q @ q, q, atol=1e-12)
    np.testing.assert_allclose(q, q.T, atol=1e-12)
    np.testing.assert_allclose(a @ q, 0.0, atol=1e-12)
    # A vec(P) = (0, G f): balance reads the right entries
    force = np.random.default_rng(0).standard_normal((count, 3))
    wrench = a @ full_flow.start(grasp.to_cone(force))
    np.testing.assert_allclose(wrench, np.append(np.zeros(6 * count), grasp.wrench(force)), atol=1e-13)


def test_flow_is_the_negative_gradient_in_the_metric_of_p() -> None:
    """Q_bar VWP = -(projected gradient): the directional derivative of Phi along it is minus its squared length."""
    for grasp in closure_grasps(10):
        x = _start(grasp)
        direction = reduced_projector(grasp.cone_matrix) @ flow_vector(x, _weights(grasp))
        length = float(direction**2 @ np.tile([3.0, 2.0, 2.0], grasp.n_contacts))
        slope = float(OBJECTIVE.gradient(x) @ direction)
        assert slope == pytest.approx(-length, rel=1e-9, abs=1e-13)


def test_paper_wrench_first_step_by_hand() -> None:
    """One step of Eq. 26 with explicit inverses and a pseudoinverse in place of Q: nothing of the package but G."""
    grasp = GRASPS["cuboid, 4"]
    force = LinearCombination(OBJECTIVE)(grasp, PAPER_WRENCH)
    x, alpha = grasp.to_cone(force), 1e-3
    p = np.zeros((12, 12))
    for k, (u, o, t) in enumerate(x.reshape(-1, 3)):
        p[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = [[u, 0, o], [0, u, t], [o, t, u]]
    inverse = np.linalg.inv(p)
    drive = (0.1 * inverse @ inverse - np.eye(12)).reshape(-1, order="F")
    a = full_flow.constraints(grasp.cone_matrix)
    step = drive - np.linalg.pinv(a) @ (a @ drive)
    after = (p.reshape(-1, order="F") + alpha * step).reshape(12, 12, order="F")
    mine = x + alpha * reduced_projector(grasp.cone_matrix) @ flow_vector(x, _weights(grasp))
    np.testing.assert_allclose(mine[0::3], np.diag(after)[0::3], rtol=1e-12)
    np.testing.assert_allclose(mine[1::3], after[np.arange(2, 12, 3), np.arange(0, 12, 3)], atol=1e-12)
    np.testing.assert_allclose(mine[2::3], after[np.arange(2, 12, 3), np.arange(1, 12, 3)], atol=1e-12)


# step rules


WILD: dict[str, StepRule] = {
    "constant": AdaptiveStep(1e-3, grow=1.0), "wild": AdaptiveStep(0.3, grow=10.0, shrink=0.9),
    "fixed, huge": FixedStep(1e12), "fixed, tiny": FixedStep(1e-15),
    "armijo, huge": ArmijoStep(1e12, shrink=0.999, slope=0.9), "armijo, strict": ArmijoStep(1.0, slope=1.0 - 1e-16),
    "adaptive, wild": AdaptiveStep(1e12, grow=999_999.0, shrink=0.999), "adaptive, tiny": AdaptiveStep(1e-15),
    "short, huge": BarzilaiBorweinStep(1e12), "long, tiny": BarzilaiBorweinStep(1e-12, shrink=0.01, variant="long"),
    "exact, fine": ExactStep(1e-15), "exact, coarse": ExactStep(0.999),
}  # fmt: skip


@pytest.mark.parametrize("rule", [*STEP_RULES.values(), *WILD.values()], ids=[*STEP_RULES, *WILD])
def test_every_iterate_is_inside_balanced_and_better(rule: StepRule) -> None:
    rng = np.random.default_rng(3)
    options = {"step_rule": rule, "barrier_weight": 0.1, "tolerance": 1e-12, "max_iterations": 80}
    for k, grasp in enumerate(closure_grasps(10)):
        optimizer = ForceOptimizer(grasp, method="full_flow" if k == 0 else "reduced_flow", **options)
        for wrench in (*wrenches.sample_ball(rng, 2), *wrenches.sample_magnitudes(rng, 2, 1e-3, 1e3)):
            solution = optimizer.solve(wrench, trace=True)
            trace, steps = solution.objective_trace, solution.iterations
            assert solution.status in (Status.OPTIMAL, Status.ITERATION_LIMIT, Status.STALLED)
            assert np.isfinite([*solution.force.flat, *trace]).all()
            assert (len(trace), trace[-1]) == (steps + 1, solution.objective)
            assert (np.diff(trace) < 0.0).all()
            assert OBJECTIVE.value(grasp.to_cone(solution.force)) == pytest.approx(solution.objective, rel=1e-9)
            assert steps <= solution.trials <= (81 * 2500 if rule != WILD["constant"] else steps)
            assert solution.lower_bound <= solution.objective * (1.0 + 1e-10)
            assert grasp.cone_margin(solution.force) > 0.0
            size = np.abs(solution.initial_force).max() + np.abs(grasp.unit_frame @ wrench).max()
            assert grasp.residual(solution.force, wrench) <= 1e-12 * size


LAND = landscape(CUBOID.cone_matrix, _weights(CUBOID))


def _first_steps(rule: StepRule, count: int) -> Iterator[tuple[np.ndarray, np.ndarray, float]]:
    """Iterates, their directions and steps."""
    result, iterates = followed(_start(CUBOID, 2.0), LAND, rule, count)
    return ((x, LAND.direction(x), alpha) for x, alpha in zip(iterates, result.steps, strict=False))


def test_exact_step_is_the_minimum_along_the_ray() -> None:
    for x, move, alpha in _first_steps(ExactStep(1e-9), 6):
        along = lambda a, x=x, move=move: min(LAND.value(x + a * move), 1e6)  # noqa: E731
        best = minimize_scalar(along, bounds=(0.0, 10.0 * alpha), method="bounded", options={"xatol": 1e-12})
        assert LAND.value(x + alpha * move) <= best.fun * (1.0 + 1e-12)


def test_armijo_steps_decrease_sufficiently_and_are_the_first_to() -> None:
    for x, move, alpha in _first_steps(ArmijoStep(first=0.5, shrink=0.5, slope=0.3), 10):
        most = LAND.value(x) - 0.3 * np.array([alpha, 2.0 * alpha]) * float(LAND.metric @ move**2)
        assert LAND.value(x + alpha * move) <= most[0]
        assert alpha == 0.5 or not LAND.value(x + 2.0 * alpha * move) <= most[1]


def test_barzilai_borwein_steps_are_inverse_curvatures() -> None:
    for variant in ("long", "short", "alternate"):
        steps = list(_first_steps(BarzilaiBorweinStep(1e-3, variant=variant), 10))
        for k, ((before, drive, _), (x, move, alpha)) in enumerate(pairwise(steps), 1):
            s, y = x - before, drive - move
            long, short = LAND.metric @ s**2 / (LAND.metric @ (s * y)), LAND.metric @ (s * y) / (LAND.metric @ y**2)
            expected = {"long": long, "short": short, "alternate": short if k % 2 else long}[variant]
            assert short <= long
            # halved until Phi decreases
            halvings = float(np.log2(expected / alpha))
            assert halvings == pytest.approx(round(halvings), abs=1e-6)
            assert halvings > -1e-6


@pytest.mark.parametrize(
    ("rule", "given", "message"),
    [
        (FixedStep, {"size": 0.0}, "size must be finite and > 0, got 0.0"),
        (FixedStep, {"size": "big"}, "size must be a number > 0, got 'big'"),
        (ArmijoStep, {"first": np.nan}, "first must be finite and > 0, got nan"),
        (ArmijoStep, {"shrink": 1.0}, r"shrink must lie in \(0, 1\), got 1.0"),
        (ArmijoStep, {"shrink": 1.0 - 1e-12}, "shrink must lie within 0.001 to 0.999, got 0.999999999999"),
        (AdaptiveStep, {"shrink": 1e-9}, "shrink must lie within 0.001 to 0.999, got 1e-09"),
        (AdaptiveStep, {"grow": np.nan}, "grow must be a finite factor >= 1, got nan"),
        (AdaptiveStep, {"grow": 0.5}, "grow must be a finite factor >= 1, got 0.5"),
        (ArmijoStep, {"slope": 0.0}, r"slope must lie in \(0, 1\), got 0.0"),
        (AdaptiveStep, {"shrink": "half"}, r"shrink must lie in \(0, 1\), got 'half'"),
        (BarzilaiBorweinStep, {"first": -1.0}, "first must be finite and > 0, got -1.0"),
        (BarzilaiBorweinStep, {"shrink": 2.0}, r"shrink must lie in \(0, 1\), got 2.0"),
        (BarzilaiBorweinStep, {"variant": "medium"}, "'medium': choose one of 'alternate', 'long', 'short'"),
        (ExactStep, {"precision": 1.0}, r"precision must lie in \(0, 1\), got 1.0"),
        (checked_rule, {"rule": "exact"}, r"a FixedStep, ArmijoStep, .* or ExactStep, got 'exact'"),
    ],
)
def test_wrong_arguments_say_what_is_allowed(rule: Any, given: dict[str, Any], message: str) -> None:
    with pytest.raises(UnknownNameError if "variant" in given else InvalidInputError, match=message):
        rule(**given)


def test_no_rule_is_the_adaptive_one() -> None:
    assert checked_rule(None) == AdaptiveStep()
    assert checked_rule(ExactStep()) == ExactStep()


@pytest.mark.parametrize("method", ["newton", "conic"])
def test_a_step_rule_belongs_to_a_flow(method: str) -> None:
    with pytest.raises(UnsupportedProblemError, match=f"step_rule belongs to the flows, got method '{method}'"):
        ForceOptimizer(GRASPS["cuboid, 4"], method=method, step_rule=FixedStep(0.1))

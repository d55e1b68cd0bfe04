"""The flows in every layout and form: the plain flow's iterates, every step rule, and what a record promises."""

from __future__ import annotations

from itertools import product

import _core_test as insides
import numpy as np
import pytest
from oracles import full_flow, reduced_flow
from oracles.descent import Descent, descend, followed, never
from oracles.phi import lower_bound, phi
from problems import STEP_RULES
from samples import Sample, layouts, sample, wrenches
from test_newton import CODE, ITERATIONS, OBJECTIVE, RESIDUAL, TRIALS, check
from test_pipeline import path, pipeline

from grasp_env.force.record import FORCE
from grasp_env.force.step_size import AdaptiveStep, BarzilaiBorweinStep, FixedStep, StepRule

CONVERGED, LIMIT, STALLED, INFEASIBLE, REFUSED = range(5)
FULL, PAPER, REDUCED = FORMS = range(3)
NONE = float("nan")
RULES = STEP_RULES | {"fixed": FixedStep(0.003)}


def flow(
    s: Sample,
    layout: tuple[int, int],
    rule: StepRule | np.ndarray | None = None,
    form: int = REDUCED,
    tolerance: float = 1e-4,
    limit: int = 20_000,
):
    numbers = rule if isinstance(rule, np.ndarray) else (rule or AdaptiveStep()).parameters()
    return insides.AnyNewton.flow(*layout, s.placement, tolerance, limit, form, numbers)


def starts(s: Sample, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(wrench, force (3N,), its cone coordinates): the optimum and as much squeeze again, many steps away from it."""
    wrench = wrenches(np.random.default_rng([s.count, seed]), 1)[0]
    x = s.minimum(wrench)[0] + 2.0 * s.rest
    x = x - s.inverse @ (s.rows @ x + s.unit @ wrench)
    return wrench, x / np.where(s.scale > 0.0, s.scale, 1.0).reshape(-1), x


def coordinates(s: Sample, row: np.ndarray) -> np.ndarray:
    return (row[FORCE : FORCE + 3 * s.count].reshape(-1, 3) * s.scale).reshape(-1)


def plain(s: Sample, x: np.ndarray, rule: StepRule, count: int) -> tuple[Descent, list[np.ndarray]]:
    """The oracle's reduced flow, and all its iterates."""
    return followed(x, reduced_flow.landscape(s.rows, s.weights), rule, count)


@pytest.mark.parametrize(
    ("count", "kind", "form"),
    [
        *product((3, 4, 5, 6), ("hard",), FORMS),
        *product((4, 7), ("frictionless",), FORMS),
        *product((8, 11), ("hard",), (PAPER, REDUCED)),
    ],
)
def test_every_layout_and_form_gives_the_iterates_of_the_plain_flow(count: int, kind: str, form: int) -> None:
    s = sample(count, kind)
    wrench, force, x = starts(s)
    rule, many = AdaptiveStep(), 20  # growing and rejected steps; few enough that no decision hangs on rounding
    descent, iterates = plain(s, x, rule, many)
    for layout in layouts(count):
        for k in (0, 1, 2, many):
            row, trace = flow(s, layout, rule, form, 1e-300, k).descend(wrench, force, NONE, many + 1)
            assert (row[CODE], row[ITERATIONS]) == (LIMIT, k)
            np.testing.assert_allclose(coordinates(s, row), iterates[k], rtol=0, atol=1e-9 * np.abs(iterates[k]).max())
            np.testing.assert_allclose(trace[: k + 1], descent.values[: k + 1], rtol=1e-9)
            assert (trace[k + 1 :] == -1.0).all()
            assert row[OBJECTIVE] == trace[k]
        assert row[TRIALS] == descent.trials > many


@pytest.mark.parametrize("rule", RULES.values(), ids=RULES)
@pytest.mark.parametrize("count", [4, 9])
def test_steps_are_the_plain_ones(count: int, rule: StepRule) -> None:
    s = sample(count)
    wrench, force, x = starts(s)
    many = 12
    descent, iterates = plain(s, x, rule, many)
    for layout in layouts(count):
        for k in (1, 2, 5, many):
            row, _ = flow(s, layout, rule, REDUCED, 1e-300, k).descend(wrench, force, NONE, 0)
            assert (row[CODE], row[ITERATIONS]) == (LIMIT, k)
            # a line search amplifies what rounding leaves of the direction
            np.testing.assert_allclose(coordinates(s, row), iterates[k], rtol=0, atol=1e-7 * np.abs(iterates[k]).max())
        assert row[TRIALS] == descent.trials >= many


@pytest.mark.parametrize("rule", RULES.values(), ids=RULES)
def test_the_plain_full_flow_takes_the_steps_of_the_reduced_one(rule: StepRule) -> None:
    s = sample(3)
    x = starts(s)[2]
    whole = descend(full_flow.start(x), full_flow.landscape(s.rows, s.weights), never, rule, 8)
    reduced = descend(x, reduced_flow.landscape(s.rows, s.weights), never, rule, 8)
    np.testing.assert_allclose(whole.steps, reduced.steps, rtol=1e-5)
    np.testing.assert_allclose(full_flow.cone_coordinates(whole.state), reduced.state, rtol=0, atol=1e-7 * x.max())


@pytest.mark.parametrize("kind", ["hard", "frictionless"])
@pytest.mark.parametrize("count", [3, 4, 5, 8, 9, 17, 50])
def test_every_layout_finds_the_optimum_of_the_oracle(count: int, kind: str) -> None:
    s, tolerance = sample(count, kind), 1e-5
    for seed in range(2 if count < 10 else 1):
        wrench, force, _ = starts(s, seed)
        least = phi(s.minimum(wrench)[0], s.weights)
        for layout in layouts(count):
            row, trace = flow(s, layout, BarzilaiBorweinStep(), REDUCED, tolerance).descend(wrench, force, NONE, 30_000)
            x = check(s, wrench, row, tolerance)
            assert least * (1.0 - 1e-12) <= row[OBJECTIVE] <= least * (1.0 + 1.1 * tolerance)
            assert row[5 - 1] <= least * (1.0 + 1e-12)
            nu = row[14:20]
            assert lower_bound(nu, s.cone_matrix, wrench, s.weights) == pytest.approx(row[4], rel=1e-9)
            values = trace[: int(row[ITERATIONS]) + 1]
            assert (np.diff(values) < 0.0).all()
            assert x[s.scale.reshape(-1) == 0.0].any() == False  # noqa: E712


@pytest.mark.parametrize("rule", RULES.values(), ids=RULES)
def test_every_rule_converges_with_a_certificate(rule: StepRule) -> None:
    s = sample(4)
    wrench, force, _ = starts(s)
    for layout in layouts(4):
        row, _ = flow(s, layout, rule, REDUCED, 1e-6, 200_000).descend(wrench, force, NONE, 0)
        check(s, wrench, row, 1e-6)


@pytest.mark.parametrize("form", FORMS)
def test_a_known_optimum_ends_it(form: int) -> None:
    s = sample(5)
    wrench, force, _ = starts(s)
    least = phi(s.minimum(wrench)[0], s.weights)
    row, trace = flow(s, (8, 1), None, form, 1e-3).descend(wrench, force, least, 20_000)
    assert (row[CODE], row[4]) == (CONVERGED, least)
    last = int(row[ITERATIONS])
    # at the first iterate that is near enough
    assert trace[last] <= least * (1.0 + 1e-3) < trace[last - 1]


@pytest.mark.parametrize("count", [4, 12])
def test_the_three_starts(count: int) -> None:
    """From the basis, carried over in both ways, and given: as Newton's."""
    s, rng = sample(count), np.random.default_rng(count)
    first, second = wrenches(rng, 2, 2.0)
    for layout in layouts(count):
        made, newton = flow(s, layout, BarzilaiBorweinStep()), insides.AnyNewton.make(*layout, s.placement, 1e-4, 50)
        for solver in (made, newton):
            solver.set_basis(s.basis)
        row = made.solve(first)
        check(s, first, row, 1e-4)
        force = row[FORCE : FORCE + 3 * count]
        initial = slice(FORCE + 3 * count, FORCE + 6 * count)
        np.testing.assert_array_equal(row[initial], newton.solve(first)[initial])
        for tangent in (True, False):
            row = made.follow(second, force, tangent)
            check(s, second, row, 1e-4)
            np.testing.assert_array_equal(row[initial], newton.follow(second, force, tangent)[initial])
        assert made.follow(first, force, True)[ITERATIONS] == 0.0
        again = made.clone().solve(first)
        np.testing.assert_array_equal(again, made.solve(first))


@pytest.mark.parametrize("kind", [0, 1, 2, 3])
@pytest.mark.parametrize("shrink", [1.0 - 1e-12, 1.0 - 2.0**-53, 0.5, 1e-300])
def test_no_rule_hangs(kind: int, shrink: float) -> None:
    """Numbers that `step_size.py` refuses, too: every search ends, at something that is valid."""
    s = sample(4)
    wrench, force, x = starts(s)
    for first in (1e-300, 1.0, 1e300, np.inf, np.nan):
        for grow in (1.0, 1.0 + 1e-300, 1e300, 2.0):
            numbers = np.array([float(kind), first, grow, shrink, 0.999 if kind == 1 else 0.0])
            row, _ = flow(s, (4, 1), numbers, REDUCED, 1e-9, 30).descend(wrench, force, NONE, 0)
            assert row[CODE] in (CONVERGED, LIMIT, STALLED)
            assert row[TRIALS] <= 31 * 2500  # a hundred shrinks, then halvings from 1e300 to 1e-16 of x
            assert np.isfinite(row).all()
            assert phi(coordinates(s, row), s.weights) <= phi(x, s.weights) * (1.0 + 1e-12)


@pytest.mark.parametrize("precision", [1e-300, 1e-14, 0.999, np.nan])
def test_no_line_search_hangs(precision: float) -> None:
    s = sample(4)
    wrench, force, _ = starts(s)
    row, _ = flow(s, (4, 1), np.array([4.0, 1.0, 1.0, 0.5, precision]), REDUCED, 1e-9, 30).descend(
        wrench, force, NONE, 0
    )
    assert row[CODE] in (CONVERGED, LIMIT, STALLED)
    assert row[TRIALS] <= 31 * 2500
    assert np.isfinite(row).all()


@pytest.mark.parametrize("omega", [1e-40, 1e-32, 1e-24, 1e-12, 1e12, 1e24])
def test_optimal_is_balanced_whatever_the_weights(omega: float) -> None:
    base = sample(4)
    s = Sample(base.positions, base.normals, base.scale, np.tile([omega, 0.01], (4, 1)))
    made = flow(s, (4, 1), None, REDUCED, 1e-4, 5000)
    gap, basis = made.make_basis()
    if not gap < 1e-2:
        return
    made.set_basis(basis)
    for wrench in wrenches(np.random.default_rng(1), 20):
        row = made.solve(wrench)
        x = coordinates(s, row)
        if row[CODE] != REFUSED:
            near = x.copy()
            # from coordinates to forces and back: at 1e24 the optimum is within rounding of its cones
            near[0::3] *= 1.0 + 1e-15
            assert phi(near, s.weights) < np.inf
        if row[CODE] == CONVERGED:
            left = np.abs(s.rows @ x + s.unit @ wrench).max()
            assert left <= 1.1e-9 * max(np.abs(s.unit @ wrench).max(), min(x.max(), 1.0))
            assert 0.0 <= row[OBJECTIVE] - row[4] <= 1e-4 * row[4]


def test_it_stalls_where_floating_point_ends() -> None:
    s = sample(4)
    wrench, force, _ = starts(s)
    least = phi(s.minimum(wrench)[0], s.weights)
    for rule in RULES.values():
        row, _ = flow(s, (4, 1), rule, REDUCED, 1e-300, 100_000).descend(wrench, force, NONE, 0)
        assert row[CODE] in (STALLED, LIMIT) or row[OBJECTIVE] <= row[4]
        assert row[OBJECTIVE] == pytest.approx(least, rel=1e-7)


@pytest.mark.parametrize("name", [name for name in RULES if name != "fixed"])  # that one does not grow
def test_a_start_at_the_apex_gets_away(name: str) -> None:
    s = sample(4)
    tiny = 1e-7 * s.rest
    row, _ = flow(s, (4, 1), RULES[name], REDUCED, 1e-3).descend(np.zeros(6), tiny / s.scale.reshape(-1), NONE, 0)
    assert row[CODE] == CONVERGED
    assert row[ITERATIONS] > 0
    assert row[OBJECTIVE] < 1e-3 * phi(tiny, s.weights)


def test_what_is_refused() -> None:
    s = sample(5)
    wrench, force, x = starts(s)
    made = flow(s, (8, 1))
    assert made.solve(wrench)[CODE] == REFUSED  # no basis
    outside = np.where(np.arange(15) % 3 == 0, -force, force)
    for wrong in (outside, 1.01 * force, np.full(15, np.nan)):
        assert made.descend(wrench, wrong, NONE, 0)[0][CODE] == REFUSED
    for wrong in (np.full(6, np.nan), np.full(6, 1e13)):
        assert made.descend(wrong, force, NONE, 0)[0][CODE] == REFUSED
    assert made.descend(wrench, force, NONE, 0)[0][CODE] == CONVERGED
    assert made.descend(wrench, force, NONE, 0)[0][RESIDUAL] < 1e-12 * np.abs(x).max()


@pytest.mark.parametrize("count", [4, 6, 12])
def test_contacts_that_hardly_span_the_wrenches(count: int) -> None:
    """Beyond the digits of one Cholesky factor: the second pass makes the rows orthonormal, so that iterates stay balanced."""
    s = sample(count, "thin")
    wrench, force, _ = starts(s)
    for layout in layouts(count):
        trace = flow(s, layout, None, REDUCED, 1e-12, 300).descend(wrench, force, NONE, 301)[1]
        # without balance Phi would fall below its least
        assert (trace >= phi(s.minimum(wrench)[0], s.weights) * (1.0 - 1e-9)).all()
        assert (np.diff(trace) < 0.0).all()


@pytest.mark.parametrize("remembers", [True, False])
@pytest.mark.parametrize("count", [3, 4, 5, 9])
def test_moving_contacts(count: int, remembers: bool) -> None:
    """The flow in a pipeline: as certified as a flow made for the contacts of every call, and of as few steps."""
    s, steps = sample(count), 0.0
    every = [pipeline(s, layout, remembers, 1e-4, 20_000, flows=True) for layout in layouts(count)]
    newton = pipeline(s, layouts(count)[0], remembers, 1e-4, 20_000)
    for there, w in path(s, 8, 3e-3):
        other = newton.solve(there.positions, there.normals, w)
        for made in every:
            row = made.solve(there.positions, there.normals, w)
            x = coordinates(there, row)
            assert row[CODE] == CONVERGED
            assert phi(x, s.weights) == pytest.approx(row[OBJECTIVE], rel=1e-9)
            assert row[4] <= min(row[OBJECTIVE], other[OBJECTIVE]) * (1.0 + 1e-11)
            assert row[OBJECTIVE] - row[4] <= 1e-4 * row[4]
            missed = np.abs(there.rows @ x + there.unit @ w).max()
            assert missed <= 1e-13 * count * (np.abs(x).max() + np.abs(there.unit @ w).max())
            np.testing.assert_allclose(made.last, x, rtol=1e-15)
            start = row[FORCE + 3 * count : FORCE + 6 * count]
            alone = flow(there, layouts(count)[-1]).descend(w, start, NONE, 0)[0]
            # other lanes round otherwise, and hundreds of steps magnify that
            assert abs(alone[ITERATIONS] - row[ITERATIONS]) <= 3 + 0.25 * row[ITERATIONS]
            steps += row[ITERATIONS]
    assert steps > 0.0

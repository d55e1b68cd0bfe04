"""The flows in every layout and form: the plain flow's iterates, every step rule, and what a record promises."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from cases import CONVERGED, FIELDS, LIMIT, STALLED, START, Case
from oracles import reduced_flow
from oracles.descent import Descent, followed
from oracles.phi import lower_bound, phi
from problems import STEP_RULES
from samples import Sample, layouts, sample, wrenches
from test_optimizer import at, check, nu_of

from grasp_env.core import _core
from grasp_env.force.step_size import AdaptiveStep, FixedStep, StepRule

RULES = STEP_RULES | {"fixed": FixedStep(0.003)}


def flow(
    s: Sample, layout: tuple[int, int], rule: StepRule | np.ndarray | None = None, form: str = "reduced",
    tolerance: float = 1e-4, limit: int = 20_000,
):  # fmt: skip
    """Solves (wrench, force, optimum, traced): the row and its trace."""
    numbers = rule if isinstance(rule, np.ndarray) else np.array((rule or AdaptiveStep()).parameters())
    if form == "paper":  # for studies alone: in the layout that the core takes
        contacts = _core.Contacts.make(s.positions, s.normals, s.scale, s.weights, np.zeros((0, 3)))

        def alone(wrench: np.ndarray, force: np.ndarray, optimum: float = np.nan, traced: int = 0):
            row, trace = np.zeros(_core.record_size(s.count)), np.full(traced, -1.0)
            given = np.ascontiguousarray(force.reshape(-1, 3))
            row[0] = _core.descend_flow(
                contacts, "paper", numbers, tolerance, limit, wrench, given, optimum, trace, row
            )
            return row, trace

        return alone
    made = Case(s, np.zeros(s.count)).solver(layout, f"{form} flow", tolerance=tolerance, limit=limit, rule=numbers)

    def solve(wrench: np.ndarray, force: np.ndarray, optimum: float = np.nan, traced: int = 0):
        return made.solve(wrench, START["given"], force=force, optimum=optimum, traced=traced)

    return solve


def starts(s: Sample, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(wrench, force (3N,), its cone coordinates): the optimum and as much squeeze again, many steps away from it."""
    wrench = wrenches(np.random.default_rng([s.count, seed]), 1)[0]
    x = s.minimum(wrench)[0] + 2.0 * s.rest
    x = x - s.inverse @ (s.rows @ x + s.unit @ wrench)
    return wrench, x / np.where(s.scale > 0.0, s.scale, 1.0).reshape(-1), x


def coordinates(s: Sample, row: np.ndarray) -> np.ndarray:
    return row[FIELDS["force"] :][: 3 * s.count] * s.scale.reshape(-1)


def plain(s: Sample, x: np.ndarray, rule: StepRule, count: int) -> tuple[Descent, list[np.ndarray]]:
    """The oracle's reduced flow, and all its iterates."""
    return followed(x, reduced_flow.landscape(s.rows, s.weights), rule, count)


CASES = [
    *((n, "hard", form, "adaptive") for n, form in product((3, 4, 5, 6), ("full", "paper", "reduced"))),
    *((n, "frictionless", form, "adaptive") for n, form in product((4, 7), ("full", "paper", "reduced"))),
    *((n, "hard", form, "adaptive") for n, form in product((8, 11), ("paper", "reduced"))),
    *((n, "hard", "reduced", rule) for n, rule in product((4, 9), RULES)),
]


@pytest.mark.parametrize(("count", "kind", "form", "rule"), CASES)
def test_every_layout_form_and_rule_gives_the_iterates_of_the_plain_flow(
    count: int, kind: str, form: str, rule: str
) -> None:
    """Growing and rejected steps; few enough that no decision hangs on rounding."""
    s, many = sample(count, kind), 20 if rule == "adaptive" else 12
    wrench, force, x = starts(s)
    descent, iterates = plain(s, x, RULES[rule], many)
    # a line search amplifies what rounding leaves of the direction
    near = 1e-9 if rule == "adaptive" else 1e-7
    for layout in layouts(count)[: 1 if form == "paper" else None]:
        for k in (0, 1, 2, 5, many):
            row, trace = flow(s, layout, RULES[rule], form, 1e-300, k)(wrench, force, traced=many + 1)
            assert (at(row, "code"), at(row, "iterations")) == (LIMIT, k)
            np.testing.assert_allclose(coordinates(s, row), iterates[k], rtol=0, atol=near * np.abs(iterates[k]).max())
            np.testing.assert_allclose(trace[: k + 1], descent.values[: k + 1], rtol=near)
            assert (trace[k + 1 :] == -1.0).all()
            assert at(row, "objective") == trace[k]
        assert at(row, "trials") == descent.trials >= many


@pytest.mark.parametrize(
    ("count", "kind", "rule", "tolerance"),
    [
        *((n, kind, "short", 1e-5) for n in (3, 4, 5, 8, 9, 17, 50) for kind in ("hard", "frictionless")),
        *((4, "hard", rule, 1e-6) for rule in RULES),
    ],
)
def test_every_layout_finds_the_optimum_of_the_oracle(count: int, kind: str, rule: str, tolerance: float) -> None:
    s = sample(count, kind)
    for seed in range(2 if count < 10 else 1):
        wrench, force, _ = starts(s, seed)
        least = phi(s.minimum(wrench)[0], s.weights)
        for layout in layouts(count):
            row, trace = flow(s, layout, RULES[rule], "reduced", tolerance, 200_000)(wrench, force, traced=30_000)
            check(Case(s, np.zeros(count)), wrench, row, tolerance, least)
            known = lower_bound(nu_of(row), s.cone_matrix, wrench, s.weights)
            assert known == pytest.approx(at(row, "lower_bound"), rel=1e-9)
            assert (np.diff(trace[: int(at(row, "iterations")) + 1]) < 0.0).all()


@pytest.mark.parametrize("form", ["full", "paper", "reduced"])
def test_a_known_optimum_ends_it(form: str) -> None:
    s = sample(5)
    wrench, force, _ = starts(s)
    least = phi(s.minimum(wrench)[0], s.weights)
    row, trace = flow(s, (8, 0), None, form, 1e-3)(wrench, force, least, 20_000)
    assert (at(row, "code"), at(row, "lower_bound")) == (CONVERGED, least)
    last = int(at(row, "iterations"))
    # at the first iterate that is near enough
    assert trace[last] <= least * (1.0 + 1e-3) < trace[last - 1]


NUMBERS = [
    *(([kind, first, grow, shrink, 0.999 if kind == 1 else 0.0])
      for kind in range(4) for shrink in (1.0 - 1e-12, 1.0 - 2.0**-53, 0.5, 1e-300)
      for first in (1e-300, 1.0, 1e300, np.inf, np.nan) for grow in (1.0, 1.0 + 1e-300, 1e300, 2.0)),
    *([4.0, 1.0, 1.0, 0.5, precision] for precision in (1e-300, 1e-14, 0.999, np.nan)),
]  # fmt: skip


def test_no_rule_hangs() -> None:
    """Numbers that `step_size.py` refuses, too: every search ends, at something that is valid."""
    s = sample(4)
    wrench, force, x = starts(s)
    for numbers in NUMBERS:
        row, _ = flow(s, (4, 1), np.array(numbers, float), "reduced", 1e-9, 30)(wrench, force)
        assert at(row, "code") in (CONVERGED, LIMIT, STALLED)
        assert at(row, "trials") <= 31 * 2500  # a hundred shrinks, then halvings from 1e300 to 1e-16 of x
        assert np.isfinite(row).all()
        assert phi(coordinates(s, row), s.weights) <= phi(x, s.weights) * (1.0 + 1e-12)


@pytest.mark.parametrize("omega", [1e-40, 1e-32, 1e-24, 1e-12, 1e12, 1e24])
def test_optimal_is_balanced_whatever_the_weights(omega: float) -> None:
    base = sample(4)
    s = Sample(base.positions, base.normals, base.scale, np.tile([omega, 0.01], (4, 1)))
    made = Case(s, np.zeros(4)).solver((4, 1), "reduced flow", tolerance=1e-4, limit=5000)
    for wrench in wrenches(np.random.default_rng(1), 20):
        row, _ = made.solve(wrench)
        x = coordinates(s, row)
        if at(row, "code") in (CONVERGED, LIMIT, STALLED):
            near = x.copy()
            # from coordinates to forces and back: at 1e24 the optimum is within rounding of its cones
            near[0::3] *= 1.0 + 1e-15
            assert phi(near, s.weights) < np.inf
        if at(row, "code") == CONVERGED:
            left = np.abs(s.rows @ x + s.unit @ wrench).max()
            assert left <= 1.1e-9 * max(np.abs(s.unit @ wrench).max(), min(x.max(), 1.0))
            assert 0.0 <= at(row, "objective") - at(row, "lower_bound") <= 1e-4 * at(row, "lower_bound")


@pytest.mark.parametrize("rule", RULES.values(), ids=RULES)
def test_it_stalls_where_floating_point_ends_and_gets_away_from_the_apex(rule: StepRule) -> None:
    s = sample(4)
    wrench, force, _ = starts(s)
    least = phi(s.minimum(wrench)[0], s.weights)
    row, _ = flow(s, (4, 1), rule, "reduced", 1e-300, 100_000)(wrench, force)
    assert at(row, "code") in (STALLED, LIMIT) or at(row, "objective") <= at(row, "lower_bound")
    assert at(row, "objective") == pytest.approx(least, rel=1e-7)
    if rule is RULES["fixed"]:
        return  # it does not grow
    tiny = 1e-7 * s.rest
    row, _ = flow(s, (4, 1), rule, "reduced", 1e-3)(np.zeros(6), tiny / s.scale.reshape(-1))
    assert at(row, "code") == CONVERGED
    assert at(row, "iterations") > 0
    assert at(row, "objective") < 1e-3 * phi(tiny, s.weights)


@pytest.mark.parametrize("count", [4, 6, 12])
def test_contacts_that_hardly_span_the_wrenches(count: int) -> None:
    """Beyond the digits of one Cholesky factor: the second pass makes the rows orthonormal, so that iterates stay balanced."""
    s = sample(count, "thin")
    wrench, force, _ = starts(s)
    for layout in layouts(count):
        _, trace = flow(s, layout, None, "reduced", 1e-12, 300)(wrench, force, traced=301)
        # without balance Phi would fall below its least
        assert (trace >= phi(s.minimum(wrench)[0], s.weights) * (1.0 - 1e-9)).all()
        assert (np.diff(trace) < 0.0).all()

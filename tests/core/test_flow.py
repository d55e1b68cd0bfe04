"""The flows in every form: iterates of the plain flow, every step rule, certificates, and where
they stop."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from cases import FIELDS, START, Case, at, nu_of
from oracles import reduced_flow
from oracles.descent import followed
from oracles.phi import lower_bound, phi
from problems import STEP_RULES
from samples import Sample, sample, wrenches
from test_optimizer import check

from grasp_env.core import _core
from grasp_env.force.record import CONVERGED, LIMIT, STALLED
from grasp_env.force.step_size import AdaptiveStep, FixedStep, StepRule

RULES = STEP_RULES | {"fixed": FixedStep(0.003)}


def flow(
    s: Sample,
    rule: StepRule | np.ndarray | None = None,
    form: str = "reduced",
    tolerance: float = 1e-4,
    limit: int = 20_000,
):
    """Return solve(wrench, force, optimum, traced) -> (row, trace)."""
    numbers = (
        rule if isinstance(rule, np.ndarray) else np.array((rule or AdaptiveStep()).parameters())
    )
    if form == "paper":  # for studies alone
        contacts = _core.Contacts.make(s.positions, s.normals, s.scale, s.weights, np.zeros((0, 3)))

        def alone(wrench: np.ndarray, force: np.ndarray, optimum: float = np.nan, traced: int = 0):
            row = np.zeros(_core.record_size(s.count))
            trace = np.full(traced, -1.0)
            given = np.ascontiguousarray(force.reshape(-1, 3))
            options = _core.Options(step_rule=numbers, tolerance=tolerance, limit=limit)
            request = _core.Request(force=given, optimum=optimum, trace=trace)
            row[0] = _core.descend_flow(contacts, "paper", options, wrench, request, row)
            return row, trace

        return alone
    solver = Case(s, np.zeros(s.count)).solver(
        f"{form} flow", tolerance=tolerance, limit=limit, rule=numbers
    )

    def solve(wrench: np.ndarray, force: np.ndarray, optimum: float = np.nan, traced: int = 0):
        return solver.solve(wrench, START["given"], force=force, optimum=optimum, traced=traced)

    return solve


def starts(s: Sample) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(wrench, force (3N,), its cone coordinates): the optimum and as much squeeze again, many
    steps away from it."""
    wrench = wrenches(np.random.default_rng([s.count, 0]), 1)[0]
    x = s.minimum(wrench)[0] + 2.0 * s.rest
    x = x - s.inverse @ (s.rows @ x + s.unit @ wrench)
    return wrench, x / np.where(s.scale > 0.0, s.scale, 1.0).reshape(-1), x


CASES = [
    *(
        (n, "hard", form, "adaptive")
        for n, form in product((3, 4, 5), ("full", "paper", "reduced"))
    ),
    *(
        (n, "frictionless", form, "adaptive")
        for n, form in product((7,), ("full", "paper", "reduced"))
    ),
    *((11, "hard", form, "adaptive") for form in ("paper", "reduced")),
    *((n, "hard", "reduced", rule) for n, rule in product((4, 9), RULES)),
]


@pytest.mark.parametrize(("count", "kind", "form", "rule"), CASES)
def test_every_form_and_rule_gives_the_iterates_of_the_plain_flow(count, kind, form, rule):
    """Growing and rejected steps; few enough that no decision depends on rounding."""
    s = sample(count, kind)
    many = 20 if rule == "adaptive" else 12
    wrench, force, x = starts(s)
    descent, iterates = followed(
        x, reduced_flow.landscape(s.rows, s.phi_weights), RULES[rule], many
    )
    # a line search amplifies what rounding leaves of the direction
    near = 1e-9 if rule == "adaptive" else 1e-7
    for k in (0, 1, 5, many):
        row, trace = flow(s, RULES[rule], form, 1e-300, k)(wrench, force, traced=many + 1)
        assert (at(row, "code"), at(row, "iterations")) == (LIMIT, k)
        found = row[FIELDS["force"] :][: 3 * count]
        assert not found[s.scale.reshape(-1) == 0.0].any()
        found = found * s.scale.reshape(-1)
        np.testing.assert_allclose(
            found, iterates[k], rtol=0, atol=near * np.abs(iterates[k]).max()
        )
        np.testing.assert_allclose(trace[: k + 1], descent.values[: k + 1], rtol=near)
        assert (trace[k + 1 :] == -1.0).all()
        assert at(row, "objective") == trace[k]
    assert at(row, "trials") == descent.trials >= many


@pytest.mark.parametrize(
    ("count", "kind", "rule", "tolerance"),
    [
        *(
            (n, kind, "short", 1e-5)
            for n, kind in ((3, "hard"), (8, "frictionless"), (9, "hard"), (50, "hard"))
        ),
        *((4, "hard", rule, 1e-6) for rule in RULES),
    ],
)
def test_the_flow_finds_the_optimum_of_the_oracle(count, kind, rule, tolerance):
    s = sample(count, kind)
    wrench, force, _ = starts(s)
    least = phi(s.minimum(wrench)[0], s.phi_weights)
    row, trace = flow(s, RULES[rule], "reduced", tolerance, 200_000)(wrench, force, traced=30_000)
    check(Case(s, np.zeros(count)), wrench, row, tolerance, least)
    known = lower_bound(nu_of(row), s.cone_matrix, wrench, s.phi_weights)
    assert known == pytest.approx(at(row, "lower_bound"), rel=1e-9)
    assert (np.diff(trace[: int(at(row, "iterations")) + 1]) < 0.0).all()


@pytest.mark.parametrize("form", ["full", "paper", "reduced"])
def test_a_known_optimum_ends_it_at_the_first_iterate_near_enough(form):
    s = sample(5)
    wrench, force, _ = starts(s)
    least = phi(s.minimum(wrench)[0], s.phi_weights)
    row, trace = flow(s, None, form, 1e-3)(wrench, force, least, 20_000)
    assert (at(row, "code"), at(row, "lower_bound")) == (CONVERGED, least)
    last = int(at(row, "iterations"))
    assert trace[last] <= least * (1.0 + 1e-3) < trace[last - 1]


def test_no_rule_hangs():
    """Extreme numbers, also those that `step_size.py` refuses: every search ends, and what
    converged is certified."""
    s = sample(4)
    wrench, force, _ = starts(s)
    numbers = [
        *(
            [kind, first, grow, shrink, 0.999 if kind == 1 else 0.0]
            for kind in range(4)
            for shrink in (1.0 - 2.0**-53, 1e-300)
            for first in (1e-300, 1e300, np.inf, np.nan)
            for grow in (1.0, 1e300)
        ),
        *([4.0, 1.0, 1.0, 0.5, precision] for precision in (1e-300, 0.999, np.nan)),
    ]
    for each in numbers:
        row, _ = flow(s, np.array(each, float), "reduced", 1e-9, 30)(wrench, force)
        assert at(row, "code") in (CONVERGED, LIMIT, STALLED)
        assert at(row, "code") != CONVERGED or at(row, "objective") <= at(row, "lower_bound") * (
            1.0 + 1e-9
        )


@pytest.mark.parametrize("rule", RULES.values(), ids=RULES)
def test_it_stalls_where_floating_point_ends_and_gets_away_from_the_apex(rule):
    s = sample(4)
    wrench, force, _ = starts(s)
    least = phi(s.minimum(wrench)[0], s.phi_weights)
    row, _ = flow(s, rule, "reduced", 1e-300, 100_000)(wrench, force)
    assert at(row, "code") in (STALLED, LIMIT) or at(row, "objective") <= at(row, "lower_bound")
    assert at(row, "objective") == pytest.approx(least, rel=1e-7)
    if rule is not RULES["fixed"]:  # which does not grow
        tiny = 1e-7 * s.rest
        row, _ = flow(s, rule, "reduced", 1e-3)(np.zeros(6), tiny / s.scale.reshape(-1))
        assert at(row, "code") == CONVERGED
        assert at(row, "objective") < 1e-3 * phi(tiny, s.phi_weights)


@pytest.mark.parametrize("count", [4, 12])
def test_contacts_that_hardly_span_the_wrenches(count):
    """A second Cholesky pass makes the rows orthonormal, so that iterates stay balanced: else Phi
    would fall below its least."""
    s = sample(count, "thin")
    wrench, force, _ = starts(s)
    _, trace = flow(s, None, "reduced", 1e-12, 300)(wrench, force, traced=301)
    assert (trace >= phi(s.minimum(wrench)[0], s.phi_weights) * (1.0 - 1e-9)).all()
    assert (np.diff(trace) < 0.0).all()

"""Numbers that are none, too large or tiny, at Python's side of the core: refused, or an answer that holds."""

from __future__ import annotations

import numpy as np
import pytest
from calls import CALLS, COUNT, LOADS, REFUSED, SAMPLE, SIZE, TOLERANCE, begun, contacts, newton

from grasp_env.core import _core
from grasp_env.force.record import FORCE

BAD = (np.nan, np.inf, -np.inf, 1e300, -1e300)
SOLVES = (
    "Newton.solve",
    "Newton.descend",
    "LimitedNewton.solve",
    "LimitedNewton.descend",
    "Conic.solve",
    "Pipeline.solve",
)


def valid(row: np.ndarray, wrench: np.ndarray) -> bool:
    """Whether a record's force is what it says: finite, in the cones, balanced."""
    x = (row[FORCE : FORCE + 3 * COUNT].reshape(-1, 3) * SAMPLE.scale).reshape(-1)
    if not np.isfinite(np.delete(row, 4)).all() or not row[6] >= 0.0:
        return False
    w = SAMPLE.unit @ wrench
    return bool(np.abs(SAMPLE.rows @ x + w).max() <= 1e-9 * (np.abs(x).max() + np.abs(w).max()))


@pytest.mark.parametrize("name", SOLVES)
def test_numbers_that_are_none_are_refused_or_harmless(name: str) -> None:
    """A thousand calls with one to three numbers that are not finite, too large, or tiny."""
    rng, call, outcomes = np.random.default_rng(len(name)), CALLS[name], set()
    for _ in range(1000):
        arguments = call.arguments()
        for argument in rng.choice(list(call.given), rng.integers(1, 3)):
            a = arguments[argument].reshape(-1)
            a[rng.integers(a.size, size=rng.integers(1, 4))] = rng.choice([*BAD, 1e-300, 0.0, -0.0, 1e12, 1e-12])
        outcome = call.run(**arguments)
        outcomes.add(outcome)
        # contacts with coordinates of 1e300 m are out of reach of the oracle, not of the rule
        there = all((arguments[k] == call.given[k]).all() for k in ("points", "normals") if k in call.given)
        assert outcome == REFUSED or not there or valid(arguments["record"], arguments["wrench"]), arguments
        assert outcome == arguments["record"][0] or outcome == REFUSED
    assert {0, REFUSED} <= outcomes
    # and nothing of it stays but a basis renewed for contacts far away, which may not reach back
    if name == "Pipeline.solve":
        call.run.__self__.reset()  # type: ignore[attr-defined]
    arguments = call.arguments()
    assert call.run(**arguments) == 0
    assert valid(arguments["record"], arguments["wrench"])


@pytest.mark.parametrize(
    ("name", "which"),
    [
        *(
            (name, "wrenches")
            for name in ("Newton.solve_many", "Conic.solve_many", "Learned.solve_many", "Newton.times", "Conic.times")
        ),
        ("Newton.solve_many", "previous"),
        ("Learned.solve_many", "previous"),
    ],
)
def test_one_row_that_is_none_leaves_the_others(name: str, which: str) -> None:
    call = CALLS[name]
    wanted = call.arguments()
    call.run(**wanted)
    for bad in BAD:
        arguments = call.arguments()
        arguments[which][1] = bad
        call.run(**arguments)
        for k in (0, 2):
            np.testing.assert_array_equal(arguments["records"][k], wanted["records"][k])
        assert (arguments["records"][1, 0] == REFUSED) == (which == "wrenches")


@pytest.mark.parametrize("argument", ["positions", "normals"])
def test_contacts_of_numbers_that_are_none(argument: str) -> None:
    given = CALLS["Contacts.make"].given
    for bad in (*BAD, 1e160, 1e-160):
        for every in (True, False):
            a = given[argument].copy()
            a.reshape(-1)[slice(None) if every else 4] = bad
            if argument == "positions" and not every and bad == 1e-160:
                continue  # is a contact next to an axis
            with pytest.raises(ValueError, match=r"finite|rank"):
                _core.Contacts.make(**(given | {argument: a}))


def unpack(count: int, positions: float = 0.1) -> tuple[np.ndarray, ...]:
    return (
        np.full((count, 3), positions),
        np.tile([0.0, 0.0, 1.0], (count, 1)),
        np.ones((count, 3)),
        np.ones((count, 2)),
    )


@pytest.mark.parametrize("count", [1, 2, 3, 64])
def test_contacts_that_span_nothing(count: int) -> None:
    with pytest.raises(ValueError, match="rank"):
        _core.Contacts.make(*unpack(count), np.zeros((0, 3)))


@pytest.mark.parametrize("limit", [0, -1, -(2**31), 2**31 - 1])
@pytest.mark.parametrize("tolerance", [0.0, -1.0, np.nan, np.inf, 1e300])
def test_any_settings_end(tolerance: float, limit: int) -> None:
    """Whatever is asked, a solve ends with a valid force: 2^31 steps are never taken."""
    made = _core.Newton.make(contacts(), tolerance, limit)
    made.set_basis(SAMPLE.basis)
    exact = _core.Conic.make(contacts(), tolerance, limit, SAMPLE.rest)
    for load in LOADS:
        for solver in (made, exact):
            row = np.zeros(SIZE)
            assert solver.solve(load, None, row) != REFUSED
            assert valid(row, load)


@pytest.mark.parametrize("what", ["points", "wrench"])
def test_carry_says_where_it_cannot(what: str) -> None:
    points, wrench = np.outer(np.arange(4.0), [0.01, 0.02, 0.03]), LOADS[0] * np.nan
    made, force = begun(), np.full((COUNT, 3), -7.0)
    how = made.carry(
        points if what == "points" else SAMPLE.positions,
        SAMPLE.normals,
        wrench if what == "wrench" else LOADS[0],
        force,
    )
    assert how not in (0, 1)
    assert np.isfinite(force).all()


def test_a_record_may_be_followed_in_place() -> None:
    s, rng = SAMPLE, np.random.default_rng(0)
    weights = s.weights * [1.0, 1e-4]
    hard = _core.Contacts.make(s.positions, s.normals, s.scale, weights, np.zeros((0, 3)))
    made = _core.Newton.make(hard, 1e-8, 100)
    made.set_basis(SAMPLE.basis)
    for before, now in 10.0 * rng.standard_normal((40, 2, 6)) * [1.0, 1.0, 1.0, 0.05, 0.05, 0.05]:
        first, separate = np.zeros((2, SIZE))
        made.solve(before, None, first)
        made.solve(now, first, separate)
        made.solve(now, first, first)
        np.testing.assert_array_equal(first, separate)


def test_the_limit_is_of_all_steps() -> None:
    s, rng, most = SAMPLE, np.random.default_rng(1), 0.0
    hard = _core.Contacts.make(s.positions, s.normals, s.scale, s.weights * [1.0, 1e-6], np.zeros((0, 3)))
    made = _core.Newton.make(hard, 1e-8, 20)
    made.set_basis(SAMPLE.basis)
    for load in 10.0 * rng.standard_normal((200, 6)) * [1.0, 1.0, 1.0, 0.05, 0.05, 0.05]:
        row = np.zeros(SIZE)
        made.solve(load, None, row)
        most = max(most, row[1])
    assert most <= 20


# what is wrong today


GARBAGE = {
    "scale of nan": lambda a: {"scale": np.where(np.arange(3) == 1, np.nan, a["scale"])},
    "scale of inf": lambda a: {"scale": np.where(np.arange(3) == 1, np.inf, a["scale"])},
    "no normal force": lambda a: {"scale": np.where(np.arange(3) == 0, 0.0, a["scale"])},
    "weights of nan": lambda a: {"weights": a["weights"] * [1.0, np.nan]},
    "weights below zero": lambda a: {"weights": -a["weights"]},
    "tangents of nan": lambda a: {"tangents": a["tangents"] * np.nan},
    "tangents along the normals": lambda a: {"tangents": a["normals"]},
}


@pytest.mark.parametrize("what", GARBAGE)
def test_contacts_of_garbage_are_refused(what: str) -> None:
    arguments = CALLS["Contacts.make"].arguments()
    with pytest.raises(ValueError, match=r"."):
        _core.Contacts.make(**(arguments | GARBAGE[what](arguments)))


@pytest.mark.parametrize("factor", [np.nan, np.inf, -1.0, 0.0])
@pytest.mark.parametrize("what", ["basis", "interior"])
def test_a_start_of_garbage_is_refused(what: str, factor: float) -> None:
    row, made = np.zeros(SIZE), newton()
    if what == "basis":
        made.set_basis(SAMPLE.basis * factor)
        assert made.solve(LOADS[0], None, row) == REFUSED
    else:
        interior = SAMPLE.rest * factor
        assert _core.Conic.make(contacts(), TOLERANCE, 60, interior).solve(LOADS[0], None, row) == REFUSED

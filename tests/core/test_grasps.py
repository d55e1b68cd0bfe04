"""Many grasps side by side in the registers: the answers of single solves, whatever stands beside them."""

from __future__ import annotations

from functools import cache

import _core_test as insides
import numpy as np
import pytest
from samples import EACH, Sample, random_contacts, sample, thinned, with_frictionless, wrenches

from grasp_env.core import _core
from grasp_env.force.record import BOUND, CODE, FORCE, ITERATIONS, MARGIN, MULTIPLIERS, OBJECTIVE, RESIDUAL, WRENCH

COUNTS = tuple(range(3, 13))
KINDS = ("hard", "frictionless", "thin")
CALLS = {"newton": _core.newton_grasps, "conic": _core.conic_grasps}
TOLERANCES = {"newton": 1e-4, "conic": 1e-6}
WEIGHTS = (1.0, 0.01)
REFUSED = _core.codes()["refused"]  # for a solver of its own
each_count = pytest.mark.parametrize("count", COUNTS)
each_method = pytest.mark.parametrize("method", CALLS)


@cache
def grasps(count: int, kind: str, number: int = 21) -> tuple[Sample, ...]:
    """With elliptic cones and force closure; frictionless: some contacts are; thin: contacts nearly on a line."""
    rng = np.random.default_rng([count, len(kind), 3])
    found: list[Sample] = []
    while len(found) < number:
        s = random_contacts(rng, count)
        if kind == "frictionless" and count > 3:
            s = with_frictionless(s, slice(-(count // 3), None))
        if kind == "thin":
            s = thinned(s, 10.0 ** rng.uniform(-3.0, -1.0))
        s = Sample(s.positions, s.normals, s.scale, np.tile(WEIGHTS, (count, 1)))
        rest = EACH[1](s.placement).rest() if s.placement.verdict == 0 else None
        # where closure is about to be lost, answers of one solver on registers of two widths differ in the sixth digit
        if rest is not None and depth(rest) > (0.02 if kind == "thin" else 0.08):
            found.append(s)
    return tuple(found)


def depth(x: np.ndarray) -> float:
    """Of the shallowest contact, as a part of the largest force."""
    u, o, t = x.reshape(-1, 3).T
    return float((u - np.hypot(o, t)).min() / u.max())


def solved(
    method: str, given: tuple[Sample, ...] | list[_core.Contacts], loads: np.ndarray, first: np.ndarray | None = None,
    tolerance: float | None = None, limit: int = 200,
) -> np.ndarray:  # fmt: skip
    """(M, record_size) of one call; a wrench for each grasp unless `first` says where those of each begin."""
    placed_ = [placed(each) if isinstance(each, Sample) else each for each in given]
    count = placed_[0].count
    size, weights = _core.record_size(count), np.tile(WEIGHTS, (count, 1))
    rows, begin = np.full((len(loads), size + 9 * count), -7.0), np.arange(len(given) + 1.0) if first is None else first
    CALLS[method](placed_, weights, begin, tolerance or TOLERANCES[method], limit, loads, rows)
    for k, contacts in enumerate(placed_):
        for row in rows[int(begin[k]) : int(begin[k + 1])]:
            if row[CODE] == 0.0:
                np.testing.assert_array_equal(row[size:], np.ravel(contacts.frames))
    return rows[:, :size]


def placed(s: Sample) -> _core.Contacts:
    """The contacts of a sample as the core stores them; bad geometry is kept for the core to judge."""
    return _core.Contacts.put(s.positions, s.normals, s.scale, np.zeros(s.count), np.zeros((0, 3)))


def alone(method: str, s: Sample, load: np.ndarray) -> np.ndarray:
    """(record_size,) of the solver of one problem."""
    if method == "newton":
        return EACH[4](s.placement).solved(load, TOLERANCES[method])
    made = insides.AnyOptimizer.make(8, 0, s.placement, method=3, tolerance=TOLERANCES[method])
    return made.solve(load)[0][: _core.record_size(s.count)]


def last_digits(method: str, s: Sample, load: np.ndarray, forces: slice) -> float:
    """By how much the forces move with the last digits of the wrench [N]."""
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (6, 6))
    moved = [alone(method, s, load * (1.0 + np.finfo(float).eps * sign))[forces] for sign in signs]
    return float(np.ptp(moved, axis=0).max())


@pytest.mark.parametrize("lanes", EACH)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [3, 4, 5, 8, 9])
def test_the_start_is_the_least_force_and_some_of_the_internal(lanes: int, kind: str, count: int) -> None:
    """As much as it needs."""
    s, rng = sample(count, kind), np.random.default_rng(count)
    made = EACH[lanes](s.placement)
    rest = made.rest()
    push = Sample(s.positions, np.tile([0.0, 0.6, 0.8], (count, 1)), s.scale * 0.0 + [0.3, 1.0, 1.0], s.weights)
    assert EACH[lanes](push.placement).rest() is None  # fingers that all push the same way have none
    assert np.abs(s.rows @ rest).max() <= 1e-12 * np.abs(rest).max()
    assert made.squeezed(rest) == pytest.approx(1.0, rel=1e-12)
    for size in (0.0, 1e-6, 1.0, 1e3):
        for load in wrenches(rng, 5, size):
            w = s.unit @ load
            least = -s.inverse @ w
            needed = made.inside(least, rest)[0]
            x = made.begun(rest, w)
            wanted = least + max(1.0, 1.1 * needed + 0.5) * rest
            np.testing.assert_allclose(x, wanted, rtol=0, atol=1e-11 * np.abs(wanted).max())
            assert made.phi(x) < np.inf


@each_method
@pytest.mark.parametrize("kind", KINDS)
@each_count
def test_the_answers_of_single_solves(method: str, kind: str, count: int) -> None:
    given = grasps(count, kind)
    rng = np.random.default_rng(count)
    loads = wrenches(rng, len(given)) * 10.0 ** rng.uniform(-3.0, 0.5, (len(given), 1))
    records = solved(method, given, loads)
    digits = 1e-5 if kind == "thin" else 1e-9
    forces, exact = slice(FORCE, FORCE + 6 * count), [CODE, ITERATIONS]
    left = records[:, CODE] == REFUSED
    assert left.mean() < (0.5 if kind == "thin" else 0.01)
    for s, load, each in (
        row for row, lost in zip(zip(given, loads, records, strict=True), left, strict=True) if not lost
    ):
        one = alone(method, s, load)
        near = digits * np.abs(one[forces]).max()
        if np.abs(each[forces] - one[forces]).max() > near:  # one grasp has fewer digits
            near = 2.0 * last_digits(method, s, load, forces)
        np.testing.assert_array_equal(each[exact], one[exact])
        np.testing.assert_allclose(each[forces], one[forces], rtol=0, atol=near)
        np.testing.assert_allclose(each[[OBJECTIVE, BOUND]], one[[OBJECTIVE, BOUND]], rtol=10 * digits)
        assert each[MARGIN] == pytest.approx(one[MARGIN], abs=near)
        assert each[RESIDUAL] <= 1e-9 * np.abs(load).max()
        np.testing.assert_array_equal(each[WRENCH : WRENCH + 6], load)
        nu = slice(MULTIPLIERS, MULTIPLIERS + 6)
        np.testing.assert_allclose(each[nu], one[nu], rtol=0, atol=100 * digits * np.abs(one[nu]).max())


@each_method
@each_count
def test_what_is_not_ordinary_is_left(method: str, count: int) -> None:
    """Contacts that hardly span the wrenches, or do not; no force closure; numbers that are none; wrenches of nothing."""
    given = list(grasps(count, "hard"))
    rng = np.random.default_rng(count)
    loads = wrenches(rng, len(given))
    before = solved(method, tuple(given), loads)
    s = given[5]
    given[1] = thinned(s, 1e-5)
    given[5] = thinned(s, 0.0)
    floor = np.tile([0.0, 0.0, 1.0], (count, 1))
    given[9] = Sample(s.positions, floor, s.scale, s.weights)
    given[13] = Sample(np.where(np.arange(3) == 1, np.nan, s.positions), s.normals, s.scale, s.weights)
    given[14] = Sample(s.positions, 1.01 * s.normals, s.scale, s.weights)
    loads[17], loads[18] = 0.0, np.inf
    records = solved(method, tuple(given), loads)
    assert (records[[5, 9, 13, 14, 18], CODE] == REFUSED).all()
    assert records[17, CODE] in (0.0, REFUSED)
    same = [k for k in range(len(given)) if k not in (1, 5, 9, 13, 14, 17, 18)]
    np.testing.assert_array_equal(records[same], before[same])


@each_method
@pytest.mark.parametrize("count", [3, 4, 9])
def test_no_answer_hangs_on_its_neighbours(method: str, count: int) -> None:
    """Each grasp has 0 to 20 wrenches; the grasps in another order, and one at a time."""
    given = grasps(count, "hard")
    rng = np.random.default_rng(count)
    own = rng.integers(0, 20, len(given)) * (rng.uniform(size=len(given)) < 0.7) + (np.arange(len(given)) % 3)
    first = np.append(0, np.cumsum(own))
    loads = wrenches(rng, int(first[-1])) * 10.0 ** rng.uniform(-2.0, 2.0, (int(first[-1]), 1))
    records = solved(method, given, loads, first.astype(float))
    assert (records[:, CODE] == 0.0).all()
    order = rng.permutation(len(given))
    rows = np.concatenate([np.arange(first[u], first[u + 1]) for u in order])
    begin = np.append(0, np.cumsum(own[order])).astype(float)
    mixed = solved(method, tuple(given[u] for u in order), loads[rows], begin)
    np.testing.assert_array_equal(mixed, records[rows])
    for u, s in enumerate(given):
        part = slice(first[u], first[u + 1])
        single = solved(method, (s,), loads[part], np.array([0.0, own[u]]))
        np.testing.assert_array_equal(single, records[part])


@each_method
def test_a_limit_of_iterations_leaves_them(method: str) -> None:
    """Few are within it."""
    given = grasps(4, "hard")
    loads = wrenches(np.random.default_rng(1), len(given), 100.0)
    assert (solved(method, given, loads, None, 1e-8, 2)[:, CODE] == REFUSED).all()


@each_method
def test_soft_contacts_are_refused_and_others_are_not(method: str) -> None:
    given = grasps(4, "hard")
    loads = wrenches(np.random.default_rng(2), len(given))
    contacts = [placed(s) for s in given]
    before = solved(method, contacts, loads)
    s = given[5]
    contacts[5] = _core.Contacts.put(s.positions, s.normals, s.scale, np.full(4, 0.01), np.zeros((0, 3)))
    after = solved(method, contacts, loads)
    assert after[5, CODE] == REFUSED
    others = np.delete(np.arange(len(given)), 5)
    np.testing.assert_array_equal(after[others], before[others])
    for wrong in ([*contacts[:-1], None], [*contacts[:-1], 3], [*contacts[:-1], placed(grasps(5, "hard")[0])]):
        rows = np.empty((len(loads), _core.record_size(4) + 36))
        with pytest.raises(TypeError, match="contacts"):
            CALLS[method](wrong, np.tile(WEIGHTS, (4, 1)), np.arange(len(wrong) + 1.0), 1e-4, 9, loads, rows)

"""Many grasps side by side in the registers have the answers of single solves, whatever stands
beside them."""

from __future__ import annotations

from functools import cache

import _core_test as insides
import numpy as np
import pytest
from cases import START
from samples import Sample, random_contacts, thinned, with_frictionless, wrenches

from grasp_env.core import _core
from grasp_env.force.record import (
    BOUND,
    CODE,
    FORCE,
    ITERATIONS,
    MARGIN,
    MULTIPLIERS,
    OBJECTIVE,
    RESIDUAL,
    STARTED,
    WRENCH,
)

CALLS = {"newton": _core.newton_grasps, "conic": _core.conic_grasps}
TOLERANCES = {"newton": 1e-4, "conic": 1e-6}
REFUSED = _core.codes()["refused"]  # left to a solver of its own
each_method = pytest.mark.parametrize("method", CALLS)


def weights_of(count: int) -> np.ndarray:
    """(N, 2), different at every contact."""
    rng = np.random.default_rng(count)
    return np.column_stack(
        [rng.uniform(0.7, 1.6, count), 0.01 * 10.0 ** rng.uniform(-0.5, 0.5, count)]
    )


@cache
def grasps(count: int, kind: str, number: int = 11) -> tuple[Sample, ...]:
    """Grasps with elliptic cones and force closure; frictionless: some contacts are; thin: contacts
    nearly on a line."""
    rng = np.random.default_rng([count, len(kind), 3])
    found: list[Sample] = []
    while len(found) < number:
        s = random_contacts(rng, count)
        if kind == "frictionless" and count > 3:
            s = with_frictionless(s, slice(-(count // 3), None))
        if kind == "thin":
            s = thinned(s, 10.0 ** rng.uniform(-3.0, -1.0))
        s = Sample(s.positions, s.normals, s.scale, weights_of(count))
        # where closure is about to be lost, answers in registers of two widths differ in the sixth
        # digit
        if depth(s) > (0.02 if kind == "thin" else 0.08):
            found.append(s)
    return tuple(found)


def depth(s: Sample) -> float:
    """Depth of the shallowest contact of an internal force in its cone, as a part of the largest
    force; 0 without closure."""
    if s.placement.verdict != 0:
        return 0.0
    row = insides.AnyOptimizer.make(s.placement).start(np.zeros(6), START["internal_force"])
    if row[CODE] != STARTED:
        return 0.0
    first = FORCE + 3 * s.count
    u, o, t = (row[first : first + 3 * s.count] * s.scale.reshape(-1)).reshape(-1, 3).T
    return float((u - np.hypot(o, t)).min() / u.max())


def placed(s: Sample, torsion: float = 0.0) -> _core.Contacts:
    """The contacts of a sample as the core stores them; bad geometry is kept for the core to judge."""
    return _core.Contacts.put(
        s.positions, s.normals, s.scale, np.full(s.count, torsion), np.zeros((0, 3))
    )


def solved(
    method: str,
    given: list[_core.Contacts],
    loads: np.ndarray,
    first: np.ndarray | None = None,
    tolerance: float | None = None,
    limit: int = 200,
) -> np.ndarray:
    """(M, record_size) of one call; `first` says where the wrenches of each grasp begin, by default
    one for each."""
    count = given[0].count
    size = _core.record_size(count)
    begin = np.arange(len(given) + 1.0) if first is None else first
    rows = np.full((len(loads), size + 10 * count), -7.0)
    CALLS[method](
        given, weights_of(count), begin, (tolerance or TOLERANCES[method], limit), loads, rows
    )
    for k, contacts in enumerate(given):
        for row in rows[int(begin[k]) : int(begin[k + 1])]:
            if row[CODE] == 0.0:
                frames = np.ravel(contacts.frames)
                np.testing.assert_array_equal(row[size : size + 9 * count], frames)
    return rows[:, :size]


def alone(method: str, s: Sample, load: np.ndarray) -> np.ndarray:
    """(record_size,) of the solver of one problem."""
    made = insides.AnyOptimizer.make(
        s.placement, method=3 * (method == "conic"), tolerance=TOLERANCES[method]
    )
    return made.solve(load)[0][: _core.record_size(s.count)]


def last_digits(method: str, s: Sample, load: np.ndarray, forces: slice) -> float:
    """By how much the forces move with the last digits of the wrench [N]."""
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (6, 6))
    moved = [alone(method, s, load * (1.0 + np.finfo(float).eps * sign))[forces] for sign in signs]
    return float(np.ptp(moved, axis=0).max())


@each_method
@pytest.mark.parametrize("kind", ["hard", "frictionless", "thin"])
@pytest.mark.parametrize("count", [3, 4, 9])
def test_the_answers_of_single_solves(method, kind, count):
    given = grasps(count, kind)
    rng = np.random.default_rng(count)
    loads = wrenches(rng, len(given)) * 10.0 ** rng.uniform(-3.0, 0.5, (len(given), 1))
    records = solved(method, [placed(s) for s in given], loads)
    digits = 1e-5 if kind == "thin" else 1e-9
    forces = slice(FORCE, FORCE + 6 * count)
    exact = [CODE, ITERATIONS]
    nu = slice(MULTIPLIERS, MULTIPLIERS + 6)
    left = records[:, CODE] == REFUSED
    assert left.mean() < (0.5 if kind == "thin" else 0.01)
    for k in np.flatnonzero(~left):
        s = given[k]
        load = loads[k]
        record = records[k]
        one = alone(method, s, load)
        near = digits * np.abs(one[forces]).max()
        if np.abs(record[forces] - one[forces]).max() > near:  # one grasp has fewer digits
            near = 2.0 * last_digits(method, s, load, forces)
        np.testing.assert_array_equal(record[exact], one[exact])
        np.testing.assert_allclose(record[forces], one[forces], rtol=0, atol=near)
        np.testing.assert_allclose(
            record[[OBJECTIVE, BOUND]], one[[OBJECTIVE, BOUND]], rtol=10 * digits
        )
        np.testing.assert_allclose(
            record[nu], one[nu], rtol=0, atol=100 * digits * np.abs(one[nu]).max()
        )
        assert record[MARGIN] == pytest.approx(one[MARGIN], abs=near)
        assert record[RESIDUAL] <= 1e-9 * np.abs(load).max()
        np.testing.assert_array_equal(record[WRENCH : WRENCH + 6], load)


@each_method
@pytest.mark.parametrize("count", [3, 9])
def test_what_is_not_ordinary_is_left(method, count):
    """Contacts of little or no rank, no force closure, soft contacts, bad numbers, wrenches of
    nothing; the others keep their bits."""
    given = list(grasps(count, "hard"))
    loads = wrenches(np.random.default_rng(count), len(given))
    before = solved(method, [placed(s) for s in given], loads)
    s = given[5]
    given[1], given[5] = thinned(s, 1e-5), thinned(s, 0.0)
    given[6] = Sample(s.positions, np.tile([0.0, 0.0, 1.0], (count, 1)), s.scale, s.weights)
    given[7] = Sample(
        np.where(np.arange(3) == 1, np.nan, s.positions), s.normals, s.scale, s.weights
    )
    given[8] = Sample(s.positions, 1.01 * s.normals, s.scale, s.weights)
    loads[9], loads[10] = 0.0, np.inf
    contacts = [placed(sample, 0.01 * (k == 3)) for k, sample in enumerate(given)]
    records = solved(method, contacts, loads)
    assert (records[[3, 5, 6, 7, 8, 10], CODE] == REFUSED).all()
    left = records[:, CODE] == REFUSED
    assert not records[left, FORCE : FORCE + 6 * count].any()
    np.testing.assert_array_equal(
        records[left][:, [OBJECTIVE, BOUND]], np.tile([np.inf, -np.inf], (left.sum(), 1))
    )
    assert records[9, CODE] in (0.0, REFUSED)
    np.testing.assert_array_equal(records[[0, 2, 4]], before[[0, 2, 4]])
    for wrong in (None, 3, placed(grasps(5, "hard")[0])):
        with pytest.raises(TypeError, match="contacts"):
            solved(method, [*contacts[:-1], wrong], loads)


@each_method
@pytest.mark.parametrize("count", [3, 9])
def test_no_answer_depends_on_its_neighbours(method, count):
    given = [placed(s) for s in grasps(count, "hard")]
    rng = np.random.default_rng(count)
    own = rng.integers(0, 20, len(given)) * (rng.uniform(size=len(given)) < 0.7) + (
        np.arange(len(given)) % 3
    )
    first = np.append(0, np.cumsum(own))
    loads = wrenches(rng, int(first[-1])) * 10.0 ** rng.uniform(-2.0, 2.0, (int(first[-1]), 1))
    records = solved(method, given, loads, first.astype(float))
    assert (records[:, CODE] == 0.0).all()
    order = rng.permutation(len(given))
    rows = np.concatenate([np.arange(first[u], first[u + 1]) for u in order])
    begin = np.append(0, np.cumsum(own[order])).astype(float)
    np.testing.assert_array_equal(
        solved(method, [given[u] for u in order], loads[rows], begin), records[rows]
    )
    for u, sample in enumerate(given):
        part = slice(first[u], first[u + 1])
        np.testing.assert_array_equal(
            solved(method, [sample], loads[part], np.array([0.0, own[u]])), records[part]
        )


@each_method
def test_the_limit_of_iterations_leaves_problems(method):
    loads = wrenches(np.random.default_rng(1), 11, 100.0)
    rows = solved(method, [placed(s) for s in grasps(4, "hard")], loads, None, 1e-8, 2)
    assert (rows[:, CODE] == REFUSED).all()

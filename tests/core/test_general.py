"""The general program as real-time code has it: the room that it takes, where it starts, and what follows faster algorithms."""

from __future__ import annotations

from functools import cache

import _core_test as insides
import numpy as np
import pytest
from cases import CONVERGED, EXCEEDED, FIELDS, INFEASIBLE, LIMIT, STALLED, Case, case, shared_limits
from samples import Sample, sample
from test_optimizer import at, nu_of

GOOD, TORN, RANK_LOST = range(3)  # how `place` ends
DEEPEST, GIVEN, CARRIED = range(3)  # where `phi` starts
NOTHING = np.zeros(0)
LOAD = np.array([0.7, -0.4, 0.9, 0.011, -0.007, 0.013])
_TWO = Sample(
    np.array([[0.001, 0.0, -0.02], [0.0, 0.002, 0.021]]), np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]),
    np.tile([0.5, 1.0, 1.0], (2, 1)), np.tile([1.0, 0.01], (2, 1)),
)  # fmt: skip
PINCH = Case(_TWO, np.full(2, 0.005))
CASES = {
    "pinch": PINCH,
    "hard": case(4, "hard"),
    "soft": case(4, "all soft"),
    "mixed": case(5, "some soft"),
    "hard, normals": Case(sample(4), np.zeros(4), {"min_normal": np.full(4, 0.1), "max_normal": np.full(4, 9.0)}),
    "soft, normals": Case(sample(4), case(4, "all soft").gamma, {"max_normal": np.full(4, 3.4)}),
    "hard, own joints": case(4, "own limits", 1),
    "hard, torques": case(4, "shared limits"),
    "all": case(5, "soft limits"),
    "tight": Case(sample(5), case(5, "some soft").gamma, shared_limits(sample(5), 0, 0.4)),
}
LOADS = {"pinch": LOAD * [1, 1, 1, 0.3, 0.3, 0.1]}
each_case = pytest.mark.parametrize("name", CASES)


@cache
def problem_of(name: str) -> insides.GeneralProblem:
    c = CASES[name]
    joints = c.jacobian.shape[2]
    given = (c.limits.get(key, NOTHING) for key in ("min_normal", "max_normal"))
    torques = (c.limits.get(key, np.zeros(joints)) for key in ("torque_limit", "torque_bias"))
    return insides.GeneralProblem(c.placement, c.torsion_divisor, *given, np.ascontiguousarray(c.jacobian), *torques)


def made(name: str, contacts: int = 0, limits: int = 0) -> insides.General:
    """Placed in a program of its own size, or of a larger one."""
    c = CASES[name]
    general = insides.General(contacts or c.count, limits or len(c.sizes) + int(c.soft.sum()), True)
    assert general.place(problem_of(name), True, NOTHING) == GOOD
    return general


def solved(general: insides.General, load: np.ndarray, what: str, tolerance: float, limit: int = 1000):
    """The record, and all prices."""
    if what == "phi":
        return general.phi(load, DEEPEST, NOTHING, NOTHING, tolerance, limit)[:2]
    return general.conic(load, what == "largest", tolerance, limit)[:2]


@each_case
def test_a_larger_room_gives_the_same_bits(name: str) -> None:
    """And so does one that held other contacts before."""
    load, own, wide = LOADS.get(name, LOAD), made(name), made(name, 9, 60)
    none = insides.General(0, 0, False)  # takes its room when it is asked for
    assert none.place(problem_of(name), True, NOTHING) == GOOD
    used = made("all", 12, 80)
    used.phi(LOAD, DEEPEST, NOTHING, NOTHING, 1e-6, 100)
    assert used.place(problem_of(name), True, NOTHING) == GOOD
    for what in ("sum", "largest", "phi"):
        want = solved(own, load, what, 1e-6)
        assert at(want[0], "code") == (INFEASIBLE if name == "tight" else CONVERGED)
        for other in (wide, none, used):
            for mine, part in zip(solved(other, load, what, 1e-6), want, strict=True):
                np.testing.assert_array_equal(mine, part)


@pytest.mark.skipif(not insides.counts_allocations, reason="the sanitizers have an operator new of their own")
def test_nothing_is_allocated() -> None:
    """Contacts and limits of all kinds in a room for the largest, and each in its own; feasible or not."""
    rng = np.random.default_rng(4)
    loads = 2.0 * rng.standard_normal((20, 6)) * [1, 1, 1, 0.05, 0.05, 0.05]
    loads = np.concatenate([[LOAD, 0.0 * LOAD, 1e-12 * LOAD], loads, 10.0 * loads])
    general = insides.General(5, max(len(c.sizes) + int(c.soft.sum()) for c in CASES.values()), True)
    count, ended = general.allocations([problem_of(name) for name in CASES], loads, 1200)
    assert count == 0
    assert min(ended[CONVERGED], ended[INFEASIBLE], ended[EXCEEDED]) > 20
    for name, c in CASES.items():
        own = insides.General(c.count, len(c.sizes), bool(c.soft.any()))
        load = LOADS.get(name, LOAD)
        assert own.allocations([problem_of(name)], np.array([load, -load, 30.0 * load]), 30)[0] == 0


def test_starts_of_phi() -> None:
    """A force that is balanced and strictly inside is where it starts; else one carried over, else the deepest."""
    c, general = CASES["soft, normals"], made("soft, normals")

    def begin(start: int, force: np.ndarray, torsion: np.ndarray, load: np.ndarray = LOAD) -> np.ndarray:
        record, *_ = general.phi(load, start, force.reshape(-1), torsion, 1e-6, 1000)
        assert at(record, "code") == CONVERGED
        return c.forces(record, "initial")[0]

    code, margin, _, force, torsion = general.deepest(LOAD)
    assert (code, margin > 0.0) == (CONVERGED, True)
    missed, slack = general.misses(LOAD, force, torsion)
    assert missed < 1e-12
    assert slack > 0.0
    np.testing.assert_allclose(begin(DEEPEST, NOTHING, NOTHING), force, atol=1e-12)
    optimum, *_ = general.phi(LOAD, DEEPEST, NOTHING, NOTHING, 1e-6, 1000)
    best, turn = (part.copy() for part in c.forces(optimum))
    assert np.abs(turn).max() > 1e-5
    np.testing.assert_allclose(begin(GIVEN, best, turn), best, atol=1e-12)
    assert at(general.phi(LOAD, GIVEN, best, turn, 1e-6, 1000)[0], "iterations") <= 1
    # not balanced, outside the limits
    for wrong in (1.01, 9.0):
        np.testing.assert_allclose(begin(GIVEN, wrong * best, turn), force, atol=1e-12)
    assert general.misses(LOAD, 1.01 * best, turn)[0] > 1e-3
    assert general.misses(LOAD, 90.0 * best, turn)[1] < 0.0
    # carried to another wrench by the least change in (u, o, t, w)
    other, z = LOAD * 1.0005, c.z(optimum)
    forces = slice(3 * c.count)
    narrow = np.hstack([c.matrix[:, forces], -c.matrix[:, 3 * c.count :]])
    narrow[:, 0 : 3 * c.count : 3] += c.matrix[:, 3 * c.count :]
    change = np.linalg.pinv(narrow) @ (c.matrix @ z + c.contacts.unit @ other)
    wanted = (z[forces] - change[forces]) / c.contacts.divisor.reshape(-1)
    np.testing.assert_allclose(begin(CARRIED, best, turn, other), wanted, atol=1e-12)
    # of a wrench next to nothing that of none
    code, _, _, rest, _ = general.deepest(np.zeros(6))
    assert code == CONVERGED
    np.testing.assert_allclose(begin(DEEPEST, NOTHING, NOTHING, 1e-10 * LOAD), rest, atol=1e-8)


def test_going_on_from_phi_that_stalled() -> None:
    c, general = CASES["hard, normals"], made("hard, normals")
    best, *_ = general.phi(LOAD, DEEPEST, NOTHING, NOTHING, 1e-6, 1000)
    start, *_ = general.phi(LOAD, DEEPEST, NOTHING, NOTHING, 1e-6, 1)
    assert at(start, "code") == LIMIT
    start[FIELDS["code"]], start[FIELDS["iterations"]] = STALLED, 7.0
    found, *_ = general.go_on(start, "phi", 1e-6, 1000)
    assert at(found, "code") == CONVERGED
    assert at(found, "objective") == pytest.approx(at(best, "objective"), rel=1e-6)
    assert at(found, "iterations") > 7.0
    np.testing.assert_array_equal(c.forces(found, "initial")[0], c.forces(start, "initial")[0])
    # the limit counts the steps that were made
    cut, *_ = general.go_on(start, "phi", 1e-6, 9)
    assert (at(cut, "code"), at(cut, "iterations")) == (LIMIT, 9.0)
    assert at(cut, "objective") < at(start, "objective")
    for rest in ("phi", "conic", "excess"):
        np.testing.assert_array_equal(general.go_on(start, rest, 1e-6, 7)[0], start)
    # nothing to gain, or another end
    np.testing.assert_array_equal(general.go_on(best, "phi", 1e-6, 1000)[0], best)
    best[FIELDS["code"]] = STALLED
    np.testing.assert_array_equal(general.go_on(best, "phi", 1e-6, 1000)[0], best)
    start[FIELDS["code"]] = LIMIT
    np.testing.assert_array_equal(general.go_on(start, "phi", 1e-6, 1000)[0], start)


def test_going_on_from_least_forces_that_stalled() -> None:
    general = made("hard")
    best, *_ = general.conic(LOAD, False, 1e-8, 1000)
    rough = best.copy()
    for name, value in (
        ("code", STALLED), ("objective", 1.1 * at(best, "objective")), ("lower_bound", 0.5 * at(best, "lower_bound")),
        ("iterations", 11.0),
    ):  # fmt: skip
        rough[FIELDS[name]] = value
    found, *_ = general.go_on(rough, "conic", 1e-8, 1000)
    assert at(found, "code") == CONVERGED
    assert at(found, "objective") == at(best, "objective")
    assert at(found, "iterations") == at(best, "iterations") + 11.0
    assert at(general.go_on(rough, "conic", 1e-8, 14)[0], "iterations") <= 14.0
    # neither holds a digit: the proof
    s = sample(4)
    upward = insides.place(s.positions, np.tile([0.0, 0.0, 1.0], (4, 1)), s.scale, s.weights)
    lost = insides.General(4, 0, False)
    none = insides.GeneralProblem(upward, np.full(4, np.inf), NOTHING, NOTHING, np.zeros((4, 4, 0)), NOTHING, NOTHING)
    assert lost.place(none, False, NOTHING) == GOOD
    rough[FIELDS["lower_bound"]] = 0.0
    found, *_ = lost.go_on(rough, "conic", 1e-8, 1000)
    assert at(found, "code") == INFEASIBLE
    assert nu_of(found) @ LOAD > 0.0


@pytest.mark.parametrize("limit", [0, 1, 3, 6])
def test_the_limit_ends_all_attempts_together(limit: int) -> None:
    for name in ("soft", "hard, torques", "all"):
        for what in ("sum", "largest", "phi"):
            record, _ = solved(made(name), LOAD, what, 1e-14, limit)
            assert at(record, "iterations") <= limit
            assert at(record, "code") == LIMIT


def test_what_cannot_be_placed() -> None:
    general, s = insides.General(4, 20, True), sample(4)
    assert general.place(problem_of("pinch"), True, NOTHING) == GOOD
    assert general.place(problem_of("pinch"), False, NOTHING) == RANK_LOST  # it is torsion that holds
    assert general.place(problem_of("hard"), False, NOTHING) == GOOD

    def verdict(positions: np.ndarray, bias: float = 0.0, jacobian: float = 0.0) -> int:
        placement = insides.place(positions, s.normals, s.scale, s.weights)
        torques = np.full((4, 4, 2), jacobian), np.ones(2), np.array([0.0, bias])
        problem = insides.GeneralProblem(placement, np.full(4, np.inf), NOTHING, NOTHING, *torques)
        return general.place(problem, True, NOTHING)

    assert verdict(s.positions) == GOOD
    assert verdict(s.positions * [1.0, 0.0, 0.0]) == RANK_LOST
    assert verdict(s.positions, bias=np.nan) == TORN
    assert verdict(s.positions, jacobian=np.inf) == TORN

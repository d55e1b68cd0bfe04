"""The general program as real-time code has it: what `ForceProgram` and what follows it find, without a heap allocation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import _core_test as insides
import numpy as np
import pytest
from force.clarabel_reference import KINDS, Reference, random_limits, random_wrench, some_grasp
from force.general_problems import CUBOID, LOAD, NAMES, PINCH, PROBLEMS, mixed, soft

from grasp_env.core import codes
from grasp_env.force import ForceLimits
from grasp_env.force.limits import LimitArrays
from grasp_env.force.program import ForceProgram
from grasp_env.force.record import (
    BOUND,
    CODE,
    CONVERGED,
    FORCE,
    INFEASIBLE,
    ITERATIONS,
    LIMIT,
    LIMITS_EXCEEDED,
    MULTIPLIERS,
    OBJECTIVE,
    REFUSED,
    RESIDUAL,
    STALLED,
    WRENCH,
    record_size,
)
from grasp_env.grasp import Grasp

GOOD, TORN, RANK_LOST = range(3)  # how `place` ends
DEEPEST, GIVEN, CARRIED = range(3)  # where `phi` starts
NOTHING = np.zeros(0)
WEIGHTS = (1.0, 0.01)


def in_contact_frames(grasp: Grasp, given: LimitArrays) -> LimitArrays:
    """With the Jacobian (N, 4, J) along (normal, o, t) and about the normal."""
    along = np.einsum("nik,nij->nkj", grasp.frames, given.jacobian[:, :3])
    about = np.einsum("ni,nij->nj", grasp.normals, given.jacobian[:, 3:])
    return given._replace(jacobian=np.concatenate([along, about[:, None]], axis=1))


@dataclass(frozen=True)
class Asked:
    """A grasp within limits, as Python has it and as the core."""

    grasp: Grasp
    limits: ForceLimits | None = None
    weights: tuple[float, float] = WEIGHTS

    @property
    def count(self) -> int:
        return self.grasp.n_contacts

    @cached_property
    def each(self) -> np.ndarray:
        """(N, 2) omega and lambda, that of lambda another at every contact."""
        omega, lam = self.weights
        return np.column_stack([np.full(self.count, omega), lam * np.linspace(0.7, 1.6, self.count)])

    @cached_property
    def program(self) -> ForceProgram:
        return ForceProgram(self.grasp, self.limits, elastic=True)

    @cached_property
    def problem(self) -> insides.GeneralProblem:
        grasp = self.grasp
        placement = insides.place(grasp.positions, grasp.normals, grasp.models.cone_scale, self.each)
        given = (ForceLimits() if self.limits is None else self.limits).checked(self.count)
        return insides.GeneralProblem(placement, self.program.torsion_divisor, *in_contact_frames(grasp, given))

    def made(self, contacts: int = 0, limits: int = 0, any_soft: bool = True) -> insides.General:
        """Placed in a program of its own size, or of a larger one."""
        general = insides.General(contacts or self.count, limits or len(self.program.bound), any_soft)
        assert general.place(self.problem, any_soft, NOTHING) == GOOD
        return general


def record_of(asked: Asked, load: np.ndarray, what: str, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """(record, prices) of `ForceProgram`, with what the package does where it has no force."""
    program = asked.program
    if what in ("sum", "max"):
        record, prices = program.least_force(load, what, tolerance)
        if record[CODE] != REFUSED:
            return record, prices
    deepest = program.deepest(load)
    if what == "phi" and deepest.code == CONVERGED:
        return program.least_phi(load, asked.each, deepest.z, tolerance, float("nan"), 1000, NOTHING)
    record = np.zeros(record_size(asked.count))
    record[CODE] = INFEASIBLE if deepest.code == INFEASIBLE else codes()["undecided"]
    if deepest.twist is not None:
        record[OBJECTIVE], record[MULTIPLIERS : MULTIPLIERS + 6] = np.inf, deepest.twist
    return record, np.zeros(len(program.bound))


def solved(general: insides.General, load: np.ndarray, what: str, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    if what == "phi":
        record, prices, _ = general.phi(load, DEEPEST, NOTHING, NOTHING, tolerance, 1000)
    else:
        record, prices, _ = general.conic(load, what == "max", tolerance, 1000)
    return record, prices


def agree(asked: Asked, load: np.ndarray, what: str, tolerance: float = 1e-8) -> np.ndarray:
    """The core's record, which is Python's."""
    record, prices = solved(asked.made(), load, what, tolerance)
    want, wanted = record_of(asked, load, what, tolerance)
    assert record[CODE] == want[CODE]
    np.testing.assert_array_equal(record[WRENCH : WRENCH + 6], load)
    if record[CODE] != CONVERGED:
        if record[CODE] == INFEASIBLE:
            assert np.isinf(record[OBJECTIVE])
            twist = record[MULTIPLIERS : MULTIPLIERS + 6]
            assert np.abs(twist).max() == pytest.approx(1.0)
            np.testing.assert_array_equal(record[FORCE : FORCE + 7 * asked.count], 0.0)
        return record
    assert record[OBJECTIVE] == pytest.approx(want[OBJECTIVE], rel=1e-9)
    assert record[OBJECTIVE] - record[BOUND] <= 1.01 * tolerance * record[OBJECTIVE]
    assert record[RESIDUAL] <= 1e-9 * (np.abs(load).max() + np.abs(record[FORCE : FORCE + 3 * asked.count]).max())
    if what == "phi":  # where the optimum is one point, and the prices are its
        own = np.r_[
            FORCE : FORCE + 3 * asked.count, FORCE + 6 * asked.count : FORCE + 7 * asked.count
        ]  # want's start is its end
        np.testing.assert_allclose(record[own], want[own], atol=1e-3 * np.abs(want[own]).max())
        np.testing.assert_allclose(prices, wanted, atol=1e-2 * np.abs(wanted).max(initial=0.0))
    return record


@pytest.mark.parametrize("what", ["sum", "max", "phi"])
@pytest.mark.parametrize("name", NAMES)
def test_named_problems(name: str, what: str) -> None:
    grasp, load, limits = PROBLEMS[name]
    assert agree(Asked(grasp, limits), load, what)[CODE] == CONVERGED


@pytest.mark.parametrize("what", ["sum", "max", "phi"])
@pytest.mark.parametrize("kind", KINDS)
def test_random_problems(kind: str, what: str) -> None:
    """All contacts, normal limits and joints that fingers share, feasible or not, over ten decades of wrenches."""
    rng = np.random.default_rng(len(kind) + 10 * len(what))
    ended = set()
    for k in range(24):
        grasp = some_grasp(rng, kind, most=8)
        load = random_wrench(rng, grasp)
        size = float(np.abs(Reference(grasp).load(load)).max())
        limits = random_limits(rng, grasp, size) if k % 3 else None
        ended.add(agree(Asked(grasp, limits, (1.0, 0.01 * size * size)), load, what)[CODE])
    assert {CONVERGED, INFEASIBLE} <= ended


@pytest.mark.parametrize("what", ["sum", "phi"])
def test_joints_of_one_finger(what: str) -> None:
    rng = np.random.default_rng(3)
    for limit in (2.0, 0.5, 0.1, 0.02):
        jacobian = np.zeros((4, 6, 12))
        for k in range(4):
            jacobian[k, :, 3 * k : 3 * k + 3] = 0.08 * rng.standard_normal((6, 3))
        limits = ForceLimits(jacobian=jacobian, torque_limit=limit, torque_bias=0.02 * rng.standard_normal(12))
        for grasp in (CUBOID, soft()):
            agree(Asked(grasp, limits), LOAD, what)


@pytest.mark.parametrize("kind", ["hard", "soft", "mixed"])
def test_the_least_excess(kind: str) -> None:
    rng = np.random.default_rng(len(kind))
    exceeded = ended_alike = 0
    while exceeded < 12:
        grasp = some_grasp(rng, kind, most=8)
        load = random_wrench(rng, grasp)
        asked = Asked(grasp, random_limits(rng, grasp, float(np.abs(Reference(grasp).load(load)).max())))
        general = asked.made()
        refuted, *_ = general.conic(load, False, 1e-6, 1000)
        found, *_ = general.go_on(refuted, "excess", 1e-6, 1000)
        if refuted[CODE] != INFEASIBLE:
            np.testing.assert_array_equal(found, refuted)
            continue
        want = asked.program.least_excess(load)
        if want[CODE] != LIMITS_EXCEEDED:
            np.testing.assert_array_equal(found, refuted)
            continue
        assert found[CODE] == LIMITS_EXCEEDED
        sooner = refuted[ITERATIONS] + want[ITERATIONS] - found[ITERATIONS]
        assert abs(sooner) <= 1  # rounding may decide whether an iterate is good enough, to a hundredth
        assert found[OBJECTIVE] == pytest.approx(want[OBJECTIVE], rel=1e-2 if sooner else 1e-9)
        ended_alike += not sooner
        exceeded += 1
    assert ended_alike >= 11


@pytest.mark.parametrize("name", NAMES)
def test_a_larger_room_gives_the_same_bits(name: str) -> None:
    """And so does one that held other contacts before."""
    grasp, load, limits = PROBLEMS[name]
    asked = Asked(grasp, limits)
    own, wide = asked.made(), asked.made(9, 60)
    none = insides.General(0, 0, False)  # takes its room when it is asked for
    assert none.place(asked.problem, True, NOTHING) == GOOD
    used = Asked(mixed(), PROBLEMS["all"][2]).made(12, 80)
    used.phi(LOAD, DEEPEST, NOTHING, NOTHING, 1e-6, 100)
    assert used.place(asked.problem, True, NOTHING) == GOOD
    for what in ("sum", "max", "phi"):
        want = solved(own, load, what, 1e-6)
        for other in (wide, none, used):
            for mine, part in zip(solved(other, load, what, 1e-6), want, strict=True):
                np.testing.assert_array_equal(mine, part)


@pytest.mark.skipif(not insides.counts_allocations, reason="the sanitizers have an operator new of their own")
def test_nothing_is_allocated() -> None:
    """Contacts and limits of all kinds in a room for the largest, feasible or not."""
    rng = np.random.default_rng(4)
    asked = [Asked(grasp, limits) for grasp, _, limits in PROBLEMS.values()]
    while len(asked) < 40:
        grasp = some_grasp(rng, str(rng.choice(KINDS)), most=7)
        asked.append(Asked(grasp, random_limits(rng, grasp, 1.0)))
    loads = np.concatenate(
        [[LOAD, 0.0 * LOAD, 1e-12 * LOAD], 2.0 * rng.standard_normal((20, 6)) * [1, 1, 1, 0.05, 0.05, 0.05]]
    )
    general = insides.General(max(each.count for each in asked), max(len(each.program.bound) for each in asked), True)
    made, ended = general.allocations([each.problem for each in asked], loads, 1200)
    assert made == 0
    assert min(ended[CONVERGED], ended[INFEASIBLE], ended[LIMITS_EXCEEDED]) > 20


@pytest.mark.skipif(not insides.counts_allocations, reason="the sanitizers have an operator new of their own")
@pytest.mark.parametrize("name", NAMES)
def test_the_room_is_enough_for_each(name: str) -> None:
    grasp, load, limits = PROBLEMS[name]
    asked = Asked(grasp, limits)
    given = len(asked.program.bound) - int(asked.program.soft.sum())
    general = insides.General(asked.count, given, bool(asked.program.soft.any()))
    assert general.allocations([asked.problem], np.array([load, -load, 30.0 * load]), 30)[0] == 0


def test_prices_are_of_the_limits_as_given() -> None:
    grasp, load, limits = PROBLEMS["soft, normals"]
    asked = Asked(grasp, limits)
    for what in ("sum", "phi"):
        general = asked.made()
        _, every, given = (
            general.conic(load, False, 1e-9, 100)
            if what == "sum"
            else general.phi(load, DEEPEST, NOTHING, NOTHING, 1e-9, 100)
        )
        _, want = record_of(asked, load, what, 1e-9)
        np.testing.assert_allclose(every, want, atol=1e-5 * want.max())
        np.testing.assert_array_equal(given, every[int(asked.program.soft.sum()) :])
        assert given.max() > 0.0


def test_starts_of_phi() -> None:
    """A force that is balanced and strictly inside is where it starts; else one carried over, else the deepest."""
    asked = Asked(soft(), ForceLimits(max_normal=6.0))
    general, count = asked.made(), 4
    initial = slice(FORCE + 3 * count, FORCE + 6 * count)

    def begin(start: int, force: np.ndarray, torsion: np.ndarray, load: np.ndarray = LOAD) -> np.ndarray:
        record, *_ = general.phi(load, start, force.reshape(-1), torsion, 1e-6, 1000)
        assert record[CODE] == CONVERGED
        return record[initial]

    code, margin, _, force, torsion = general.deepest(LOAD)
    assert (code, margin > 0.0) == (CONVERGED, True)
    missed, slack = general.misses(LOAD, force, torsion)
    assert missed < 1e-12
    assert slack > 0.0
    np.testing.assert_allclose(begin(DEEPEST, NOTHING, NOTHING), force, atol=1e-12)
    optimum, *_ = general.phi(LOAD, DEEPEST, NOTHING, NOTHING, 1e-6, 1000)
    best, turn = optimum[FORCE : FORCE + 3 * count].copy(), optimum[FORCE + 6 * count : FORCE + 7 * count].copy()
    assert np.abs(turn).max() > 1e-5
    np.testing.assert_allclose(begin(GIVEN, best, turn), best, atol=1e-12)
    assert general.phi(LOAD, GIVEN, best, turn, 1e-6, 1000)[0][ITERATIONS] <= 1
    # not balanced, outside the limits
    np.testing.assert_allclose(begin(GIVEN, 1.01 * best, turn), force, atol=1e-12)
    assert general.misses(LOAD, 1.01 * best, turn)[0] > 1e-3
    assert general.misses(LOAD, 9.0 * best, turn)[1] < 0.0
    np.testing.assert_allclose(begin(GIVEN, 9.0 * best, turn), force, atol=1e-12)
    # carried to another wrench by the least change
    other = LOAD * 1.05
    z = asked.program.balanced(asked.program.variables(best.reshape(-1, 3), turn), other)
    np.testing.assert_allclose(begin(CARRIED, best, turn, other), asked.program.force(z).reshape(-1), atol=1e-12)
    # of a wrench next to nothing that of none
    code, _, _, rest, _ = general.deepest(np.zeros(6))
    assert code == CONVERGED
    np.testing.assert_allclose(begin(DEEPEST, NOTHING, NOTHING, 1e-10 * LOAD), rest, atol=1e-8)


def test_going_on_from_phi_that_stalled() -> None:
    asked = Asked(CUBOID, PROBLEMS["hard, normals"][2])
    general = asked.made()
    best, *_ = general.phi(LOAD, DEEPEST, NOTHING, NOTHING, 1e-6, 1000)
    start, *_ = general.phi(LOAD, DEEPEST, NOTHING, NOTHING, 1e-6, 1)
    assert start[CODE] == LIMIT
    start[CODE], start[ITERATIONS] = STALLED, 7.0
    found, *_ = general.go_on(start, "phi", 1e-6, 1000)
    assert found[CODE] == CONVERGED
    assert found[OBJECTIVE] == pytest.approx(best[OBJECTIVE], rel=1e-6)
    assert found[ITERATIONS] > 7.0
    np.testing.assert_array_equal(found[FORCE + 12 : FORCE + 24], start[FORCE + 12 : FORCE + 24])
    # the limit counts the steps that were made
    cut, *_ = general.go_on(start, "phi", 1e-6, 9)
    assert (cut[CODE], cut[ITERATIONS]) == (LIMIT, 9.0)
    assert cut[OBJECTIVE] < start[OBJECTIVE]
    for rest in ("phi", "conic", "excess"):
        np.testing.assert_array_equal(general.go_on(start, rest, 1e-6, 7)[0], start)
    # nothing to gain, or another end
    np.testing.assert_array_equal(general.go_on(best, "phi", 1e-6, 1000)[0], best)
    best[CODE] = STALLED
    np.testing.assert_array_equal(general.go_on(best, "phi", 1e-6, 1000)[0], best)
    start[CODE] = LIMIT
    np.testing.assert_array_equal(general.go_on(start, "phi", 1e-6, 1000)[0], start)


def test_going_on_from_least_forces_that_stalled() -> None:
    asked = Asked(CUBOID)
    general = asked.made()
    best, *_ = general.conic(LOAD, False, 1e-8, 1000)
    rough = best.copy()
    rough[CODE], rough[OBJECTIVE], rough[BOUND], rough[ITERATIONS] = (
        STALLED,
        1.1 * best[OBJECTIVE],
        0.5 * best[BOUND],
        11.0,
    )
    found, *_ = general.go_on(rough, "conic", 1e-8, 1000)
    assert found[CODE] == CONVERGED
    assert found[OBJECTIVE] == best[OBJECTIVE]
    assert found[ITERATIONS] == best[ITERATIONS] + 11.0
    cut, *_ = general.go_on(rough, "conic", 1e-8, 14)
    assert cut[ITERATIONS] <= 14.0
    # neither holds a digit: the proof
    lost = Asked(Grasp.from_contacts(CUBOID.positions, [[0.0, 0.0, 1.0]] * 4, 0.4)).made()
    rough[BOUND] = 0.0
    found, *_ = lost.go_on(rough, "conic", 1e-8, 1000)
    assert found[CODE] == INFEASIBLE


@pytest.mark.parametrize("limit", [0, 1, 3, 6])
def test_the_limit_ends_all_attempts_together(limit: int) -> None:
    for name in ("soft", "hard, torques", "all"):
        grasp, load, limits = PROBLEMS[name]
        general = Asked(grasp, limits).made()
        for record, *_ in (
            general.conic(load, False, 1e-12, limit), general.conic(load, True, 1e-12, limit),
            general.phi(load, DEEPEST, NOTHING, NOTHING, 1e-14, limit),
        ):  # fmt: skip
            assert record[ITERATIONS] <= limit
            assert record[CODE] == LIMIT


def test_an_internal_force_spares_one_to_be_found() -> None:
    for name in ("hard, torques", "hard, normals", "soft"):
        grasp, load, limits = PROBLEMS[name]
        asked = Asked(grasp, limits)
        own, given = asked.made(), asked.made()
        rest = Asked(grasp).made().deepest(np.zeros(6))[3]
        want, *_ = own.conic(load, False, 1e-10, 100)
        assert given.place(asked.problem, True, rest) == GOOD
        found, *_ = given.conic(load, False, 1e-10, 100)
        assert found[OBJECTIVE] == pytest.approx(want[OBJECTIVE], rel=1e-9)
        assert given.place(asked.problem, True, -rest) == GOOD  # none: it finds its own
        np.testing.assert_array_equal(given.conic(load, False, 1e-10, 100)[0], want)


def test_what_cannot_be_placed() -> None:
    pinch = Asked(PINCH)
    general = insides.General(4, 20, True)
    assert general.place(pinch.problem, True, NOTHING) == GOOD
    assert general.place(pinch.problem, False, NOTHING) == RANK_LOST  # it is torsion that holds
    assert general.place(Asked(CUBOID).problem, False, NOTHING) == GOOD

    def verdict(positions: np.ndarray, **torn: np.ndarray) -> int:
        placement = insides.place(positions, CUBOID.normals, CUBOID.models.cone_scale, Asked(CUBOID).each)
        given = ForceLimits(jacobian=np.zeros((4, 6, 2)), torque_limit=1.0).checked(4)
        given = in_contact_frames(CUBOID, given)._replace(**torn)
        return general.place(insides.GeneralProblem(placement, np.full(4, np.inf), *given), True, NOTHING)

    assert verdict(CUBOID.positions) == GOOD
    assert verdict(CUBOID.positions * [1.0, 0.0, 0.0]) == RANK_LOST
    assert verdict(CUBOID.positions, torque_bias=np.array([0.0, np.nan])) == TORN
    assert verdict(CUBOID.positions, jacobian=np.full((4, 4, 2), np.inf)) == TORN


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e13])
def test_a_wrench_of_no_number_is_refused(bad: float) -> None:
    general = Asked(CUBOID).made()
    load = LOAD.copy()
    load[3] = bad
    assert general.conic(load, False, 1e-6, 100)[0][CODE] == REFUSED
    assert general.phi(load, DEEPEST, NOTHING, NOTHING, 1e-6, 100)[0][CODE] == REFUSED
    assert general.deepest(load)[0] == REFUSED

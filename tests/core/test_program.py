"""The general program's interior point, one to four iterations deep, against its dense twin `oracles.interior_point`, and its parts."""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import _core_test as insides
import numpy as np
import pytest
from oracles.interior_point import ConicProgram, Iterate, nt_step
from problems import GRASPS

from grasp_env.force import ForceLimits
from grasp_env.force.program import ForceProgram
from grasp_env.force.record import LIMIT
from grasp_env.grasp import Grasp

LOAD = np.array([0.7, -0.4, 0.9, 0.011, -0.007, 0.013])
CUBOID = GRASPS["cuboid, 4"]


class Asked(NamedTuple):
    """A program on dense rows: the first `equal` are equations."""

    rows: np.ndarray
    coupling: np.ndarray
    right: np.ndarray
    equal: int
    cost: np.ndarray
    shared_cost: np.ndarray
    soft: np.ndarray


def soft_grasp(base: Grasp, models: str | list[str] = "soft") -> Grasp:
    return Grasp.from_contacts(
        base.positions, base.normals, base.friction, contact_model=models, torsional_friction=0.004
    )


def jacobian(count: int, rows: int = 3, joints: int = 3) -> np.ndarray:
    """Every joint moves every contact: rows that couple them."""
    return 0.08 * np.random.default_rng(3).standard_normal((count, rows, joints))


def fingers(count: int) -> np.ndarray:
    """Three joints a contact, which move no other."""
    out = np.zeros((count, 3, 3 * count))
    for k in range(count):
        out[k, :, 3 * k : 3 * k + 3] = 0.08 * np.random.default_rng(k).standard_normal((3, 3))
    return out


MIXED = ["hard", "soft", "hard", "frictionless", "soft"]
OWN = ForceLimits(min_normal=[0.2, 0.0, 0.3, 0.1], max_normal=[9.0, 5.0, np.inf, 5.0])
COUPLED = ForceLimits(0.05, 8.0, jacobian(5, 6), 0.9)
CASES = {
    "hard, 3": (GRASPS["tripod, uneven"], None),
    "hard, 4": (CUBOID, None),
    "soft": (soft_grasp(CUBOID), None),
    "mixed": (soft_grasp(GRASPS["cuboid, 5, uneven"], MIXED), None),
    "hard, own limits": (CUBOID, OWN),
    "hard, own joints": (CUBOID, ForceLimits(jacobian=fingers(4), torque_limit=0.5)),
    "soft, own limits": (soft_grasp(CUBOID), OWN),
    "hard, coupled": (CUBOID, ForceLimits(jacobian=jacobian(4), torque_limit=0.5)),
    "mixed, all limits": (soft_grasp(GRASPS["cuboid, 5, uneven"], MIXED), COUPLED),
}


def asked_of(name: str, kind: str) -> Asked:
    """The least sum, the least maximum, or the deepest force."""
    program = ForceProgram(*CASES[name])
    count, limits = program.grasp.n_contacts, len(program.bound)
    unit = program.frame @ LOAD
    rows, right = np.concatenate([program.balance, program.rows]), np.concatenate([-unit, program.bound])
    cost, price = np.zeros((count, 4)), 1.0 / program.grasp.models.cone_divisor[:, 0]
    if kind == "sum":
        cost[:, 0] = price
        return Asked(rows, np.zeros((len(rows), 0)), right, 6, cost, np.zeros(0), program.soft)
    if kind == "max":
        largest = np.zeros((count, count, 4))
        largest[np.arange(count), np.arange(count), 0] = price
        coupling = np.concatenate([np.zeros((len(rows), 1)), -np.ones((count, 1))])
        rows, right = np.concatenate([rows, largest]), np.concatenate([right, np.zeros(count)])
        return Asked(rows, coupling, right, 6, cost, np.ones(1), program.soft)
    inward, total = np.zeros((count, 4)), np.zeros((1, count, 4))
    inward[:, 0], inward[:, 3], total[0, :, 0] = 1.0, program.soft, 1.0
    coupling = np.zeros((8 + limits, 2))
    coupling[:6, 0], coupling[:6, 1], coupling[6] = np.einsum("rna,na->r", program.balance, inward), unit, (count, 1.0)
    coupling[7:-1, 0] = np.einsum("rna,na->r", program.rows, inward) + 1.0
    coupling[7:-1, 1], coupling[-1] = -program.bound, (1.0, -1.0)
    rows = np.concatenate([program.balance, total, program.rows, np.zeros((1, count, 4))])
    return Asked(rows, coupling, np.eye(len(rows))[6], 7, cost, np.array([-1.0, 0.0]), program.soft)


class State(NamedTuple):
    """Its variables: y the multipliers of all rows, slack of those that are limits."""

    z: np.ndarray
    s: np.ndarray
    t: np.ndarray
    y: np.ndarray
    slack: np.ndarray


def inside(rng: np.random.Generator) -> np.ndarray:
    x = rng.standard_normal(3)
    x[0] = np.linalg.norm(x[1:]) + rng.uniform(0.01, 1.0)
    return x


def cold(asked: Asked) -> State:
    units = np.tile([1.0, 0.0, 0.0, 1.0], (len(asked.cost), 1))
    y = np.concatenate([np.zeros(asked.equal), np.ones(len(asked.right) - asked.equal)])
    return State(units, units.copy(), np.zeros(len(asked.shared_cost)), y, np.maximum(1.0, asked.right))


def anywhere(asked: Asked, rng: np.random.Generator) -> State:
    """Any start strictly inside: nothing is feasible, nothing symmetric."""
    z, s = (
        np.column_stack([[inside(rng) for _ in asked.cost], rng.uniform(0.2, 2.0, len(asked.cost))]) for _ in range(2)
    )
    z[~asked.soft, 3] = s[~asked.soft, 3] = 1.0
    y = rng.standard_normal(len(asked.right))
    y[asked.equal :] = rng.uniform(0.2, 2.0, len(y) - asked.equal)
    return State(z, s, rng.standard_normal(len(asked.shared_cost)), y, rng.uniform(0.2, 2.0, len(y)))


def dense(asked: Asked) -> ConicProgram:
    """Cones of the contacts, then w of soft contacts, then slacks of the limits."""
    m, count = len(asked.right), len(asked.cost)
    limits = m - asked.equal
    matrix = np.hstack([asked.rows[:, :, :3].reshape(m, -1), asked.rows[:, asked.soft, 3], np.eye(m)[:, asked.equal :]])
    cost = np.concatenate([asked.cost[:, :3].reshape(-1), asked.cost[asked.soft, 3], np.zeros(limits)])
    sizes = (3,) * count + (1,) * (int(asked.soft.sum()) + limits)
    return ConicProgram(
        matrix, asked.right, cost, asked.coupling, asked.shared_cost, sizes, len(sizes), (0.9, 0.095), 1e-10
    )  # fmt: skip


def flat(asked: Asked, state: State) -> Iterate:
    """The variables as the twin's; the multiplier of a limit is its slack's dual."""
    z, s, t, y, slack = state
    x = np.concatenate([z[:, :3].reshape(-1), z[asked.soft, 3], slack[asked.equal :]])
    return Iterate(x, np.concatenate([s[:, :3].reshape(-1), s[asked.soft, 3], y[asked.equal :]]), t, y)


def run(asked: Asked, start: State, limit: int, twice: bool = False) -> tuple[State, int, int, float]:
    rows, coupling, right, equal, cost, shared_cost, soft = asked
    *state, code, iterations, objective = insides.interior_point(
        rows, coupling, right, equal, cost, shared_cost, soft.astype(float), *start, limit, twice
    )
    return State(*state), code, iterations, objective


@pytest.mark.parametrize("twice", [False, True])
@pytest.mark.parametrize("kind", ["sum", "max", "deepest"])
@pytest.mark.parametrize("name", ["hard, own joints", "mixed, all limits"])
def test_the_factored_system_is_solved(name: str, kind: str, twice: bool) -> None:
    """Without the refinement, which would make good most errors."""
    rng = np.random.default_rng(9)
    asked = asked_of(name, kind)
    count, m, shares = len(asked.cost), len(asked.right), len(asked.shared_cost)
    shapes, lines = rng.standard_normal((count, 3, 3)) + 2.0 * np.eye(3), rng.uniform(0.5, 2.0, count)
    diagonal = np.concatenate([np.zeros(asked.equal), rng.uniform(0.1, 2.0, m - asked.equal)])
    fz, ft, fy = rng.standard_normal((count, 4)), rng.standard_normal(shares), rng.standard_normal(m)
    e, t, y, *left = insides.row_system(
        asked.rows, asked.coupling, asked.equal, diagonal, shapes, lines, fz, ft, fy, twice
    )
    whole = np.zeros((count, 4, 4))
    whole[:, :3, :3], whole[:, 3, 3] = shapes, lines
    turned = np.einsum("rna,nab->rnb", asked.rows, whole)
    made = (
        e + np.einsum("rna,r->na", turned, y),
        asked.coupling.T @ y,
        np.einsum("rna,na->r", turned, e) + asked.coupling @ t - diagonal * y,
    )
    size = max(1.0, np.abs(y).max())
    for side, mine, rest in zip((fz, ft, fy), made, left, strict=True):
        np.testing.assert_allclose(mine, side, rtol=0, atol=1e-10 * size)
        np.testing.assert_allclose(rest, side - mine, rtol=0, atol=1e-12 * size)


def test_rows_of_one_contact_lose_no_digits() -> None:
    """A limit of each contact that binds (diagonal 1e-14) in a wide block: the normal equations would lose all digits."""
    rng = np.random.default_rng(4)
    asked = asked_of("hard, own joints", "sum")
    count, m = len(asked.cost), len(asked.right)
    shapes, lines = np.tile(1e3 * np.eye(3), (count, 1, 1)), np.ones(count)
    diagonal = np.concatenate([np.zeros(6), np.where(np.arange(m - 6) % 6 == 0, 1e-14, 1e3)])
    sides = rng.standard_normal((count, 4)), np.zeros(0), rng.standard_normal(m)
    e, t, y, *_ = insides.row_system(asked.rows, asked.coupling, 6, diagonal, shapes, lines, *sides)
    want = insides.row_system(asked.rows, asked.coupling, 6, diagonal, shapes, lines, *sides, True)
    for mine, right in zip((e, t, y), want[:3], strict=True):
        np.testing.assert_allclose(mine, right, rtol=0, atol=1e-6 * np.abs(right).max(initial=0.0))


@pytest.mark.parametrize("kind", ["sum", "max", "deepest"])
@pytest.mark.parametrize("name", CASES)
def test_interior_point_takes_the_twins_steps(name: str, kind: str) -> None:
    asked = asked_of(name, kind)
    assert len(asked.shared_cost) == {"sum": 0, "max": 1, "deepest": 2}[kind]
    program = dense(asked)
    for start in (cold(asked), anywhere(asked, np.random.default_rng(len(name)))):
        at = flat(asked, start)
        for k in range(1, 5):
            before, at = at, nt_step(program, at)
            for twice in (False, True):
                state, code, iterations, objective = run(asked, start, k, twice)
                assert (code, iterations) == (LIMIT, k)
                for part, want, old in zip(flat(asked, state), at, before, strict=True):
                    size = max(1.0, np.abs(want).max(initial=0.0))
                    np.testing.assert_allclose(part, want, rtol=0, atol=1e-8 * size)
                    assert part.size == 0 or np.abs(want - old).max() > 1e-7 * size
                assert objective == pytest.approx(program.cost @ at.x + program.shared_cost @ at.t, rel=1e-8, abs=1e-8)


def test_cases_hold_what_they_promise() -> None:
    asked = {name: asked_of(name, "sum") for name in CASES}
    assert not asked["hard, 4"].soft.any()
    assert asked["mixed"].soft.tolist() == [False, True, False, False, True]
    contacts = {
        name: [int((row != 0.0).any(axis=1).sum()) for row in each.rows[each.equal :]] for name, each in asked.items()
    }
    assert contacts["hard, 4"] == []
    assert set(contacts["hard, own limits"]) == set(contacts["hard, own joints"]) == {1}
    assert set(contacts["hard, coupled"]) == {4}
    assert set(contacts["mixed, all limits"]) == {1, 5}


@pytest.mark.parametrize("name", ["hard, 4", "hard, own joints", "mixed, all limits"])
def test_the_twin_ends_where_the_core_does(name: str) -> None:
    asked = asked_of(name, "sum")
    program, at = dense(asked), flat(asked, cold(asked))
    for _ in range(12):
        at = nt_step(program, at)
    assert at.x @ at.s < 1e-6 * abs(program.cost @ at.x)
    state, _, _, objective = run(asked, cold(asked), 60)
    assert program.cost @ at.x == pytest.approx(objective, rel=1e-6)
    assert -program.right @ at.y == pytest.approx(objective, rel=1e-6)
    assert state.z[:, 0].min() > 0.0


def test_a_wrong_rule_is_seen() -> None:
    """What the comparisons above would let through if they were too coarse."""
    asked = asked_of("soft, own limits", "max")
    program, start = dense(asked), cold(asked)
    for wrong in (
        program._replace(reach=(0.9, 0.09)),
        program._replace(counted=program.counted - 1),
        program._replace(reach=(0.9001, 0.095)),
    ):
        at = flat(asked, start)
        for _ in range(4):
            at = nt_step(wrong, at)
        state, *_ = run(asked, start, 4)
        assert np.abs(flat(asked, state).x - at.x).max() > 1e-6


@pytest.mark.parametrize("what", ["+", "-", "*", "/", "sqrt"])
def test_twice_has_thirty_digits(what: str) -> None:
    """Against fractions, over 1e-20 to 1e20 and where two nearly cancel."""
    rng = np.random.default_rng(8)
    for k in range(400):
        high = rng.standard_normal(2) * 10.0 ** rng.uniform(-20.0, 20.0, 2 if k % 2 else 1)
        if k % 5 == 0:
            high[1] = -high[0] * (1.0 + rng.uniform(-1e-12, 1e-12))
        a, b = (
            np.array([h, h * rng.uniform(-1e-17, 1e-17)])
            for h in (abs(high[0]) if what == "sqrt" else high[0], high[1])
        )
        p, q = (Fraction(x[0]) + Fraction(x[1]) for x in (a, b))
        got = sum(Fraction(x) for x in insides.twice(a, b, what))
        if what == "sqrt":
            assert abs(got * got - p) <= abs(p) * Fraction(1e-30)
            continue
        want = {"+": p + q, "-": p - q, "*": p * q, "/": p / q}[what]
        # a sum is as good as its parts
        size = abs(want)
        assert abs(got - want) <= size * Fraction(1e-30)


@pytest.mark.skipif(not insides.counts_allocations, reason="the sanitizers have an operator new of their own")
@pytest.mark.parametrize("name", ["mixed", "hard, own joints", "mixed, all limits"])
def test_nothing_is_allocated(name: str) -> None:
    """Least forces, least excesses, deepest forces and Newton on Phi, feasible or not."""
    program = ForceProgram(*CASES[name])
    divisor = np.concatenate([program.grasp.models.cone_divisor, program.torsion_divisor[:, None]], axis=1)
    loads = np.concatenate([[LOAD], np.random.default_rng(1).standard_normal((11, 6)) * [3, 3, 3, 0.1, 0.1, 0.1]])
    shares = np.concatenate([np.zeros(program.soft.sum()), np.ones(len(program.bound) - program.soft.sum())])
    made, converged, infeasible, exceeded = insides.program_allocations(
        program.frame, program.balance, program.rows, program.bound, divisor, shares, loads, 2000
    )
    assert made == 0
    assert converged > 0
    assert infeasible > 0 or name == "mixed"
    assert exceeded > 0

"""The general program's interior point, one to four iterations deep, against its dense twin `oracles.interior_point`, and its parts."""

from __future__ import annotations

from fractions import Fraction

import _core_test as insides
import numpy as np
import pytest
from cases import LIMIT, Case, case
from dense import Asked, State, asked_of, cold, flat, twin
from oracles.interior_point import nt_step
from samples import sample

LOAD = np.array([0.7, -0.4, 0.9, 0.011, -0.007, 0.013])
NORMALS = {"min_normal": np.array([0.2, 0.0, 0.3, 0.1]), "max_normal": np.array([9.0, 5.0, np.inf, 5.0])}
CASES = {
    "hard, 3": case(3, "hard"),
    "hard, 4": case(4, "hard"),
    "soft": case(4, "all soft"),
    "mixed": case(5, "some soft"),
    "hard, own limits": Case(sample(4), np.zeros(4), NORMALS),
    "hard, own joints": case(4, "own limits", 1),
    "soft, own limits": Case(sample(4), case(4, "all soft").gamma, NORMALS),
    "hard, coupled": case(4, "shared limits"),
    "mixed, all limits": case(5, "soft limits"),
}
each_kind = pytest.mark.parametrize("kind", ["sum", "largest", "deepest"])


def inside(rng: np.random.Generator) -> np.ndarray:
    x = rng.standard_normal(3)
    x[0] = np.linalg.norm(x[1:]) + rng.uniform(0.01, 1.0)
    return x


def anywhere(asked: Asked, rng: np.random.Generator) -> State:
    """Any start strictly inside: nothing is feasible, nothing symmetric."""
    z, s = (
        np.column_stack([[inside(rng) for _ in asked.cost], rng.uniform(0.2, 2.0, len(asked.cost))]) for _ in range(2)
    )
    z[~asked.soft, 3] = s[~asked.soft, 3] = 1.0
    y = rng.standard_normal(len(asked.right))
    y[asked.equal :] = rng.uniform(0.2, 2.0, len(y) - asked.equal)
    return State(z, s, rng.standard_normal(len(asked.shared_cost)), y, rng.uniform(0.2, 2.0, len(y)))


def run(asked: Asked, start: State, limit: int, twice: bool = False) -> tuple[State, int, int, float]:
    rows, coupling, right, equal, cost, shared_cost, soft = asked
    *state, code, iterations, objective = insides.interior_point(
        rows, coupling, right, equal, cost, shared_cost, soft.astype(float), *start, limit, twice
    )
    return State(*state), code, iterations, objective


@pytest.mark.parametrize("twice", [False, True])
@each_kind
@pytest.mark.parametrize("name", ["hard, own joints", "mixed, all limits"])
def test_the_factored_system_is_solved(name: str, kind: str, twice: bool) -> None:
    """Without the refinement, which would make good most errors."""
    rng = np.random.default_rng(9)
    asked = asked_of(CASES[name], LOAD, kind)
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
    asked = asked_of(CASES["hard, own joints"], LOAD, "sum")
    count, m = len(asked.cost), len(asked.right)
    shapes, lines = np.tile(1e3 * np.eye(3), (count, 1, 1)), np.ones(count)
    diagonal = np.concatenate([np.zeros(6), np.where(np.arange(m - 6) % 6 == 0, 1e-14, 1e3)])
    sides = rng.standard_normal((count, 4)), np.zeros(0), rng.standard_normal(m)
    e, t, y, *_ = insides.row_system(asked.rows, asked.coupling, 6, diagonal, shapes, lines, *sides)
    want = insides.row_system(asked.rows, asked.coupling, 6, diagonal, shapes, lines, *sides, True)
    for mine, right in zip((e, t, y), want[:3], strict=True):
        np.testing.assert_allclose(mine, right, rtol=0, atol=1e-6 * np.abs(right).max(initial=0.0))


@each_kind
@pytest.mark.parametrize("name", CASES)
def test_interior_point_takes_the_twins_steps(name: str, kind: str) -> None:
    asked = asked_of(CASES[name], LOAD, kind)
    program = twin(asked)
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
        assert abs(got - want) <= abs(want) * Fraction(1e-30)

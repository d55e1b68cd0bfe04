"""The compiled interior points, one to four iterations deep, against their dense twins `oracles.conic` and `oracles.interior_point`."""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pytest
from oracles import conic
from oracles.interior_point import ConicProgram, Iterate, nt_step, per_boundary, scaling
from problems import GRASPS, PAPER_WRENCH, random_grasp

from grasp_env import core
from grasp_env.force import ForceLimits, Objective, record
from grasp_env.force.basis import core_contacts
from grasp_env.force.feasibility import phase_one
from grasp_env.force.program import ForceProgram
from grasp_env.force.program_kernels import boundary, factor, interior_point, missed, scaled, solve
from grasp_env.force.record import LIMIT
from grasp_env.grasp import Grasp

LOAD = np.array([0.7, -0.4, 0.9, 0.011, -0.007, 0.013])
CUBOID = GRASPS["cuboid, 4"]


# the twins themselves


def inside(rng: np.random.Generator, size: int) -> np.ndarray:
    x = rng.standard_normal(size)
    x[0] = np.linalg.norm(x[1:]) + rng.uniform(0.01, 1.0)
    return x


@pytest.mark.parametrize("size", [1, 3])
def test_the_scaling_takes_s_to_x_and_the_boundary_is_where_steps_end(size: int) -> None:
    rng = np.random.default_rng(size)
    bounded = 0
    for _ in range(50):
        x, s, d = inside(rng, size), inside(rng, size), rng.standard_normal(size)
        w = scaling(x, s)
        if size == 3:
            np.testing.assert_array_equal(conic.scaling(x, s), w)
            assert conic.per_boundary(x, d) == per_boundary(x, d)
        np.testing.assert_allclose(w @ w @ s, x, rtol=1e-10, atol=1e-10)
        j = np.array([1.0, -1.0, -1.0])[:size]
        form = w @ (j[:, None] * w)
        np.testing.assert_allclose(form, form[0, 0] * np.diag(j), atol=1e-10 * form[0, 0])
        inverse = per_boundary(x, d)
        if inverse > 0.0:
            end = x + d / inverse
            assert abs(end[0] - np.linalg.norm(end[1:])) < 1e-9 * (1.0 + np.abs(end).max())
            assert end[0] > -1e-9
            bounded += 1
        else:
            far = x + 1e6 * d
            assert far[0] >= np.linalg.norm(far[1:]) - 1e-6
    assert 10 < bounded < 50


def test_the_kernels_scaling_and_boundary_are_the_twins() -> None:
    rng = np.random.default_rng(2)
    for _ in range(50):
        x, s, d = inside(rng, 3), inside(rng, 3), rng.standard_normal(3)
        j = np.array([1.0, -1.0, -1.0])
        eta = np.sqrt((x @ (j * x)) / (s @ (j * s)))
        v = (x + eta * j * s) / np.sqrt((x + eta * j * s) @ (j * (x + eta * j * s)))
        np.testing.assert_allclose(scaled(*v, eta, *d), scaling(x, s) @ d, rtol=1e-9, atol=1e-9)
        assert boundary(*x, *d) == pytest.approx(per_boundary(x, d), rel=1e-9, abs=1e-12)


# core.Conic: hard contacts


@cache
def closed_grasp(count: int, kind: str) -> tuple[Grasp, np.ndarray]:
    """A random grasp with force closure and an internal force strictly inside, cone coordinates."""
    rng = np.random.default_rng(100 + count)
    while True:
        grasp = random_grasp(rng, count)
        if kind == "elliptic":
            both = np.column_stack([grasp.friction, rng.uniform(0.3, 1.0, count)])
            grasp = Grasp.from_contacts(grasp.positions, grasp.normals, both)
        elif kind == "last one frictionless":
            models = ["hard"] * (count - 1) + ["frictionless"]
            grasp = Grasp.from_contacts(grasp.positions, grasp.normals, grasp.friction, contact_model=models)
        found = phase_one(grasp, np.zeros(6))
        if found.force is not None and found.margin > 0.02:
            return grasp, grasp.to_cone(found.force)


def lanes_of(count: int) -> int:
    """Contacts that the core's registers hold together: 4 or 8 where they all fit, else as many as one register of this build."""
    if count <= 8:
        return 4 if count <= 4 else 8
    return {"AVX-512": 8, "AVX2": 4, "AVX": 4}.get(core.build_info()["instruction_set"], 2)


def inverse_of(grasp: Grasp) -> np.ndarray:
    """(3N, 6) of the unit frame: the least change of the force, not of the cone coordinates; G^+ of the columns in newtons."""
    scale = grasp.models.cone_scale.reshape(-1)
    return scale[:, None] * np.linalg.pinv(grasp.unit_frame @ grasp.cone_matrix * scale)


def program_of(grasp: Grasp, unit: np.ndarray, lanes: int) -> conic.Program:
    """The core's program: its empty lanes hold contacts without effect that limit the steps all the same."""
    return conic.padded(grasp.unit_frame @ grasp.cone_matrix, unit, grasp.models.cone_divisor, lanes)


@pytest.mark.parametrize(
    ("count", "kind"),
    [*((count, kind) for count in (3, 4, 5, 8, 9) for kind in ("round", "elliptic")), (8, "last one frictionless")],
)
def test_conic_takes_the_twins_steps(count: int, kind: str) -> None:
    grasp, rest = closed_grasp(count, kind)
    contacts = core_contacts(grasp, Objective())
    divisor = grasp.models.cone_divisor
    for load in (LOAD, 20.0 * PAPER_WRENCH):
        loaded = grasp.unit_frame @ load
        size = float(np.abs(loaded).max())
        program = program_of(grasp, loaded / size, lanes_of(count))
        at = conic.start(program, inverse_of(grasp), rest)
        first = size * at.x[: 3 * count].reshape(count, 3) / divisor
        seen = [first]
        for k in range(1, 5):
            at = conic.iteration(program, at)
            row = np.zeros(record.record_size(count))
            assert core.Conic.make(contacts, 1e-15, k, rest).solve(load, None, row) == LIMIT
            assert (row[record.CODE], row[record.ITERATIONS]) == (LIMIT, k)
            x = at.x[: 3 * count].reshape(count, 3)
            force, start = row[record.FORCE : record.FORCE + 6 * count].reshape(2, count, 3)
            near = 1e-9 * np.abs(force).max()
            np.testing.assert_allclose(start, first, rtol=0, atol=1e-11 * np.abs(first).max())
            np.testing.assert_allclose(force, size * x / divisor, rtol=0, atol=near)
            # y of the record is scaled onto the boundary of its set, and has the other sign
            pull = -(program.matrix.T @ at.y).reshape(-1, 3)
            theta = 1.0 / ((pull[:, 0] + np.hypot(pull[:, 1], pull[:, 2])) / program.cost[0::3]).max()
            nu = -theta * grasp.unit_frame.T @ at.y
            multipliers = row[record.MULTIPLIERS : record.MULTIPLIERS + 6]
            np.testing.assert_allclose(multipliers, nu, rtol=0, atol=1e-9 * np.abs(nu).max())
            assert row[record.BOUND] == pytest.approx(max(-nu @ load, 0.0), rel=1e-8, abs=near)
            assert conic.certified_bound(program, at.y)[0] * size == pytest.approx(max(-nu @ load, 0.0), rel=1e-9)
            seen.append(force)
        # every iteration moved: equal iterates would prove nothing
        assert all(np.abs(b - a).max() > 1e-6 * np.abs(b).max() for a, b in pairwise(seen))


@pytest.mark.parametrize(("count", "away"), [(3, 1e-5), (5, 1e-4), (4, 0.0), (8, 0.0)])
def test_empty_lanes_shorten_steps(count: int, away: float) -> None:
    """What the comparison above would miss if the twin left them out: nothing where all lanes are taken."""
    grasp, rest = closed_grasp(count, "round")
    unit = grasp.unit_frame @ LOAD
    unit /= np.abs(unit).max()
    padded, bare = program_of(grasp, unit, lanes_of(count)), program_of(grasp, unit, 1)
    at, other = (conic.start(program, inverse_of(grasp), rest) for program in (padded, bare))
    for _ in range(4):
        at, other = conic.iteration(padded, at), conic.iteration(bare, other)
    apart = np.abs(at.x[: 3 * count] - other.x).max() / np.abs(other.x).max()
    assert away <= apart <= (0.05 if away else 0.0)


@pytest.mark.parametrize(("count", "kind"), [(4, "round"), (5, "elliptic")])
def test_both_twins_take_one_step(count: int, kind: str) -> None:
    """`oracles.interior_point` without limits and shared variables is `oracles.conic`."""
    grasp, rest = closed_grasp(count, kind)
    program = program_of(grasp, grasp.unit_frame @ LOAD, 1)
    general = ConicProgram(
        *program[:3], np.zeros((6, 0)), np.zeros(0), (3,) * count, program.counted, program.reach, 0.0
    )  # fmt: skip
    at = conic.start(program, inverse_of(grasp), rest)
    other = Iterate(at.x, at.s, np.zeros(0), at.y)
    for _ in range(4):
        at, other = conic.iteration(program, at), nt_step(general, other)
        for mine, theirs in zip(at, (other.x, other.s, other.y), strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-9 * np.abs(theirs).max())


# program_kernels.interior_point: soft contacts, limits, shared variables


class Asked(NamedTuple):
    """What `ForceProgram` asks of `interior_point`."""

    first: np.ndarray
    touched: np.ndarray
    values: np.ndarray
    coupling: np.ndarray
    right: np.ndarray
    equal: int
    cost: np.ndarray
    shared_cost: np.ndarray
    soft: np.ndarray


class Recorder(ForceProgram):
    """Keeps what it asks for, first to last: `least_force` may go on to ask for the deepest force."""

    def _run(self, structure, coupling, right, equal, cost, shared_cost, tolerance, limit, absolute=1e-14):
        asked = Asked(*structure, coupling, right, equal, cost, shared_cost, self.soft)
        self.asked = [*getattr(self, "asked", []), asked]
        return super()._run(structure, coupling, right, equal, cost, shared_cost, tolerance, limit, absolute)


def soft_grasp(base: Grasp, models: str | list[str] = "soft") -> Grasp:
    return Grasp.from_contacts(
        base.positions, base.normals, base.friction, contact_model=models, torsional_friction=0.004
    )


def jacobian(count: int, rows: int = 3, joints: int = 3) -> np.ndarray:
    """Every joint moves every contact: rows that couple them."""
    return 0.08 * np.random.default_rng(3).standard_normal((count, rows, joints))


MIXED = ["hard", "soft", "hard", "frictionless", "soft"]
OWN = ForceLimits(min_normal=[0.2, 0.0, 0.3, 0.1], max_normal=[9.0, 5.0, np.inf, 5.0])
COUPLED = ForceLimits(0.05, 8.0, jacobian(5, 4), 0.9)
CASES = {
    "hard, 3": (GRASPS["tripod, uneven"], None),
    "hard, 4": (CUBOID, None),
    "soft": (soft_grasp(CUBOID), None),
    "mixed": (soft_grasp(GRASPS["cuboid, 5, uneven"], MIXED), None),
    "hard, own limits": (CUBOID, OWN),
    "soft, own limits": (soft_grasp(CUBOID), OWN),
    "hard, coupled": (CUBOID, ForceLimits(jacobian=jacobian(4), torque_limit=0.5)),
    "mixed, all limits": (soft_grasp(GRASPS["cuboid, 5, uneven"], MIXED), COUPLED),
}


def asked_of(name: str, kind: str) -> Asked:
    program = Recorder(*CASES[name])
    if kind == "deepest":
        program.deepest(LOAD)
    else:
        program.least_force(LOAD, kind)
    return program.asked[0]


class State(NamedTuple):
    """The kernel's variables."""

    z: np.ndarray
    t: np.ndarray
    y: np.ndarray
    s: np.ndarray
    slack: np.ndarray

    def copied(self) -> State:
        return State(*(part.copy() for part in self))


def cold(asked: Asked) -> State:
    """The start that `ForceProgram` takes."""
    units = np.tile([1.0, 0.0, 0.0, 1.0], (len(asked.cost), 1))
    y = np.concatenate([np.zeros(asked.equal), np.ones(len(asked.right) - asked.equal)])
    return State(units, np.zeros(len(asked.shared_cost)), y, units.copy(), np.maximum(1.0, asked.right))


def anywhere(asked: Asked, rng: np.random.Generator) -> State:
    """Any start strictly inside: nothing is feasible, nothing symmetric."""
    z, s = (
        np.column_stack([[inside(rng, 3) for _ in asked.cost], rng.uniform(0.2, 2.0, len(asked.cost))])
        for _ in range(2)
    )
    z[~asked.soft, 3] = s[~asked.soft, 3] = 1.0
    y = rng.standard_normal(len(asked.right))
    y[asked.equal :] = rng.uniform(0.2, 2.0, len(y) - asked.equal)
    return State(z, rng.standard_normal(len(asked.shared_cost)), y, s, rng.uniform(0.2, 2.0, len(y)))


def dense(asked: Asked) -> ConicProgram:
    """Cones of the contacts, then w of soft contacts, then slacks of the limits."""
    m, count = len(asked.right), len(asked.cost)
    rows = np.zeros((m, count, 4))
    for i in range(count):
        for j in range(asked.first[i], asked.first[i + 1]):
            rows[asked.touched[j], i] = asked.values[j]
    limits = m - asked.equal
    matrix = np.hstack([rows[:, :, :3].reshape(m, -1), rows[:, asked.soft, 3], np.eye(m)[:, asked.equal :]])
    cost = np.concatenate([asked.cost[:, :3].reshape(-1), asked.cost[asked.soft, 3], np.zeros(limits)])
    sizes = (3,) * count + (1,) * (int(asked.soft.sum()) + limits)
    return ConicProgram(
        matrix, asked.right, cost, asked.coupling, asked.shared_cost, sizes, len(sizes), (0.9, 0.09), 1e-10
    )  # fmt: skip


def flat(asked: Asked, state: State) -> Iterate:
    """The kernel's variables as the twin's; the multiplier of a limit is its slack's dual."""
    z, t, y, s, slack = state
    x = np.concatenate([z[:, :3].reshape(-1), z[asked.soft, 3], slack[asked.equal :]])
    return Iterate(x, np.concatenate([s[:, :3].reshape(-1), s[asked.soft, 3], y[asked.equal :]]), t, y)


def run(asked: Asked, start: State, limit: int) -> tuple[State, np.ndarray]:
    state, info = start.copied(), np.zeros(6)
    interior_point(*asked, 1e-15, 0.0, limit, *state, info)
    return state, info


@pytest.mark.parametrize("kind", ["sum", "max", "deepest"])
def test_the_factored_system_is_solved(kind: str) -> None:
    """Without the refinement, which would make good most errors."""
    rng = np.random.default_rng(9)
    asked = asked_of("mixed, all limits", kind)
    count, m, shares = len(asked.cost), len(asked.right), len(asked.shared_cost)
    root = rng.standard_normal((count, 4, 4))
    blocks = np.einsum("nij,nkj->nik", root, root) + np.eye(4)
    metric = np.linalg.inv(blocks)
    diagonal = np.concatenate([np.zeros(asked.equal), rng.uniform(0.1, 2.0, m - asked.equal)])
    schur, reduced, corner = np.empty((m, m)), np.empty((m, shares)), np.empty((shares, shares))
    columns = asked.first, asked.touched, asked.values
    assert factor(*columns, blocks, asked.coupling, diagonal, schur, reduced, corner)
    sides = rng.standard_normal((count, 4)), rng.standard_normal(shares), rng.standard_normal(m)
    found = np.empty((count, 4)), np.empty(shares), np.empty(m)
    solve(*columns, blocks, asked.coupling, schur, reduced, corner, *sides, *found)
    left = np.empty((count, 4)), np.empty(shares), np.empty(m)
    missed(*columns, metric, asked.coupling, diagonal, *sides, *found, *left)
    rows = np.zeros((m, count, 4))
    for i in range(count):
        for j in range(asked.first[i], asked.first[i + 1]):
            rows[asked.touched[j], i] = asked.values[j]
    de, dt, dy = found
    wanted = (
        np.einsum("nij,nj->ni", metric, de) + np.einsum("rna,r->na", rows, dy),
        asked.coupling.T @ dy,
        np.einsum("rna,na->r", rows, de) + asked.coupling @ dt - diagonal * dy,
    )
    size = max(1.0, np.abs(dy).max())
    for side, mine, rest in zip(sides, wanted, left, strict=True):
        np.testing.assert_allclose(mine, side, rtol=0, atol=1e-10 * size)
        np.testing.assert_allclose(rest, side - mine, rtol=0, atol=1e-12 * size)
    # and what a wrong answer misses
    found[0][0, 0] += 1.0
    missed(*columns, metric, asked.coupling, diagonal, *sides, *found, *left)
    np.testing.assert_allclose(left[0][0], -metric[0, :, 0], rtol=0, atol=1e-10 * size)
    np.testing.assert_allclose(left[2], -rows[:, 0, 0], rtol=0, atol=1e-10 * size)


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
            state, info = run(asked, start, k)
            assert (info[0], info[1]) == (LIMIT, k)
            for part, want, old in zip(flat(asked, state), at, before, strict=True):
                size = max(1.0, np.abs(want).max(initial=0.0))
                np.testing.assert_allclose(part, want, rtol=0, atol=1e-9 * size)
                assert part.size == 0 or np.abs(want - old).max() > 1e-7 * size
            assert info[2] == pytest.approx(program.cost @ at.x + program.shared_cost @ at.t, rel=1e-9, abs=1e-9)
            assert info[3] == pytest.approx(at.x @ at.s, rel=1e-8)
            misses = program.matrix @ at.x + program.coupling @ at.t - program.right
            largest = max(1.0, at.x[: 3 * len(asked.cost) : 3].max())
            # what starts at zero stays there, to rounding
            missed = float((np.abs(misses) / (largest + np.abs(program.right))).max())
            assert info[4] == pytest.approx(missed, rel=1e-6, abs=1e-12)


def test_cases_hold_what_they_promise() -> None:
    asked = {name: asked_of(name, "sum") for name in CASES}
    assert not asked["hard, 4"].soft.any()
    assert asked["mixed"].soft.tolist() == [False, True, False, False, True]
    contacts = {name: [int((a.touched == r).sum()) for r in range(a.equal, len(a.right))] for name, a in asked.items()}
    assert contacts["hard, 4"] == []
    assert set(contacts["hard, own limits"]) == {1}
    assert set(contacts["hard, coupled"]) == {4}
    assert set(contacts["mixed, all limits"]) == {1, 5}


@pytest.mark.parametrize("name", ["hard, 4", "mixed, all limits"])
def test_the_twin_ends_where_the_kernel_does(name: str) -> None:
    asked = asked_of(name, "sum")
    program, at = dense(asked), flat(asked, cold(asked))
    for _ in range(12):
        at = nt_step(program, at)
    assert at.x @ at.s < 1e-6 * abs(program.cost @ at.x)
    state, info = run(asked, cold(asked), 60)
    assert program.cost @ at.x == pytest.approx(info[2], rel=1e-6)
    assert -program.right @ at.y == pytest.approx(info[2], rel=1e-6)
    assert state.z[:, 0].min() > 0.0


def test_a_wrong_rule_is_seen() -> None:
    """What the comparisons above would let through if they were too coarse."""
    asked = asked_of("soft, own limits", "max")
    program, start = dense(asked), cold(asked)
    for wrong in (
        program._replace(reach=(0.9, 0.095)),
        program._replace(counted=program.counted - 1),
        program._replace(reach=(0.9001, 0.09)),
    ):
        at = flat(asked, start)
        for _ in range(4):
            at = nt_step(wrong, at)
        state, _ = run(asked, start, 4)
        assert np.abs(flat(asked, state).x - at.x).max() > 1e-6

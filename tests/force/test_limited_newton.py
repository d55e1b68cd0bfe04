"""`newton` within limits: whatever the answer, it holds; verdicts and least excesses against Clarabel; what goes to the general program."""

from __future__ import annotations

import pickle
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
from force.clarabel_reference import KINDS, SOLVED, Reference, _run, random_limits, random_wrench
from force.clarabel_reference import random_grasp as random_contacts
from force.test_hard_programs import clustered, near_closure
from grasp_env.force.program import ForceProgram
from problems import random_grasp

from grasp_env.errors import (
    GraspError,
    InfeasibleStartError,
    InfeasibleWrenchError,
    InvalidInputError,
)
from grasp_env.force import ForceLimits, ForceOptimizer, ForceSolution, Status, optimize_force, optimize_forces
from grasp_env.force.record import BOUND, CODE, EXCESS, LIMITS_EXCEEDED, MULTIPLIERS
from grasp_env.grasp import Grasp, presets
from grasp_env.quality import feasibility

CUBOID = presets.paper_cuboid()
LOAD = np.array([1.0, 0.5, -0.6, -0.1, 0.2, 0.0])


def own_joints(rng: np.random.Generator, count: int, each: int = 3) -> np.ndarray:
    """(N, 3, J) of fingers with `each` joints of their own, levers of some centimetres."""
    jacobian = np.zeros((count, 3, each * count))
    for k in range(count):
        jacobian[k, :, each * k : each * (k + 1)] = 0.05 * rng.standard_normal((3, each))
    return jacobian


def some_limits(rng: np.random.Generator, count: int, tight: float = 1.0) -> ForceLimits:
    """Torques of three or four joints a finger, some without limit, with bias; normal forces now and then."""
    each = int(rng.choice([2, 3, 4]))
    torque = tight * rng.uniform(0.1, 0.4, each * count)
    torque[rng.random(len(torque)) < 0.1] = np.inf
    given = {}
    if rng.random() < 0.4:
        given["max_normal"] = tight * rng.uniform(4.0, 12.0, count)
    if rng.random() < 0.3:
        given["min_normal"] = rng.uniform(0.0, 0.3, count)
    bias = 0.02 * rng.standard_normal(each * count)
    return ForceLimits(jacobian=own_joints(rng, count, each), torque_limit=torque, torque_bias=bias, **given)


def closed(rng: np.random.Generator, count: int) -> Grasp:
    """With force closure."""
    while True:
        grasp = random_grasp(rng, count)
        if feasibility(grasp, np.zeros(6)).feasible:
            return grasp


def loads(rng: np.random.Generator, number: int) -> np.ndarray:
    return rng.standard_normal((number, 6)) * [1.0, 1.0, 1.0, 0.03, 0.03, 0.03]


def outcome(optimizer: ForceOptimizer, load: np.ndarray) -> ForceSolution:
    """The solution, or that of the proof."""
    try:
        return optimizer.solve(load)
    except InfeasibleWrenchError as error:
        found = error.solution
    assert found is not None
    return found


def least(reference: Reference, limited: np.ndarray, load: np.ndarray) -> float:
    """The least excess by Clarabel: one more variable t, every limit raised by t of itself."""
    clarabel = import_module("clarabel")
    w = reference.load(load)
    size = float(np.abs(w).max())
    width = 4 * reference.count + 1
    blocks, right, cones = reference._cones(width, size)
    lengths = np.sqrt((reference.rows**2).sum(axis=(1, 2)))
    linear = next(k for k, cone in enumerate(cones) if "Nonnegative" in type(cone).__name__)
    blocks[linear][-len(lengths) :, -1] = -limited / size / lengths
    balance = np.zeros((6, width))
    balance[:, :-1] = reference.matrix.reshape(6, -1)
    cost = np.zeros(width)
    cost[-1] = 1.0
    found = _run(
        cost,
        np.vstack([balance, *blocks]),
        np.concatenate([-w / size, *right]),
        [clarabel.ZeroConeT(6), *cones],
        1e-9,
    )
    return found.obj_val if str(found.status) in SOLVED else float("nan")


def limits_of_rows(limits: ForceLimits, count: int) -> np.ndarray:
    """What each row of the reference is limited to, in its order."""
    checked = limits.checked(count)
    finite = checked.torque_limit[np.isfinite(checked.torque_limit)]
    normal = [checked.min_normal[checked.min_normal > 0.0], checked.max_normal[np.isfinite(checked.max_normal)]]
    return np.concatenate([*normal, np.repeat(finite, 2)])


@pytest.mark.parametrize("seed", range(12))
def test_whatever_the_answer_it_holds(seed: int) -> None:
    """OPTIMAL: balance, cones, limits. INFEASIBLE: a twist that separates, by Clarabel. LIMITS_EXCEEDED: least to a hundredth."""
    pytest.importorskip("clarabel")
    rng = np.random.default_rng(seed)
    grasp = CUBOID if seed % 3 == 0 else closed(rng, int(rng.integers(3, 8)))
    limits = some_limits(rng, grasp.n_contacts, 10.0 ** rng.uniform(-0.3, 0.3))
    reference, limited = Reference(grasp, limits), limits_of_rows(limits, grasp.n_contacts)
    plain = ForceOptimizer(grasp, method="newton", limits=limits)
    elastic = ForceOptimizer(grasp, method="newton", limits=limits, elastic=True)
    for load in loads(rng, 12):
        found, relaxed = outcome(plain, load), elastic.solve(load)
        margin = reference.margin(load)
        if abs(margin) > 1e-6:
            assert found.status is (Status.OPTIMAL if margin > 0.0 else Status.INFEASIBLE)
        for solution in (found, relaxed):
            if solution.status is Status.INFEASIBLE:
                continue
            size = float(np.abs(solution.force).max())
            assert reference.residual(solution.force, solution.torsion, load) < 1e-12 * size
            assert grasp.cone_margin(solution.force) > 0.0
            assert solution.cone_margin == pytest.approx(grasp.cone_margin(solution.force), abs=1e-12 * size)
        if found.status is Status.OPTIMAL:
            assert limits.violations(grasp, found.force, tolerance=0.0) == []
            assert (found.optimality_gap <= 1e-4, found.limit_excess) == (True, 0.0)
            np.testing.assert_array_equal(relaxed.force, found.force)
            assert relaxed.status is Status.OPTIMAL
            continue
        assert found.certificate is not None
        assert reference.separates(found.certificate, load) > 0.0
        assert relaxed.status is Status.LIMITS_EXCEEDED
        rows, bound, _ = limits.rows(grasp)
        forces = np.column_stack([relaxed.force, relaxed.torsion]).reshape(-1)
        assert relaxed.limit_excess == pytest.approx(((rows @ forces - bound) / limited).max(), rel=1e-9)
        assert relaxed.objective == relaxed.limit_excess
        want = least(reference, limited, load)
        assert relaxed.limit_excess <= max(1.01 * want, want + 1e-6) * (1.0 + 1e-6)
        assert relaxed.lower_bound <= want * (1.0 + 1e-6) + 1e-9


@pytest.mark.parametrize("seed", range(4))
def test_the_general_program_agrees(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    grasp = closed(rng, 4)
    limits = some_limits(rng, 4, 2.5)
    optimizer = ForceOptimizer(grasp, method="newton", limits=limits, tolerance=1e-10)
    optimal = 0
    for load in loads(rng, 10):
        found = outcome(optimizer, load)
        if found.status is Status.INFEASIBLE:
            assert not feasibility(grasp, load, limits).feasible
            continue
        optimal += 1
        want = optimizer.solve(load, trace=True)  # what studies ask goes to the general program
        assert found.status is want.status is Status.OPTIMAL
        assert found.objective == pytest.approx(want.objective, rel=2e-10)
        np.testing.assert_allclose(found.multipliers, want.multipliers, atol=1e-3 * np.abs(want.multipliers).max())
        # prices are lambda / slack^2, known to the root of the gap
        np.testing.assert_allclose(
            found.limit_multipliers, want.limit_multipliers, atol=1e-3 * want.limit_multipliers.max()
        )
    assert optimal > 2


def test_least_excess_of_joints_that_fingers_share_and_of_soft_contacts() -> None:
    """They go to the general program, in the same call; Clarabel knows the least."""
    pytest.importorskip("clarabel")
    rng, exceeded = np.random.default_rng(3), 0
    soft = Grasp.from_contacts(
        CUBOID.positions, CUBOID.normals, 0.5, contact_model="soft", torsional_friction=0.005
    )  # fmt: skip
    for grasp in (CUBOID, soft):
        for method in ("newton", "conic"):
            limits = ForceLimits(jacobian=0.05 * rng.standard_normal((4, 3, 5)), torque_limit=rng.uniform(0.05, 0.1, 5))
            reference, limited = Reference(grasp, limits), limits_of_rows(limits, 4)
            plain = ForceOptimizer(grasp, method=method, limits=limits)
            elastic = ForceOptimizer(grasp, method=method, limits=limits, elastic=True)
            for load in 2.0 * loads(rng, 6):
                found, relaxed = outcome(plain, load), elastic.solve(load)
                if found.status is not Status.INFEASIBLE:
                    assert relaxed.status is found.status
                    continue
                exceeded += 1
                want = least(reference, limited, load)
                assert relaxed.status is Status.LIMITS_EXCEEDED
                assert want * (1.0 - 1e-6) <= relaxed.limit_excess <= max(1.01 * want, want + 1e-6)
                assert reference.residual(relaxed.force, relaxed.torsion, load) < 1e-9
                assert relaxed.cone_margin > 0.0
    assert exceeded > 8


@pytest.mark.parametrize("kind", [*KINDS, "near closure", "clustered", "flat"])
@pytest.mark.parametrize(
    "seeds", [range(25), pytest.param(range(25, 600), marks=pytest.mark.slow)], ids=["few", "many"]
)
def test_least_excess_of_any_contacts_and_limits(kind: str, seeds: range) -> None:
    """To a hundredth of Clarabel's, balanced, inside the cones; none where Clarabel finds no force in the cones either."""
    pytest.importorskip("clarabel")
    exceeded = 0
    for seed in seeds:
        rng = np.random.default_rng([seed, 1212])
        try:
            if kind in ("near closure", "clustered"):
                grasp = (near_closure if kind == "near closure" else clustered)(rng)
            elif kind == "flat":
                grasp = random_contacts(rng, "mixed", flat=10.0 ** rng.uniform(-6.0, -2.0), most=8)
            else:
                grasp = random_contacts(rng, kind, most=8)
        except GraspError:
            continue  # rank lost
        load = random_wrench(rng, grasp, 1e-3, 1e3)
        limits = random_limits(rng, grasp, float(np.abs(load[:3]).max()) * 10.0 ** rng.uniform(-1.5, 0.3))
        reference, limited = Reference(grasp, limits), limits_of_rows(limits, grasp.n_contacts)
        method = "conic" if seed % 2 else "newton"
        try:
            found = ForceOptimizer(grasp, method=method, limits=limits, elastic=True).solve(load)
        except InfeasibleWrenchError:
            assert Reference(grasp).margin(load) < 1e-8
            continue
        except GraspError:
            continue  # the limits' own verdict is open
        if found.status is not Status.LIMITS_EXCEEDED:
            continue
        want = least(reference, limited, load)
        if np.isnan(want):
            continue
        exceeded += 1
        assert found.limit_excess <= max(1.01 * want, want + 1e-6) * (1.0 + 1e-6), (seed, found, want)
        assert found.lower_bound <= want * (1.0 + 1e-5) + 1e-7, (seed, found, want)
        size = max(float(np.abs(found.force).max()), float(np.abs(reference.load(load)).max()))
        assert reference.residual(found.force, found.torsion, load) <= 1e-9 * size
        assert found.cone_margin > 0.0
        assert Reference(grasp).violation(found.force, found.torsion) <= 0.0
    assert exceeded >= len(seeds) // 10


def test_both_least_excesses_agree() -> None:
    rng = np.random.default_rng(4)
    limits = ForceLimits(jacobian=own_joints(rng, 4), torque_limit=0.1)
    optimizer = ForceOptimizer(CUBOID, method="newton", limits=limits, elastic=True)
    exceeded = [(load, s) for load in loads(rng, 12) if (s := optimizer.solve(load)).status is Status.LIMITS_EXCEEDED]
    assert len(exceeded) > 3
    general = ForceProgram(CUBOID, limits, elastic=True)
    for load, found in exceeded:
        other = general.least_excess(load)
        assert other[CODE] == LIMITS_EXCEEDED
        assert found.lower_bound <= other[EXCESS] * (1.0 + 1e-9)
        assert other[BOUND] <= found.limit_excess * (1.0 + 1e-9)
        assert found.limit_excess == pytest.approx(other[EXCESS], rel=0.01)
        prices = other[MULTIPLIERS : MULTIPLIERS + 6]
        # multipliers of balance: a bound for every wrench
        for bound, multipliers in ((found.lower_bound, found.multipliers), (other[BOUND], prices)):
            for wrench, excess in ((wrench, solution.limit_excess) for wrench, solution in exceeded):
                assert bound - multipliers @ (wrench - load) <= excess * (1.0 + 1e-9)
        with pytest.raises(InfeasibleWrenchError, match="exceeds"):
            found.raise_for_status()


def test_a_path_follows_the_previous_optimum() -> None:
    rng = np.random.default_rng(5)
    limits = ForceLimits(jacobian=own_joints(rng, 4), torque_limit=0.25)
    cold = ForceOptimizer(CUBOID, method="newton", limits=limits)
    warm = ForceOptimizer(CUBOID, method="newton", limits=limits, initial="previous")
    steps = []
    for part in np.linspace(0.0, 1.0, 50):
        load = (1.0 - 2.0 * part) * 0.5 * LOAD
        want, found = cold.solve(load), warm.solve(load)
        assert found.status is Status.OPTIMAL
        # both certified to 1e-4
        assert found.objective == pytest.approx(want.objective, rel=1e-4)
        steps.append(found.iterations)
    assert warm.previous is not None
    assert warm.previous.initial == "previous"
    assert np.median(steps[1:]) <= 2


def test_starts() -> None:
    rng = np.random.default_rng(6)
    limits = ForceLimits(jacobian=own_joints(rng, 4), torque_limit=0.6, max_normal=9.0)
    optimizer = ForceOptimizer(CUBOID, method="newton", limits=limits, tolerance=1e-9)
    want = optimizer.solve(LOAD)
    assert want.initial == "internal_force"
    inside = optimize_force(CUBOID, 0.9 * LOAD, method="newton", limits=limits)
    names = ["linear_combination", "single_value", "phase_one", "previous", inside, want.force, lambda g, w: want.force]
    for start in names:
        found = optimizer.solve(LOAD, initial=start)
        assert found.objective == pytest.approx(want.objective, rel=2e-9)
        assert CUBOID.cone_margin(found.initial_force) > 0.0
        # the first step from another wrench's force is what balances it
        assert start is inside or CUBOID.residual(found.initial_force, LOAD) < 1e-8
    # any force inside the cones is a start
    beyond = optimize_force(CUBOID, LOAD, method="newton", barrier_weight=10.0).force
    assert limits.violations(CUBOID, beyond) != []
    assert optimizer.solve(LOAD, initial=beyond).objective == pytest.approx(want.objective, rel=2e-9)
    with pytest.raises(InfeasibleStartError, match="misses balance"):
        optimizer.solve(1.1 * LOAD, initial=want.force)
    # studies: the general program's
    traced = optimizer.solve(LOAD, trace=True)
    assert (np.diff(traced.objective_trace) <= 0.0).all()
    assert traced.objective == pytest.approx(want.objective, rel=2e-9)
    assert optimizer.solve(LOAD, optimum=want.objective).optimality_gap <= 1e-9


def test_iteration_limits_never_leave_the_limits() -> None:
    rng = np.random.default_rng(7)
    limits = ForceLimits(jacobian=CUBOID.frames @ own_joints(rng, 4), torque_limit=0.25)
    ends = set()
    for most in range(12):
        found = outcome(ForceOptimizer(CUBOID, method="newton", limits=limits, max_iterations=most), LOAD)
        ends.add(found.status)
        assert limits.violations(CUBOID, found.force, tolerance=0.0) == []
    assert ends == {Status.OPTIMAL, Status.ITERATION_LIMIT}


def test_the_proof_tells_itself() -> None:
    limits = ForceLimits(jacobian=own_joints(np.random.default_rng(8), 4), torque_limit=0.02)
    with pytest.raises(
        InfeasibleWrenchError,
        match="no force strictly inside the friction cones, and limits where there are any, balances wrench",
    ) as caught:
        optimize_force(CUBOID, 3.0 * LOAD, method="newton", limits=limits)
    again = pickle.loads(pickle.dumps(caught.value))
    assert "separates it" in str(again) == str(again)
    solution = caught.value.solution
    assert solution is not None
    assert (solution.status, solution.objective, solution.lower_bound) == (Status.INFEASIBLE, np.inf, np.inf)
    np.testing.assert_array_equal(solution.force, 0.0)


def test_solutions_and_optimizers_are_pickled_and_moved() -> None:
    rng = np.random.default_rng(9)
    limits = ForceLimits(jacobian=own_joints(rng, 4), torque_limit=0.6)
    optimizer = ForceOptimizer(CUBOID, method="newton", limits=limits, initial="previous")
    found = optimizer.solve(LOAD)
    again = pickle.loads(pickle.dumps(found))
    np.testing.assert_array_equal(again.limit_multipliers, found.limit_multipliers)
    assert len(found.limit_multipliers) == len(optimizer.limit_labels) == 24
    assert pickle.loads(pickle.dumps(optimizer)).solve(LOAD).objective == pytest.approx(found.objective, rel=1e-4)
    places = CUBOID.positions + 1e-3 * rng.standard_normal((4, 3))
    after = optimizer.solve(LOAD, positions=places)
    assert after.initial == "previous"
    moved = Grasp.from_contacts(places, CUBOID.normals, CUBOID.friction)
    assert after.objective == pytest.approx(
        optimize_force(moved, LOAD, method="newton", limits=limits).objective, rel=1e-4
    )


def test_limits_move_with_the_contacts() -> None:
    rng = np.random.default_rng(11)
    limits = ForceLimits(jacobian=own_joints(rng, 4), torque_limit=rng.uniform(0.05, 0.6, 12))
    optimizer = ForceOptimizer(CUBOID, method="newton", elastic=True, limits=limits)
    for _ in range(5):
        places, moves = CUBOID.positions + 1e-3 * rng.standard_normal((4, 3)), own_joints(rng, 4)
        moved = Grasp.from_contacts(places, CUBOID.normals, CUBOID.friction)
        there = replace(limits, jacobian=moves)
        anew = optimize_force(moved, LOAD, method="newton", limits=there, elastic=True)
        after = optimizer.solve(LOAD, positions=places, jacobian=moves)
        assert after.status is anew.status
        assert after.objective == pytest.approx(anew.objective, rel=1e-4 if anew.limit_excess == 0.0 else 0.02)
        assert after.limit_excess == pytest.approx(anew.limit_excess, rel=0.02)


def test_batches_hold_optima_proofs_and_excesses() -> None:
    rng = np.random.default_rng(10)
    limits = ForceLimits(jacobian=own_joints(rng, 4), torque_limit=0.15)
    many = loads(rng, 30)
    single = ForceOptimizer(CUBOID, method="newton", limits=limits, elastic=True)
    relaxed = optimize_forces(CUBOID, many, limits=limits, elastic=True)
    plain = optimize_forces(CUBOID, many, limits=limits)
    assert set(relaxed.counts()) == {Status.OPTIMAL, Status.LIMITS_EXCEEDED}
    assert set(plain.counts()) == {Status.OPTIMAL, Status.INFEASIBLE}
    for k, load in enumerate(many):
        want = single.solve(load)
        np.testing.assert_array_equal(relaxed[k].force, want.force)
        assert relaxed[k].limit_excess == want.limit_excess
        assert (plain[k].status is Status.INFEASIBLE) == (want.status is Status.LIMITS_EXCEEDED)
        assert (plain[k].certificate is not None) == (plain[k].status is Status.INFEASIBLE)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"elastic": 1}, "elastic must be True or False, got 1"),
        ({"elastic": True}, "give limits"),
    ],
)
def test_wrong_elastic(given: dict, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        ForceOptimizer(CUBOID, method="newton", **given)


def test_what_the_cones_cannot_balance_stays_an_error() -> None:
    floor = Grasp.from_contacts([[0.1, 0, 0], [-0.05, 0.08, 0], [-0.05, -0.08, 0]], [[0, 0, 1.0]] * 3, 0.5)
    for load in ([0, 0, 5.0, 0, 0, 0], [0, 0, -50.0, 0, 0, 0]):
        with pytest.raises(InfeasibleWrenchError):
            optimize_force(floor, load, method="newton", limits=ForceLimits(max_normal=5.0))
    with pytest.raises(InfeasibleWrenchError):
        optimize_force(floor, [0, 0, 5.0, 0, 0, 0], method="newton", limits=ForceLimits(max_normal=5.0), elastic=True)
    found = optimize_force(
        floor, [0, 0, -50.0, 0, 0, 0], method="newton", limits=ForceLimits(max_normal=5.0), elastic=True
    )
    # 50 N on three contacts: 16.7 N each, 2.33 times 5 N above it
    assert found.limit_excess == pytest.approx(50.0 / 15.0 - 1.0, rel=0.01)

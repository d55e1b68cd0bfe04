"""method="conic" on hard, elliptic and frictionless contacts: exact, certified, honest."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from force.clarabel_reference import Reference, random_wrench
from problems import CONIC_LEAST, GRASPS, PAPER_WRENCH, closure_grasps

from grasp_env.errors import (
    InvalidInputError,
    UnknownNameError,
    UnsupportedProblemError,
)
from grasp_env.force import ForceLimits, ForceOptimizer, ForceSolution, Status, optimize_force
from grasp_env.grasp import Grasp, presets

CUBOID = GRASPS["cuboid, 4"]


def conic(grasp: Grasp, wrench, **options) -> ForceSolution:
    return optimize_force(grasp, wrench, method="conic", **options)


def certified(grasp: Grasp, wrench, found: ForceSolution, criterion: str = "sum", limits: ForceLimits | None = None):
    """Recomputes what an OPTIMAL claims, from the geometry alone; returns (objective, bound)."""
    wrench = np.asarray(wrench, dtype=float)
    reference = Reference(grasp, limits)
    size = float(np.abs(reference.load(wrench)).max())
    reach = max(size, float(np.abs(found.force).max()))
    normals = found.force[:, 0]
    objective = float(normals.sum() if criterion == "sum" else normals.max())
    assert found.objective == pytest.approx(objective, rel=1e-12)
    assert reference.residual(found.force, found.torsion, wrench) <= 1e-9 * size + 1e-14 * reach
    assert reference.violation(found.force, found.torsion) <= 1e-14 * reach
    assert found.cone_margin >= 0.0
    prices = found.limit_multipliers[len(found.limit_multipliers) - len(reference.bound) :]
    bound, theta = reference.dual_bound(found.multipliers, prices, wrench, criterion)
    assert theta > 1.0 - 1e-9
    assert found.lower_bound <= bound * (1.0 + 1e-9)
    return objective, bound


@pytest.mark.parametrize("criterion", ["sum", "max"])
@pytest.mark.parametrize("name", GRASPS)
def test_presets_are_certified_and_clarabel_agrees(name: str, criterion: str) -> None:
    pytest.importorskip("clarabel")
    grasp, rng = GRASPS[name], np.random.default_rng(0)
    for wrench in [PAPER_WRENCH, *(random_wrench(rng, grasp) for _ in range(6))]:
        found = conic(grasp, wrench, criterion=criterion)
        assert found.status is Status.OPTIMAL
        objective, bound = certified(grasp, wrench, found, criterion)
        assert objective - bound <= 1.01e-6 * objective
        assert objective == pytest.approx(Reference(grasp).solve(wrench, criterion).objective, rel=1e-6)


def test_the_notes_number() -> None:
    assert conic(CUBOID, PAPER_WRENCH).objective == pytest.approx(CONIC_LEAST, abs=1e-5)


@pytest.mark.parametrize("tolerance", [1.0, 1e-2, 1e-6, 1e-9, 1e-12, 1e-16])
@pytest.mark.parametrize("criterion", ["sum", "max"])
def test_optimal_means_certified_at_any_tolerance(tolerance: float, criterion: str) -> None:
    for grasp in closure_grasps()[:8]:
        found = conic(grasp, PAPER_WRENCH, criterion=criterion, tolerance=tolerance)
        # whatever the status: the force is a valid grasp
        objective, bound = certified(grasp, PAPER_WRENCH, found, criterion)
        if found.status is Status.OPTIMAL and tolerance < 1.0:
            assert objective - bound <= max(tolerance, 1e-14) * bound * (1.0 + 1e-9)


@pytest.mark.parametrize("iterations", [0, 1, 2, 3])
def test_stopped_early_it_is_a_valid_grasp_that_says_so(iterations: int) -> None:
    found = conic(CUBOID, PAPER_WRENCH, max_iterations=iterations)
    assert found.status is Status.ITERATION_LIMIT
    assert found.iterations == iterations
    objective, bound = certified(CUBOID, PAPER_WRENCH, found)
    assert bound <= CONIC_LEAST <= objective


@pytest.mark.parametrize("factor", [2.0**-20, 0.5, 4.0, 2.0**10])
@pytest.mark.parametrize("criterion", ["sum", "max"])
def test_force_scales_with_the_wrench_to_the_last_bit(factor: float, criterion: str) -> None:
    for grasp in closure_grasps()[:6]:
        one, other = (conic(grasp, PAPER_WRENCH * k, criterion=criterion) for k in (1.0, factor))
        np.testing.assert_array_equal(other.force, factor * one.force)
        assert (other.objective, other.lower_bound) == (factor * one.objective, factor * one.lower_bound)


@pytest.mark.parametrize("factor", [1e-6, 0.3, 7.0, 1e4])
def test_force_scales_with_the_wrench(factor: float) -> None:
    for grasp in closure_grasps()[:6]:
        one, other = conic(grasp, PAPER_WRENCH), conic(grasp, PAPER_WRENCH * factor)
        np.testing.assert_allclose(other.force, factor * one.force, rtol=0, atol=1e-9 * factor * one.objective)


@pytest.mark.parametrize("size", [1e-300, 1e-310, 5e-324])
def test_subnormal_wrenches_give_numbers_or_an_honest_status(size: float) -> None:
    found = conic(CUBOID, np.array([size, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert found.status is not Status.OPTIMAL or np.isfinite(found.force).all()


@pytest.mark.parametrize("criterion", ["sum", "max"])
def test_no_wrench_needs_no_force(criterion: str) -> None:
    found = conic(CUBOID, np.zeros(6), criterion=criterion)
    assert found.status is Status.OPTIMAL
    assert found.objective == pytest.approx(0.0, abs=1e-12)
    assert np.abs(found.force).max() <= 1e-12
    assert found.cone_margin >= 0.0
    assert found.optimality_gap <= 1e-6  # OPTIMAL says that the gap is within the tolerance


@pytest.mark.parametrize("criterion", ["sum", "max"])
def test_multipliers_are_the_derivative(criterion: str) -> None:
    for grasp in [CUBOID, *closure_grasps()[:4]]:
        load = np.array([0.7, -0.4, 0.9, 0.011, -0.007, 0.013])
        found = conic(grasp, load, criterion=criterion, tolerance=1e-9)
        for axis in range(6):
            step = np.zeros(6)
            step[axis] = 1e-4 if axis < 3 else 1e-4 * grasp.length
            up, down = (
                conic(grasp, load + s * step, criterion=criterion, tolerance=1e-10).objective for s in (1.0, -1.0)
            )
            slope = (up - down) / (2.0 * step[axis])
            price = max(1.0, float(np.abs(found.multipliers[:3]).max())) / (1.0 if axis < 3 else grasp.length)
            assert slope == pytest.approx(-found.multipliers[axis], abs=1e-3 * price)


def test_elliptic_cones_are_kept_and_used() -> None:
    pytest.importorskip("clarabel")
    base = GRASPS["cuboid, 5"]
    grasp = Grasp.from_contacts(base.positions, base.normals, np.tile([0.2, 0.9], (5, 1)))
    found = conic(grasp, PAPER_WRENCH)
    certified(grasp, PAPER_WRENCH, found)
    assert found.objective == pytest.approx(Reference(grasp).solve(PAPER_WRENCH).objective, rel=1e-6)
    swapped = Grasp.from_contacts(base.positions, base.normals, np.tile([0.9, 0.2], (5, 1)))
    assert conic(swapped, PAPER_WRENCH).objective != pytest.approx(found.objective, rel=1e-2)


def frictionless_box() -> Grasp:
    """Two contacts off-centre on each face of a cube: closure without friction."""
    positions, normals = [], []
    for axis in range(3):
        for side in (1.0, -1.0):
            for shift in (1.0, -1.0):
                point = np.zeros(3)
                point[axis], point[(axis + 1) % 3] = side, 0.6 * shift
                positions.append(0.05 * point)
                normals.append(-side * np.eye(3)[axis])
    return Grasp.from_contacts(positions, normals, 0.5, contact_model="frictionless")


@pytest.mark.parametrize("criterion", ["sum", "max"])
def test_frictionless_contacts_carry_no_tangential_force(criterion: str) -> None:
    pytest.importorskip("clarabel")
    grasp = frictionless_box()
    load = np.array([1.0, -0.5, 0.3, 0.01, 0.02, -0.01])
    found = conic(grasp, load, criterion=criterion)
    assert found.status is Status.OPTIMAL
    certified(grasp, load, found, criterion)
    assert not found.force[:, 1:].any()
    assert found.objective == pytest.approx(Reference(grasp).solve(load, criterion).objective, rel=1e-6)


def test_some_contacts_frictionless() -> None:
    pytest.importorskip("clarabel")
    base = GRASPS["cuboid, 5"]
    names = ["hard", "hard", "frictionless", "hard", "hard"]
    grasp = Grasp.from_contacts(base.positions, base.normals, 0.6, contact_model=names)
    found = conic(grasp, PAPER_WRENCH)
    certified(grasp, PAPER_WRENCH, found)
    assert found.objective == pytest.approx(Reference(grasp).solve(PAPER_WRENCH).objective, rel=1e-6)


LOAD = np.array([0.3, -0.2, 0.5, 0.01, -0.005, 0.0078125])


@pytest.mark.parametrize("method", ["conic", "newton"])
@pytest.mark.parametrize("form", ["list", "tuple", "read-only", "strided", "reversed", "float32", "fortran"])
def test_any_form_of_the_wrench_gives_the_same_numbers(method: str, form: str) -> None:
    load = LOAD.astype(np.float32).astype(float)
    frozen = load.copy()
    frozen.flags.writeable = False
    given = {
        "list": load.tolist(),
        "tuple": tuple(load.tolist()),
        "read-only": frozen,
        "strided": np.repeat(load, 2)[::2],
        "reversed": load[::-1].copy()[::-1],
        "float32": load.astype(np.float32),
        "fortran": np.asfortranarray(np.tile(load, (3, 1)))[1],
    }[form]
    want = ForceOptimizer(CUBOID, method=method).solve(load)
    got = ForceOptimizer(CUBOID, method=method).solve(given)
    np.testing.assert_array_equal(got.wrench, load)
    assert got.status is want.status
    if method == "conic":
        np.testing.assert_array_equal(got.force, want.force)
        assert (got.objective, got.lower_bound) == (want.objective, want.lower_bound)
    else:  # whose start is put together in compiled code or in Python
        np.testing.assert_allclose(got.force, want.force, rtol=0, atol=1e-13)
        assert got.objective == pytest.approx(want.objective, rel=1e-14)


def test_the_answer_does_not_follow_the_wrench_that_the_caller_changes() -> None:
    optimizer = ForceOptimizer(CUBOID, method="conic")
    load = PAPER_WRENCH.copy()
    first = optimizer.solve(load)
    force = first.force.copy()
    load[:] = 7.0
    optimizer.solve(load)
    np.testing.assert_array_equal(first.force, force)
    np.testing.assert_array_equal(first.wrench, PAPER_WRENCH)


@pytest.mark.parametrize("method", ["conic", "newton"])
@pytest.mark.parametrize("limited", [False, True])
def test_four_threads_give_the_bits_of_one(method: str, limited: bool) -> None:
    rng = np.random.default_rng(5)
    wrenches = [random_wrench(rng, CUBOID, 0.1, 5.0) for _ in range(40)]
    limits = ForceLimits(max_normal=1e6) if limited else None

    def sweep() -> list[np.ndarray]:
        optimizer = ForceOptimizer(CUBOID, method=method, limits=limits)
        return [optimizer.solve(w).force for w in wrenches]

    want = sweep()
    answers: dict[int, list[np.ndarray]] = {}
    threads = [threading.Thread(target=lambda k=k: answers.__setitem__(k, sweep())) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for k in range(4):
        np.testing.assert_array_equal(answers[k], want)


def test_order_of_calls_does_not_matter() -> None:
    rng = np.random.default_rng(6)
    wrenches = [random_wrench(rng, CUBOID) for _ in range(20)]
    optimizer = ForceOptimizer(CUBOID, method="conic")
    forward = [optimizer.solve(w).force.copy() for w in wrenches]
    backward = [optimizer.solve(w).force.copy() for w in wrenches[::-1]][::-1]
    np.testing.assert_array_equal(forward, backward)


# wrong input


@pytest.mark.parametrize(
    ("error", "options"),
    [
        (UnknownNameError, {"criterion": "mean"}),
        (UnknownNameError, {"criterion": None}),
        (UnknownNameError, {"criterion": ["sum"]}),
        (UnknownNameError, {"method": "cone"}),
        (UnknownNameError, {"method": None}),
        (UnsupportedProblemError, {"method": "newton", "criterion": "max"}),
        (UnsupportedProblemError, {"method": "reduced_flow", "criterion": "max"}),
        (UnsupportedProblemError, {"method": "reduced_flow", "limits": ForceLimits(max_normal=9.0)}),
        (UnsupportedProblemError, {"method": "full_flow", "limits": ForceLimits(min_normal=0.1)}),
        (InvalidInputError, {"limits": {"max_normal": 3.0}}),
        (InvalidInputError, {"limits": 3.0}),
        (InvalidInputError, {"limits": ForceLimits(max_normal=[3.0, 3.0])}),
        (InvalidInputError, {"limits": ForceLimits(jacobian=np.zeros((3, 3, 2)), torque_limit=1.0)}),
        (InvalidInputError, {"initial": np.ones((4, 3))}),
        (InvalidInputError, {"initial": "previous"}),
        (InvalidInputError, {"optimum": 3.0}),
        (InvalidInputError, {"trace": True}),
        (InvalidInputError, {"tolerance": 0.0}),
        (InvalidInputError, {"tolerance": np.nan}),
        (InvalidInputError, {"tolerance": "fine"}),
        (InvalidInputError, {"max_iterations": 2.5}),
        (InvalidInputError, {"max_iterations": -1}),
        (InvalidInputError, {"max_iterations": True}),
    ],
    ids=str,
)
def test_wrong_options_are_named(error: type[Exception], options: dict) -> None:
    with pytest.raises(error) as caught:
        optimize_force(CUBOID, PAPER_WRENCH, **{"method": "conic", **options})
    assert type(caught.value) is error
    assert len(str(caught.value)) > 20


@pytest.mark.parametrize(
    "wrench",
    [
        [1.0] * 5, [[1.0] * 6], 3.0, "wrench", None, [np.nan] * 6, [np.inf] * 6, [1e13] * 6, {"force": 1.0},
        np.full(6, np.nan), np.full(6, 1e13), [1.0, 2.0, [3.0], 4.0, 5.0, 6.0], np.ones(6) * 1j,
    ],
    ids=str,
)  # fmt: skip
@pytest.mark.parametrize("limits", [None, ForceLimits(max_normal=50.0)], ids=["plain", "limits"])
def test_wrong_wrenches_are_refused(wrench, limits: ForceLimits | None) -> None:
    with pytest.raises(InvalidInputError, match="wrench"):
        conic(CUBOID, wrench, limits=limits)


def test_a_refused_wrench_leaves_the_optimizer_working() -> None:
    optimizer = ForceOptimizer(presets.paper_cuboid(), method="conic")
    want = optimizer.solve(PAPER_WRENCH).force
    with pytest.raises(InvalidInputError):
        optimizer.solve(np.full(6, np.nan))
    np.testing.assert_array_equal(optimizer.solve(PAPER_WRENCH).force, want)

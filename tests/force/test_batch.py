"""Batches: the bits of single calls, statuses instead of errors, wrong input."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from problems import closure_grasps

from grasp_env.errors import InvalidInputError, UnknownNameError
from grasp_env.force import ForceLimits, ForceOptimizer, Status, optimize_force, optimize_forces
from grasp_env.grasp import Grasp, presets
from grasp_env.grasp.wrench import sample_ball

GRASP = presets.paper_cuboid()


@pytest.mark.parametrize("method", ["newton", "conic", "reduced_flow"])
@pytest.mark.parametrize("workers", [1, 3])
def test_the_bits_of_single_calls(method: str, workers: int) -> None:
    loads = sample_ball(np.random.default_rng(0), 40)
    batch = optimize_forces(GRASP, loads, method=method, workers=workers)
    optimizer = ForceOptimizer(GRASP, method=method)
    for k, load in enumerate(loads):
        one = optimizer.solve(load)
        np.testing.assert_array_equal(batch.force[k], one.force)
        assert (batch.objective[k], batch.iterations[k]) == (one.objective, one.iterations)
        assert batch[k].status is one.status
        np.testing.assert_array_equal(batch[k].wrench, load)
    assert batch.counts() == {Status.OPTIMAL: 40}
    np.testing.assert_array_equal(batch[5:9].force, batch.force[5:9])


def test_many_grasps() -> None:
    grasps = [grasp for grasp in closure_grasps() if grasp.n_contacts == 5]
    loads = sample_ball(np.random.default_rng(1), len(grasps))
    batch = optimize_forces(grasps, loads, method="conic")
    for grasp, load, force in zip(grasps, loads, batch.force, strict=True):
        np.testing.assert_array_equal(force, optimize_force(grasp, load, method="conic").force)


@pytest.mark.parametrize("method", ["newton", "conic", "linear"])
def test_infeasible_wrenches_get_a_status_and_keep_their_proof(method: str) -> None:
    floor = Grasp.from_contacts([[0.03, 0, 0], [-0.03, 0.02, 0], [-0.02, -0.03, 0]], [[0.0, 0.0, 1.0]] * 3, 0.4)
    loads = np.array([[0, 0, -2.0, 0, 0, 0], [0, 0, 2.0, 0, 0, 0]])
    options = {"initial": "phase_one"} if method == "newton" else {}
    batch = optimize_forces(floor, loads, method=method, **options)
    assert [solution.status for solution in batch] == [Status.OPTIMAL, Status.INFEASIBLE]
    assert batch[1].certificate @ loads[1] > 0.0
    assert np.isinf(batch.objective[1])


def test_limits_and_their_multipliers_come_through() -> None:
    loads = sample_ball(np.random.default_rng(2), 5)
    limits = ForceLimits(max_normal=50.0)
    batch = optimize_forces(GRASP, loads, method="conic", limits=limits)
    assert batch.optimal.all()
    assert all(solution.limit_multipliers.shape == (4,) for solution in batch)


@pytest.mark.parametrize(
    ("grasps", "loads", "options", "message"),
    [
        (GRASP, np.zeros(6), {}, "wrenches must have shape"),
        (GRASP, np.full((2, 6), np.nan), {}, "wrenches must be finite"),
        (GRASP, np.full((2, 6), 1e13), {}, "components up to"),
        (GRASP, np.zeros((2, 6)), {"workers": 0}, "workers must be an integer >= 1"),
        (GRASP, np.zeros((2, 6)), {"initial": "previous"}, "no previous solution"),
        ([GRASP], np.zeros((2, 6)), {}, "as many grasps as wrenches"),
        ([GRASP, presets.tripod()], np.zeros((2, 6)), {}, "one number of contacts"),
        ([GRASP, 3], np.zeros((2, 6)), {}, "entry 1 is int"),
    ],
)
def test_wrong_input(grasps: object, loads: np.ndarray, options: dict, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        optimize_forces(grasps, loads, **options)


def test_errors_travel_between_processes() -> None:
    error = pickle.loads(pickle.dumps(UnknownNameError("method", "newest", ("conic",), "; look again")))
    assert str(error) == "unknown method 'newest': choose one of 'conic'; look again"


def test_solutions_travel_between_processes() -> None:
    solution = optimize_force(GRASP, sample_ball(np.random.default_rng(3), 1)[0], method="conic")
    again = pickle.loads(pickle.dumps(solution))
    np.testing.assert_array_equal(again.force, solution.force)
    assert again.status is Status.OPTIMAL
    with pytest.raises(ValueError, match="read-only"):
        solution.force[0, 0] = 0.0


def test_conic_ends_whatever_the_tolerance() -> None:
    """Rounding makes the gap negative once in ten thousand wrenches; the loop must not wait for it to shrink."""
    rng = np.random.default_rng(4)
    loads = rng.standard_normal((20_000, 6)) * [1, 1, 1, 0.1, 0.1, 0.1]
    for tolerance in (1e-12, 1e-15):
        batch = optimize_forces(GRASP, loads, method="conic", tolerance=tolerance)
        assert set(np.unique(batch.codes)) <= {0, 1, 2}
        assert (batch.cone_margin >= 0.0).all()


def test_the_control_loops_path_is_the_careful_one() -> None:
    """An array of floats takes the compiled call, a list every check: the same solution, bit for bit but for rounding."""
    rng = np.random.default_rng(5)
    fast, slow = (ForceOptimizer(GRASP, method="newton", initial="previous", tolerance=1e-8) for _ in range(2))
    load = sample_ball(rng, 1)[0]
    for _ in range(50):
        load = load * (1.0 + 10.0 ** rng.uniform(-4, 0.5) * rng.standard_normal(6))
        one, other = fast.solve(load), slow.solve(load.tolist())
        assert (one.status, one.initial) == (other.status, other.initial)
        assert one.objective == pytest.approx(other.objective, rel=2e-8)
        assert one.equilibrium_residual <= 1e-13 * np.abs(one.force).max()


def test_a_refused_move_changes_nothing() -> None:
    optimizer = ForceOptimizer(GRASP, method="newton", force_weight=[1.0] * 4)
    load = sample_ball(np.random.default_rng(6), 1)[0]
    before = optimizer.solve(load)
    with pytest.raises(InvalidInputError, match="force_weight has 4 entries, the grasp 5 contacts"):
        optimizer.move_to(presets.five_finger_cuboid())
    assert optimizer.grasp is GRASP
    np.testing.assert_array_equal(optimizer.solve(load).force, before.force)

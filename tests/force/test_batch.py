"""Batches: the answers of single calls, whatever stands beside them; statuses instead of errors; wrong input."""

from __future__ import annotations

import numpy as np
import pytest
from force.named import attempt
from problems import closure_grasps

from grasp_env.errors import InvalidInputError
from grasp_env.force import ForceLimits, ForceOptimizer, Status, optimize_force, optimize_forces
from grasp_env.force.many import CHUNK
from grasp_env.grasp import Grasp, presets
from grasp_env.grasp.wrench import sample_ball
from policies import LearnedInitialForce

GRASP = presets.paper_cuboid()


AGREES = 1e-9
"""Of single calls: in a register of problems sums over contacts are taken in another order."""
KINDS: dict[str, dict] = {
    "newton": {}, "newton to 1e-8": {"tolerance": 1e-8}, "other weights": {"force_weight": 3.0, "barrier_weight": 1e-4},
    "conic": {"method": "conic"}, "conic to 1e-9": {"method": "conic", "tolerance": 1e-9}, "flow": {"method": "reduced_flow"},
    "limits": {"limits": ForceLimits(max_normal=100.0)}, "network": {"initial": LearnedInitialForce.pretrained()},
}  # fmt: skip
"""What the core solves without Python between the problems."""


@pytest.mark.parametrize("kind", KINDS)
def test_the_answers_of_single_calls(kind: str) -> None:
    loads = wide_loads(300)
    batch, optimizer = optimize_forces(GRASP, loads, **KINDS[kind]), ForceOptimizer(GRASP, **KINDS[kind])
    agrees = 10 * AGREES if kind == "conic to 1e-9" else AGREES  # its last system has few digits left
    for k, load in enumerate(loads):
        one = optimizer.solve(load)
        scale = np.abs(one.force).max()
        np.testing.assert_allclose(batch.force[k], one.force, rtol=0, atol=agrees * scale)
        np.testing.assert_allclose(batch[k].initial_force, one.initial_force, rtol=0, atol=AGREES * scale)
        assert (batch.iterations[k], batch[k].status) == (one.iterations, one.status)
        assert batch.objective[k] == pytest.approx(one.objective, rel=AGREES)
        np.testing.assert_array_equal(batch[k].wrench, load)
        np.testing.assert_allclose(batch[k].limit_multipliers, one.limit_multipliers, rtol=1e-6)
    assert batch.counts() == {Status.OPTIMAL: len(loads)}
    np.testing.assert_array_equal(batch[5:9].force, batch.force[5:9])


def wide_loads(count: int) -> np.ndarray:
    """Wrenches of 1e-3 to 10 times the ordinary ones."""
    rng = np.random.default_rng(0)
    return sample_ball(rng, count) * 10.0 ** rng.uniform(-3, 1, (count, 1))


@pytest.mark.parametrize("kind", ["newton", "conic", "network", "limits"])
def test_no_answer_hangs_on_threads_or_neighbours(kind: str) -> None:
    loads = wide_loads(3 * CHUNK // 2)
    options = KINDS[kind]
    batch = optimize_forces(GRASP, loads, workers=1, **options)
    for workers in (2, 5):
        np.testing.assert_array_equal(optimize_forces(GRASP, loads, workers=workers, **options).records, batch.records)
    order = np.random.default_rng(1).permutation(len(loads))
    np.testing.assert_array_equal(optimize_forces(GRASP, loads[order], **options).records, batch.records[order])


@pytest.mark.parametrize("count", [3, 4, 5, 8, 9, 17])
@pytest.mark.parametrize("method", ["newton", "conic"])
def test_any_number_of_contacts(count: int, method: str) -> None:
    grasps = [grasp for grasp in closure_grasps() if grasp.n_contacts == count] or [ring(count)]
    for grasp in grasps[:3]:
        loads = wide_loads(50)
        batch = optimize_forces(grasp, loads, method=method)
        optimizer = ForceOptimizer(grasp, method=method)
        for k, load in enumerate(loads):
            one = optimizer.solve(load)
            close = 10 * AGREES * np.abs(one.force).max()  # some of these hardly span the wrenches
            np.testing.assert_allclose(batch.force[k], one.force, rtol=0, atol=close)


def ring(count: int) -> Grasp:
    """Contacts around a cylinder."""
    angle = 2.0 * np.pi * np.arange(count) / count
    normals = -np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    heights = np.random.default_rng(count).uniform(-0.02, 0.02, count)
    return Grasp.from_contacts(-0.04 * normals + np.outer(heights, [0, 0, 1]), normals, 0.5)


@pytest.mark.parametrize("method", ["newton", "conic"])
def test_hard_problems_are_not_lost(method: str) -> None:
    """Wrenches of 1e-6 to 1e6 N, tight tolerances: as many optima as single calls find, none of them invented."""
    rng = np.random.default_rng(7)
    loads = rng.standard_normal((400, 6)) * 10.0 ** rng.uniform(-6, 6, (400, 1)) * [1, 1, 1, 0.05, 0.05, 0.05]
    batch = optimize_forces(GRASP, loads, method=method, tolerance=1e-10)
    optimizer = ForceOptimizer(GRASP, method=method, tolerance=1e-10)
    alone = np.array([optimizer.solve(load).status is Status.OPTIMAL for load in loads])
    assert batch.optimal[alone].all()
    gap = (batch.objective - batch.lower_bound) / batch.lower_bound
    assert (gap[batch.optimal] <= 1e-10).all()
    assert (batch.cone_margin >= 0.0).all()


@pytest.mark.parametrize("method", ["newton", "conic"])
def test_grasps_of_every_kind_side_by_side(method: str) -> None:
    """Nearly coplanar, without force closure, soft, elliptic and frictionless among ordinary ones: the statuses of single calls."""
    base = ring(8)
    positions, normals = base.positions, base.normals
    grasps = [Grasp.from_contacts(positions * scale, normals, 0.5) for scale in np.linspace(0.8, 1.2, 30)]
    grasps[3] = Grasp.from_contacts(positions * [1.0, 1.0, 1e-6], normals, 0.5)
    grasps[7] = Grasp.from_contacts(positions, np.tile([0.0, 0.0, 1.0], (8, 1)), 0.5)
    grasps[11] = Grasp.from_contacts(positions, normals, 0.5, contact_model="soft", torsional_friction=0.003)
    grasps[12] = Grasp.from_contacts(positions, normals, np.linspace(0.3, 0.9, 16).reshape(8, 2))
    grasps[13] = Grasp.from_contacts(positions, normals, 0.6, contact_model=["hard"] * 5 + ["frictionless"] * 3)
    loads = sample_ball(np.random.default_rng(4), len(grasps))
    batch = optimize_forces(grasps, loads, method=method)
    for k, grasp in enumerate(grasps):
        one = attempt(lambda g=grasp, w=loads[k]: optimize_force(g, w, method=method))
        assert batch[k].status is one.status
        assert batch[k].objective == pytest.approx(one.objective, rel=1e-4)
    ordinary = [k for k in range(len(grasps)) if k not in (3, 7, 11, 12, 13)]
    without = optimize_forces([grasps[k] for k in ordinary], loads[ordinary], method=method)
    np.testing.assert_array_equal(without.records, batch.records[ordinary])


@pytest.mark.parametrize("thin", [1e-3, 1e-4, 1e-5, 1e-6])
def test_grasps_near_rank_loss_are_solved_alone(thin: float) -> None:
    """Contacts nearly on a line, where sums of another order are worth more than rounding: the bits of single calls."""
    base = ring(8)
    points = [base.positions * [1.0, thin, thin] * (1.0 + 0.03 * k) for k in range(9)]
    grasps = [Grasp.from_contacts(each, base.normals, 0.5) for each in points]
    loads = np.random.default_rng(4).standard_normal((9, 6)) * np.repeat([1.0, 0.01], 3)
    for found, grasp, load in zip(optimize_forces(grasps, loads), grasps, loads, strict=True):
        np.testing.assert_array_equal(found.force, attempt(lambda g=grasp, w=load: optimize_force(g, w)).force)


@pytest.mark.parametrize(
    ("grasps", "loads", "options", "message"),
    [
        (GRASP, np.zeros(6), {}, "wrenches must have shape"), (GRASP, np.full((2, 6), np.nan), {}, "wrenches must be finite"),
        (GRASP, np.full((2, 6), 1e13), {}, "components up to"), (GRASP, np.zeros((2, 6)), {"workers": 0}, "workers must be an integer >= 1"),
        (GRASP, np.zeros((2, 6)), {"initial": "previous"}, "no previous solution"), ([GRASP], np.zeros((2, 6)), {}, "as many grasps as wrenches"),
        ([GRASP, presets.tripod()], np.zeros((2, 6)), {}, "one number of contacts"), ([GRASP, 3], np.zeros((2, 6)), {}, "entry 1 is int"),
    ],
)  # fmt: skip
def test_wrong_input(grasps: object, loads: np.ndarray, options: dict, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        optimize_forces(grasps, loads, **options)


def test_the_control_loops_path_is_the_careful_one() -> None:
    """An array of floats takes the compiled call, a list every check: the same solution, bit for bit but for rounding."""
    rng = np.random.default_rng(5)
    fast, slow = (ForceOptimizer(GRASP, initial="previous", tolerance=1e-8) for _ in range(2))
    load = sample_ball(rng, 1)[0]
    for _ in range(50):
        load = load * (1.0 + 10.0 ** rng.uniform(-4, 0.5) * rng.standard_normal(6))
        one, other = fast.solve(load), slow.solve(load.tolist())
        assert (one.status, one.initial) == (other.status, other.initial)
        assert one.objective == pytest.approx(other.objective, rel=2e-8)
        assert one.equilibrium_residual <= 1e-13 * np.abs(one.force).max()

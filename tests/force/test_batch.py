"""Batches give the answers of single calls, on any threads; processes, shared optimizers and
interrupts."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from force.named import attempt
from problems import random_grasp

from grasp_env.errors import InfeasibleWrenchError, NotConvergedError, RankDeficientGraspError
from grasp_env.force import (
    ForceLimits,
    ForceOptimizer,
    Margin,
    Status,
    optimize_force,
    optimize_forces,
)
from grasp_env.force.many import CHUNK
from grasp_env.force.record import INFEASIBLE, RANK_LOST, UNDECIDED
from grasp_env.grasp import Grasp, presets
from grasp_env.grasp.wrench import sample_ball
from policies import LearnedInitialForce

ROOT = Path(__file__).parents[2]
GRASP = presets.paper_cuboid()
AGREES = 1e-9
"""Relative difference from single calls: sums over contacts are taken in another order."""
KINDS: dict[str, dict] = {
    "newton": {},
    "newton to 1e-8": {"tolerance": 1e-8},
    "other weights": {"force_weight": 3.0, "barrier_weight": 1e-4},
    "conic": {"method": "conic"},
    "conic to 1e-9": {"method": "conic", "tolerance": 1e-9},
    "weighted conic": {"method": "conic", "force_weight": [1.0, 0.2, 30.0, 5.0]},
    "flow": {"method": "reduced_flow"},
    "limits": {"limits": ForceLimits(max_normal=100.0)},
    "network": {"initial": LearnedInitialForce.pretrained()},
}


def wide_loads(count: int) -> np.ndarray:
    """Wrenches of 1e-3 to 10 times the ordinary ones."""
    rng = np.random.default_rng(0)
    return sample_ball(rng, count) * 10.0 ** rng.uniform(-3, 1, (count, 1))


@pytest.mark.parametrize("kind", KINDS)
def test_the_answers_of_single_calls(kind):
    loads = wide_loads(100)
    batch = optimize_forces(GRASP, loads, **KINDS[kind])
    optimizer = ForceOptimizer(GRASP, **KINDS[kind])
    # its last system has few digits left
    agrees = 10 * AGREES if kind == "conic to 1e-9" else AGREES
    for k, load in enumerate(loads):
        one = optimizer.solve(load)
        scale = np.abs(one.force).max()
        np.testing.assert_allclose(batch.force[k], one.force, rtol=0, atol=agrees * scale)
        np.testing.assert_allclose(
            batch[k].initial_force, one.initial_force, rtol=0, atol=AGREES * scale
        )
        assert (batch.iterations[k], batch[k].status) == (one.iterations, one.status)
        assert batch.objective[k] == pytest.approx(one.objective, rel=AGREES)
        np.testing.assert_array_equal(batch[k].wrench, load)
        np.testing.assert_allclose(batch[k].limit_multipliers, one.limit_multipliers, rtol=1e-6)
    assert batch.counts() == {Status.OPTIMAL: len(loads)}
    np.testing.assert_array_equal(batch[5:9].force, batch.force[5:9])


@pytest.mark.parametrize("kind", ["newton", "conic", "network", "limits"])
def test_no_answer_depends_on_threads_or_neighbours(kind):
    loads = wide_loads(3 * CHUNK // 2)
    options = KINDS[kind]
    batch = optimize_forces(GRASP, loads, workers=1, **options)
    np.testing.assert_array_equal(
        optimize_forces(GRASP, loads, workers=5, **options).records, batch.records
    )
    if kind == "newton":  # more grasps than the core takes at once, some twice
        grasps = [GRASP.with_friction(mu) for mu in np.linspace(0.3, 0.9, 700)]
        many = [*grasps, *grasps[::-1]]
        found = optimize_forces(many, loads[: len(many)], **options)
        np.testing.assert_array_equal(
            found.records[700:], optimize_forces(many[700:], loads[700 : len(many)]).records
        )
    order = np.random.default_rng(1).permutation(len(loads))
    np.testing.assert_array_equal(
        optimize_forces(GRASP, loads[order], **options).records, batch.records[order]
    )


@pytest.mark.parametrize(("method", "tolerance"), [("newton", 1e-8), ("conic", 1e-9)])
def test_what_agrees_where_sums_round_differently(method, tolerance):
    rng = np.random.default_rng(0)
    apart = []
    for _ in range(20):
        grasp = random_grasp(rng, int(rng.integers(3, 8)))
        loads = sample_ball(rng, 100) * 10.0 ** rng.uniform(-3, 1, (100, 1))
        optimizer = ForceOptimizer(grasp, method=method, tolerance=tolerance)
        batch = optimizer.solve_many(loads)
        for k, load in enumerate(loads):
            one = attempt(lambda o=optimizer, w=load: o.solve(w))
            assert batch[k].status is one.status
            if one.status is Status.OPTIMAL:
                assert batch.objective[k] == pytest.approx(one.objective, rel=tolerance)
                apart.append(np.abs(batch.force[k] - one.force).max() / np.abs(one.force).max())
    assert len(apart) > 1000
    assert np.quantile(apart, 0.95) <= AGREES
    assert max(apart) <= np.sqrt(tolerance)


def ring(count: int) -> Grasp:
    """Contacts around a cylinder."""
    angle = 2.0 * np.pi * np.arange(count) / count
    normals = -np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    heights = np.random.default_rng(count).uniform(-0.02, 0.02, count)
    return Grasp.from_contacts(-0.04 * normals + np.outer(heights, [0, 0, 1]), normals, 0.5)


@pytest.mark.parametrize(
    "weights", [None, [1.0, 0.3, 5.0, 1.0, 2.0, 0.1, 1.0, 20.0]], ids=["equal", "weighted"]
)
@pytest.mark.parametrize("method", ["newton", "conic"])
def test_grasps_of_every_kind_side_by_side(method, weights):
    base = ring(8)
    positions, normals = base.positions, base.normals
    grasps = [
        Grasp.from_contacts(positions * scale, normals, 0.5) for scale in np.linspace(0.8, 1.2, 30)
    ]
    grasps[3] = Grasp.from_contacts(positions * [1.0, 1.0, 1e-6], normals, 0.5)
    grasps[7] = Grasp.from_contacts(positions, np.tile([0.0, 0.0, 1.0], (8, 1)), 0.5)
    grasps[11] = Grasp.from_contacts(
        positions, normals, 0.5, contact_model="soft", torsional_friction=0.003
    )
    grasps[12] = Grasp.from_contacts(positions, normals, np.linspace(0.3, 0.9, 16).reshape(8, 2))
    grasps[13] = Grasp.from_contacts(
        positions, normals, 0.6, contact_model=["hard"] * 5 + ["frictionless"] * 3
    )
    loads = sample_ball(np.random.default_rng(4), len(grasps))
    options: dict[str, Any] = {"method": method} | (
        {} if weights is None else {"force_weight": weights}
    )
    batch = optimize_forces(grasps, loads, **options)
    for k, grasp in enumerate(grasps):
        one = attempt(lambda g=grasp, w=loads[k]: optimize_force(g, w, **options))
        assert batch[k].status is one.status
        assert batch[k].objective == pytest.approx(one.objective, rel=1e-4)
        np.testing.assert_allclose(batch.torsion[k], one.torsion, atol=1e-6)
        if one.status is Status.OPTIMAL:
            assert grasp.residual(batch.force[k], batch.wrench[k], batch.torsion[k]) < 1e-9
    ordinary = [k for k in range(len(grasps)) if k not in (3, 7, 11, 12, 13)]
    without = optimize_forces([grasps[k] for k in ordinary], loads[ordinary], **options)
    np.testing.assert_array_equal(without.records, batch.records[ordinary])


def test_grasps_near_rank_loss_are_solved_alone():
    """Contacts nearly on a line, where the order of sums matters more than rounding: the bits of
    single calls."""
    base = ring(8)
    points = [base.positions * [1.0, 1e-3, 1e-3] * (1.0 + 0.03 * k) for k in range(9)]
    grasps = [Grasp.from_contacts(each, base.normals, 0.5) for each in points]
    loads = np.random.default_rng(4).standard_normal((9, 6)) * np.repeat([1.0, 0.01], 3)
    for found, grasp, load in zip(optimize_forces(grasps, loads), grasps, loads, strict=True):
        np.testing.assert_array_equal(
            found.force, attempt(lambda g=grasp, w=load: optimize_force(g, w)).force
        )


PALM = Grasp.from_contacts(GRASP.positions, [[0.0, 0.0, 1.0]] * 4, 0.4)
"""Without force closure: it carries what presses on it, and nothing that pulls."""


@pytest.mark.parametrize("error", [NotConvergedError, InfeasibleWrenchError])
def test_what_a_rule_leaves_undecided_is_no_optimum(error):

    def rule(grasp: Grasp, load: np.ndarray) -> np.ndarray:
        if load[0] > 0.0:
            raise error("no start")
        return ForceOptimizer(grasp).start(load)

    loads = wide_loads(12)
    lost = loads[:, 0] > 0.0
    assert 0 < lost.sum() < 12
    for grasps in (GRASP, [GRASP] * 12):
        batch = optimize_forces(grasps, loads, initial=rule)
        assert batch.codes.tolist() == np.where(lost, UNDECIDED, 0).tolist()
        assert (batch.objective[lost] == np.inf).all()
        assert (batch.lower_bound[lost] == -np.inf).all()
        assert not batch.force[lost].any()
        np.testing.assert_array_equal(batch.wrench, loads)
        best = optimize_forces(GRASP, loads[~lost]).objective
        np.testing.assert_allclose(batch.objective[~lost], best, rtol=2e-4)  # twice the tolerance
    assert batch[int(np.flatnonzero(lost)[0])].optimality_gap == np.inf


def test_an_undecided_problem_keeps_its_sizes():
    jacobian = np.full((4, 3, 2), 0.05)
    options = {
        "limits": ForceLimits(max_normal=1e3, jacobian=jacobian, torque_limit=[np.inf, 1e3]),
        "margin": Margin(0.8, 0.5),
    }

    def rule(grasp: Grasp, load: np.ndarray) -> np.ndarray:
        raise NotConvergedError("no start")

    slight = Grasp.from_contacts(  # a torsional friction of rounding
        [[-0.02, 0, 0], [0.02, 0, 0]],
        [[1, 0, 0], [-1, 0, 0]],
        0.5,
        contact_model="soft",
        torsional_friction=1e-12,
    )
    load = np.array([0.0, 0.0, -1.0, -5e-12, 0.0, 0.0])
    by_core = optimize_forces([slight], load[None], limits=ForceLimits(max_normal=2.0))
    by_rule = optimize_forces([GRASP], load[None], initial=rule, **options)
    for batch, limits, joints in ((by_core, 2, 0), (by_rule, 6, 2)):
        assert batch.codes.tolist() == [UNDECIDED]
        assert (batch[0].limit_multipliers.size, batch[0].torques.size) == (limits, joints)
        np.testing.assert_array_equal(batch[0].wrench, load)
    preloaded = load + 0.5 * GRASP.matrix[:, ::3].sum(axis=1)
    np.testing.assert_allclose(by_rule[0].wrench_with_preload, preloaded)


@pytest.mark.parametrize(
    "options", [{}, {"method": "conic"}, {"limits": ForceLimits(max_normal=1e3)}], ids=str
)
def test_what_is_infeasible_has_an_infinite_objective_and_bound(options):
    pulls, presses = np.eye(6)[[2, 2]] * [[1.0], [-1.0]]
    loads = np.array([pulls, presses] * 6)
    for grasps in (PALM, [PALM] * 12):
        batch = optimize_forces(grasps, loads, **options)
        assert batch.codes.tolist() == [INFEASIBLE, 0] * 6
        assert (batch.objective[::2] == np.inf).all()
        assert (batch.lower_bound[::2] == np.inf).all()
        assert np.isfinite(batch.objective[1::2]).all()


@pytest.mark.parametrize("method", ["newton", "conic", "reduced_flow"])
def test_contacts_without_rank_have_an_infinite_objective(method):
    optimizer = ForceOptimizer(GRASP, method=method)
    with pytest.raises(
        RankDeficientGraspError if method == "reduced_flow" else InfeasibleWrenchError
    ):
        optimizer.solve(LOADS[0], contacts=np.array([True, False, False, False]))
    alone = np.array([True, False, False, False])
    solution = optimizer.core.solve(LOADS[0], (None, None, None, None, None, alone, None), None)
    ends = (
        (RANK_LOST, np.inf, -np.inf) if method == "reduced_flow" else (INFEASIBLE, np.inf, np.inf)
    )
    assert (solution.code, solution.objective, solution.lower_bound) == ends


# threads, processes, interrupts

LOADS = sample_ball(np.random.default_rng(0), 100)


@pytest.mark.parametrize("kind", ["newton", "conic", "flow", "limits"])
def test_eight_threads_with_an_optimizer_each_or_a_shared_one(kind):
    """Use one optimizer in one thread; if it is shared all the same, its answers are still right."""
    alone = [ForceOptimizer(GRASP, **KINDS[kind]) for _ in range(8)]
    shared = ForceOptimizer(GRASP, **KINDS[kind])
    want = np.array([shared.solve(load).force for load in LOADS])
    remembers = ForceOptimizer(
        GRASP, **KINDS[kind], initial=None if kind == "conic" else "previous"
    )
    with ThreadPoolExecutor(8) as pool:
        for found in pool.map(lambda own: [own.solve(load).force for load in LOADS], alone):
            np.testing.assert_array_equal(found, want)
        np.testing.assert_array_equal(
            [found.force for found in pool.map(shared.solve, LOADS)], want
        )
        for load, solution in zip(LOADS, pool.map(remembers.solve, LOADS), strict=True):
            np.testing.assert_array_equal(solution.wrench, load)
            assert solution.equilibrium_residual < 1e-9
            assert solution.optimality_gap <= 1e-4


def in_a_child(optimizer: ForceOptimizer, answers: multiprocessing.SimpleQueue) -> None:
    answers.put(
        (optimizer.solve(LOADS[1]).force, optimize_forces(optimizer.grasp, LOADS, workers=2).force)
    )


@pytest.mark.parametrize("way", ["fork", "spawn"])
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")
def test_processes_after_use(way):
    """The parent has used everything, threads of its batches too, before its child does."""
    optimizer = ForceOptimizer(GRASP, initial="previous")
    optimizer.solve(LOADS[0])
    expected = optimize_forces(GRASP, LOADS, workers=2).force
    context = multiprocessing.get_context(way)
    answers = context.SimpleQueue()
    child = context.Process(target=in_a_child, args=(optimizer, answers), daemon=True)
    child.start()
    here = optimize_forces(GRASP, LOADS, workers=2).force  # at the same time
    force, batch = answers.get()
    child.join(60.0)
    assert child.exitcode == 0
    np.testing.assert_array_equal(force, optimizer.solve(LOADS[1]).force)
    for one in (here, batch):
        np.testing.assert_array_equal(one, expected)


INTERRUPTED = """
import signal, sys, threading, time
import numpy as np
from grasp_env.force import optimize_forces
from grasp_env.grasp import presets

signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in a background job
grasp = presets.paper_cuboid()
loads = np.random.default_rng(0).standard_normal((400_000, 6)) * [1, 1, 1, 0.05, 0.05, 0.05]
before, sent = optimize_forces(grasp, loads[:50], method="reduced_flow").force, []
def interrupt():
    sent.append(time.perf_counter())
    signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
threading.Timer(0.1, interrupt).start()
try:
    optimize_forces(grasp, loads, method="reduced_flow", workers=2, tolerance=1e-12)
    sys.exit("finished")
except KeyboardInterrupt:
    took = time.perf_counter() - sent[0]
assert (optimize_forces(grasp, loads[:50], method="reduced_flow").force == before).all()
begin = time.perf_counter()
while threading.active_count() > 1 and time.perf_counter() < begin + 5.0:
    time.sleep(0.01)
print(took, threading.active_count())
"""


def test_an_interrupt_ends_a_batch():
    command = [sys.executable, "-c", INTERRUPTED]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        command, cwd=ROOT, env=environment, timeout=120, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-2000:]
    took, threads = done.stdout.split()
    assert float(took) < 1.0
    assert threads == "1"

"""Threads, processes and interrupts: solvers side by side, in children by fork and spawn, and Ctrl-C in the midst of a batch."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from grasp_env.force import ForceLimits, ForceOptimizer, optimize_forces
from grasp_env.grasp import presets
from grasp_env.grasp.wrench import sample_ball

ROOT = Path(__file__).parents[2]
GRASP = presets.paper_cuboid()
LOADS = sample_ball(np.random.default_rng(0), 200)
OPTIMIZERS = {
    "newton": {"method": "newton"},
    "previous": {"method": "newton", "initial": "previous"},
    "reduced_flow": {"method": "reduced_flow"},
    "conic": {"method": "conic"},
    "limits": {"method": "newton", "limits": ForceLimits(max_normal=20.0)},
    "general": {"method": "conic", "limits": ForceLimits(max_normal=50.0)},
}


def forces(name: str, loads: np.ndarray = LOADS) -> np.ndarray:
    """Of an optimizer of one's own."""
    optimizer = ForceOptimizer(GRASP, **OPTIMIZERS[name])
    return np.array([optimizer.solve(load).force for load in loads])


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_eight_threads_with_an_optimizer_each_or_with_one(name: str) -> None:
    """One belongs to one thread. Where it is shared all the same, and starts from no previous solution, answers are right."""
    loads = LOADS[: 30 if name == "general" else 200]
    alone, shared = forces(name, loads), ForceOptimizer(GRASP, **OPTIMIZERS[name])
    orders = [np.random.default_rng(k).permutation(len(loads)) for k in range(8)]
    with ThreadPoolExecutor(8) as pool:
        for found in pool.map(lambda _: forces(name, loads), range(8)):
            np.testing.assert_array_equal(found, alone)
        if name == "previous":
            return
        answers = pool.map(lambda order: [shared.solve(loads[k]).force for k in order], orders)
        for order, found in zip(orders, answers, strict=True):
            np.testing.assert_array_equal(found, alone[order])


def test_one_optimizer_that_remembers() -> None:
    """Shared, its solutions are still those of their own wrenches: from whatever start."""
    shared = ForceOptimizer(GRASP, **OPTIMIZERS["previous"])
    with ThreadPoolExecutor(8) as pool:
        for k, solution in enumerate(pool.map(shared.solve, LOADS)):
            np.testing.assert_array_equal(solution.wrench, LOADS[k])
            assert solution.equilibrium_residual < 1e-9
            assert solution.optimality_gap <= 1e-4


def in_a_child(optimizer: ForceOptimizer, load: np.ndarray, answers: multiprocessing.SimpleQueue) -> None:
    """With what came from the parent, and with its own."""
    batch = optimize_forces(optimizer.grasp, LOADS, method="newton", workers=2)
    answers.put((optimizer.solve(load).force, ForceOptimizer(GRASP, method="conic").solve(load).force, batch.force))


@pytest.mark.parametrize("way", ["fork", "spawn", "forkserver"])
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")
def test_processes_after_use(way: str) -> None:
    """The parent has used everything, threads of its batches too, before its children do."""
    optimizer = ForceOptimizer(GRASP, method="newton", initial="previous")
    optimizer.solve(LOADS[0])
    expected = optimize_forces(GRASP, LOADS, method="newton", workers=2).force
    context = multiprocessing.get_context(way)
    answers = context.SimpleQueue()
    children = [context.Process(target=in_a_child, args=(optimizer, LOADS[1], answers)) for _ in range(2)]
    for child in children:
        child.start()
    here = optimize_forces(GRASP, LOADS, method="newton", workers=2).force  # at the same time
    given = []
    deadline = threading.Timer(60.0, lambda: [child.kill() for child in children])
    deadline.start()
    for child in children:
        given.append(answers.get())
        child.join(60.0)
    deadline.cancel()
    assert [child.exitcode for child in children] == [0, 0]
    mine = optimizer.solve(LOADS[1]).force, ForceOptimizer(GRASP, method="conic").solve(LOADS[1]).force, expected
    np.testing.assert_array_equal(here, expected)
    for theirs in given:
        for one, other in zip(theirs, mine, strict=True):
            np.testing.assert_array_equal(one, other)


LONG = [("reduced_flow", "wrenches", 400_000), ("newton", "wrenches", 1_500_000), ("conic", "wrenches", 1_000_000), ("newton", "grasps", 300_000)]  # fmt: skip
"""Batches of seconds, within 0.6 GiB."""
CASES = [(*batch, workers) for batch in LONG for workers in (1, 2, None)]
INTERRUPTED = """
import signal, sys, threading, time
import numpy as np
from grasp_env.force import ForceOptimizer, optimize_forces
from grasp_env.grasp import presets

signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored, where a background job runs the tests
grasp, method, workers, many, count = presets.paper_cuboid(), sys.argv[1], eval(sys.argv[2]), sys.argv[3] == "grasps", int(sys.argv[4])
loads = np.random.default_rng(0).standard_normal((count, 6)) * [1, 1, 1, 0.05, 0.05, 0.05]
grasps = [grasp] * count if many else grasp
before = optimize_forces(grasp, loads[:50], method=method).force
sent = []
def interrupt():
    sent.append(time.perf_counter())
    signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
timer = threading.Timer(0.1, interrupt)
timer.start()
try:
    optimize_forces(grasps, loads, method=method, workers=workers, tolerance=1e-12)
    print("finished", file=sys.stderr)
    sys.exit(3)
except KeyboardInterrupt:
    took = time.perf_counter() - sent[0]
after = optimize_forces(grasp, loads[:50], method=method).force
assert (after == before).all()
begin = time.perf_counter()
while threading.active_count() > 1 and time.perf_counter() < begin + 5.0:
    time.sleep(0.01)
print(took, threading.active_count())
"""


@pytest.mark.parametrize(
    ("method", "kind", "count", "workers"), [CASES[1], *(pytest.param(*c, marks=pytest.mark.slow) for c in CASES)]
)
def test_an_interrupt_ends_a_batch(method: str, kind: str, count: int, workers: int | None) -> None:
    """Within about a second, at any length; what comes after it has the same bits."""
    command = [sys.executable, "-c", INTERRUPTED, method, str(workers), kind, str(count)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=ROOT, env=environment, timeout=120, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    took, threads = done.stdout.split()
    assert float(took) < 1.0
    assert threads == "1"


def test_an_interrupt_ends_a_loop() -> None:
    """Single calls are short: Python looks between them."""
    optimizer, begun = ForceOptimizer(GRASP, method="newton"), time.perf_counter()

    def loop() -> None:
        while time.perf_counter() < begun + 20.0:
            optimizer.solve(LOADS[0])

    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        threading.Timer(0.1, lambda: signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)).start()
        with pytest.raises(KeyboardInterrupt):
            loop()
    finally:
        signal.signal(signal.SIGINT, handler)
    np.testing.assert_array_equal(optimizer.solve(LOADS[0]).force, forces("newton", LOADS[:1])[0])

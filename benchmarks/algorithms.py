"""Time of each algorithm of the core on its problems, and of the one that could replace it there."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.benchmark import Benchmark, tick
from benchmarks.force.package import grasp_of
from benchmarks.force.problems import Problem, load
from benchmarks.problem import compiled_times
from grasp_env.errors import InfeasibleWrenchError, NotConvergedError
from grasp_env.force import ForceLimits, ForceOptimizer, optimize_forces
from grasp_env.force.record import CODE, CONVERGED, INFEASIBLE, LIMITS_EXCEEDED
from grasp_env.grasp import Grasp, presets
from grasp_env.grasp.wrench import sample_ball
from grasp_env.inputs.arguments import Array
from grasp_env.quality import payload
from training.data.grasps import BENCH
from training.evaluation.results.table import pd, table

ALGORITHMS = {
    "newton/newton": "Newton on Phi: four contacts stay in registers",
    "newton/limited": "Newton with limits: rank-one terms of a contact's block, and a border",
    "newton/soft": "Newton with torsion, the fourth variable of a contact",
    "newton/excess": "elastic: the force that exceeds the limits least",
    "general/phi_rows": "Newton for any contacts and limits, and after others give up",
    "many/problems": "Newton on several wrenches at once, one in each vector lane",
    "many/grasps": "Newton on several grasps at once",
    "layer/smooth": "Newton to the last digits, with gradients; elastic: penalties that stay smooth",
    "flow/flow": "the paper's gradient flow, reduced and full",
    "conic/conic": "interior point for the least sum of normal forces",
    "conic/limited": "the same with limits, other criteria, soft contacts or without force closure: rank-one terms and a border",
    "general/interior_point": "interior point for any contacts, and after others give up",
    "general/payload": "interior point for the largest load along a direction, called from Python",
}
"""Folder of each algorithm and the reason why it exists."""
TOLERANCE = 1e-6
TORSIONAL_FRICTION = 0.005
"""Torsional friction of the soft contacts [m]."""


@dataclass(frozen=True)
class AlgorithmSettings:
    """Settings of a benchmark.

    Attributes:
        wrenches: problems of each algorithm.
        passes: calls of each problem; its time is the shortest.
        seed: seed of the problems.
    """

    wrenches: int = 400
    passes: int = 10
    seed: int = 0


def run(settings: AlgorithmSettings) -> pd.DataFrame:
    """Return a row with the microseconds of each problem."""
    rows: list[dict[str, Any]] = []
    for method, problem, times in measured(settings):
        tick(f"{method}, {problem}")
        rows += [{"method": method, "case": problem, "microseconds": 1e6 * t} for t in times]
    return table(rows)


def measured(settings: AlgorithmSettings) -> Iterator[tuple[str, str, Array]]:
    """Yield the folder of an algorithm, a label of the problems, and seconds."""
    rng = np.random.default_rng(settings.seed)
    loads = sample_ball(rng, settings.wrenches)
    hard = presets.paper_cuboid()
    torsion: dict[str, Any] = {"contact_model": "soft", "torsional_friction": TORSIONAL_FRICTION}
    soft = Grasp.from_contacts(hard.positions, hard.normals, hard.friction, **torsion)
    pinch = Grasp.from_contacts(
        [[0.03, 0.0, 0.0], [-0.03, 0.0, 0.0]], [[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]], 0.6, **torsion
    )
    bounds = ForceLimits(max_normal=20.0)
    tight = ForceLimits(max_normal=1.0)
    heavy = 10.0 * loads / np.linalg.norm(loads, axis=1, keepdims=True)

    def timed(
        grasp: Grasp, wrenches: Array = loads, ending: float = CONVERGED, **options: Any
    ) -> Array:
        optimizer = ForceOptimizer(grasp, tolerance=TOLERANCE, **options)
        seconds, records = compiled_times(optimizer, wrenches, settings.passes)
        if not (records[:, CODE] == ending).all():
            raise NotConvergedError(f"problems with {options} ended in another way than expected")
        return seconds

    def hand(track: str, method: str) -> Array:
        times = [
            timed(grasp, problem.wrench[None], method=method, limits=limits)
            for problem in four_contacts(track)
            for grasp, limits in [grasp_of(problem)]
        ]
        return np.concatenate(times)

    yield "newton/newton", "hard", timed(hard)
    yield "newton/limited", "normal forces limited", timed(hard, limits=bounds)
    yield "newton/limited", "each joint moves one finger", hand("own", "newton")
    yield "newton/limited", "joints shared by fingers", hand("shared", "newton")
    yield "newton/limited", "soft, normal forces limited", timed(soft, limits=bounds)
    yield "newton/soft", "soft", timed(soft)
    yield "general/phi_rows", "two soft fingers", timed(pinch)
    yield "flow/flow", "hard, from the 12-basis", timed(hard, method="reduced_flow")
    yield "flow/flow", "hard, full, from the 12-basis", timed(hard, method="full_flow")
    yield "conic/conic", "hard", timed(hard, method="conic")
    conic_limits = timed(hard, method="conic", limits=bounds)
    yield "conic/limited", "normal forces limited", conic_limits
    yield "conic/limited", "each joint moves one finger", hand("own", "conic")
    yield "conic/limited", "joints shared by fingers", hand("shared", "conic")
    yield "conic/limited", "soft", timed(soft, method="conic")
    motors = ForceLimits(jacobian=jacobian(rng, 4, 12), torque_limit=np.inf)
    largest = timed(hard, method="conic", criterion="max", limits=bounds)
    yield "conic/limited", "the largest normal force, limited", largest
    torque = timed(hard, method="conic", criterion="torque", limits=motors)
    yield "conic/limited", "least norm of 12 joint torques", torque
    yield "general/interior_point", "two soft fingers", timed(pinch, method="conic")
    directions = loads[: max(1, len(loads) // 10)]
    yield "general/payload", "normal forces limited", payloads(hard, directions, bounds)
    yield "general/payload", "the same by bisection", bisections(hard, directions, bounds)
    excess = timed(hard, heavy, LIMITS_EXCEEDED, limits=tight, elastic=True)
    proof = timed(hard, heavy, INFEASIBLE, limits=tight)
    yield "newton/excess", "limits that no force meets, elastic", excess
    yield "newton/limited", "limits that no force meets, proof", proof

    grasps = [BENCH.closed(rng, 4) for _ in loads]
    options: dict[str, Any] = {"workers": 1, "tolerance": TOLERANCE}
    many = repeated(settings, lambda: optimize_forces(hard, loads, **options))
    yield "many/problems", "one grasp, many wrenches", many
    many = repeated(settings, lambda: optimize_forces(grasps, loads, **options))
    yield "many/grasps", "many grasps, a wrench each", many
    yield "layer/smooth", "batch, forward", layer(settings, hard, loads, None)
    yield "layer/smooth", "batch, forward and backward", layer(settings, hard, loads, None, True)
    yield "layer/smooth", "limits that no force meets, elastic", layer(settings, hard, heavy, 1.0)


def jacobian(rng: np.random.Generator, contacts: int, joints: int) -> Array:
    """Return a Jacobian (N, 3, J) with levers of about 50 mm [m]."""
    return 0.05 * rng.standard_normal((contacts, 3, joints))


def payloads(grasp: Grasp, directions: Array, limits: ForceLimits) -> Array:
    """Return seconds of `payload` for each direction (K, 6)."""
    return clocked(directions, lambda d: payload(grasp, d, limits))


def bisections(grasp: Grasp, directions: Array, limits: ForceLimits) -> Array:
    """Return seconds of the largest load by bisection for each direction (K, 6)."""
    solver = ForceOptimizer(grasp, initial="previous", limits=limits)
    return clocked(directions, lambda d: bisection(solver, d))


def bisection(solver: ForceOptimizer, direction: Array, tolerance: float = TOLERANCE) -> float:
    """Return the largest load along a direction, by solves that start from the last one."""

    def holds(load: float) -> bool:
        try:
            solver.solve(load * direction)
        except InfeasibleWrenchError:
            return False
        return True

    low, high = 0.0, 1.0
    while holds(high):
        low, high = high, 2.0 * high
    while high - low > tolerance * high:
        middle = 0.5 * (low + high)
        if holds(middle):
            low = middle
        else:
            high = middle
    return low


def clocked(arguments: Array, call: Callable[[Array], Any]) -> Array:
    """Return the seconds of a call with each argument."""
    times = np.empty(len(arguments))
    for k, argument in enumerate(arguments):
        begin = time.perf_counter()
        call(argument)
        times[k] = time.perf_counter() - begin
    return times


def four_contacts(track: str) -> Iterator[Problem]:
    """Yield the first ten problems of each session of a track with four contacts."""
    for session in load(track).sessions:
        if session.problems[0].n_contacts == 4:
            yield from (p for p in session.problems[:10] if p.active.all())


def repeated(settings: AlgorithmSettings, call: Callable[[], Any]) -> Array:
    """Return seconds per problem of a call that solves `settings.wrenches`, for each pass."""
    call()
    times = np.empty(settings.passes)
    for k in range(settings.passes):
        begin = time.perf_counter()
        call()
        times[k] = time.perf_counter() - begin
    return times / settings.wrenches


def layer(
    settings: AlgorithmSettings,
    grasp: Grasp,
    loads: Array,
    max_normal: float | None,
    backward: bool = False,
) -> Array:
    """Return seconds per problem of the force layer on one core."""
    import torch

    from policies.layer import grasp_force

    torch.set_num_threads(1)
    fields = (grasp.positions, grasp.normals, grasp.friction)
    positions, normals, friction = (torch.from_numpy(np.array(field)) for field in fields)
    wrenches = torch.from_numpy(loads).requires_grad_(backward)
    options: dict[str, Any] = {"max_normal": max_normal, "tolerance": TOLERANCE}
    if max_normal is not None:
        options["infeasible"] = "elastic"

    def call() -> None:
        forces = grasp_force(positions, normals, friction, wrenches, **options)
        if backward:
            forces.force.sum().backward()

    return repeated(settings, call)


BENCHMARK = Benchmark(
    run,
    AlgorithmSettings(),
    quick={"wrenches": 40, "passes": 2},
    shown=("microseconds_median", "microseconds_p99"),
    words=ALGORITHMS,
)

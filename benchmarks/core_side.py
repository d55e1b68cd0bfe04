"""One side of the benchmark `core`, run in a checkout; it writes its rows as lines of JSON.

`python -c <this source> OUT PROBLEMS PASSES BEGIN ROW...` imports only numpy and parts of
`grasp_env` that both checkouts have.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

WARM_UP = 20
"""Number of untimed calls of every row."""
Case = dict[str, Any]
"""A grasp with wrenches (n, 6), and a smooth path: points (n, N, 3), Jacobians (n, N, 3, J) etc."""
Answers = tuple[Any, list[float]]
"""Least seconds (n,) of each call, and the objectives (n,), nan where not optimal."""


def timed(
    passes: int,
    call: Any,
    calls: list[Any],
    restart: Callable[[], Any] = lambda: None,
    expected: str = "OPTIMAL",
) -> Answers:
    """Time `call(*calls[k])`; a solve includes the reading of `.force` and `.status`.

    A pass begins with `restart()` and an untimed call.
    """
    solves = not hasattr(call(*calls[0]), "length")  # or makes a grasp
    for arguments in calls[:WARM_UP]:
        call(*arguments)
    best = np.full(len(calls), np.inf)
    for _ in range(passes):
        restart()
        call(*calls[0])
        for k, arguments in enumerate(calls):
            begin = time.perf_counter_ns()
            result = call(*arguments)
            if solves:
                force, status = result.force, result.status  # noqa: F841
            best[k] = min(best[k], time.perf_counter_ns() - begin)
    restart()
    results = [call(*arguments) for arguments in calls]
    if not solves:
        return 1e-9 * best, [grasp.length for grasp in results]
    values = [
        np.nan if s.status.name != expected else s.objective if expected == "OPTIMAL" else 1.0
        for s in results
    ]
    return 1e-9 * best, values


def python(
    case: Case, passes: int, grasp: str = "grasp", wrenches: str = "wrenches", **options: Any
) -> Answers:
    """Time `ForceOptimizer(grasp, **options).solve(wrench)`."""
    from grasp_env.force import ForceOptimizer

    optimizer = ForceOptimizer(case[grasp], **options)
    loads = [(wrench.copy(),) for wrench in case[wrenches]]
    return timed(passes, optimizer.solve, loads, lambda: setattr(optimizer, "previous", None))


def compiled(case: Case, passes: int, **options: Any) -> Answers:
    """Time the compiled call in C++, start and certificate included; objectives are from Python."""
    from grasp_env.force import ForceOptimizer

    solver = ForceOptimizer(case["grasp"], **options).core
    loads = case["wrenches"]
    best = np.empty(len(loads))
    records = np.zeros((len(loads), solver.size))
    solver.times(loads[:WARM_UP], 1, records[:WARM_UP], best[:WARM_UP])
    solver.times(loads, passes, records, best)
    return best, python(case, 1, **options)[1]


def path_of(case: Case, *more: str) -> list[Any]:
    """Return (points, normals, wrench, ...) of each step."""
    names = ("points", "normals", "wrenches", *more)
    return list(zip(*(case[f"path_{name}"] for name in names), strict=True))


def moving(case: Case, passes: int, **options: Any) -> Answers:
    """Time `solve` with moving contacts, from Python."""
    from grasp_env.force import ForceOptimizer

    optimizer = ForceOptimizer(case["grasp"], method="newton", tolerance=1e-4, **options)

    def solve(points: Any, normals: Any, wrench: Any) -> Any:
        return optimizer.solve(wrench, positions=points, normals=normals)

    return timed(passes, solve, path_of(case), lambda: setattr(optimizer, "previous", None))


def within_limits(
    case: Case, passes: int, share: float = 1.0, expected: str = "OPTIMAL", **options: Any
) -> Answers:
    """Time the same with the current Jacobian, within a share of the torque limits."""
    from grasp_env.errors import InfeasibleWrenchError
    from grasp_env.force import ForceLimits, ForceOptimizer

    limits = ForceLimits(
        jacobian=case["path_jacobians"][0], torque_limit=share * case["torque_limit"]
    )
    optimizer = ForceOptimizer(
        case["grasp"], limits=limits, method="newton", tolerance=1e-4, **options
    )

    def solve(points: Any, normals: Any, wrench: Any, jacobian: Any) -> Any:
        try:
            return optimizer.solve(wrench, positions=points, normals=normals, jacobian=jacobian)
        except InfeasibleWrenchError as error:
            return error.solution

    return timed(
        passes,
        solve,
        path_of(case, "jacobians"),
        lambda: setattr(optimizer, "previous", None),
        expected,
    )


def new_contacts(case: Case, passes: int, **options: Any) -> Answers:
    """Time `Grasp.from_contacts` with `optimize_force` along the path."""
    from grasp_env.force import optimize_force
    from grasp_env.grasp import Grasp

    def call(points: Any, normals: Any, wrench: Any) -> Any:
        return optimize_force(
            Grasp.from_contacts(points, normals, case["friction"]), wrench, **options
        )

    return timed(passes, call, path_of(case))


def grasps_of(case: Case) -> list[Any]:
    """Return the grasps of the path."""
    from grasp_env.grasp import Grasp

    contacts = zip(case["path_points"], case["path_normals"], strict=True)
    return [Grasp.from_contacts(*pair, case["friction"]) for pair in contacts]


def batch(case: Case, passes: int, **options: Any) -> Answers:
    """Time `optimize_forces` of as many grasps as wrenches on one core; a call's is the mean."""
    from grasp_env.force import optimize_forces

    best = np.inf
    loads = case["path_wrenches"].copy()
    result: Any = None
    for _ in range(passes + 1):
        grasps = grasps_of(case)
        begin = time.perf_counter_ns()
        result = optimize_forces(grasps, loads, workers=1, **options)
        best = min(best, time.perf_counter_ns() - begin)
    return np.full(len(loads), 1e-9 * best / len(loads)), np.where(
        result.optimal, result.objective, np.nan
    ).tolist()


def constructor(case: Case, passes: int, **options: Any) -> Answers:
    """Time `ForceOptimizer(grasp, **options)` of new grasps."""
    from grasp_env.force import ForceOptimizer

    best = np.full(len(case["path_points"]), np.inf)
    for turn in range(passes + 1):  # the first one warms up
        for k, grasp in enumerate(grasps_of(case)):
            begin = time.perf_counter_ns()
            ForceOptimizer(grasp, **options)
            if turn:
                best[k] = min(best[k], time.perf_counter_ns() - begin)
    return 1e-9 * best, [1.0] * len(best)


def new_grasp(case: Case, passes: int, name: str, third: Any) -> Answers:
    """Time a constructor of `Grasp` along the path."""
    path = zip(case["path_points"], case["path_normals"], strict=True)
    calls = [(*contacts, third) for contacts in path]
    return timed(passes, getattr(type(case["grasp"]), name), calls)


ROWS: dict[str, tuple[str, Callable[[Case, int], Answers]]] = {
    "newton": (
        "Newton on Phi to 1e-8, compiled call",
        partial(compiled, method="newton", tolerance=1e-8),
    ),
    "newton_python": (
        "the same, ForceOptimizer.solve from Python",
        partial(python, method="newton", tolerance=1e-8),
    ),
    "newton_default": (
        "the same to 1e-4, the default",
        partial(python, method="newton", tolerance=1e-4),
    ),
    "newton_previous": (
        "ForceOptimizer.solve to 1e-8, initial='previous', wrenches on a smooth path",
        partial(
            python, wrenches="path_wrenches", method="newton", tolerance=1e-8, initial="previous"
        ),
    ),
    "conic": ("conic to 1e-6, compiled call", partial(compiled, method="conic", tolerance=1e-6)),
    "conic_python": (
        "the same, ForceOptimizer.solve from Python",
        partial(python, method="conic", tolerance=1e-6),
    ),
    "moving_newton": (
        "current contacts to certified force by newton to 1e-4, no history, from Python",
        moving,
    ),
    "moving_newton_previous": (
        "the same from the previous solution",
        partial(moving, initial="previous"),
    ),
    "moving_limits": (
        "current contacts and Jacobian within torque limits, newton to 1e-4, from Python",
        within_limits,
    ),
    "moving_limits_previous": (
        "the same from the previous solution",
        partial(within_limits, initial="previous"),
    ),
    "moving_limits_infeasible": (
        "the same where no force keeps the limits, with the error",
        partial(within_limits, share=0.05, expected="INFEASIBLE"),
    ),
    "new_contacts_newton": (
        "Grasp.from_contacts and optimize_force, newton to 1e-4",
        partial(new_contacts, method="newton"),
    ),
    "new_contacts_conic": ("the same, conic to 1e-6", partial(new_contacts, method="conic")),
    "batch_grasps_newton": (
        "optimize_forces of as many grasps as wrenches on one core, newton",
        partial(batch, method="newton"),
    ),
    "batch_grasps_conic": ("the same, conic", lambda *given: batch(*given, method="conic")),
    "constructor": (
        "ForceOptimizer(grasp, method='newton') of a new grasp",
        partial(constructor, method="newton"),
    ),
    "from_contacts": (
        "Grasp.from_contacts",
        lambda case, passes: new_grasp(case, passes, "from_contacts", case["friction"]),
    ),
    "unchecked": (
        "Grasp.unchecked",
        lambda case, passes: new_grasp(case, passes, "unchecked", case["grasp"].models),
    ),
    "flow": ("the paper's flow, ForceOptimizer.solve", partial(python, method="reduced_flow")),
    "soft": (
        "soft contacts, newton to 1e-4, ForceOptimizer.solve",
        partial(python, grasp="soft", method="newton", tolerance=1e-4),
    ),
    "max": (
        "least largest normal force, conic to 1e-6, ForceOptimizer.solve",
        partial(python, method="conic", criterion="max"),
    ),
}
"""Timed calls by label, each a function of a case and the number of passes."""


def cases(path: str) -> Iterator[Case]:
    """Yield the cases that the driver wrote, with their grasps."""
    from grasp_env.grasp import Grasp

    arrays = np.load(path)
    for group in sorted({name.partition("/")[0] for name in arrays.files}):
        case: Case = {
            name.partition("/")[2]: arrays[name]
            for name in arrays.files
            if name.startswith(f"{group}/")
        }
        case["path_jacobians"] = jacobians(case["path_joints"])
        contacts = case["positions"], case["normals"], case["friction"]
        case["grasp"] = Grasp.from_contacts(*contacts)
        gamma = 0.1 * case["friction"] * case["grasp"].length
        case["soft"] = Grasp.from_contacts(
            *contacts, contact_model="soft", torsional_friction=gamma
        )
        yield case


def jacobians(joints: Any) -> Any:
    """Return (n, N, 3, 3 N) for fingers of three joints each, whose own blocks are (n, N, 3, 3)."""
    steps, count = joints.shape[:2]
    matrices = np.zeros((steps, count, 3, count, 3))
    for finger in range(count):
        matrices[:, finger, :, finger] = joints[:, finger]
    return matrices.reshape(steps, count, 3, 3 * count)


def lines(problems: str, passes: int, names: tuple[str, ...]) -> Iterator[dict[str, Any]]:
    """Yield microseconds and objectives of all problems, or why a row cannot be timed."""
    problem_cases = list(cases(problems))
    for name in names:
        try:
            answers = [ROWS[name][1](case, passes) for case in problem_cases]
        except Exception as error:
            yield {"method": name, "reason": f"{type(error).__name__}: {error}"}
            continue
        seconds, values = (np.concatenate(arrays) for arrays in zip(*answers, strict=True))
        for problem, second in enumerate(seconds.tolist()):
            value = float(values[problem])
            yield {
                "method": name,
                "problem": problem,
                "microseconds": 1e6 * second,
                "objective": value if np.isfinite(value) else None,
            }


def main(out: str, problems: str, passes: str, begin: str, *names: str) -> None:
    """Write the package and the time of the first solve since `begin` (CLOCK_MONOTONIC), then rows."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    import grasp_env
    from grasp_env.force import optimize_force
    from grasp_env.grasp import presets

    force = optimize_force(
        presets.paper_cuboid(), [1, 0.5, -0.6, -0.1, 0.2, 0], method="newton"
    ).force
    first = 1e3 * (time.monotonic() - float(begin)) if np.isfinite(force).all() else None
    about = {
        "root": os.path.dirname(os.path.dirname(os.path.abspath(grasp_env.__file__))),
        "milliseconds": first,
    }
    with open(out, "w", encoding="utf-8") as file:
        file.writelines(
            json.dumps(line) + "\n" for line in (about, *lines(problems, int(passes), names))
        )


if __name__ == "__main__":
    main(*sys.argv[1:])

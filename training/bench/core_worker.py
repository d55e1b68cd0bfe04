"""One side of `grasp bench core`: times what the checkout in the working directory has, mostly by its public interface.

Any checkout's interpreter is given this source (`python -c`), so it imports only what an old one has too. It answers every line
of JSON on stdin by one on stdout: {"contacts", "wrenches", "seed"} makes problems, {"row", "passes"} times a row of them,
passes 0 tells what its calls find. An "error" in an answer is the reason why there is no such row.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

import grasp_env
from grasp_env.force import ForceOptimizer, ForcePipeline, phase_one
from grasp_env.grasp import Grasp
from training.bench.grasps import problems
from training.runs import provenance

Array = NDArray[np.float64]
WARM_UP = 20
"""Calls before the clock starts, at every request."""
STEP = 0.03
"""Between neighbours on a path [rad]: 200 calls go round once."""
SHIFT, TILT = 2e-3, 0.05
"""How far contacts move on a path [m], how far their normals tilt [rad]."""


@dataclass(frozen=True)
class Case:
    """One grasp with its wrenches (n, 6), and a smooth path of n (points (N, 3), normals (N, 3), wrench (6,))."""

    grasp: Grasp
    wrenches: Array
    path: list[tuple[Array, Array, Array]]


@dataclass(frozen=True)
class Timed:
    """A row's `times(passes)`, the best seconds (n,) of every call, and `answers()`, its objectives (n,), nan where not optimal."""

    times: Callable[[int], Array]
    answers: Callable[[], list[float]]


def cases(seed: int, count: int, wrenches: int) -> list[Case]:
    """The problems of the other benchmarks, and a path round each grasp on which it keeps force closure."""
    rng, out = np.random.default_rng([seed, count, 1]), []
    for grasp, loads in problems(seed, count, wrenches):
        angle = STEP * np.arange(len(loads))[:, None, None]
        phase, shift, tilt = rng.uniform(0.0, 2.0 * np.pi, (count, 1)), *rng.uniform(-1.0, 1.0, (2, count, 3))
        part = 1.0  # of the way: halved until closure is kept
        while True:
            points = grasp.positions + part * SHIFT * shift * np.sin(angle + phase)
            normals = grasp.normals + part * TILT * tilt * np.cos(angle + phase)
            normals /= np.sqrt((normals**2).sum(axis=2, keepdims=True))
            if all(closed(p, n, grasp) for p, n in zip(points, normals, strict=True)):
                break
            part *= 0.5
        path = np.cos(angle[:, 0]) * loads[0] + np.sin(angle[:, 0]) * loads[1]
        out.append(
            Case(grasp, loads, [(p.copy(), n.copy(), w.copy()) for p, n, w in zip(points, normals, path, strict=True)])
        )
    return out


def closed(points: Array, normals: Array, grasp: Grasp) -> bool:
    """Whether contacts with the friction of `grasp` have force closure."""
    return phase_one(Grasp.from_contacts(points, normals, grasp.friction), np.zeros(6)).feasible


def solving(solve: Callable[..., Any], calls: list[Any], restart: Callable[[], object]) -> Timed:
    """`solve(*call)` and the reading of `.force` and `.status`; a pass begins with `restart()` and the first call, untimed."""

    def times(passes: int) -> Array:
        for call in calls[:WARM_UP]:
            solve(*call)
        best = np.full(len(calls), np.inf)
        for _ in range(passes):
            restart()
            solve(*calls[0])
            for k, call in enumerate(calls):
                begin = time.perf_counter_ns()
                solution = solve(*call)
                force, status = solution.force, solution.status  # noqa: F841  reading is part of what is timed
                best[k] = min(best[k], time.perf_counter_ns() - begin)
        return 1e-9 * best

    def answers() -> list[float]:
        restart()
        solutions = [solve(*call) for call in calls]
        return [s.objective if s.status.name == "OPTIMAL" else np.nan for s in solutions]

    return Timed(times, answers)


def making(make: Callable[..., Grasp], calls: list[Any]) -> Timed:
    """`make(*call)` -> Grasp; its answer is the grasp's length [m]."""

    def times(passes: int) -> Array:
        for call in calls[:WARM_UP]:
            make(*call)
        best = np.full(len(calls), np.inf)
        for _ in range(passes):
            for k, call in enumerate(calls):
                begin = time.perf_counter_ns()
                make(*call)
                best[k] = min(best[k], time.perf_counter_ns() - begin)
        return 1e-9 * best

    return Timed(times, lambda: [make(*call).length for call in calls])


def compiled(method: str, tolerance: float) -> Callable[[Case], Timed]:
    """The compiled call alone, start and certificate included; its answers are those from Python."""

    def timed(case: Case) -> Timed:
        from training.bench.timing import compiled_times

        optimizer = ForceOptimizer(case.grasp, method=method, tolerance=tolerance)
        records = np.empty((len(case.wrenches), 20 + 7 * case.grasp.n_contacts))
        asked = python(method=method, tolerance=tolerance)(case)
        return Timed(lambda passes: compiled_times(optimizer, case.wrenches, passes, records), asked.answers)

    return timed


def python(on_path: bool = False, **options: Any) -> Callable[[Case], Timed]:
    """`ForceOptimizer(grasp, **options).solve(wrench)`, of the wrenches or of those on the path."""

    def timed(case: Case) -> Timed:
        optimizer = ForceOptimizer(case.grasp, **options)
        loads = [w for _, _, w in case.path] if on_path else [w.copy() for w in case.wrenches]
        return solving(optimizer.solve, [(w,) for w in loads], lambda: setattr(optimizer, "previous", None))

    return timed


def soft(case: Case) -> Case:
    """The same contacts with torsion up to a tenth of friction times the grasp's length."""
    g = case.grasp
    gamma = 0.1 * g.friction * g.length
    made = Grasp.from_contacts(g.positions, g.normals, g.friction, contact_model="soft", torsional_friction=gamma)
    return Case(made, case.wrenches, case.path)


def pipeline(method: str) -> Callable[[Case], Timed]:
    """`ForcePipeline(grasp, method=method).solve(points, normals, wrench)` along the path."""

    def timed(case: Case) -> Timed:
        made = ForcePipeline(case.grasp, method=method)
        return solving(made.solve, case.path, made.reset)

    return timed


ROWS: dict[str, Callable[[Case], Timed]] = {
    "newton": compiled("newton", 1e-8),
    "newton_python": python(method="newton", tolerance=1e-8),
    "newton_default": python(method="newton", tolerance=1e-4),
    "newton_previous": python(on_path=True, method="newton", tolerance=1e-8, initial="previous"),
    "conic": compiled("conic", 1e-6),
    "conic_python": python(method="conic", tolerance=1e-6),
    "pipeline_newton": pipeline("newton"),
    "from_contacts": lambda case: making(Grasp.from_contacts, [(p, n, case.grasp.friction) for p, n, _ in case.path]),
    "unchecked": lambda case: making(Grasp.unchecked, [(p, n, case.grasp.models) for p, n, _ in case.path]),
    "flow": python(method="reduced_flow"),
    "pipeline_flow": pipeline("reduced_flow"),
    "soft": lambda case: python(method="newton", tolerance=1e-4)(soft(case)),
    "max": python(method="conic", criterion="max"),
}


class Worker:
    """The problems of now and the rows made for them."""

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """The answer to one request."""
        if "contacts" in request:
            self.cases = cases(request["seed"], request["contacts"], request["wrenches"])
            self.made: dict[str, list[Timed]] = {}
            mixed = [
                float(np.sin(np.arange(w.size)) @ w.ravel())
                for c in self.cases
                for w in (c.grasp.positions, c.wrenches)
            ]
            return {"problems": mixed}
        row = request["row"]
        try:
            if row not in self.made:
                self.made[row] = [ROWS[row](case) for case in self.cases]
            passes = request.get("passes")
            found = [timed.times(passes) if passes else timed.answers() for timed in self.made[row]]
            return {"values": [float(value) if np.isfinite(value) else None for part in found for value in part]}
        except Exception as error:
            return {"error": f"{type(error).__name__}: {error}"}


def serve() -> None:
    """Says who it is, then answers until stdin ends."""
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print is no answer
    worker, about = Worker(), provenance()
    hello = {"root": str(Path(grasp_env.__file__).parents[1]), "commit": about["commit"], "versions": about["versions"]}
    _say(out, hello)
    for line in sys.stdin:
        _say(out, worker.answer(json.loads(line)))


def _say(out: TextIO, answer: dict[str, Any]) -> None:
    out.write(json.dumps(answer) + "\n")
    out.flush()


if __name__ == "__main__":
    serve()

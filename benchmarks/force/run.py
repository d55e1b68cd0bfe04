"""Runs of entrants on tracks in turns; the time of a problem is the least of its calls."""

from __future__ import annotations

import ctypes
import gc
import importlib
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.force.build import library
from benchmarks.force.entrant import CProblem, Entrant, Library, Task, status_of
from benchmarks.force.entrants import ENTRANTS
from benchmarks.force.package import problem_of
from benchmarks.force.problems import OBJECTIVES, Array, Problem, Session, Track
from benchmarks.force.score import Parts, parts_of, score
from grasp_env.grasp import presets
from grasp_env.inputs.files import import_file

HERE = Path(__file__).parent
Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class Effort:
    """Amount of timing.

    Attributes:
        rounds: rounds in which the entrants take turns, so that a busy moment affects all alike.
        seconds: time for further passes of an entrant in a round.
        passes: largest number of passes in a round.
        sessions, problems: largest numbers per track and per session; None: all.
    """

    rounds: int = 2
    seconds: float = 0.4
    passes: int = 15
    sessions: int | None = None
    problems: int | None = None


QUICK = Effort(rounds=1, seconds=0.02, passes=3, sessions=3, problems=4)
SAME = 1e-9
"""Largest difference of results that count as equal, relative to the largest force."""


class Timed:
    """An entrant set up for a session.

    Args:
        solver: the entrant.
        task: argument of its `setup`.
        problems: copies of the session's problems for this entrant.

    Attributes:
        answers: distinct results of all passes for each problem; all of them are scored.
        iterations: iterations of the first pass, nan if unknown.
        seconds: (M,) least time of all passes.
        calls: number of passes.
        many: results and seconds per problem in a call of `solve_many`, if it exists.
    """

    def __init__(self, solver: Any, task: Task, problems: list[Problem]) -> None:
        self.solver = solver
        self.task = task
        self.problems = problems
        self.answers: list[list[Parts]] = [[] for _ in problems]
        self.iterations = np.full(len(problems), np.nan)
        self.seconds = np.full(len(problems), np.inf)
        self.calls = 0
        self.many: tuple[list[Parts], float] | None = None
        self._pass = self._in_python
        if hasattr(solver, "compiled"):
            self._pass = self._in_c
            timer()  # it may have to be compiled, or there is no compiler
        solver.setup(task)

    def passes(self, count: int) -> float:
        """Make passes over the problems in their order; return the seconds that they took."""
        begin = time.perf_counter()
        for _ in range(count):
            self._pass()
            self.calls += 1
        seconds = time.perf_counter() - begin
        if self.task.mode == "persistent" and hasattr(self.solver, "solve_many"):
            self._all_at_once()
        return seconds

    def _keep(self, m: int, answer: Parts, iterations: float) -> None:
        """Keep an answer that differs from the earlier ones."""
        earlier = self.answers[m]
        if not earlier:
            self.iterations[m] = iterations
        if not any(same(answer, other) for other in earlier):
            earlier.append(answer)

    def _in_python(self) -> None:
        solve = self.solver.solve
        setup = self.solver.setup
        clock = time.perf_counter_ns
        cold = self.task.mode == "cold"
        warm = self.task.mode == "warm"
        start = None
        for m in range(-1, len(self.problems)):  # first the last one, untimed, as in timer.c
            problem = self.problems[m]
            task = replace(self.task, first=problem) if cold else self.task
            answer: Any = None
            begin = clock()
            try:
                if cold:
                    setup(task)
                answer = solve(problem, start)
            except Exception as error:  # an error of a solver must not end the benchmark
                answer = error
            seconds = 1e-9 * (clock() - begin)
            if m < 0:
                continue
            self.seconds[m] = min(self.seconds[m], seconds)
            parts = parts_of(problem, answer)
            start = None
            if warm and parts.force is not None and parts.status == "solved":
                start = parts.force.copy()
            self._keep(m, parts, getattr(self.solver, "iterations", np.nan))

    def _in_c(self) -> None:
        compiled = self.solver.compiled()
        n = len(self.problems)
        first = self.problems[0]
        views = (CProblem * n)(*map(CProblem.of, self.problems))
        forces = np.full((n, first.matrix.shape[1]), np.nan)
        multipliers = np.full((n, 6 + len(first.limit_bound)), np.nan)
        statuses = np.zeros(n, np.int32)
        iterations = np.full(n, -1, np.int32)
        seconds = np.empty(n)
        cold = self.task.mode == "cold"
        calls = (compiled.solve, compiled.context, compiled.setup * cold, compiled.close * cold)
        results = (forces, multipliers, statuses, iterations, seconds)
        timer().force_times(
            *(ctypes.c_void_p(address or None) for address in calls),
            self.task.objective.encode(),
            views,
            n,
            int(self.task.mode == "warm"),
            *(ctypes.c_void_p(array.ctypes.data) for array in results),
        )
        self.seconds = np.minimum(self.seconds, seconds)
        for m, problem in enumerate(self.problems):
            proof = None if np.isnan(multipliers[m]).any() else multipliers[m]
            steps = np.nan if iterations[m] < 0 else float(iterations[m])
            answer = forces[m], proof, status_of(int(statuses[m]))
            self._keep(m, parts_of(problem, answer), steps)

    def _all_at_once(self) -> None:
        begin = time.perf_counter()
        try:
            answers = self.solver.solve_many(self.problems)
            seconds = (time.perf_counter() - begin) / len(self.problems)
            parts = [parts_of(*pair) for pair in zip(self.problems, answers, strict=True)]
        except Exception:  # such as NotImplementedError: this batch is not supported
            return
        self.many = parts, min(seconds, self.many[1] if self.many else np.inf)


def same(one: Parts, other: Parts) -> bool:
    """Return True if two answers to a problem are equal up to `SAME`."""
    if one.status != other.status or (one.force is None) != (other.force is None):
        return False
    if one.force is None or other.force is None:
        return one.status == "failed" or (one.multipliers is None) == (other.multipliers is None)
    return bool(np.abs(one.force - other.force).max() <= SAME * np.abs(other.force).max())


class Empty:
    """The control, which returns the same zeros for every problem."""

    name, note = "empty", "an empty call, the control"

    def setup(self, task: Task) -> None:
        """Make the zeros."""
        self._zeros = np.zeros(task.first.matrix.shape[1])

    def solve(self, problem: Problem, start: Array | None = None) -> Array:
        """Return the zeros."""
        return self._zeros


def entrants(chosen: Sequence[str]) -> dict[str, Callable[[], Entrant]]:
    """Return the constructors of entrants by name.

    Args:
        chosen: names of `ENTRANTS`, FILE.py:CLASS, or FILE.so:FUNCTION.

    Raises:
        ValueError: there is no such entrant, or two have one name.
    """
    makers: dict[str, Callable[[], Any]] = {}
    for spec in chosen:
        location, _, attribute = ENTRANTS.get(spec, spec).rpartition(":")
        if not location:
            raise ValueError(
                f"no entrant {spec!r}: choose of {', '.join(ENTRANTS)}, or give FILE.py:CLASS or FILE.so:FUNCTION"
            )
        name = spec if spec in ENTRANTS else attribute
        if location.endswith(".so"):
            if not os.path.isfile(location):
                raise ValueError(f"there is no file {location}: give FILE.so:FUNCTION")
            make: Any = partial(Library, str(Path(location).resolve()), attribute)
        else:
            make = getattr(_module(location), attribute, None)
            if make is None:
                raise ValueError(f"{location} has no {attribute}: give FILE.py:CLASS")
            if lacking := [m for m in ("setup", "solve") if not callable(getattr(make, m, None))]:
                raise ValueError(
                    f"{spec} has no {' and no '.join(lacking)}: see Entrant in benchmarks/force/entrant.py"
                )
            name = spec if spec in ENTRANTS else getattr(make, "name", attribute)
        if name in (*makers, Empty.name):
            raise ValueError(
                f"two entrants are called {name!r}: give {spec} another name, or leave the other out by --against"
            )
        makers[name] = make
    return makers


def measured(
    tracks: Sequence[Track],
    chosen: dict[str, Callable[[], Entrant]],
    effort: Effort,
    tell: Callable[[str], None] = lambda text: None,
) -> tuple[Rows, dict[str, dict[str, Any]]]:
    """Time the entrants on the tracks.

    Returns:
        A row for each entrant, objective, mode and problem, and one with a `reason` if an entrant
        does not take part in a track; and the notes of the entrants.
    """
    rows: Rows = []
    descriptions: dict[str, dict[str, Any]] = {}
    cells = (
        (track, *cell)
        for track in tracks
        for cell in product(track.about["objectives"], track.about["modes"])
    )
    for track, objective, mode in cells:
        key = {"case": track.name, "objective": objective, "mode": mode}
        sessions = track.sessions[: effort.sessions]
        ready: dict[str, list[Timed]] = {}
        for name, make in {Empty.name: Empty, **chosen}.items():
            if objective not in getattr(make, "objectives", OBJECTIVES):
                continue
            tell(f"{track.name}, {objective}, {mode}: setting up {name}")
            try:
                ready[name] = []
                for session in sessions:
                    solver = make()
                    problems = session.copies()[: effort.problems]
                    if not getattr(solver, "margins", False):
                        problems = [problem.shifted() for problem in problems]
                    task = Task(track.name, objective, mode, problems[0])
                    ready[name].append(Timed(solver, task, problems))
            except Exception as error:  # other entrants continue
                del ready[name]
                reason = str(error)
                if not isinstance(error, ImportError | NotImplementedError):
                    reason = f"its setup failed: {type(error).__name__}: {error}"
                rows.append(key | {"method": name, "reason": reason[:300]})
        _take_turns(ready, effort, lambda text, track=track: tell(f"{track.name}: {text}"))
        for name, timed_sessions in ready.items():
            solver = timed_sessions[0].solver
            noted = [a for a in ("note", "training_seconds") if hasattr(solver, a)]
            descriptions[name] = {a: getattr(solver, a) for a in noted}
            key |= {
                "method": name,
                "division": getattr(solver, "division", "closed"),
                "language": "C" if hasattr(solver, "compiled") else "Python",
            }
            for session, timed in zip(sessions, timed_sessions, strict=True):
                rows += [key | row for row in scored(session, timed)]
    return rows, descriptions


def scored(session: Session, timed: Timed) -> Iterator[dict[str, Any]]:
    """Yield a row for each problem of a session: its time and the score of its worst answer."""
    objective = timed.task.objective
    best = session.references[objective].value.tolist()
    for m, (problem, given, answers) in enumerate(
        zip(session.problems, timed.problems, timed.answers, strict=False)
    ):
        many = [timed.many[0][m]] if timed.many else []
        moved = [_moved(answer, problem.shift - given.shift) for answer in (*answers, *many)]
        scores = [score(problem, objective, best[m], answer) for answer in moved]
        row = {
            "event": session.name,
            "problem": m,
            "microseconds": 1e6 * timed.seconds[m],
            "iterations": timed.iterations[m],
            "calls": timed.calls,
        }
        if timed.many and scores.pop()["solved"]:
            row["many_microseconds"] = 1e6 * timed.many[1]
        yield row | min(scores, key=lambda s: (s["solved"], s["solved_coarse"], s["proved"]))


def unit() -> float:
    """Return the unit for comparing machines [us].

    It is the median of 30 cold solves of the README's first problem by SciPy's SLSQP.
    """
    slsqp = entrants(["slsqp"])["slsqp"]()
    problem = problem_of(presets.paper_cuboid(), [1.0, 0.5, -0.6, -0.1, 0.2, 0.0])
    times = []
    for _ in range(30):
        begin = time.perf_counter()
        slsqp.setup(Task("unit", "sum", "cold", problem))
        slsqp.solve(problem)
        times.append(1e6 * (time.perf_counter() - begin))
    return float(np.median(times))


@cache
def timer() -> Any:
    """Return the clock in C, compiled once; a `RuntimeError` says that there is no compiler."""
    return ctypes.CDLL(str(library("timer", [HERE / "timer.c"], ["-O2"], (HERE / "force.h",))))


@contextmanager
def no_garbage_collection() -> Iterator[None]:
    """Collect garbage, and then not until the block ends: a timed call might contain it."""
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()


def _take_turns(ready: dict[str, list[Timed]], effort: Effort, tell: Callable[[str], None]) -> None:
    """Make passes of all entrants in turn, without garbage collection."""
    with no_garbage_collection():
        for turn in range(effort.rounds):
            for name, timed_sessions in ready.items():
                tell(f"round {turn + 1} of {effort.rounds}: {name}")
                seconds = sum(timed.passes(1) for timed in timed_sessions)
                more = int(np.clip(effort.seconds / max(seconds, 1e-9), 0, effort.passes - 1))
                for timed in timed_sessions if more else ():
                    timed.passes(more)


def _moved(answer: Parts, by: Array) -> Parts:
    """Return an answer with its normal forces moved by (N,) [N]."""
    if answer.force is None:
        return answer
    force = answer.force.reshape(len(by), -1).copy()
    force[:, 0] += by
    return answer._replace(force=force.reshape(-1))


def _module(location: str) -> Any:
    if not location.endswith(".py"):
        return importlib.import_module(location)
    path = Path(location).resolve()
    if not path.is_file():
        raise ValueError(f"there is no file {location}: give FILE.py:CLASS")
    sys.path.append(str(path.parent))
    return import_file(path, f"entrant_{path.stem}")

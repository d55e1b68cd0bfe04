"""Runs entrants on tracks: they take turns, and the time of a problem is the least of its calls."""

from __future__ import annotations

import ctypes
import gc
import importlib
import importlib.util
import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.force.entrant import MODES, STATUSES, CProblem, Entrant, Library, Task
from benchmarks.force.entrants import ENTRANTS
from benchmarks.force.problems import OBJECTIVES, Array, Problem, Session, Track
from benchmarks.force.score import Parted, parted, score

HERE = Path(__file__).parent
BUILD = HERE.parents[1] / "build/force"
Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class Effort:
    """How much is timed.

    Attributes:
        rounds: in which the entrants take turns, so that a busy second of the machine hits all alike.
        seconds: an entrant may spend on a track in one round after its first pass; it makes one pass at least.
        passes: most passes of a round.
        sessions: of each track at most, problems: of each of them; None: all.
    """

    rounds: int = 3
    seconds: float = 0.3
    passes: int = 10
    sessions: int | None = None
    problems: int | None = None


QUICK = Effort(rounds=1, seconds=0.02, passes=3, sessions=3, problems=4)


@dataclass(eq=False)
class Timed:
    """An entrant set up for a session.

    Attributes:
        solver: it.
        task: what it was told.
        problems: of the session.
        answers: those of the first pass.
        iterations: of those, nan where it does not tell.
        seconds: (M,) the least of all passes.
        many: answers and seconds of one problem in a call of `solve_many`, where it has that.
    """

    solver: Any
    task: Task
    problems: list[Problem]
    answers: list[Parted] = field(default_factory=list)
    iterations: Array = field(default_factory=lambda: np.zeros(0))
    seconds: Array = field(default_factory=lambda: np.zeros(0))
    many: tuple[list[Parted], float] | None = None

    def __post_init__(self) -> None:
        self.solver.setup(self.task)
        self.seconds = np.full(len(self.problems), np.inf)
        compiled = getattr(self.solver, "compiled", None)
        self._pass = self._in_python if compiled is None else self._in_c

    def passes(self, count: int) -> float:
        """Makes passes over the problems in their order; returns the seconds that they took."""
        began = time.perf_counter()
        self._pass(count)
        taken = time.perf_counter() - began
        if self.task.mode == "persistent" and hasattr(self.solver, "solve_many"):
            self._all_at_once(count)
        return taken

    def _all_at_once(self, count: int) -> None:
        for _ in range(count):
            began = time.perf_counter()
            try:
                answers = self.solver.solve_many(self.problems)
            except NotImplementedError:
                return
            taken = (time.perf_counter() - began) / len(self.problems)
            made = [parted(problem, answer) for problem, answer in zip(self.problems, answers, strict=True)]
            self.many = made, min(taken, self.many[1] if self.many else np.inf)

    def _in_python(self, count: int) -> None:
        solve, setup, clock = self.solver.solve, self.solver.setup, time.perf_counter_ns
        cold, warm = self.task.mode == "cold", self.task.mode == "warm"
        for _ in range(count):
            start, first = None, not self.answers
            if first:
                self.iterations = np.full(len(self.problems), np.nan)
            for m, problem in enumerate(self.problems):
                task = Task(self.task.track, self.task.objective, "cold", problem) if cold else self.task
                answer: Any = None
                begin = clock()
                try:
                    if cold:
                        setup(task)
                    answer = solve(problem, start)
                except Exception as error:  # a solver's fault is no fault of the benchmark
                    answer = (None, None, f"failed: {type(error).__name__}: {error}"[:200])
                self.seconds[m] = min(self.seconds[m], 1e-9 * (clock() - begin))
                if first or warm:
                    made = parted(problem, answer)
                    start = made.force if warm and made.status == "solved" else None
                    if first:
                        self.answers.append(made)
                        self.iterations[m] = getattr(self.solver, "iterations", np.nan)

    def _in_c(self, count: int) -> None:
        compiled, n = self.solver.compiled(), len(self.problems)
        first = self.problems[0]
        views = (CProblem * n)(*map(CProblem.of, self.problems))
        forces, multipliers = (
            np.full((n, first.matrix.shape[1]), np.nan),
            np.full((n, 6 + len(first.limit_bound)), np.nan),
        )
        statuses, iterations, seconds = np.zeros(n, np.int32), np.full(n, -1, np.int32), np.empty(n)
        cold = self.task.mode == "cold"
        timer().force_times(
            *(ctypes.c_void_p(at or None) for at in (compiled.solve, compiled.context, compiled.setup * cold, compiled.close * cold)),
            self.task.objective.encode(), views, n, count, int(self.task.mode == "warm"),
            *(ctypes.c_void_p(array.ctypes.data) for array in (forces, multipliers, statuses, iterations, seconds)),
        )  # fmt: skip
        self.seconds = np.minimum(self.seconds, seconds)
        if not self.answers:
            self.iterations = np.where(iterations < 0, np.nan, iterations)
            for problem, force, prices, status in zip(
                self.problems, forces, multipliers, statuses.tolist(), strict=True
            ):
                self.answers.append(
                    parted(problem, (force, None if np.isnan(prices).any() else prices, STATUSES[status]))
                )


class Empty:
    """The control: returns the same zeros for every problem; its time is that of the call."""

    name, note = "empty", "an empty call, the control"

    def setup(self, task: Task) -> None:
        """Makes the zeros."""
        self._zeros = np.zeros(task.first.matrix.shape[1])

    def solve(self, problem: Problem, start: Array | None = None) -> Array:
        """The zeros."""
        return self._zeros


def entrants(chosen: Sequence[str]) -> dict[str, Callable[[], Entrant]]:
    """Entrants by name: those of `ENTRANTS`, FILE.py:CLASS, or FILE.so:FUNCTION.

    Raises:
        ValueError: there is no such entrant.
    """
    made: dict[str, Callable[[], Any]] = {}
    for spec in chosen:
        where, _, what = ENTRANTS.get(spec, spec).rpartition(":")
        if not where:
            raise ValueError(
                f"no entrant {spec!r}: choose of {', '.join(ENTRANTS)}, or give FILE.py:CLASS or FILE.so:FUNCTION"
            )
        if where.endswith(".so"):
            make: Any = partial(Library, str(Path(where).resolve()), what)
        else:
            make = getattr(_module(where), what, None)
            if make is None:
                raise ValueError(f"{where} has no {what}: give FILE.py:CLASS")
        made[spec if spec in ENTRANTS else what] = make
    return made


def measured(
    tracks: Sequence[Track],
    chosen: dict[str, Callable[[], Entrant]],
    effort: Effort,
    tell: Callable[[str], None] = lambda text: None,
) -> tuple[Rows, dict[str, dict[str, Any]]]:
    """A row for each entrant, objective, mode and problem, and one with a `reason` where an entrant does not take part; what entrants say of themselves."""
    rows: Rows = []
    told: dict[str, dict[str, Any]] = {}
    solvers = {"empty": Empty, **chosen}
    for track, objective, mode in cells(tracks):
        key = {"case": track.name, "objective": objective, "mode": mode}
        ready: dict[str, list[Timed]] = {}
        for name, make in solvers.items():
            if objective not in getattr(make, "objectives", OBJECTIVES):
                continue
            tell(f"{track.name}, {objective}, {mode}: setting up {name}")
            try:
                ready[name] = [
                    _prepared(make, session, track.name, objective, mode, effort) for session in track.sessions
                ]
            except (ImportError, NotImplementedError, RuntimeError) as error:
                rows.append(key | {"method": name, "reason": f"{error}"[:300]})
        _take_turns(
            ready, effort, lambda text, key=key: tell(f"{key['case']}, {key['objective']}, {key['mode']}: {text}")
        )
        for name, each in ready.items():
            solver = each[0].solver
            told[name] = {
                which: getattr(solver, which) for which in ("note", "training_seconds") if hasattr(solver, which)
            }
            about = {
                "method": name, "division": getattr(solver, "division", "closed"),
                "language": "C" if hasattr(solver, "compiled") else "Python",
            }  # fmt: skip
            rows += [
                key | about | row
                for session, timed in zip(track.sessions, each, strict=False)
                for row in _scored(session, timed)
            ]
    return rows, told


def cells(tracks: Sequence[Track]) -> Iterator[tuple[Track, str, str]]:
    """What is compared: a track, an objective and a mode."""
    for track in tracks:
        for objective in track.about["objectives"]:
            for mode in track.about["modes"]:
                assert mode in MODES
                yield track, objective, mode


def unit() -> float:
    """[us] of a cold solve of the paper's cuboid under its wrench by SciPy's SLSQP: what machines compare by. Median of 30."""
    slsqp = entrants(["slsqp"])["slsqp"]()
    frames = np.zeros((4, 3, 3))
    for k, sign in enumerate((1.0, -1.0, -1.0, -1.0)):
        frames[k] = np.column_stack([[0, 0, sign], [1, 0, 0], [0, sign, 0]])
    positions = np.array([[0, 0, -0.05], [0, 0.03, 0.05], [-0.03, -0.02, 0.05], [0.03, -0.02, 0.05]])
    problem = Problem(positions, frames, np.full(4, 0.4), np.array([1.0, 0.5, -0.6, -0.1, 0.2, 0.0]))
    times = []
    for _ in range(30):
        begin = time.perf_counter()
        slsqp.setup(Task("unit", "sum", "cold", problem))
        slsqp.solve(problem)
        times.append(1e6 * (time.perf_counter() - begin))
    return float(np.median(times))


@cache
def timer() -> Any:
    """The clock in C, compiled once.

    Raises:
        RuntimeError: there is no C compiler.
    """
    return ctypes.CDLL(str(library("timer", [HERE / "timer.c"], ["-O2"], (HERE / "force.h",))))


def library(
    name: str, sources: Sequence[Path], flags: Sequence[str], depends: Sequence[Path] = (), cpp: bool = False
) -> Path:
    """A shared library of sources in `BUILD`, compiled where it is not there yet.

    Raises:
        RuntimeError: there is no compiler, or it fails.
    """
    choices = ("CXX", "g++", "clang++", "c++") if cpp else ("CC", "gcc", "clang", "cc")
    named = (os.environ.get(choices[0]), *choices[1:])
    command = next((found for each in named if each and (found := shutil.which(each))), None)
    if command is None:
        raise RuntimeError(f"no compiler: install {choices[1]} or {choices[2]}, or set {choices[0]}")
    key = sha256()
    for text in (command, *flags, *(path.read_text(encoding="utf-8") for path in (*sources, *depends))):
        key.update(text.encode() + b"\0")
    path = BUILD / f"{name}_{key.hexdigest()[:12]}.so"
    if not path.exists():
        BUILD.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(f".{os.getpid()}")
        words = [command, *flags, "-fPIC", "-shared", *map(str, sources), "-o", str(part)]
        answer = subprocess.run(words, capture_output=True, text=True, check=False, timeout=900)
        if answer.returncode:
            raise RuntimeError(f"{command} fails on {sources[0].name}: {answer.stderr.strip()[:300]}")
        part.replace(path)
    return path


def _prepared(
    make: Callable[[], Any], session: Session, track: str, objective: str, mode: str, effort: Effort
) -> Timed:
    problems = session.problems[: effort.problems]
    return Timed(make(), Task(track, objective, mode, problems[0]), problems)


def _take_turns(ready: dict[str, list[Timed]], effort: Effort, tell: Callable[[str], None]) -> None:
    """Passes of all entrants in turn, without garbage collection."""
    counts: dict[str, int] = {}
    gc.collect()
    gc.disable()
    try:
        for turn in range(effort.rounds):
            for name, each in ready.items():
                tell(f"round {turn + 1} of {effort.rounds}: {name}")
                if not turn:
                    taken = sum(timed.passes(1) for timed in each)
                    counts[name] = int(np.clip(effort.seconds / max(taken, 1e-9), 0, effort.passes))
                if counts[name]:
                    for timed in each:
                        timed.passes(counts[name])
    finally:
        gc.enable()


def _scored(session: Session, timed: Timed) -> Iterator[dict[str, Any]]:
    objective = timed.task.objective
    best = session.references[objective].value
    for m, (problem, answer) in enumerate(zip(timed.problems, timed.answers, strict=True)):
        row = {
            "event": session.name,
            "problem": m,
            "microseconds": 1e6 * timed.seconds[m],
            "iterations": timed.iterations[m],
        }
        if timed.many is not None and score(problem, objective, float(best[m]), timed.many[0][m])["solved"]:
            row["many_microseconds"] = 1e6 * timed.many[1]
        yield row | score(problem, objective, float(best[m]), answer)


def _module(where: str) -> Any:
    if not where.endswith(".py"):
        return importlib.import_module(where)
    path = Path(where).resolve()
    if not path.is_file():
        raise ValueError(f"there is no file {where}: give FILE.py:CLASS")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module

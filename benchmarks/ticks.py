"""The worst tick of a hand's control loop: every call of a solver is timed on its own.

The ticks are those of the track `loop` of the benchmark of forces, in which contacts, Jacobian and
loads move, limits bind now and then, fingers lift and land, and some ticks are infeasible. A solver
is set up once for each of its sessions, which it then plays over and over, in order; where a session
begins anew, contacts and loads jump. A first pass of each session is not counted. Solvers take turns in rounds; a turn begins with an untimed tick.
C functions are called and timed in C, and Python without garbage collection, as in a control loop.

The system may interrupt any call, so that the largest time is partly that of the machine. It is
given in four ways: of all calls; without calls during which the system took the processor away; as
the largest of the problems' medians over all passes, which is the solver's own; and of a control, a
busy wait. The second still contains interrupts, and what a virtual machine's host does.

The answers of the first pass, and of one more at the end, are scored as in the benchmark of forces.
"""

from __future__ import annotations

import ctypes
import resource
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.benchmark import Benchmark, tick
from benchmarks.force.entrant import Compiled, CProblem, Task
from benchmarks.force.entrants import ENTRANTS
from benchmarks.force.problems import OBJECTIVES, Array, Track, load
from benchmarks.force.run import Timed, entrants, no_garbage_collection, scored, timer
from grasp_env.errors import InvalidInputError
from training.evaluation.results.claims import Claim
from training.evaluation.results.table import pd, table

TRACK, OBJECTIVE = "loop", "sum"
BUSY = "busy"
"""Name of the control."""
THREAD = getattr(resource, "RUSAGE_THREAD", resource.RUSAGE_SELF)
Times = tuple[Array, NDArray[np.bool_]]
"""Seconds (passes, M) of the calls for M problems, and in which the processor was taken away."""


@dataclass(frozen=True)
class TicksSettings:
    """Solvers, and how many ticks each of them plays.

    Attributes:
        solvers: entrants of the benchmark of forces, FILE.py:CLASS or FILE.so:FUNCTION.
        ticks: least number of ticks of our solver in C++, and of the control.
        python: the same of our solver in Python.
        peers: the same of every other solver.
        rounds: rounds in which the solvers take turns.
    """

    solvers: tuple[str, ...] = ("conic", "conic_python", "qocogen", "qoco", "clarabel")
    ticks: int = 1_000_000
    python: int = 100_000
    peers: int = 20_000
    rounds: int = 5


class Busy:
    """The control in C: every call is busy for the same time.

    Args:
        seconds: that time.
    """

    def __init__(self, seconds: float) -> None:
        self._seconds = ctypes.c_double(seconds)

    def setup(self, task: Task) -> None:
        """Do nothing."""

    def compiled(self) -> Compiled:
        """See `Entrant`."""
        address = ctypes.cast(timer().force_busy, ctypes.c_void_p).value or 0
        return Compiled(address, ctypes.addressof(self._seconds), keep=self._seconds)


class Player:
    """A solver, set up once for each session of a track.

    Args:
        make: makes the solver of a session.
        track: the stream.

    Attributes:
        sessions: the solver with the problems, of each session; it has made one pass.
        language: "C" or "Python".
        times: of each session, one entry for every call of `play`.
    """

    def __init__(self, make: Callable[[], Any], track: Track) -> None:
        self.sessions: list[Timed] = []
        for session in track.sessions:
            problems = session.copies()
            task = Task(track.name, OBJECTIVE, "persistent", problems[0])
            self.sessions.append(Timed(make(), task, problems))
        self.language = "C" if hasattr(self.sessions[0].solver, "compiled") else "Python"
        self.times: list[list[Times]] = [[] for _ in self.sessions]
        self.check()

    def check(self) -> None:
        """Make a pass over all sessions, whose answers are kept for the score."""
        for timed in self.sessions:
            timed.passes(1)

    def play(self, passes: int) -> None:
        """Make passes over each session, every tick timed on its own."""
        playing = in_c if self.language == "C" else in_python
        for timed, times in zip(self.sessions, self.times, strict=True):
            times.append(playing(timed, passes))

    def first_pass(self) -> float:
        """Return the median time of a tick in the pass that is not counted [s]."""
        return float(np.median(np.concatenate([timed.seconds for timed in self.sessions])))

    def rows(self, track: Track, judged: bool) -> pd.DataFrame:
        """Return a row for every tick, pass after pass of one session after another.

        The rows of a session's first pass also have the median time of each problem, in `typical`,
        and, if `judged`, the score of the worst of its answers.
        """
        frames = []
        for session, timed, times in zip(track.sessions, self.sessions, self.times, strict=True):
            seconds, interrupted = map(np.concatenate, zip(*times, strict=True))
            passes, count = seconds.shape
            of_problem: dict[str, Any] = {"typical": 1e6 * np.median(seconds, axis=0)}
            if judged:
                marks = list(scored(session, timed))
                failed = [not mark["solved"] for mark in marks]
                of_problem["failed"] = pd.array(failed, "boolean")
                of_problem["wrong"] = pd.array([mark["wrong"] for mark in marks], "boolean")
            of_tick = {
                "event": session.name,
                "problem": np.tile(np.arange(count), passes),
                "latency": 1e6 * seconds.ravel(),
                "interrupted": interrupted.ravel(),
            }
            frames.append(pd.DataFrame(of_tick).join(pd.DataFrame(of_problem)))
        rows = pd.concat(frames, ignore_index=True)
        median = rows["latency"].median()
        slowdown = (rows["latency"] / median).round(3)
        return rows.assign(
            latency=rows["latency"].round(3),
            slowdown=slowdown,
            undisturbed=slowdown.where(~rows["interrupted"]),
            typical=(rows["typical"] / median).round(3),
        )


def run(settings: TicksSettings) -> pd.DataFrame:
    """Play the stream; return a row per tick, and one with a reason for a solver that cannot run."""
    try:
        makers = entrants(settings.solvers)
    except ValueError as error:
        raise InvalidInputError(str(error)) from None
    track = load(TRACK)
    players: dict[str, Player] = {}
    reasons = []
    for name, make in makers.items():
        tick(f"{name} is set up")
        try:
            if OBJECTIVE not in getattr(make, "objectives", OBJECTIVES):
                raise NotImplementedError(
                    "it minimises something else than the sum of normal forces"
                )
            players[name] = Player(make, track)
        except Exception as error:  # the others play
            reasons.append({"case": TRACK, "method": name, "reason": str(error)[:300]})
    if not players:
        told = "; ".join(f"{row['method']}: {row['reason']}" for row in reasons)
        raise InvalidInputError(f"no solver plays: {told or 'name one'}")
    judged = list(players)
    try:
        timer()
        seconds = players[judged[0]].first_pass()
        players[BUSY] = Player(lambda: Busy(seconds), track)
    except RuntimeError as error:  # no compiler
        reasons.append({"case": TRACK, "method": BUSY, "reason": str(error)[:300]})
    take_turns(players, settings, track.size)
    tables = [pd.DataFrame(reasons)] if reasons else []
    for name, player in players.items():
        if name in judged:
            player.check()
        rows = player.rows(track, name in judged)
        tables.append(rows.assign(case=TRACK, method=name, language=player.language))
    return table(pd.concat(tables, ignore_index=True))


def take_turns(players: dict[str, Player], settings: TicksSettings, size: int) -> None:
    """Let the solvers play in turns, without garbage collection; size: ticks of the stream."""
    with no_garbage_collection():
        for turn in range(settings.rounds):
            for name, player in players.items():
                tick(f"round {turn + 1} of {settings.rounds}: {name}")
                least = wanted(name, player, settings)
                player.play(-(-least // (size * settings.rounds)))


def wanted(name: str, player: Player, settings: TicksSettings) -> int:
    """Return the least number of ticks of a solver."""
    ours = ENTRANTS.get(name, "").rpartition(":")[0].endswith(".ours")
    if not ours and name != BUSY:
        return settings.peers
    return settings.ticks if player.language == "C" else settings.python


def in_c(timed: Timed, passes: int) -> Times:
    """Make passes over a session in C."""
    compiled = timed.solver.compiled()
    problems = timed.problems
    count = len(problems)
    views = (CProblem * count)(*map(CProblem.of, problems))
    force = np.zeros(problems[0].matrix.shape[1])
    multipliers = np.zeros(6 + len(problems[0].limit_bound))
    seconds = np.full((passes, count), np.nan)  # written, so that its memory is there
    interrupted = np.full((passes, count), 1, np.uint8)
    arrays = (force, multipliers, seconds, interrupted)
    timer().force_ticks(
        ctypes.c_void_p(compiled.solve),
        ctypes.c_void_p(compiled.context or None),
        views,
        count,
        passes,
        *(ctypes.c_void_p(array.ctypes.data) for array in arrays),
    )
    return seconds, interrupted.astype(bool)


def in_python(timed: Timed, passes: int) -> Times:
    """Make passes over a session in Python, as `force_ticks` of timer.c makes them in C."""
    solve = timed.solver.solve
    problems = timed.problems
    clock = time.perf_counter_ns
    usage = resource.getrusage
    seconds = np.full((passes, len(problems)), np.nan)
    interrupted = np.full((passes, len(problems)), True)
    before = 0
    for k in range(-1, passes * len(problems)):
        turn, m = divmod(k, len(problems))
        problem = problems[m]
        begin = clock()
        try:  # noqa: SIM105  suppress takes time
            solve(problem, None)
        except Exception:  # it counts where answers are scored
            pass
        end = clock()
        after = usage(THREAD).ru_nivcsw
        if k >= 0:
            seconds[turn, m] = 1e-9 * (end - begin)
            interrupted[turn, m] = after != before
        before = after
    return seconds, interrupted


_CPP = "method == 'conic'"
_OURS = "method == 'conic' or method == 'conic_python'"
BENCHMARK = Benchmark(
    run,
    TicksSettings(),
    {"ticks": 20_000, "python": 5_000, "peers": 2_000, "rounds": 1},
    (
        "latency_median",
        "latency_p99",
        "latency_p999",
        "latency_max",
        "slowdown_max",
        "undisturbed_max",
        "interrupted_sum",
        "typical_max",
        "failed_sum",
        "wrong_sum",
    ),
    claims=(
        Claim("largest over median of all ticks in C++", _CPP, "slowdown_max", "<=", 15.0),
        Claim("the same without interrupted ticks", _CPP, "undisturbed_max", "<=", 15.0),
        Claim("the same of the medians over all passes", _CPP, "typical_max", "<=", 15.0),
        Claim("ticks that we do not solve, of a pass", _OURS, "failed_sum", "<=", 0.0),
        Claim("wrong verdicts of ours, of a pass", _OURS, "wrong_sum", "<=", 0.0),
    ),
    words={
        BUSY: "no solver, but a wait as long as the median of the first one: what the machine adds"
    },
    notes=lambda summary: (
        "failed and wrong: of the problems of the stream, in the first pass, which is not timed, and in one after the others",
    ),
)

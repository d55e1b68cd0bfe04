"""The two kinds of entrants: a Python class, and a C function in a shared library."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from benchmarks.force.problems import Array, Problem

Answer = Any
"""force (N k,) or (N, k), (force, multipliers), or (force, multipliers, one of `STATUSES`)."""
STATUSES = ("solved", "failed", "infeasible")
"""Statuses in the order of a C function's return values; other values are failures."""


@dataclass(frozen=True, eq=False)
class Task:
    """The session that `setup` prepares for.

    Attributes:
        track: its name.
        objective: "sum" or "phi".
        mode: one of `problems.MODES`.
        first: the first problem; problems that have not `moved` differ from it in the wrench.
    """

    track: str
    objective: str
    mode: str
    first: Problem


class Entrant(Protocol):
    """A solver.

    An entrant may also have `objectives` (default: both), `division` ("closed", the default,
    "learned" or "open"), `note` (settings, for people), `training_seconds`, `iterations` (of the
    last solve), `solve_many(problems) -> list of answers`, which is timed, too, in mode persistent,
    `compiled() -> Compiled`, with which it is called and timed in C, and `margins`: True if it
    takes problems with a margin as they are. Without it, it receives the `shifted` problem, and its
    force is shifted back, both untimed.
    """

    name: str

    def setup(self, task: Task) -> None:
        """Prepare for a session.

        Raises:
            NotImplementedError: the entrant does not support such problems; the message gives the
                reason.
            ImportError, RuntimeError: the entrant cannot run on this machine.
        """

    def solve(self, problem: Problem, start: Array | None = None) -> Answer:
        """Return the forces of a problem; `start` is the last force, in mode warm."""


def status_of(returned: int) -> str:
    """Translate a C return value to a status."""
    return STATUSES[returned] if 0 <= returned < len(STATUSES) else "failed"


class CProblem(ctypes.Structure):
    """`force_problem` of force.h."""

    _pointers = (
        "positions",
        "frames",
        "normals",
        "friction",
        "torsional_friction",
        "min_normal",
        "max_normal",
        "jacobian",
        "torque_limit",
        "torque_bias",
        "wrench",
        "matrix",
        "limit_matrix",
        "limit_bound",
        "friction_margin",
        "preload",
    )
    _fields_ = (
        *((name, ctypes.c_int) for name in ("contacts", "width", "joints", "limits", "moved")),
        ("touching", ctypes.c_ulonglong),
        *((name, ctypes.c_void_p) for name in _pointers),
    )

    @classmethod
    def of(cls, problem: Problem) -> CProblem:
        """Return a view of a problem, which must outlive the view."""
        view = cls(
            problem.n_contacts,
            problem.width,
            0 if problem.torque_limit is None else len(problem.torque_limit),
            len(problem.limit_bound),
            problem.moved,
            sum(1 << i for i in np.flatnonzero(problem.active).tolist()),
        )
        for name in cls._pointers:
            array = getattr(problem, name)
            setattr(view, name, None if array is None or not array.size else array.ctypes.data)
        return view


@dataclass(frozen=True)
class Compiled:
    """C functions as force.h declares them.

    Attributes:
        solve: address of a `force_solve`.
        context: its first argument.
        setup: address of a `force_setup`, called in mode cold before each solve; 0: none.
        close: address of a `force_close` for what `setup` returned; 0: none.
        keep: objects that must live as long.
    """

    solve: int
    context: int = 0
    setup: int = 0
    close: int = 0
    keep: Any = None


class Library:
    """`FILE.so:FUNCTION` as an entrant, with FUNCTION_setup and FUNCTION_close if they exist."""

    note = "a shared library, timed in C"

    _context: int | None = None

    def __init__(self, path: str, function: str) -> None:
        self.name = function
        self.open(path, function)

    def open(self, path: str, function: str) -> None:
        """Find the functions in a library."""
        self._library = ctypes.CDLL(path)
        self._solve = self._address(function)
        self._setup, self._close = (
            self._address(f"{function}_{which}", missing=0) for which in ("setup", "close")
        )

    def setup(self, task: Task) -> None:
        """Call FUNCTION_setup; null means that the problems are not supported."""
        self.close()
        if not self._setup:
            return
        call = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_char_p)(self._setup)
        self._first = task.first, CProblem.of(task.first)  # it may keep the pointer
        self._context = call(ctypes.addressof(self._first[1]), task.objective.encode())
        if not self._context:
            raise NotImplementedError(f"{self.name}_setup returned null")

    def close(self) -> None:
        """Free the context of the last `setup`."""
        if self._context and self._close:
            ctypes.CFUNCTYPE(None, ctypes.c_void_p)(self._close)(self._context)
        self._context = None

    def solve(self, problem: Problem, start: Array | None = None) -> Answer:
        """Call the function once from Python."""
        force = np.zeros(problem.matrix.shape[1])
        steps = ctypes.c_int()
        multipliers = np.zeros(6 + len(problem.limit_bound))
        call = ctypes.CFUNCTYPE(ctypes.c_int, *[ctypes.c_void_p] * 6)(self._solve)
        begin = None if start is None else start.ctypes.data
        view = CProblem.of(problem)
        results = force.ctypes.data, multipliers.ctypes.data, ctypes.addressof(steps)
        status = call(self._context, ctypes.addressof(view), begin, *results)
        self.iterations = steps.value
        return force, multipliers, status_of(status)

    def compiled(self) -> Compiled:
        """See `Entrant`."""
        return Compiled(self._solve, self._context or 0, self._setup, self._close, self._library)

    def _address(self, name: str, missing: int | None = None) -> int:
        if missing is not None and not hasattr(self._library, name):
            return missing
        return ctypes.cast(getattr(self._library, name), ctypes.c_void_p).value or 0

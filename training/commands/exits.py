"""How `grasp` ends, for scripts: the one table of its exit codes."""

from __future__ import annotations

from grasp_env.errors import GraspError, InfeasibleStartError, InfeasibleWrenchError, NotConvergedError

EXIT_CODES = {
    0: "done",
    1: "a fault of the program",
    2: "wrong usage: an option, name, file or path, or an extra that is not installed",
    3: "infeasible: no force within cones and limits balances the wrench; the proof is told",
    4: "no certified optimum: stopped at the most iterations, stalled, or without a start",
    130: "interrupted",
}
"""Exit codes and what they mean."""
_CODES: dict[type[GraspError], int] = {InfeasibleWrenchError: 3, NotConvergedError: 4, InfeasibleStartError: 4}
"""Of the errors that are no wrong usage."""


def exit_code(error: GraspError) -> int:
    """The exit code of an error.

    Example:
        >>> exit_code(NotConvergedError("stalled")), exit_code(GraspError("no such file"))
        (4, 2)
    """
    return next((code for kind, code in _CODES.items() if isinstance(error, kind)), 2)

"""What a method is: made for one grasp, it turns a wrench and a start into a `ForceSolution`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from grasp_env._check import Array, ContactForces, Wrench, as_array
from grasp_env.errors import InfeasibleStartError, InfeasibleWrenchError, InvalidInputError, shown
from grasp_env.force.limits import ForceLimits
from grasp_env.force.objective import Objective
from grasp_env.force.record import MULTIPLIERS
from grasp_env.force.repair import Correction
from grasp_env.force.solution import ForceSolution, infeasible
from grasp_env.force.step_size import StepRule
from grasp_env.grasp.grasp import Grasp

CRITERIA = ("sum", "max")
"""Of `conic`: of the normal forces."""
CONIC_ITERATIONS = 100
"""Most iterations of an interior point: a dozen is usual."""
BALANCE_TOLERANCE = 1e-8
"""A start may miss balance by this much of the wrench and force it carries; the rest is an error of the rule."""


@dataclass(frozen=True)
class Settings:
    """What every method may need; see `optimize_force`."""

    method: str
    criterion: str
    limits: ForceLimits | None
    objective: Objective
    tolerance: float
    max_iterations: int
    step_rule: StepRule
    correction: Correction
    elastic: bool = False


@dataclass(frozen=True)
class Start:
    """Where a descent begins: the rule's name and a force (N, 3) [N], with torsions (N,) [N m] where contacts are soft."""

    name: str
    force: ContactForces
    torsion: Array | None = None


@dataclass(slots=True)
class Loop:
    """The control loop's call: from wrench to record in one compiled call.

    Attributes:
        call: (wrench, previous record or None, record) -> code (`record.py`); REFUSED for anything it cannot read or solve, which
            the general path then converts or explains.
        name: of the start without a previous solution. carried: with one.
        remembers: whether the previous solution is handed to it.
        many: `call` for (M, 6) wrenches, (M, 20 + 7N) previous records or None, into such records; None: one after the other.
        solution: (record, method, the start's name) -> what a call that CONVERGED wrote.
        stopped: the same for one that ended otherwise; may go on from there, or raise where that is a proof.
    """

    call: Callable[[Any, Array | None, Array], int]
    name: str
    carried: str = ""
    remembers: bool = False
    many: Callable[[Array, Array | None, Array], None] | None = None
    solution: Callable[[Array, str, str], ForceSolution] = ForceSolution
    stopped: Callable[[Array, str, str], ForceSolution] = ForceSolution


class Method(Protocol):
    """One method on one grasp."""

    takes_start: bool
    """Whether it begins from a start that can be chosen; the others have their own."""
    uses_basis: bool
    """Whether the 12-basis of the grasp serves it."""

    def loop(self, initial: Any) -> Loop | None:
        """The control loop's call from that start (see `optimize_force`); None: every call takes the general path."""
        ...

    def start(self, wrench: Wrench, initial: Any, previous: ForceSolution | None) -> Start | None:
        """The start for a checked wrench; None: the method takes none."""
        ...

    def run(self, wrench: Wrench, start: Start | None, optimum: float, trace: bool) -> ForceSolution:
        """Solves for a checked wrench (6,); `optimum` is a known minimum or nan, `trace` asks for Phi of every iterate."""
        ...


class OwnStart:
    """Methods that begin from their own centre."""

    takes_start = False
    uses_basis = False
    settings: Settings

    def start(self, wrench: Wrench, initial: Any, previous: ForceSolution | None) -> Start | None:
        """None."""
        if initial is not None:
            raise InvalidInputError(
                f"method {self.settings.method!r} starts from its own centre, got initial={shown(initial)}"
            )
        return None


def readable(wrench: Any) -> bool:
    """Whether the core can read this wrench as it is."""
    return type(wrench) is np.ndarray and wrench.dtype is _FLOAT and wrench.shape == (6,) and wrench.flags.carray


_FLOAT = np.dtype(np.float64)


def given_start(name: str, force: ArrayLike, count: int) -> Start:
    """A rule's force as a start.

    Raises:
        InfeasibleStartError: not (N, 3) finite numbers.
    """
    try:
        return Start(name, as_array(force, (count, 3), "initial force"))
    except InvalidInputError as error:
        told = "it returned None: does it end in a return?" if force is None else error
        raise InfeasibleStartError(f"initial-force rule {name!r}: {told}") from None


def refused_start(grasp: Grasp, wrench: Wrench, start: Start) -> InfeasibleStartError:
    """Why a descent did not take a start."""
    missed = grasp.residual(start.force, wrench)
    scale = float(np.abs(start.force).max()) + float(np.abs(grasp.unit_frame @ wrench).max())
    if missed > BALANCE_TOLERANCE * scale:
        return InfeasibleStartError(
            f"initial-force rule {start.name!r} misses balance by {missed:.3g} N (G f + w = 0, w the wrench ON the object); "
            "add -G^+ (G f + w), or pass it through grasp_env.force.Repair"
        )
    return InfeasibleStartError(
        f"initial-force rule {start.name!r} leaves the friction cones (margin {grasp.cone_margin(start.force):.3g} N); "
        "pass it through grasp_env.force.Repair"
    )


def infeasible_error(
    grasp: Grasp, wrench: Wrench, method: str, initial: str, certificate: Array
) -> InfeasibleWrenchError:
    """The error that carries the infeasible solution and its separating twist."""
    residual = grasp.residual(np.zeros((grasp.n_contacts, 3)), wrench)
    return InfeasibleWrenchError("", infeasible(wrench, grasp.n_contacts, method, initial, residual, certificate))


def proven(record: Array, method: str, initial: str) -> InfeasibleWrenchError:
    """The error of a record that is a proof: no force, its multipliers the separating twist."""
    proof = record[MULTIPLIERS : MULTIPLIERS + 6]
    return InfeasibleWrenchError("", ForceSolution(record, method, initial, certificate=proof))


def refuse(method: str, start: Start | None, optimum: float, trace: bool) -> None:
    """Raises where a method without descents is given what belongs to them."""
    if start is not None or optimum == optimum or trace:
        raise InvalidInputError(f"method {method!r} takes no start, optimum or trace: they belong to descents on Phi")

"""What a method is: made for one grasp, it turns a wrench and a start into a `ForceSolution`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from grasp_env._check import Array, ContactForces, Wrench
from grasp_env.errors import InfeasibleWrenchError, InvalidInputError
from grasp_env.force.limits import ForceLimits
from grasp_env.force.objective import Objective
from grasp_env.force.repair import Correction
from grasp_env.force.solution import ForceSolution, infeasible
from grasp_env.force.step_size import StepRule
from grasp_env.grasp.grasp import Grasp


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


@dataclass(frozen=True)
class Start:
    """Where a descent begins: the rule's name and a force (N, 3) [N], with torsions (N,) [N m] where contacts are soft."""

    name: str
    force: ContactForces
    torsion: Array | None = None


class Method(Protocol):
    """One method on one grasp."""

    needs_start: bool
    """Whether `run` takes a start; the others have their own."""

    def run(self, wrench: Wrench, start: Start | None, optimum: float, trace: bool) -> ForceSolution:
        """Solves for a checked wrench (6,); `optimum` is a known minimum or nan, `trace` asks for Phi of every iterate."""
        ...


def infeasible_error(
    grasp: Grasp, wrench: Wrench, method: str, initial: str, certificate: Array
) -> InfeasibleWrenchError:
    """The error that carries the infeasible solution and its separating twist."""
    residual = grasp.residual(np.zeros((grasp.n_contacts, 3)), wrench)
    return InfeasibleWrenchError(
        f"no force strictly inside the limits balances wrench {wrench.tolist()}; the twist "
        f"{np.round(certificate, 6).tolist()} separates it (error.solution.certificate): add contacts, raise the "
        "friction, widen the limits, or change the wrench",
        infeasible(wrench, grasp.n_contacts, method, initial, residual, certificate),
    )


def refuse(method: str, start: Start | None, optimum: float, trace: bool) -> None:
    """Raises where a method without descents is given what belongs to them."""
    if start is not None or optimum == optimum or trace:
        raise InvalidInputError(f"method {method!r} takes no start, optimum or trace: they belong to descents on Phi")

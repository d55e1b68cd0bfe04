"""`newton` with soft contacts at control rate: without further limits, where the contacts have force closure without torsion.

The rest, closure by torsion alone, further limits, and what the core leaves out of digits, is the general program's
(`program_methods.ProgramNewton`), in the same call.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from grasp_env import core
from grasp_env._check import Array, Wrench
from grasp_env.errors import InfeasibleStartError, RankDeficientGraspError
from grasp_env.force.basis import OfflineBasis, core_contacts
from grasp_env.force.hard_methods import LOOPED, NO_TRACE, FallingBack
from grasp_env.force.method import Settings, Start
from grasp_env.force.record import ITERATIONS, REFUSED, record_size
from grasp_env.force.solution import ForceSolution
from grasp_env.grasp.grasp import Grasp


@dataclass(frozen=True, eq=False)
class TorsionPrices:
    """What solutions with soft contacts need to price the limit v >= -u of each, v the torsion in units of its limit.

    Attributes:
        soft: (N,) which contacts.
        scale: (N,) u = scale * normal force.
        divisor: (N,) v = divisor * torsion [1 / m]; inf where a contact is not soft.
        weights: (N,) lambda [N^2].
    """

    soft: NDArray[np.bool_]
    scale: Array
    divisor: Array
    weights: Array

    @classmethod
    def of(cls, grasp: Grasp, weights: Array) -> TorsionPrices:
        """Of a grasp's contacts and the weights (N, 2) of Phi."""
        gamma, mu = grasp.models.torsional_friction, grasp.models.cone_scale[:, 0]
        soft = gamma > 0.0
        return cls(soft, mu, np.where(soft, mu / np.where(soft, gamma, 1.0), np.inf), weights[:, 1])

    def prices(self, solution: ForceSolution) -> Array:
        """(M,) lambda / (u + v)^2 of the soft contacts, which is what they are at an optimum."""
        soft = self.soft
        slack = (self.scale * solution.force[:, 0])[soft] + (self.divisor[soft] * solution.torsion[soft])
        return self.weights[soft] / slack**2


class SoftNewton(FallingBack):
    """Newton on Phi with soft contacts, from the starts of hard ones without torsion."""

    def __init__(self, grasp: Grasp, settings: Settings) -> None:
        """The core's solver; the general one is made where it is needed.

        Raises:
            InfeasibleStartError: no force closure without torsion, so there is no 12-basis to start from.
            RankDeficientGraspError: nor wrenches of all directions.
        """
        self.grasp, self.settings = grasp, settings
        self.priced = TorsionPrices.of(grasp, settings.objective.weights(grasp.n_contacts))
        self.solver = core.SoftNewton.make(
            core_contacts(grasp, settings.objective), settings.tolerance, settings.max_iterations, self.priced.divisor,
            OfflineBasis.of(grasp, settings.objective).cone_forces,
        )  # fmt: skip

    @property
    def limit_labels(self) -> tuple[str, ...]:
        """What each entry of a solution's `limit_multipliers` belongs to."""
        return self.general.limit_labels

    def solution(self, record: Array, method: str, initial: str, trace: Array = NO_TRACE) -> ForceSolution:
        """What the core wrote."""
        return ForceSolution(record, method, initial, trace, None, self.priced)

    def start(self, wrench: Wrench, initial: Any, previous: ForceSolution | None) -> Start:
        """See `Method.start`. The 12-basis is without torsion; all else is the general program's, as a previous solution with its torsion.

        Raises:
            UnsupportedProblemError: the name of a rule that balances by hard contacts' least forces.
        """
        first = initial == "previous" and previous is None if isinstance(initial, str) else initial is None
        if first or (isinstance(initial, str) and initial.startswith("linear_combination")):
            return super().start(wrench, initial, previous)
        return self.general.start(wrench, initial, previous)

    def run(self, wrench: Wrench, start: Start | None, optimum: float, trace: bool) -> ForceSolution:
        """See `Method`. What the core leaves is the general program's, from the deepest force unless a start was asked for."""
        assert start is not None
        values = np.full(self.settings.max_iterations + 1, np.nan) if trace else NO_TRACE
        count = self.grasp.n_contacts
        record, torsion = np.empty(record_size(count)), np.zeros(count) if start.torsion is None else start.torsion
        force = np.ascontiguousarray(start.force)
        if self.solver.descend(wrench, force, torsion, optimum, values, record) == REFUSED:
            begin = self.general.deepest(wrench) if start.name in LOOPED else start
            return self.general.run(wrench, begin, optimum, trace)
        return self.solution(record, "newton", start.name, values[: int(record[ITERATIONS]) + 1] if trace else NO_TRACE)


def soft_newton(grasp: Grasp, settings: Settings) -> SoftNewton | None:
    """The core's method, or None where the contacts are the general program's."""
    try:
        return SoftNewton(grasp, settings)
    except (InfeasibleStartError, RankDeficientGraspError):
        return None


__all__ = ["SoftNewton", "TorsionPrices", "soft_newton"]

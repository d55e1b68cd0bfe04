"""`newton` within limits at control rate: hard contacts, rows that touch one contact each (a finger's own joints, normal forces).

The rest, joints that fingers share, soft contacts, no force closure, and what the core leaves, nearly infeasible or out of digits, is the
general program's (`program_methods.ProgramNewton`), in the same call.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from grasp_env import core
from grasp_env._check import Array, Wrench
from grasp_env.errors import InfeasibleStartError
from grasp_env.force.basis import OfflineBasis, core_contacts
from grasp_env.force.hard_methods import NO_TRACE, FallingBack
from grasp_env.force.initial import CompiledRule, is_rule
from grasp_env.force.limits import ForceLimits
from grasp_env.force.method import BALANCE_TOLERANCE, Settings, Start, proven, refused_start
from grasp_env.force.objective import Objective
from grasp_env.force.record import CODE, INFEASIBLE, REFUSED, record_size
from grasp_env.force.solution import ForceSolution
from grasp_env.grasp.grasp import Grasp


@dataclass(frozen=True, eq=False)
class ContactRows:
    """Limits a . x <= b on the force of one contact each, cone coordinates.

    Attributes:
        normals: (M, 3) a of length one; zero for a torque that no force changes.
        bounds: (M,) b [N].
        shares: (M,) by how much b grows where the limit grows by all of itself [N].
        weights: (M,) lambda [N^2]: the mean of the contacts that a row touches, of all where it touches none.
        owners: (M,) which contact.
        sizes: (M,) what a row was divided by.
        scale: (N, 3) cone coordinates = scale * force.
        labels: M texts for people.
    """

    normals: Array
    bounds: Array
    shares: Array
    weights: Array
    owners: Array
    sizes: Array
    scale: Array
    labels: tuple[str, ...]

    @classmethod
    def of(cls, grasp: Grasp, limits: ForceLimits, objective: Objective) -> ContactRows | None:
        """None where a row touches several contacts, or there are more on one, or larger ones, than the core takes."""
        given, limited = limits._rows(grasp)
        count, many = grasp.n_contacts, len(given.bound)
        rows = np.ascontiguousarray(given.matrix.reshape(many, count, 4)[:, :, :3])
        normals, table = np.empty((many, 3)), np.empty((5, many))
        divisor, lam = grasp.models.cone_divisor, objective.weights(count)[:, 1].copy()
        if not core.contact_rows(divisor, lam, rows, given.bound, limited, normals, table):
            return None
        bounds, shares, weights, sizes, owners = table
        return cls(normals, bounds, shares, weights, owners, sizes, grasp.models.cone_scale, given.labels)

    def slack(self, force: Array) -> Array:
        """(M,) distances of forces (N, 3) [N] from the limits [N]; negative outside."""
        x = (force * self.scale)[self.owners.astype(int)]
        return self.bounds - np.einsum("ma,ma->m", self.normals, x)

    def prices(self, solution: ForceSolution) -> Array:
        """(M,) lambda / slack^2, which is what they are at an optimum; none where limits are exceeded."""
        if solution.limit_excess > 0.0:
            return np.empty(0)
        return self.weights / self.slack(solution.force) ** 2 / self.sizes


class LimitedNewton(FallingBack):
    """Newton on Phi within limits, from any force inside the cones."""

    def __init__(self, grasp: Grasp, settings: Settings, rows: ContactRows) -> None:
        """The core's solver; the general one is made where it is needed.

        Raises:
            InfeasibleStartError: no force closure, so there is no 12-basis to start from.
        """
        self.grasp, self.settings, self.priced = grasp, settings, rows
        self.solver = core.LimitedNewton.make(
            core_contacts(grasp, settings.objective), settings.tolerance, settings.max_iterations, rows.normals, rows.bounds,
            rows.shares, rows.weights, rows.owners, OfflineBasis.of(grasp, settings.objective).cone_forces, settings.elastic,
        )  # fmt: skip

    @property
    def limit_labels(self) -> tuple[str, ...]:
        """What each entry of a solution's `limit_multipliers` belongs to."""
        return self.priced.labels

    def solution(self, record: Array, method: str, initial: str) -> ForceSolution:
        """What the core wrote.

        Raises:
            InfeasibleWrenchError: no force keeps the limits.
        """
        if record[CODE] != INFEASIBLE:
            return ForceSolution(record, method, initial, NO_TRACE, None, self.priced)
        raise proven(record, method, initial)

    def start(self, wrench: Wrench, initial: Any, previous: ForceSolution | None) -> Start:
        """See `Method.start`. Names start inside the cones, forces and callables within the limits."""
        if isinstance(initial, str) and initial == "phase_one":
            return self.general.start(wrench, initial, previous)
        start = super().start(wrench, initial, previous)
        if not (initial is None or isinstance(initial, str) or is_rule(initial, CompiledRule)):
            slack = float(self.priced.slack(start.force).min(initial=np.inf))
            if not slack > 0.0:
                raise InfeasibleStartError(
                    f"initial-force rule {start.name!r} leaves the limits by {-slack:.3g} N; use "
                    "initial='phase_one', the force deepest inside them, or leave it out"
                )
        return start

    def run(self, wrench: Wrench, start: Start | None, optimum: float, trace: bool) -> ForceSolution:
        """See `Method`. A known optimum and a trace are the general program's, from within the limits.

        Raises:
            InfeasibleWrenchError: no force keeps the limits.
        """
        assert start is not None
        studied = optimum == optimum or trace
        if not studied:
            record = np.empty(record_size(self.grasp.n_contacts))
            if self.solver.descend(wrench, np.ascontiguousarray(start.force), record) != REFUSED:
                return self.solution(record, "newton", start.name)
        size = float(np.abs(start.force).max()) + float(np.abs(self.grasp.unit_frame @ wrench).max())
        balanced = self.grasp.residual(start.force, wrench) <= BALANCE_TOLERANCE * size
        if not (balanced and self.grasp.cone_margin(start.force) > 0.0):
            raise refused_start(self.grasp, wrench, start)
        inside = studied and float(self.priced.slack(start.force).min(initial=np.inf)) > 0.0
        return self.general.run(wrench, start if inside else self.general.deepest(wrench), optimum, trace)


def limited_newton(grasp: Grasp, settings: Settings) -> LimitedNewton | None:
    """The core's method, or None where the limits or the contacts are the general program's."""
    assert settings.limits is not None
    if not grasp.hard:
        return None
    rows = ContactRows.of(grasp, settings.limits, settings.objective)
    if rows is None:
        return None
    try:
        return LimitedNewton(grasp, settings, rows)
    except InfeasibleStartError:
        return None


__all__ = ["ContactRows", "LimitedNewton", "limited_newton"]

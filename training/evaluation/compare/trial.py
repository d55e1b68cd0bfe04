"""Run every method from every start on every case; yield one result row each.

Column `status` of a row:

- "optimal": the relative gap of Phi reached `TOLERANCE`.
- "iteration_limit", "stalled", ...: the status of a method that stopped before that; if it reported
  "optimal" by its own criterion, the value is "stalled".
- "no_start": the start is missing or invalid; `reason` says why.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from grasp_env.errors import GraspError, InfeasibleStartError
from grasp_env.force import ForceOptimizer, Objective
from grasp_env.force.repair import start_replaced
from grasp_env.force.rules import RULES
from grasp_env.grasp import Grasp
from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import Array, ContactForces, as_array
from training.evaluation.compare.case import Case
from training.evaluation.compare.cases import scaled
from training.evaluation.compare.methods import METHODS, optimizer
from training.evaluation.compare.starts import BASIS, ComparedStart, DoesNotApply, carry_force
from training.evaluation.results.words import shortened

TOLERANCE = 1e-4
"""Relative gap of Phi to which iterations are counted by default."""
COARSE, FINE = 1e-2, 1e-6
"""Relative gaps of Phi to which iterations are counted as well."""
END_GAP = {"reduced_flow": 1e-6, "newton": 1e-8}
"""Relative gap of Phi at which each method is stopped, at most `FINE`."""
ITERATION_LIMIT = 5000
"""Iteration limit of a run; a gap that is not reached counts as one iteration more."""
OPTIMUM_GAP = 1e-10
"""Relative certified gap of the reference optima."""
MAX_RESIDUAL = 1e-6
"""Largest accepted balance residual of a force, over the force's largest component."""
PHI_ROUNDING = 1e-10
"""Relative difference of Phi that is rounding, for example between two orders of summation."""
REASON_LENGTH = 120
"""Largest length of the reason why there is no force, in characters."""


@dataclass(frozen=True)
class Quality:
    """Quality of a force.

    Attributes:
        gap: relative gap of Phi to the optimum; inf outside the cones.
        margin: smallest cone margin, over the largest force component.
        residual: balance residual, over the largest force component.
    """

    gap: float
    margin: float
    residual: float

    @classmethod
    def of(
        cls, grasp: Grasp, load: Array, force: ContactForces, least_phi: float, objective: Objective
    ) -> Quality:
        """Evaluate a force (N, 3) in contact frames; `least_phi` is Phi at the optimum."""
        size = max(float(np.abs(force).max()), 1e-300)
        gap = max(0.0, objective.of(grasp, force) / least_phi - 1.0)
        return cls(gap, grasp.cone_margin(force) / size, grasp.residual(force, load) / size)

    def reason(self) -> str | None:
        """Return why the force is invalid; None if it balances the wrench inside the cones."""
        if self.margin <= 0.0:
            return "outside the cones"
        return "out of balance" if self.residual > MAX_RESIDUAL else None

    def columns(self, prefix: str = "") -> dict[str, float]:
        """Return the columns of a row, with a prefix; an infinite gap is left out."""
        return {
            f"{prefix}{name}": value for name, value in vars(self).items() if np.isfinite(value)
        }


class Optimizers:
    """Cache of the optimizers of up to four grasps; a new grasp replaces the oldest."""

    def __init__(self, objective: Objective) -> None:
        self.objective = objective
        self._cache: dict[Grasp, dict[str, ForceOptimizer]] = {}
        self._last_optimum: tuple[Grasp, Array, ContactForces, float] | None = None

    def optimum(self, grasp: Grasp, load: Array) -> tuple[ContactForces, float]:
        """Return the force (N, 3) of least Phi, and Phi there."""
        last = self._last_optimum
        if last is None or last[0] is not grasp or not np.array_equal(last[1], load):
            solution = self._of(grasp)["optimum"].solve(load).raise_for_status()
            last = self._last_optimum = grasp, load, solution.force, solution.objective
        return last[2:]

    def run(
        self, method: str, grasp: Grasp, load: Array, start: ContactForces, least_phi: float
    ) -> dict[str, Any]:
        """Run a method from a start and return its columns."""
        solution = self._of(grasp)[method].solve(load, initial=start, optimum=least_phi, trace=True)
        gaps = np.maximum(solution.objective_trace / least_phi - 1.0, 0.0)
        reached = {
            level: int(np.argmax(gaps <= level)) if gaps[-1] <= level else ITERATION_LIMIT + 1
            for level in (COARSE, TOLERANCE, FINE)
        }
        status = solution.status.value
        if reached[TOLERANCE] <= ITERATION_LIMIT:
            status = "optimal"
        elif status == "optimal":
            status = "stalled"
        return {
            "status": status,
            "iterations": reached[TOLERANCE],
            "iterations_coarse": reached[COARSE],
            "iterations_fine": reached[FINE],
            "trials": solution.trials,
            **Quality.of(grasp, load, solution.force, least_phi, self.objective).columns(),
        }

    def _of(self, grasp: Grasp) -> dict[str, ForceOptimizer]:
        if grasp not in self._cache:
            while len(self._cache) > 3:
                del self._cache[next(iter(self._cache))]
            optimizers = {"optimum": optimizer(grasp, "newton", self.objective, OPTIMUM_GAP)}
            options: dict[str, Any] = {"max_iterations": ITERATION_LIMIT}
            for method, gap in END_GAP.items():
                optimizers[method] = optimizer(grasp, method, self.objective, gap, **options)
            self._cache[grasp] = optimizers
        return self._cache[grasp]


def trials(
    name: str,
    cases: list[Case],
    starts: Mapping[str, ComparedStart],
    objective: Objective,
    solved: bool = True,
) -> Iterator[dict[str, Any]]:
    """Yield the rows of a set: one for each case, start and method.

    Args:
        name: name of the set.
        cases: cases to solve.
        starts: see `StartContext.all_starts`; a start has no row of a case it does not apply to.
        objective: Phi.
        solved: True if the methods run; otherwise there is one row for each case and start.
    """
    optimizers = Optimizers(objective)
    previous_starts: dict[str, tuple[Case, ContactForces]] = {}
    for number, case in enumerate(cases):
        grasp, load, carried_force = case.grasp, case.wrench, None
        if case.before is not None:
            carried_force = carry_force(
                case.before[0], optimizers.optimum(*case.before)[0], grasp, objective
            )
        _, least_phi = optimizers.optimum(grasp, load)
        common = {"case": name, "problem": number, "group": case.group, "event": case.event or None}
        paper_force = _paper_start(starts, grasp, load)
        paper_phi = None if paper_force is None else objective.of(grasp, paper_force)
        for key, start in starts.items():
            row = {**common, "start": key}
            try:
                force = attempt(start, grasp, load, carried_force)
            except DoesNotApply:
                continue
            except GraspError as error:
                row |= {"status": "no_start", "reason": failure_reason(error)}
                for method in METHODS if solved else (None,):
                    yield {**row, "method": method}
                continue
            quality = Quality.of(grasp, load, force, least_phi, objective)
            row |= quality.columns("start_")
            reason = quality.reason()
            if paper_phi is not None and reason is None:
                row["start_excess"] = objective.of(grasp, force) / paper_phi - 1.0
                row["start_replaced"] = key not in RULES and start_replaced(grasp, load, force)
            if reason is None:
                row["start_slope"] = _slope(previous_starts.get(key), case, force)
                previous_starts[key] = case, force
            if not solved:
                yield row if reason is None else {**row, "status": "no_start", "reason": reason}
                continue
            for method in METHODS:
                try:
                    run = optimizers.run(method, grasp, load, force, least_phi)
                except InfeasibleStartError:  # outside the cones, or not balanced up to rounding
                    run = {"status": "no_start", "reason": reason or "out of balance"}
                yield {**row, "method": method, **run}


def attempt(
    start: ComparedStart, grasp: Grasp, load: Array, carried_force: ContactForces | None
) -> ContactForces:
    """Return the force (N, 3) [N] of a start, which may be a user's.

    `carried_force` (N, 3) is the optimum of the preceding case, carried over to these contacts;
    None if there is no preceding case.

    Raises:
        DoesNotApply: the start does not apply to this case.
        GraspError: the start has no force, fails, or returns something else; `failure_reason` gives
            the reason.
    """
    try:
        return as_array(
            start.start(grasp, load, carried_force), (grasp.n_contacts, 3), "a start", ranges.SIZE
        )
    except (DoesNotApply, GraspError):
        raise
    except Exception as error:
        raise InfeasibleStartError(str(error)) from error


def failure_reason(error: Exception) -> str:
    """Return why there is no force, cut at `REASON_LENGTH`."""
    cause = error.__cause__ if isinstance(error.__cause__, Exception) else error
    if isinstance(cause, InfeasibleStartError):
        return "no feasible start"
    return shortened(f"{type(cause).__name__}: {cause!s}", REASON_LENGTH)


def _paper_start(
    starts: Mapping[str, ComparedStart], grasp: Grasp, load: Array
) -> ContactForces | None:
    """Return the force of the paper's start; None if the grasp has no such start."""
    try:
        return starts[BASIS].start(grasp, load, None)
    except (KeyError, GraspError):
        return None


def _slope(
    previous_start: tuple[Case, ContactForces] | None, case: Case, force: ContactForces
) -> float:
    """Return |change of start| / |change of wrench|, moments / 0.05 m; NaN if cold."""
    if previous_start is None or case.before is None or previous_start[0].grasp is not case.grasp:
        return float("nan")
    preceding, preceding_force = previous_start
    if preceding.group != case.group or not np.array_equal(preceding.wrench, case.before[1]):
        return float("nan")
    change = float(np.linalg.norm(scaled(case.wrench - preceding.wrench)))
    return float(np.linalg.norm(force - preceding_force)) / change if change > 0.0 else float("nan")

"""Trials: rows of every method from every start on every case of a set, and of every solver of a user."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from grasp_env import ranges
from grasp_env._check import Array, ContactForces, as_array
from grasp_env.errors import GraspError, InfeasibleStartError
from grasp_env.force import RULES, ForceOptimizer, Objective, start_replaced
from grasp_env.grasp import Grasp
from training.compare.case import Case
from training.compare.cases import scaled
from training.compare.given import Problem, Solver
from training.compare.methods import METHODS, optimizer
from training.compare.starts import BASIS, DoesNotApply, PreparedStart, carry_force
from training.results.words import shortened

TOLERANCE = 1e-4
"""Relative gap of Phi to which iterations are counted by default."""
COARSE, FINE = 1e-2, 1e-6
LAST = {"reduced_flow": 1e-6, "newton": 1e-8}
"""Relative gap at which a run ends."""
LIMIT = 5000
"""Iteration limit of a run; a gap that is not reached counts as one iteration more."""
OPTIMUM = 1e-10
"""Relative certified gap of the reference optima."""
BALANCED = 1e-6
"""Largest balance residual of a solver's force, over its largest component."""
ROUNDING = 1e-10
"""Relative difference of Phi between two orders of summation."""
REASON = 120
"""Largest length of the reason why there is no force."""


@dataclass(frozen=True)
class Quality:
    """Quality of a force.

    Attributes:
        gap: relative gap of Phi to the optimum; inf outside the cones.
        margin: least cone margin over the largest component.
        residual: balance residual over the largest component.
    """

    gap: float
    margin: float
    residual: float

    @classmethod
    def of(cls, grasp: Grasp, load: Array, force: ContactForces, best: float, objective: Objective) -> Quality:
        """Evaluate a force (N, 3) in contact frames; `best` is the least Phi."""
        size = max(float(np.abs(force).max()), 1e-300)
        gap = objective.value(grasp.to_cone(force)) / best - 1.0
        return cls(max(0.0, gap), grasp.cone_margin(force) / size, grasp.residual(force, load) / size)

    def reason(self, margin: float = 0.0) -> str | None:
        """Return why the force is invalid; None if it balances the wrench with more than this cone margin."""
        return "outside the cones" if self.margin <= margin else "out of balance" if self.residual > BALANCED else None

    def columns(self, before: str = "") -> dict[str, float]:
        """Return the columns of a row, with a prefix; an infinite gap is left out."""
        gap = self.gap if np.isfinite(self.gap) else None
        named = {"gap": gap, "margin": self.margin, "residual": self.residual}
        return {f"{before}{name}": value for name, value in named.items() if value is not None}


class Optimizers:
    """Optimizers of the last few grasps."""

    def __init__(self, objective: Objective) -> None:
        self.objective = objective
        self._made: dict[Grasp, dict[str, ForceOptimizer]] = {}
        self._last: tuple[Grasp, Array, ContactForces, float] | None = None

    def optimum(self, grasp: Grasp, load: Array) -> tuple[ContactForces, float]:
        """Return the force (N, 3) of least Phi, and that Phi."""
        if self._last is None or self._last[0] is not grasp or not np.array_equal(self._last[1], load):
            solution = self._of(grasp)["optimum"].solve(load).raise_for_status()
            self._last = grasp, load, solution.force, solution.objective
        return self._last[2], self._last[3]

    def run(self, method: str, grasp: Grasp, load: Array, start: ContactForces, best: float) -> dict[str, Any]:
        """Run a method from a start and return its columns."""
        solution = self._of(grasp)[method].solve(load, initial=start, optimum=best, trace=True)
        gaps = np.maximum(solution.objective_trace / best - 1.0, 0.0)
        reached = {
            level: int(np.argmax(gaps <= level)) if gaps[-1] <= level else LIMIT + 1
            for level in (COARSE, TOLERANCE, FINE)
        }
        ended = solution.status.value
        return {
            "status": "optimal" if reached[TOLERANCE] <= LIMIT else "stalled" if ended == "optimal" else ended,
            "iterations": reached[TOLERANCE], "iterations_coarse": reached[COARSE], "iterations_fine": reached[FINE],
            "trials": solution.trials, **Quality.of(grasp, load, solution.force, best, self.objective).columns(),
        }  # fmt: skip

    def _of(self, grasp: Grasp) -> dict[str, ForceOptimizer]:
        if grasp not in self._made:
            while len(self._made) > 3:
                del self._made[next(iter(self._made))]
            self._made[grasp] = {"optimum": optimizer(grasp, "newton", self.objective, OPTIMUM)} | {
                method: optimizer(grasp, method, self.objective, LAST[method], max_iterations=LIMIT)
                for method in METHODS
            }
        return self._made[grasp]


def trials(
    name: str,
    cases: list[Case],
    starts: Mapping[str, PreparedStart],
    solvers: Mapping[str, Solver],
    objective: Objective,
    solved: bool = True,
) -> Iterator[dict[str, Any]]:
    """Yield the rows of a set: one for each case, start and method, and one for each case and solver.

    Args:
        name: name of the set.
        cases: cases to solve.
        starts: see `StartFactory.made`; a start that does not apply to a case has no row there.
        solvers: solvers of a user.
        objective: Phi.
        solved: True if the methods run; otherwise there is one row for each case and start.
    """
    optimizers = Optimizers(objective)
    last: dict[str, tuple[Case, ContactForces]] = {}
    for number, case in enumerate(cases):
        grasp, load, before = case.grasp, case.wrench, None
        if case.before is not None:
            before = carry_force(case.before[0], optimizers.optimum(*case.before)[0], grasp, objective)
        _, best = optimizers.optimum(grasp, load)
        common = {"case": name, "problem": number, "group": case.group, "event": case.event or None}
        paper = _basis(starts, grasp, load)
        phi = None if paper is None else objective.value(grasp.to_cone(paper))
        for key, made in starts.items():
            row = {**common, "start": key}
            try:
                force = attempt(made, grasp, load, before)
            except DoesNotApply:
                continue
            except GraspError as error:
                row |= {"status": "no_start", "reason": failure_reason(error)}
                yield from ({**row, "method": method} for method in (METHODS if solved else (None,)))
                continue
            quality = Quality.of(grasp, load, force, best, objective)
            row |= quality.columns("start_")
            reason = quality.reason()
            if phi is not None and reason is None:
                row["start_excess"] = objective.value(grasp.to_cone(force)) / phi - 1.0
                row["start_replaced"] = key not in RULES and start_replaced(grasp, load, force)
            if reason is None:
                row["start_slope"] = _slope(last.get(key), case, force)
                last[key] = case, force
            if not solved:
                yield row if reason is None else {**row, "status": "no_start", "reason": reason}
                continue
            for method in METHODS:
                try:
                    run = optimizers.run(method, grasp, load, force, best)
                except InfeasibleStartError:  # outside the cones, or not balanced up to rounding
                    yield {**row, "method": method, "status": "no_start", "reason": reason or "out of balance"}
                    continue
                yield {**row, "method": method, **run}
        for key, solver in solvers.items():
            yield {**common, "method": key, **solver_columns(solver, grasp, load, best, objective)}


def problem_of(grasp: Grasp, load: Array, objective: Objective) -> Problem:
    """Return the problem in the form that a user's solver gets."""
    weights = objective.weights(grasp.n_contacts)
    arrays = (grasp.positions, grasp.normals, grasp.friction, load, grasp.frames, weights)
    return Problem(*(np.array(array) for array in arrays))


def solver_columns(solver: Solver, grasp: Grasp, load: Array, best: float, objective: Objective) -> dict[str, Any]:
    """Run a user's solver and return its columns: "optimal" to `TOLERANCE` in Phi, "feasible", or "failed" with the reason."""
    try:
        forces = as_array(
            solver.solve(problem_of(grasp, load, objective)), (grasp.n_contacts, 3), "a solver", ranges.SIZE
        )
    except Exception as error:
        return {"status": "failed", "reason": failure_reason(error), "failed": True}
    local = np.einsum("nij,ni->nj", grasp.frames, forces)
    quality = Quality.of(grasp, load, local, best, objective)
    reason = quality.reason(-BALANCED)
    status = "failed" if reason else "optimal" if quality.gap <= TOLERANCE else "feasible"
    force = float(local[:, 0].sum())
    return {
        "status": status,
        "reason": reason,
        "failed": reason is not None,
        "normal_force": force,
        **quality.columns(),
    }


def attempt(made: PreparedStart, grasp: Grasp, load: Array, before: ContactForces | None) -> ContactForces:
    """Return the force (N, 3) [N] of a start, which may be a user's.

    Raises:
        DoesNotApply: the start does not apply to this case.
        GraspError: it has no force, fails, or returns something else; `failure_reason` gives the reason.
    """
    try:
        return as_array(made.start(grasp, load, before), (grasp.n_contacts, 3), "a start", ranges.SIZE)
    except (DoesNotApply, GraspError):
        raise
    except Exception as error:
        raise InfeasibleStartError(str(error)) from error


def failure_reason(error: Exception) -> str:
    """Return why there is no force, in a few words: the exception's class, a colon and its message."""
    cause = error.__cause__ if isinstance(error.__cause__, Exception) else error
    if isinstance(cause, InfeasibleStartError):
        return "has none"
    return shortened(f"{type(cause).__name__}: {cause!s}", REASON)


def _basis(starts: Mapping[str, PreparedStart], grasp: Grasp, load: Array) -> ContactForces | None:
    """Return the force of the paper's start; None if the grasp has none."""
    try:
        return starts[BASIS].start(grasp, load, None)
    except (KeyError, GraspError):
        return None


def _slope(last: tuple[Case, ContactForces] | None, case: Case, force: ContactForces) -> float:
    """Return |change of the start| over |change of the wrench| since the case before, moments over 0.05 m; nan without one."""
    if last is None or case.before is None or last[0].grasp is not case.grasp:
        return float("nan")
    if last[0].group != case.group or not np.array_equal(last[0].wrench, case.before[1]):
        return float("nan")
    way = float(np.linalg.norm(scaled(case.wrench - last[0].wrench)))
    return float(np.linalg.norm(force - last[1])) / way if way > 0.0 else float("nan")

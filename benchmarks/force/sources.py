"""The two sources of a reference in doubles: the package, and Clarabel on conic forms. `Measure` bounds both."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module

import numpy as np
from scipy import sparse

from benchmarks.force.bounds import Measure
from benchmarks.force.entrants.clarabel import cones_of, infeasible_of
from benchmarks.force.entrants.forms import Dual, Form, Primal, form
from benchmarks.force.package import grasp_of
from benchmarks.force.problems import Array, Problem
from grasp_env.errors import GraspWarning, InfeasibleWrenchError
from grasp_env.force import ForceOptimizer

GAP = 1e-9
"""Largest (upper - lower) / upper of a source."""
TOLERANCES = (1e-13, 1e-12, 1e-11, 1e-10, 1e-9)
"""Tolerances that the solvers are given one after the other, until the gap is a tenth of `GAP`; the best answer counts."""


@dataclass(frozen=True, eq=False)
class Found:
    """The answer of a source to a problem.

    Attributes:
        force, multipliers: (N k,), (6 + L,); the force is nan if the multipliers are a witness.
        lower, upper: bounds by `Measure`; inf if the witness proves that no force exists.
        rest: (N k + 6 + L,) rounding errors of both for results of `exact`, else None.
    """

    force: Array
    multipliers: Array
    lower: float
    upper: float
    rest: Array | None = None

    @property
    def gap(self) -> float:
        """(upper - lower) / upper; 0 where no force exists, inf where nothing is known."""
        if self.lower == np.inf:
            return 0.0
        return (self.upper - self.lower) / self.upper if 0.0 < self.upper < np.inf else np.inf

    @property
    def value(self) -> float:
        """The optimum."""
        return 0.5 * (self.lower + self.upper)


def package(problem: Problem, name: str) -> Found:
    """Source 1: `ForceOptimizer`, whose `GraspError` is raised if it refuses the problem."""
    grasp, limits = grasp_of(problem)
    method = "conic" if name == "sum" else "newton"

    def answers() -> Iterator[tuple[Array, Array, bool]]:
        for tolerance in TOLERANCES:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", GraspWarning)  # sizes of a kilometre are intended
                optimizer = ForceOptimizer(grasp, method=method, limits=limits, tolerance=tolerance)
            try:
                solution = optimizer.solve(problem.wrench, contacts=problem.touching)
            except InfeasibleWrenchError as error:
                solution = error.solution
            if solution is None:
                continue
            force = np.column_stack([solution.force, solution.torsion])[:, : problem.width]
            yield (
                force.reshape(-1),
                np.concatenate([solution.multipliers, solution.limit_multipliers]),
                solution.certificate is not None,
            )

    return _best(problem, name, answers())


def clarabel(problem: Problem, name: str) -> Found:
    """Source 2: Clarabel on the conic forms of its entrant, in turn."""
    makes = (Dual, Primal) if name == "sum" else (partial(form, objective=name),)
    return _best(problem, name, (_solved(make(problem), tolerance) for make in makes for tolerance in TOLERANCES))


def _solved(made: Form, tolerance: float) -> tuple[Array, Array, bool]:
    """Force, multipliers, and whether these are a witness."""
    solver = import_module("clarabel")
    settings = solver.DefaultSettings()
    settings.verbose, settings.presolve_enable, settings.max_iter = False, False, 200
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
    settings.tol_infeas_abs = settings.tol_infeas_rel = tolerance
    nothing, matrix = sparse.csc_matrix((len(made.c), len(made.c))), sparse.csc_matrix(made.rows)
    found = solver.DefaultSolver(nothing, made.c, matrix, made.sides, cones_of(solver, made), settings).solve()
    infeasible = found.status == infeasible_of(solver, made)
    force, multipliers, _ = made.answer(np.array(found.x), np.array(found.z), "infeasible" if infeasible else "solved")
    return np.empty(0) if force is None else force.reshape(-1), multipliers, infeasible


def _best(problem: Problem, name: str, answers: Iterable[tuple[Array, Array, bool]]) -> Found:
    """The answer of the least gap, or the first witness that holds."""
    measure = Measure.of(problem)
    none = best = Found(np.full(problem.matrix.shape[1], np.nan), np.zeros(6 + len(measure.bound)), -np.inf, np.inf)
    for force, multipliers, infeasible in answers:
        if infeasible and measure.witness(multipliers) > 0.0:
            return replace(none, multipliers=multipliers, lower=np.inf)
        if infeasible or not (np.isfinite(force).all() and np.isfinite(multipliers).all()):
            continue
        bounds = measure.lower(name, multipliers), measure.upper(name, force, multipliers)
        found = Found(force, multipliers, *map(float, bounds))
        if abs(found.gap) < abs(best.gap):
            best = found
        if abs(best.gap) <= 0.1 * GAP:
            break
    return best

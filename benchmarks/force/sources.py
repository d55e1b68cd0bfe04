"""The two sources of a reference in doubles: the package, and Clarabel on the cone program. `Measure` bounds both."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from importlib import import_module

import numpy as np

from benchmarks.force.bounds import Measure
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
    """Source 1: `ForceOptimizer`.

    Raises:
        GraspError: it refuses the problem.
    """
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
    """Source 2: Clarabel on the cone program, from `Measure` alone."""
    found = _best(problem, name, map(_Program(problem, name).solve, TOLERANCES))
    if (
        name == "phi" and not abs(found.gap) <= GAP
    ):  # where no force exists, the shorter program of `sum` proves it more clearly
        proof = _best(problem, "sum", map(_Program(problem, "sum").solve, TOLERANCES))
        return proof if proof.lower == np.inf else found
    return found


class _Program:
    """The cone program in u = friction * normal, o, t and torsion * friction / torsional_friction, in units of the wrench.

    For `phi` a contact has r, y and z besides: u r >= root, u (u - z) >= o^2 + t^2, y z >= 2 root, and the price of r and y is
    root = sqrt(lambda): at the optimum they are root / u and root 2 u / (u^2 - o^2 - t^2).
    """

    def __init__(self, problem: Problem, name: str) -> None:
        measure = self.measure = Measure.of(problem)
        self.kept = np.flatnonzero(measure.touching)
        count, k = len(self.kept), problem.width
        mu = measure.friction[self.kept]
        self.scale = np.ones((count, k))
        self.scale[:, 0] = 1.0 / mu
        self.scale[:, 3:] = (measure.spin[self.kept] / mu)[:, None]
        least_normal = 0.0 if problem.min_normal is None else problem.min_normal.max()
        self.unit = (
            float(max(np.abs(measure.load).max(), least_normal, np.sqrt(measure.weight) if name == "phi" else 0.0))
            or 1.0
        )
        self.width, self.size = count * k, count * (k + 3 if name == "phi" else k)
        each = np.eye(self.size)
        at = each[: self.width].reshape(count, k, self.size)
        self.rows, self.sides, self.cones = [], [], []
        self._add("ZeroConeT", self._wide(measure.matrix), -measure.load / self.unit)
        limits = self._wide(measure.rows)
        self.lengths = np.linalg.norm(limits, axis=1)
        self.lengths[self.lengths == 0.0] = 1.0
        self._add("NonnegativeConeT", limits / self.lengths[:, None], measure.bound / self.unit / self.lengths)
        if k == 4:
            self._add(
                "NonnegativeConeT",
                np.concatenate([sign * at[:, 3] - at[:, 0] for sign in (1.0, -1.0)]),
                np.zeros(2 * count),
            )
        self.cost = np.zeros(self.size)
        self.cost[: self.width : k] = measure.price(name)[self.kept] / mu
        root = float(np.sqrt(measure.weight)) / self.unit
        for i in range(count):
            u, o, t = at[i, :3]
            if name == "sum":
                self._add("SecondOrderConeT", -np.stack([u, o, t]), np.zeros(3))
                continue
            r, y, z = each[self.width + 3 * i : self.width + 3 * i + 3]
            self.cost[self.width + 3 * i : self.width + 3 * i + 2] = root
            self._product(u, r, [], np.sqrt(root))
            self._product(u, u - z, [o, t], 0.0)
            self._product(y, z, [], np.sqrt(2.0 * root))

    def solve(self, tolerance: float) -> tuple[Array, Array, bool]:
        """Force, multipliers, and whether these are a witness."""
        solver, sparse = import_module("clarabel"), import_module("scipy.sparse")
        settings = solver.DefaultSettings()
        settings.verbose, settings.presolve_enable, settings.max_iter = False, False, 200
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
        settings.tol_infeas_abs = settings.tol_infeas_rel = tolerance
        nothing, matrix = sparse.csc_matrix((self.size, self.size)), sparse.csc_matrix(np.vstack(self.rows))
        cones = [getattr(solver, cone)(len(side)) for cone, side in zip(self.cones, self.sides, strict=True)]
        found = solver.DefaultSolver(nothing, self.cost, matrix, np.concatenate(self.sides), cones, settings).solve()
        x, z = np.array(found.x), np.array(found.z)
        infeasible = "PrimalInfeasible" in str(found.status)
        count, limits = len(self.measure.friction), len(self.lengths)
        force = np.zeros((count, self.scale.shape[1]))
        force[self.kept] = x[: self.width].reshape(self.scale.shape) * self.scale * self.unit
        sign = 1.0 if infeasible else -1.0
        return (
            force.reshape(-1),
            np.concatenate([self.measure.about_origin(sign * z[:6]), z[6 : 6 + limits] / self.lengths]),
            infeasible,
        )

    def _wide(self, rows: Array) -> Array:
        """Rows (R, N, k) on forces as rows on the variables."""
        kept = (rows[:, self.kept] * self.scale).reshape(len(rows), self.width)
        return np.concatenate([kept, np.zeros((len(rows), self.size - self.width))], axis=1)

    def _add(self, cone: str, rows: Array, side: Array) -> None:
        """Rows x + s = side, s in the cone."""
        if len(side):
            for kept, new in ((self.rows, rows), (self.sides, side), (self.cones, cone)):
                kept.append(new)

    def _product(self, a: Array, b: Array, others: list[Array], constant: float) -> None:
        """The constraint a b >= |others|^2 + constant^2."""
        rows = -np.stack([a + b, a - b, *(2.0 * other for other in others), 0.0 * a])
        side = np.zeros(len(rows))
        side[-1] = 2.0 * constant
        self._add("SecondOrderConeT", rows, side)


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

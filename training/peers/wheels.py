"""Interior-point solvers that install as wheels, on the dual form, each with the settings that serve it best.

Packages are imported when a solver is made, so that this module imports without them.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
from scipy import sparse

from grasp_env._check import Array, Wrench
from training.peers.problem import best_times, dual_form


class _Timed:
    """`Solver.times` by `Solver.solve`."""

    def solve(self, wrench: Wrench) -> Array:
        raise NotImplementedError

    def times(self, wrenches: Array, repeats: int) -> Array:
        """See `best_times`."""
        return best_times(self.solve, wrenches, repeats)


class Clarabel(_Timed):
    """Clarabel, updated in place.

    Args:
        cone_matrix: A, (6, 3N).
        cost: c, (N,).
        tolerance: absolute and relative gap, and feasibility.
    """

    def __init__(self, cone_matrix: Array, cost: Array, tolerance: float = 1e-8) -> None:
        clarabel = import_module("clarabel")
        matrix, bound = dual_form(cone_matrix, cost)
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        # either of these two would forbid the update
        settings.presolve_enable = False
        settings.chordal_decomposition_enable = False
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
        cones = [clarabel.SecondOrderConeT(3)] * len(cost)
        self._solver = clarabel.DefaultSolver(sparse.csc_matrix((6, 6)), np.ones(6), matrix, bound, cones, settings)
        self._solved = clarabel.SolverStatus.Solved

    def solve(self, wrench: Wrench) -> Array:
        """See `Solver`."""
        self._solver.update(q=wrench)
        solution = self._solver.solve()
        force = np.array(solution.z)
        return force if solution.status == self._solved else np.full_like(force, np.nan)


class Qoco(_Timed):
    """QOCO, updated in place.

    At 1e-8 it stalls on a few wrenches in a thousand, and a stall raises the regularisation of every later solve of
    the same object: hundreds fail. 1e-7 solves them all; the default is put back after a failure all the same.
    It does not detect infeasibility: for a wrench that nothing balances it reports success with forces near zero.
    """

    def __init__(self, cone_matrix: Array, cost: Array, tolerance: float = 1e-7) -> None:
        matrix, bound = dual_form(cone_matrix, cost)
        count = len(cost)
        self._solver = import_module("qoco").QOCO()
        self._solver.setup(
            n=6,
            m=3 * count,
            p=0,
            P=None,
            c=np.ones(6),
            A=None,
            b=None,
            G=matrix,
            h=bound,
            l=0,
            nsoc=count,
            q=np.full(count, 3),
            abstol=tolerance,
            reltol=tolerance,
        )
        self._regularisation = self._solver.settings.kkt_dynamic_reg

    def solve(self, wrench: Wrench) -> Array:
        """See `Solver`."""
        self._solver.update_vector_data(c=wrench)
        solution = self._solver.solve()
        if solution.status != "QOCO_SOLVED":
            self._solver.update_settings(kkt_dynamic_reg=self._regularisation)
            return np.full(len(solution.z), np.nan)
        return np.asarray(solution.z)


class Moreau(_Timed):
    """Moreau's compiled solver, its structure and values set up once; a batch is one call, on all cores.

    The dual form takes 0.85 of the time of the primal with `DirectConeSpec`, and every `direct_solve_method` the same.

    Args:
        cone_matrix: A, (6, 3N).
        cost: c, (N,).
        tolerance: absolute and relative gap, and feasibility.
        warm: whether a call starts from the solution before it, cold once more where that ends otherwise than solved. Of random
            wrenches it saves nothing, along a path of small steps a third.
    """

    def __init__(self, cone_matrix: Array, cost: Array, tolerance: float = 1e-8, warm: bool = False) -> None:
        self._moreau, self._form = import_module("moreau"), dual_form(cone_matrix, cost)
        self._cones = self._moreau.Cones(so_cone_dims=[3] * len(cost))
        self._tolerance, self._warm, self._last = tolerance, warm, None
        self._solved = self._moreau.SolverStatus.Solved
        self._solver, self._bound = self._made(1)
        self._many: tuple[int, Any, Array] | None = None

    def solve(self, wrench: Wrench) -> Array:
        """See `Solver`."""
        solution = self._solver.solve(wrench[None], self._bound, warm_start=self._last)
        if self._last is not None and self._solver.info.status[0] != self._solved:
            solution = self._solver.solve(wrench[None], self._bound)
        good = self._solver.info.status[0] == self._solved
        self._last = solution.to_warm_start() if self._warm and good else None
        return np.asarray(solution.z[0]) if good else np.full(self._bound.shape[1], np.nan)

    def prepare(self, count: int) -> None:
        """Sets up for batches of that size."""
        self._many = count, *self._made(count)

    def solve_many(self, wrenches: Array) -> Array:
        """The forces (M, 3N) of a batch (M, 6), NaN where there is none."""
        if self._many is None or self._many[0] != len(wrenches):
            self.prepare(len(wrenches))
        assert self._many is not None
        _, solver, bound = self._many
        forces = np.array(solver.solve(wrenches, bound).z)
        forces[[status != self._solved for status in solver.info.status]] = np.nan
        return forces

    def _made(self, batch: int) -> tuple[Any, Array]:
        """A solver for that many problems at once, and their right sides."""
        matrix, bound = self._form[0].tocsr(), self._form[1]
        every = set(
            self._moreau.SolverStatus
        )  # none is tried again, with a warning, where a warm start fails: `solve` does
        ipm = self._moreau.IPMSettings(
            tol_gap_abs=self._tolerance,
            tol_gap_rel=self._tolerance,
            tol_feas=self._tolerance,
            warm_start_no_retry=every,
        )
        settings = self._moreau.Settings(device="cpu", solver="ipm", batch_size=batch, ipm_settings=ipm)
        solver = self._moreau.CompiledSolver(
            6, len(bound), np.zeros(7, dtype=np.int64), [], matrix.indptr, matrix.indices, self._cones, settings
        )
        solver.setup(np.zeros(0), matrix.data)
        return solver, np.tile(bound, (batch, 1))


class Ecos(_Timed):
    """ECOS, which has no update: every call sets up again. GPL-3: never a dependency, for comparison only."""

    def __init__(self, cone_matrix: Array, cost: Array, tolerance: float = 1e-8) -> None:
        self._ecos = import_module("ecos")
        self._matrix, self._bound = dual_form(cone_matrix, cost)
        self._dims = {"l": 0, "q": [3] * len(cost), "e": 0}
        self._options = {"abstol": tolerance, "reltol": tolerance, "feastol": tolerance, "verbose": False}

    def solve(self, wrench: Wrench) -> Array:
        """See `Solver`."""
        answer = self._ecos.solve(wrench, self._matrix, self._bound, self._dims, **self._options)
        return answer["z"] if answer["info"]["exitFlag"] == 0 else np.full_like(self._bound, np.nan)

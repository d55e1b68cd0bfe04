"""Interior-point solvers that install as wheels, on the dual form, each with the settings that serve it best.

Packages are imported when a solver is made, so that this module imports without them.
"""

from __future__ import annotations

from importlib import import_module

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

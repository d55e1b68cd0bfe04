"""Clarabel, updated in place."""

from __future__ import annotations

from importlib import import_module

import numpy as np
from scipy import sparse

from benchmarks.force.entrants.forms import Conic, Numbers
from benchmarks.force.problems import Array


class Clarabel(Conic):
    """Clarabel's interior-point method."""

    name = "clarabel"
    note = "Dual form (phi and many limits: primal), updated in place; tolerances 1e-8, in the primal 1e-7."

    def build(self) -> None:
        """See `Conic`."""
        clarabel = import_module("clarabel")
        form = self.form
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        # either of these two would forbid the update
        settings.presolve_enable = False
        settings.chordal_decomposition_enable = False
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = self.tolerance
        self._numbers = Numbers(form.rows, form.pattern)
        linear = ((clarabel.ZeroConeT, form.equations), (clarabel.NonnegativeConeT, form.nonneg))
        cones = [cone(size) for cone, size in linear if size]
        cones += [clarabel.SecondOrderConeT(size) for size in form.cones]
        quadratic = sparse.csc_matrix((len(form.c), len(form.c)))
        self._solver = clarabel.DefaultSolver(
            quadratic, form.c, self._numbers.matrix, form.sides, cones, settings
        )
        self._statuses = self.statuses(clarabel.SolverStatus)

    def run(self, moved: bool) -> tuple[Array, Array, str]:
        """See `Conic`."""
        form = self.form
        if moved:
            self._solver.update(q=form.c, A=self._numbers.refresh(form.rows), b=form.sides)
        elif form.in_cost:
            self._solver.update(q=form.c)
        else:
            self._solver.update(b=form.sides)
        result = self._solver.solve()
        self.iterations = result.iterations
        return np.array(result.x), np.array(result.z), self._statuses.get(result.status, "failed")

"""Moreau's compiled solver."""

from __future__ import annotations

from importlib import import_module

import numpy as np

from benchmarks.force.entrant import Answer, Task
from benchmarks.force.entrants.forms import Conic, Numbers
from benchmarks.force.problems import Array, Problem


class Moreau(Conic):
    """Moreau's interior-point method on one thread of the CPU, set up once.

    The dual form takes 0.85 of the time of the primal with `DirectConeSpec`, and every
    `direct_solve_method` the same.
    """

    name = "moreau"
    note = (
        "CompiledSolver on the CPU, dual form (phi and many limits: primal), values set up once; tolerances 1e-8, in the primal 1e-7. "
        "Its warm start halves the iterations along a path and saves nothing on random wrenches."
    )

    def setup(self, task: Task) -> None:
        """See `Entrant`."""
        self._warm = task.mode == "warm"
        super().setup(task)

    def build(self) -> None:
        """See `Conic`."""
        moreau = import_module("moreau")
        form = self.form
        # its matrices are stored by rows: the transpose's by columns
        self._numbers = Numbers(form.rows.T, form.pattern.T)
        cones = moreau.Cones(
            num_zero_cones=form.equations, num_nonneg_cones=form.nonneg, so_cone_dims=form.cones
        )
        limits = dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), self.tolerance)
        ipm = moreau.IPMSettings(**limits)
        settings = moreau.Settings(device="cpu", solver="ipm", batch_size=1, ipm_settings=ipm)
        stored = self._numbers.matrix
        m, n = form.rows.shape
        begins = np.zeros(n + 1, dtype=np.int64)
        self._solver = moreau.CompiledSolver(
            n, m, begins, [], stored.indptr, stored.indices, cones, settings
        )
        self._solver.setup(np.zeros(0), stored.data)
        self._last = None
        self._statuses = self.statuses(moreau.SolverStatus)

    def solve(self, problem: Problem, start: Array | None = None) -> Answer:
        """See `Entrant`; any `start` stands for all variables and multipliers of the last call."""
        self._started = start is not None
        return super().solve(problem)

    def run(self, moved: bool) -> tuple[Array, Array, str]:
        """See `Conic`."""
        form = self.form
        if moved:
            self._solver.setup(np.zeros(0), self._numbers.refresh(form.rows.T))
        last = self._last if self._started else None
        result = self._solver.solve(form.c[None], form.sides[None], last)
        info = self._solver.info
        if self._warm:
            self._last = result.to_warm_start()
        self.iterations = int(info.iterations[0])
        return result.x[0], result.z[0], self._statuses.get(info.status[0], "failed")

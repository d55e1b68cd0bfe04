"""QOCO, updated in place."""

from __future__ import annotations

from importlib import import_module

import numpy as np

from benchmarks.force.entrants.forms import Conic
from benchmarks.force.problems import Array


class Qoco(Conic):
    """QOCO's interior-point method.

    At 1e-8 it stalls on a few wrenches in a thousand, and a stall raises the regularisation of
    every later solve of the object, so hundreds fail. 1e-7 solves them all. After a failure the
    default is restored nevertheless.
    """

    name = "qoco"
    note = (
        "Dual form (phi and many limits: primal), updated in place; tolerances 1e-7, because 1e-8 stalls now and then. "
        "It detects no infeasibility and reports such wrenches as solved."
    )

    def build(self) -> None:
        """See `Conic`."""
        form, p = self.form, self.form.equations
        self._upper, self._lower = form.halves()
        self._solver = import_module("qoco").QOCO()
        self._solver.setup(
            n=len(form.c),
            m=len(form.sides) - p,
            p=p,
            P=None,
            c=form.c,
            A=self._upper.matrix if self._upper else None,
            b=form.sides[:p],
            G=self._lower.matrix,
            h=form.sides[p:],
            l=form.nonneg,
            nsoc=len(form.cones),
            q=np.array(form.cones),
            abstol=1e-7,
            reltol=1e-7,
        )
        self._regularisation = self._solver.settings.kkt_dynamic_reg

    def run(self, moved: bool) -> tuple[Array, Array, str]:
        """See `Conic`."""
        form = self.form
        p = form.equations
        solver = self._solver
        if moved:
            solver.update_vector_data(c=form.c, b=form.sides[:p] if p else None, h=form.sides[p:])
            upper = self._upper.refresh(form.rows[:p]) if self._upper else None
            solver.update_matrix_data(A=upper, G=self._lower.refresh(form.rows[p:]))
        elif form.in_cost:
            solver.update_vector_data(c=form.c)
        else:
            solver.update_vector_data(b=form.sides[:p], h=form.sides[p:])
        result = solver.solve()
        self.iterations = result.iters
        solved = result.status == "QOCO_SOLVED"
        if not solved:
            solver.update_settings(kkt_dynamic_reg=self._regularisation)
        return result.x, form.joined(result.y, result.z), "solved" if solved else "failed"

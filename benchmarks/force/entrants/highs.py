"""HiGHS on the linear program over inner pyramids."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
from scipy import sparse

from benchmarks.force.entrant import Answer, Task
from benchmarks.force.entrants.pyramids import Pyramids
from benchmarks.force.problems import Array, Problem


class Highs:
    """The dual simplex method on a model that is kept while only the wrench changes."""

    name = "highs"
    objectives = ("sum",)
    note = (
        "highspy, simplex without presolve (scipy's linprog takes ten times as long); in mode warm it keeps the basis. "
        "Pyramids of 8 sides miss the optimum by 2-3 %, up to 10 %, those of 26 edges in the cones of soft contacts by 7 %, up to 14 %, "
        "so that even 1e-4 is out of reach."
    )

    def setup(self, task: Task) -> None:
        """See `Entrant`."""
        self._highspy = import_module("highspy")
        self._solver: Any = self._highspy.Highs()
        for option, value in {"output_flag": False, "presolve": "off", "solver": "simplex"}.items():
            self._solver.setOptionValue(option, value)
        self._balance = np.arange(6, dtype=np.int32)
        self._model(task.first)
        self._of = task.first

    def solve(self, problem: Problem, start: Array | None = None) -> Answer:
        """See `Entrant`; with a `start` the simplex method begins at the last basis."""
        solver = self._solver
        moved = problem.differs(self._of)
        self._of = problem
        if moved:
            basis = solver.getBasis()
            self._model(problem)
            if start is not None:
                solver.setBasis(basis)
        else:
            if start is None:
                solver.clearSolver()
            solver.changeRowsBounds(6, self._balance, -problem.wrench, -problem.wrench)
        solver.run()
        self.iterations = solver.getInfo().simplex_iteration_count
        # without a force in the pyramids, there may be one in the cones
        solved = solver.getModelStatus() == self._highspy.HighsModelStatus.kOptimal
        force = self._pyramids.force(np.array(solver.getSolution().col_value))
        return force, None, "solved" if solved else "failed"

    def _model(self, problem: Problem) -> None:
        self._pyramids = Pyramids(problem)
        stored = sparse.csc_matrix(self._pyramids.columns)
        infinity = self._highspy.kHighsInf
        rows, columns = self._pyramids.columns.shape
        lp = self._highspy.HighsLp()
        lp.num_row_ = rows
        lp.num_col_ = columns
        lp.col_cost_ = np.ones(columns)
        lp.col_lower_ = np.zeros(columns)
        lp.col_upper_ = np.full(columns, infinity)
        lp.row_lower_ = np.concatenate([-problem.wrench, np.full(rows - 6, -infinity)])
        lp.row_upper_ = np.concatenate([-problem.wrench, problem.limit_bound])
        lp.a_matrix_.format_ = self._highspy.MatrixFormat.kColwise
        lp.a_matrix_.start_ = stored.indptr
        lp.a_matrix_.index_ = stored.indices
        lp.a_matrix_.value_ = stored.data
        self._solver.passModel(lp)

"""PIQP on the linear program over inner pyramids."""

from __future__ import annotations

from importlib import import_module

import numpy as np

from benchmarks.force.entrant import Answer, Task
from benchmarks.force.entrants.pyramids import Pyramids
from benchmarks.force.problems import Array, Problem


class Piqp:
    """PIQP's proximal interior-point method on the dual, with 6 + L variables."""

    name = "piqp"
    objectives = ("sum",)
    note = (
        "Dual form over pyramids of 8 sides, DenseSolver, updated in place, its default tolerances (1e-8); the release has no warm start. "
        "The pyramids miss the optimum by 2-3 %, up to 10 %, those of 26 edges in the cones of soft contacts by 7 %, up to 14 %, "
        "so that even 1e-4 is out of reach."
    )

    def setup(self, task: Task) -> None:
        """See `Entrant`."""
        piqp = import_module("piqp")
        first = task.first
        self._solver = piqp.DenseSolver()
        self._solved = piqp.PIQP_SOLVED
        self._pyramids = Pyramids(first)
        self._of = first
        rows = self._rows()
        least = np.concatenate([np.full(6, -np.inf), np.zeros(len(first.limit_bound))])
        self._cost = np.concatenate([first.wrench, first.limit_bound])
        quadratic = np.zeros((len(least), len(least)), order="F")
        self._solver.setup(quadratic, self._cost, G=rows, h_u=np.ones(len(rows)), x_l=least)

    def solve(self, problem: Problem, start: Array | None = None) -> Answer:
        """See `Entrant`; `start` is not used."""
        self._cost[:6] = problem.wrench
        moved = problem.differs(self._of)
        self._of = problem
        if moved:
            self._pyramids = Pyramids(problem)
            self._cost[6:] = problem.limit_bound
            self._solver.update(c=self._cost, G=self._rows())
        else:
            self._solver.update(c=self._cost)
        # without a force in the pyramids, there may be one in the cones
        status = "solved" if self._solver.solve() == self._solved else "failed"
        self.iterations = self._solver.result.info.iter
        return self._pyramids.force(np.array(self._solver.result.z_u)), None, status

    def _rows(self) -> Array:
        columns = self._pyramids.columns.T.copy(order="F")
        columns[:, 6:] *= -1.0
        return columns

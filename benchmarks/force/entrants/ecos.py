"""ECOS, which has no update: every call sets up again."""

from __future__ import annotations

from importlib import import_module

from benchmarks.force.entrants.forms import Conic
from benchmarks.force.problems import Array


class Ecos(Conic):
    """ECOS's interior-point method."""

    name = "ecos"
    note = (
        "Dual form (phi and many limits: primal), set up in every call, as it has no update; tolerances 1e-8. "
        "GPL-3: for comparison only."
    )

    def build(self) -> None:
        """See `Conic`."""
        form = self.form
        self._solve = import_module("ecos").solve
        self._upper, self._lower = form.halves()
        self._dims = {"l": form.nonneg, "q": form.cones, "e": 0}
        self._options = {"abstol": 1e-8, "reltol": 1e-8, "feastol": 1e-8, "verbose": False}
        self._infeasible = 2 if form.in_cost else 1

    def run(self, moved: bool) -> tuple[Array, Array, str]:
        """See `Conic`."""
        form, p = self.form, self.form.equations
        if moved:
            self._lower.refresh(form.rows[p:])
            if self._upper:
                self._upper.refresh(form.rows[:p])
        equations = (self._upper.matrix, form.sides[:p]) if self._upper else ()
        result = self._solve(
            form.c, self._lower.matrix, form.sides[p:], self._dims, *equations, **self._options
        )
        info = result["info"]
        self.iterations = info["iter"]
        status = {0: "solved", self._infeasible: "infeasible"}.get(info["exitFlag"], "failed")
        return result["x"], form.joined(result["y"], result["z"]), status

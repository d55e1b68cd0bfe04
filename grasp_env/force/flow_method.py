"""The paper's flows as methods, compiled by numba; see `methods`."""

from __future__ import annotations

from typing import Any

import numpy as np

from grasp_env._check import Array, Wrench
from grasp_env.errors import InfeasibleStartError
from grasp_env.force.basis import OfflineBasis
from grasp_env.force.flow import FORMS
from grasp_env.force.flow import Flow as GradientFlow
from grasp_env.force.flow_record import BASIS, TANGENT, run_flow, solve_flow
from grasp_env.force.initial import CompiledRule, RuleStarts
from grasp_env.force.lanes import KNOWN, options
from grasp_env.force.method import Loop, Settings, Start, readable, refused_start
from grasp_env.force.methods import LOOPED, NO_TRACE, rule_loop
from grasp_env.force.record import CODE, FORCE, ITERATIONS, REFUSED, record_size
from grasp_env.force.solution import ForceSolution
from grasp_env.grasp.grasp import Grasp


class Flow(RuleStarts):
    """`reduced_flow` in its fastest form, `full_flow` dense."""

    def __init__(self, grasp: Grasp, settings: Settings) -> None:
        self.grasp, self.settings = grasp, settings
        flow = GradientFlow(grasp, "full" if settings.method == "full_flow" else None)
        self._form = (flow.constants, FORMS.index(flow.form), *flow.matrices)
        weights = settings.objective.weights(grasp.n_contacts)
        # kernels take writable arrays only: one compiled signature
        self._contacts = (grasp.cone_matrix.copy(), grasp.models.cone_divisor.copy(), weights)
        self._rule = settings.step_rule.parameters()
        self._options = options(grasp, settings.tolerance, settings.max_iterations)
        self._size = record_size(grasp.n_contacts)

    def loop(self, initial: Any) -> Loop | None:
        """See `Method.loop`."""
        if self.settings.correction != "tangent":
            return None
        if isinstance(initial, CompiledRule):
            return rule_loop(self, initial)
        if initial is not None and not (isinstance(initial, str) and initial in LOOPED):
            return None
        try:
            basis = OfflineBasis.of(self.grasp, self.settings.objective).cone_forces
        except InfeasibleStartError:
            return None  # rules that need one say so
        grasp = self.grasp
        inverse = grasp.pseudoinverse * grasp.models.cone_scale.reshape(-1)[:, None]
        nothing = np.empty(0)

        def call(wrench: Any, previous: Array | None, record: Array) -> int:
            if not readable(wrench) or (previous is not None and len(previous) != self._size):
                return REFUSED
            kind, start = (BASIS, nothing) if previous is None else (TANGENT, previous[FORCE:])
            solve_flow(
                *self._form, kind, start, basis, inverse, *self._contacts, wrench, self._rule, self._options, record
            )
            return int(record[CODE])

        call(
            np.zeros(6), None, np.empty(self._size)
        )  # compiles, or loads, the kernels before the first call that counts
        return Loop(call, "linear_combination", "previous", remembers=initial == "previous")

    def descend(self, force: Array, wrench: Wrench, record: Array) -> None:
        """From a force (3N,) [N] into a record."""
        run_flow(*self._form, force, *self._contacts, wrench, self._rule, self._options, record, NO_TRACE)

    def run(self, wrench: Wrench, start: Start | None, optimum: float, trace: bool) -> ForceSolution:
        """See `Method`."""
        assert start is not None
        values = np.full(self.settings.max_iterations + 1, np.nan) if trace else NO_TRACE
        record, numbers = np.empty(self._size), self._options.copy()
        numbers[KNOWN] = optimum
        run_flow(*self._form, start.force.reshape(-1), *self._contacts, wrench, self._rule, numbers, record, values)
        if record[CODE] == REFUSED:
            raise refused_start(self.grasp, wrench, start)
        return ForceSolution(record, self.settings.method, start.name, values[: int(record[ITERATIONS]) + 1])

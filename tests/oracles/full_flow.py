"""The full flow (Eq. 12) without compiled code: the plain driver on vec(P), certified like the compiled flow."""

from __future__ import annotations

import numpy as np

from grasp_env._check import Array, Wrench
from grasp_env.force import full_flow as full
from grasp_env.force.descent import descend
from grasp_env.force.kernels import certified_bound, relative_gap
from grasp_env.force.objective import Objective
from grasp_env.force.step_size import StepRule
from grasp_env.grasp.grasp import Grasp


def full_flow(
    grasp: Grasp,
    objective: Objective,
    x: Array,
    wrench: Wrench,
    rule: StepRule,
    tolerance: float,
    optimum: float,
    max_iterations: int,
    trace: Array,
) -> tuple[int, int, int, float, float]:
    """Runs Eq. 12 from cone coordinates x (3N,), overwritten; arguments and result as `flow.run_flow`."""
    matrix = grasp.cone_matrix.copy()
    step, multipliers = np.empty_like(x), np.empty(6)
    weights = objective.weights(grasp.n_contacts)
    bound = -np.inf if np.isnan(optimum) else optimum
    next_check = 0

    def converged(state: Array, value: float, iterations: int) -> bool:
        nonlocal bound, next_check
        if np.isnan(optimum) and iterations >= next_check:
            next_check = iterations + max(1, iterations // 8)
            here = full.cone_coordinates(state)
            bound = max(bound, certified_bound(here, matrix, wrench, weights, step, multipliers))
        return relative_gap(value, bound) <= tolerance

    result = descend(full.start(x), full.landscape(grasp, objective), converged, rule, max_iterations)
    x[:] = full.cone_coordinates(result.state)
    count = min(len(trace), len(result.values))
    trace[:count] = result.values[:count]
    return result.code, result.iterations, result.trials, result.values[-1], bound

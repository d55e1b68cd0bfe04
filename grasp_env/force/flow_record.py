"""The flow from its start to its record in one compiled call: what control loops pay for."""

from __future__ import annotations

import numpy as np

from grasp_env._compile import compiled
from grasp_env.core import LARGEST
from grasp_env.force.flow_kernels import flow
from grasp_env.force.kernels import best_on_segment, certified_bound, combine, cone_slack, phi, residual, tangent
from grasp_env.force.lanes import load, pull_back
from grasp_env.force.method import BALANCE_TOLERANCE
from grasp_env.force.record import (
    BOUND,
    CODE,
    FORCE,
    ITERATIONS,
    MARGIN,
    MULTIPLIERS,
    OBJECTIVE,
    REFUSED,
    RESIDUAL,
    TRIALS,
    WRENCH,
)

BASIS, TANGENT = 1, 2
"""Kinds of starts."""


@compiled
def solve_flow(
    constants, form, first, second, places, kind, start, basis, inverse, cone_matrix, divisor, weights, wrench, rule, options,
    record,
):  # fmt: skip
    """`run_flow` from the 12-basis or from the previous optimum; writes `record` (see `record.py`).

    REFUSED where the wrench is not finite or the start is not balanced and strictly inside: the general path says why.

    Args:
        constants, form, first, second, places, rule, options: see `flow_kernels.flow`.
        kind: BASIS or TANGENT.
        start: (>= 3N,) for TANGENT: the previous force (normal, o, t) [N].
        basis: (13, 3N) the offline basis, cone coordinates.
        inverse, cone_matrix: G^+ (3N, 6) and G (6, 3N) in cone coordinates.
        divisor: (N, 3) force = cone coordinates / divisor.
        weights: (N, 2) omega and lambda.
        wrench: (6,) external wrench [N, N m].
        record: (20 + 7N,) overwritten.
    """
    record[CODE] = REFUSED
    for r in range(6):
        if not abs(wrench[r]) <= LARGEST:
            return
    x = np.empty(cone_matrix.shape[1])
    combine(basis, wrench, False, x)
    if kind == TANGENT:
        safe, before, moved = x.copy(), np.empty_like(x), np.empty_like(x)
        for j in range(x.size):
            scale = divisor[j // 3, j % 3]
            before[j] = start[j] * scale if scale < np.inf else 0.0
        if not (phi(before, weights) < np.inf and tangent(before, cone_matrix, wrench, weights, moved)):
            moved[:] = before
        least_change(moved, cone_matrix, inverse, wrench)
        best_on_segment(safe, moved, weights, x)
    for j in range(x.size):
        x[j] /= divisor[j // 3, j % 3]
    run_flow(
        constants, form, first, second, places, x, cone_matrix, divisor, weights, wrench, rule, options, record, np.empty(0)
    )  # fmt: skip


@compiled
def least_change(x, cone_matrix, inverse, wrench):
    """Takes what misses balance off x (3N,) by G^+."""
    left = np.empty(6)
    residual(cone_matrix, x, wrench, left)
    for j in range(x.size):
        for r in range(6):
            x[j] -= inverse[j, r] * left[r]


@compiled
def run_flow(
    constants, form, first, second, places, start, cone_matrix, divisor, weights, wrench, rule, options, record, trace
):  # fmt: skip
    """The flow from a force `start` (3N,) and its record; REFUSED where it is not balanced and strictly inside.

    trace: (T,) receives Phi of iterates 0..T-1. All other arguments as in `solve_flow`.
    """
    size = start.size
    x, six = np.empty(size), np.empty(12)
    left, unit = six[:6], six[6:]
    for j in range(record.size):
        record[j] = 0.0
    record[CODE] = REFUSED
    largest = 0.0
    for j in range(size):
        scale = divisor[j // 3, j % 3]
        record[FORCE + size + j] = start[j]
        x[j] = start[j] * scale if scale < np.inf else 0.0
        largest = max(largest, abs(start[j]))
    residual(cone_matrix, x, wrench, left)
    balanced = unit_size(left, options, unit) <= BALANCE_TOLERANCE * (largest + unit_size(wrench, options, unit))
    if not (balanced and phi(x, weights) < np.inf):
        return
    record[CODE], record[ITERATIONS], record[TRIALS], record[OBJECTIVE], record[BOUND] = flow(
        constants, form, first, second, places, weights, x, wrench, rule, options, trace, left
    )
    if left[0] == left[0]:
        multipliers = pull_back(options, left)
        for r in range(6):
            record[MULTIPLIERS + r] = multipliers[r]
    else:
        certified_bound(x, cone_matrix, wrench, weights, np.empty(size), record[MULTIPLIERS : MULTIPLIERS + 6])
    record[MARGIN] = cone_slack(x)
    residual(cone_matrix, x, wrench, left)
    record[RESIDUAL] = unit_size(left, options, unit)
    for r in range(6):
        record[WRENCH + r] = wrench[r]
    for j in range(size):
        record[FORCE + j] = x[j] / divisor[j // 3, j % 3]


@compiled
def unit_size(wrench, options, unit):
    """Largest |component| of a wrench in the unit frame [N]; `unit` (6,) is work space."""
    load(wrench, options, unit)
    most = 0.0
    for r in range(6):
        most = max(most, abs(unit[r]))
    return most

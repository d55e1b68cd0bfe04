"""Damped Newton on Phi under balance, compiled, four contacts at a time; linear in N.

The Hessian of Phi is block diagonal, so a step is one 6 x 6 system G H^-1 G^T whatever N is. Starts are the 12-basis, a
given force, or the previous optimum carried over by the tangent correction. The plain twin of a step is `newton.newton_step`.
"""

from __future__ import annotations

import math

import numpy as np

from grasp_env._check import LARGEST
from grasp_env._compile import compiled_lanes
from grasp_env.force.cholesky6 import factor6, solve6
from grasp_env.force.descent_kernels import CONVERGED, LIMIT, SHORTEST, STALLED
from grasp_env.force.kernels import phi
from grasp_env.force.lanes import (
    CONSTANTS,
    DIVISOR,
    GAP,
    KNOWN,
    LANE_COUNT,
    PINV,
    STEPS,
    G,
    load,
    pull_back,
)
from grasp_env.force.phi_lanes import (
    STEP,
    WIDTH,
    X,
    correct,
    direction,
    longest,
    newton_system,
    phi_bound,
    reach_and_decrement,
    rebalance,
    spread,
    trial_phi,
)
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
from grasp_env.force.start_kernels import best_on_segment, combine

GIVEN, BASIS, TANGENT = 0, 1, 2
"""Kinds of starts."""


REFINEMENTS = 3
BALANCED = 1e-13
"""A step that misses balance by less than this part of Phi needs no refinement [N / N]."""


@compiled_lanes
def newton(constants, basis, kind, start, wrench, weights, options, record, trace):
    """Solves one wrench and writes `record` (see `record.py`).

    Args:
        constants: (blocks, 4 * CONSTANTS) from `lanes.pack`.
        basis: (13, 3N) the offline basis, cone coordinates; for GIVEN it is not read.
        kind: GIVEN: `start` is balanced and strictly inside. BASIS: the 12-basis' combination. TANGENT: `start` is an
            optimum for another wrench, or other contacts, and is carried over and repaired.
        start: (3N,) forces (normal, o, t) [N]; a record's are at record[FORCE : FORCE + 3N].
        wrench: (6,) external wrench [N, N m].
        weights: (N, 2) omega and lambda, as in `constants`.
        options: (8,) from `lanes.options`; with a known min Phi the gap is taken to that instead of the dual bound.
        record: (20 + 7N,) overwritten.
        trace: (T,) receives Phi of iterates 0..T-1.
    """
    tolerance, limit, lanes, optimum = options[GAP], options[STEPS], int(options[LANE_COUNT]), options[KNOWN]
    blocks = constants.shape[0]
    count = (record.size - FORCE) // 7
    for r in range(6):
        if not abs(wrench[r]) <= LARGEST:
            record[CODE] = REFUSED
            return
    work = np.empty((blocks, WIDTH))
    scratch = np.empty(192 + 3 * count)  # one allocation
    sums, lower, factor, unit = scratch[:132], scratch[132:153], scratch[153:174], scratch[174:180]
    left, right, first = scratch[180:186], scratch[186:192], scratch[192:]
    load(wrench, options, unit)
    for b in range(blocks):
        for j in range(4 * CONSTANTS):
            work[b, j] = constants[b, j]
        for n in range(4):
            work[b, 4 * X + n], work[b, 4 * (X + 1) + n], work[b, 4 * (X + 2) + n] = 1.0, 0.0, 0.0
            work[b, 4 * STEP + n], work[b, 4 * (STEP + 1) + n], work[b, 4 * (STEP + 2) + n] = 0.0, 0.0, 0.0
    if kind == BASIS:
        combine(basis, wrench, False, first)
    else:
        for i in range(count):
            for a in range(3):
                scale = work[i // 4, 4 * (DIVISOR + a) + i % 4]
                first[3 * i + a] = start[3 * i + a] * scale if scale < np.inf else 0.0
    spread(first, work)
    if kind == TANGENT:
        _carry_over(work, sums, lower, factor, unit, wrench, weights, basis, first, lanes)
        spread(first, work)
    value = trial_phi(work, 0.0, lanes)
    known = optimum == optimum
    bound = optimum if known else -np.inf
    n0, n1, n2, n3, n4, n5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    iterations, trials = 0, 0
    code = CONVERGED
    while True:
        if iterations < trace.size:
            trace[iterations] = value
        newton_system(work, sums, lanes)
        for r in range(21):
            lower[r] = (sums[4 * r] + sums[4 * r + 1]) + (sums[4 * r + 2] + sums[4 * r + 3])
        if not factor6(lower, factor) > 0.0:
            code = STALLED
            break
        # S nu = G H^-1 grad - r, r = G x + w
        for r in range(6):
            p = 4 * r
            left[r] = (sums[108 + p] + sums[109 + p]) + (sums[110 + p] + sums[111 + p]) + unit[r]
            right[r] = (sums[84 + p] + sums[85 + p]) + (sums[86 + p] + sums[87 + p]) - left[r]
        n0, n1, n2, n3, n4, n5 = solve6(factor, right[0], right[1], right[2], right[3], right[4], right[5])
        direction(work, sums, n0, n1, n2, n3, n4, n5, lanes)
        # forces at very different depths in their cones make S ill-conditioned: what the step misses of balance is taken off,
        # in the metric of Phi while it is large (a few digits a time), then by the least change
        for r in range(6):
            right[r] = left[r]
        for refinement in range(REFINEMENTS + 1):
            worst = 0.0
            for r in range(6):
                p = 4 * r
                left[r] = right[r] + (sums[p] + sums[p + 1]) + (sums[p + 2] + sums[p + 3])
                worst = max(worst, abs(left[r]))
            if not worst > BALANCED * value or refinement == REFINEMENTS:
                break
            correct(work, sums, solve6(factor, left[0], left[1], left[2], left[3], left[4], left[5]), lanes)
        rebalance(work, left, lanes)
        decrement, reach = reach_and_decrement(work, lanes)
        # Phi - min Phi is half the squared decrement to third order: the bound costs half an iteration, so it waits
        if not known and (decrement < 4.0 * tolerance * value or iterations >= limit):
            bound = max(bound, phi_bound(work, unit, n0, n1, n2, n3, n4, n5, lanes))
        # far below its bound is a force that misses balance: steps restore it
        if bound > 0.0 and value - bound <= tolerance * bound and (known or value - bound >= -1e-9 * bound):
            break
        if iterations >= limit:
            code = LIMIT
            break
        alpha = min(1.0, 0.95 / reach) if reach > 0.0 else 1.0
        accepted, trial = False, value
        for _ in range(60):
            trials += 1
            trial = trial_phi(work, alpha, lanes)
            if trial < value - 1e-4 * alpha * decrement or (trial <= value and decrement < 1e-9 * value):
                # far from the optimum steps are as long as Phi is straight: what counts is how far x moves
                accepted = alpha * longest(work, STEP) > SHORTEST * longest(work, X)
                break
            alpha *= 0.5
        if not accepted:
            if not known:
                bound = max(bound, phi_bound(work, unit, n0, n1, n2, n3, n4, n5, lanes))
            code = CONVERGED if bound > 0.0 and value - bound <= tolerance * bound else STALLED
            break
        for b in range(blocks):
            row = work[b]
            for n in range(lanes):
                row[4 * X + n] += alpha * row[4 * STEP + n]
                row[4 * (X + 1) + n] += alpha * row[4 * (STEP + 1) + n]
                row[4 * (X + 2) + n] += alpha * row[4 * (STEP + 2) + n]
        value = trial
        iterations += 1
    record[:] = 0.0
    record[CODE], record[ITERATIONS], record[TRIALS] = code, iterations, trials
    record[OBJECTIVE], record[BOUND] = value, bound
    for r in range(6):
        record[WRENCH + r] = wrench[r]
    multipliers = pull_back(options, (n0, n1, n2, n3, n4, n5))
    for r in range(6):
        record[MULTIPLIERS + r] = multipliers[r]
    for i in range(count):
        for a in range(3):
            record[FORCE + 3 * (count + i) + a] = first[3 * i + a] / work[i // 4, 4 * (DIVISOR + a) + i % 4]
    _finish(work, unit, iterations > 0 or kind == TANGENT, record)


@compiled_lanes
def _carry_over(work, sums, lower, factor, unit, wrench, weights, basis, first, lanes):
    """First = the optimum in X carried to G and w as they are now, then the least Phi on the way to it from the 12-basis.

    dx = -H^-1 G^T (G H^-1 G^T)^-1 (G x + w) follows the optimum to first order.
    """
    safe = np.empty(first.size)
    combine(basis, wrench, False, safe)
    newton_system(work, sums, lanes)
    for r in range(21):
        lower[r] = (sums[4 * r] + sums[4 * r + 1]) + (sums[4 * r + 2] + sums[4 * r + 3])
    if not factor6(lower, factor) > 0.0:
        first[:] = safe
        return
    left = np.empty(6)
    for r in range(6):
        p = 108 + 4 * r
        left[r] = (sums[p] + sums[p + 1]) + (sums[p + 2] + sums[p + 3]) + unit[r]
    for b in range(work.shape[0]):
        for j in range(12):
            work[b, 4 * STEP + j] = 0.0
    correct(work, sums, solve6(factor, left[0], left[1], left[2], left[3], left[4], left[5]), lanes)
    for i in range(first.size // 3):
        for a in range(3):
            first[3 * i + a] += work[i // 4, 4 * (STEP + a) + i % 4]
    # what that leaves of balance, by the least change
    left[:] = unit
    for i in range(first.size // 3):
        for a in range(3):
            for r in range(6):
                left[r] += work[i // 4, 4 * (G + 6 * a + r) + i % 4] * first[3 * i + a]
    for i in range(first.size // 3):
        for a in range(3):
            for r in range(6):
                first[3 * i + a] -= work[i // 4, 4 * (PINV + 6 * a + r) + i % 4] * left[r]
    if not phi(first, weights) < phi(safe, weights):
        best_on_segment(safe, first.copy(), weights, first)


@compiled_lanes
def _finish(work, unit, moved, record):
    """Takes what rounding left of G x + w off a moved x by G^+; writes force, residual and margin."""
    count = (record.size - FORCE) // 7
    left = np.empty(12)
    left[:6] = unit
    for i in range(count):
        row = work[i // 4]
        for a in range(3):
            p, x = 4 * (G + 6 * a) + i % 4, row[4 * (X + a) + i % 4]
            for r in range(6):
                left[r] += row[p + 4 * r] * x
    if not moved:
        left[:6] = 0.0
    left[6:] = unit
    margin = np.inf
    for i in range(count):
        row, n = work[i // 4], i % 4
        for a in range(3):
            p = 4 * (PINV + 6 * a) + n
            x = row[4 * (X + a) + n]
            for r in range(6):
                x -= row[p + 4 * r] * left[r]
            row[4 * (X + a) + n] = x
            record[FORCE + 3 * i + a] = x / row[4 * (DIVISOR + a) + n]
            for r in range(6):
                left[6 + r] += row[4 * (G + 6 * a + r) + n] * x
        o, t = row[4 * (X + 1) + n], row[4 * (X + 2) + n]
        margin = min(margin, row[4 * X + n] - math.sqrt(o * o + t * t))
    record[MARGIN] = margin
    record[RESIDUAL] = np.abs(left[6:]).max()

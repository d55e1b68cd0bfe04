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
    LAM,
    LANE_COUNT,
    MASK,
    OMEGA,
    PINV,
    STEPS,
    G,
    load,
    pull_back,
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
X, STEP, GRADIENT, B = CONSTANTS, CONSTANTS + 3, CONSTANTS + 6, CONSTANTS + 9
"""Iterate, Newton step, gradient of Phi, and the six entries of the inverse Hessian block."""
A, C = CONSTANTS + 15, CONSTANTS + 16
"""Lane results that are reduced afterwards."""
WIDTH = 4 * (CONSTANTS + 17)


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
    value = _phi(work, 0.0, lanes)
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
        _direction(work, sums, n0, n1, n2, n3, n4, n5, lanes)
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
            _correct(work, sums, solve6(factor, left[0], left[1], left[2], left[3], left[4], left[5]), lanes)
        _rebalance(work, left, lanes)
        decrement, reach = _reach(work, lanes)
        # Phi - min Phi is half the squared decrement to third order: the bound costs half an iteration, so it waits
        if not known and (decrement < 4.0 * tolerance * value or iterations >= limit):
            bound = max(bound, phi_bound(work, unit, n0, n1, n2, n3, n4, n5, lanes))
        if bound > 0.0 and value - bound <= tolerance * bound:
            break
        if iterations >= limit:
            code = LIMIT
            break
        alpha = min(1.0, 0.95 / reach) if reach > 0.0 else 1.0
        accepted, trial = False, value
        for _ in range(60):
            trials += 1
            trial = _phi(work, alpha, lanes)
            if trial < value - 1e-4 * alpha * decrement or (trial <= value and decrement < 1e-9 * value):
                accepted = alpha > SHORTEST
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
    _finish(work, unit, iterations > 0, record)


@compiled_lanes
def spread(x, work):
    """Flat cone coordinates (3N,) into the lanes."""
    for i in range(x.size // 3):
        for a in range(3):
            work[i // 4, 4 * (X + a) + i % 4] = x[3 * i + a]


@compiled_lanes
def _phi(work, alpha, lanes):
    """Phi at x + alpha step; +inf unless strictly inside every cone."""
    total, least = 0.0, np.inf
    for b in range(work.shape[0]):
        row = work[b]
        for n in range(lanes):
            u = row[4 * X + n] + alpha * row[4 * STEP + n]
            o = row[4 * (X + 1) + n] + alpha * row[4 * (STEP + 1) + n]
            t = row[4 * (X + 2) + n] + alpha * row[4 * (STEP + 2) + n]
            d = u * u - o * o - t * t
            row[4 * A + n] = min(u, d)
            row[4 * C + n] = row[4 * MASK + n] * (
                3.0 * row[4 * OMEGA + n] * u + row[4 * LAM + n] * (1.0 / u + 2.0 * u / d)
            )
        for n in range(lanes):
            least = min(least, row[4 * A + n])
            total += row[4 * C + n]
    return total if least > 0.0 and total == total else np.inf


@compiled_lanes
def newton_system(work, sums, lanes):
    """GRADIENT and B of every contact; sums (33 x 4): G B G^T packed, G B grad, G x."""
    for r in range(132):
        sums[r] = 0.0
    for b in range(work.shape[0]):
        row = work[b]
        for n in range(lanes):
            u, o, t = row[4 * X + n], row[4 * (X + 1) + n], row[4 * (X + 2) + n]
            lam = row[4 * LAM + n]
            u2, s2 = u * u, o * o + t * t
            d = u2 - s2
            i = 1.0 / d
            i2 = i * i
            iu = 1.0 / u
            row[4 * GRADIENT + n] = 3.0 * row[4 * OMEGA + n] - lam * (iu * iu + 2.0 * i2 * (u2 + s2))
            row[4 * (GRADIENT + 1) + n] = 4.0 * lam * i2 * u * o
            row[4 * (GRADIENT + 2) + n] = 4.0 * lam * i2 * u * t
            # the inverse Hessian of `kernels.inverse_hessian`
            scale = 1.0 / (6.0 * lam * (u2 + s2))
            along = scale * u2 * (3.0 * u2 + s2)
            across = d * d * iu / (4.0 * lam)
            bend = scale * (3.0 * u2 * (u2 + s2) - 2.0 * s2 * s2) * iu
            row[4 * B + n] = scale * u2 * u * (u2 + 3.0 * s2)
            row[4 * (B + 1) + n], row[4 * (B + 2) + n] = along * o, along * t
            row[4 * (B + 3) + n] = across + bend * o * o
            row[4 * (B + 4) + n] = bend * o * t
            row[4 * (B + 5) + n] = across + bend * t * t
        for n in range(lanes):
            b0, b1, b2 = row[4 * B + n], row[4 * (B + 1) + n], row[4 * (B + 2) + n]
            b3, b4, b5 = row[4 * (B + 3) + n], row[4 * (B + 4) + n], row[4 * (B + 5) + n]
            g0, g1, g2 = row[4 * GRADIENT + n], row[4 * (GRADIENT + 1) + n], row[4 * (GRADIENT + 2) + n]
            q0, q1, q2 = b0 * g0 + b1 * g1 + b2 * g2, b1 * g0 + b3 * g1 + b4 * g2, b2 * g0 + b4 * g1 + b5 * g2
            u, o, t = row[4 * X + n], row[4 * (X + 1) + n], row[4 * (X + 2) + n]
            p = 4 * G + n
            for r in range(6):
                c0, c1, c2 = row[p + 4 * r], row[p + 4 * r + 24], row[p + 4 * r + 48]
                sums[84 + 4 * r + n] += c0 * q0 + c1 * q1 + c2 * q2
                sums[108 + 4 * r + n] += c0 * u + c1 * o + c2 * t
                h0, h1, h2 = b0 * c0 + b1 * c1 + b2 * c2, b1 * c0 + b3 * c1 + b4 * c2, b2 * c0 + b4 * c1 + b5 * c2
                for s in range(r + 1):
                    sums[2 * r * (r + 1) + 4 * s + n] += (
                        h0 * row[p + 4 * s] + h1 * row[p + 4 * s + 24] + h2 * row[p + 4 * s + 48]
                    )


@compiled_lanes
def _direction(work, sums, n0, n1, n2, n3, n4, n5, lanes):
    """STEP = B (G^T nu - grad); sums (6 x 4) = G STEP."""
    for r in range(24):
        sums[r] = 0.0
    for b in range(work.shape[0]):
        row = work[b]
        for n in range(lanes):
            p = 4 * G + n
            y0 = (
                row[p] * n0 + row[p + 4] * n1 + row[p + 8] * n2 + row[p + 12] * n3 + row[p + 16] * n4 + row[p + 20] * n5
            )
            p += 24
            y1 = (
                row[p] * n0 + row[p + 4] * n1 + row[p + 8] * n2 + row[p + 12] * n3 + row[p + 16] * n4 + row[p + 20] * n5
            )
            p += 24
            y2 = (
                row[p] * n0 + row[p + 4] * n1 + row[p + 8] * n2 + row[p + 12] * n3 + row[p + 16] * n4 + row[p + 20] * n5
            )
            y0, y1, y2 = y0 - row[4 * GRADIENT + n], y1 - row[4 * (GRADIENT + 1) + n], y2 - row[4 * (GRADIENT + 2) + n]
            b1, b2, b4 = row[4 * (B + 1) + n], row[4 * (B + 2) + n], row[4 * (B + 4) + n]
            e0 = row[4 * B + n] * y0 + b1 * y1 + b2 * y2
            e1 = b1 * y0 + row[4 * (B + 3) + n] * y1 + b4 * y2
            e2 = b2 * y0 + b4 * y1 + row[4 * (B + 5) + n] * y2
            row[4 * STEP + n], row[4 * (STEP + 1) + n], row[4 * (STEP + 2) + n] = e0, e1, e2
            for r in range(6):
                p = 4 * (G + r) + n
                sums[4 * r + n] += row[p] * e0 + row[p + 24] * e1 + row[p + 48] * e2


@compiled_lanes
def _correct(work, sums, multipliers, lanes):
    """STEP -= B G^T multipliers; sums (6 x 4) = G STEP."""
    n0, n1, n2, n3, n4, n5 = multipliers
    for r in range(24):
        sums[r] = 0.0
    for b in range(work.shape[0]):
        row = work[b]
        for n in range(lanes):
            p = 4 * G + n
            y0 = (
                row[p] * n0 + row[p + 4] * n1 + row[p + 8] * n2 + row[p + 12] * n3 + row[p + 16] * n4 + row[p + 20] * n5
            )
            p += 24
            y1 = (
                row[p] * n0 + row[p + 4] * n1 + row[p + 8] * n2 + row[p + 12] * n3 + row[p + 16] * n4 + row[p + 20] * n5
            )
            p += 24
            y2 = (
                row[p] * n0 + row[p + 4] * n1 + row[p + 8] * n2 + row[p + 12] * n3 + row[p + 16] * n4 + row[p + 20] * n5
            )
            b1, b2, b4 = row[4 * (B + 1) + n], row[4 * (B + 2) + n], row[4 * (B + 4) + n]
            row[4 * STEP + n] -= row[4 * B + n] * y0 + b1 * y1 + b2 * y2
            row[4 * (STEP + 1) + n] -= b1 * y0 + row[4 * (B + 3) + n] * y1 + b4 * y2
            row[4 * (STEP + 2) + n] -= b2 * y0 + b4 * y1 + row[4 * (B + 5) + n] * y2
            e0, e1, e2 = row[4 * STEP + n], row[4 * (STEP + 1) + n], row[4 * (STEP + 2) + n]
            for r in range(6):
                p = 4 * (G + r) + n
                sums[4 * r + n] += row[p] * e0 + row[p + 24] * e1 + row[p + 48] * e2


@compiled_lanes
def _rebalance(work, left, lanes):
    """STEP -= G^+ left, the least change in force."""
    n0, n1, n2, n3, n4, n5 = left[0], left[1], left[2], left[3], left[4], left[5]
    for b in range(work.shape[0]):
        row = work[b]
        for n in range(lanes):
            for a in range(3):
                p = 4 * (PINV + 6 * a) + n
                row[4 * (STEP + a) + n] -= (
                    row[p] * n0
                    + row[p + 4] * n1
                    + row[p + 8] * n2
                    + row[p + 12] * n3
                    + row[p + 16] * n4
                    + row[p + 20] * n5
                )


@compiled_lanes
def _reach(work, lanes):
    """(Squared decrement -grad . step, 1 / largest step inside the cones)."""
    decrement, reach = 0.0, 0.0
    for b in range(work.shape[0]):
        row = work[b]
        for n in range(lanes):
            e0, e1, e2 = row[4 * STEP + n], row[4 * (STEP + 1) + n], row[4 * (STEP + 2) + n]
            row[4 * C + n] = -row[4 * MASK + n] * (
                e0 * row[4 * GRADIENT + n] + e1 * row[4 * (GRADIENT + 1) + n] + e2 * row[4 * (GRADIENT + 2) + n]
            )
            u, o, t = row[4 * X + n], row[4 * (X + 1) + n], row[4 * (X + 2) + n]
            i = 1.0 / (u * u - o * o - t * t)
            j = math.sqrt(i)
            rho = (u * e0 - o * e1 - t * e2) * i
            k = (e0 * j + rho) / (1.0 + u * j)
            r1, r2 = e1 - k * o, e2 - k * t
            row[4 * A + n] = j * math.sqrt(r1 * r1 + r2 * r2) - rho
        for n in range(lanes):
            reach = max(reach, row[4 * A + n])
            decrement += row[4 * C + n]
    return decrement, reach


@compiled_lanes
def phi_bound(work, unit, n0, n1, n2, n3, n4, n5, lanes):
    """Dual value at nu: see `kernels.lower_bound`."""
    total, least = 0.0, np.inf
    for b in range(work.shape[0]):
        row = work[b]
        for n in range(lanes):
            p = 4 * G + n
            y0 = (
                row[p] * n0 + row[p + 4] * n1 + row[p + 8] * n2 + row[p + 12] * n3 + row[p + 16] * n4 + row[p + 20] * n5
            )
            p += 24
            y1 = (
                row[p] * n0 + row[p + 4] * n1 + row[p + 8] * n2 + row[p + 12] * n3 + row[p + 16] * n4 + row[p + 20] * n5
            )
            p += 24
            y2 = (
                row[p] * n0 + row[p + 4] * n1 + row[p + 8] * n2 + row[p + 12] * n3 + row[p + 16] * n4 + row[p + 20] * n5
            )
            a = 3.0 * row[4 * OMEGA + n] - y0
            t = math.sqrt(y1 * y1 + y2 * y2)
            row[4 * A + n] = a - t
            k = (a - t) / (a + t)
            # two contractions (factor below 0.16), then two Newton steps: the value's error is the square of r's
            r = math.sqrt(k)
            r = math.sqrt(k / (1.0 + 2.0 * (1.0 - k) / ((1.0 + r) * (1.0 + r))))
            r = math.sqrt(k / (1.0 + 2.0 * (1.0 - k) / ((1.0 + r) * (1.0 + r))))
            q = 1.0 + r
            r -= (r * r * (q * q + 2.0) - k * (q * q + 2.0 * r * r)) / (
                2.0 * r * (q * q + 2.0) + 2.0 * r * r * q - k * (2.0 * q + 4.0 * r)
            )
            q = 1.0 + r
            r -= (r * r * (q * q + 2.0) - k * (q * q + 2.0 * r * r)) / (
                2.0 * r * (q * q + 2.0) + 2.0 * r * r * q - k * (2.0 * q + 4.0 * r)
            )
            c = 0.5 * (a - t + (a + t) * r)
            row[4 * C + n] = (
                row[4 * MASK + n] * 2.0 * math.sqrt(row[4 * LAM + n] * c * (1.0 + 1.0 / r + 2.0 / (1.0 + r)))
            )
        for n in range(lanes):
            least = min(least, row[4 * A + n])
            total += row[4 * C + n]
    if not least > 0.0:
        return -np.inf
    total -= n0 * unit[0] + n1 * unit[1] + n2 * unit[2] + n3 * unit[3] + n4 * unit[4] + n5 * unit[5]
    return total if total == total else -np.inf


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
    _correct(work, sums, solve6(factor, left[0], left[1], left[2], left[3], left[4], left[5]), lanes)
    for i in range(first.size // 3):
        for a in range(3):
            first[3 * i + a] += work[i // 4, 4 * (STEP + a) + i % 4]
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

"""The exact conic problem, compiled: least sum of normal forces, balance, friction cones; four contacts at a time.

    min sum_i c_i u_i  s.t.  G x = -w,  x_i = (u, o, t)_i in the cone u >= sqrt(o^2 + t^2),  c_i = 1 / mu_i
    max -w . y         s.t.  s_i = c_i e_u - G_i^T y in the same cone

A primal-dual interior-point method with Nesterov-Todd scaling and Mehrotra's corrector (Nesterov, Todd 1997; Mehrotra
1992; as in Vandenberghe 2010, "The CVXOPT linear and quadratic cone program solvers"). Both sides start strictly feasible
and stay so: every iterate is a valid grasp, and y scaled onto the boundary is a certified bound.

In these coordinates the scaling of contact i is eta (2 v v^T - J), v . J v = 1, J = diag(1, -1, -1), so the 6 x 6 matrix
of an iteration is the sum of eta (2 (G v)(G v)^T - G J G^T) with G J G^T constant. The plain twin is `conic.nt_step`.
"""

from __future__ import annotations

import math

import numpy as np

from grasp_env._check import LARGEST, NOTHING
from grasp_env._compile import compiled_lanes
from grasp_env.force.cholesky6 import factor6, solve6
from grasp_env.force.conic_lanes import (
    ETA,
    START,
    WIDTH,
    A,
    B,
    D,
    L,
    Q,
    S,
    X,
    accumulate,
    centre,
    direct,
    predict,
    scale,
)
from grasp_env.force.descent_kernels import CONVERGED, LIMIT, STALLED
from grasp_env.force.lanes import (
    CONSTANTS,
    COST,
    DIVISOR,
    GAP,
    LANE_COUNT,
    MASK,
    PINV,
    REST,
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

STEP = 0.995
"""The largest part of the way to the boundary."""


@compiled_lanes
def conic(constants, wrench, options, record):
    """Solves one wrench and writes `record` (see `record.py`).

    Args:
        constants: (blocks, 4 * CONSTANTS) from `lanes.pack`, whose REST is an internal force strictly inside.
        wrench: (6,) external wrench [N, N m].
        options: (8,) from `lanes.options`.
        record: (20 + 7N,) overwritten.
    """
    tolerance, limit, lanes = options[GAP], options[STEPS], int(options[LANE_COUNT])
    blocks = constants.shape[0]
    count = (record.size - FORCE) // 7
    for r in range(6):
        if not abs(wrench[r]) <= LARGEST:
            record[CODE] = REFUSED
            return
    work = np.empty((blocks, WIDTH))
    scratch = np.empty(132)  # one allocation
    sums, lower, factor, unit = scratch[:84], scratch[84:105], scratch[105:126], scratch[126:]
    load(wrench, options, unit)
    size = 0.0
    for r in range(6):
        size = max(size, abs(unit[r]))
    record[:] = 0.0
    for r in range(6):
        record[WRENCH + r] = wrench[r]
    if size < NOTHING:
        # no force is needed, and none is less
        return
    w0, w1, w2, w3, w4, w5 = (
        unit[0] / size,
        unit[1] / size,
        unit[2] / size,
        unit[3] / size,
        unit[4] / size,
        unit[5] / size,
    )

    # start: x = -G^+ w + k rest with k beyond what the triangle inequality asks, s = c (y = 0)
    squeeze = 1e-6
    for b in range(blocks):
        row = work[b]
        for j in range(4 * CONSTANTS):
            row[j] = constants[b, j]
        for n in range(lanes):
            for a in range(3):
                p = 4 * (PINV + 6 * a) + n
                row[4 * (X + a) + n] = -(
                    row[p] * w0
                    + row[p + 4] * w1
                    + row[p + 8] * w2
                    + row[p + 12] * w3
                    + row[p + 16] * w4
                    + row[p + 20] * w5
                )
            o, t = row[4 * (X + 1) + n], row[4 * (X + 2) + n]
            ro, rt = row[4 * (REST + 1) + n], row[4 * (REST + 2) + n]
            row[4 * A + n] = (math.sqrt(o * o + t * t) - row[4 * X + n]) / (
                row[4 * REST + n] - math.sqrt(ro * ro + rt * rt)
            )
        for n in range(lanes):
            squeeze = max(squeeze, row[4 * A + n])
    squeeze *= 1.3
    gap, price = 0.0, 0.0
    for b in range(blocks):
        row = work[b]
        for n in range(lanes):
            for a in range(3):
                row[4 * (X + a) + n] += squeeze * row[4 * (REST + a) + n]
                row[4 * (START + a) + n] = row[4 * (X + a) + n]
            row[4 * S + n] = row[4 * COST + n]
            row[4 * (S + 1) + n] = 0.0
            row[4 * (S + 2) + n] = 0.0
            price += row[4 * MASK + n] * row[4 * COST + n] * row[4 * X + n]
    gap = price
    y0, y1, y2, y3, y4, y5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    iterations = 0
    code = CONVERGED
    goal, certified = tolerance, np.inf
    while True:
        if gap <= goal * price:
            # the iterations' own gap is not proof: the certificate's is
            certified = _certify(work, unit, size, options, y0, y1, y2, y3, y4, y5, record)
            if certified <= tolerance:
                break
            certified = np.inf
            goal *= 0.1
            if not gap > 0.0 or goal < 1e-3 * tolerance:
                code = STALLED
                break
            continue
        if iterations >= limit:
            code = LIMIT
            break
        for r in range(84):
            sums[r] = 0.0
        for b in range(blocks):
            row = work[b]
            scale(row, lanes)
            accumulate(row, sums, lanes)
        for r in range(21):
            lower[r] = (sums[4 * r] + sums[4 * r + 1]) + (sums[4 * r + 2] + sums[4 * r + 3])
        if not factor6(lower, factor) > 0.0:
            code = STALLED
            break
        # predictor: dx + M ds = -x, so that S dy = G x = -w
        d0, d1, d2, d3, d4, d5 = solve6(factor, -w0, -w1, -w2, -w3, -w4, -w5)
        primal, dual, cross, square = 1.0, 1.0, 0.0, 0.0
        for b in range(blocks):
            row = work[b]
            predict(row, d0, d1, d2, d3, d4, d5, lanes)
            for n in range(lanes):
                dual = max(dual, row[4 * A + n] - row[4 * B + n])
                primal = max(primal, 1.0 + row[4 * A + n] + row[4 * B + n])
                part = row[4 * MASK + n] * row[4 * ETA + n]
                e0, e1, e2 = row[4 * D + n], row[4 * (D + 1) + n], row[4 * (D + 2) + n]
                cross += part * (row[4 * L + n] * e0 + row[4 * (L + 1) + n] * e1 + row[4 * (L + 2) + n] * e2)
                square += part * (e0 * e0 + e1 * e1 + e2 * e2)
        primal, dual = 1.0 / primal, 1.0 / dual
        after = gap + dual * cross - primal * (gap + cross) - primal * dual * (cross + square)
        centring = min(1.0, (max(after, 0.0) / gap) ** 3)
        target = centring * gap / (2.0 * count)
        reach = 0.9 + (STEP - 0.9) * min(primal, dual)
        for r in range(24):
            sums[r] = 0.0
        for b in range(blocks):
            centre(work[b], sums, target, lanes)
        d0, d1, d2, d3, d4, d5 = solve6(
            factor,
            (sums[0] + sums[1]) + (sums[2] + sums[3]),
            (sums[4] + sums[5]) + (sums[6] + sums[7]),
            (sums[8] + sums[9]) + (sums[10] + sums[11]),
            (sums[12] + sums[13]) + (sums[14] + sums[15]),
            (sums[16] + sums[17]) + (sums[18] + sums[19]),
            (sums[20] + sums[21]) + (sums[22] + sums[23]),
        )
        primal, dual = reach, reach
        for b in range(blocks):
            row = work[b]
            direct(row, d0, d1, d2, d3, d4, d5, lanes)
            for n in range(lanes):
                primal = max(primal, row[4 * A + n])
                dual = max(dual, row[4 * B + n])
        primal, dual = reach / primal, reach / dual
        if not primal + dual > 1e-6:
            code = STALLED
            break
        y0, y1, y2 = y0 + dual * d0, y1 + dual * d1, y2 + dual * d2
        y3, y4, y5 = y3 + dual * d3, y4 + dual * d4, y5 + dual * d5
        gap, price = 0.0, 0.0
        for b in range(blocks):
            row = work[b]
            for n in range(lanes):
                x0 = row[4 * X + n] + primal * row[4 * Q + n]
                x1 = row[4 * (X + 1) + n] + primal * row[4 * (Q + 1) + n]
                x2 = row[4 * (X + 2) + n] + primal * row[4 * (Q + 2) + n]
                s0 = row[4 * S + n] + dual * row[4 * D + n]
                s1 = row[4 * (S + 1) + n] + dual * row[4 * (D + 1) + n]
                s2 = row[4 * (S + 2) + n] + dual * row[4 * (D + 2) + n]
                row[4 * X + n], row[4 * (X + 1) + n], row[4 * (X + 2) + n] = x0, x1, x2
                row[4 * S + n], row[4 * (S + 1) + n], row[4 * (S + 2) + n] = s0, s1, s2
                gap += row[4 * MASK + n] * (x0 * s0 + x1 * s1 + x2 * s2)
                price += row[4 * MASK + n] * row[4 * COST + n] * x0
        iterations += 1
    if not certified <= tolerance:
        certified = _certify(work, unit, size, options, y0, y1, y2, y3, y4, y5, record)
        code = CONVERGED if certified <= tolerance else code
    record[CODE], record[ITERATIONS], record[TRIALS] = code, iterations, iterations


@compiled_lanes
def _certify(work, unit, size, options, y0, y1, y2, y3, y4, y5, record):
    """Balances the last digits, scales y onto the boundary of its set, and writes force and certificates.

    For any y the largest theta with c - theta G^T y in every cone is min c / (g_u + |g_t|), g = G^T y over the contacts where
    that is positive: -theta w . y is a bound that needs no trust in the iterations.
    """
    count = (record.size - FORCE) // 7
    r0, r1, r2, r3, r4, r5 = (
        unit[0] / size,
        unit[1] / size,
        unit[2] / size,
        unit[3] / size,
        unit[4] / size,
        unit[5] / size,
    )
    value = -(r0 * y0 + r1 * y1 + r2 * y2 + r3 * y3 + r4 * y4 + r5 * y5)
    largest = 0.0
    for i in range(count):
        row = work[i // 4]
        p = 4 * G + i % 4
        x0, x1, x2 = row[4 * X + i % 4], row[4 * (X + 1) + i % 4], row[4 * (X + 2) + i % 4]
        r0 += row[p] * x0 + row[p + 24] * x1 + row[p + 48] * x2
        r1 += row[p + 4] * x0 + row[p + 28] * x1 + row[p + 52] * x2
        r2 += row[p + 8] * x0 + row[p + 32] * x1 + row[p + 56] * x2
        r3 += row[p + 12] * x0 + row[p + 36] * x1 + row[p + 60] * x2
        r4 += row[p + 16] * x0 + row[p + 40] * x1 + row[p + 64] * x2
        r5 += row[p + 20] * x0 + row[p + 44] * x1 + row[p + 68] * x2
        g0 = row[p] * y0 + row[p + 4] * y1 + row[p + 8] * y2 + row[p + 12] * y3 + row[p + 16] * y4 + row[p + 20] * y5
        p += 24
        g1 = row[p] * y0 + row[p + 4] * y1 + row[p + 8] * y2 + row[p + 12] * y3 + row[p + 16] * y4 + row[p + 20] * y5
        p += 24
        g2 = row[p] * y0 + row[p + 4] * y1 + row[p + 8] * y2 + row[p + 12] * y3 + row[p + 16] * y4 + row[p + 20] * y5
        largest = max(largest, (g0 + math.sqrt(g1 * g1 + g2 * g2)) / row[4 * COST + i % 4])
    theta = 1.0 / largest if largest > 0.0 else 1.0
    multipliers = pull_back(options, (theta * y0, theta * y1, theta * y2, theta * y3, theta * y4, theta * y5))
    for r in range(6):
        record[MULTIPLIERS + r] = multipliers[r]
    record[BOUND] = size * max(theta * value, 0.0)
    squeeze = 0.0
    for i in range(count):
        row, n = work[i // 4], i % 4
        for a in range(3):
            p = 4 * (PINV + 6 * a) + n
            row[4 * (X + a) + n] -= (
                row[p] * r0 + row[p + 4] * r1 + row[p + 8] * r2 + row[p + 12] * r3 + row[p + 16] * r4 + row[p + 20] * r5
            )
        outside = math.sqrt(row[4 * (X + 1) + n] ** 2 + row[4 * (X + 2) + n] ** 2) - row[4 * X + n]
        outside += 1e-15 * row[4 * X + n]  # what the rounding of the next lines may cost
        if outside > 0.0:
            # the last digits of balance took it out of its cone: an internal force takes it back
            depth = row[4 * REST + n] - math.sqrt(row[4 * (REST + 1) + n] ** 2 + row[4 * (REST + 2) + n] ** 2)
            squeeze = max(squeeze, 1.1 * outside / depth)
    price, margin = 0.0, np.inf
    b0, b1, b2, b3, b4, b5 = unit[0], unit[1], unit[2], unit[3], unit[4], unit[5]
    for i in range(count):
        row, n = work[i // 4], i % 4
        x0 = size * (row[4 * X + n] + squeeze * row[4 * REST + n])
        x1 = size * (row[4 * (X + 1) + n] + squeeze * row[4 * (REST + 1) + n])
        x2 = size * (row[4 * (X + 2) + n] + squeeze * row[4 * (REST + 2) + n])
        margin = min(margin, x0 - math.sqrt(x1 * x1 + x2 * x2))
        price += row[4 * COST + n] * x0
        p = 4 * G + n
        b0 += row[p] * x0 + row[p + 24] * x1 + row[p + 48] * x2
        b1 += row[p + 4] * x0 + row[p + 28] * x1 + row[p + 52] * x2
        b2 += row[p + 8] * x0 + row[p + 32] * x1 + row[p + 56] * x2
        b3 += row[p + 12] * x0 + row[p + 36] * x1 + row[p + 60] * x2
        b4 += row[p + 16] * x0 + row[p + 40] * x1 + row[p + 64] * x2
        b5 += row[p + 20] * x0 + row[p + 44] * x1 + row[p + 68] * x2
        record[FORCE + 3 * i] = x0 / row[4 * DIVISOR + n]
        record[FORCE + 3 * i + 1] = x1 / row[4 * (DIVISOR + 1) + n]
        record[FORCE + 3 * i + 2] = x2 / row[4 * (DIVISOR + 2) + n]
        for a in range(3):
            record[FORCE + 3 * (count + i) + a] = size * row[4 * (START + a) + n] / row[4 * (DIVISOR + a) + n]
    record[OBJECTIVE], record[MARGIN] = price, margin
    record[RESIDUAL] = max(max(abs(b0), abs(b1), abs(b2)), max(abs(b3), abs(b4), abs(b5)))
    return (price - record[BOUND]) / record[BOUND] if record[BOUND] > 0.0 else np.inf

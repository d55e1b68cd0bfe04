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

from grasp_env._check import LARGEST
from grasp_env._compile import compiled_lanes
from grasp_env.force.cholesky6 import factor6, solve6
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
    K,
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

# a block's variables, behind its constants
X, S = CONSTANTS, CONSTANTS + 3
"""Primal x and dual slack s."""
V, ETA, SHRINK, INVERSE = CONSTANTS + 6, CONSTANTS + 9, CONSTANTS + 10, CONSTANTS + 11
"""The scaling: v (3), eta, 1 / (1 + v_0), 1 / sqrt(s . J s)."""
L, D, Q = CONSTANTS + 12, CONSTANTS + 15, CONSTANTS + 18
"""Scaled point, scaled dual direction (later ds), and q with dx + M ds = q (later dx)."""
L0, L1 = CONSTANTS + 21, CONSTANTS + 22
"""1 / l_0 and 1 / (1 + l_0 / sqrt(l . J l))."""
A, B = CONSTANTS + 23, CONSTANTS + 24
"""Lane results that are reduced afterwards."""
FIELDS = CONSTANTS + 25
START = CONSTANTS + 25
"""First iterate x, kept for the record."""
WIDTH = 4 * (FIELDS + 3)

NOTHING = 1e-280
"""[N] below which a wrench counts as none: its square has no digits left."""
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
            continue
        if iterations >= limit:
            code = LIMIT
            break
        for r in range(84):
            sums[r] = 0.0
        for b in range(blocks):
            row = work[b]
            _scale(row, lanes)
            _accumulate(row, sums, lanes)
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
            _predict(row, d0, d1, d2, d3, d4, d5, lanes)
            for n in range(lanes):
                dual = max(dual, row[4 * A + n] - row[4 * B + n])
                primal = max(primal, 1.0 + row[4 * A + n] + row[4 * B + n])
                scale = row[4 * MASK + n] * row[4 * ETA + n]
                e0, e1, e2 = row[4 * D + n], row[4 * (D + 1) + n], row[4 * (D + 2) + n]
                cross += scale * (row[4 * L + n] * e0 + row[4 * (L + 1) + n] * e1 + row[4 * (L + 2) + n] * e2)
                square += scale * (e0 * e0 + e1 * e1 + e2 * e2)
        primal, dual = 1.0 / primal, 1.0 / dual
        after = gap + dual * cross - primal * (gap + cross) - primal * dual * (cross + square)
        centring = min(1.0, (max(after, 0.0) / gap) ** 3)
        target = centring * gap / (2.0 * count)
        reach = 0.9 + (STEP - 0.9) * min(primal, dual)
        for r in range(24):
            sums[r] = 0.0
        for b in range(blocks):
            _correct(work[b], sums, target, lanes)
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
            _direct(row, d0, d1, d2, d3, d4, d5, lanes)
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
def _scale(row, lanes):
    """V, ETA, SHRINK, INVERSE of the Nesterov-Todd scaling that takes s to x."""
    for n in range(lanes):
        x0, x1, x2 = row[4 * X + n], row[4 * (X + 1) + n], row[4 * (X + 2) + n]
        s0, s1, s2 = row[4 * S + n], row[4 * (S + 1) + n], row[4 * (S + 2) + n]
        # (u - r)(u + r), r the tangential length: no cancellation close to the cone's surface
        inverse = 1.0 / (s0 * s0 - s1 * s1 - s2 * s2)
        eta = math.sqrt((x0 * x0 - x1 * x1 - x2 * x2) * inverse)
        z0, z1, z2 = x0 + eta * s0, x1 - eta * s1, x2 - eta * s2
        h = 1.0 / math.sqrt(z0 * z0 - z1 * z1 - z2 * z2)
        v0 = z0 * h
        row[4 * V + n], row[4 * (V + 1) + n], row[4 * (V + 2) + n] = v0, z1 * h, z2 * h
        row[4 * ETA + n] = eta
        row[4 * SHRINK + n] = 1.0 / (1.0 + v0)
        row[4 * INVERSE + n] = math.sqrt(inverse)


@compiled_lanes
def _accumulate(row, sums, lanes):
    """Sums (21 x 4) += eta (2 (G v)(G v)^T - K), lane by lane."""
    for n in range(lanes):
        v0, v1, v2, eta = row[4 * V + n], row[4 * (V + 1) + n], row[4 * (V + 2) + n], row[4 * ETA + n]
        g0 = row[4 * G + n] * v0 + row[4 * (G + 6) + n] * v1 + row[4 * (G + 12) + n] * v2
        g1 = row[4 * (G + 1) + n] * v0 + row[4 * (G + 7) + n] * v1 + row[4 * (G + 13) + n] * v2
        g2 = row[4 * (G + 2) + n] * v0 + row[4 * (G + 8) + n] * v1 + row[4 * (G + 14) + n] * v2
        g3 = row[4 * (G + 3) + n] * v0 + row[4 * (G + 9) + n] * v1 + row[4 * (G + 15) + n] * v2
        g4 = row[4 * (G + 4) + n] * v0 + row[4 * (G + 10) + n] * v1 + row[4 * (G + 16) + n] * v2
        g5 = row[4 * (G + 5) + n] * v0 + row[4 * (G + 11) + n] * v1 + row[4 * (G + 17) + n] * v2
        e0, e1, e2 = 2.0 * eta * g0, 2.0 * eta * g1, 2.0 * eta * g2
        e3, e4, e5 = 2.0 * eta * g3, 2.0 * eta * g4, 2.0 * eta * g5
        sums[n] += e0 * g0 - eta * row[4 * K + n]
        sums[4 + n] += e1 * g0 - eta * row[4 * (K + 1) + n]
        sums[8 + n] += e1 * g1 - eta * row[4 * (K + 2) + n]
        sums[12 + n] += e2 * g0 - eta * row[4 * (K + 3) + n]
        sums[16 + n] += e2 * g1 - eta * row[4 * (K + 4) + n]
        sums[20 + n] += e2 * g2 - eta * row[4 * (K + 5) + n]
        sums[24 + n] += e3 * g0 - eta * row[4 * (K + 6) + n]
        sums[28 + n] += e3 * g1 - eta * row[4 * (K + 7) + n]
        sums[32 + n] += e3 * g2 - eta * row[4 * (K + 8) + n]
        sums[36 + n] += e3 * g3 - eta * row[4 * (K + 9) + n]
        sums[40 + n] += e4 * g0 - eta * row[4 * (K + 10) + n]
        sums[44 + n] += e4 * g1 - eta * row[4 * (K + 11) + n]
        sums[48 + n] += e4 * g2 - eta * row[4 * (K + 12) + n]
        sums[52 + n] += e4 * g3 - eta * row[4 * (K + 13) + n]
        sums[56 + n] += e4 * g4 - eta * row[4 * (K + 14) + n]
        sums[60 + n] += e5 * g0 - eta * row[4 * (K + 15) + n]
        sums[64 + n] += e5 * g1 - eta * row[4 * (K + 16) + n]
        sums[68 + n] += e5 * g2 - eta * row[4 * (K + 17) + n]
        sums[72 + n] += e5 * g3 - eta * row[4 * (K + 18) + n]
        sums[76 + n] += e5 * g4 - eta * row[4 * (K + 19) + n]
        sums[80 + n] += e5 * g5 - eta * row[4 * (K + 20) + n]


@compiled_lanes
def _predict(row, y0, y1, y2, y3, y4, y5, lanes):
    """L = scaled point, D = scaled ds = -G^T dy; A + B, A - B bound the steps. All without their factor sqrt(eta)."""
    for n in range(lanes):
        p = 4 * G + n
        d0 = -(row[p] * y0 + row[p + 4] * y1 + row[p + 8] * y2 + row[p + 12] * y3 + row[p + 16] * y4 + row[p + 20] * y5)
        p += 24
        d1 = -(row[p] * y0 + row[p + 4] * y1 + row[p + 8] * y2 + row[p + 12] * y3 + row[p + 16] * y4 + row[p + 20] * y5)
        p += 24
        d2 = -(row[p] * y0 + row[p + 4] * y1 + row[p + 8] * y2 + row[p + 12] * y3 + row[p + 16] * y4 + row[p + 20] * y5)
        v0, v1, v2, f = row[4 * V + n], row[4 * (V + 1) + n], row[4 * (V + 2) + n], row[4 * SHRINK + n]
        s0, s1, s2 = row[4 * S + n], row[4 * (S + 1) + n], row[4 * (S + 2) + n]
        z = v1 * s1 + v2 * s2
        k = s0 + z * f
        l0, l1, l2 = v0 * s0 + z, s1 + k * v1, s2 + k * v2
        z = v1 * d1 + v2 * d2
        k = d0 + z * f
        e0, e1, e2 = v0 * d0 + z, d1 + k * v1, d2 + k * v2
        j = row[4 * INVERSE + n]
        m = l0 * j + 1.0
        both = 1.0 / (m * l0)
        row[4 * L1 + n], row[4 * L0 + n] = both * l0, both * m
        rho = (l0 * e0 - l1 * e1 - l2 * e2) * j * j
        k = (e0 * j + rho) * both * l0
        r1, r2 = e1 - k * l1, e2 - k * l2
        row[4 * A + n], row[4 * B + n] = j * math.sqrt(r1 * r1 + r2 * r2), rho
        row[4 * L + n], row[4 * (L + 1) + n], row[4 * (L + 2) + n] = l0, l1, l2
        row[4 * D + n], row[4 * (D + 1) + n], row[4 * (D + 2) + n] = e0, e1, e2


@compiled_lanes
def _correct(row, sums, target, lanes):
    """D = scaled right side with centring and second order, Q = its unscaled image; sums (6 x 4) -= G Q."""
    for n in range(lanes):
        v0, v1, v2, eta = row[4 * V + n], row[4 * (V + 1) + n], row[4 * (V + 2) + n], row[4 * ETA + n]
        l0, l1, l2 = row[4 * L + n], row[4 * (L + 1) + n], row[4 * (L + 2) + n]
        e0, e1, e2 = row[4 * D + n], row[4 * (D + 1) + n], row[4 * (D + 2) + n]
        j = row[4 * INVERSE + n]
        f0, f1, f2 = l0 + e0, l1 + e1, l2 + e2
        r0 = target / eta + (f0 * e0 + f1 * e1 + f2 * e2)
        r1, r2 = f0 * e1 + e0 * f1, f0 * e2 + e0 * f2
        h0 = (l0 * r0 - l1 * r1 - l2 * r2) * j * j
        h1 = (r1 - h0 * l1) * row[4 * L0 + n] - l1
        h2 = (r2 - h0 * l2) * row[4 * L0 + n] - l2
        h0 -= l0
        z = v1 * h1 + v2 * h2
        k = h0 + z * row[4 * SHRINK + n]
        q0, q1, q2 = eta * (v0 * h0 + z), eta * (h1 + k * v1), eta * (h2 + k * v2)
        for r in range(6):
            p = 4 * (G + r) + n
            sums[4 * r + n] -= row[p] * q0 + row[p + 24] * q1 + row[p + 48] * q2
        row[4 * D + n], row[4 * (D + 1) + n], row[4 * (D + 2) + n] = h0, h1, h2
        row[4 * Q + n], row[4 * (Q + 1) + n], row[4 * (Q + 2) + n] = q0, q1, q2


@compiled_lanes
def _direct(row, y0, y1, y2, y3, y4, y5, lanes):
    """D = ds, Q = dx; A and B are 1 / (step to the boundary) of x and s."""
    for n in range(lanes):
        p = 4 * G + n
        d0 = -(row[p] * y0 + row[p + 4] * y1 + row[p + 8] * y2 + row[p + 12] * y3 + row[p + 16] * y4 + row[p + 20] * y5)
        p += 24
        d1 = -(row[p] * y0 + row[p + 4] * y1 + row[p + 8] * y2 + row[p + 12] * y3 + row[p + 16] * y4 + row[p + 20] * y5)
        p += 24
        d2 = -(row[p] * y0 + row[p + 4] * y1 + row[p + 8] * y2 + row[p + 12] * y3 + row[p + 16] * y4 + row[p + 20] * y5)
        v0, v1, v2, eta = row[4 * V + n], row[4 * (V + 1) + n], row[4 * (V + 2) + n], row[4 * ETA + n]
        z = v1 * d1 + v2 * d2
        k = d0 + z * row[4 * SHRINK + n]
        e0, e1, e2 = v0 * d0 + z, d1 + k * v1, d2 + k * v2
        l0, l1, l2 = row[4 * L + n], row[4 * (L + 1) + n], row[4 * (L + 2) + n]
        h0, h1, h2 = row[4 * D + n] - e0, row[4 * (D + 1) + n] - e1, row[4 * (D + 2) + n] - e2
        j, m = row[4 * INVERSE + n], row[4 * L1 + n]
        rho = (l0 * e0 - l1 * e1 - l2 * e2) * j * j
        k = (e0 * j + rho) * m
        r1, r2 = e1 - k * l1, e2 - k * l2
        row[4 * B + n] = j * math.sqrt(r1 * r1 + r2 * r2) - rho
        rho = (l0 * h0 - l1 * h1 - l2 * h2) * j * j
        k = (h0 * j + rho) * m
        r1, r2 = h1 - k * l1, h2 - k * l2
        row[4 * A + n] = j * math.sqrt(r1 * r1 + r2 * r2) - rho
        z = 2.0 * (v0 * d0 + v1 * d1 + v2 * d2)
        row[4 * Q + n] -= eta * (z * v0 - d0)
        row[4 * (Q + 1) + n] -= eta * (z * v1 + d1)
        row[4 * (Q + 2) + n] -= eta * (z * v2 + d2)
        row[4 * D + n], row[4 * (D + 1) + n], row[4 * (D + 2) + n] = d0, d1, d2


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

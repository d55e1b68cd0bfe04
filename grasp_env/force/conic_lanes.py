"""The steps of one iteration of `conic_kernels.conic`, four contacts at a time. Layout as in `lanes.py`."""

from __future__ import annotations

import math

from grasp_env._compile import compiled_lanes
from grasp_env.force.lanes import CONSTANTS, G, K

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


@compiled_lanes
def scale(row, lanes):
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
def accumulate(row, sums, lanes):
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
def predict(row, y0, y1, y2, y3, y4, y5, lanes):
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
def centre(row, sums, target, lanes):
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
def direct(row, y0, y1, y2, y3, y4, y5, lanes):
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

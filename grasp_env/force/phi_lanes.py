"""Phi four contacts at a time: what the flows certify themselves by. Layout as in `lanes.py`; variables behind the constants."""

from __future__ import annotations

import math

import numpy as np

from grasp_env._compile import compiled_lanes
from grasp_env.force.lanes import CONSTANTS, LAM, MASK, OMEGA, G

X, STEP, GRADIENT, B = CONSTANTS, CONSTANTS + 3, CONSTANTS + 6, CONSTANTS + 9
"""Iterate, Newton step, gradient of Phi, and the six entries of the inverse Hessian block."""
A, C = CONSTANTS + 15, CONSTANTS + 16
"""Lane results that are reduced afterwards."""
WIDTH = 4 * (CONSTANTS + 17)


@compiled_lanes
def spread(x, work):
    """Flat cone coordinates (3N,) into the lanes."""
    for i in range(x.size // 3):
        for a in range(3):
            work[i // 4, 4 * (X + a) + i % 4] = x[3 * i + a]


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

"""The 6 x 6 system of every method, written out: LDL^T and its solve without loops, which the compiler cannot unroll.

Balance has six equations whatever the number of contacts, so each Newton or interior-point step ends in this system.
Loops with triangular bounds stay loops in compiled code and take four times as long.
"""

from __future__ import annotations

from grasp_env._compile import compiled_lanes

PACKED = 21
"""Entries of the lower triangle, row by row."""


@compiled_lanes
def factor6(s, f):
    """LDL^T of the packed lower triangle s (21,): f receives L below and 1 / D on the diagonal; returns min D."""
    d0 = s[0]
    i0 = 1.0 / d0
    c10 = s[1]
    l10 = c10 * i0
    d1 = s[2] - c10 * l10
    i1 = 1.0 / d1
    c20 = s[3]
    l20 = c20 * i0
    c21 = s[4] - c20 * l10
    l21 = c21 * i1
    d2 = s[5] - c20 * l20 - c21 * l21
    i2 = 1.0 / d2
    c30 = s[6]
    l30 = c30 * i0
    c31 = s[7] - c30 * l10
    l31 = c31 * i1
    c32 = s[8] - c30 * l20 - c31 * l21
    l32 = c32 * i2
    d3 = s[9] - c30 * l30 - c31 * l31 - c32 * l32
    i3 = 1.0 / d3
    c40 = s[10]
    l40 = c40 * i0
    c41 = s[11] - c40 * l10
    l41 = c41 * i1
    c42 = s[12] - c40 * l20 - c41 * l21
    l42 = c42 * i2
    c43 = s[13] - c40 * l30 - c41 * l31 - c42 * l32
    l43 = c43 * i3
    d4 = s[14] - c40 * l40 - c41 * l41 - c42 * l42 - c43 * l43
    i4 = 1.0 / d4
    c50 = s[15]
    l50 = c50 * i0
    c51 = s[16] - c50 * l10
    l51 = c51 * i1
    c52 = s[17] - c50 * l20 - c51 * l21
    l52 = c52 * i2
    c53 = s[18] - c50 * l30 - c51 * l31 - c52 * l32
    l53 = c53 * i3
    c54 = s[19] - c50 * l40 - c51 * l41 - c52 * l42 - c53 * l43
    l54 = c54 * i4
    d5 = s[20] - c50 * l50 - c51 * l51 - c52 * l52 - c53 * l53 - c54 * l54
    f[0] = i0
    f[1], f[2] = l10, i1
    f[3], f[4], f[5] = l20, l21, i2
    f[6], f[7], f[8], f[9] = l30, l31, l32, i3
    f[10], f[11], f[12], f[13], f[14] = l40, l41, l42, l43, i4
    f[15], f[16], f[17], f[18], f[19], f[20] = l50, l51, l52, l53, l54, 1.0 / d5
    return min(d0, d1, d2, d3, d4, d5)


@compiled_lanes
def solve6(f, b0, b1, b2, b3, b4, b5):
    """The solution (6 floats) of L D L^T y = b with `factor6`'s f."""
    a0 = b0
    a1 = b1 - f[1] * a0
    a2 = b2 - f[3] * a0 - f[4] * a1
    a3 = b3 - f[6] * a0 - f[7] * a1 - f[8] * a2
    a4 = b4 - f[10] * a0 - f[11] * a1 - f[12] * a2 - f[13] * a3
    a5 = b5 - f[15] * a0 - f[16] * a1 - f[17] * a2 - f[18] * a3 - f[19] * a4
    y5 = a5 * f[20]
    y4 = a4 * f[14] - f[19] * y5
    y3 = a3 * f[9] - f[13] * y4 - f[18] * y5
    y2 = a2 * f[5] - f[8] * y3 - f[12] * y4 - f[17] * y5
    y1 = a1 * f[2] - f[4] * y2 - f[7] * y3 - f[11] * y4 - f[16] * y5
    y0 = a0 * f[0] - f[1] * y1 - f[3] * y2 - f[6] * y3 - f[10] * y4 - f[15] * y5
    return y0, y1, y2, y3, y4, y5

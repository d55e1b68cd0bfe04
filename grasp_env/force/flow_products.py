"""Five compiled ways to make the same step of the flow, the projected negative gradient in the metric of P.

| form | products for N contacts | N = 4 | what is multiplied |
|---|---|---|---|
| full | (9 N^2)^2 | 20736 | Q times vec(P^-1 W_i P^-1 - W_p) (Eqs. 9-12) |
| paper | 27 N^2 | 432 | Q_bar times VWP (Eqs. 18-26) |
| projector | 9 N^2 | 144 | Pi = D^-1 - D^-1 G^T (G D^-1 G^T)^-1 G D^-1 times the gradient, D = diag(3, 2, 2) |
| null_space | 6 N (3 N - 6) | 144 | B B^T times the gradient, B a basis of ker G, orthonormal in D |
| row_space | 39 N | 156 | D^-1 - R^T R times the gradient, R the six orthonormal rows of G D^-1 |

Work lies as in `lanes.py` and `phi_lanes.py`: row b of `work` holds contacts 4b .. 4b + 3, constants first.
"""

from __future__ import annotations

from grasp_env._compile import compiled_lanes
from grasp_env.force.lanes import LAM, OMEGA
from grasp_env.force.phi_lanes import GRADIENT, STEP, WIDTH, X

FULL, PAPER, PROJECTOR, NULL_SPACE, ROW_SPACE = range(5)
"""Forms."""
NEXT = WIDTH // 4
"""3: the trial point."""
NEXT_GRADIENT, PAST, SLOPE, DRIVE = NEXT + 3, NEXT + 6, NEXT + 9, NEXT + 10
"""3: the gradient of Phi there; 3: the step before; 1: a lane result; 9: P^-1 W_i P^-1 - W_p."""
ROW = 4 * (DRIVE + 9)
BETWEEN = 24
"""Least length of the rows of work space between two products."""


@compiled_lanes
def project(work, matrices, lanes):
    """STEP = -Pi GRADIENT; matrices (blocks^2, 1, 144), 12 x 12 from block b to block c at blocks b + c."""
    blocks = work.shape[0]
    if blocks == 1:  # without the loops a fifth faster
        spread(matrices[0, 0], work[0], work[0], True, 3 * lanes)
        return
    for b in range(blocks):
        for c in range(blocks):
            spread(matrices[blocks * b + c, 0], work[b], work[c], b == 0, 3 * lanes)


@compiled_lanes
def spread(m, source, target, fresh, width):
    """STEP of `target` = m (144,) times GRADIENT of `source`, added to what is there unless `fresh`."""
    for i in range(width):
        total = (
            ((m[i] * source[4 * GRADIENT] + m[12 + i] * source[4 * GRADIENT + 1])
            + (m[24 + i] * source[4 * GRADIENT + 2] + m[36 + i] * source[4 * GRADIENT + 3]))
            + ((m[48 + i] * source[4 * GRADIENT + 4] + m[60 + i] * source[4 * GRADIENT + 5])
            + (m[72 + i] * source[4 * GRADIENT + 6] + m[84 + i] * source[4 * GRADIENT + 7]))
            + ((m[96 + i] * source[4 * GRADIENT + 8] + m[108 + i] * source[4 * GRADIENT + 9])
            + (m[120 + i] * source[4 * GRADIENT + 10] + m[132 + i] * source[4 * GRADIENT + 11]))
        )  # fmt: skip
        target[4 * STEP + i] = total if fresh else target[4 * STEP + i] + total


@compiled_lanes
def direct(work, form, first, second, places, between, lanes):
    """STEP in every form but PROJECTOR, which the loop calls itself: passing seven arrays costs as much as its products.

    Args:
        work: (blocks, ROW), X and GRADIENT filled.
        form: which.
        first: matrices of the form, see `flow.matrices`.
        second: of NULL_SPACE.
        places: of FULL.
        between: (2, >= BETWEEN) work space; zero where a form leaves it alone.
        lanes: 4, a number the compiler must not know.
    """
    blocks = work.shape[0]
    if form == ROW_SPACE:
        _reject(work, first, between[0], lanes)
    elif form == NULL_SPACE:
        for b in range(blocks):
            _product(first[b], work[b, 4 * GRADIENT :], between[0], b == 0)
        for b in range(blocks):
            _product(second[b], between[0], work[b, 4 * STEP :], True)
    elif form == PAPER:
        for b in range(blocks):
            _flow_matrix(work[b], lanes)
            for c in range(blocks):
                _product(first[blocks * b + c], work[b, 4 * DRIVE :], work[c, 4 * STEP :], b == 0)
    else:
        drive, moved = between[0], between[1]
        for b in range(blocks):
            _flow_matrix(work[b], lanes)
        for i in range(places.shape[0]):
            for a in range(9):
                drive[places[i, a]] = work[i // 4, 4 * (DRIVE + a) + i % 4]
        _product(first[0], drive, moved, True)
        for i in range(places.shape[0]):
            for a in range(3):
                work[i // 4, 4 * (STEP + a) + i % 4] = moved[places[i, 9 + a]]


@compiled_lanes
def _product(matrix, source, target, fresh):
    """Target = matrix^T source, added to what is there unless `fresh`; matrix (rows, columns), rows a multiple of 6."""
    for j in range(0, matrix.shape[0], 6):
        m, s = matrix[j : j + 6], source[j : j + 6]
        for i in range(matrix.shape[1]):
            total = (
                (m[0, i] * s[0] + m[1, i] * s[1])
                + (m[2, i] * s[2] + m[3, i] * s[3])
                + (m[4, i] * s[4] + m[5, i] * s[5])
            )
            target[i] = total if fresh else target[i] + total
        fresh = False


@compiled_lanes
def _reject(work, matrices, sums, lanes):
    """STEP = R^T R GRADIENT - D^-1 GRADIENT; matrices (blocks, 1, 72), entry 24 a + 4 r + lane: row r, coordinate a."""
    for r in range(24):
        sums[r] = 0.0
    for b in range(work.shape[0]):
        row, m = work[b], matrices[b, 0]
        for n in range(lanes):
            p, q, s = row[4 * GRADIENT + n], row[4 * (GRADIENT + 1) + n], row[4 * (GRADIENT + 2) + n]
            for r in range(6):
                sums[4 * r + n] += m[4 * r + n] * p + m[24 + 4 * r + n] * q + m[48 + 4 * r + n] * s
    y0 = (sums[0] + sums[1]) + (sums[2] + sums[3])
    y1 = (sums[4] + sums[5]) + (sums[6] + sums[7])
    y2 = (sums[8] + sums[9]) + (sums[10] + sums[11])
    y3 = (sums[12] + sums[13]) + (sums[14] + sums[15])
    y4 = (sums[16] + sums[17]) + (sums[18] + sums[19])
    y5 = (sums[20] + sums[21]) + (sums[22] + sums[23])
    for b in range(work.shape[0]):
        row, m = work[b], matrices[b, 0]
        for n in range(lanes):
            p, q, s = row[4 * GRADIENT + n], row[4 * (GRADIENT + 1) + n], row[4 * (GRADIENT + 2) + n]
            row[4 * STEP + n] = (
                (m[n] * y0 + m[4 + n] * y1 + m[8 + n] * y2)
                + (m[12 + n] * y3 + m[16 + n] * y4 + m[20 + n] * y5)
                - p * (1.0 / 3.0)
            )
            row[4 * (STEP + 1) + n] = (
                (m[24 + n] * y0 + m[28 + n] * y1 + m[32 + n] * y2)
                + (m[36 + n] * y3 + m[40 + n] * y4 + m[44 + n] * y5)
                - q * 0.5
            )
            row[4 * (STEP + 2) + n] = (
                (m[48 + n] * y0 + m[52 + n] * y1 + m[56 + n] * y2)
                + (m[60 + n] * y3 + m[64 + n] * y4 + m[68 + n] * y5)
                - s * 0.5
            )


@compiled_lanes
def _flow_matrix(row, lanes):
    """DRIVE: the nine entries of P^-1 W_i P^-1 - W_p of four contacts, column by column (paper, Eqs. 22-25).

    P^-1 = [[u^2 - t^2, ot, -uo], [ot, u^2 - o^2, -ut], [-uo, -ut, u^2]] / det P.
    """
    for n in range(lanes):
        u, o, t = row[4 * X + n], row[4 * (X + 1) + n], row[4 * (X + 2) + n]
        omega, lam = row[4 * OMEGA + n], row[4 * LAM + n]
        i = 1.0 / (u * (u * u - o * o - t * t))
        a, b, c = (u * u - t * t) * i, o * t * i, -u * o * i
        d, e, f = (u * u - o * o) * i, -u * t * i, u * u * i
        one, two, five = lam * (a * b + b * d + c * e), lam * (a * c + b * e + c * f), lam * (b * c + d * e + e * f)
        row[4 * DRIVE + n] = lam * (a * a + b * b + c * c) - omega
        row[4 * (DRIVE + 1) + n] = one
        row[4 * (DRIVE + 2) + n] = two
        row[4 * (DRIVE + 3) + n] = one
        row[4 * (DRIVE + 4) + n] = lam * (b * b + d * d + e * e) - omega
        row[4 * (DRIVE + 5) + n] = five
        row[4 * (DRIVE + 6) + n] = two
        row[4 * (DRIVE + 7) + n] = five
        row[4 * (DRIVE + 8) + n] = lam * (c * c + e * e + f * f) - omega


@compiled_lanes
def repeat_product(work, form, first, second, places, between, lanes, times):
    """Makes the same step `times` times, for measurements; returns a number that depends on all of them."""
    for _ in range(times):
        work[0, 4 * X] += 1e-16 * work[0, 4 * STEP]
        if form == PROJECTOR:
            project(work, first, lanes)
        else:
            direct(work, form, first, second, places, between, lanes)
    return work[0, 4 * X]

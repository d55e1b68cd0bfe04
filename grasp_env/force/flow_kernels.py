"""The compiled gradient flow: one loop for every form and every step rule, four contacts at a time.

Its plain twin is `descent.descend`. Forms are data (`flow_products.py`), step rules are data (`step_size.py`).
"""

from __future__ import annotations

import math

import numpy as np

from grasp_env._compile import compiled_lanes
from grasp_env.force.cholesky6 import factor6, solve6
from grasp_env.force.flow_products import BETWEEN, NEXT, NEXT_GRADIENT, PAST, PROJECTOR, ROW, SLOPE, direct, project
from grasp_env.force.kernels import relative_gap
from grasp_env.force.lanes import CONSTANTS, GAP, KNOWN, LAM, LANE_COUNT, MASK, OMEGA, STEPS, load
from grasp_env.force.phi_lanes import GRADIENT, STEP, A, C, X, newton_system, phi_bound, spread
from grasp_env.force.record import CONVERGED, LIMIT, STALLED
from grasp_env.force.step_size import (
    ADAPTIVE,
    ARMIJO,
    BARZILAI_BORWEIN,
    EXACT,
    FIXED,
    FLAT,
    LEAP,
    MOST_TRIALS,
    SHORTEST,
)

KIND, FIRST, GROW, SHRINK, DECREASE = range(5)
"""Places in a rule's parameters."""
FAR = 3.0
"""After a step that gained more than this times the tolerance the gap is not yet below it: no bound is computed."""


@compiled_lanes
def flow(constants, form, first, second, places, weights, x, wrench, rule, options, trace, multipliers):
    """x_{k+1} = x_k + alpha_k d_k with every x_k strictly inside the cones and Phi strictly decreasing (Eqs. 12, 26).

    Args:
        constants: (blocks, 4 * CONSTANTS) from `lanes.pack`; its weights are replaced.
        form, first, second, places: see `flow_products.direct`.
        weights: (N, 2) omega and lambda of each contact.
        x: (3N,) cone coordinates, strictly feasible and balanced; overwritten.
        wrench: (6,) external wrench [N, N m].
        rule: (5,) from `StepRule.parameters`.
        options: (8,) from `lanes.options`: the relative gap at which to stop, most accepted steps, and a known min Phi to
            take the gap to. nan there: the certified dual bound, computed at iterations 0, 1, ..., 8 and then each time the
            count has grown by an eighth, but not while steps gain more than FAR tolerances.
        trace: (T,) receives Phi of iterates 0..T-1.
        multipliers: (6,) receives those of the last bound, in the unit frame, if it was taken at the last iterate, else nan.

    Returns:
        (code, accepted steps, trials, Phi, lower bound).
    """
    multipliers[0] = np.nan
    tolerance, max_iterations, lanes, optimum = options[GAP], options[STEPS], int(options[LANE_COUNT]), options[KNOWN]
    count, blocks = x.size // 3, constants.shape[0]
    unit_wrench = np.empty(6)
    load(wrench, options, unit_wrench)
    work, between = np.zeros((blocks, ROW)), np.zeros((2, max(BETWEEN, first.shape[2], second.shape[1])))
    sums, lower, factor = np.empty(132), np.empty(21), np.empty(21)
    for b in range(blocks):
        for j in range(4 * CONSTANTS):
            work[b, j] = constants[b, j]
        for n in range(4):
            work[b, 4 * X + n] = 1.0
    for i in range(count):
        work[i // 4, 4 * OMEGA + i % 4], work[i // 4, 4 * LAM + i % 4] = weights[i, 0], weights[i, 1]
    spread(x, work)
    known = optimum == optimum
    bound = optimum if known else -np.inf
    value, _ = _evaluate(work, 0.0, lanes)
    kind, alpha, past, gained = int(rule[KIND]), rule[FIRST], 0.0, 0.0
    iterations, trials, next_check = 0, 0, 0
    code = LIMIT
    while True:
        for b in range(blocks):
            row = work[b]
            for n in range(3 * lanes):
                row[4 * X + n] = row[4 * NEXT + n]
                row[4 * GRADIENT + n] = row[4 * NEXT_GRADIENT + n]
        if iterations < trace.size:
            trace[iterations] = value
        near = iterations >= next_check and gained <= FAR * tolerance * value
        if not known and (near or iterations >= max_iterations):
            next_check = iterations + max(1, iterations // 8)
            bound = max(bound, _certify(work, sums, lower, factor, unit_wrench, lanes, multipliers))
        if relative_gap(value, bound) <= tolerance:
            code = CONVERGED
            break
        if iterations >= max_iterations:
            break
        if form == PROJECTOR:
            project(work, first, lanes)
        else:
            direct(work, form, first, second, places, between, lanes)
        reach, squared, mixed = _lengths(work, lanes)
        if kind in (FIXED, ARMIJO):
            alpha = rule[FIRST]
        elif kind == ADAPTIVE and iterations > 0:
            alpha *= rule[GROW]
        elif kind == BARZILAI_BORWEIN and iterations > 0:
            s_y, y_y = past - mixed, (past - mixed) + (squared - mixed)
            if s_y > FLAT * past and y_y > 0.0:
                long = rule[GROW] == 1.0 or (rule[GROW] == 0.0 and iterations % 2 == 0)
                alpha *= past / s_y if long else s_y / y_y
            else:
                alpha *= LEAP
        elif kind == EXACT:
            bend = _curvature(work, 0.0, lanes)
            alpha = squared / bend if bend > 0.0 else rule[FIRST]
        past = squared
        alpha = max(alpha, SHORTEST * math.sqrt(reach / squared)) if squared > 0.0 else alpha
        trial = np.inf
        if kind == EXACT:
            alpha, trial, tried = _search(work, alpha, rule[DECREASE] * squared, lanes)
            trials += tried
        accepted = trial < value
        decrease = rule[DECREASE] * squared if kind == ARMIJO else 0.0
        while not accepted and alpha * alpha * squared > 1e-32 * reach:
            trials += 1
            trial, _ = _evaluate(work, alpha, lanes)
            accepted = trial < value and trial <= value - decrease * alpha
            if not accepted:
                alpha *= rule[SHRINK]
        if not accepted:
            if not known:
                bound = max(bound, _certify(work, sums, lower, factor, unit_wrench, lanes, multipliers))
            code = CONVERGED if relative_gap(value, bound) <= tolerance else STALLED
            break
        gained = value - trial
        value = trial
        iterations += 1
        multipliers[0] = np.nan
    for i in range(count):
        for a in range(3):
            x[3 * i + a] = work[i // 4, 4 * (X + a) + i % 4]
    return code, iterations, trials, value, bound


@compiled_lanes
def _search(work, alpha, slope_limit, lanes):
    """(step, Phi there, trials) where |slope| <= slope_limit: Newton on the slope, kept in a bracket; inf: not found."""
    low, high = 0.0, np.inf
    for k in range(MOST_TRIALS):
        trial, slope = _evaluate(work, alpha, lanes)
        guess = -1.0
        if trial < np.inf:
            if abs(slope) <= slope_limit:
                return alpha, trial, k + 1
            guess = alpha - slope / _curvature(work, alpha, lanes)
        if trial < np.inf and slope < 0.0:
            low = alpha
        else:
            high = alpha
        if not low < guess < high:
            guess = 0.5 * (low + high) if high < np.inf else 2.0 * alpha
        alpha = guess
    return alpha, np.inf, MOST_TRIALS


@compiled_lanes
def _evaluate(work, alpha, lanes):
    """(Phi, its slope) at x + alpha step, which goes to NEXT, its gradient to NEXT_GRADIENT; Phi +inf outside."""
    total, least, slope = 0.0, np.inf, 0.0
    for b in range(work.shape[0]):
        row = work[b]
        for n in range(lanes):
            p, q, r = row[4 * STEP + n], row[4 * (STEP + 1) + n], row[4 * (STEP + 2) + n]
            u = row[4 * X + n] + alpha * p
            o = row[4 * (X + 1) + n] + alpha * q
            t = row[4 * (X + 2) + n] + alpha * r
            row[4 * NEXT + n], row[4 * (NEXT + 1) + n], row[4 * (NEXT + 2) + n] = u, o, t
            omega, lam = 3.0 * row[4 * OMEGA + n], row[4 * LAM + n]
            u2, s2 = u * u, o * o + t * t
            d = u2 - s2
            i, j = 1.0 / u, 1.0 / d
            k = 4.0 * lam * j * j * u
            g = omega - lam * (i * i + 2.0 * j * j * (u2 + s2))
            row[4 * NEXT_GRADIENT + n] = g
            row[4 * (NEXT_GRADIENT + 1) + n] = k * o
            row[4 * (NEXT_GRADIENT + 2) + n] = k * t
            row[4 * A + n] = min(u, d)
            row[4 * C + n] = row[4 * MASK + n] * (omega * u + lam * (i + 2.0 * u * j))
            row[4 * SLOPE + n] = g * p + k * (o * q + t * r)
        for n in range(lanes):
            least = min(least, row[4 * A + n])
            total += row[4 * C + n]
            slope += row[4 * SLOPE + n]
    return (total if least > 0.0 and total == total else np.inf), slope


@compiled_lanes
def _curvature(work, alpha, lanes):
    """Second derivative of Phi along the step at x + alpha step, strictly inside."""
    total = 0.0
    for b in range(work.shape[0]):
        row = work[b]
        for n in range(lanes):
            p, q, r = row[4 * STEP + n], row[4 * (STEP + 1) + n], row[4 * (STEP + 2) + n]
            u = row[4 * X + n] + alpha * p
            o = row[4 * (X + 1) + n] + alpha * q
            t = row[4 * (X + 2) + n] + alpha * r
            u2, s2, along = u * u, o * o + t * t, o * q + t * r
            i, j = 1.0 / u, 1.0 / (u2 - s2)
            j2 = j * j
            row[4 * C + n] = row[4 * LAM + n] * (
                (2.0 * i * i * i + 4.0 * u * (u2 + 3.0 * s2) * j2 * j) * p * p
                - 8.0 * (3.0 * u2 + s2) * j2 * j * p * along
                + 4.0 * u * j2 * (q * q + r * r + 4.0 * j * along * along)
            )
        for n in range(lanes):
            total += row[4 * C + n]
    return total


@compiled_lanes
def _lengths(work, lanes):
    """In the metric diag(3, 2, 2): |X|^2, |STEP|^2 and <STEP, PAST>; then PAST = STEP."""
    reach, squared, mixed = 0.0, 0.0, 0.0
    for b in range(work.shape[0]):
        row = work[b]
        for n in range(lanes):
            u, o, t = row[4 * X + n], row[4 * (X + 1) + n], row[4 * (X + 2) + n]
            p, q, r = row[4 * STEP + n], row[4 * (STEP + 1) + n], row[4 * (STEP + 2) + n]
            p0, q0, r0 = row[4 * PAST + n], row[4 * (PAST + 1) + n], row[4 * (PAST + 2) + n]
            row[4 * A + n] = row[4 * MASK + n] * (3.0 * u * u + 2.0 * (o * o + t * t))
            row[4 * C + n] = 3.0 * p * p + 2.0 * (q * q + r * r)
            row[4 * SLOPE + n] = 3.0 * p * p0 + 2.0 * (q * q0 + r * r0)
            row[4 * PAST + n], row[4 * (PAST + 1) + n], row[4 * (PAST + 2) + n] = p, q, r
        for n in range(lanes):
            reach += row[4 * A + n]
            squared += row[4 * C + n]
            mixed += row[4 * SLOPE + n]
    return reach, squared, mixed


@compiled_lanes
def _certify(work, sums, lower, factor, wrench, lanes, multipliers):
    """Lower bound of min Phi from the Newton multipliers at X, S nu = G H^-1 grad, which are handed out; -inf: none."""
    newton_system(work, sums, lanes)
    for r in range(21):
        lower[r] = (sums[4 * r] + sums[4 * r + 1]) + (sums[4 * r + 2] + sums[4 * r + 3])
    if not factor6(lower, factor) > 0.0:
        return -np.inf
    for r in range(6):
        k = 84 + 4 * r
        lower[r] = (sums[k] + sums[k + 1]) + (sums[k + 2] + sums[k + 3])
    n0, n1, n2, n3, n4, n5 = solve6(factor, lower[0], lower[1], lower[2], lower[3], lower[4], lower[5])
    multipliers[0], multipliers[1], multipliers[2] = n0, n1, n2
    multipliers[3], multipliers[4], multipliers[5] = n3, n4, n5
    return phi_bound(work, wrench, n0, n1, n2, n3, n4, n5, lanes)

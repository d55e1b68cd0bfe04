"""Damped Newton on Phi with soft contacts and further limits, compiled.

Phi gains lambda / slack for every further limit, the order of tr P^-1: slack is the row's distance in cone coordinates [N],
u - v and u + v for torsion. The steps use the factorisation of `program_kernels`, with 1 / (second derivative of lambda /
slack) on the diagonal of the limits.
"""

from __future__ import annotations

import math

import numpy as np

from grasp_env._compile import compiled
from grasp_env.force.kernels import gradient, inner_minimum, inverse_hessian, relative_gap
from grasp_env.force.program_kernels import boundary, factor, solve
from grasp_env.force.record import CONVERGED, LIMIT, STALLED
from grasp_env.force.step_size import SHORTEST

REFINEMENTS = 3
BALANCED = 1e-13
"""A step that misses balance by less than this part of Phi needs no refinement [N / N]."""


@compiled
def slacks(first, touched, values, right, equal, z, out):
    """Out (m,) = right - C z: what balance misses, then the slack of every limit."""
    out[:] = right
    for i in range(first.size - 1):
        for j in range(first[i], first[i + 1]):
            for a in range(4):
                out[touched[j]] -= values[j, a] * z[i, a]


@compiled
def general_phi(z, slack, equal, weights, row_weights, soft):
    """Phi of z (N, 4) with slacks (m,); +inf unless strictly inside."""
    total = 0.0
    for i in range(z.shape[0]):
        u, o, t = z[i, 0], z[i, 1], z[i, 2]
        d = u * u - o * o - t * t
        if not (u > 0.0 and d > 0.0):
            return np.inf
        total += 3.0 * weights[i, 0] * u + weights[i, 1] * (1.0 / u + 2.0 * u / d)
        if soft[i]:
            if not z[i, 3] > 0.0:
                return np.inf
            total += weights[i, 1] / z[i, 3]
    for r in range(equal, slack.size):
        if not slack[r] > 0.0:
            return np.inf
        total += row_weights[r] / slack[r]
    return total


@compiled
def general_bound(first, touched, values, right, equal, weights, row_weights, soft, y):
    """Dual value at multipliers y (m,) >= 0 on the limits: no z inside has a smaller Phi; -inf where it says nothing.

    Contact by contact the least of phi(x) + q . x, q = (C^T y)_i (see `kernels.lower_bound`), of lambda / w + q_w w, and of
    lambda / slack + y slack: 2 sqrt(lambda y).
    """
    total = 0.0
    for r in range(right.size):
        total -= y[r] * right[r]
        if r >= equal:
            if not y[r] >= 0.0:
                return -np.inf
            total += 2.0 * math.sqrt(row_weights[r] * y[r])
    q = np.empty(4)
    for i in range(first.size - 1):
        q[:] = 0.0
        for j in range(first[i], first[i + 1]):
            for a in range(4):
                q[a] += values[j, a] * y[touched[j]]
        a, b = 3.0 * weights[i, 0] + q[0], math.sqrt(q[1] * q[1] + q[2] * q[2])
        if not a > b or (soft[i] and not q[3] >= 0.0):
            return -np.inf
        total += inner_minimum(a, b, weights[i, 1])
        if soft[i]:
            total += 2.0 * math.sqrt(weights[i, 1] * q[3])
    return total


@compiled
def general_newton(
    first, touched, values, right, equal, inverse, weights, row_weights, soft, tolerance, optimum, limit, z, y, trace
):
    """Newton from z (N, 4), strictly inside; overwritten, as are the multipliers y (m,) of balance and limits.

    inverse: (N, 4, 6) the least change of z for a unit of balance.

    Returns (code, iterations, trials, Phi, lower bound); see `newton.hpp` of the core.
    """
    count, m = z.shape[0], right.size
    none = np.empty((m, 0))
    corner, nothing = np.empty((0, 0)), np.empty(0)
    schur, diagonal, slack = np.empty((m, m)), np.zeros(m), np.empty(m)
    x, g, blocks3 = np.empty(3 * count), np.empty(3 * count), np.empty((count, 3, 3))
    blocks, gz, step, candidate = (
        np.zeros((count, 4, 4)),
        np.zeros((count, 4)),
        np.empty((count, 4)),
        np.empty((count, 4)),
    )
    ge, dy, trial_slack = np.empty(m), np.empty(m), np.empty(m)
    zero, more, more_y, left = np.zeros((count, 4)), np.empty((count, 4)), np.empty(m), np.empty(m)
    slacks(first, touched, values, right, equal, z, slack)
    value = general_phi(z, slack, equal, weights, row_weights, soft)
    known = optimum == optimum
    bound = optimum if known else -np.inf
    iterations, trials = 0, 0
    while True:
        if iterations < trace.size:
            trace[iterations] = value
        for i in range(count):
            for a in range(3):
                x[3 * i + a] = z[i, a]
        gradient(x, weights, g)
        inverse_hessian(x, weights, blocks3)
        for i in range(count):
            blocks[i, :3, :3] = blocks3[i]
            for a in range(3):
                gz[i, a] = -g[3 * i + a]
            if soft[i]:
                w = z[i, 3]
                blocks[i, 3, 3] = 0.5 * w * w * w / weights[i, 1]
                gz[i, 3] = weights[i, 1] / (w * w)
        # limits: y becomes p + dp with p = lambda / slack^2 and dp = p' (C dz): C dz - dp / p' = 0, taken up to y
        for r in range(equal, m):
            diagonal[r] = 0.5 * slack[r] ** 3 / row_weights[r]
        for r in range(m):
            ge[r] = slack[r] if r < equal else -0.5 * slack[r]
        if not factor(first, touched, values, blocks, none, diagonal, schur, none, corner):
            return (CONVERGED if relative_gap(value, bound) <= tolerance else STALLED), iterations, trials, value, bound
        solve(first, touched, values, blocks, none, schur, none, corner, gz, nothing, ge, step, nothing, dy)
        # what the step misses of the rows is taken off, a few digits a time in the metric of Phi, then balance by least change
        for refinement in range(REFINEMENTS + 1):
            for r in range(m):
                left[r] = ge[r] + diagonal[r] * dy[r]
            for i in range(count):
                for j in range(first[i], first[i + 1]):
                    for a in range(4):
                        left[touched[j]] -= values[j, a] * step[i, a]
            worst = 0.0
            for r in range(equal):
                worst = max(worst, abs(left[r]))
            if not worst > BALANCED * value or refinement == REFINEMENTS:
                break
            solve(first, touched, values, blocks, none, schur, none, corner, zero, nothing, left, more, nothing, more_y)
            step += more
            dy += more_y
        for i in range(count):
            for a in range(4):
                for r in range(equal):
                    step[i, a] += inverse[i, a, r] * left[r]
        y[:] = dy
        decrement, reach = 0.0, 0.0
        for i in range(count):
            reach = max(reach, boundary(z[i, 0], z[i, 1], z[i, 2], step[i, 0], step[i, 1], step[i, 2]))
            for a in range(4):
                decrement += gz[i, a] * step[i, a]
            if soft[i]:
                reach = max(reach, -step[i, 3] / z[i, 3])
            else:
                step[i, 3] = 0.0
        for r in range(equal, m):
            trial_slack[r] = 0.0
        for i in range(count):
            for j in range(first[i], first[i + 1]):
                if touched[j] >= equal:
                    for a in range(4):
                        trial_slack[touched[j]] += values[j, a] * step[i, a]
        for r in range(equal, m):
            # here the slack shrinks by trial_slack
            decrement -= row_weights[r] / (slack[r] * slack[r]) * trial_slack[r]
            reach = max(reach, trial_slack[r] / slack[r])
        for r in range(equal, m):
            y[r] = max(y[r], 0.0)  # any multipliers >= 0 give a bound
        if not known:
            bound = max(bound, general_bound(first, touched, values, right, equal, weights, row_weights, soft, y))
        if relative_gap(value, bound) <= tolerance:
            return CONVERGED, iterations, trials, value, bound
        if iterations >= limit:
            return LIMIT, iterations, trials, value, bound
        alpha = min(1.0, 0.95 / reach) if reach > 0.0 else 1.0
        accepted, trial = False, value
        for _ in range(60):
            trials += 1
            candidate[:] = z + alpha * step
            slacks(first, touched, values, right, equal, candidate, trial_slack)
            trial = general_phi(candidate, trial_slack, equal, weights, row_weights, soft)
            if trial < value - 1e-4 * alpha * decrement or (trial <= value and decrement < 1e-9 * value):
                # far from the optimum steps are as long as Phi is straight: what counts is how far z moves
                accepted = alpha * np.abs(step).max() > SHORTEST * np.abs(z).max()
                break
            alpha *= 0.5
        if not accepted:
            return (CONVERGED if relative_gap(value, bound) <= tolerance else STALLED), iterations, trials, value, bound
        z[:] = candidate
        slack[:] = trial_slack
        value = trial
        iterations += 1

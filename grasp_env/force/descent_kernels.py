"""Compiled descents on Phi: the paper's reduced flow and the damped Newton method, with one return convention.

Both overwrite x and return (code, iterations, trials, Phi, lower bound): code 0 converged, 1 iteration limit, 2 no
further decrease in floating point. Their numpy twins are `reduced_flow.py` and `newton.py`.
"""

from __future__ import annotations

import math

import numpy as np

from grasp_env._compile import compiled
from grasp_env.force.kernels import (
    certified_bound,
    phi,
    relative_gap,
)

CONVERGED, LIMIT, STALLED = 0, 1, 2
SHORTEST = 1e-10
"""The first trial of an iteration moves x by at least this fraction of its length."""


@compiled
def flow_matrix(x, weights, out):
    """VWP (9N,): the 3 x 3 blocks of P^-1 W_i P^-1 - W_p, column by column (paper, Eqs. 22-25)."""
    for k in range(x.size // 3):
        u, o, t = x[3 * k], x[3 * k + 1], x[3 * k + 2]
        omega, lam = weights[k]
        scale = 1.0 / (u * (u * u - o * o - t * t))
        a, b, c = (u * u - t * t) * scale, o * t * scale, -u * o * scale
        d, e, f = (u * u - o * o) * scale, -u * t * scale, u * u * scale
        i = 9 * k
        out[i] = lam * (a * a + b * b + c * c) - omega
        out[i + 4] = lam * (b * b + d * d + e * e) - omega
        out[i + 8] = lam * (c * c + e * e + f * f) - omega
        out[i + 1] = out[i + 3] = lam * (a * b + b * d + c * e)
        out[i + 2] = out[i + 6] = lam * (a * c + b * e + c * f)
        out[i + 5] = out[i + 7] = lam * (b * c + d * e + e * f)


@compiled
def reduced_flow(
    x, projector, cone_matrix, wrench, weights, first, grow, shrink, tolerance, optimum, max_iterations, trace
):
    """VP_{k+1} = VP_k + alpha_k Q_bar VWP_k (paper, Eq. 26) with steps that stay inside and decrease Phi.

    Args:
        x: (3N,) strictly feasible, balanced; overwritten.
        projector: Q_bar, (3N, 9N).
        first, grow, shrink: the adaptive step; alpha grows after an accepted step, shrinks after a rejected one.
        tolerance: relative gap at which to stop.
        optimum: a known min Phi to take the gap to; nan: the certified dual bound, checked at iterations 0, 1, ...,
            8 and then each time the count has grown by an eighth.
        trace: (T,) receives Phi of iterates 0..T-1.
    """
    size = x.size
    drive = np.empty(3 * size)
    direction = np.empty(size)
    candidate = np.empty(size)
    step = np.empty(size)
    multipliers = np.empty(6)
    known = optimum == optimum
    bound = optimum if known else -np.inf
    value = phi(x, weights)
    alpha = first
    iterations, trials, next_check = 0, 0, 0
    while True:
        if iterations < trace.size:
            trace[iterations] = value
        if not known and iterations >= next_check:
            next_check = iterations + max(1, iterations // 8)
            bound = max(bound, certified_bound(x, cone_matrix, wrench, weights, step, multipliers))
        if relative_gap(value, bound) <= tolerance:
            return CONVERGED, iterations, trials, value, bound
        if iterations >= max_iterations:
            return LIMIT, iterations, trials, value, bound
        flow_matrix(x, weights, drive)
        norm = 0.0
        for i in range(size):
            total = 0.0
            for j in range(3 * size):
                total += projector[i, j] * drive[j]
            direction[i] = total
            norm += total * total
        scale = 0.0
        for i in range(size):
            scale += x[i] * x[i]
        # a step far shorter than x, left from a start near the apex, grows from here instead of stalling
        alpha = max(alpha, SHORTEST * math.sqrt(scale / norm)) if norm > 0.0 else alpha
        while True:
            if not alpha * alpha * norm > 1e-32 * scale:
                if not known:
                    last = certified_bound(x, cone_matrix, wrench, weights, step, multipliers)
                    bound = max(bound, last)
                code = CONVERGED if relative_gap(value, bound) <= tolerance else STALLED
                return code, iterations, trials, value, bound
            trials += 1
            for i in range(size):
                candidate[i] = x[i] + alpha * direction[i]
            trial = phi(candidate, weights)
            if trial < value:
                break
            alpha *= shrink
        x[:] = candidate
        value = trial
        alpha *= grow
        iterations += 1

"""Phi, the tangent correction and the segment rule for the control tick until it moves to the core: numba twins, nothing else.

Everything here works on flat cone coordinates x = (u_1, o_1, t_1, u_2, ...), u = mu * normal [N], with `cone_matrix` (6, 3N) the grasp
matrix in those coordinates and `weights` (N, 2) the omega and lambda of each contact.
"""

from __future__ import annotations

import math

import numpy as np

from grasp_env._compile import compiled


@compiled
def phi(x, weights):
    """Phi = sum 3 omega u + lam (1/u + 2u/(u^2 - s^2)); +inf unless strictly inside every cone (Eqs. 10, 30, 31)."""
    total = 0.0
    for i in range(0, x.size, 3):
        u = x[i]
        d = u * u - x[i + 1] * x[i + 1] - x[i + 2] * x[i + 2]
        if not (u > 0.0 and d > 0.0):
            return np.inf
        total += 3.0 * weights[i // 3, 0] * u + weights[i // 3, 1] * (1.0 / u + 2.0 * u / d)
    return total


@compiled
def gradient(x, weights, out):
    """Gradient of Phi into `out` (3N,)."""
    for i in range(0, x.size, 3):
        u, o, t = x[i], x[i + 1], x[i + 2]
        s2 = o * o + t * t
        d = u * u - s2
        omega, lam = weights[i // 3]
        scale = lam / (d * d)
        out[i] = 3.0 * omega - lam / (u * u) - 2.0 * scale * (u * u + s2)
        out[i + 1] = 4.0 * scale * u * o
        out[i + 2] = 4.0 * scale * u * t


@compiled
def inverse_hessian(x, weights, out):
    """Inverse of the 3 x 3 Hessian blocks of Phi into `out` (N, 3, 3).

    In closed form, without differences that cancel close to a cone: with p = u + s, q = u - s the part of Phi in the plane
    of u and s is lambda (2/(p+q) + 1/p + 1/q), whose Hessian is diag(2/p^3, 2/q^3) + 4/(p+q)^3 (1, 1)(1, 1)^T.
    """
    for k in range(x.size // 3):
        u, o, t = x[3 * k], x[3 * k + 1], x[3 * k + 2]
        u2, s2 = u * u, o * o + t * t
        d = u2 - s2
        lam = weights[k, 1]
        scale = 1.0 / (6.0 * lam * (u2 + s2))
        along = scale * u2 * (3.0 * u2 + s2)
        across = d * d / (4.0 * lam * u)
        bend = scale * (3.0 * u2 * (u2 + s2) - 2.0 * s2 * s2) / u
        block = out[k]
        block[0, 0] = scale * u2 * u * (u2 + 3.0 * s2)
        block[0, 1] = block[1, 0] = along * o
        block[0, 2] = block[2, 0] = along * t
        block[1, 1] = across + bend * o * o
        block[1, 2] = block[2, 1] = bend * o * t
        block[2, 2] = across + bend * t * t


@compiled
def schur(cone_matrix, blocks, half, out):
    """Out (6, 6) = G B G^T for block-diagonal B = `blocks` (N, 3, 3); `half` (3N, 6) receives B G^T."""
    out[:] = 0.0
    for k in range(blocks.shape[0]):
        block = blocks[k]
        for row in range(3):
            for j in range(6):
                half[3 * k + row, j] = (
                    block[row, 0] * cone_matrix[j, 3 * k]
                    + block[row, 1] * cone_matrix[j, 3 * k + 1]
                    + block[row, 2] * cone_matrix[j, 3 * k + 2]
                )
        for i in range(6):
            for j in range(i + 1):
                total = 0.0
                for row in range(3):
                    total += cone_matrix[i, 3 * k + row] * half[3 * k + row, j]
                out[i, j] += total


@compiled
def cholesky(matrix):
    """Lower Cholesky factor in place (lower triangle); False when not positive definite."""
    n = matrix.shape[0]
    for j in range(n):
        pivot = matrix[j, j]
        for k in range(j):
            pivot -= matrix[j, k] * matrix[j, k]
        if not pivot > 0.0:
            return False
        pivot = math.sqrt(pivot)
        matrix[j, j] = pivot
        for i in range(j + 1, n):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = total / pivot
    return True


@compiled
def cholesky_solve(factor, b):
    """Solves L L^T y = b in place."""
    n = factor.shape[0]
    for i in range(n):
        total = b[i]
        for k in range(i):
            total -= factor[i, k] * b[k]
        b[i] = total / factor[i, i]
    for i in range(n - 1, -1, -1):
        total = b[i]
        for k in range(i + 1, n):
            total -= factor[k, i] * b[k]
        b[i] = total / factor[i, i]


@compiled
def residual(cone_matrix, x, wrench, out):
    """Out (6,) = G f + w."""
    for i in range(6):
        total = wrench[i]
        for j in range(x.size):
            total += cone_matrix[i, j] * x[j]
        out[i] = total


@compiled
def step_to_boundary(x, step):
    """Largest a with x + a * step inside every cone (np.inf: all of the ray is inside), x strictly inside."""
    limit = np.inf
    for i in range(0, x.size, 3):
        u, o, t = x[i], x[i + 1], x[i + 2]
        du, do, dt = step[i], step[i + 1], step[i + 2]
        a = du * du - do * do - dt * dt
        b = u * du - o * do - t * dt
        c = u * u - o * o - t * t
        # a r^2 + 2 b r + c = 0, c > 0: the least positive root, in the form that does not cancel
        if a < 0.0 or b < 0.0:
            # b^2 >= a c but for rounding: no ray from inside a cone misses its surface and the opposite cone's
            denominator = math.sqrt(max(b * b - a * c, 0.0)) - b
            if denominator > 0.0:
                limit = min(limit, c / denominator)
    return limit


@compiled
def combine(basis, wrench, printed, out):
    """Out (3N,) = sum E_k f_k (+ max(0, 1 - sum E_k) f_rest unless `printed`), E_k = max(0, +-w_k) (Eqs. 33, 34).

    basis: (13, 3N), the optima for +e_1..+e_6, -e_1..-e_6 and for w = 0.
    """
    total = 0.0
    out[:] = 0.0
    for k in range(6):
        weight = abs(wrench[k])
        total += weight
        row = k if wrench[k] > 0.0 else k + 6
        if weight > 0.0:
            for j in range(out.size):
                out[j] += weight * basis[row, j]
    if not printed and total < 1.0:
        for j in range(out.size):
            out[j] += (1.0 - total) * basis[12, j]


@compiled
def tangent(x, cone_matrix, wrench, weights, out):
    """Out = x + H^-1 G^T (G H^-1 G^T)^-1 (-(G f + w)), H the Hessian of Phi at x; False when S lost definiteness.

    The predictor of the optimum when the wrench (or G) has moved away from the one that x balances.
    """
    size = x.size
    blocks = np.empty((size // 3, 3, 3))
    half = np.empty((size, 6))
    s = np.empty((6, 6))
    r = np.empty(6)
    inverse_hessian(x, weights, blocks)
    schur(cone_matrix, blocks, half, s)
    residual(cone_matrix, x, wrench, r)
    if not cholesky(s):
        return False
    cholesky_solve(s, r)
    for j in range(size):
        total = x[j]
        for i in range(6):
            total -= half[j, i] * r[i]
        out[j] = total
    return True


@compiled
def best_on_segment(safe, candidate, weights, out):
    """The force of least Phi on the segment from `safe` (strictly inside) to `candidate`, into `out`; returns theta.

    Phi is convex along the segment: its slope is driven to zero by bisection inside the cones, to a thousandth of theta. The
    result is never worse than `safe`, nor than `candidate` where that is strictly inside.
    """
    size = safe.size
    move = candidate - safe
    value_safe = phi(safe, weights)
    value_candidate = phi(candidate, weights)
    low, high = 0.0, 1.0
    g = np.empty(size)
    if value_candidate == np.inf:
        high = min(1.0, 0.999 * step_to_boundary(safe, move))
    best, best_value = 0.0, value_safe
    if value_candidate < best_value:
        best, best_value = 1.0, value_candidate
    theta = high
    for _ in range(40):
        for j in range(size):
            out[j] = safe[j] + theta * move[j]
        value = phi(out, weights)
        if value < best_value:
            best, best_value = theta, value
        if value == np.inf:
            high = theta
        else:
            gradient(out, weights, g)
            slope = 0.0
            for j in range(size):
                slope += g[j] * move[j]
            if slope <= 0.0:
                if theta == 1.0:
                    break
                low = theta
            else:
                high = theta
        if high - low < 1e-3 * high:
            break
        theta = 0.5 * (low + high)
    if best == 1.0:
        out[:] = candidate
    else:
        for j in range(size):
            out[j] = safe[j] + best * move[j]
    return best

"""Compiled initial forces in cone coordinates: the 12-basis, segments, rays and the tangent correction."""

from __future__ import annotations

import math

import numpy as np

from grasp_env._compile import compiled
from grasp_env.force.kernels import (
    cholesky,
    cholesky_solve,
    gradient,
    inverse_hessian,
    phi,
    residual,
    schur,
    step_to_boundary,
)


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
def ray_interval(point, ray):
    """(low, high): the k >= 0 with point + k * ray strictly inside every cone; low >= high when there are none."""
    low, high = 0.0, np.inf
    for i in range(0, point.size, 3):
        pu, po, pt = point[i], point[i + 1], point[i + 2]
        ru, ro, rt = ray[i], ray[i + 1], ray[i + 2]
        # inside: q(k) = a k^2 + 2 b k + c > 0 and u(k) > 0. {q > 0, u > 0} is convex: one interval.
        a = ru * ru - ro * ro - rt * rt
        b = pu * ru - po * ro - pt * rt
        c = pu * pu - po * po - pt * pt
        discriminant = b * b - a * c
        one, two = 0.0, np.inf
        if a > 0.0:  # the ray ends inside one of the two opposite cones, so b^2 >= a c but for rounding
            root = math.sqrt(max(discriminant, 0.0))
            if b > 0.0:
                near, far = -(root + b) / a, -c / (root + b)
            elif root - b > 0.0:
                near, far = c / (root - b), (root - b) / a
            else:
                near, far = 0.0, 0.0
            if ru > 0.0:
                one = far
            else:
                two = near
        elif a < 0.0:
            if discriminant > 0.0:
                root = math.sqrt(discriminant)
                q = -(b + root) if b >= 0.0 else root - b
                first, second = q / a, c / q
                one, two = min(first, second), max(first, second)
                if not pu + 0.5 * (one + two) * ru > 0.0:
                    two = one - 1.0
            else:
                two = -1.0
        elif b > 0.0:  # the ray runs along the surface of a cone
            one = -c / (2.0 * b)
            if not ru > 0.0:
                two = one - 1.0
        elif b < 0.0:
            two = -c / (2.0 * b)
            if not ru < 0.0:
                two = one - 1.0
        elif not (c > 0.0 and pu > 0.0):
            two = -1.0
        low, high = max(low, one), min(high, two)
    return low, high


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


@compiled
def squeeze_scale(x, weights):
    """K > 0 of least Phi(k x) for x strictly inside: Phi(k x) = k a + b / k."""
    force, barrier = 0.0, 0.0
    for i in range(0, x.size, 3):
        u = x[i]
        d = u * u - x[i + 1] * x[i + 1] - x[i + 2] * x[i + 2]
        omega, lam = weights[i // 3]
        force += 3.0 * omega * u
        barrier += lam * (1.0 / u + 2.0 * u / d)
    return math.sqrt(barrier / force)

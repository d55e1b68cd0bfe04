"""The general program, compiled: soft contacts, further linear limits, shared variables.

    min  sum_i c_i . z_i + ct . t   s.t.   sum_i C_i z_i + g t  = b  (the first `equal` rows)  or  <= b  (the others)
                                           (u, o, t)_i in its cone, w_i >= 0 where contact i is soft

A contact's torsion is u - w in units of its limit, so w >= 0 is one of its two bounds and a row w - 2u <= 0 the other. The
method is that of the core's `conic.hpp` from an infeasible start. Each limit joins the equations with slack / multiplier on the
diagonal (the form that subtracts nothing large), and every step is corrected once by what it misses. Contacts enter by the
rows that they touch, so an iteration costs O(N) and one factorisation of all rows. The plain twin of an iteration is `conic.nt_step`.
"""

from __future__ import annotations

import math

import numpy as np

from grasp_env._compile import compiled
from grasp_env.force.kernels import cholesky, cholesky_solve
from grasp_env.force.record import CONVERGED, LIMIT, STALLED

FEASIBLE = 1e-9
"""Residuals, relative to the data, at which an iterate counts as feasible."""
NEARLY = 1e-7
"""Residuals at which an iterate may be the best one, where the method ends short."""
REFINEMENTS = 2


@compiled
def scaled(v0, v1, v2, eta, a0, a1, a2):
    """W a of the Nesterov-Todd scaling: W = sqrt(eta) (v_0, v^T; v, I + v v^T / (1 + v_0)); W^-1 has -v and 1 / eta."""
    root = math.sqrt(eta)
    inner = v1 * a1 + v2 * a2
    k = a0 + inner / (1.0 + v0)
    return root * (v0 * a0 + inner), root * (a1 + k * v1), root * (a2 + k * v2)


@compiled
def boundary(x0, x1, x2, d0, d1, d2):
    """1 / (largest step that keeps x + a d in the cone), at least 0."""
    i = 1.0 / (x0 * x0 - x1 * x1 - x2 * x2)
    j = math.sqrt(i)
    rho = (x0 * d0 - x1 * d1 - x2 * d2) * i
    k = (d0 * j + rho) / (1.0 + x0 * j)
    r1, r2 = d1 - k * x1, d2 - k * x2
    return max(0.0, j * math.sqrt(r1 * r1 + r2 * r2) - rho)


@compiled
def factor(first, touched, columns, blocks, coupling, diagonal, schur, reduced, corner):
    """Schur = C B C^T + D and corner = g^T S^-1 g in Cholesky form, reduced = S^-1 g; False where one is not positive.

    columns (K, 4) of the rows touched[first[i] : first[i + 1]] by contact i, blocks B (N, 4, 4), coupling g (m, T),
    diagonal D (m,).
    """
    m, shares = diagonal.size, corner.shape[0]
    schur[:] = 0.0
    for r in range(m):
        schur[r, r] = diagonal[r]
    half = np.empty(4)
    for i in range(first.size - 1):
        for j in range(first[i], first[i + 1]):
            r = touched[j]
            for a in range(4):
                half[a] = 0.0
                for c in range(4):
                    half[a] += blocks[i, a, c] * columns[j, c]
            for l in range(first[i], j + 1):  # noqa: E741
                total = 0.0
                for a in range(4):
                    total += half[a] * columns[l, a]
                schur[r, touched[l]] += total
    if not cholesky(schur, 1e-15):
        return False
    column = np.empty(m)
    for k in range(shares):
        column[:] = coupling[:, k]
        cholesky_solve(schur, column)
        reduced[:, k] = column
    for k in range(shares):
        for j in range(shares):
            corner[k, j] = 0.0
            for r in range(m):
                corner[k, j] += coupling[r, k] * reduced[r, j]
    return shares == 0 or cholesky(corner)


@compiled
def solve(first, touched, columns, blocks, coupling, schur, reduced, corner, gz, gt, ge, de, dt, dy):
    """B^-1 de + C^T dy = gz, g^T dy = gt, C de + g dt - D dy = ge, factored by `factor`."""
    shares = gt.size
    dy[:] = -ge
    for i in range(first.size - 1):
        for a in range(4):
            de[i, a] = 0.0
            for c in range(4):
                de[i, a] += blocks[i, a, c] * gz[i, c]
        for j in range(first[i], first[i + 1]):
            for a in range(4):
                dy[touched[j]] += columns[j, a] * de[i, a]
    # S dy - g dt = f: dt from g^T S^-1 g dt = gt - g^T S^-1 f
    for k in range(shares):
        dt[k] = gt[k]
        for r in range(dy.size):
            dt[k] -= reduced[r, k] * dy[r]
    cholesky_solve(schur, dy)
    if shares > 0:
        cholesky_solve(corner, dt)
    for k in range(shares):
        for r in range(dy.size):
            dy[r] += reduced[r, k] * dt[k]
    rest = np.empty(4)
    for i in range(first.size - 1):
        for a in range(4):
            rest[a] = gz[i, a]
        for j in range(first[i], first[i + 1]):
            for a in range(4):
                rest[a] -= columns[j, a] * dy[touched[j]]
        for a in range(4):
            de[i, a] = 0.0
            for c in range(4):
                de[i, a] += blocks[i, a, c] * rest[c]


@compiled
def missed(first, touched, columns, metric, coupling, diagonal, fz, ft, fe, de, dt, dy, gz, gt, ge):
    """What (de, dt, dy) misses of the equations of `solve` with right sides f; metric (N, 4, 4) is B^-1."""
    shares = ft.size
    gz[:], gt[:], ge[:] = fz, ft, fe
    for r in range(dy.size):
        ge[r] += diagonal[r] * dy[r]
        for k in range(shares):
            gt[k] -= coupling[r, k] * dy[r]
            ge[r] -= coupling[r, k] * dt[k]
    for i in range(first.size - 1):
        for a in range(4):
            for c in range(4):
                gz[i, a] -= metric[i, a, c] * de[i, c]
        for j in range(first[i], first[i + 1]):
            for a in range(4):
                gz[i, a] -= columns[j, a] * dy[touched[j]]
                ge[touched[j]] -= columns[j, a] * de[i, a]


@compiled
def interior_point(
    first,
    touched,
    values,
    coupling,
    right,
    equal,
    cost,
    shared_cost,
    soft,
    tolerance,
    absolute,
    limit,
    z,
    t,
    y,
    s,
    slack,
    info,
):
    """Solves the program; z, t, y, s, slack hold the start and receive the answer.

    Args:
        first, touched, values: (N + 1,), (K,), (K, 4): C by contact; contact i touches rows touched[first[i] : first[i + 1]].
        coupling: (m, T) g; right: (m,) b; equal: how many of the m rows are equations.
        cost: (N, 4) c; shared_cost: (T,).
        soft: (N,) whether w is a variable (elsewhere it stays 1 and is touched by no row).
        tolerance, absolute: gap, relative to the objective and absolute; limit: most iterations.
        z, s: (N, 4), primal and dual, strictly inside; t: (T,); y: (m,) > 0 on the limits; slack: (m,) > 0 there.
        info: (6,) receives code, iterations, objective, gap, primal residual, dual residual.
    """
    count, m, shares = z.shape[0], right.size, t.size
    degree = 2.0 * count + (m - equal)
    for i in range(count):
        degree += 1.0 if soft[i] else 0.0
    scaling = np.empty((count, 5))
    blocks = np.zeros((count, 4, 4))
    for i in range(count):
        for a in range(4):
            blocks[i, a, a] = 1.0
    columns = np.empty_like(values)
    schur, reduced, corner, diagonal = np.empty((m, m)), np.empty((m, shares)), np.empty((shares, shares)), np.zeros(m)
    rz, rt, re = np.empty((count, 4)), np.empty(shares), np.empty(m)
    fz, ft, fe = np.empty((count, 4)), np.empty(shares), np.empty(m)
    gz, gt, ge = np.empty((count, 4)), np.empty(shares), np.empty(m)
    ce, ct, cy = np.empty((count, 4)), np.empty(shares), np.empty(m)
    de, dt, dy = np.empty((count, 4)), np.empty(shares), np.empty(m)
    dz, ds, h = np.zeros((count, 4)), np.zeros((count, 4)), np.empty((count, 4))
    kappa, dslack = np.zeros(m), np.zeros(m)
    size_c = 1.0
    for i in range(count):
        for a in range(4):
            size_c = max(size_c, abs(cost[i, a]))
    best = np.inf
    best_z, best_t, best_y = np.empty_like(z), np.empty_like(t), np.empty_like(y)
    info[:] = 0.0
    iterations = 0
    while True:
        gap, objective, primal, dual = 0.0, 0.0, 0.0, 0.0
        size_z = 1.0  # weak grasps hold wrenches of size one with forces of thousands: residuals are relative to those
        for i in range(count):
            size_z = max(size_z, z[i, 0])
        for r in range(m):
            re[r] = -right[r]
            for k in range(shares):
                re[r] += coupling[r, k] * t[k]
        for k in range(shares):
            objective += shared_cost[k] * t[k]
            rt[k] = shared_cost[k]
            for r in range(m):
                rt[k] += coupling[r, k] * y[r]
            dual = max(dual, abs(rt[k]) / size_c)
        for i in range(count):
            for a in range(4):
                objective += cost[i, a] * z[i, a]
                rz[i, a] = cost[i, a] - s[i, a]
                if a < 3 or soft[i]:
                    gap += z[i, a] * s[i, a]
            for j in range(first[i], first[i + 1]):
                for a in range(4):
                    re[touched[j]] += values[j, a] * z[i, a]
                    rz[i, a] += values[j, a] * y[touched[j]]
            if not soft[i]:
                rz[i, 3] = 0.0
            for a in range(4):
                dual = max(dual, abs(rz[i, a]) / size_c)
        for r in range(m):
            if r >= equal:
                re[r] += slack[r]
                gap += slack[r] * y[r]
            primal = max(primal, abs(re[r]) / (size_z + abs(right[r])))
        info[1], info[2], info[3], info[4], info[5] = iterations, objective, gap, primal, dual
        if primal < NEARLY and dual < NEARLY and gap < best:
            best = gap
            best_z[:], best_t[:], best_y[:] = z, t, y
        if not gap < np.inf:
            code = STALLED
            break
        if primal < FEASIBLE and dual < FEASIBLE and gap <= tolerance * abs(objective) + absolute:
            code = CONVERGED
            break
        if iterations >= limit:
            code = LIMIT
            break
        mu = gap / degree
        for i in range(count):
            x0, x1, x2, s0, s1, s2 = z[i, 0], z[i, 1], z[i, 2], s[i, 0], s[i, 1], s[i, 2]
            eta = math.sqrt((x0 * x0 - x1 * x1 - x2 * x2) / (s0 * s0 - s1 * s1 - s2 * s2))
            v0, v1, v2 = x0 + eta * s0, x1 - eta * s1, x2 - eta * s2
            unit = 1.0 / math.sqrt(v0 * v0 - v1 * v1 - v2 * v2)
            v0, v1, v2 = v0 * unit, v1 * unit, v2 * unit
            line = math.sqrt(z[i, 3] / s[i, 3]) if soft[i] else 1.0
            scaling[i, 0], scaling[i, 1], scaling[i, 2], scaling[i, 3], scaling[i, 4] = v0, v1, v2, eta, line
            for j in range(first[i], first[i + 1]):
                a0, a1, a2 = values[j, 0], values[j, 1], values[j, 2]
                columns[j, 0], columns[j, 1], columns[j, 2] = scaled(v0, v1, v2, eta, a0, a1, a2)
                columns[j, 3] = line * values[j, 3]
        for r in range(equal, m):
            diagonal[r] = slack[r] / y[r]
        if not factor(first, touched, columns, blocks, coupling, diagonal, schur, reduced, corner):
            code = STALLED
            break
        target, step_primal, step_dual = 0.0, 0.0, 0.0
        for phase in range(2):
            # complementarity: W^-1 dz + W ds = h, slack dy + y dslack = kappa; the predictor's de and ds are still there
            for i in range(count):
                v0, v1, v2, eta, line = scaling[i]
                l0, l1, l2 = scaled(v0, v1, v2, eta, s[i, 0], s[i, 1], s[i, 2])
                l3 = line * s[i, 3]
                h[i, 0], h[i, 1], h[i, 2], h[i, 3] = -l0, -l1, -l2, -l3 if soft[i] else 0.0
                if phase == 1:
                    e0, e1, e2 = scaled(v0, v1, v2, eta, ds[i, 0], ds[i, 1], ds[i, 2])
                    p0, p1, p2 = de[i, 0], de[i, 1], de[i, 2]
                    r0 = target - (p0 * e0 + p1 * e1 + p2 * e2)
                    r1, r2 = -(p0 * e1 + e0 * p1), -(p0 * e2 + e0 * p2)
                    q0 = (l0 * r0 - l1 * r1 - l2 * r2) / (l0 * l0 - l1 * l1 - l2 * l2)
                    h[i, 0] += q0
                    h[i, 1] += (r1 - q0 * l1) / l0
                    h[i, 2] += (r2 - q0 * l2) / l0
                    if soft[i]:
                        h[i, 3] += (target - de[i, 3] * line * ds[i, 3]) / l3
                g0, g1, g2 = scaled(v0, v1, v2, eta, rz[i, 0], rz[i, 1], rz[i, 2])
                fz[i, 0], fz[i, 1], fz[i, 2] = h[i, 0] - g0, h[i, 1] - g1, h[i, 2] - g2
                fz[i, 3] = h[i, 3] - line * rz[i, 3]
            ft[:] = -rt
            for r in range(m):
                fe[r] = -re[r]
                if r >= equal:
                    kappa[r] = target - slack[r] * y[r] - (dslack[r] * dy[r] if phase == 1 else 0.0)
                    fe[r] -= kappa[r] / y[r]
            solve(first, touched, columns, blocks, coupling, schur, reduced, corner, fz, ft, fe, de, dt, dy)
            for _ in range(REFINEMENTS):
                missed(first, touched, columns, blocks, coupling, diagonal, fz, ft, fe, de, dt, dy, gz, gt, ge)
                solve(first, touched, columns, blocks, coupling, schur, reduced, corner, gz, gt, ge, ce, ct, cy)
                de += ce
                dt += ct
                dy += cy
            far_primal, far_dual = 1e-12, 1e-12
            for i in range(count):
                v0, v1, v2, eta, line = scaling[i]
                dz[i, 0], dz[i, 1], dz[i, 2] = scaled(v0, v1, v2, eta, de[i, 0], de[i, 1], de[i, 2])
                dz[i, 3] = line * de[i, 3]
                # ds from its own equation: what was feasible stays so to the last digit
                for a in range(4):
                    ds[i, a] = rz[i, a]
                for j in range(first[i], first[i + 1]):
                    for a in range(4):
                        ds[i, a] += values[j, a] * dy[touched[j]]
                far_primal = max(far_primal, boundary(z[i, 0], z[i, 1], z[i, 2], dz[i, 0], dz[i, 1], dz[i, 2]))
                far_dual = max(far_dual, boundary(s[i, 0], s[i, 1], s[i, 2], ds[i, 0], ds[i, 1], ds[i, 2]))
                if soft[i]:
                    far_primal, far_dual = max(far_primal, -dz[i, 3] / z[i, 3]), max(far_dual, -ds[i, 3] / s[i, 3])
                else:
                    dz[i, 3] = ds[i, 3] = 0.0
            for r in range(equal, m):
                dslack[r] = (kappa[r] - slack[r] * dy[r]) / y[r]
                far_primal, far_dual = max(far_primal, -dslack[r] / slack[r]), max(far_dual, -dy[r] / y[r])
            if phase == 0:
                step_primal, step_dual = min(1.0, 1.0 / far_primal), min(1.0, 1.0 / far_dual)
                after = 0.0
                for i in range(count):
                    for a in range(4 if soft[i] else 3):
                        after += (z[i, a] + step_primal * dz[i, a]) * (s[i, a] + step_dual * ds[i, a])
                for r in range(equal, m):
                    after += (slack[r] + step_primal * dslack[r]) * (y[r] + step_dual * dy[r])
                ratio = min(1.0, max(after, 0.0) / gap)
                target = mu * max(ratio * ratio * ratio, 1e-10)
            else:
                reach = 0.9 + 0.09 * min(step_primal, step_dual)
                step_primal, step_dual = min(1.0, reach / far_primal), min(1.0, reach / far_dual)
        if not max(step_primal, step_dual) > 1e-10:
            code = STALLED
            break
        z += step_primal * dz
        s += step_dual * ds
        t += step_primal * dt
        y += step_dual * dy
        slack += step_primal * dslack
        iterations += 1
    if code != CONVERGED and best < np.inf:
        # where the last digits were lost, the best iterate is worth more than the last
        z[:], t[:], y[:] = best_z, best_t, best_y
    info[0] = code

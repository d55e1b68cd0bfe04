"""How the forces of a control tick follow contacts and wrench between two optimisations, compiled."""

from __future__ import annotations

import math

import numpy as np

from grasp_env._compile import compiled
from grasp_env._views import inlined
from grasp_env.force.kernels import cholesky, cholesky_solve, phi
from grasp_env.force.pipeline_kernels import CARRIED, carry_or_repair, turn
from grasp_env.force.start_kernels import combine, tangent


@inlined
def carry(x, frames_then, basis, basis_frames, frames, cone_matrix, divisor, wrench, weights, out):
    """`pipeline_kernels.carry` of a force (3n,) that was optimal in other frames; True where the tangent correction was enough."""
    turned = np.empty_like(x)
    turn(x, divisor, frames_then, frames, turned)
    if tangent(turned, cone_matrix, wrench, weights, out) and phi(out, weights) < np.inf:
        return True
    return _repair(turned, basis, basis_frames, frames, cone_matrix, divisor, wrench, weights, out)


@compiled
def _repair(turned, basis, basis_frames, frames, cone_matrix, divisor, wrench, weights, out):
    """`carry` where the tangent correction left the cones."""
    combined, there = np.empty_like(turned), np.empty_like(turned)
    combine(basis, wrench, False, there)
    turn(there, divisor, basis_frames, frames, combined)
    return carry_or_repair(turned, combined, cone_matrix, wrench, weights, out) == CARRIED


@compiled
def least_norm(force, matrix, wrench):
    """Force (3n,) += -G^T (G G^T)^-1 (G f + w): balance restored by the least change [N], as far as these contacts can."""
    normal, residual, scale = np.zeros((6, 6)), np.empty(6), 0.0
    for i in range(6):
        residual[i] = wrench[i]
        for j in range(force.size):
            residual[i] += matrix[i, j] * force[j]
        for k in range(i + 1):
            for j in range(force.size):
                normal[i, k] += matrix[i, j] * matrix[k, j]
        scale = max(scale, normal[i, i])
    for i in range(6):
        normal[i, i] += 1e-9 * scale  # two contacts cannot turn the object about the line between them
    if not cholesky(normal):
        return
    cholesky_solve(normal, residual)
    for j in range(force.size):
        for i in range(6):
            force[j] -= matrix[i, j] * residual[i]


@inlined
def bound_change(x, before, frames_before, basis, basis_frames, frames, cone_matrix, divisor, wrench, weights, most):
    """Moves x (3n,) towards what was commanded before (n, 3), so that no component changes by more than `most` [N] beyond balance."""
    change = 0.0
    for k in range(before.shape[0]):
        for r in range(3):
            change = max(change, abs(x[3 * k + r] / divisor[k, r] - before[k, r]))
    if change > most:
        _slow_down(x, before, frames_before, basis, basis_frames, frames, cone_matrix, divisor, wrench, weights, most)


@compiled
def _slow_down(x, before, frames_before, basis, basis_frames, frames, cone_matrix, divisor, wrench, weights, most):
    """`bound_change` where there is something to bound."""
    old, kept = np.empty_like(x), np.empty_like(x)
    for k in range(before.shape[0]):
        for r in range(3):
            old[3 * k + r] = before[k, r] * divisor[k, r]
        # a finger that has just landed carries nothing yet: barely inside its cone
        old[3 * k] = max(old[3 * k], 1.05 * math.sqrt(old[3 * k + 1] ** 2 + old[3 * k + 2] ** 2), 1e-2)
    carry(old, frames_before, basis, basis_frames, frames, cone_matrix, divisor, wrench, weights, kept)
    change = 0.0
    for j in range(x.size):
        change = max(change, abs(x[j] - kept[j]) / divisor[j // 3, j % 3])
    if change > most:
        for j in range(x.size):
            x[j] = kept[j] + most / change * (x[j] - kept[j])

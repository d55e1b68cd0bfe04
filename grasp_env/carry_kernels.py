"""How the forces of a control tick follow contacts and wrench between two optimisations, compiled."""

from __future__ import annotations

import math

import numpy as np

from grasp_env._compile import compiled
from grasp_env._views import inlined
from grasp_env.core import LARGEST, ROUNDING, TANGENT_SWITCH
from grasp_env.phi_kernels import best_on_segment, cholesky, cholesky_solve, combine, phi, tangent


@inlined
def carry(x, frames_then, basis, basis_frames, frames, cone_matrix, divisor, wrench, weights, out):
    """`carry_or_repair` of a force (3n,) that was optimal in other frames; True where the tangent correction was enough."""
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


CARRIED, REPAIRED, CLIPPED = 0, 1, 2
"""How a force was carried."""


@compiled
def turn(x, divisor, old, new, out):
    """Out (3N,) = x with its tangential parts turned from the tangents of `old` into those of `new` frames (N, 3, 3).

    What the frames' tilt takes off a tangential force is left out, so that out is inside the cones where x is (round cones).
    """
    for k in range(divisor.shape[0]):
        fo, ft = x[3 * k + 1] / divisor[k, 1], x[3 * k + 2] / divisor[k, 2]
        o, t = 0.0, 0.0
        for a in range(3):
            along = old[k, a, 1] * fo + old[k, a, 2] * ft
            o += new[k, a, 1] * along
            t += new[k, a, 2] * along
        out[3 * k], out[3 * k + 1], out[3 * k + 2] = x[3 * k], o * divisor[k, 1], t * divisor[k, 2]


@compiled
def carry_or_repair(x, combined, cone_matrix, wrench, weights, out):
    """A force that was optimal before, carried to the cone matrix and the wrench of now and strictly inside the cones.

    The tangent correction (one 6 x 6 system); where that leaves the cones, the least Phi on the segment to it from the
    `combined` force, itself carried; where even that is outside, the force clipped into the cones, without balance. The core's twin
    is `PipelineOn::carry`.

    Args:
        x: (3N,) the optimum before, cone coordinates [N].
        combined: (3N,) the combination of an offline basis of nearby contacts. Both in the frames of `cone_matrix`.
        cone_matrix: (6, 3N) G in cone coordinates.
        wrench: (6,) external wrench [N, N m], in the frame of cone_matrix.
        weights: (N, 2) omega and lambda of Phi.
        out: (3N,) overwritten; not x.

    Returns:
        CARRIED, REPAIRED or CLIPPED.
    """
    if not tangent(x, cone_matrix, wrench, weights, out):
        out[:] = x
    if phi(out, weights) < np.inf:  # false for nan
        return CARRIED
    safe, moved, finite = np.empty_like(x), out.copy(), True
    for j in range(moved.size):
        finite = finite and abs(moved[j]) < LARGEST
    if not finite:
        moved[:] = combined
    if tangent(combined, cone_matrix, wrench, weights, safe) and phi(safe, weights) < np.inf:
        out[:] = safe
        if finite:
            best_on_segment(safe, moved, weights, out)
        return REPAIRED
    out[:] = moved
    # give up a little balance (the pose feedback takes it back), never the friction cone
    for j in range(0, out.size, 3):
        out[j] = max(out[j], 1.05 * math.sqrt(out[j + 1] * out[j + 1] + out[j + 2] * out[j + 2]))
    return CLIPPED


@compiled
def write_contact_geometry(positions, normals, cone_divisor, tangents, frames, matrix, cone_matrix):
    """`contact_geometry` into given arrays."""
    for k in range(positions.shape[0]):
        nx, ny, nz = normals[k]
        if tangents.shape[0] > 0:
            ox, oy, oz = tangents[k]
            for _ in range(
                2
            ):  # the second takes away what rounding left of o . n where a tangent is close to the normal
                along = ox * nx + oy * ny + oz * nz
                if abs(along) > ROUNDING:
                    ox, oy, oz = ox - along * nx, oy - along * ny, oz - along * nz
                length = math.sqrt(ox * ox + oy * oy + oz * oz)
                if abs(length - 1.0) > ROUNDING:
                    ox, oy, oz = ox / length, oy / length, oz / length
        elif abs(nx) > TANGENT_SWITCH:
            ox, oy, oz = -ny * nx, 1.0 - ny * ny, -ny * nz
        else:
            ox, oy, oz = 1.0 - nx * nx, -nx * ny, -nx * nz
        length = math.sqrt(ox * ox + oy * oy + oz * oz)
        if abs(length - 1.0) > ROUNDING:
            ox, oy, oz = ox / length, oy / length, oz / length
        frames[k, 0, 0], frames[k, 1, 0], frames[k, 2, 0] = nx, ny, nz
        frames[k, 0, 1], frames[k, 1, 1], frames[k, 2, 1] = ox, oy, oz
        frames[k, 0, 2] = ny * oz - nz * oy
        frames[k, 1, 2] = nz * ox - nx * oz
        frames[k, 2, 2] = nx * oy - ny * ox
        x, y, z = positions[k]
        for axis in range(3):
            fx, fy, fz = frames[k, 0, axis], frames[k, 1, axis], frames[k, 2, axis]
            column = 3 * k + axis
            matrix[0, column], matrix[1, column], matrix[2, column] = fx, fy, fz
            matrix[3, column] = y * fz - z * fy
            matrix[4, column] = z * fx - x * fz
            matrix[5, column] = x * fy - y * fx
            for row in range(6):
                cone_matrix[row, column] = matrix[row, column] / cone_divisor[k, axis]

"""Compiled contact geometry for control loops; `contact.contact_frames` and `grasp.grasp_matrix` are the plain twins."""

from __future__ import annotations

import math

import numpy as np

from grasp_env._compile import compiled

TANGENT_SWITCH = 0.9
UNIT_TOLERANCE = 1e-6
"""Normals may miss unit length by this much; they are then normalised exactly."""
ROUNDING = 1e-15
"""Directions that miss unit length and orthogonality by no more are kept, so that a grasp made again keeps its bits."""


@compiled
def contact_geometry(positions, normals, cone_divisor, tangents):
    """Frames (N, 3, 3), G (6, 3N) and G in cone coordinates (6, 3N) of contacts (N, 3) with inward unit normals.

    cone_divisor: (N, 3), force = cone coordinates / cone_divisor. tangents: (N, 3), or (0, 3) for the default rule.
    """
    count = positions.shape[0]
    frames = np.empty((count, 3, 3))
    matrix = np.empty((6, 3 * count))
    cone_matrix = np.empty((6, 3 * count))
    write_contact_geometry(positions, normals, cone_divisor, tangents, frames, matrix, cone_matrix)
    return frames, matrix, cone_matrix


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


@compiled
def unit_frame(points):
    """(length, centre (3,), frame (6, 6)) of contact points (N, 3); see `Grasp`."""
    centre, frame = np.empty(3), np.empty((6, 6))
    return write_unit_frame(points, centre, frame), centre, frame


@compiled
def write_unit_frame(points, centre, frame):
    """`unit_frame` into given arrays; returns the length [m]."""
    count = max(points.shape[0], 1)
    centre[:] = 0.0
    for k in range(points.shape[0]):
        for a in range(3):
            centre[a] += points[k, a] / count
    square = 0.0
    for k in range(points.shape[0]):
        for a in range(3):
            square += (points[k, a] - centre[a]) ** 2
    length = math.sqrt(square / count)
    scale = 1.0 / length if length > 0.0 else 1.0
    frame[:] = 0.0
    for a in range(3):
        frame[a, a], frame[3 + a, 3 + a] = 1.0, scale
    x, y, z = centre
    # moment about the centre: M - c x F
    frame[3, 1], frame[3, 2] = scale * z, -scale * y
    frame[4, 0], frame[4, 2] = -scale * z, scale * x
    frame[5, 0], frame[5, 1] = scale * y, -scale * x
    return length


CLEAR_RANK = 1e-10
"""A lower bound of the least eigenvalue of G G^T over its trace that proves rank 6 whatever rounding did."""


@compiled
def is_clearly_full_rank(rows):
    """Whether (6, M) has rank 6 beyond doubt; where not, only its singular values can tell.

    det S <= least eigenvalue * (trace / 5)^5 for S = rows rows^T, so the pivots of S bound that eigenvalue from below.
    """
    s, trace = np.zeros((6, 6)), 0.0
    for i in range(6):
        for j in range(i + 1):
            total = 0.0
            for k in range(rows.shape[1]):
                total += rows[i, k] * rows[j, k]
            s[i, j] = total
        trace += s[i, i]
    bound = 1.0
    for j in range(6):
        pivot = s[j, j]
        if not pivot > 1e-13 * trace:
            return False
        bound *= pivot / (0.2 * trace)
        for i in range(j + 1, 6):
            factor = s[i, j] / pivot
            for k in range(j + 1, i + 1):
                s[i, k] -= factor * s[k, j]
    return 0.2 * bound > CLEAR_RANK


@compiled
def grasp_arrays(
    positions, normals, models, tangents, friction, frames, matrix, cone_matrix, torsion_matrix, centre, frame
):  # fmt: skip
    """Fills the arrays of a `Grasp` from `friction` on; returns its length, negative where its rank may not be 6.

    models: `ContactModels.packed`. tangents: as in `contact_geometry`.
    """
    count = positions.shape[0]
    divisor, soft = np.empty((count, 3)), 0
    for k in range(count):
        friction[k] = models[3, k] if models[0, k] > 0.0 else 0.0
        soft += 1 if models[2, k] > 0.0 else 0
        for a in range(3):
            divisor[k, a] = models[6 + a, k]
            torsion_matrix[a, k] = 0.0
            torsion_matrix[3 + a, k] = normals[k, a] if models[2, k] > 0.0 else 0.0
    write_contact_geometry(positions, normals, divisor, tangents, frames, matrix, cone_matrix)
    length = write_unit_frame(positions, centre, frame)
    rows = np.zeros((6, 3 * count + soft))
    column = 3 * count
    for k in range(count):
        for a in range(3):
            if models[3 + a, k] > 0.0:
                to_unit_frame(frame, matrix, 3 * k + a, rows, 3 * k + a)
        if models[2, k] > 0.0:
            to_unit_frame(frame, torsion_matrix, k, rows, column)
            column += 1
    return length if is_clearly_full_rank(rows) else -length


@compiled
def to_unit_frame(frame, source, column, target, place):
    """A column of `target` = frame (6, 6) of `unit_frame` times a column of `source`, without its zeros."""
    x, y, z = source[0, column], source[1, column], source[2, column]
    target[0, place], target[1, place], target[2, place] = x, y, z
    for i in range(3, 6):
        target[i, place] = frame[i, 0] * x + frame[i, 1] * y + frame[i, 2] * z + frame[i, i] * source[i, column]

"""Compiled contact geometry for control loops; `contact.contact_frames` and `grasp.grasp_matrix` are the plain twins."""

from __future__ import annotations

import math

import numpy as np

from grasp_env._compile import compiled

TANGENT_SWITCH = 0.9
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
    for k in range(count):
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
    return frames, matrix, cone_matrix


@compiled
def unit_frame(points):
    """(length, centre (3,), frame (6, 6)) of contact points (N, 3); see `Grasp`."""
    count = max(points.shape[0], 1)
    centre = np.zeros(3)
    for k in range(points.shape[0]):
        for a in range(3):
            centre[a] += points[k, a] / count
    square = 0.0
    for k in range(points.shape[0]):
        for a in range(3):
            square += (points[k, a] - centre[a]) ** 2
    length = math.sqrt(square / count)
    scale = 1.0 / length if length > 0.0 else 1.0
    frame = np.zeros((6, 6))
    for a in range(3):
        frame[a, a], frame[3 + a, 3 + a] = 1.0, scale
    x, y, z = centre
    # moment about the centre: M - c x F
    frame[3, 1], frame[3, 2] = scale * z, -scale * y
    frame[4, 0], frame[4, 2] = -scale * z, scale * x
    frame[5, 0], frame[5, 1] = scale * y, -scale * x
    return length, centre, frame

"""Surfaces of convex objects, compiled: the surface point nearest to a given one, its inward normal and the distance.

A spherical fingertip of radius r whose centre is at distance d touches where d = r, at the surface point nearest to the
centre. The axis of cylinders and capsules is y.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from grasp_env._compile import compiled

CUBOID, CYLINDER, SPHERE, CAPSULE, MESH = 0, 1, 2, 3, 4
KINDS = {"cuboid": CUBOID, "cylinder": CYLINDER, "sphere": SPHERE, "capsule": CAPSULE, "mesh": MESH}
"""Numbers of the shapes in a `Surface`."""

_TINY = 1e-280  # a squared length below it has lost its digits
_SHARP = 1e-9  # [m]; nearer to an edge of a mesh than this, rounding decides the direction


class Surface(NamedTuple):
    """A convex surface for the kernels, body frame; all arrays to be read only.

    Attributes:
        kind: One of `KINDS`.
        numbers: (4,) [m]. Cuboid: half sides x, y, z. Cylinder: radius, half height. Sphere: radius. Capsule: radius,
            half the length of its axis. The rest, and all of a mesh, is 0.
        triangles: (F, 3, 3) corners of a mesh's faces [m], seen from outside counterclockwise; F = 0 for other shapes.
        normals: (F, 3) their OUTWARD unit normals.
    """

    kind: int
    numbers: np.ndarray
    triangles: np.ndarray
    normals: np.ndarray


@compiled
def nearest(surface, center, point, normal):
    """Write the surface point nearest to `center` and the INWARD unit normal there; return the signed distance.

    Where several points are as near, as inside at the centre of a sphere, one of them is written. On edges the normal
    is the direction from `center` to them. Below 0.1 us for the primitives, 2 us for 400 faces.

    Args:
        surface: The object, a `Surface`.
        center: [m], (3,), body frame, finite.
        point: Output [m], (3,).
        normal: Output, (3,).

    Returns:
        The distance [m], below 0 inside.
    """
    if surface.kind == CUBOID:
        return _nearest_cuboid(surface.numbers, center, point, normal)
    if surface.kind == CYLINDER:
        return _nearest_cylinder(surface.numbers[0], surface.numbers[1], center, point, normal)
    if surface.kind == MESH:
        return _nearest_mesh(surface.triangles, surface.normals, center, point, normal)
    return _nearest_capsule(surface.numbers[0], surface.numbers[1], center, point, normal)


@compiled
def _nearest_cuboid(half, center, point, normal):
    squared, depth, axis = 0.0, -math.inf, 0
    for k in range(3):
        beyond = abs(center[k]) - half[k]
        if beyond > depth:
            depth, axis = beyond, k
        point[k] = min(max(center[k], -half[k]), half[k])
        normal[k] = point[k] - center[k]
        squared += normal[k] * normal[k]
    if squared > _TINY:
        distance = math.sqrt(squared)
        for k in range(3):
            normal[k] /= distance
        return distance
    side = math.copysign(1.0, center[axis])
    for k in range(3):
        normal[k] = 0.0
    normal[axis] = -side
    point[axis] = side * half[axis]
    return depth


@compiled
def _nearest_cylinder(radius, half, center, point, normal):
    x, y, z = center[0], center[1], center[2]
    away = math.sqrt(x * x + z * z)
    if away > 0.0:
        x, z = x / away, z / away
    else:
        x, z = 1.0, 0.0
    side, beyond, above = math.copysign(1.0, y), away - radius, abs(y) - half
    if beyond > 0.0 or above > 0.0:
        out, up = max(beyond, 0.0), max(above, 0.0)
        distance = math.sqrt(out * out + up * up)
        if distance > 0.0:
            out, up = out / distance, up / distance
        else:
            out, up = (1.0, 0.0) if beyond > above else (0.0, 1.0)
        point[0], point[1], point[2] = min(away, radius) * x, side * min(abs(y), half), min(away, radius) * z
    elif beyond >= above:
        distance, out, up = beyond, 1.0, 0.0
        point[0], point[1], point[2] = radius * x, y, radius * z
    else:
        distance, out, up = above, 0.0, 1.0
        point[0], point[1], point[2] = away * x, side * half, away * z
    normal[0], normal[1], normal[2] = -out * x, -up * side, -out * z
    return distance


@compiled
def _nearest_capsule(radius, half, center, point, normal):
    """Also of a sphere, whose axis has no length."""
    along = min(max(center[1], -half), half)
    x, y, z = center[0], center[1] - along, center[2]
    away = math.sqrt(x * x + y * y + z * z)
    if away > 0.0:
        x, y, z = x / away, y / away, z / away
    else:
        x, y, z = 1.0, 0.0, 0.0
    point[0], point[1], point[2] = radius * x, along + radius * y, radius * z
    normal[0], normal[1], normal[2] = -x, -y, -z
    return away - radius


@compiled
def _nearest_mesh(triangles, normals, center, point, normal):
    """The nearest point of a convex mesh lies on a face that the centre is outside of, if there is one."""
    x, y, z = center[0], center[1], center[2]
    highest, face = -math.inf, 0
    for f in range(len(normals)):
        height = _height(triangles, normals, f, x, y, z)
        if height > highest:
            highest, face = height, f
    if highest <= 0.0:
        for k in range(3):
            point[k], normal[k] = center[k] - highest * normals[face, k], -normals[face, k]
        return highest
    best, flat = math.inf, False
    # the highest face first: mostly it is the one, and no other can be nearer then
    first, f = face, face
    for turn in range(len(normals) + 1):
        if turn > 0:
            f = turn - 1
            if f == first:
                continue
        height = _height(triangles, normals, f, x, y, z)
        if height <= 0.0 or height * height >= best:
            continue
        p, q, r, inner = _nearest_in_triangle(triangles[f], x, y, z)
        squared = height * height if inner else (p - x) ** 2 + (q - y) ** 2 + (r - z) ** 2
        if squared < best:
            best, face, flat = squared, f, inner
            point[0], point[1], point[2] = p, q, r
    distance = math.sqrt(best)
    if flat or not distance > _SHARP:
        for k in range(3):
            normal[k] = -normals[face, k]
    else:
        for k in range(3):
            normal[k] = (point[k] - center[k]) / distance
    return distance


@compiled
def _height(triangles, normals, f, x, y, z):
    """Of a point over the plane of a face."""
    return (
        normals[f, 0] * (x - triangles[f, 0, 0])
        + normals[f, 1] * (y - triangles[f, 0, 1])
        + normals[f, 2] * (z - triangles[f, 0, 2])
    )


@compiled
def _nearest_in_triangle(corners, x, y, z):
    """Its coordinates, and whether it is inside; by the regions of the corners and edges (Ericson 2005, 5.1.5)."""
    ax, ay, az = corners[0, 0], corners[0, 1], corners[0, 2]
    bx, by, bz = corners[1, 0] - ax, corners[1, 1] - ay, corners[1, 2] - az
    cx, cy, cz = corners[2, 0] - ax, corners[2, 1] - ay, corners[2, 2] - az
    px, py, pz = x - ax, y - ay, z - az
    d1, d2 = bx * px + by * py + bz * pz, cx * px + cy * py + cz * pz
    if d1 <= 0.0 and d2 <= 0.0:
        return ax, ay, az, False
    bb, bc, cc = bx * bx + by * by + bz * bz, bx * cx + by * cy + bz * cz, cx * cx + cy * cy + cz * cz
    d3, d4 = d1 - bb, d2 - bc
    if d3 >= 0.0 and d4 <= d3:
        return ax + bx, ay + by, az + bz, False
    d5, d6 = d1 - bc, d2 - cc
    if d6 >= 0.0 and d5 <= d6:
        return ax + cx, ay + cy, az + cz, False
    on_ab = d1 * d4 - d3 * d2
    if on_ab <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        part = d1 / bb
        return ax + part * bx, ay + part * by, az + part * bz, False
    on_ac = d5 * d2 - d1 * d6
    if on_ac <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        part = d2 / cc
        return ax + part * cx, ay + part * cy, az + part * cz, False
    on_bc = d3 * d6 - d5 * d4
    if on_bc <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        part = (d4 - d3) / (d4 - d3 + d5 - d6)
        return ax + bx + part * (cx - bx), ay + by + part * (cy - by), az + bz + part * (cz - bz), False
    total = on_ab + on_ac + on_bc
    v, w = on_ac / total, on_ab / total
    return ax + v * bx + w * cx, ay + v * by + w * cy, az + v * bz + w * cz, True

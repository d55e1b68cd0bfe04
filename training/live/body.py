"""The object of bare contacts: a convex surface on which contacts lie and along which they are dragged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh

from grasp_env import core
from grasp_env._check import Array
from grasp_env.grasp import Grasp

SHAPES = ("box", "sphere", "cylinder")
_MARCH, _CLOSE = 64, 1e-4
"""Most steps of a ray towards the surface, and what of the body's extent counts as there."""
_THIN = 0.02
"""Of the extent: what flat contacts are thickened by, either way."""
_NO_FACES = np.zeros((0, 3, 3)), np.zeros((0, 3))


@dataclass(frozen=True, eq=False)
class Body:
    """A convex body in the object's frame.

    Attributes:
        name: a name in `SHAPES`, or "hull of the contacts".
        surface: its nearest points, in a frame turned by `turn`.
        turn: (3, 3) from the surface's frame to the object's.
        mesh: its looks, object frame [m].
        centre: (3,) of its box [m].
        extent: the longest side of its box [m].
    """

    name: str
    surface: core.Surface
    turn: Array
    mesh: trimesh.Trimesh
    centre: Array
    extent: float

    def nearest(self, point: Array) -> tuple[Array, Array, float]:
        """The nearest point of the surface [m], the inward unit normal there, and the distance [m], below 0 inside."""
        place, inward, distance = self.surface.nearest(np.ascontiguousarray(self.turn.T @ point))
        return self.turn @ place, self.turn @ inward, distance

    def under(self, eye: Array, through: Array) -> tuple[Array, Array]:
        """Where the ray from `eye` through a point meets the surface, else the surface's point nearest to the ray: place, normal."""
        along = (through - eye) / max(float(np.linalg.norm(through - eye)), 1e-12)
        # towards the surface by its distance; a convex body is never stepped over
        reach, best = 0.0, (np.inf, 0.0)
        for _ in range(_MARCH):
            distance = self.nearest(eye + reach * along)[2]
            if distance >= best[0] and best[0] < np.inf:
                break
            best = min(best, (distance, reach))
            if distance < _CLOSE * self.extent:
                break
            reach += distance
        at = eye + best[1] * along
        if best[0] > _CLOSE * self.extent:  # it misses: where it is nearest
            at = eye + float(np.clip(along @ (self.centre - eye), 0.0, None)) * along
        place, inward, _ = self.nearest(at)
        return place, inward

    def placed(self, count: int) -> tuple[Array, Array]:
        """Contacts (N, 3) and inward normals (N, 3): one against `count` - 1 on the other side."""
        around = 2.0 * np.pi * (np.arange(count - 1) / (count - 1)) + 0.5 * np.pi
        others = np.column_stack([0.62 * np.cos(around), 0.62 * np.sin(around), np.full(count - 1, 0.785)])
        found = [self.under(self.centre + 4.0 * self.extent * away, self.centre) for away in [np.array([0.0, 0.0, -1.0]), *others]]  # fmt: skip
        return np.array([place for place, _ in found]), np.array([inward for _, inward in found])


def shaped(shape: str, size: float, turn: Array | None = None) -> Body:
    """A box, sphere or cylinder (axis y) of that side or diameter [m]."""
    half = 0.5 * size
    turned = np.eye(3) if turn is None else turn
    if shape == "box":
        mesh, kind, numbers = trimesh.creation.box((size, size, size)), "cuboid", (half, half, half)
    elif shape == "sphere":
        mesh, kind, numbers = trimesh.creation.icosphere(4, half), "sphere", (half, 0.0, 0.0)
    else:
        mesh, kind, numbers = trimesh.creation.cylinder(half, size, sections=96), "cylinder", (half, half, 0.0)
        mesh.apply_transform(trimesh.transformations.rotation_matrix(0.5 * np.pi, (1.0, 0.0, 0.0)))
    mesh.vertices = mesh.vertices @ turned.T
    return Body(shape, core.Surface.make(kind, np.array(numbers), *_NO_FACES), turned, mesh, np.zeros(3), size)


def hull(grasp: Grasp) -> Body:
    """The convex hull of a grasp's contacts, thickened along their normals where they are flat."""
    away = _THIN * float(np.ptp(grasp.positions, axis=0).max())
    points = np.vstack([grasp.positions, grasp.positions + away * grasp.frames[:, :, 1], grasp.positions + away * grasp.frames[:, :, 2],
                        grasp.positions - away * grasp.frames[:, :, 1], grasp.positions - away * grasp.frames[:, :, 2]])  # fmt: skip
    mesh = trimesh.convex.convex_hull(points)
    surface = core.Surface.make("mesh", np.zeros(3), np.ascontiguousarray(mesh.triangles), np.ascontiguousarray(mesh.face_normals))  # fmt: skip
    low, high = mesh.bounds
    return Body("hull of the contacts", surface, np.eye(3), mesh, 0.5 * (low + high), float((high - low).max()))


def body_of(grasp: Grasp) -> Body:
    """The body that a grasp's contacts lie on: a box or a disc where they fit one, with inward normals, else their hull."""
    size = 2.0 * float(np.abs(grasp.positions).max())
    upright = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    for candidate in (
        shaped("box", size),
        shaped("sphere", size),
        shaped("cylinder", size),
        shaped("cylinder", size, upright),
    ):
        near = [
            candidate.nearest(point + 1e-3 * size * -normal)
            for point, normal in zip(grasp.positions, grasp.normals, strict=True)
        ]
        fits = [np.linalg.norm(place - point) < 1e-6 * size and inward @ normal > 0.999999
                for (place, inward, _), point, normal in zip(near, grasp.positions, grasp.normals, strict=True)]  # fmt: skip
        if all(fits):
            return candidate
    return hull(grasp)

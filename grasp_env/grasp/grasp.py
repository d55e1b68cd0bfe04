"""`Grasp`: contacts on an object and the linear maps between their forces and the object's wrench."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from grasp_env._check import Array, ContactForces, Wrench, as_array
from grasp_env.errors import InvalidInputError, RankDeficientGraspError
from grasp_env.grasp.kernels import contact_geometry

UNIT_TOLERANCE = 1e-6
"""Normals may miss unit length by this much; they are then normalised exactly."""
RANK_TOLERANCE = 1e-8
"""Least ratio of singular values of G (moments divided by the grasp's length) that counts as rank 6."""


@dataclass(frozen=True, eq=False)
class Grasp:
    """Point contacts with friction on a rigid object. Make one with `Grasp.from_contacts`.

    Balance is G f + w = 0 (paper, Eq. 2) with w the external wrench ON the object and f the stacked contact
    forces (normal, o, t), each finger's force ON the object.

    Attributes:
        positions: (N, 3) contact points [m], object frame.
        normals: (N, 3) inward unit normals, object frame.
        friction: (N,) Coulomb coefficients > 0.
        frames: (N, 3, 3) columns (n, o, t) in object coordinates.
        matrix: G, (6, 3N), columns (normal, o, t) per contact.
        length: [m] root mean square distance of the contacts from their centre; scales moments.
    """

    positions: Array
    normals: Array
    friction: Array
    frames: Array = field(repr=False)
    matrix: Array = field(repr=False)
    length: float = field(repr=False)
    pseudoinverse: Array = field(repr=False)
    """G^+, (3N, 6): the least-norm forces that make a unit wrench."""
    cone_matrix: Array = field(repr=False)
    """G in cone coordinates x = (u, o, t), u = mu * normal: (6, 3N); cone_matrix @ x = matrix @ f."""

    @classmethod
    def from_contacts(cls, positions: ArrayLike, normals: ArrayLike, friction: ArrayLike) -> Grasp:
        """Builds a grasp from contact geometry.

        Args:
            positions: (N, 3) contact points [m], object frame.
            normals: (N, 3) unit normals pointing INTO the object, object frame.
            friction: coefficient(s) > 0, a scalar or (N,).

        Raises:
            InvalidInputError: wrong shapes, non-finite values, normals not of unit length, friction <= 0.
            RankDeficientGraspError: rank(G) < 6 (fewer than three contacts, or all on one line).

        Example:
            >>> from grasp_env.grasp import presets
            >>> g = presets.paper_cuboid()
            >>> Grasp.from_contacts(g.positions, g.normals, 0.4).matrix.shape
            (6, 12)
        """
        points: Array = as_array(positions, (None, 3), "positions")
        inward: Array = as_array(normals, (len(points), 3), "normals")
        coefficients = _friction(friction, len(points))
        lengths = np.sqrt(np.einsum("ij,ij->i", inward, inward))
        off = np.abs(lengths - 1.0)
        if off.size and off.max() > UNIT_TOLERANCE:
            worst = int(off.argmax())
            raise InvalidInputError(
                f"normals must be unit vectors into the object; normal {worst} is {inward[worst].tolist()} with "
                f"length {lengths[worst]:.6g}: divide it by its length"
            )
        inward = inward / lengths[:, None]
        frames, matrix, cone_matrix = contact_geometry(points, inward, coefficients)
        centre = points.mean(axis=0) if len(points) else np.zeros(3)
        length = float(np.sqrt(((points - centre) ** 2).sum() / len(points))) if len(points) else 0.0
        pseudoinverse = _checked_pseudoinverse(matrix, length, len(points))
        for array in (points, inward, coefficients, frames, matrix, pseudoinverse, cone_matrix):
            array.flags.writeable = False
        return cls(points, inward, coefficients, frames, matrix, length, pseudoinverse, cone_matrix)

    @property
    def n_contacts(self) -> int:
        """N, the number of contacts."""
        return self.positions.shape[0]

    @property
    def null_dimension(self) -> int:
        """3N - 6, the number of independent internal forces."""
        return 3 * self.n_contacts - 6

    def with_friction(self, friction: ArrayLike) -> Grasp:
        """The same contacts with other friction coefficients, a scalar or (N,)."""
        return Grasp.from_contacts(self.positions, self.normals, friction)

    def wrench(self, force: ContactForces) -> Wrench:
        """The wrench (6,) [N, N m] that contact forces (N, 3) exert on the object: G f."""
        return self.matrix @ as_array(force, (self.n_contacts, 3), "force").reshape(-1)

    def residual(self, force: ContactForces, wrench: Wrench) -> float:
        """Largest |component| of G f + w, moments divided by `length` [N]."""
        error = self.matrix @ np.asarray(force).reshape(-1) + wrench
        error[3:] /= self.length
        return float(np.abs(error).max())

    def to_object_frame(self, force: ContactForces) -> Array:
        """Contact-frame forces (N, 3) -> object-frame vectors (N, 3) [N]."""
        return np.einsum("nij,nj->ni", self.frames, force)

    def to_contact_frame(self, vectors: Array) -> ContactForces:
        """Object-frame vectors (N, 3) [N] -> contact-frame forces (normal, o, t)."""
        return np.einsum("nji,nj->ni", self.frames, vectors)


def grasp_matrix(positions: Array, frames: Array) -> Array:
    """G, (6, 3N): per contact the force columns over the moment columns p x R.

    Args:
        positions: (N, 3) contact points [m].
        frames: (N, 3, 3) columns (n, o, t).
    """
    x, y, z = positions.T[:, :, None]
    fx, fy, fz = frames[:, 0, :], frames[:, 1, :], frames[:, 2, :]
    moments = np.stack([y * fz - z * fy, z * fx - x * fz, x * fy - y * fx], axis=0)
    forces = np.stack([fx, fy, fz], axis=0)
    return np.concatenate([forces, moments], axis=0).reshape(6, -1)


def _friction(value: ArrayLike, count: int) -> Array:
    scalar = np.ndim(value) == 0
    friction = np.full(count, as_array(value, (), "friction")) if scalar else as_array(value, (count,), "friction")
    if (friction <= 0.0).any():
        raise InvalidInputError(f"friction must be > 0 at every contact, got {friction.tolist()}")
    return friction


def _checked_pseudoinverse(matrix: Array, length: float, count: int) -> Array:
    scale = np.ones(6)
    scale[3:] = length if length > 0.0 else 1.0
    u, s, vt = np.linalg.svd(matrix / scale[:, None], full_matrices=False)
    if len(s) < 6 or s[-1] < RANK_TOLERANCE * s[0]:
        rank = int((s > RANK_TOLERANCE * s.max(initial=1e-300)).sum())
        raise RankDeficientGraspError(
            f"rank(G) = {rank} < 6 with {count} contacts: some wrenches cannot be balanced. Use at least three "
            "contacts that do not lie on one line"
        )
    # Least norm in force: scaling the rows of G does not change G^+ up to the same column scaling (full row rank).
    return (vt.T / s) @ u.T / scale[None, :]

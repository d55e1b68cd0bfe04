"""Inertias of rigid bodies as ixx, ixy, ixz, iyy, iyz, izz about the centre of mass [kg m^2]."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np

from grasp_env.errors import InvalidInputError
from grasp_env.inputs.arguments import Array
from grasp_env.sim.hand.check import numbers

Inertia: TypeAlias = tuple[float, float, float, float, float, float]


def inertia_of(values: Any, name: str) -> Inertia:
    """Return the inertia of a body that can exist, positive and no principal moment above the sum
    of the others, or raise an error.
    """
    given = numbers(values, 6, f"{name}: inertia")
    moments = np.linalg.eigvalsh(inertia_matrix(given))
    if moments[0] <= 0.0:
        raise InvalidInputError(
            f"{name}: inertia={given} has the principal moments {moments.tolist()} kg m^2, all must be above 0; "
            "give ixx, ixy, ixz, iyy, iyz, izz about the centre of mass"
        )
    if moments[2] >= moments[0] + moments[1]:
        raise InvalidInputError(
            f"{name}: inertia={given} has the principal moments {moments.tolist()} kg m^2; in a body the largest is "
            "below the sum of the other two. Check units, signs and that it is about the centre of mass"
        )
    xx, xy, xz, yy, yz, zz = given
    return xx, xy, xz, yy, yz, zz


def nearest_inertia(values: Inertia, mass: float) -> Inertia | None:
    """Return the nearest inertia that a body of this mass [kg] can have; None if the given one is
    possible. Gyration is at least 1 mm.
    """
    from scipy.optimize import nnls

    moments, axes = np.linalg.eigh(inertia_matrix(values))
    if moments[0] > 0.0 and moments[2] < moments[0] + moments[1]:
        return None
    least = max(mass * 1e-6, 1e-3 * float(moments[2]))
    # moments are sums of the second moments along the other two axes
    sums = np.ones((3, 3)) - np.eye(3)
    seconds = nnls(sums, moments - 2.0 * least)[0] + least
    return inertia_numbers((axes * (sums @ seconds)) @ axes.T)


def inertia_matrix(values: Sequence[float]) -> Array:
    """Return the matrix (3, 3) of ixx, ixy, ixz, iyy, iyz, izz."""
    xx, xy, xz, yy, yz, zz = values
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def inertia_numbers(matrix: Array) -> Inertia:
    """Return ixx, ixy, ixz, iyy, iyz, izz of a matrix (3, 3)."""
    xx, xy, xz = matrix[0].tolist()
    return xx, xy, xz, float(matrix[1, 1]), float(matrix[1, 2]), float(matrix[2, 2])


def with_rotor(values: Inertia, rotor: float) -> Inertia:
    """Return an inertia plus that of a rotor [kg m^2] about all axes, see
    `HandDescription.with_rotors`.
    """
    return inertia_numbers(inertia_matrix(values) + rotor * np.eye(3))

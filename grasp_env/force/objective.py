"""Phi = tr(W_p P) + tr(W_i P^-1), its derivatives and its dual bound, from the core."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grasp_env import core
from grasp_env.errors import InvalidInputError, shown
from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import AllFaults, Array, as_array, instance, positive, whole

Weight = float | Sequence[float]
"""One weight for all contacts, or one per contact (the diagonal blocks of W_p, W_i)."""


@dataclass(frozen=True)
class Objective:
    """The paper's objective, Eqs. 10 and 27-31, with W_p = omega I and W_i = lambda I.

    Per contact, in cone coordinates (u, o, t) and with s^2 = o^2 + t^2, it is
    3 omega u + lambda (1/u + 2u/(u^2 - s^2)). (The second trace is of W_i P^-1; Eqs. 10, 27 and 29
    print W_p.)

    Attributes:
        force_weight: omega, the weight of the forces, 1e-4 to 1e4; a scalar, or one value per
            contact.
        barrier_weight: lambda, the weight of the barrier at the cones, in N^2 when force_weight is
            1, 1e-16 to 1e6; a scalar, or one value per contact.

    Raises:
        InvalidInputError: weights that are not numbers, or out of range.
    """

    force_weight: Weight = 1.0
    barrier_weight: Weight = 0.01

    def __post_init__(self) -> None:
        with AllFaults() as check:
            omega = check(_weight, self.force_weight, "force_weight", ranges.FORCE_WEIGHT)
            lam = check(_weight, self.barrier_weight, "barrier_weight", ranges.BARRIER_WEIGHT)
        object.__setattr__(self, "force_weight", omega)
        object.__setattr__(self, "barrier_weight", lam)

    def weights(self, count: int) -> Array:
        """Return (N, 2) omega and lambda of each of `count` contacts.

        Raises:
            InvalidInputError: weights for another number of contacts.
        """
        count = whole(count, "count", 0, ranges.SIDE_BY_SIDE)
        out = np.empty((count, 2))
        for column, name in enumerate(("force_weight", "barrier_weight")):
            value = getattr(self, name)
            if np.ndim(value) == 1 and len(value) != count:
                raise InvalidInputError(
                    f"{name} has {len(value)} entries, the grasp {count} contacts: give one or {count}"
                )
            out[:, column] = value
        return out

    def value(self, x: Array) -> float:
        """Return Phi at flat cone coordinates `x` (3N,); +inf for nan and not strictly inside.

        Example:
            >>> round(Objective(1.0, 0.01).value(np.array([0.5, 0.0, 0.0])), 12)
            1.56
        """
        rows = _contacts(x, finite=False)
        return core.phi(rows, self.weights(len(rows)))

    def gradient(self, x: Array) -> Array:
        """Return the gradient of Phi (3N,) at cone coordinates `x` strictly inside the cones."""
        rows = _contacts(x, inside=True)
        out = np.empty_like(rows)
        core.phi_gradient(rows, self.weights(len(rows)), out)
        return out.reshape(-1)

    def hessian(self, x: Array) -> Array:
        """Return the Hessian blocks (N, 3, 3) of Phi at cone coordinates `x` inside the cones."""
        rows = _contacts(x, inside=True)
        out = np.empty((len(rows), 3, 3))
        core.phi_hessian(rows, self.weights(len(rows)), out)
        return out

    def lower_bound(self, multipliers: Array, cone_matrix: Array, wrench: Array) -> float:
        """Return a lower bound of Phi over forces that balance `wrench` (6,), or -inf.

        It is the dual value at the `multipliers` nu (6,); at the optimum grad Phi = G^T nu, with G
        in cone coordinates, `cone_matrix` (6, 3N).
        """
        nu = as_array(multipliers, (6,), "multipliers", ranges.SIZE)
        load = as_array(wrench, (6,), "wrench", ranges.SIZE)
        y = _contacts(as_array(cone_matrix, (6, None), "cone_matrix", ranges.SIZE).T @ nu)
        return core.phi_lower_bound(y, self.weights(len(y))) - float(nu @ load)


def _contacts(x: Array, inside: bool = False, finite: bool = True) -> Array:
    """Return flat cone coordinates as (N, 3)."""
    numbers = as_array(x, None, "x", ranges.SIZE if finite else None, finite=finite)
    if numbers.size % 3 or not 1 <= numbers.size // 3 <= ranges.SIDE_BY_SIDE:
        raise InvalidInputError(
            f"x must have shape (3N,) for at least one contact, got {numbers.shape}"
        )
    rows = numbers.reshape(-1, 3)
    if inside and not (rows[:, 0] * (1.0 - 1e-15) > np.hypot(rows[:, 1], rows[:, 2])).all():
        raise InvalidInputError(
            f"x must lie strictly inside the cones, u > |(o, t)| at every contact, got {shown(numbers)}"
        )
    if inside and not (rows[:, 0] > 1e-30).all():
        raise InvalidInputError(f"x must have u > 1e-30 N at every contact, got {shown(numbers)}")
    return rows


def _weight(value: Weight, name: str, within: ranges.Range) -> Weight:
    """Return a weight within its range, or one per contact as a tuple."""
    if not isinstance(value, list | tuple | range) and not (
        isinstance(value, np.ndarray) and value.ndim
    ):
        return positive(value, name, within)
    weights = as_array(value, (None,), name).tolist()
    with AllFaults() as check:
        return tuple(
            check(positive, value, f"{name}[{k}]", within) for k, value in enumerate(weights)
        )


def as_objective(value: object) -> Objective:
    """Return a checked `Objective`, the default one for None."""
    return Objective() if value is None else instance(value, Objective, "objective")

"""Phi = tr(W_p P) + tr(W_i P^-1), its derivatives and its dual bound, from the core."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from grasp_env import core
from grasp_env.errors import InvalidInputError, shown
from grasp_env.grasp.grasp import Grasp
from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import (
    AllFaults,
    Array,
    ContactForces,
    as_array,
    instance,
    positive,
    whole,
)

Weight = float | Sequence[float]
"""One weight for all contacts, or one per contact (the diagonal blocks of W_p, W_i)."""


@dataclass(frozen=True)
class Objective:
    """The paper's objective, Eqs. 10 and 27-31, with W_p = omega I and W_i = lambda I.

    A contact has k tangential parts in cone coordinates: none without friction, (o, t) of a hard
    contact, (o, t, v) of a soft one. With s^2 the sum of their squares, its part of Phi is
    3 omega u + lambda ((k - 1)/u + 2u/(u^2 - s^2)). The barrier is the trace of W_i P^-1, P the
    arrow matrix with u on its diagonal and the tangential parts beside it (Eqs. 10, 27 and 29 print
    W_p); the price of u is that of hard contacts, the paper's, for all.

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

    def of(self, grasp: Grasp, force: ContactForces, torsion: ArrayLike | None = None) -> float:
        """Return Phi of `force` (N, 3) [N] and `torsion` (N,) [N m] on a grasp.

        It is +inf unless they are strictly inside the cones.

        Example:
            >>> from grasp_env.grasp import presets
            >>> round(Objective().of(presets.tripod(), [[2.0, 0, 0]] * 3), 12)
            9.09
        """
        if torsion is None and not grasp.hard:
            torsion = np.zeros(grasp.n_contacts)
        return self.value(grasp.to_cone(force, torsion), grasp.models.tangential)

    def value(self, x: Array, tangential: ArrayLike | None = None) -> float:
        """Return Phi at flat cone coordinates `x`; +inf for nan and not strictly inside.

        Args:
            x: (3N,), or (4N,) with the torsions v; see `Grasp.to_cone`.
            tangential: (N,) numbers k of tangential parts, `grasp.models.tangential`; None: 2, all
                contacts are hard. `gradient`, `hessian` and `lower_bound` take the same.

        Example:
            >>> round(Objective(1.0, 0.01).value(np.array([0.5, 0.0, 0.0])), 12)
            1.56
        """
        return core.phi(*self._contacts(x, tangential, finite=False))

    def gradient(self, x: Array, tangential: ArrayLike | None = None) -> Array:
        """Return the gradient of Phi, shaped as `x`, strictly inside the cones.

        `x` and `tangential` are those of `value`.
        """
        rows, weights = self._contacts(x, tangential, inside=True)
        out = np.empty_like(rows)
        core.phi_gradient(rows, weights, out)
        return out.reshape(-1)

    def hessian(self, x: Array, tangential: ArrayLike | None = None) -> Array:
        """Return the Hessian blocks (N, 3, 3) or (N, 4, 4) of Phi inside the cones.

        `x` and `tangential` are those of `value`.
        """
        rows, weights = self._contacts(x, tangential, inside=True)
        out = np.empty((*rows.shape, rows.shape[1]))
        core.phi_hessian(rows, weights, out)
        return out

    def lower_bound(
        self,
        multipliers: Array,
        cone_matrix: Array,
        wrench: Array,
        tangential: ArrayLike | None = None,
    ) -> float:
        """Return a lower bound of Phi over forces that balance `wrench` (6,), or -inf.

        It is the dual value at the `multipliers` nu (6,); at the optimum grad Phi = G^T nu, with G
        in cone coordinates, `cone_matrix` (6, 3N) or (6, 4N). `tangential` is that of `value`.
        """
        nu = as_array(multipliers, (6,), "multipliers", ranges.SIZE)
        load = as_array(wrench, (6,), "wrench", ranges.SIZE)
        matrix = as_array(cone_matrix, (6, None), "cone_matrix", ranges.SIZE)
        return core.phi_lower_bound(*self._contacts(matrix.T @ nu, tangential)) - float(nu @ load)

    def _contacts(
        self,
        x: Array,
        tangential: ArrayLike | None,
        inside: bool = False,
        finite: bool = True,
    ) -> tuple[Array, Array]:
        """Return flat cone coordinates by contact, (N, 3) or (N, 4), and weights (N, 3)."""
        numbers = as_array(x, None, "x", ranges.SIZE if finite else None, finite=finite)
        parts = None if tangential is None else as_array(tangential, (None,), "tangential")
        count = numbers.size // 3 if parts is None else len(parts)
        allowed = (3 * count,) if parts is None else (3 * count, 4 * count)
        if not 1 <= count <= ranges.SIDE_BY_SIDE or numbers.size not in allowed:
            raise InvalidInputError(
                "x must have 3 numbers for each contact, or 4 with torsion and the contacts' tangential parts, and at least "
                f"one contact; got {numbers.shape}"
            )
        if parts is None:
            parts = np.full(count, 2.0)
        elif not np.isin(parts, (0, 1, 2, 3)).all():
            raise InvalidInputError(f"tangential must be 0, 1, 2 or 3, got {shown(parts)}")
        rows = numbers.reshape(count, -1)
        length = np.sqrt((rows[:, 1:] ** 2).sum(axis=1)) if inside else 0.0
        if inside and not (rows[:, 0] * (1.0 - 1e-15) > length).all():
            raise InvalidInputError(
                f"x must lie strictly inside the cones, u > |(o, t, ..)| at every contact, got {shown(numbers)}"
            )
        if inside and not (rows[:, 0] > 1e-30).all():
            raise InvalidInputError(
                f"x must have u > 1e-30 N at every contact, got {shown(numbers)}"
            )
        return rows, np.column_stack([self.weights(count), parts - 1.0])


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

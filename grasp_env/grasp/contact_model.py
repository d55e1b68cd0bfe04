"""Contact models: transmitted components, and the scaling that makes friction cones round.

| model | transmits | limits |
|---|---|---|
| hard | normal, o, t | (o / mu_o)^2 + (t / mu_t)^2 <= normal^2; mu_o = mu_t is Coulomb's round cone |
| soft | normal, o, t, torsion about the normal | (o / mu_o)^2 + (t / mu_t)^2 + (torsion / gamma)^2 <= normal^2 (Howe and Cutkosky 1996) |
| frictionless | normal | normal >= 0 |

In cone coordinates x = (u, o', t', v), with u = mu * normal, mu = sqrt(mu_o mu_t), o' = o mu / mu_o,
t' = t mu / mu_t and v = torsion mu / gamma, every friction cone is u >= sqrt(o'^2 + t'^2 + v^2). A
frictionless contact has u = normal and o' = t' = 0. Contacts that are not soft have v = 0.

A soft contact with gamma = 0 is a hard one. The forces of the exact problem are continuous there:
as gamma vanishes, so does the torsion. Phi is not: its barrier counts the tangential parts, 3 of a
soft contact however small gamma is, 2 of a hard one, and 0 of a frictionless one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from grasp_env import core
from grasp_env.errors import InvalidInputError, shown
from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import Array, as_array, choice

CONTACT_MODELS = ("hard", "soft", "frictionless")
"""Names of the contact models."""


@dataclass(frozen=True, eq=False)
class ContactModels:
    """Checked models, friction and scalings of N contacts.

    Attributes:
        names: N names from `CONTACT_MODELS`.
        friction: (N, 2) mu_o, mu_t; 0 for frictionless contacts.
        torsional_friction: (N,) gamma [m]; 0 unless soft, and a soft contact with 0 is a hard one.
        cone_scale: (N, 3) cone coordinates = cone_scale * force.
        cone_divisor: (N, 3) force = cone coordinates / cone_divisor; inf for components that are
            not transmitted.
    """

    names: tuple[str, ...]
    friction: Array
    torsional_friction: Array
    cone_scale: Array
    cone_divisor: Array

    @classmethod
    def checked(
        cls,
        models: str | Sequence[str],
        friction: ArrayLike,
        torsional_friction: ArrayLike | None,
        count: int,
    ) -> ContactModels:
        """Check the models of `count` contacts; see `Grasp.from_contacts`."""
        within = ranges.FRICTION
        if (
            isinstance(models, str)
            and models == "hard"
            and torsional_friction is None
            and type(friction) is float
            and within.low <= friction <= within.high
        ):
            # a control loop's new contacts
            return cls._from_arrays(
                ("hard",) * count, np.full((count, 2), friction), np.zeros(count)
            )
        if isinstance(models, np.ndarray) and models.ndim == 1 and len(models) == count:
            models = models.tolist()
        listed = [models] * count if isinstance(models, str) else models
        if not isinstance(listed, list | tuple) or len(listed) != count:
            got = len(listed) if isinstance(listed, list | tuple) else shown(models)
            raise InvalidInputError(f"contact_model must be one name or {count} of them, got {got}")
        names = tuple(choice(name, "contact model", CONTACT_MODELS) for name in listed)
        mu = _friction(friction, np.array([name != "frictionless" for name in names], dtype=bool))
        gamma = _torsional(
            torsional_friction, np.array([name == "soft" for name in names], dtype=bool)
        )
        return cls._from_arrays(names, mu, gamma)

    @classmethod
    def _from_arrays(cls, names: tuple[str, ...], mu: Array, gamma: Array) -> ContactModels:
        cone_scale = np.empty((len(names), 3))
        core.cone_scale(mu, cone_scale)
        # dividing by the factor that multiplied returns a force to the last bit; x / inf = 0
        arrays = mu, gamma, cone_scale, np.where(cone_scale > 0.0, cone_scale, np.inf)
        for array in arrays:
            array.setflags(write=False)
        return cls(names, *arrays)

    def other_friction(self, friction: ArrayLike, used: np.ndarray | None = None) -> Array:
        """Return (N, 2) other coefficients for the same contacts, from a scalar, (N,) or (N, 2).

        They are 0 for frictionless contacts, and for those that a mask `used` (N,) leaves out.
        """
        rough = self.friction[:, 0] > 0.0
        if used is None:
            return _friction(friction, rough)
        return _friction(friction, rough & used, finite=False)

    @cached_property
    def transmitted(self) -> np.ndarray:
        """(N, 3) bool: the transmitted force components (normal, o, t)."""
        sent = self.cone_scale > 0.0
        sent.setflags(write=False)
        return sent

    @cached_property
    def tangential(self) -> Array:
        """(N,) number of tangential parts: 0 without friction, 2 with it, 1 more with torsion."""
        parts = self.transmitted[:, 1:].sum(axis=1) + (self.torsional_friction > 0.0)
        parts = parts.astype(float)
        parts.setflags(write=False)
        return parts

    @cached_property
    def torsion_scale(self) -> Array:
        """(N,) v = torsion_scale * torsion [1 / m]; 0 for contacts without torsion."""
        gamma = self.torsional_friction
        scale = self.cone_scale[:, 0] * (gamma > 0.0) / np.where(gamma > 0.0, gamma, 1.0)
        scale.setflags(write=False)
        return scale

    @cached_property
    def mean_friction(self) -> Array:
        """(N,) sqrt(mu_o mu_t); 0 for frictionless contacts."""
        mean = self.cone_scale[:, 0] * (self.friction[:, 0] > 0.0)
        mean.setflags(write=False)
        return mean


def _friction(value: ArrayLike, rough: np.ndarray, finite: bool = True) -> Array:
    """Return coefficients (N, 2), 0 for contacts that are not `rough` (N,)."""
    count = len(rough)
    shapes = (), (count,), (count, 2)
    where = "at every contact that is not frictionless"
    return _per_contact(value, "friction", shapes, rough, ranges.FRICTION, where, finite)


def _torsional(value: ArrayLike | None, soft: np.ndarray) -> Array:
    """Return gamma (N,), 0 for contacts that are not `soft` (N,)."""
    if value is None and not soft.any():
        return np.zeros(len(soft))
    if value is None:
        raise InvalidInputError(
            "soft contacts need torsional_friction, the largest torsion over the normal force [m], a scalar or (N,); "
            "about 0.005 for a fingertip with a contact patch of 1 cm radius"
        )
    within, shapes = ranges.TORSIONAL_FRICTION, ((), soft.shape)
    gamma = as_array(value, None, "torsional_friction")
    turning = soft & (gamma != 0.0) if gamma.shape in shapes else soft
    where = "at every soft contact, or be 0"
    return _per_contact(gamma, "torsional_friction", shapes, turning, within, where)


def _per_contact(
    value: ArrayLike,
    name: str,
    shapes: tuple[tuple[int, ...], ...],
    used: np.ndarray,
    within: ranges.Range,
    where: str,
    finite: bool = True,
) -> Array:
    """Return numbers in the last of some shapes, checked for contacts `used` (N,), else 0."""
    numbers = as_array(value, None, name, finite=finite)
    if numbers.shape not in shapes:
        raise InvalidInputError(
            f"{name} must have shape {' or '.join(map(str, shapes))}, got {numbers.shape}"
        )
    rows = numbers[:, None] if numbers.ndim == 1 and len(shapes[-1]) == 2 else numbers
    full = np.array(np.broadcast_to(rows, shapes[-1]), order="C")
    if not ((full >= within.low) & (full <= within.high))[used].all():
        raise InvalidInputError(f"{name} must lie within {within} {where}, got {shown(numbers)}")
    full[~used] = 0.0
    return full

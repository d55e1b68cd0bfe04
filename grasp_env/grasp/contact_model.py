"""Contact models: the components that a contact transmits, and the scaling that makes every friction cone round.

| model | transmits | limits |
|---|---|---|
| hard | normal, o, t | (o / mu_o)^2 + (t / mu_t)^2 <= normal^2; mu_o = mu_t is Coulomb's round cone |
| soft | normal, o, t, torsion about the normal | the same, and abs(torsion) <= gamma * normal (Murray, Li, Sastry 1994, Sec. 5.2) |
| frictionless | normal | normal >= 0 |

In cone coordinates x = (u, o', t'), with u = mu * normal, mu = sqrt(mu_o mu_t), o' = o mu / mu_o and t' = t mu / mu_t, every
friction cone is u >= sqrt(o'^2 + t'^2). A frictionless contact has u = normal and o' = t' = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from grasp_env import core, ranges
from grasp_env._check import Array, as_array, as_list, as_text, choice
from grasp_env.errors import InvalidInputError, shown

CONTACT_MODELS = ("hard", "soft", "frictionless")
"""Names of the contact models."""


@dataclass(frozen=True, eq=False)
class ContactModels:
    """Checked models, friction and scalings of N contacts.

    Attributes:
        names: N names from `CONTACT_MODELS`.
        friction: (N, 2) mu_o, mu_t; 0 for frictionless contacts.
        torsional_friction: (N,) gamma [m]; 0 unless soft.
        cone_scale: (N, 3) cone coordinates = cone_scale * force.
        cone_divisor: (N, 3) force = cone coordinates / cone_divisor; inf for components that are not transmitted.
    """

    names: tuple[str, ...]
    friction: Array
    torsional_friction: Array
    cone_scale: Array
    cone_divisor: Array

    @classmethod
    def checked(
        cls, models: str | Sequence[str], friction: ArrayLike, torsional_friction: ArrayLike | None, count: int
    ) -> ContactModels:
        """Check the models of `count` contacts; see `Grasp.from_contacts` for the arguments and errors."""
        plain = type(friction) is float and ranges.FRICTION.low <= friction <= ranges.FRICTION.high
        named = as_text(models)
        if named == "hard" and torsional_friction is None and (plain or _dimensions(friction) < 2):
            # fast path for control loops: round cones at every contact
            coefficient = friction
            if not plain:
                coefficient = _friction_array(friction, (count,) if _dimensions(friction) else ())
            mu, scale = np.empty((count, 2)), np.empty((count, 3))
            mu[:, 0] = mu[:, 1] = coefficient
            core.cone_scale(mu, scale)
            return cls(("hard",) * count, mu, np.zeros(count), scale, scale.copy())._frozen()
        if isinstance(models, np.ndarray) and models.ndim == 1 and len(models) == count:
            models = models.tolist()
        each = [named] * count if named is not None else as_list(models)
        if each is None or len(each) != count:
            given = shown(models) if each is None else len(each)
            raise InvalidInputError(f"contact_model must be one name or {count} of them, got {given}")
        names = tuple(choice(name, "contact model", CONTACT_MODELS) for name in each)
        rough = np.array([name != "frictionless" for name in names], dtype=bool)
        soft = np.array([name == "soft" for name in names], dtype=bool)
        mu = _friction(friction, count, rough)
        gamma = _torsional(torsional_friction, count, soft)
        cone_scale = np.empty((count, 3))
        core.cone_scale(np.ascontiguousarray(mu), cone_scale)
        # dividing by the factor that multiplied returns a force to the last bit; x / inf = 0
        cone_divisor = np.where(cone_scale > 0.0, cone_scale, np.inf)
        return cls(names, mu, gamma, cone_scale, cone_divisor)._frozen()

    def other_friction(self, friction: ArrayLike) -> Array:
        """Return (N, 2) other coefficients for the same contacts, from a scalar, (N,) or (N, 2); 0 for frictionless ones.

        Raises:
            InvalidInputError: see `Grasp.from_contacts`.
        """
        return np.ascontiguousarray(_friction(friction, len(self.names), self.friction[:, 0] > 0.0))

    @cached_property
    def mean_friction(self) -> Array:
        """(N,) sqrt(mu_o mu_t); 0 for frictionless contacts. Read-only and shared by all grasps with these models."""
        mean = self.cone_scale[:, 0] * (self.friction[:, 0] > 0.0)
        mean.setflags(write=False)
        return mean

    def _frozen(self) -> ContactModels:
        for array in (self.friction, self.torsional_friction, self.cone_scale, self.cone_divisor):
            array.setflags(False)  # pyright: ignore[reportCallIssue]
        return self


def _friction(value: ArrayLike, count: int, rough: np.ndarray) -> Array:
    shape = {0: (), 2: (count, 2)}.get(_dimensions(value), (count,))
    mu = _friction_array(value, shape, rough)
    mu = np.array(np.broadcast_to(mu[:, None] if len(shape) == 1 else mu, (count, 2)))
    mu[~rough] = 0.0
    return mu


def _friction_array(value: ArrayLike, shape: tuple[int, ...], rough: np.ndarray | None = None) -> Array:
    """Return coefficients, checked for the contacts that are `rough`; None: for all."""
    mu = as_array(value, shape, "friction")
    felt = mu if rough is None or not shape else mu[rough]
    if rough is not None and not rough.any():
        return mu
    if not (felt > 0.0).all():
        raise InvalidInputError(f"friction must be > 0 at every contact that is not frictionless, got {shown(mu)}")
    if not ((felt >= ranges.FRICTION.low) & (felt <= ranges.FRICTION.high)).all():
        raise InvalidInputError(f"friction must lie within {ranges.FRICTION}, got {shown(mu)}")
    return mu


def _dimensions(value: ArrayLike) -> int:
    """Return the number of dimensions of nested lists and arrays; `as_array` checks them later."""
    depth = 0
    while depth < 3 and (each := as_list(value)):
        value, depth = each[0], depth + 1
    return depth + (np.asarray(value).ndim if isinstance(value, np.ndarray) else 0)


def _torsional(value: ArrayLike | None, count: int, soft: np.ndarray) -> Array:
    if value is None:
        if soft.any():
            raise InvalidInputError(
                "soft contacts need torsional_friction: |torsion| <= torsional_friction * normal [m], a scalar or (N,); "
                "about 0.005 for a fingertip with a contact patch of 1 cm radius"
            )
        return np.zeros(count)
    given = as_array(value, (count,) if _dimensions(value) else (), "torsional_friction")
    gamma = np.array(np.broadcast_to(given, (count,)))
    felt, within = gamma[soft], ranges.TORSIONAL_FRICTION
    if (felt <= 0.0).any():
        raise InvalidInputError(f"torsional_friction must be > 0 m at every soft contact, got {shown(gamma)}")
    if not ((felt >= within.low) & (felt <= within.high)).all():
        raise InvalidInputError(
            f"torsional_friction must lie within {within} at every soft contact, got {shown(gamma)}"
        )
    gamma[~soft] = 0.0
    return gamma

"""The margin of a problem: how far its forces stay inside the friction cones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from grasp_env.errors import InvalidInputError, shown
from grasp_env.force.limits import ForceLimits
from grasp_env.grasp.grasp import Grasp
from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import Array, ContactForces, Wrench, as_array, number


@dataclass(frozen=True, eq=False)
class Margin:
    """How far forces stay inside the friction cones: |t| <= friction * mu * (n - preload).

    The share of friction covers friction that is lower than given, the preload errors of the wrench
    and of the forces. With the torsion m of a soft contact, sqrt(|t / mu|^2 + (m / gamma)^2) <=
    friction * (n - preload). Contacts that do not touch have no preload.

    Attributes:
        friction: share of the friction that forces may use, 0.01 to 1.
        preload: normal force of each contact that does not count for friction [N], 0 to 1e6, below
            `max_normal`; one for all contacts or (N,).

    Raises:
        InvalidInputError: a number out of range, or another shape.

    Example:
        >>> from grasp_env.force import optimize_force
        >>> from grasp_env.grasp import presets
        >>> cuboid, load = presets.paper_cuboid(), [0, 3, -10, 0, 0, 0]
        >>> for margin in (1.0, 0.8, Margin(0.8, preload=0.5)):
        ...     print(f"{optimize_force(cuboid, load, margin=margin).friction_used.max():.2f}")
        0.91
        0.72
        0.54
    """

    friction: float = 1.0
    preload: ArrayLike = 0.0

    def __post_init__(self) -> None:
        shares, within = ranges.FRICTION_MARGIN, ranges.LEAST_NORMAL_FORCE
        if (
            type(self.friction) is float
            and type(self.preload) is float
            and shares.low <= self.friction <= shares.high
            and within.low <= self.preload <= within.high
        ):
            return  # a control loop's margin
        share = number(self.friction, "the friction margin", shares)
        preload: Any = as_array(self.preload, None, "preload")
        fits = (preload >= within.low) & (preload <= within.high)
        if preload.ndim > 1 or preload.size == 0 or not fits.all():
            raise InvalidInputError(
                f"preload must lie within {within}, one for all contacts or one per contact, got {shown(self.preload)}"
            )
        if preload.ndim:
            preload.flags.writeable = False
        else:
            preload = float(preload)
        object.__setattr__(self, "friction", share)
        object.__setattr__(self, "preload", preload)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Margin) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def _key(self) -> tuple[Any, ...]:
        return self.friction, np.shape(self.preload), np.asarray(self.preload).tobytes()

    def __bool__(self) -> bool:
        """False for the margin that changes nothing."""
        preload: Any = self.preload
        return self.friction < 1.0 or (
            preload > 0.0 if type(preload) is float else bool(preload.any())
        )

    def __str__(self) -> str:
        parts = []
        if self.friction < 1.0:
            parts.append(f"friction margin {self.friction:g}")
        if np.any(self.preload):
            parts.append(f"preload {np.asarray(self.preload).tolist()} N")
        return " and ".join(parts) or "no margin"

    def preloads(self, n_contacts: int) -> Array:
        """Return the preloads (N,) [N] of `n_contacts` contacts.

        Raises:
            InvalidInputError: preloads of another number of contacts.
        """
        preload = np.asarray(self.preload)
        if preload.ndim and len(preload) != n_contacts:
            raise InvalidInputError(
                f"preload has {len(preload)} entries, the grasp {n_contacts} contacts: give one or {n_contacts}"
            )
        return np.broadcast_to(preload, (n_contacts,)).copy()

    def narrowed(self, grasp: Grasp) -> Grasp:
        """Return `grasp` with the share of its friction, or itself if that is all of it."""
        if self.friction == 1.0:
            return grasp
        models = grasp.models
        return grasp.with_friction(
            self.friction * models.friction, self.friction * models.torsional_friction
        )


class ShiftedProblem(NamedTuple):
    """The ordinary problem whose forces g give the forces f = g + s n of a problem with a margin.

    Attributes:
        grasp: the contacts with the share of their friction.
        wrench: (6,) w + G s n [N, N m].
        preload: (N,) s [N].
    """

    grasp: Grasp
    wrench: Wrench
    preload: Array

    @classmethod
    def of(cls, grasp: Grasp, wrench: Wrench, preload: Array) -> ShiftedProblem:
        """Return the problem of a grasp that `Margin.narrowed` returned."""
        return cls(grasp, wrench + grasp.matrix[:, ::3] @ preload, preload)

    def outer(self, force: ContactForces) -> ContactForces:
        """Return f (N, 3) [N] from g."""
        return self._moved(force, self.preload)

    def inner(self, force: ContactForces) -> ContactForces:
        """Return g (N, 3) [N] from f."""
        return self._moved(force, -self.preload)

    def _moved(self, force: ContactForces, by: Array) -> ContactForces:
        moved = np.array(force)
        moved[:, 0] += by
        return moved


def shifted(margin: Margin, grasp: Grasp, wrench: Wrench) -> ShiftedProblem:
    """Return the problem of a grasp and a wrench (6,) without the margin."""
    return ShiftedProblem.of(margin.narrowed(grasp), wrench, margin.preloads(grasp.n_contacts))


def check_preload(
    margin: Margin, limits: ForceLimits | None, n_contacts: int, touching: Any = None
) -> None:
    """Raise an error if the preload of a contact that touches reaches its largest normal force."""
    if type(margin.preload) is float and (limits is None or margin.preload == 0.0):
        return
    preload = margin.preloads(n_contacts)
    if limits is None:
        return
    most = limits.checked(n_contacts).max_normal
    crossing = preload >= most if touching is None else (preload >= most) & touching
    for k in np.flatnonzero(crossing):
        raise InvalidInputError(
            f"the preload must be below max_normal at every contact; at contact {k} they are {preload[k]:g} and {most[k]:g} N: "
            "lower the preload or raise the limit"
        )


def nearest_margin(margin: Margin, largest_share: Callable[[Margin], float | None]) -> str:
    """Return a sentence with the margin that forces do keep where they do not keep `margin`.

    The sentence is empty if no force exists without a margin either.

    Args:
        margin: the margin that no force keeps.
        largest_share: solves with another margin and returns the largest share of friction that its
            force uses; None if there is no force.
    """
    for preload, words in ((margin.preload, " and that preload"), (0.0, " and no preload")):
        if largest_share(Margin(1.0, preload)) is None:
            continue
        low, high = 0, 100  # percents of friction without and with a force
        while high - low > 1:
            middle = (low + high) // 2
            if largest_share(Margin(middle / 100, preload)) is None:
                low = middle
            else:
                high = middle
        kept = Margin(max(high / 100, margin.friction), preload)
        return (
            f"no force keeps {margin}; with friction margin {kept.friction:g}{words if np.any(margin.preload) else ''} one exists "
            f"(uses {largest_share(kept):.3g} of the friction): "
        )
    return ""


NO_MARGIN = Margin()


def as_margin(value: Any) -> Margin:
    """Return `value`, a `Margin`, a share of friction or None, as a checked margin."""
    if value is None:
        return NO_MARGIN
    return value if isinstance(value, Margin) else Margin(value)

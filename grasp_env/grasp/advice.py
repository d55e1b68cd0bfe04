"""Advice on contacts, limits and wrenches that are valid but look like a mistake."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from grasp_env import core
from grasp_env._check import Array, Wrench, as_wrench, warn
from grasp_env.errors import InvalidInputError
from grasp_env.grasp.grasp import Grasp, as_grasp

LARGEST_CONDITION = 1e3
"""Condition number of G, with moments divided by the grasp's length, above which some wrenches need very large forces."""
SMALLEST_DISTANCE = 0.01
"""Distance of two contacts, as a fraction of the grasp's length, below which they act like one contact."""


def advise(grasp: Grasp, wrench: ArrayLike | None = None, limits: Any = None) -> list[str]:
    """Return a list of texts, one for each likely mistake in a grasp, a wrench and limits. Nothing is printed.

    The texts report normals that point out of the object, millimetres (positions, torsional friction, Jacobian), friction above 2 or
    in degrees, contacts that nearly coincide, and a nearly singular G. With a wrench, they also report a moment about another point
    than the origin of the positions, and force and moment in the wrong order. With limits as well, they report torque limits hundreds
    of times too large or too small. Each text tells what was seen, when it may be right, and what to change. `optimize_force` warns of
    the mistakes that are near certain.

    Args:
        grasp: a valid grasp.
        wrench: (6,) external wrench [N, N m], as for `optimize_force`.
        limits: the `ForceLimits` of the solve.

    Raises:
        InvalidInputError: no grasp, a wrench of another shape, or limits of another number of contacts.

    Example:
        >>> from grasp_env.grasp import presets
        >>> good = presets.tripod()
        >>> advise(good, wrench=[0, 0, -5, 0, 0, 0])
        []
        >>> print(*advise(Grasp.from_contacts(good.positions, -good.normals, 0.5)))
        all 3 normals point away from the centre of the contacts: normals must point INTO the object; ...
        >>> print(*advise(good, wrench=[0.1, 0, 0, 0, 0, -5]))
        the wrench's moment of 5 N m is that of its force of 0.1 N at 50 m from contacts that span 0.04 m: ...
    """
    given = as_grasp(grasp).contacts, None if wrench is None else as_wrench(wrench), *_torque_limits(grasp, limits)
    return [*(text for _, text in core.advise(*given)), *_coincident(grasp), *_condition(grasp)]


def warn_of(grasp: Grasp, wrench: Wrench | None = None, limits: Any = None) -> None:
    """Issue a `GraspWarning` about mistakes that are near certain, at the caller's line. It takes less than a microsecond.

    With a wrench (6,) float64, it is about the wrench only: contacts and limits were checked when the solver was made.
    """
    rows = _torque_limits(grasp, limits)
    if core.looks_wrong(grasp.contacts, wrench, *rows):
        known = [] if wrench is None else core.advise(grasp.contacts, None, *rows)
        if found := [
            text
            for certain, text in core.advise(grasp.contacts, wrench, *rows)
            if certain and (certain, text) not in known
        ]:
            warn("; ".join(found))


def _torque_limits(grasp: Grasp, limits: Any) -> tuple[Array | None, Array | None]:
    """Return the Jacobian (N, 3 or 6, J) and the torque limits (J,), or None for both."""
    if limits is None:
        return None, None
    rows = getattr(limits, "jacobian", None)
    if not hasattr(limits, "torque_limit") or (rows is not None and len(rows) != grasp.n_contacts):
        raise InvalidInputError(f"limits must be a ForceLimits for {grasp.n_contacts} contacts, got {limits!r:.200}")
    return rows, limits.torque_limit


def _coincident(grasp: Grasp) -> list[str]:
    if grasp.n_contacts == 1:
        return []
    apart = np.linalg.norm(grasp.positions[:, None] - grasp.positions, axis=2)
    first, second = np.nonzero(np.triu(apart < SMALLEST_DISTANCE * grasp.length, 1))
    return [
        f"contacts {i} and {j} are {1e3 * apart[i, j]:.3g} mm apart, {100 * apart[i, j] / grasp.length:.2g} % of the grasp's "
        "length: they act like one contact; drop one or correct its position"
        for i, j in zip(first.tolist(), second.tolist(), strict=True)
    ]


def _condition(grasp: Grasp) -> list[str]:
    if grasp.rank < 6:
        return [
            f"rank(G) = {grasp.rank} < 6: the contacts balance only some wrenches, and contacts on a line none with a moment about that "
            "line; add a contact, friction, or soft fingertips if the object can turn"
        ]
    centre = grasp.positions.mean(axis=0)
    here, centred = (_condition_number(grasp, about) for about in (np.zeros(3), centre))
    if centred > LARGEST_CONDITION:
        return [
            f"G is nearly singular, condition number {centred:.2g}: some wrenches need forces that much larger than others; "
            "spread the contacts, away from one common line, or add friction, torsion or a contact"
        ]
    if here > LARGEST_CONDITION:
        return [
            f"G has condition number {here:.2g}, but {centred:.2g} with moments about the centre of the contacts: the object "
            f"frame's origin is {np.linalg.norm(centre):.3g} m away; put it near the contacts"
        ]
    return []


def _condition_number(grasp: Grasp, about: Array) -> float:
    """Return the condition number of G, with moments taken about `about` (3,) [m] and divided by the grasp's length."""
    matrix = grasp.matrix * grasp.models.transmitted.reshape(-1)
    whole = np.concatenate([matrix, grasp.torsion_matrix * grasp.length], axis=1)
    whole[3:] -= np.cross(about, whole[:3].T).T
    whole[3:] /= grasp.length
    values = np.linalg.svd(whole, compute_uv=False)
    return float(values[0] / values[-1])

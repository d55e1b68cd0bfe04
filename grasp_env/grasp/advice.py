"""Advice on contacts, limits and wrenches that are valid but look like a mistake."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from numpy.typing import ArrayLike

from grasp_env.errors import InvalidInputError
from grasp_env.grasp.grasp import Grasp, as_grasp
from grasp_env.grasp.mistakes import (
    all_outward,
    coincident,
    condition,
    contact_units,
    frame_and_order,
    lever_units,
    little_margin,
    some_outward,
    torque_units,
)
from grasp_env.inputs.arguments import Array, Wrench, as_wrench, warn


def advise(
    grasp: Grasp, wrench: ArrayLike | None = None, limits: Any = None, margin: Any = None
) -> list[str]:
    """Return a list of texts, one for each likely mistake in a grasp, a wrench and limits.

    The texts report normals that point out of the object, millimetres (positions, torsional
    friction, Jacobian), friction above 2 or in degrees, contacts that nearly coincide, and a nearly
    singular G. With a wrench, they also report a moment about another point than the origin of the
    positions, force and moment in the wrong order, and, without a margin, an optimum that uses more
    than 0.9 of the friction. With limits as well, they report torque limits hundreds of times too
    large or too small. Each text states what was seen, when it may be
    right, and what to change. `optimize_force` warns about the almost certain mistakes.

    Args:
        grasp, wrench: as in `optimize_force`.
        limits: the `ForceLimits` of the solve.
        margin: the `Margin` of the solve, or its share of friction; None: none.

    Raises:
        InvalidInputError: no grasp, a wrench of another shape, or limits of another number of
            contacts.

    Example:
        >>> from grasp_env.grasp import presets
        >>> good = presets.tripod()
        >>> advise(good, wrench=[0, 0, -5, 0, 0, 0], margin=0.75)
        []
        >>> print(*advise(good, wrench=[0, 0, -5, 0, 0, 0]))
        the optimum without a margin uses 0.967 of the friction at contact 0: it slips
        there if the friction is 3.3% lower than given, ...
        >>> print(*advise(Grasp.from_contacts(good.positions, -good.normals, 0.5)))
        all 3 normals point away from the centre of the contacts: normals must point INTO the
        object; ...
        >>> print(*advise(good, wrench=[0.1, 0, 0, 0, 0, -5], margin=0.75))
        the wrench's moment of 5 N m is that of its force of 0.1 N at 50 m from contacts that span
        0.04 m: ...
    """
    as_grasp(grasp)
    load = None if wrench is None else as_wrench(wrench)
    jacobian, torque_limit = _torque_limits(grasp, limits)
    mistakes = [*all_outward(grasp), *some_outward(grasp), *contact_units(grasp)]
    if jacobian is not None:
        mistakes += lever_units(jacobian)
    if load is not None:
        mistakes += frame_and_order(grasp, load)
    if load is not None and (not margin or margin == 1.0):
        mistakes += little_margin(grasp, load)
    if load is not None and jacobian is not None and torque_limit is not None:
        mistakes += torque_units(grasp, load, jacobian, torque_limit)
    mistakes += [*coincident(grasp), *condition(grasp)]
    return [text for _, text in mistakes]


def warn_of_contacts(grasp: Grasp, limits: Any = None) -> None:
    """Warn about near-certain mistakes in contacts and limits, at the caller's line."""
    mistakes = [*all_outward(grasp), *contact_units(grasp)]
    if limits is not None and limits.jacobian is not None:
        mistakes += lever_units(limits.jacobian)
    _warn(mistakes)


def warn_of_wrench(grasp: Grasp, wrench: Wrench) -> None:
    """Warn about near-certain mistakes in a wrench (6,) float64, at the caller's line."""
    _warn(frame_and_order(grasp, wrench))


def _warn(mistakes: Iterable[tuple[bool, str]]) -> None:
    texts = [text for near_certain, text in mistakes if near_certain]
    if texts:
        warn("; ".join(texts))


def _torque_limits(grasp: Grasp, limits: Any) -> tuple[Array | None, Array | None]:
    """Return the Jacobian (N, 3 or 6, J) and the torque limits (J,), or None for both."""
    if limits is None:
        return None, None
    rows = getattr(limits, "jacobian", None)
    if not hasattr(limits, "torque_limit") or (rows is not None and len(rows) != grasp.n_contacts):
        raise InvalidInputError(
            f"limits must be a ForceLimits for {grasp.n_contacts} contacts, got {limits!r:.200}"
        )
    return rows, limits.torque_limit

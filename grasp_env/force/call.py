"""Arguments of one call of an optimizer: checked arrays, and the contacts that touch."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from grasp_env.errors import InvalidInputError, shown
from grasp_env.force.margin import Margin, as_margin
from grasp_env.force.torques import checked_jacobian
from grasp_env.grasp.checks import rank_error
from grasp_env.grasp.grasp import Grasp
from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import AllFaults, as_array


class Call(NamedTuple):
    """Arrays of `ForceOptimizer.solve` in the core's order; None: the optimizer's own."""

    positions: Any
    normals: Any
    friction: Any
    jacobian: Any
    torque_bias: Any
    contacts: Any
    margin: Any = None


def checked_call(
    grasp: Grasp,
    motions: tuple[int, int],
    positions: Any = None,
    normals: Any = None,
    friction: Any = None,
    jacobian: Any = None,
    torque_bias: Any = None,
    contacts: Any = None,
    margin: Any = None,
) -> Call:
    """Check the arguments of `ForceOptimizer.solve`; limits have a Jacobian (N, *motions)."""
    n = grasp.n_contacts
    joints = motions[1]

    def array(value: Any, shape: tuple[int | None, ...], name: str, **options: Any) -> Any:
        return None if value is None else as_array(value, shape, name, copy=False, **options)

    def rows() -> Any:
        if jacobian is None:
            return None
        checked = checked_jacobian(jacobian, n, touch)
        if checked.shape[2] != joints:
            raise InvalidInputError(
                f"jacobian must have {joints} joints, got shape {checked.shape}"
            )
        if joints and checked.shape[1:] != motions:
            raise InvalidInputError(
                f"jacobian must have the shape {(n, *motions)} of the limits', got {checked.shape}"
            )
        return checked

    with AllFaults() as check:
        touch = None if contacts is None else check(_mask, contacts, n)
        return Call(
            check(array, positions, (n, 3), "positions", used=touch),
            check(array, normals, (n, 3), "normals", used=touch),
            None if friction is None else check(grasp.models.other_friction, friction, touch),
            check(rows),
            check(array, torque_bias, (joints,), "torque_bias", within=ranges.BIAS),
            touch,
            None if margin is None else check(_margin, margin, n),
        )


def _margin(margin: Any, count: int) -> Margin:
    checked = as_margin(margin)
    checked.preloads(count)  # raises if they are of another number of contacts
    return checked


def _mask(contacts: Any, count: int) -> Any:
    """Return (N,) bool of the contacts that touch, from true and false or from 1 and 0."""
    try:
        flags = np.asarray(contacts)
    except Exception:  # of numpy
        flags = np.asarray(None)
    if np.ma.is_masked(contacts):
        raise InvalidInputError(
            f"contacts must be true or false each, none of them masked, got {shown(contacts)}"
        )
    if flags.shape == (count,) and flags.dtype.kind in "biuf" and count <= 64:
        mask = np.ascontiguousarray(flags, dtype=bool)
        if flags.dtype.kind == "b" or (mask == flags).all():
            return mask
    raise InvalidInputError(
        f"contacts must be ({count},) of true and false, of at most 64 contacts, got {shown(contacts)}"
    )


def touching_grasp(grasp: Grasp, call: Call) -> Grasp:
    """Return the touching contacts of a call as a grasp.

    Raises:
        RankDeficientGraspError: no contact touches.
    """
    positions, normals, friction, mask = call.positions, call.normals, call.friction, call.contacts
    if mask is not None and not mask.any():
        raise rank_error(0, 0)
    chosen = slice(None) if mask is None else mask
    models, tangents = grasp.models, grasp.contacts.tangents
    names = [name for k, name in enumerate(models.names) if mask is None or mask[k]]
    gamma = models.torsional_friction[chosen]
    return Grasp.from_contacts(
        (grasp.positions if positions is None else positions)[chosen],
        (grasp.normals if normals is None else normals)[chosen],
        (models.friction if friction is None else friction)[chosen],
        contact_model=names,
        torsional_friction=gamma if "soft" in names else None,
        tangents=tangents[chosen] if len(tangents) else None,
    )

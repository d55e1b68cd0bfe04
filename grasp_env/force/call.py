"""Arguments of one call of an optimizer: checked arrays, and the contacts that touch."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from grasp_env import ranges
from grasp_env._check import AllFaults, as_array
from grasp_env.errors import InvalidInputError, shown
from grasp_env.force.torques import checked_jacobian
from grasp_env.grasp.grasp import Grasp


class Call(NamedTuple):
    """Arrays of a call in the order of the core's arguments, or None for the optimizer's own; see `ForceOptimizer.solve`."""

    positions: Any
    normals: Any
    friction: Any
    jacobian: Any
    torque_bias: Any
    contacts: Any


def checked_call(
    grasp: Grasp,
    joints: int,
    positions: Any = None,
    normals: Any = None,
    friction: Any = None,
    jacobian: Any = None,
    torque_bias: Any = None,
    contacts: Any = None,
) -> Call:
    """Check the arguments of a call of `ForceOptimizer.solve` on its contacts and its limits of so many joints."""
    n = grasp.n_contacts

    def array(value: Any, shape: tuple[int | None, ...], name: str, within: Any = None) -> Any:
        return None if value is None else as_array(value, shape, name, within, copy=False)

    def rows() -> Any:
        if jacobian is None:
            return None
        checked = checked_jacobian(jacobian, n)
        if checked.shape[2] != joints:
            raise InvalidInputError(f"jacobian must be that of {joints} joints, got shape {checked.shape}")
        return checked

    def touching() -> Any:
        if contacts is None:
            return None
        mask = np.asarray(contacts)
        if mask.shape != (n,) or mask.dtype != np.bool_ or n > 64:
            raise InvalidInputError(
                f"contacts must be ({n},) of true and false, of at most 64 contacts, got {shown(contacts)}"
            )
        return np.ascontiguousarray(mask)

    with AllFaults() as check:
        return Call(
            check(array, positions, (n, 3), "positions"),
            check(array, normals, (n, 3), "normals"),
            None if friction is None else check(grasp.models.other_friction, friction),
            check(rows),
            check(array, torque_bias, (joints,), "torque_bias", ranges.BIAS),
            check(touching),
        )


def touching_grasp(grasp: Grasp, call: Call) -> Grasp:
    """Return the touching contacts of a call as a grasp; a `GraspError` if they are none."""
    positions, normals, friction, _, _, mask = call
    chosen = slice(None) if mask is None else mask
    models, tangents = grasp.models, grasp.contacts.tangents
    gamma = models.torsional_friction[chosen]
    return Grasp.from_contacts(
        (grasp.positions if positions is None else positions)[chosen],
        (grasp.normals if normals is None else normals)[chosen],
        (models.friction if friction is None else friction)[chosen],
        contact_model=[name for k, name in enumerate(models.names) if mask is None or mask[k]],
        torsional_friction=gamma if gamma.any() else None,
        tangents=tangents[chosen] if len(tangents) else None,
    )

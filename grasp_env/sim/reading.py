"""One reading of the server as flat numbers: a compiled walk through the tuples that PyBullet answers with.

A loop in Python over the same tuples takes five times as long.
"""

from __future__ import annotations

from typing import Any

from numba import njit, types

from grasp_env import _compile

# CPython's own functions, by their documented names: borrowed references in, numbers out
_item = types.ExternalFunction("PyTuple_GetItem", types.intp(types.intp, types.intp))
_length = types.ExternalFunction("PyTuple_Size", types.intp(types.intp))
_number = types.ExternalFunction("PyFloat_AsDouble", types.float64(types.intp))


def _walk(joints: int, pose: int, velocity: int, contacts: int, out: Any) -> int:
    """Writes angles (M,), speeds (M,), the object (`BODY` numbers) and `ROW` numbers per contact; see `snapshot.observe`.

    Args:
        joints: id() of what getJointStates answered. pose: of getBasePositionAndOrientation. velocity: of getBaseVelocity.
        contacts: of getContactPoints. The objects must stay alive during the call.
        out: (>= 2M + BODY + ROW * R,) receives the numbers.

    Returns:
        How many were written.
    """
    count = _length(joints)
    for j in range(count):
        row = _item(joints, j)
        out[j], out[count + j] = _number(_item(row, 0)), _number(_item(row, 1))
    place = 2 * count
    for k in range(4):  # position, quaternion, linear and angular velocity
        row = _item(pose if k < 2 else velocity, k % 2)
        for r in range(4 if k == 1 else 3):
            out[place] = _number(_item(row, r))
            place += 1
    for i in range(_length(contacts)):
        contact = _item(contacts, i)
        for k in range(4):  # link and place, normal force and normal, two friction forces and their directions
            number, vector = (3, 6) if k == 0 else ((9, 7) if k == 1 else (6 + 2 * k, 7 + 2 * k))
            row = _item(contact, vector)
            out[place] = _number(_item(contact, number))
            for r in range(3):
                out[place + 1 + r] = _number(_item(row, r))
            place += 4
    return place


# holds the GIL, unlike `compiled`: it reads Python's objects
walk: Any = _compile._stamped(njit(cache=True, error_model="numpy", fastmath=False)(_walk))  # pyright: ignore[reportPrivateUsage]

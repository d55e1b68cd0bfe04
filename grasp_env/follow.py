"""One control tick between two optimisations in one compiled call: the server's answers in, torques out."""

from __future__ import annotations

from typing import Any

from numba import njit

from grasp_env import _compile
from grasp_env.control_kernels import tick
from grasp_env.sim.reading import walk
from grasp_env.sim.snapshot import MASK, VALID, observe


def _follow(
    joints, pose, velocity, contacts, target, told, mask, numbers, indices, kind, sizes, triangles, triangle_normals, falling,
    reading, finger_of_link, buffer, home, gravity, belief, mode, fingers, given, given_frames, divisor, weights, basis,
    basis_frames, goals, inwards, command,
):  # fmt: skip
    """`reading.walk`, `snapshot.observe` and, where the contacts are those of `mask`, `control_kernels.tick`.

    Args:
        joints, pose, velocity, contacts: of `reading.walk`. falling: (3,) gravity of the scene.
        mask: the fingers for which the forces were optimised.
        All others: of the kernels of the same names.

    Returns:
        Whether there are torques; else the contacts have changed, or the numbers are not finite.
    """
    count = walk(joints, pose, velocity, contacts, reading)
    observe(
        numbers, indices, kind, sizes, triangles, triangle_normals, falling, reading[:count], finger_of_link, buffer
    )
    if buffer[VALID] == 0.0 or buffer[MASK] != mask:
        return False
    tick(
        numbers, indices, home, buffer, target, told, gravity, belief, mode, fingers, given, given_frames, divisor, weights,
        basis, basis_frames, goals, inwards, False, command,
    )  # fmt: skip
    return True


# holds the GIL, unlike `compiled`: it reads Python's objects
follow: Any = _compile._stamped(njit(cache=True, error_model="numpy", fastmath=False)(_follow))  # pyright: ignore[reportPrivateUsage]

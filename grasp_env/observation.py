"""The observation, as one table: name, size, unit, frame, bound. The class docstring of the env is tested against it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grasp_env._compile import compiled
from grasp_env._views import small
from grasp_env.control_kernels import pose_error
from grasp_env.sim.snapshot import split


@dataclass(frozen=True)
class Field:
    """One block of the observation vector."""

    name: str
    size: int
    unit: str
    frame: str
    bound: float


def fields(tips: int = 4, joints: int = 12) -> tuple[Field, ...]:
    """The blocks for a hand of so many tips and joints."""
    return (
        Field("wrench to balance: force", 3, "N", "object", 200.0),
        Field("wrench to balance: moment", 3, "N m", "object", 20.0),
        Field("object position minus the wanted one", 3, "m", "world", 1.0),
        Field("object orientation against the wanted one", 3, "rad", "world", 3.2),
        Field("object linear velocity minus the wanted one", 3, "m/s", "world", 10.0),
        Field("object angular velocity minus the wanted one", 3, "rad/s", "world", 50.0),
        Field("contact point", 3 * tips, "m", "object", 0.5),
        Field("inward normal", 3 * tips, "1", "object", 1.0),
        Field("commanded force (normal, o, t)", 3 * tips, "N", "contact", 500.0),
        Field("measured force (normal, o, t)", 3 * tips, "N", "contact", 500.0),
        Field("touching", tips, "1", "-", 1.0),
        Field("joint angle", joints, "rad", "-", 7.0),
        Field("solver friction", 1, "1", "-", 10.0),
    )


def bounds(tips: int, joints: int) -> NDArray[np.float32]:
    """The bound of each entry; observations are clipped to +-bound."""
    blocks = fields(tips, joints)
    return np.repeat([block.bound for block in blocks], [block.size for block in blocks]).astype(np.float32)


DRIFT, TILT, FORCE_ERROR, SLIP, STRAY, TOTAL_NORMAL = range(6)
"""Places in a summary: the object's distance [m] and angle [rad] from where it should be, largest component of measured - commanded
force [N], fastest tip on the object [m/s], force of links on the object [N], commanded normal forces [N]."""


@compiled
def observe(buffer, indices, target, wrench, force, frames, friction, bound, measured, summary, out):
    """Writes the clipped observation, the measured forces (N, 3) in contact frames, and the summary.

    Args:
        buffer: of the snapshot. indices: of the hand, from `pack_tree`. target: (19,) the wanted motion.
        wrench, force, frames: what is commanded. friction: of the solver.
        bound, out: (size,) float32.
    """
    m, n = indices[0], indices[1]
    s = split(buffer, n, m)
    error = small(12)
    pose_error(s, target, error)
    summary[DRIFT] = math.sqrt(error[0] ** 2 + error[1] ** 2 + error[2] ** 2)
    summary[TILT] = math.sqrt(error[3] ** 2 + error[4] ** 2 + error[5] ** 2)
    summary[FORCE_ERROR], summary[SLIP], summary[STRAY], summary[TOTAL_NORMAL] = 0.0, 0.0, s.stray[0], 0.0
    place = 0
    for k in range(6):
        out[place + k] = wrench[k]
    place += 6
    for k in range(12):
        out[place + k] = error[k]
    place += 12
    for i in range(n):
        for k in range(3):
            total = 0.0
            for q in range(3):
                total += frames[i, q, k] * s.forces[i, q]
            measured[i, k] = total
            j = place + 3 * i + k
            out[j], out[j + 3 * n] = s.points[i, k], s.normals[i, k]
            out[j + 6 * n], out[j + 9 * n] = force[i, k], total
            summary[FORCE_ERROR] = max(summary[FORCE_ERROR], abs(total - force[i, k]))
        summary[TOTAL_NORMAL] += force[i, 0]
        if s.touching[i] > 0.0:
            summary[SLIP] = max(summary[SLIP], s.slip[i])
        out[place + 12 * n + i] = s.touching[i]
    place += 13 * n
    for j in range(m):
        out[place + j] = s.angles[j]
    out[place + m] = friction
    for j in range(out.size):
        out[j] = min(max(out[j], -bound[j]), bound[j])


def table() -> list[str]:
    """Lines "first-last | name | unit | frame | bound" of the four-finger hand, as printed in the environment's docstring."""
    lines, start = [], 0
    for block in fields():
        last = start + block.size - 1
        index = f"{start}" if block.size == 1 else f"{start}-{last}"
        lines.append(f"| {index} | {block.name} | {block.unit} | {block.frame} | {block.bound:g} |")
        start = last + 1
    return lines

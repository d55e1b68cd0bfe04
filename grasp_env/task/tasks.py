"""Tasks: what is asked of the grasp in an episode, and what counts as success."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Task:
    """A kind of episode.

    Attributes:
        duration: [s] of an episode, unless given.
        disturbance: a key of `DISTURBANCES`, unless given.
        description: one line.
        drift_limit: [m] below which the object must be from its place for success; infinite: only not lost.
        tilt_limit: [rad], the same.

    Example:
        >>> TASKS["hold"].duration
        2.0
    """

    duration: float
    disturbance: str
    description: str
    drift_limit: float = math.inf
    tilt_limit: float = math.inf


TASKS: dict[str, Task] = {
    "hold": Task(2.0, "constant", "hold the object in place against the disturbance"),
    "move": Task(4.0, "none", "follow the object trajectory `motion`; gravity and inertia must be balanced"),
    "payload": Task(4.0, "none", "hold while the mass, which nobody tells, changes by `payload_factor`"),
    "six_directions": Task(
        12.0,
        "none",
        "pushes of 10 N/kg along +x, -x, +y, -y, +z, -z for 2 s each, in one episode (DexGraspBench, which starts a "
        "fresh grasp for each); below 50 mm and 15 degrees",
        drift_limit=0.05,
        tilt_limit=math.radians(15.0),
    ),
}
"""What `task` may be."""


def succeeded(task: str, drift: float, tilt: float, failed: bool) -> bool:
    """Whether an episode that ends here is a success.

    Args:
        task: a key of `TASKS`.
        drift: [m] of the object from where it should be.
        tilt: [rad] of the object from how it should stand.
        failed: whether the object was lost.

    Example:
        >>> succeeded("six_directions", drift=0.04, tilt=0.2, failed=False)
        True
        >>> succeeded("six_directions", drift=0.04, tilt=0.3, failed=False)
        False
    """
    limits = TASKS[task]
    return not failed and bool(drift < limits.drift_limit) and bool(tilt < limits.tilt_limit)

"""The observation, as one table: key, name, size, unit, frame, bound. The class docstring of the env is tested against it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from grasp_env._check import Array
from grasp_env.core import Gather, Outcome
from grasp_env.sim.snapshot import Snapshot

if TYPE_CHECKING:
    from grasp_env.control.loop import ForceLoop


@dataclass(frozen=True)
class Field:
    """One block of the observation; `key` is its name in a dict."""

    key: str
    name: str
    size: int
    unit: str
    frame: str
    bound: float


def fields(tips: int = 4, joints: int = 12) -> tuple[Field, ...]:
    """The blocks for a hand of so many tips and joints."""
    return (
        Field("force", "wrench to balance: force", 3, "N", "object", 200.0),
        Field("moment", "wrench to balance: moment", 3, "N m", "object", 20.0),
        Field("position", "object position minus the wanted one", 3, "m", "world", 1.0),
        Field("orientation", "object orientation against the wanted one", 3, "rad", "world", 3.2),
        Field("linear_velocity", "object linear velocity minus the wanted one", 3, "m/s", "world", 10.0),
        Field("angular_velocity", "object angular velocity minus the wanted one", 3, "rad/s", "world", 50.0),
        Field("contact_points", "contact point", 3 * tips, "m", "object", 0.5),
        Field("normals", "inward normal", 3 * tips, "1", "object", 1.0),
        Field("commanded_force", "commanded force (normal, o, t)", 3 * tips, "N", "contact", 500.0),
        Field("measured_force", "measured force (normal, o, t)", 3 * tips, "N", "contact", 500.0),
        Field("touching", "touching", tips, "1", "-", 1.0),
        Field("joint_angles", "joint angle", joints, "rad", "-", 7.0),
        Field("friction", "solver friction", 1, "1", "-", 10.0),
    )


def action_size(mode: str, tips: int) -> int:
    """Numbers of an action in mode "initial_force", "contact_force" or "none" for a hand of so many tips."""
    return {"initial_force": max(3 * tips - 6, 1), "contact_force": 3 * tips, "none": 1}[mode]


def bounds(tips: int, joints: int) -> NDArray[np.float32]:
    """The bound of each entry; observations are clipped to +-bound."""
    blocks = fields(tips, joints)
    return np.repeat([block.bound for block in blocks], [block.size for block in blocks]).astype(np.float32)


class Observer:
    """Fills observations for one hand.

    Attributes:
        fields: the blocks. bound: (size,) float32 of each entry.
        error: (12,) position, orientation, velocities of the object against the wanted ones, world frame.
        measured: (N, 3) measured forces in the commanded contact frames [N].
    """

    def __init__(self, tips: int, joints: int) -> None:
        self.fields, self.bound = fields(tips, joints), bounds(tips, joints)
        self._ends = np.cumsum([block.size for block in self.fields])[:-1]
        self.error, self.measured = np.zeros(12), np.zeros((tips, 3))

    def named(self, vector: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
        """The parts of an observation (size,) by their keys."""
        return {block.key: part for block, part in zip(self.fields, np.split(vector, self._ends), strict=True)}

    def watch(self, snapshot: Snapshot, loop: ForceLoop) -> None:
        """Whose numbers are observed, in the order of `fields`: views that a reading and a tick overwrite."""
        self._loop = loop
        parts = (
            loop.wrench, self.error, snapshot.points, snapshot.normals, loop.force, self.measured, snapshot.touching,
            snapshot.angles, np.array([loop.friction]),
        )  # fmt: skip
        self._gather = Gather(list(parts), self.bound)

    def __call__(self, target: Array) -> tuple[NDArray[np.float32], Outcome]:
        """The clipped observation, and how the object is held; target: (19,) the wanted motion."""
        outcome = self._loop.outcome(target, self.error, self.measured)
        return self._gather(), outcome

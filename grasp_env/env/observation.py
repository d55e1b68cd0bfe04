"""The layout of the observation, which a test compares with the environment's docstring."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grasp_env.control.loop import ForceLoop
from grasp_env.core import Gather, Outcome
from grasp_env.inputs.arguments import Array
from grasp_env.sim.snapshot import Snapshot


@dataclass(frozen=True)
class Field:
    """A block of the observation; `key` is its name in a dict."""

    key: str
    name: str
    size: int
    unit: str
    frame: str
    bound: float


def fields(tips: int = 4, joints: int = 12, mode: str = "") -> tuple[Field, ...]:
    """Return the blocks for a hand with these numbers of tips and joints, and an action mode."""
    linear = "object linear velocity minus the desired one"
    angular = "object angular velocity minus the desired one"
    felt = (
        Field("tangential_share", "tangential over normal measured force", tips, "1", "-", 10.0),
        Field("slid", "distance that the fingertip slid on the object", tips, "m", "-", 0.1),
    )
    return (
        Field("force", "wrench to balance: force", 3, "N", "object", 200.0),
        Field("moment", "wrench to balance: moment", 3, "N m", "object", 20.0),
        Field("position", "object position minus the desired one", 3, "m", "world", 1.0),
        Field("orientation", "object orientation against the desired one", 3, "rad", "world", 3.2),
        Field("linear_velocity", linear, 3, "m/s", "world", 10.0),
        Field("angular_velocity", angular, 3, "rad/s", "world", 50.0),
        Field("contact_points", "contact point", 3 * tips, "m", "object", 0.5),
        Field("normals", "inward normal", 3 * tips, "1", "object", 1.0),
        Field("commanded_force", "commanded force (normal, o, t)", 3 * tips, "N", "contact", 500.0),
        Field("measured_force", "measured force (normal, o, t)", 3 * tips, "N", "contact", 500.0),
        Field("touching", "touching", tips, "1", "-", 1.0),
        Field("joint_angles", "joint angle", joints, "rad", "-", 7.0),
        Field("friction", "solver friction", 1, "1", "-", 10.0),
        *(felt if mode == "grip" else ()),
    )


def bounds(tips: int, joints: int, mode: str = "") -> NDArray[np.float32]:
    """Return the bound of each entry; observations are clipped to +-bound."""
    blocks = fields(tips, joints, mode)
    return np.repeat([block.bound for block in blocks], [block.size for block in blocks]).astype(
        np.float32
    )


class Observer:
    """Computes the observations of one hand.

    Attributes:
        fields: the blocks; bound: (size,) bound of each entry, float32.
        error: (12,) errors of the object's position, orientation and velocities, world frame.
        measured: (N, 3) measured forces in the commanded contact frames [N].
    """

    def __init__(self, tips: int, joints: int, mode: str = "") -> None:
        self.fields, self.bound = fields(tips, joints, mode), bounds(tips, joints, mode)
        self._feels = mode == "grip"
        self._share = np.zeros(tips)
        self._ends = np.cumsum([block.size for block in self.fields])[:-1]
        self.error, self.measured = np.zeros(12), np.zeros((tips, 3))

    def named(self, vector: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
        """Return the blocks of an observation (size,) by their keys."""
        return {
            block.key: values
            for block, values in zip(self.fields, np.split(vector, self._ends), strict=True)
        }

    def watch(self, snapshot: Snapshot, loop: ForceLoop) -> None:
        """Select the arrays to observe, in the order of `fields`; ticks overwrite them."""
        self._loop = loop
        arrays = [
            loop.wrench,
            self.error,
            snapshot.points,
            snapshot.normals,
            loop.force,
            self.measured,
            snapshot.touching,
            snapshot.angles,
            np.array([loop.friction]),
        ]
        if self._feels:
            arrays += [self._share, loop.hand.slid]
        self._gather = Gather(arrays, self.bound)

    def __call__(self, target: Array) -> tuple[NDArray[np.float32], Outcome]:
        """Return the clipped observation and the state of the hold; target: (19,) desired motion."""
        outcome = self._loop.outcome(target, self.error, self.measured)
        if self._feels:
            normal, tangential = self.measured[:, 0], np.hypot(*self.measured[:, 1:].T)
            np.divide(tangential, normal, out=self._share, where=normal > 0.0)
            self._share[normal <= 0.0] = 0.0
        return self._gather(), outcome

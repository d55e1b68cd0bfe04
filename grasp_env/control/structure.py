"""Contact forces that no motor can produce: the structure of the fingers carries them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from grasp_env.force import optimize_forces
from grasp_env.grasp.grasp import Grasp
from grasp_env.inputs.arguments import Array, Indices
from grasp_env.sim.hand.kinematics import HandKinematics, motor_force_basis
from grasp_env.sim.snapshot import Snapshot

MAX_CARRIED = 0.65
"""Largest share of a finger's force that its structure may carry without a warning.

In 34 grasps by five hands (Dex3, Linker O7, Ability, BrainCo, iCub) the engines agreed below it:
Bullet held 26 of 32 trials, MuJoCo 27. Above it Bullet held 30 of 104, MuJoCo 69."""


class Posture(NamedTuple):
    """A posture of a hand around an object.

    Attributes:
        angles: (M,) joint angles [rad].
        touch: (N, 3) points where the fingertips touch [m], world frame.
        rotation: (3, 3) rotation from the object to the world.
    """

    angles: Array
    touch: Array
    rotation: Array


class FingerStructure(NamedTuple):
    """Shares of the forces of N fingers that motors produce and that structure carries.

    Attributes:
        components: (N,) number of a finger's three force components that its motors can produce.
        share: (N,) share of a finger's force that its structure carries, root mean square over the
            loads.
    """

    components: Indices
    share: Array

    def warning(self, names: Sequence[str]) -> str:
        """Return a warning about fingers whose structure carries more than `MAX_CARRIED`, or ""."""
        fingers = zip(names, self.components.tolist(), self.share.tolist(), strict=True)
        listed = ", ".join(
            f"{share:.0%} of the force of {name!r} "
            + (
                f"(motors make {count} of 3 components)"
                if count < 3
                else "(other fingers share its motors)"
            )
            for name, count, share in fingers
            if share > MAX_CARRIED
        )
        return listed and (
            f"no motor produces the forces that the structure of fingers carries: {listed}. Torques do not correct them, so the object may "
            "slip although the commanded forces hold it; in PyBullet more often than in MuJoCo. Use engine='mujoco', "
            "engine=BulletEngine(solver_iterations=1500), or a hand position and contact_points at which motors push along the normals"
        )


def finger_structure(
    posture: Posture | Snapshot, kinematics: HandKinematics, grasp: Grasp, wrenches: Array
) -> FingerStructure:
    """Return the shares of the forces that structure carries in a posture.

    Contact forces f take the motor torques J^T f, with J the Jacobian of all contacts. The part of
    f in the null space of J^T takes no torque, and no torque changes it. `wrenches` (K, 6) are
    loads on the object [N, N m], object frame. Those that the contacts cannot balance are ignored.
    """
    count = len(posture.touch)
    motors = kinematics.motors
    jacobian = kinematics.statics(posture.angles, posture.touch)[0][:, :, motors]
    span = motor_force_basis(jacobian.reshape(3 * count, len(motors)))
    if span.shape[1] == 3 * count:
        return FingerStructure(np.full(count, 3), np.zeros(count))
    components = np.array([motor_force_basis(rows).shape[1] for rows in jacobian], dtype=np.int64)
    optimal = optimize_forces(grasp, wrenches, workers=1).force
    optimal = optimal[np.isfinite(optimal).all(axis=(1, 2))]
    forces = np.einsum("nij,mnj->mni", posture.rotation @ grasp.frames, optimal)
    forces = forces.reshape(-1, 3 * count)
    carried = forces - forces @ span @ span.T
    squares = [(f.reshape(-1, count, 3) ** 2).sum(axis=(0, 2)) for f in (carried, forces)]
    share = np.sqrt(squares[0] / np.maximum(squares[1], np.finfo(float).tiny))
    # shared motors couple the fingers: the carried part of one may exceed its own force
    return FingerStructure(components, np.minimum(share, 1.0))

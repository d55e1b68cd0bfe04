"""The part of the contact forces that motors cannot make, so that the structure of the fingers' joints carries it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from grasp_env._check import Array, Indices
from grasp_env.force import optimize_forces
from grasp_env.grasp.grasp import Grasp
from grasp_env.sim.hand.kinematics import HandKinematics, motor_span
from grasp_env.sim.snapshot import Snapshot

MOST_CARRIED = 0.65
"""Part of a finger's force that its structure may carry unreported. In 34 grasps by five hands (Dex3, Linker O7, Ability, BrainCo, iCub)
the engines agreed below it: Bullet held 26 of 32 trials, MuJoCo 27. Above it Bullet held 30 of 104, MuJoCo 69."""


class FingerStructure(NamedTuple):
    """The parts of N fingers' forces that motors make and that structure carries.

    Attributes:
        components: (N,) of the three force components of a finger, how many its motors make.
        share: (N,) the part of a finger's force, root mean square over the loads, that its structure carries; 0 where all of the
            fingers' motors make all components.
    """

    components: Indices
    share: Array

    def warning(self, names: Sequence[str]) -> str:
        """Fingers whose structure carries more than `MOST_CARRIED`, with numbers and advice; empty without one.

        Args:
            names: Of the fingers, (N,).
        """
        said = ", ".join(
            f"{share:.0%} of the force of {name!r} "
            + (f"(motors make {made} of 3 components)" if made < 3 else "(other fingers share its motors)")
            for name, made, share in zip(names, self.components.tolist(), self.share.tolist(), strict=True)
            if share > MOST_CARRIED
        )
        return said and (
            f"no motor makes the forces that the structure of fingers carries: {said}. Torques do not correct them, so the object may "
            "slip although the commanded forces hold it; in PyBullet more often than in MuJoCo. Use engine='mujoco', "
            "engine=BulletEngine(solver_iterations=1500), or a place of the hand and contact_points at which motors push along the normals"
        )


def finger_structure(snapshot: Snapshot, kinematics: HandKinematics, grasp: Grasp, wrenches: Array) -> FingerStructure:
    """The parts of the forces that motors make and that structure carries, in the present posture.

    The motors' torques are J^T f of the contact forces f. Here J is the Jacobian of all contacts; coupled joints and motors that
    several fingers share are in it. The part of f in the null space of J^T takes no torque, and no torque changes it.

    Args:
        snapshot: The hand around the object; every finger touches.
        kinematics: Of the hand.
        grasp: The contacts there.
        wrenches: Loads on the object [N, N m], (K, 6), object frame. Those that the contacts cannot balance do not count.
    """
    count, motors, turn = len(snapshot.points), kinematics.motors, snapshot.rotation
    jacobian = kinematics.statics(snapshot.angles, snapshot.touch)[0][:, :, motors]
    span = motor_span(jacobian.reshape(3 * count, len(motors)))
    if span.shape[1] == 3 * count:
        return FingerStructure(np.full(count, 3), np.zeros(count))
    components: Indices = np.array([motor_span(part).shape[1] for part in jacobian], dtype=np.int64)
    found = optimize_forces(grasp, wrenches, workers=1).force
    forces = np.einsum("nij,mnj->mni", turn @ grasp.frames, found[np.isfinite(found).all(axis=(1, 2))]).reshape(
        -1, 3 * count
    )
    carried = forces - forces @ span @ span.T
    parts = [(part.reshape(-1, count, 3) ** 2).sum(axis=(0, 2)) for part in (carried, forces)]
    share = np.sqrt(parts[0] / np.maximum(parts[1], np.finfo(float).tiny))
    return FingerStructure(components, np.minimum(share, 1.0))  # what structure carries of one finger may push another

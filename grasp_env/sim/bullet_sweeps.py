"""Sweeps of Bullet's contact solver that a grasp needs."""

from __future__ import annotations

from typing import Any

import numpy as np

from grasp_env.grasp.grasp import Grasp
from grasp_env.inputs.arguments import Array
from grasp_env.sim.config import SceneConfig
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.hand.kinematics import HandKinematics

# fewest solver sweeps if a finger has more than three joints: with 20, the fingers of LEAP crept
# along objects by up to 3 mm in 4 s
LONG_SWEEPS = 40
# fewest solver sweeps with soft contacts: under shear and torsion at once a cylinder between four
# fingertips crept 1.4 mm in 2 s with 20 sweeps, 0.3 mm with 60
SOFT_SWEEPS = 60
# fewest solver sweeps if a finger has fewer than three motors and squeezes the object through its
# structure: iCub held a cube in 0 of 10 trials with 40 sweeps and in 10 with 400, the Ability hand
# a ball in 3 with 400 and in 10 with 800
STRUCTURE_SWEEPS = 800
# [1] error that the sweeps leave of contact forces that stick, and most sweeps for that. Robonaut's
# hand, whose links weigh 1 g, needs 90 sweeps and lost a ball in 5 of 5 trials with 20, in none
# with 90
_LEFT, MAX_CONTACT_SWEEPS = 1e-3, 2000


def min_sweeps(config: SceneConfig, angles: Array) -> int:
    """Return the solver sweeps that a grasp needs; couplings may raise the number."""
    soft = SOFT_SWEEPS if config.object.torsional_friction > 0.0 else 0
    return max(soft, _sweeps_of_fingers(config.hand), contact_sweeps(config, angles))


def contact_sweeps(config: SceneConfig, angles: Array) -> int:
    """Return the sweeps after which contacts that stick have `_LEFT` of their error.

    The solver is the method of Gauss and Seidel. It converges slowly if fingers are mobile in one
    direction and stiff in another, or if contacts push each other through the object.
    """
    kinematics = HandKinematics(config.hand)
    points = np.array(config.contact_points)
    motors = kinematics.motors
    mobility = np.linalg.inv(kinematics.mass_matrix(angles)[np.ix_(motors, motors)])
    grasp = Grasp.from_contacts(points, config.contact_normals, config.object.friction)
    moves = np.concatenate(
        [
            frame.T @ kinematics.jacobian(angles, finger, point)[:, motors]
            for finger, (frame, point) in enumerate(zip(grasp.frames, points, strict=True))
        ]
    )
    inverse = 1.0 / np.array([config.object.mass] * 3 + [*config.object.moments])
    matrix = moves @ mobility @ moves.T + (grasp.matrix.T * inverse) @ grasp.matrix
    lower = np.tril(matrix)
    rates: Any = np.linalg.eigvals(np.linalg.solve(lower, matrix - lower))
    error = float(np.abs(rates).max())
    if not error < np.exp(np.log(_LEFT) / MAX_CONTACT_SWEEPS):
        return MAX_CONTACT_SWEEPS
    return int(np.ceil(np.log(_LEFT) / np.log(max(error, _LEFT))))


def _sweeps_of_fingers(hand: HandDescription) -> int:
    """Return the solver sweeps that fingers need by the number of their joints and motors."""
    numbers = {link.name: index for index, link in enumerate(hand.links)}
    least = 0
    for tip in hand.fingertips:
        link = tip.link
        motors = set[int]()
        joints = 0
        while link in numbers:
            index = numbers[link]
            link = hand.links[index].parent
            joints += 1
            motors.add(hand.drivers[index])
        if joints > 3:
            least = max(least, LONG_SWEEPS)
        if len(motors) < 3:
            least = max(least, STRUCTURE_SWEEPS)
    return least

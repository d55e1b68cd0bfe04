"""Grasps with soft, elliptic and frictionless contacts, and limits, for the tests of the general methods."""

from __future__ import annotations

import numpy as np
from problems import GRASPS

from grasp_env.force import ForceLimits
from grasp_env.grasp import Grasp

CUBOID = GRASPS["cuboid, 4"]
LOAD = np.array([0.7, -0.4, 0.9, 0.011, -0.007, 0.013])


def soft(base: Grasp = CUBOID, gamma: float = 0.004, **options) -> Grasp:
    options = {"contact_model": "soft", "torsional_friction": gamma, **options}
    return Grasp.from_contacts(base.positions, base.normals, options.pop("friction", base.friction), **options)


PINCH = Grasp.from_contacts(
    [[0.001, 0.0, -0.02], [0.0, 0.002, 0.021]], [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], 0.5,
    contact_model="soft", torsional_friction=0.005,
)  # fmt: skip


def jacobian(count: int = 4, rows: int = 3, joints: int = 5, seed: int = 3) -> np.ndarray:
    """Every joint moves every contact."""
    return 0.08 * np.random.default_rng(seed).standard_normal((count, rows, joints))


def mixed() -> Grasp:
    return soft(
        GRASPS["cuboid, 5"], friction=np.column_stack([np.linspace(0.3, 0.9, 5), np.linspace(0.8, 0.4, 5)]),
        contact_model=["hard", "soft", "hard", "frictionless", "soft"],
    )  # fmt: skip


PROBLEMS = {
    "pinch": (PINCH, LOAD * [1, 1, 1, 0.3, 0.3, 0.1], None),
    "soft": (soft(), LOAD, None),
    "mixed": (mixed(), LOAD, None),
    "hard, largest normal": (CUBOID, LOAD, ForceLimits(max_normal=[3.5, 2.0, 2.0, 3.0])),
    "hard, normals": (CUBOID, LOAD, ForceLimits(min_normal=0.4, max_normal=6.0)),
    "soft, normals": (soft(), LOAD, ForceLimits(min_normal=[0.2, 0.0, 0.3, 0.0], max_normal=5.0)),
    "hard, torques": (CUBOID, LOAD, ForceLimits(jacobian=jacobian(), torque_limit=0.4)),
    "hard, torques, bias": (
        CUBOID, LOAD, ForceLimits(jacobian=jacobian(), torque_limit=[0.5, 0.4, np.inf, 0.4, 0.6], torque_bias=[0.1, 0, 0, -0.05, 0.1]),
    ),
    "soft, torsion in the torques": (soft(), LOAD, ForceLimits(jacobian=jacobian(rows=6), torque_limit=0.4)),
    "all": (mixed(), LOAD, ForceLimits(0.05, 8.0, jacobian(5, 6), 0.9)),
}  # fmt: skip
NAMES = list(PROBLEMS)

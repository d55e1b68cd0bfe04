"""The grasps and wrenches of the golden problems: fixed data and fixed seeds, nothing measured."""

from __future__ import annotations

import numpy as np

from grasp_env.grasp import Grasp, presets

PAPER = np.array([1.0, 0.5, -0.6, -0.1, 0.2, 0.0])
"""The paper's constant wrench [N, N m]."""
LIGHT = np.array([0.3, -0.2, 0.5, 0.01, -0.005, 0.008])
NONE = np.zeros(6)
METRES = np.array([1.0, 1.0, 1.0, 0.03, 0.03, 0.03])
"""Of random wrenches: one newton, and its moment at the size of a hand."""


def wrenches(seed: int, count: int, size: float = 1.5) -> np.ndarray:
    """(count, 6) random wrenches [N, N m]."""
    return size * METRES * np.random.default_rng(seed).standard_normal((count, 6))


def about(load: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """`load` (6,) of an object at the origin, told about an origin from which the object is `shift` away."""
    return np.concatenate([load[:3], load[3:] + np.cross(shift, load[:3])])


def _uneven(preset: Grasp, seed: int) -> Grasp:
    """Millimetres and degrees off the preset, friction unequal: no symmetry that would hide an error."""
    rng = np.random.default_rng(seed)
    normals = preset.normals + 0.03 * rng.standard_normal((preset.n_contacts, 3))
    return Grasp.from_contacts(
        preset.positions + 2e-3 * rng.standard_normal((preset.n_contacts, 3)),
        normals / np.linalg.norm(normals, axis=1)[:, None],
        preset.friction * rng.uniform(0.9, 1.3, preset.n_contacts),
    )


def ellipsoid(count: int, seed: int) -> Grasp:
    """`count` contacts on an ellipsoid, friction 0.3 to 1."""
    rng = np.random.default_rng(seed)
    axes = rng.uniform(0.03, 0.06, 3)
    directions = rng.standard_normal((count, 3))
    positions = directions / np.linalg.norm(directions, axis=1)[:, None] * axes
    normals = -positions / axes**2
    return Grasp.from_contacts(
        positions, normals / np.linalg.norm(normals, axis=1)[:, None], rng.uniform(0.3, 1.0, count)
    )


CUBOID = presets.paper_cuboid()
UNEVEN = _uneven(CUBOID, 4)
SHIFT = np.array([30.0, -20.0, 10.0])
"""[m] of the grasp far from the origin."""


def _plate() -> Grasp:
    """Four fingers on a plate of 2 mm: nearly flat, moments about its normal cost friction alone."""
    positions = np.array([[0.0, 0.001, -0.001], [0.03, 0.02, 0.001], [-0.03, 0.015, 0.001], [0.002, -0.03, 0.001]])
    return Grasp.from_contacts(positions, [[0, 0, 1.0], [0, 0, -1.0], [0, 0, -1.0], [0, 0, -1.0]], 0.4)


def _smooth() -> Grasp:
    """Eight frictionless contacts, two on each face but two, no two lines alike: form closure."""
    a, b = 0.03, 0.02
    positions = [[a, b, 0.004], [a, -b, -0.006], [-a, 0.012, 0.01], [b, a, -0.011], [-b, a, 0.009], [0.004, -a, 0.002], [0.006, 0.005, a], [0.001, 0.002, -a]]  # fmt: skip
    positions += [[-0.015, 0.01, a], [0.01, -0.016, -a], [-a, -0.014, -0.013], [0.015, -a, -0.012]]
    positions = np.array(positions)
    outward = np.where(np.abs(positions) == a, np.sign(positions), 0.0)
    return Grasp.from_contacts(positions, -outward, 1.0, contact_model="frictionless")


def _pinch() -> Grasp:
    return Grasp.from_contacts(
        [[0.001, 0, -0.02], [0, 0.002, 0.02]], [[0, 0, 1.0], [0, 0, -1.0]], [0.5, 0.6],
        contact_model="soft", torsional_friction=[0.005, 0.004],
    )  # fmt: skip


HARD: dict[str, Grasp] = {
    "tripod": presets.tripod(),
    "3 uneven": _uneven(presets.tripod(), 3),
    "cuboid": CUBOID,
    "4 uneven": UNEVEN,
    "5 uneven": _uneven(presets.five_finger_cuboid(), 5),
    "8 random": ellipsoid(8, 8),
    "16 random": ellipsoid(16, 16),
    "50 random": ellipsoid(50, 50),
    "plate": _plate(),
    "slippery": UNEVEN.with_friction([0.06, 0.08, 0.07, 0.09]),
    "millimetres": Grasp.from_contacts(1e3 * UNEVEN.positions, UNEVEN.normals, UNEVEN.friction),
    "far": Grasp.from_contacts(UNEVEN.positions + SHIFT, UNEVEN.normals, UNEVEN.friction),
}
"""Round cones at every contact, force closure."""
_FRICTION = np.array([[0.5, 0.3], [0.3, 0.5], [0.6, 0.4], [0.4, 0.45]])
OTHER: dict[str, Grasp] = {
    "elliptic": Grasp.from_contacts(UNEVEN.positions, UNEVEN.normals, _FRICTION, tangents=[[1.0, 0.3, 0.1]] * 4),
    "frictionless": _smooth(),
    "rough and frictionless": Grasp.from_contacts(
        HARD["8 random"].positions, HARD["8 random"].normals, HARD["8 random"].friction,
        contact_model=["hard", "frictionless"] * 4,
    ),
    "pinch": _pinch(),
    "soft": Grasp.from_contacts(
        UNEVEN.positions, UNEVEN.normals, UNEVEN.friction, contact_model="soft", torsional_friction=0.005
    ),
    "mixed": Grasp.from_contacts(
        HARD["5 uneven"].positions, HARD["5 uneven"].normals,
        [[0.5, 0.3], [0.4, 0.4], [0.45, 0.45], [1.0, 1.0], [0.5, 0.5]],
        contact_model=["hard", "soft", "hard", "frictionless", "soft"], torsional_friction=[1, 0.004, 1, 1, 0.006],
    ),
}  # fmt: skip
"""All other contacts; "elliptic" and the frictionless ones are the flows' too."""
FLOOR = Grasp.from_contacts([[0.03, 0, 0], [-0.03, 0.02, 0], [-0.02, -0.03, 0]], [[0.0, 0.0, 1.0]] * 3, 0.4)
"""No force closure: contacts that only push up."""
OPEN: dict[str, Grasp] = {"floor": FLOOR}
GRASPS = {**HARD, **OTHER, **OPEN}

"""Contacts of real hands that hold objects, as the environment sees them after a reset: the source of the tracks with hands.

`python -m benchmarks.force record HAND...` writes hands.json anew, HAND a built-in hand or a file that describes one. This needs the
simulator and the files; the tracks are made from hands.json alone.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.force.problems import Array
from grasp_env._files import replacing

FILE = Path(__file__).with_name("hands.json")
OBJECTS: tuple[tuple[str, tuple[float, ...]], ...] = (
    ("cuboid", (0.05, 0.05, 0.05)),
    ("sphere", (0.03,)),
    ("cylinder", (0.025, 0.09)),
)
MASS, FRICTION = 0.2, 0.6
"""[kg] and the coefficient of each object."""
DIGITS = 9
"""Significant digits that are kept."""


def record(hands: Sequence[str]) -> list[dict[str, Any]]:
    """Each hand around each object: contacts, friction, Jacobian, torque limits and the torques that carry the hand, object frame."""
    import gymnasium as gym

    from grasp_env.errors import GraspError
    from grasp_env.sim import HandDescription

    made = []
    for name in hands:
        builtin = getattr(HandDescription, name, None)
        hand = HandDescription.from_file(name) if builtin is None else builtin()
        for shape, size in OBJECTS:
            env = gym.make(
                "grasp_env:FourFingerGrasp-v0",
                hand=hand,
                shape=shape,
                size=size,
                mass=MASS,
                friction=FRICTION,
                disturbance="none",
            )
            try:
                env.reset(seed=0)
                made.append({"hand": Path(name).stem, "shape": shape, "mass": MASS, **_seen(env.unwrapped)})
            except GraspError as error:
                print(f"{name}, {shape}: {error}")
            finally:
                env.close()
    return made


def write(hands: Sequence[str], file: Path = FILE) -> None:
    """Writes the records."""
    lines = ",\n".join(json.dumps(each) for each in record(hands))
    with replacing(file) as temporary:
        temporary.write_text(f"[\n{lines}\n]\n", encoding="utf-8")


def _seen(env: Any) -> dict[str, Any]:
    scene = env.scene
    seen, kinematics = scene.look(), scene.kinematics
    touching = np.flatnonzero(seen.touching)
    to_object = seen.rotation.T
    jacobian = np.zeros((len(touching), 6, len(seen.angles)))
    for k, finger in enumerate(touching.tolist()):
        jacobian[k, :3] = to_object @ kinematics.jacobian(seen.angles, finger, seen.touch[finger])
    moves = np.abs(jacobian).max(axis=(0, 1)) > 0.0  # coupled joints are in the column of their motor
    arrays = {
        "positions": seen.points[touching], "normals": seen.normals[touching], "jacobian": jacobian[:, :, moves],
        "torque_limit": kinematics.torque_limits[moves], "torque_bias": seen.gravity_torques[moves], "gravity": to_object @ scene.gravity,
    }  # fmt: skip
    return {"friction": FRICTION} | {name: short(array, DIGITS).tolist() for name, array in arrays.items()}


def short(values: Any, digits: int) -> Array:
    """Values with so many significant digits."""
    array = np.asarray(values, dtype=float)
    return np.array([float(f"{value:.{digits - 1}e}") for value in array.ravel().tolist()]).reshape(array.shape)

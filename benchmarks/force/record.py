"""Contacts of real hands that hold objects, the source of the tracks with hands.

`python -m benchmarks.force record HAND...` records them after a reset of the environment and writes
hands.json, where HAND is a built-in hand or a file. The tracks need hands.json alone.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.force.problems import Array
from grasp_env.grasp import Grasp
from grasp_env.inputs.arguments import unit_vectors
from grasp_env.inputs.files import replacing

FILE = Path(__file__).with_name("hands.json")
OBJECTS = {"cuboid": (0.05, 0.05, 0.05), "sphere": (0.03,), "cylinder": (0.025, 0.09)}
MASS, FRICTION = 0.2, 0.6
"""Mass [kg] and friction of each object."""
DIGITS = 9
"""Number of significant digits in the file."""


def write(hands: Sequence[str]) -> None:
    """Record each hand around each object in `FILE`, in the object frame."""
    import gymnasium as gym

    from grasp_env.errors import GraspError
    from grasp_env.sim import HandDescription

    lines = []
    for name in hands:
        builtin = getattr(HandDescription, name, None)
        hand = HandDescription.from_file(name) if builtin is None else builtin()
        for shape, size in OBJECTS.items():
            thing = {"shape": shape, "size": size, "mass": MASS, "friction": FRICTION}
            env = gym.make("grasp_env:FourFingerGrasp-v0", hand=hand, disturbance="none", **thing)
            try:
                env.reset(seed=0)
                fields = {"hand": Path(name).stem, "shape": shape, "mass": MASS}
                lines.append(json.dumps(fields | _contacts(env.unwrapped)))
            except GraspError as error:
                print(f"{name}, {shape}: {error}")
            finally:
                env.close()
    with replacing(FILE) as temporary:
        temporary.write_text("[\n" + ",\n".join(lines) + "\n]\n", encoding="utf-8")


def recorded() -> list[tuple[str, dict[str, Any]]]:
    """Return names and fields of all records."""
    records = json.loads(FILE.read_text(encoding="utf-8"))
    arrays = (
        {k: np.array(v) if isinstance(v, list) else v for k, v in record.items()}
        for record in records
    )
    return [(f"{record['hand']}, {record['shape']}", record) for record in arrays]


def grasp_of_hand(hand: dict[str, Any]) -> Grasp:
    """Return the contacts of a record."""
    return Grasp.from_contacts(hand["positions"], unit_vectors(hand["normals"]), hand["friction"])


def weight(hand: dict[str, Any]) -> Array:
    """Return the wrench (6,) of the object's weight."""
    return np.concatenate([hand["mass"] * hand["gravity"], np.zeros(3)])


def shares_joints(jacobian: Array) -> bool:
    """Return True if a joint moves several contacts."""
    return bool((np.abs(jacobian).max(axis=1) > 0.0).sum(axis=0).max() > 1)


def coupled(hand: dict[str, Any]) -> dict[str, Any]:
    """Return the hand with one motor for each pair of joints of its two last fingers."""
    jacobian = hand["jacobian"]
    first, second = (np.flatnonzero(np.abs(jacobian[k]).max(axis=0)) for k in (-2, -1))
    pairs = list(zip(first.tolist(), second.tolist(), strict=False))
    joined = np.eye(jacobian.shape[2])
    for a, b in pairs:
        joined[b, a] = 1.0
    joined = np.delete(joined, [b for _, b in pairs], axis=1)
    names = ("jacobian", "torque_bias", "torque_limit")
    return hand | {name: hand[name] @ joined for name in names}


def _contacts(env: Any) -> dict[str, Any]:
    scene = env.scene
    state = scene.look()
    kinematics = scene.kinematics
    touching = np.flatnonzero(state.touching)
    to_object = state.rotation.T
    jacobian = np.zeros((len(touching), 6, len(state.angles)))
    for k, finger in enumerate(touching.tolist()):
        jacobian[k, :3] = to_object @ kinematics.jacobian(state.angles, finger, state.touch[finger])
    # coupled joints are in the column of their motor
    moves = np.abs(jacobian).max(axis=(0, 1)) > 0.0
    arrays = {
        "positions": state.points[touching],
        "normals": state.normals[touching],
        "jacobian": jacobian[:, :, moves],
        "torque_limit": kinematics.torque_limits[moves],
        "torque_bias": state.gravity_torques[moves],
        "gravity": to_object @ scene.gravity,
    }
    rounded = {name: short(array, DIGITS).tolist() for name, array in arrays.items()}
    return {"friction": FRICTION} | rounded


def short(values: Any, digits: int) -> Array:
    """Round values to a number of significant digits."""
    array = np.asarray(values, dtype=float)
    rounded = [float(f"{value:.{digits - 1}e}") for value in array.ravel().tolist()]
    return np.array(rounded).reshape(array.shape)

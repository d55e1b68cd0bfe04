"""Contacts of real hands that hold objects, recorded after a reset of the environment: the source of the tracks with hands.

`python -m benchmarks.force record HAND...` writes hands.json again, where HAND is a built-in hand or a file. It needs the
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
from grasp_env.grasp import Grasp

FILE = Path(__file__).with_name("hands.json")
OBJECTS: tuple[tuple[str, tuple[float, ...]], ...] = (
    ("cuboid", (0.05, 0.05, 0.05)),
    ("sphere", (0.03,)),
    ("cylinder", (0.025, 0.09)),
)
MASS, FRICTION = 0.2, 0.6
"""Mass [kg] and friction of each object."""
DIGITS = 9
"""Number of significant digits in the file."""


def record(hands: Sequence[str]) -> list[dict[str, Any]]:
    """Return contacts, friction, Jacobian, torque limits and gravity torques of each hand around each object, in the object frame."""
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
    """Write the records."""
    lines = ",\n".join(json.dumps(each) for each in record(hands))
    with replacing(file) as temporary:
        temporary.write_text(f"[\n{lines}\n]\n", encoding="utf-8")


def recorded() -> list[tuple[str, dict[str, Any]]]:
    """Names and fields of all records."""
    records = json.loads(FILE.read_text(encoding="utf-8"))
    return [
        (f"{each['hand']}, {each['shape']}", {k: np.array(v) if isinstance(v, list) else v for k, v in each.items()})
        for each in records
    ]


def grasp_of_hand(hand: dict[str, Any]) -> Grasp:
    """The contacts of a record."""
    return Grasp.from_contacts(
        hand["positions"], hand["normals"] / np.linalg.norm(hand["normals"], axis=1, keepdims=True), hand["friction"]
    )


def weight(hand: dict[str, Any]) -> Array:
    """(6,) the wrench of the object's weight."""
    return np.concatenate([hand["mass"] * hand["gravity"], np.zeros(3)])


def shares_joints(jacobian: Array) -> bool:
    """True if a joint moves several contacts."""
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
    return hand | {
        "jacobian": jacobian @ joined,
        "torque_bias": hand["torque_bias"] @ joined,
        "torque_limit": hand["torque_limit"] @ joined,
    }


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
    """Round values to a number of significant digits."""
    array = np.asarray(values, dtype=float)
    return np.array([float(f"{value:.{digits - 1}e}") for value in array.ravel().tolist()]).reshape(array.shape)

"""Contacts of real hands that hold objects, recorded after a reset of the environment: the source
of the tracks with hands.

`python -m benchmarks.force record HAND...` writes hands.json again, where HAND is a built-in hand
or a file. It needs the simulator and the files; the tracks are made from hands.json alone.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.force.problems import Array
from grasp_env.grasp import Grasp
from grasp_env.inputs.files import replacing

FILE = Path(__file__).with_name("hands.json")
OBJECTS = {"cuboid": (0.05, 0.05, 0.05), "sphere": (0.03,), "cylinder": (0.025, 0.09)}
MASS, FRICTION = 0.2, 0.6
"""Mass [kg] and friction of each object."""
DIGITS = 9
"""Number of significant digits in the file."""


def write(hands: Sequence[str]) -> None:
    """Write contacts, friction, Jacobian, torque limits and gravity torques of each hand around
    each object, in the object frame.
    """
    import gymnasium as gym

    from grasp_env.errors import GraspError
    from grasp_env.sim import HandDescription

    made = []
    for name in hands:
        builtin = getattr(HandDescription, name, None)
        hand = HandDescription.from_file(name) if builtin is None else builtin()
        for shape, size in OBJECTS.items():
            thing = {"shape": shape, "size": size, "mass": MASS, "friction": FRICTION}
            env = gym.make("grasp_env:FourFingerGrasp-v0", hand=hand, disturbance="none", **thing)
            try:
                env.reset(seed=0)
                seen = {
                    "hand": Path(name).stem,
                    "shape": shape,
                    "mass": MASS,
                    **_seen(env.unwrapped),
                }
                made.append(json.dumps(seen))
            except GraspError as error:
                print(f"{name}, {shape}: {error}")
            finally:
                env.close()
    with replacing(FILE) as temporary:
        temporary.write_text("[\n" + ",\n".join(made) + "\n]\n", encoding="utf-8")


def recorded() -> list[tuple[str, dict[str, Any]]]:
    """Names and fields of all records."""
    return [
        (
            f"{each['hand']}, {each['shape']}",
            {k: np.array(v) if isinstance(v, list) else v for k, v in each.items()},
        )
        for each in json.loads(FILE.read_text(encoding="utf-8"))
    ]


def grasp_of_hand(hand: dict[str, Any]) -> Grasp:
    """The contacts of a record."""
    normals = hand["normals"] / np.linalg.norm(hand["normals"], axis=1, keepdims=True)
    return Grasp.from_contacts(hand["positions"], normals, hand["friction"])


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
        name: hand[name] @ joined for name in ("jacobian", "torque_bias", "torque_limit")
    }


def _seen(env: Any) -> dict[str, Any]:
    scene = env.scene
    seen = scene.look()
    kinematics = scene.kinematics
    touching = np.flatnonzero(seen.touching)
    to_object = seen.rotation.T
    jacobian = np.zeros((len(touching), 6, len(seen.angles)))
    for k, finger in enumerate(touching.tolist()):
        jacobian[k, :3] = to_object @ kinematics.jacobian(seen.angles, finger, seen.touch[finger])
    # coupled joints are in the column of their motor
    moves = np.abs(jacobian).max(axis=(0, 1)) > 0.0
    arrays = {
        "positions": seen.points[touching],
        "normals": seen.normals[touching],
        "jacobian": jacobian[:, :, moves],
        "torque_limit": kinematics.torque_limits[moves],
        "torque_bias": seen.gravity_torques[moves],
        "gravity": to_object @ scene.gravity,
    }
    return {"friction": FRICTION} | {
        name: short(array, DIGITS).tolist() for name, array in arrays.items()
    }


def short(values: Any, digits: int) -> Array:
    """Round values to a number of significant digits."""
    array = np.asarray(values, dtype=float)
    return np.array([float(f"{value:.{digits - 1}e}") for value in array.ravel().tolist()]).reshape(
        array.shape
    )

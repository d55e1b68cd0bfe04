"""`examples/ros2_node.py` in a process of its own, beside the controller that it runs.

Skipped unless this Python, or the one that GRASP_ROS_PYTHON names, has rclpy.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from grasp_env.control import HandController, HandControllerSettings
from grasp_env.sim import HandDescription, HandKinematics

ROOT = Path(__file__).parents[1]
SIDE = Path(__file__).with_name("ros2_side.py")
PYTHON = os.environ.get("GRASP_ROS_PYTHON") or (sys.executable if find_spec("rclpy") else None)
PATIENCE = 120.0
"""Time of a run in addition to its phases [s]."""
RATE = 500.0
FRICTION = 0.6
GRAVITY = (0.0, -9.81, 0.0)
WEIGHT = (0.0, -1.5, 0.0, 0.0, 0.0, 0.0)
"""Wrench that the fingers balance [N, N m]."""
TIMES = {"stale": 0.1, "grace": 0.6, "fade": 0.1}
"""Times of the watchdog [s]; long enough that a busy machine does not look like a dead sensor."""
TOLERANCE = 1e-10
"""Gap of the solver: forces of different pasts then agree."""
SETTINGS = {"rate": RATE, "friction": FRICTION, "tolerance": TOLERANCE, **TIMES}
PARAMETERS = {"gravity": list(GRAVITY), **SETTINGS}
HAND = HandDescription.four_finger()
KINEMATICS = HandKinematics(HAND)


def contacts() -> np.ndarray:
    """(N, 6) positions and normals of contacts between the thumb and the fingers, float32 as they
    are sent."""
    tips = KINEMATICS.tips(KINEMATICS.home)
    normals = np.sign(tips.mean(axis=0) - tips) * [0.0, 0.0, 1.0]
    return (
        np.hstack([tips + KINEMATICS.tip_radii[:, None] * normals, normals])
        .astype(np.float32)
        .astype(np.float64)
    )


POINTS = contacts()
JOINTS = {
    "name": list(HAND.joint_names),
    "position": KINEMATICS.home.tolist(),
    "velocity": [0.0] * HAND.joint_count,
}
"""JointState at rest, as the other process reads it."""


def phase(seconds: float = 0.7, **changes: Any) -> dict[str, Any]:
    usual = {"joints": JOINTS, "points": POINTS.tolist(), "wrench": WEIGHT, "rate": 200}
    return {**usual, "seconds": seconds, **changes}


def play(python: str, phases: list[dict[str, Any]], **parameters: Any) -> dict[str, Any]:
    """Start the node with parameters and play phases to it; return what `ros2_side.main` found, and
    the node's output as "log"."""
    command = [python, str(ROOT / "examples/ros2_node.py"), "--ros-args"]
    command += [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
    with tempfile.TemporaryDirectory() as folder:
        domain = str(1 + os.getpid() % 100)
        given = {
            **os.environ,
            "PYTHONPATH": str(ROOT),
            "ROS_DOMAIN_ID": domain,
            "ROS_LOG_DIR": folder,
        }
        pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
        with subprocess.Popen(
            [python, SIDE], env=given, text=True, start_new_session=True, **pipes
        ) as process:
            try:
                seconds = PATIENCE + sum(phase["seconds"] for phase in phases)
                told, log = process.communicate(
                    json.dumps({"command": command, "phases": phases}), timeout=seconds
                )
            finally:
                if process.poll() is None:  # the node is in its session, too
                    os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == 0, log
    return {**json.loads(told), "log": log}


@pytest.mark.skipif(
    PYTHON is None, reason="GRASP_ROS_PYTHON must name a Python with rclpy: see docs/hardware.md"
)
def test_the_node_commands_what_its_controller_does():
    """Messages in any order of joints; lost and late contacts, a message that does not fit; a life
    cycle with an end."""
    lost = POINTS.copy()
    lost[1] = np.nan
    flat = POINTS.copy()
    flat[2, 3:] = 0.0
    mixed = {
        name: [*values[::-1], extra]
        for (name, values), extra in zip(JOINTS.items(), ("elbow", 9.0, 9.0), strict=True)
    }
    pushed = [0.4, -1.0, 0.2, 0.0, 0.01, 0.0]
    phases = {
        "held": phase(),
        "one finger lost": phase(points=lost.tolist()),
        "back, pushed, other order": phase(joints=mixed, wrench=pushed),
        "no contacts": phase(0.3, wrench=pushed, silent=["contacts"]),
        "none for long": phase(1.0, wrench=pushed, silent=["contacts"]),
        "there again": phase(wrench=pushed),
        "no joint states for long": phase(1.3, wrench=pushed, silent=["joint_states"]),
        "there once more": phase(wrench=pushed),
        "of three fingers": phase(1.3, wrench=pushed, points=POINTS[:3].tolist()),
        "of all": phase(wrench=pushed),
        "from the future": phase(1.3, wrench=pushed, ahead=10.0),
        "from now": phase(wrench=pushed),
        "two frames": phase(1.3, wrench=pushed, frames=["palm", "camera"]),
        "deactivated": phase(0.3, wrench=pushed, transitions=["deactivate"]),
        "active again": phase(wrench=pushed, transitions=["activate"]),
        "configured again": phase(
            wrench=pushed, transitions=["deactivate", "cleanup", "configure", "activate"]
        ),
        "normals of no length": phase(1.3, wrench=pushed, points=flat.tolist()),
    }
    told = play(str(PYTHON), list(phases.values()), **PARAMETERS)
    assert [told[name] for name in ("configured", "early", "activated", "code")] == [
        True,
        False,
        True,
        0,
    ]
    assert told["end"] == [0.0] * HAND.joint_count, "ctrl-C while it is active"
    sent = {stamp for played in told["phases"] for stamp in played["sent"]}
    answered = {*told["phases"][0]["seen"][1:]}
    assert answered <= sent, "stamped as the contacts that they answer"
    assert len(answered) > 50
    efforts = {name: played["effort"] for name, played in zip(phases, told["phases"], strict=True)}

    controller = HandController()
    controller.configure(HAND, HandControllerSettings(**SETTINGS))

    def torques(
        points: np.ndarray, wrench: Any, age: float = 0.0, count: int = 1000
    ) -> dict[str, float]:
        state = controller.new_state()
        state.angles = KINEMATICS.home
        touching = np.isfinite(points).all(axis=1)
        state.touching = touching.astype(float)
        state.positions[touching] = points[touching, :3]
        state.normals[touching] = points[touching, 3:]
        state.wrench = np.array(wrench)
        state.gravity = np.array(GRAVITY)
        state.ages[:2] = age
        if controller.status == "inactive":
            controller.activate(state)
        for _ in range(count):
            controller.update(state, 1.0 / RATE)
        return dict(zip(HAND.joint_names, controller.torques.tolist(), strict=True))

    expected = {
        "held": torques(POINTS, WEIGHT),
        "one finger lost": torques(lost, WEIGHT),
        "back, pushed, other order": torques(POINTS, pushed),
    }
    released = torques(POINTS, pushed, age=1.0)
    assert controller.status == "released"
    expected |= dict.fromkeys(
        ["no contacts", "there again", "there once more", "of all", "from now"],
        expected["back, pushed, other order"],
    )
    expected |= dict.fromkeys(
        [
            "none for long",
            "no joint states for long",
            "of three fingers",
            "from the future",
            "two frames",
            "normals of no length",
        ],
        released,
    )
    expected |= {
        "deactivated": dict.fromkeys(HAND.joint_names, 0.0),
        "active again": expected["of all"],
        "configured again": expected["of all"],
    }
    for name, effort in efforts.items():
        assert effort == pytest.approx(expected[name], abs=1e-5), name
    different = np.array(
        [list(values.values()) for values in (*list(expected.values())[:3], released)]
    )
    assert (
        np.abs(different[:, None] - different).max(axis=2)[~np.eye(4, dtype=bool)].min() > 0.01
    ), "or nothing was tested"
    for said in (
        "cannot activate: nothing came yet on joint_states, contacts, wrench",
        "holding, was released",
        "coasting, was holding",
        "released, was coasting",
        "contacts have 3 points, 4 fingertips need one each",
        "their frame_id differ",
        "contacts have normals of no length",
    ):
        assert said in told["log"]

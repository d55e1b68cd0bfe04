"""Round trips of `examples/ros2_node.py` in a separate process, from published contacts to received efforts."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.hand_loop import TRIP, WHOLE, draw
from benchmarks.settings import Benchmark, tick
from grasp_env._check import Array
from grasp_env.errors import GraspError, InvalidInputError
from grasp_env.sim import HandDescription, HandKinematics
from training.results.table import pd, table

ROOT = Path(__file__).parents[1]
SIDE = Path(__file__).with_name("ros2_side.py")
VARIABLE = "GRASP_ROS_PYTHON"
PATIENCE = 120.0
"""Time of a run in addition to its phases [s]."""
WEIGHT = (0.0, -1.5, 0.0, 0.0, 0.0, 0.0)
"""Wrench that the fingers balance [N, N m]."""


METHODS = {"ros2_500": "ROS 2, 500 Hz", "ros2_1000": "ROS 2, 1 kHz"}
"""Rates of the node."""
SLOWER = 0.97
"""Rate of the messages over the node's: the wait for its next update takes every value up to a period."""


@dataclass(frozen=True)
class Settings:
    """Duration of the measurement.

    Attributes:
        seconds: duration for each rate.
    """

    seconds: int = 60


def run(settings: Settings) -> pd.DataFrame:
    """Measure the rates one after another.

    Returns:
        A row for each answered message of contacts, with the time until its first answer, and a row for each rate with the number of
        unanswered messages.
    """
    hand = HandDescription.four_finger()
    kinematics = HandKinematics(hand)
    still = {"joints": joints(hand, kinematics.home), "points": contacts(kinematics).tolist(), "wrench": WEIGHT}
    rows: list[dict[str, Any]] = []
    for method in METHODS:
        rate = int(method.removeprefix("ros2_"))
        tick(METHODS[method])
        phase = {**still, "rate": SLOWER * rate, "seconds": settings.seconds}
        (played,) = play([phase], f"rate:={float(rate)}", "stale:=0.05")["phases"]
        first: dict[int, int] = {}
        for stamp, came in played["seen"]:
            first.setdefault(stamp, came - stamp)
        times = [1e-3 * first[stamp] for stamp in played["sent"] if stamp in first]
        keys = {"hand": hand.name, "method": method}
        rows += [{**keys, "case": TRIP, "problem": k, "latency": microseconds} for k, microseconds in enumerate(times)]
        rows.append({**keys, "case": WHOLE, "problem": 0, "unanswered": len(played["sent"]) - len(times)})
    return table(rows)


def joints(hand: HandDescription, angles: Array) -> dict[str, Any]:
    """A JointState at rest, as the other process reads it."""
    position = np.asarray(angles).tolist()
    return {"name": list(hand.joint_names), "position": position, "velocity": [0.0] * hand.joint_count}


def contacts(kinematics: HandKinematics) -> Array:
    """(N, 6) positions and normals of contacts between the thumb and the fingers of a built-in hand, float32 as they are sent."""
    tips = kinematics.tips(kinematics.home)
    normals = np.sign(tips.mean(axis=0) - tips) * [0.0, 0.0, 1.0]
    return np.hstack([tips + kinematics.tip_radii[:, None] * normals, normals]).astype(np.float32).astype(np.float64)


def interpreter() -> str:
    """The Python of a ROS 2 environment; an `InvalidInputError` if there is none."""
    if given := os.environ.get(VARIABLE):
        return given
    if find_spec("rclpy") is None:
        told = "the Python of an environment with rclpy; docs/hardware.md says how to make one"
        raise InvalidInputError(f"{VARIABLE} must name {told}")
    return sys.executable


def play(phases: list[dict[str, Any]], *parameters: str) -> dict[str, Any]:
    """Start the node with parameters, play phases to it, and return the results of `ros2_side.main`, with the node's output under "log".

    Raises:
        GraspError: a process ended.
    """
    python = interpreter()
    command = [python, str(ROOT / "examples/ros2_node.py"), "--ros-args"]
    task = {"command": [*command, *(word for given in parameters for word in ("-p", given))], "phases": phases}
    with tempfile.TemporaryDirectory() as folder:
        domain = str(1 + os.getpid() % 100)
        given = {**os.environ, "PYTHONPATH": str(ROOT), "ROS_DOMAIN_ID": domain, "ROS_LOG_DIR": folder}
        pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
        with subprocess.Popen([python, SIDE], env=given, text=True, start_new_session=True, **pipes) as process:
            try:
                seconds = PATIENCE + sum(phase["seconds"] for phase in phases)
                told, log = process.communicate(json.dumps(task), timeout=seconds)
            finally:
                if process.poll() is None:  # the node is in its session, too
                    os.killpg(process.pid, signal.SIGKILL)
    if process.returncode:
        raise GraspError(f"the ROS 2 processes ended: {log.strip()}")
    return {**json.loads(told), "log": log}


SHOWN = ("latency_median", "latency_p99", "latency_p999", "latency_max", "unanswered_sum")
BENCHMARK = Benchmark(run, Settings(), {"seconds": 5}, SHOWN, words=METHODS, draw=draw)

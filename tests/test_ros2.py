"""`examples/ros2_node.py` in a process of its own, beside the controller that it runs; skipped without an environment for ROS 2."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from benchmarks import ros2
from benchmarks.hand_loop import example
from grasp_env.errors import InvalidInputError
from grasp_env.sim import HandDescription, HandKinematics

RATE, FRICTION, GRAVITY = 500.0, 0.6, (0.0, -9.81, 0.0)
TIMES = {"stale": 0.1, "grace": 0.6, "fade": 0.1}
"""Times of the watchdog [s]; long enough that a busy machine does not look like a dead sensor."""
PARAMETERS = {"rate": RATE, "friction": FRICTION, "gravity": list(GRAVITY), **TIMES}
HAND = HandDescription.four_finger()
KINEMATICS = HandKinematics(HAND)
POINTS = ros2.contacts(KINEMATICS)


@pytest.fixture
def _needs_ros() -> None:
    try:
        ros2.interpreter()
    except InvalidInputError as error:
        pytest.skip(str(error))


def phase(seconds: float = 0.7, **changes: Any) -> dict[str, Any]:
    usual = {
        "joints": ros2.joints(HAND, KINEMATICS.home),
        "points": POINTS.tolist(),
        "wrench": ros2.WEIGHT,
        "rate": 200,
    }
    return {**usual, "seconds": seconds, **changes}


@pytest.mark.usefixtures("_needs_ros")
def test_the_node_commands_what_its_controller_does() -> None:
    """Messages in any order of joints; lost and late contacts, a message that does not fit; a life cycle with an end."""
    lost = POINTS.copy()
    lost[1] = np.nan
    usual = ros2.joints(HAND, KINEMATICS.home)
    mixed = {
        name: [*values[::-1], extra] for (name, values), extra in zip(usual.items(), ("elbow", 9.0, 9.0), strict=True)
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
        "deactivated": phase(0.3, wrench=pushed, transition="deactivate"),
        "active again": phase(wrench=pushed, transition="activate"),
    }
    told = ros2.play(list(phases.values()), *(f"{name}:={value}" for name, value in PARAMETERS.items()))
    assert [told[name] for name in ("configured", "early", "activated", "code")] == [True, False, True, 0]
    assert told["end"] == [0.0] * HAND.joint_count, "ctrl-C while it is active"
    sent = {stamp for played in told["phases"] for stamp in played["sent"]}
    answered = {stamp for stamp, _ in told["phases"][0]["seen"][1:]}
    assert answered <= sent, "stamped as the contacts that they answer"
    assert len(answered) > 50
    efforts = {name: played["effort"] for name, played in zip(phases, told["phases"], strict=True)}

    shown, table = example(), np.outer(HAND.torque_limits, [-1.0, 1.0])
    controller = shown.HandController()
    controller.configure(HAND, shown.Settings(rate=RATE, friction=FRICTION, **TIMES), shown.Calibration(table, table))

    def torques(points: np.ndarray, wrench: Any, age: float = 0.0, count: int = 1000) -> dict[str, float]:
        touching = np.isfinite(points).all(axis=1)
        state = shown.HandState(
            KINEMATICS.home, np.zeros(HAND.joint_count), touching, *np.nan_to_num(points).reshape(-1, 2, 3).swapaxes(0, 1).copy(),
            np.array(wrench), np.array(GRAVITY), age,
        )  # fmt: skip
        if controller.status == "inactive":
            controller.activate(state)
        for _ in range(count):
            controller.update(state, 1.0 / RATE)
        return dict(zip(HAND.joint_names, controller.torques, strict=True))

    expected = {
        "held": torques(POINTS, ros2.WEIGHT),
        "one finger lost": torques(lost, ros2.WEIGHT),
        "back, pushed, other order": torques(POINTS, pushed),
    }
    released = torques(POINTS, pushed, age=1.0)
    assert controller.status == "released"
    expected |= dict.fromkeys(
        ["no contacts", "there again", "there once more", "of all", "from now"], expected["back, pushed, other order"]
    )
    expected |= dict.fromkeys(
        ["none for long", "no joint states for long", "of three fingers", "from the future", "two frames"], released
    )
    expected |= {"deactivated": dict.fromkeys(HAND.joint_names, 0.0), "active again": expected["of all"]}
    for name, effort in efforts.items():
        assert effort == pytest.approx(expected[name], abs=1e-5), name
    different = np.array([list(values.values()) for values in (*list(expected.values())[:3], released)])
    assert np.abs(different[:, None] - different).max(axis=2)[~np.eye(4, dtype=bool)].min() > 0.01, (
        "or nothing was tested"
    )
    for said in (
        "cannot activate: nothing came yet on joint_states, contacts, wrench",
        "holding, was released",
        "coasting, was holding",
        "released, was coasting",
        "contacts have 3 points, 4 fingertips need one each",
        "their frame_id differ",
    ):
        assert said in told["log"]


@pytest.mark.usefixtures("_needs_ros")
def test_the_round_trip_is_measured() -> None:
    rows = ros2.run(ros2.Settings(seconds=1))
    for method in ros2.METHODS:
        part = rows[rows["method"] == method]
        latency = part["latency"].dropna()
        published = len(latency) + part["unanswered"].sum()
        assert abs(published - ros2.SLOWER * int(method.removeprefix("ros2_"))) <= 1
        assert len(latency) > 0.2 * published
        assert latency.between(50.0, 1e6).all()
    assert ros2.BENCHMARK.draw is not None
    assert len(ros2.BENCHMARK.draw(rows, ros2.METHODS).axes) == 1


def test_an_environment_without_ros_says_how_to_make_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(ros2.VARIABLE, raising=False)
    monkeypatch.setattr(ros2, "find_spec", lambda name: None)
    with pytest.raises(InvalidInputError, match=ros2.VARIABLE):
        ros2.interpreter()

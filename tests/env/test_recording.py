"""A recording runs again bit for bit, comes back from its files, and wrong files are refused."""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np
import pytest
from hands import gripper

from grasp_env import core
from grasp_env.control import (
    Calibration,
    HandController,
    HandControllerSettings,
    HandState,
    Recording,
    differences,
    replay,
)
from grasp_env.control.recording import OUTPUTS, STATUSES
from grasp_env.errors import InvalidInputError, UnknownNameError
from grasp_env.sim import HandDescription

pytest.importorskip("gymnasium", reason="the extra sim is not installed")

PERIOD = 1e-3
HOLDS = (core.Hold.optimized, core.Hold.place, core.Hold.reach, core.Hold.squeeze)


def holding(hand: HandDescription, weight: float = 1.5) -> HandState:
    """The fingertips on a ring, pressing inwards."""
    state = HandState(hand.joint_count, hand.finger_count)
    angles = 2.0 * np.pi * np.arange(hand.finger_count) / hand.finger_count
    outwards = np.column_stack([np.cos(angles), np.sin(angles), 0.0 * angles])
    state.angles[:] = hand.home
    state.touching[:] = 1.0
    state.positions[:], state.normals[:] = 0.03 * outwards, -outwards
    state.wrench[2] = -weight
    state.gravity[:] = 0.0, 0.0, -9.81
    state.ages[:] = PERIOD
    return state


def weak(hand: HandDescription) -> Calibration:
    """Motors with a hundredth of their torque, in raw numbers, with losses."""
    ends = np.outer(0.01 * np.array(hand.torque_limits), [-1.0, 0.0, 1.0])
    units = np.tile([-240.0, 10.0, 240.0], (hand.joint_count, 1))
    ones = np.ones(hand.joint_count)
    return Calibration(ends, units, 1e-3 * ones, 5.0 * ones)


def made(
    hand: HandDescription, calibration: Calibration | None = None, **settings: Any
) -> HandController:
    controller = HandController()
    controller.configure(hand, HandControllerSettings(**settings), calibration)
    controller.record(5.0)
    return controller


def run(controller: HandController, seed: int, events: int = 400) -> Recording:
    """Record random events: each lasts for some updates."""
    rng = np.random.default_rng(seed)
    hand = controller.hand
    state, good = holding(hand), holding(hand)
    foreign = HandState(hand.joint_count + 1, hand.finger_count)
    controller.activate(state)
    for _ in range(events):
        kind = rng.integers(14)
        state.numbers[:] = good.numbers
        state.angles[:] += rng.normal(0.0, 0.01, hand.joint_count)
        state.rates[:] = rng.normal(0.0, 0.1, hand.joint_count)
        state.wrench[:] += rng.normal(0.0, [0.3] * 3 + [0.01] * 3)
        state.object[:3] = rng.normal(0.0, 1e-4, 3)
        state.target[:3] = rng.normal(0.0, 1e-4, 3)
        period = rng.choice([PERIOD, 0.02, 0.0, -1.0, np.nan], p=[0.9, 0.04, 0.02, 0.02, 0.02])
        if kind == 0:
            controller.take_hold()
        elif kind == 1:
            controller.deactivate()
            if rng.random() < 0.5:
                controller.update(state, period)  # of no effect: nothing is recorded
            controller.activate(state)
        elif kind == 2:
            controller.activate(state)
        elif kind == 3:
            controller.hold = rng.choice(HOLDS, p=[0.7, 0.1, 0.1, 0.1])
        elif kind == 4:
            lost = rng.random(hand.finger_count) < 0.4
            state.touching[lost] = 0.0
            state.positions[lost] = np.nan
        elif kind == 5:
            state.numbers[rng.integers(len(state.numbers))] = rng.choice([np.nan, np.inf, -np.inf])
        elif kind == 6:
            state.normals[0] *= 2.0
        elif kind == 7:
            state.ages[rng.integers(3)] = 1.0
        elif kind == 8:
            state.wrench[:] *= 100.0
        elif kind == 9:
            state.wrench[:] = rng.choice([0.0, -0.0, 1e-300])
        for _ in range(rng.integers(1, 8) if kind != 7 else 300 * (rng.random() < 0.1)):
            controller.update(foreign if kind == 10 else state, period)
    return Recording.of(controller)


HANDS: dict[str, tuple[Any, dict[str, Any]]] = {
    "allegro": (HandDescription.allegro, {}),
    "two fingers": (lambda: gripper(2, 2), {"release": 0}),
    "soft": (HandDescription.leap, {"torsional_friction": 0.005, "joint_delay": 0.004}),
    "coarse": (
        HandDescription.four_finger,
        {"rate": 333.0, "stale_wrench": 0.05, "max_iterations": 2, "tolerance": 0.3},
    ),
}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("motors", ["strong", "weak"])
@pytest.mark.parametrize("name", HANDS)
def test_random_events_come_back_bit_for_bit(name, motors, seed):
    make, settings = HANDS[name]
    hand = make()
    recording = run(made(hand, weak(hand) if motors == "weak" else None, **settings), seed)
    again = replay(recording)
    assert differences(recording, again) == (0, None, dict.fromkeys(OUTPUTS, 0.0))
    other = [k for k, column in enumerate(recording.columns) if not column.startswith("duration")]
    a, b = (each.rows[:, other].tobytes() for each in (recording, again))
    assert a == b or np.array_equal(
        recording.rows[:, other], again.rows[:, other], equal_nan=True
    )
    assert {0.0, 1.0, 2.0, 3.0, 4.0} == {*recording["event"]}
    assert len({*recording["status"]}) > 2

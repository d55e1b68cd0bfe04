"""The environment finds a place for a hand that has none, and another where an object asks for it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from hands import gripper

from grasp_env.env.stage import Stage
from grasp_env.errors import InvalidInputError
from grasp_env.sim import HANDS, HandDescription, ObjectDescription
from grasp_env.sim.grasping import plan_grasp


def make(hand: HandDescription, **settings: Any) -> gym.Env[Any, Any]:
    return gym.make("grasp_env:FourFingerGrasp-v0", hand=hand, disturbance="none", friction=0.7, mass=0.15, **settings)


def stage(env: gym.Env[Any, Any]) -> Stage:
    return env.unwrapped._stage  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize("name", ["three_finger", "four_finger"])
def test_a_hand_without_a_place_holds(name: str) -> None:
    hand = replace(HANDS[name]().moved((3.0, 2.0, 1.0), (1.0, 2.0, 3.0)), placed=False)
    env = make(hand, shape="sphere", size=(0.06,), duration=0.5)
    env.reset(seed=0)
    assert np.abs(stage(env).scene.look().position).max() < 1e-4
    held = True
    while True:
        _, _, lost, over, _ = env.step(np.zeros(env.action_space.shape or ()))
        held = held and not lost
        if lost or over:
            break
    assert held
    env.close()


def test_other_objects_may_need_another_place() -> None:
    hand = gripper(3, 2)
    ball = {"shape": "sphere", "size": (0.06,), "randomize": {"size": (0.045, 0.05)}}
    env = make(hand, **ball)
    first = stage(env).scene.config.hand
    with pytest.raises(InvalidInputError):  # from the first place it cannot be grasped
        plan_grasp(ObjectDescription("sphere", (0.048,), mass=0.15, friction=0.7), stage(env).kinematics)
    env.reset(seed=1)
    there = stage(env).scene
    assert there.config.hand != first
    assert there.config.hand.finger_names == first.finger_names
    angles = there.look().angles.copy()
    env.reset(seed=2)
    env.reset(seed=1)  # whatever came between
    np.testing.assert_array_equal(stage(env).scene.look().angles, angles)
    env.close()

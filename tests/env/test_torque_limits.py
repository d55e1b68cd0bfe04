"""Motors with limits that are shared or far away."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from episodes import episode

from grasp_env.env import FourFingerGrasp
from grasp_env.sim import HandDescription
from grasp_env.sim.hand.tree import Mimic
from grasp_env.task import SixDirections

POINTS = ((0.0, 0.0, -0.05), (0.0, 0.03, 0.05), (-0.03, -0.02, 0.05), (0.03, -0.02, 0.05))
"""The reference grasp; a search would take other places for weak motors."""
PUSHES = SixDirections(push_time=0.5)


def weak(limit: float) -> HandDescription:
    """The four-finger hand with other motors."""
    hand = HandDescription.four_finger()
    return replace(hand, links=tuple(replace(link, torque_limit=limit) for link in hand.links))


def test_wide_limits_cost_nothing():
    """0.68 N m: the strongest pushes take 0.695 without limits; the object stays as it does with
    strong motors."""
    _, infos = episode(None, seed=0, hand=weak(0.68), contact_points=POINTS, task=PUSHES)
    assert infos[-1]["is_success"]
    assert sum(info["limited"] for info in infos) > 100
    assert not any(info["saturated"] for info in infos)
    assert max(info["drift"] for info in infos) < 1e-4
    assert min(info["torque_margin"] for info in infos) > 0.0
    strong = episode(20)[1]  # limits that are far away
    assert all(info["limited"] == 0 and not info["saturated"] for info in strong)
    assert 11.0 < min(info["torque_margin"] for info in strong) < 12.0


def test_a_shared_joint_keeps_its_limit():
    """The outer knuckles are coupled to one motor of 0.02 N m, of which pushes would take 0.029:
    rows of two contacts at once."""
    hand = HandDescription.four_finger()
    driver = "left_knuckle_joint"
    mimic = Mimic("left_knuckle_joint", -1.0)
    links = [
        replace(link, mimic=mimic)
        if link.joint == "right_knuckle_joint"
        else replace(link, torque_limit=0.02 if link.joint == driver else link.torque_limit)
        for link in hand.links
    ]
    env = FourFingerGrasp(
        hand=replace(hand, links=tuple(links)),
        contact_points=POINTS,
        task=PUSHES,
        agent={"rate": 250},
    )
    env.reset(seed=0)
    joint = hand.joint_names.index(driver)
    over = False
    torques = []
    limited = 0
    while not over:
        *_, terminated, truncated, info = env.step(np.zeros(6, dtype=np.float32))
        over = terminated or truncated
        torques.append(abs(env._loop.torques[joint]))
        limited += info["limited"] > 0
        assert not info["saturated"]
    env.close()
    assert limited > 20  # a push that stays takes no more iterations
    assert info["is_success"]
    assert 0.019 < max(torques) <= 0.02

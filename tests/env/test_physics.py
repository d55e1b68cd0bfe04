"""Physics of the held object: pushes, and faults of an episode that is not held.

Free fall and the friction cone are tested without a controller, in tests/sim.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from engines import needs_bullet
from episodes import NO_SPRINGS

from grasp_env.env.env import FourFingerGrasp
from grasp_env.sim import HandDescription
from grasp_env.sim.config import SceneConfig
from grasp_env.task import RandomWrench

ZERO = np.zeros(6, dtype=np.float32)
STRONG = RandomWrench(force=2.0, moment=0.06)


def test_pushes_keep_their_direction():
    """A moment that the controller does not know turns the object about z; the first push points to
    +x."""
    env = FourFingerGrasp(task="six_directions", sensors={"wrench": "none"}, controller=NO_SPRINGS)
    env.reset(seed=0, options={"wrench": [0.0, 0.0, 0.0, 0.0, 0.0, 0.1]})
    advance = env.scene.advance
    pushes = []

    def listen(torques: list[float], push: Any) -> None:
        pushes.append(env.scene.look().rotation @ push[:3])
        advance(torques, push)

    env.scene.advance = listen
    for _ in range(50):
        assert env.step(ZERO)[4]["failure"] == ""
    assert env.scene.look().rotation[1, 0] > 0.05
    np.testing.assert_allclose(pushes[50:], np.tile([2.0, 0.0, 0.0], (200, 1)), atol=1e-9)
    env.close()


def sliding(env: FourFingerGrasp) -> np.ndarray:
    """Velocities (N, 3) [m/s] of the touching fingertips along the object at their contacts, object
    frame."""
    s = env.scene.look()
    hand = env.scene.kinematics
    out = np.zeros_like(s.points)
    for finger in np.flatnonzero(s.touching):
        inward = s.rotation @ s.normals[finger]
        touch = s.touch[finger]
        rates = s.rates[hand.carries[finger]]
        axes = s.axes[hand.carries[finger]]
        origins = s.origins[hand.carries[finger]]
        tip = (rates[:, None] * np.cross(axes, touch - origins)).sum(axis=0)
        moves = tip - s.linear - np.cross(s.angular, touch - s.position)
        out[finger] = (moves - moves @ inward * inward) @ s.rotation
    return out


@needs_bullet
@pytest.mark.parametrize(
    ("limits", "fault"),
    [({}, ""), ({"max_slide": 1e-4}, "slid"), ({"max_overlap": 1e-6}, "overlap")],
)
def test_what_counts_as_held_is_true(limits, fault):
    """Sliding and overlap, from the states of every control tick; each limit tells an episode from
    a success. An agent feels the sliding three ticks late."""
    env = FourFingerGrasp(
        disturbance=STRONG,
        action_mode="grip",
        sensors={"delay": 0.012},
        agent={"rate": 250},
        duration=1.0,
        limits=limits,
    )
    _, info = env.reset(seed=1)
    way = np.zeros((4, 3))
    ways = [way]
    slid = 0.0
    overlap = 0.0
    ended = False
    while not ended:
        s = env.scene.look()
        way = way + sliding(env) / 250
        ways.append(way)
        slid = max(slid, np.linalg.norm(way, axis=1).max())
        overlap = max(overlap, -s.gaps.min())
        observed, _, _, ended, info = env.step(ZERO[:2])
        late = ways[max(len(ways) - 4, 0)]
        np.testing.assert_allclose(
            observed[-4:], np.linalg.norm(late, axis=1), rtol=1e-6, atol=1e-9
        )
        overlap = max(overlap, -env.scene.look().gaps.min())
        assert info["slip_distance"] == pytest.approx(slid, rel=1e-6, abs=1e-12)
        assert info["overlap"] == pytest.approx(overlap, rel=1e-9)
        assert info["stray_share"] == 0.0
    assert slid > 1e-4
    assert (info["failure"], info["fault"], info["is_success"]) == ("", fault, not fault)
    env.close()


@needs_bullet
def test_links_that_push_the_object_are_no_hold():
    """The fourth finger has no fingertip that counts, and its middle joint presses it on the
    object."""
    hand = HandDescription.four_finger()
    env = FourFingerGrasp(
        hand=replace(hand, fingertips=hand.fingertips[:3]),
        contact_points=SceneConfig().contact_points[:3],
        disturbance="none",
        duration=0.6,
        agent={"rate": 250},
        limits={"max_slide": 1.0},
    )
    env.reset(seed=0)
    advance = env.scene.advance
    env.scene.advance = lambda torques, wrench: advance([*torques[:10], 0.5, torques[11]], wrench)
    infos = [
        env.step(np.zeros(env.action_space.shape or (), dtype=np.float32))[4] for _ in range(150)
    ]
    env.close()
    assert infos[-1]["stray_share"] == pytest.approx(
        max(info["stray_force"] for info in infos) / (9.81 * 0.2)
    )
    assert infos[-1]["stray_share"] > 0.1
    assert infos[-1]["fault"] == "stray_force"
    assert (infos[-1]["failure"], infos[-1]["is_success"]) == ("", False)

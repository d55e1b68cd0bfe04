"""Wrong input and faults: clear errors, named causes, and never a number that is none."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from engines import bullet, needs_bullet

from grasp_env.env.env import FourFingerGrasp
from grasp_env.errors import GraspError, InvalidInputError, SimulationError, UnknownNameError
from grasp_env.sim import HandDescription, SceneConfig

ZERO = np.zeros(6, dtype=np.float32)


def connections() -> int:
    return sum(bullet.isConnected(number) for number in range(64)) if bullet else 0


FOUR = HandDescription.four_finger()
POINTS = SceneConfig().contact_points


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"sensors": {"delay": -1.0}}, "sensors.delay"),
        ({"render_mode": "ascii"}, "'ascii'"),
        ({"config": 3}, "config"),
        ({"shape": "mesh"}, "mesh"),
        ({"contact_points": POINTS[:1]}, "contact_points"),  # three fingers are left over
        ({"contact_points": (*POINTS[:3], (0.03, -0.02, 0.04))}, "surface"),
        ({"contact_points": (*POINTS[:3], (0.0, -0.05, 0.0))}, "reach|clear|unhindered"),
        ({"hand": FOUR.moved((0.0, 0.5, 0.0))}, "cannot be grasped by the hand 'four_finger': finger .* out of reach"),
        ({"size": (0.5, 0.02, 0.5)}, "cannot be grasped|did not settle|cannot hold"),  # it lies under the fingers
        ({"size": (0.1, 0.4, 0.1)}, "palm"),
        ({"hand": replace(FOUR, fingertips=FOUR.fingertips[:1])}, "more fingers"),  # no force closure
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_cannot_be_held_opens_nothing(settings: dict[str, Any], message: str) -> None:
    """Settings by themselves are in test_settings.py, motors that are too weak in test_torque_limits.py."""
    before = connections()
    with pytest.raises(GraspError, match=message):
        FourFingerGrasp(**settings)
    assert connections() == before


WRONG_ACTIONS: list[Any] = [
    np.array([np.nan, 0, 0, 0, 0, 0]), np.array([0, 0, np.inf, 0, 0, 0]), np.array([0, 0, 0, 0, 0, -np.inf]),
    np.zeros(5), np.zeros((1, 6)), np.float32(0.0), "x", None, {}, [None] * 6, [object()],
]  # fmt: skip


def test_wrong_actions_change_nothing():
    env = FourFingerGrasp(disturbance="random")
    rows = []
    for wrong in ([], WRONG_ACTIONS):
        env.reset(seed=0)
        env.step(ZERO)
        for action in wrong:
            with pytest.raises(InvalidInputError, match="action must be 6 finite numbers"):
                env.step(action)
        rows.append(env.step(ZERO)[0])
    np.testing.assert_array_equal(*rows)
    env.close()


def test_calls_in_the_wrong_order():
    before = connections()
    env = FourFingerGrasp(duration=0.1)
    assert connections() - before == (bullet is not None)
    with pytest.raises(SimulationError, match="reset"):
        env.step(ZERO)
    env.reset(seed=0)
    with pytest.raises(UnknownNameError, match="wrench"):
        env.reset(options={"wrnch": 1})
    for options in ("x", 5, [("wrench", np.zeros(6))]):
        with pytest.raises(InvalidInputError, match="options must be a dict"):
            env.reset(options=options)  # type: ignore[arg-type]
    for wrench in ([1, 2, np.inf, 0, 0, 0], [1, 2], "push", [1e300] * 6):
        with pytest.raises(GraspError, match="wrench"):
            env.reset(options={"wrench": wrench})
    env.reset(seed=0)
    assert [env.step(ZERO)[3] for _ in range(5)] == [False] * 4 + [True]
    with pytest.raises(SimulationError, match=r"time is up.*reset"):
        env.step(ZERO)
    env.close()
    env.close()
    assert connections() == before
    for call in (lambda: env.step(ZERO), env.render, lambda: env.scene):
        with pytest.raises(SimulationError, match=r"closed: call reset\(\)"):
            call()


def test_a_refused_reset_leaves_no_half_episode():
    """What was running goes on, or asks for a reset; it never runs with parts of the next episode."""
    rows = []
    for refused in (False, True):
        env = FourFingerGrasp(disturbance="random")
        env.reset(seed=0)
        if refused:
            with pytest.raises(GraspError):
                env.reset(seed=1, options={"wrench": [np.nan] * 6})
        rows.append([env.reset(seed=0)[0], *(env.step(ZERO)[0] for _ in range(3))])
        env.close()
    np.testing.assert_array_equal(*rows)


def finite(env: FourFingerGrasp, obs: np.ndarray, reward: float, info: dict[str, Any]) -> None:
    """No number that is none."""
    assert env.observation_space.contains(obs)
    assert np.isfinite([*obs, reward]).all()
    for key, value in info.items():
        assert isinstance(value, str) or np.isfinite(value).all(), key


FAR = {"max_drift": 1e9, "max_tilt": 10.0, "max_contact_gap": 1e9}


@pytest.mark.parametrize(
    ("limits", "wrench", "failures"),
    [
        ({}, [0, 0, 0, 0, 0, 3.0], ("dropped", "closure_lost")),  # far beyond the joint torques
        ({"max_drift": 1e9, "max_contact_gap": 1e9}, [0, 0, 0, 0, 0, 3.0], ("dropped",)),  # it turns
        *((FAR, [push, push, 0, 0, 0, push], ("simulation_diverged",)) for push in (1e5, 1e9, 1e12)),
    ],
)
def test_a_lost_object_ends_the_episode_with_its_cause(limits, wrench, failures):
    env = FourFingerGrasp(limits=limits)
    calm = env.reset(seed=0)[0]
    env.reset(seed=0, options={"wrench": wrench})
    terminated = False
    while not terminated:
        obs, reward, terminated, truncated, info = env.step(ZERO)
        assert not truncated
        finite(env, obs, reward, info)
    assert info["failure"] in failures
    assert reward == 0.0  # nothing more is earned
    assert not info["is_success"]
    with pytest.raises(SimulationError, match=info["failure"]):
        env.step(ZERO)
    np.testing.assert_array_equal(env.reset(seed=0)[0], calm)  # whole again, to the last bit
    assert not env.step(ZERO)[2]
    env.close()


@needs_bullet
def test_numbers_that_bullet_makes_none(monkeypatch):
    """Contact forces that are NaN, as Bullet gives after a divergence."""
    env = FourFingerGrasp()
    env.reset(seed=0)
    env.step(ZERO)
    real, broken = bullet.getContactPoints, []

    def contacts(*args: Any, **kwargs: Any) -> Any:
        rows = real(*args, **kwargs)
        broken.append(len(rows))
        return tuple((*row[:9], float("nan"), *row[10:]) for row in rows)

    monkeypatch.setattr(bullet, "getContactPoints", contacts)
    obs, reward, terminated, _, info = env.step(ZERO)
    monkeypatch.undo()
    assert sum(broken) > 0
    assert terminated
    assert info["failure"] == "simulation_diverged"
    finite(env, obs, reward, info)
    env.reset(seed=0)
    assert env.step(ZERO)[4]["status"] == "optimal"
    env.close()


@needs_bullet
def test_human_mode_without_a_display_is_a_clear_error(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    before = connections()
    with pytest.raises(SimulationError, match=r"display.*rgb_array"):
        FourFingerGrasp(render_mode="human")
    with pytest.raises(SimulationError, match="display"):
        gym.make("grasp_env:FourFingerGrasp-v0", render_mode="human")
    assert connections() == before


def test_objects_that_none_can_hold_are_not_drawn_for_ever():
    env = FourFingerGrasp(randomize={"mass": (0.1, 0.3), "friction": True})
    env.reset(seed=0)
    env.close()
    slippery = FourFingerGrasp(randomize={"mass": (60.0, 90.0), "friction": (0.011, 0.012)})
    with pytest.raises(SimulationError, match="random objects could be held"):
        slippery.reset(seed=0)
    slippery.close()

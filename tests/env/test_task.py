"""Plans of an episode: motions, pushes, payloads, and criteria of success."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from grasp_env.config import EnvConfig
from grasp_env.env.plan import Plan, make_plan
from grasp_env.task import Hold, Move, Payload, SixDirections
from grasp_env.task import motion as m
from grasp_env.task.disturbance import DISTURBANCES
from grasp_env.task.tasks import PUSH_RAMP

KINDS = [
    *[{"disturbance": name} for name in DISTURBANCES],
    *[{"task": {"name": "move", "motion": name}} for name in m.MOTIONS],
    {"task": "payload", "disturbance": "random"},
    {"task": "six_directions"},
]
BASE = EnvConfig().override(disturbance="none", duration=4.0)
STEP = 1e-4
TIMES = np.arange(round(4.0 / STEP) + 1) * STEP


def plan(seed: int = 0, **settings: Any) -> Plan:
    return make_plan(BASE.override(**settings), np.random.default_rng(seed), 0.2)


def arrays(made: Plan) -> tuple[np.ndarray, ...]:
    return made.wrench, made.push, made.gravity, made.target, made.mass_factor


@pytest.mark.parametrize("settings", KINDS, ids=str)
def test_longer_episodes_have_the_same_plan(settings):
    made = plan(**settings)
    again = plan(**settings)
    other = plan(seed=1, **settings)
    for array, width in zip(arrays(made), [(6,), (3,), (3,), (19,), ()], strict=True):
        assert array.shape == (1001, *width)
        assert np.isfinite(array).all()
    assert all(
        one.tobytes() == two.tobytes() for one, two in zip(arrays(made), arrays(again), strict=True)
    )
    draws = settings.get("disturbance") in ("random", "impulses", "tilting_gravity")
    assert draws == any(
        (one != two).any() for one, two in zip(arrays(made), arrays(other), strict=True)
    )
    longer = plan(duration=11.0, **settings)
    shorter = plan(duration=3.0, **settings)
    for name in ("wrench", "push", "gravity", "mass_factor"):
        assert getattr(longer, name)[:751].tobytes() == getattr(shorter, name).tobytes()
    generators = [np.random.default_rng(0) for _ in range(2)]
    for generator, config in zip(generators, (BASE, BASE.override(**settings)), strict=True):
        make_plan(config, generator, 0.2)
    # one draw, whatever the settings
    assert len({generator.random() for generator in generators}) == 1


def test_payload_changes_the_mass_smoothly():
    factor = plan(task=Payload(0.5, 1.2)).mass_factor
    t = np.arange(1001) / 250.0
    assert (factor[t <= 1.2] == 1.0).all()
    assert_allclose(factor[t >= 1.3], 0.5)
    assert (np.diff(factor) <= 0.0).all()


def test_six_pushes_in_order_with_short_ramps():
    tick = 0.004
    times = np.arange(3251) * tick  # 13 s
    push = SixDirections().push(times, tick, 0.2)
    expected = 2.0 * np.array(
        [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [0, 0, 0]]
    )
    for k, force in enumerate(expected):
        inside = (times > 2.0 * k + PUSH_RAMP) & (times < 2.0 * (k + 1) - 1e-9)
        assert_allclose(push[inside], np.tile(force, (inside.sum(), 1)), atol=1e-12)
    assert not push[0].any()
    # the steepest ramp turns 4 N within 50 ms, at most 15 / 8 of the mean rate
    assert (
        np.linalg.norm(np.diff(push, axis=0), axis=1).max()
        < 4.0 * 15.0 / 8.0 * tick / PUSH_RAMP * 1.001
    )
    short = SixDirections(push_time=0.1).push(times, tick, 0.2)  # a ramp of 25 ms
    assert_allclose(short[round(0.09 / tick)], [2.0, 0.0, 0.0], atol=1e-12)


def test_tasks_fill_in_their_own_limits_and_sizes():
    pushed, usual = (
        EnvConfig(task=task).resolved().limits for task in (SixDirections(push_time=0.5), Hold())
    )
    assert (pushed.duration, pushed.max_drift) == (3.0, 0.05)
    assert pushed.max_tilt == SixDirections.tilt_limit
    assert (usual.duration, usual.max_drift, usual.max_tilt) == (2.0, 0.02, 0.35)
    for motion, size in m.MOTION_SIZES.items():
        assert_array_equal(plan(task=Move(motion)).target, plan(task=Move(motion, size)).target)


def difference(values: np.ndarray) -> np.ndarray:
    return (values[2:] - values[:-2]) / (2.0 * STEP)


@pytest.mark.parametrize("motion", m.MOTIONS)
@pytest.mark.parametrize("period", [0.7, 1.5, 9.0])
def test_motions_have_exact_derivatives(motion, period):
    target = m.motion_target(motion, TIMES, 0.3, period)
    # central differences miss by STEP^2 / 6 of the next derivative but one, and by STEP / 2 of the
    # next where that jumps
    jerk = 0.3 * 60.0 * (3.0 / period) ** 3
    assert_allclose(difference(target[:, m.POSITION]), target[1:-1, m.LINEAR], atol=STEP**2 * jerk)
    for value, rate in ((m.LINEAR, m.LINEAR_ACCELERATION), (m.ANGULAR, m.ANGULAR_ACCELERATION)):
        assert_allclose(difference(target[:, value]), target[1:-1, rate], atol=STEP * jerk)
    rotation = Rotation.from_quat(target[:, m.QUATERNION])
    turned = (rotation[2:] * rotation[:-2].inv()).as_rotvec() / (2.0 * STEP)
    assert_allclose(turned, target[1:-1, m.ANGULAR], atol=1e-4)
    if period < 4.0:
        assert_allclose(target[[0, -1]], m.resting_target(2), atol=1e-12)


def test_motions_reach_their_size_and_rest():
    peak = {motion: np.abs(m.motion_target(motion, TIMES, 0.2, 1.0)) for motion in m.MOTIONS}
    assert peak["lift"][:, 1].max() == pytest.approx(0.2)
    assert peak["shake"][:, 0].max() == pytest.approx(0.2, rel=1e-6)
    assert 2.0 * np.arcsin(peak["rotate"][:, 5].max()) == pytest.approx(0.2)
    for motion, moving in (
        ("lift", [1, 6, 8, 14]),
        ("shake", [0, 6, 7, 13]),
        ("rotate", [5, 6, 12, 18]),
    ):
        assert not np.delete(peak[motion], moving, axis=1).any()
    target = m.motion_target("lift", TIMES, 0.1, 1.5)  # two periods end at 3 s
    assert_array_equal(target[TIMES > 3.0], m.resting_target(int((TIMES > 3.0).sum())))
    assert target[round(2.25 / STEP), 1] == pytest.approx(0.1)

"""Plans: what each task sets, that a seed fixes them, and what counts as success."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
import pytest

from grasp_env.config import EnvConfig
from grasp_env.env.plan import Plan, make_plan
from grasp_env.grasp.wrench import paper_path
from grasp_env.task.disturbance import DISTURBANCES
from grasp_env.task.motion import MOTION_SIZES, MOTIONS, resting_target
from grasp_env.task.tasks import TASKS, succeeded

MASS = 0.2


@dataclass(frozen=True)
class Settings:
    """What `make_plan` reads."""

    task: str = "hold"
    disturbance: str | None = "none"
    duration: float | None = 4.0
    control_rate: int = 250
    gravity: tuple[float, ...] = (0.0, -9.81, 0.0)
    disturbance_value: tuple[float, ...] = (1.0, 0.5, -0.6, -0.1, 0.2, 0.0)
    disturbance_scale: float | None = 1.0
    random_force: float = 0.6
    random_moment: float = 0.02
    random_time: float = 0.3
    impulse_force: float = 2.0
    impulse_moment: float = 0.05
    impulse_time: float = 0.03
    impulse_interval: float = 0.5
    tilt_angle: float = 0.5
    tilt_period: float = 2.0
    motion: str = "lift"
    motion_size: float | None = 0.04
    motion_period: float = 1.0
    payload_factor: float = 2.0
    payload_time: float = 1.0
    push_per_mass: float = 10.0
    push_time: float = 2.0


KINDS = [
    *[{"disturbance": name} for name in DISTURBANCES],
    *[{"task": "move", "motion": name} for name in MOTIONS],
    {"task": "payload", "disturbance": "random"},
    {"task": "six_directions", "disturbance": "random"},
]


def plan(seed: int = 0, **settings) -> Plan:
    return make_plan(Settings(**settings), np.random.default_rng(seed), MASS)


def arrays(made: Plan) -> tuple[np.ndarray, ...]:
    return made.wrench, made.push, made.gravity, made.target, made.mass_factor


@pytest.mark.parametrize("settings", KINDS)
def test_shapes_types_and_what_a_seed_fixes(settings):
    made = plan(**settings)
    assert len(made) == 1001
    for array, width in zip(arrays(made), [(6,), (3,), (3,), (19,), ()], strict=True):
        assert array.shape == (1001, *width)
        assert array.dtype == np.float64
        assert array.flags.c_contiguous
        assert array.flags.writeable
        assert np.isfinite(array).all()
    for again, array in zip(arrays(plan(**settings)), arrays(made), strict=True):
        assert again.tobytes() == array.tobytes()
    longer, shorter = plan(duration=11.0, **settings), plan(duration=3.0, **settings)
    for name in ("wrench", "push", "gravity", "mass_factor"):
        assert getattr(longer, name)[:751].tobytes() == getattr(shorter, name).tobytes()
    generator = np.random.default_rng(0)
    make_plan(Settings(**settings), generator, MASS)
    other = np.random.default_rng(0)
    make_plan(Settings(), other, MASS)
    assert generator.random() == other.random()  # the same draws, whatever the settings


@pytest.mark.parametrize("disturbance", ["random", "impulses", "tilting_gravity"])
def test_seeds_differ(disturbance):
    one, two = plan(1, disturbance=disturbance), plan(2, disturbance=disturbance)
    assert not np.array_equal(one.wrench, two.wrench) or not np.array_equal(one.gravity, two.gravity)


def test_hold_is_only_its_disturbance():
    made = plan(disturbance="constant", disturbance_scale=0.5)
    np.testing.assert_array_equal(made.wrench, np.tile([0.5, 0.25, -0.3, -0.05, 0.1, 0.0], (1001, 1)))
    np.testing.assert_array_equal(made.gravity, np.tile([0.0, -9.81, 0.0], (1001, 1)))
    np.testing.assert_array_equal(made.target, resting_target(1001))
    assert not made.push.any()
    assert (made.mass_factor == 1.0).all()
    assert not plan().wrench.any()


def test_paper_path_is_sampled_as_printed():
    wrench = plan(disturbance="paper_path", duration=2.0).wrench
    assert len(wrench) == 501
    t = np.arange(501) / 250.0
    pi, cos, sin = np.pi, np.cos, np.sin
    printed = [
        cos(pi * t), cos(pi * t) ** 2, 8 * cos(0.5 * pi * t) ** 2 - 5,
        0.2 * sin(pi * t), 0.2 * cos(pi * t), sin(0.5 * pi * t) ** 2,
    ]  # fmt: skip
    np.testing.assert_allclose(wrench, np.transpose(printed), rtol=0, atol=1e-15)
    scaled = plan(disturbance="paper_path", duration=2.0, disturbance_scale=0.1).wrench
    np.testing.assert_allclose(scaled, 0.1 * paper_path(t), rtol=0, atol=1e-15)


def test_move_follows_its_motion():
    made = plan(task="move", motion="shake", motion_size=0.02, motion_period=0.5, disturbance="random")
    assert np.abs(made.target[:, 0]).max() == pytest.approx(0.02, rel=1e-3)
    np.testing.assert_allclose(made.target[[0, -1]], resting_target(2), atol=1e-12)
    assert made.wrench.any()


def test_payload_changes_the_mass_within_a_tenth_of_a_second():
    factor = plan(task="payload", payload_factor=0.5, payload_time=1.2).mass_factor
    t = np.arange(1001) / 250.0
    assert (factor[t <= 1.2] == 1.0).all()
    np.testing.assert_allclose(factor[t >= 1.3], 0.5)
    assert (np.diff(factor) <= 0.0).all()
    assert factor[round(1.25 * 250)] == pytest.approx(0.75, abs=0.05)


def test_six_directions_pushes_in_proportion_to_the_mass_and_ignores_disturbances():
    made = plan(task="six_directions", disturbance="constant", duration=12.0)
    assert not made.wrench.any()
    np.testing.assert_allclose(made.push[250], [2.0, 0.0, 0.0])  # 10 N/kg of 0.2 kg
    np.testing.assert_allclose(made.push[-2], [0.0, 0.0, -2.0])
    directions = [tuple(np.sign(np.round(made.push[round((2 * k + 1) * 250)], 9))) for k in range(6)]
    assert directions == [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]


def test_the_table_of_tasks_names_what_exists():
    for name, task in TASKS.items():
        assert task.disturbance in DISTURBANCES
        assert np.isfinite(arrays(plan(task=name, duration=task.duration))[0]).all()
    assert TASKS["six_directions"].duration == 6 * 2.0


def test_what_is_not_given_is_the_own_of_the_task_and_of_the_motion():
    for name, task in TASKS.items():
        own = EnvConfig(task=name).resolved()
        assert (own.duration, own.disturbance) == (task.duration, task.disturbance)
        for motion, size in MOTION_SIZES.items():
            assert EnvConfig(task=name, motion=motion).resolved().motion_size == size
        given = EnvConfig(task=name, duration=1.5, disturbance="none", motion_size=0.01).resolved()
        assert (given.duration, given.disturbance, given.motion_size) == (1.5, "none", 0.01)


def test_success():
    for task in ("hold", "move", "payload"):
        assert succeeded(task, 0.019, 0.3, False)
        assert not succeeded(task, 0.0, 0.0, True)
    limits = {"drift": 0.049, "tilt": np.radians(14.9), "failed": False}
    assert succeeded("six_directions", **limits) is True
    for broken in ({"drift": 0.05}, {"tilt": np.radians(15.1)}, {"failed": True}, {"drift": np.nan}, {"tilt": np.nan}):
        assert succeeded("six_directions", **(limits | broken)) is False


@pytest.mark.parametrize("settings", KINDS)
@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-3, 1e3, 1e12])
def test_no_setting_gives_numbers_that_are_none(settings, size):
    base = Settings(**settings)
    for name in Settings.__dataclass_fields__:
        if isinstance(getattr(base, name), float) and name != "duration":
            made = make_plan(replace(base, **{name: size}), np.random.default_rng(0), MASS)
            assert all(np.isfinite(array).all() for array in arrays(made)), name
    tiny = make_plan(replace(base, duration=1e-9), np.random.default_rng(0), MASS)
    assert len(tiny) == 1
    for rate in (1, 1000):
        made = make_plan(replace(base, control_rate=rate), np.random.default_rng(0), MASS)
        assert all(np.isfinite(array).all() for array in arrays(made))


@pytest.mark.slow
@pytest.mark.parametrize("settings", KINDS)
def test_plans_are_fast(settings):
    """Half a millisecond for 4 s at 250 Hz; the fastest of some, as other work shares the machine."""
    config, generator = Settings(**settings), np.random.default_rng(0)
    spent = []
    for _ in range(50):
        start = time.perf_counter()
        make_plan(config, generator, MASS)
        spent.append(time.perf_counter() - start)
    assert min(spent) < 0.5e-3

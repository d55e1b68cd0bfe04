"""Plans: what each task sets, that a seed fixes them, and what counts as success."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import fields
from typing import Any

import numpy as np
import pytest

from grasp_env.config import EnvConfig
from grasp_env.env.plan import Plan, make_plan
from grasp_env.errors import GraspError
from grasp_env.task import (
    DISTURBANCES,
    TASKS,
    ConstantWrench,
    Hold,
    Move,
    NoDisturbance,
    Payload,
    SixDirections,
)
from grasp_env.task.motion import MOTION_SIZES, MOTIONS, resting_target

MASS = 0.2


KINDS = [
    *[{"disturbance": name} for name in DISTURBANCES],
    *[{"task": {"name": "move", "motion": name}} for name in MOTIONS],
    {"task": "payload", "disturbance": "random"},
    {"task": "six_directions"},
]
BASE = EnvConfig().override(disturbance="none", duration=4.0)


def plan(seed: int = 0, **settings: Any) -> Plan:
    return make_plan(BASE.override(**settings), np.random.default_rng(seed), MASS)


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
    generators = [np.random.default_rng(0) for _ in range(2)]
    for generator, config in zip(generators, (BASE, BASE.override(**settings)), strict=True):
        make_plan(config, generator, MASS)
    assert len({generator.random() for generator in generators}) == 1  # the same draws, whatever the settings


@pytest.mark.parametrize("disturbance", ["random", "impulses", "tilting_gravity"])
def test_seeds_differ(disturbance):
    one, two = (plan(seed, disturbance=disturbance) for seed in (1, 2))
    assert (one.wrench != two.wrench).any() or (one.gravity != two.gravity).any()


def test_hold_is_only_its_disturbance():
    made = plan(disturbance=ConstantWrench(scale=0.5))
    rows = ([0.5, 0.25, -0.3, -0.05, 0.1, 0.0], 0.0, [0.0, -9.81, 0.0], resting_target(1)[0], 1.0)
    for array, row in zip(arrays(made), rows, strict=True):
        np.testing.assert_array_equal(array, np.broadcast_to(row, array.shape))
    assert not plan().wrench.any()


def test_payload_changes_the_mass_within_a_tenth_of_a_second():
    factor = plan(task=Payload(0.5, 1.2)).mass_factor
    t = np.arange(1001) / 250.0
    assert (factor[t <= 1.2] == 1.0).all()
    np.testing.assert_allclose(factor[t >= 1.3], 0.5)
    assert (np.diff(factor) <= 0.0).all()
    assert factor[round(1.25 * 250)] == pytest.approx(0.75, abs=0.05)


def test_what_is_not_given_is_the_own_of_the_task_and_of_the_motion():
    for kind in TASKS.values():
        own, task = EnvConfig(task=kind()).resolved(), kind()
        assert (own.limits.duration, own.disturbance) == (task.duration, task.disturbance)
        assert np.isfinite(arrays(make_plan(own, np.random.default_rng(0), MASS))[0]).all()
        given = EnvConfig(task=kind()).override(duration=1.5, disturbance="none").resolved()
        assert (given.limits.duration, given.disturbance) == (1.5, NoDisturbance())
    for motion, size in MOTION_SIZES.items():
        assert (plan(task=Move(motion)).target == plan(task=Move(motion, size)).target).all()
    assert (SixDirections().duration, SixDirections(push_time=0.5).duration) == (12.0, 3.0)
    pushed = EnvConfig(task=SixDirections()).resolved().limits
    assert (pushed.max_drift, pushed.max_tilt) == (0.05, SixDirections.tilt_limit)
    usual = EnvConfig().resolved().limits
    assert (usual.max_drift, usual.max_tilt) == (0.02, 0.35)


def test_how_near_to_its_place_success_asks_the_object_to_be():
    for task in (Hold(), Move(), Payload()):
        assert task.in_place(0.019, 0.3)
    limits = {"drift": 0.049, "tilt": np.radians(14.9)}
    assert SixDirections().in_place(**limits) is True
    for broken in ({"drift": 0.05}, {"tilt": np.radians(15.1)}, {"drift": np.nan}, {"tilt": np.nan}):
        assert SixDirections().in_place(**(limits | broken)) is False


@pytest.mark.parametrize("record", [*DISTURBANCES.values(), *TASKS.values()])
@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3, 1e3, 1e9])
def test_no_setting_gives_numbers_that_are_none(record, size):
    """Every number of a task or disturbance, as small and as large as it may be, and the shortest episodes."""
    place = "disturbance" if record in DISTURBANCES.values() else "task"
    for item in fields(record):
        with suppress(GraspError):  # 0 is not allowed everywhere
            made = plan(**{place: record(**{item.name: size})})
            assert all(np.isfinite(array).all() for array in arrays(made)), item.name
    fast = {"controller.rate": 1000, "engine": {"name": "bullet", "rate": 1000}}
    for others in ({"duration": 1e-9}, {"controller": {"rate": 50}}, fast):
        made = plan(**{place: record()}, **others)
        assert all(np.isfinite(array).all() for array in arrays(made))
        assert len(made) == 1 or "duration" not in others


@pytest.mark.slow
@pytest.mark.parametrize("settings", KINDS)
def test_plans_are_fast(settings):
    """Half a millisecond for 4 s at 250 Hz; the fastest of some, as other work shares the machine."""
    config, generator = BASE.override(**settings), np.random.default_rng(0)
    spent = []
    for _ in range(50):
        start = time.perf_counter()
        make_plan(config, generator, MASS)
        spent.append(time.perf_counter() - start)
    assert min(spent) < 0.5e-3

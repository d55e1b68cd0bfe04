"""The states of a scene: exact resets, other objects and back, divergence, and memory that does not grow."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from engines import needs_bullet
from hands import numbers

from grasp_env.errors import InvalidInputError, SimulationError, UnknownNameError
from grasp_env.sim import BulletEngine, MujocoEngine, ObjectDescription, Scene, SceneConfig
from grasp_env.sim.engine import Engine

PUSH = np.array([0.4, -0.3, 0.2, 0.02, -0.03, 0.01])


def _record(scene: Scene, holder: Callable[[Scene], np.ndarray], steps: int = 60) -> np.ndarray:
    """Everything that can be read, over some steps in which the object is pushed about."""
    rows = []
    for k in range(steps):
        scene.step(holder(scene), PUSH * np.sin(0.2 * k))
        rows.append(numbers(scene))
    return np.array(rows)


@pytest.mark.parametrize(
    "engine", [pytest.param(BulletEngine(), marks=needs_bullet), MujocoEngine()], ids=lambda engine: engine.name
)
def test_reset_is_exact(make_scene: Callable[..., Scene], make_holder: Callable, engine: Engine) -> None:
    """To a kept state with its contact forces, to the start without any, and after the object was lost."""
    if engine.name == "mujoco":
        pytest.importorskip("mujoco", reason="the extra mujoco is not installed")
    first, held = {}, make_scene(engine=engine, substeps=engine.rate // 250)
    make_holder().settle(held)
    held.reset("settled")
    forces = held.look().forces.copy()
    assert held.look().touching.all()
    for lost in (False, False, True):
        for name in ("settled", "start"):
            held.reset(name)
            if name == "settled":
                np.testing.assert_array_equal(held.look().forces, forces)
            else:  # the nominal pose, before any contact
                assert not held.look().touching.any()
                np.testing.assert_array_equal(held.look().position, 0.0)
            record = _record(held, make_holder())
            np.testing.assert_array_equal(record, first.setdefault(name, record))
        for _ in range(200 * lost):
            held.step(np.zeros(12))
        assert not lost or held.look().position[1] < -0.3
    held.reset("settled")
    make_holder(squeeze=14.0).settle(held)  # keeps another state of that name
    _record(held, make_holder(), 5)
    held.reset("settled")
    assert held.look().forces[0, 2] == pytest.approx(14.0, abs=0.1)
    with pytest.raises(UnknownNameError, match=r"'setled'.*'start', 'settled'"):
        held.reset("setled")


def test_scenes_of_one_process_do_not_touch_each_other(make_scene: Callable[..., Scene], make_holder: Callable) -> None:
    """Also scenes whose server has another number than the first, in another place of which Bullet takes it; and what is drawn."""
    scenes = [make_scene(visuals=visuals) for visuals in (False, False, True, False)]
    for scene in scenes:
        make_holder().settle(scene, duration=0.1)
    first = _record(scenes[0], make_holder())
    scenes[1].load(scenes[1].config)
    make_holder().settle(scenes[1], duration=0.1)
    scenes[3].close()
    make_scene(gravity=(0.0, 0.0, 0.0))
    for scene in scenes[:3]:
        scene.reset("settled")
        np.testing.assert_array_equal(_record(scene, make_holder()), first)


def test_loading_another_object_and_back_is_exact(held: Scene, make_holder: Callable) -> None:
    """An object out of reach leaves the scene as it was."""
    config = held.config
    held.load(config)
    first = _record(held, make_holder())
    can = ObjectDescription("cylinder", (0.08, 0.1), mass=0.1, friction=0.6)
    points = ((0.0, 0.0, -0.04), (0.0, 0.03, 0.04), (-0.015, -0.02, 0.04), (0.015, -0.02, 0.04))
    points = tuple((x, y, np.sign(z) * np.sqrt(0.04**2 - x * x)) for x, y, z in points)
    held.load(SceneConfig(object=can, contact_points=points))
    assert held.config.object == can
    np.testing.assert_allclose(held.look().gaps, -1e-5, atol=1e-6)
    np.testing.assert_allclose(held.look().points, points, atol=1e-6)
    for name in ("start", "settled"):
        with pytest.raises(UnknownNameError, match=name):
            held.reset(name)  # of the object before
    held.load(config)
    held.keep("here")
    big = ObjectDescription(size=(0.1, 0.1, 0.6))
    far = tuple((x, y, 6.0 * z) for x, y, z in config.contact_points)
    with pytest.raises(InvalidInputError, match="cannot reach"):
        held.load(SceneConfig(object=big, contact_points=far))
    assert held.config == config
    held.reset("here")
    np.testing.assert_array_equal(_record(held, make_holder()), first)


def _throw(scene: Scene, wrench: np.ndarray) -> None:
    for _ in range(80):
        scene.step(np.zeros(12), wrench)
        scene.look()


def test_divergence_is_an_error_and_reset_mends_it(held: Scene, make_holder: Callable) -> None:
    first = _record(held, make_holder())
    for push in (1e6, 1e308):  # Bullet cuts speeds at 100 m/s; the second makes NaN
        held.reset("settled")
        with pytest.raises(SimulationError, match="diverged"):
            _throw(held, np.full(6, push))
        with pytest.raises(SimulationError, match="diverged"):
            held.look()  # asked again: no stale numbers
        held.reset("settled")
        np.testing.assert_array_equal(_record(held, make_holder()), first)


def _resident() -> int:
    """Memory of this process [bytes]; 0 where the system does not tell."""
    status = Path("/proc/self/statm")
    return int(status.read_text().split()[1]) * 4096 if status.exists() else 0


def test_memory_is_flat_over_resets(held: Scene, make_holder: Callable) -> None:
    holder, sizes = make_holder(), []
    for k in range(500):
        held.reset("settled")
        held.step(holder(held))
        held.look()
        held.keep("settled")
        if k in (99, 499):
            sizes.append(_resident())
    assert sizes[1] - sizes[0] < 1_000_000


def test_memory_is_flat_over_objects(held: Scene) -> None:
    """A leaked body takes 58 kB, a leaked state 97 kB."""
    sizes = []
    for k in range(90):
        size = 0.09 + 0.0002 * (k % 7)
        half = 0.5 * size
        points = tuple((x, y, np.sign(z) * half) for x, y, z in SceneConfig().contact_points)
        held.load(SceneConfig(object=ObjectDescription(size=(0.1, 0.1, size)), contact_points=points))
        if k in (29, 89):
            sizes.append(_resident())
    assert sizes[1] - sizes[0] < 1_500_000

"""The states of a scene: resets, other objects, divergence, and memory."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hands import numbers
from numpy.testing import assert_allclose, assert_array_equal

from grasp_env.errors import InvalidInputError, SimulationError, UnknownNameError
from grasp_env.sim import ObjectDescription, Scene
from grasp_env.sim.config import SceneConfig

PUSH = np.array([0.4, -0.3, 0.2, 0.02, -0.03, 0.01])


def record(scene: Scene, holder: Callable[[Scene], np.ndarray], steps: int = 40) -> np.ndarray:
    """Everything that can be read over some steps, while the object is pushed about."""
    rows = []
    for k in range(steps):
        scene.step(holder(scene), PUSH * np.sin(0.2 * k))
        rows.append(numbers(scene))
    return np.array(rows)


def test_reset_is_exact(make_scene, make_holder, engine):
    """To a saved state with its contact forces, to the start without any, and after the object was
    lost."""
    first = {}
    held = make_scene(engine=engine, substeps=engine.rate // 250)
    make_holder().settle(held)
    forces = held.look().forces.copy()
    assert held.look().touching.all()
    for lost in (False, True):
        for name in ("settled", "start"):
            held.reset(name)
            if name == "settled":
                assert_array_equal(held.look().forces, forces)
            else:  # the nominal pose, before any contact
                assert not held.look().touching.any()
                assert_array_equal(held.look().position, 0.0)
            rows = record(held, make_holder())
            assert_array_equal(rows, first.setdefault(name, rows))
        for _ in range(100 * (not lost)):
            held.step(np.zeros(12))
        assert lost or held.look().position[1] < -0.1
    held.reset("settled")
    make_holder(squeeze=14.0).settle(held)  # replaces the state of that name
    record(held, make_holder(), 5)
    held.reset("settled")
    assert held.look().forces[0, 2] == pytest.approx(14.0, abs=0.1)
    with pytest.raises(UnknownNameError, match=r"'setled'.*'start', 'settled'"):
        held.reset("setled")


def test_loading_another_object_and_back_is_exact(held, make_holder):
    """An object out of reach leaves the scene unchanged."""
    config = held.config
    held.load(config)
    first = record(held, make_holder())
    can = ObjectDescription("cylinder", (0.08, 0.1), mass=0.1, friction=0.6)
    points = ((0.0, 0.0, -0.04), (0.0, 0.03, 0.04), (-0.015, -0.02, 0.04), (0.015, -0.02, 0.04))
    points = tuple((x, y, np.sign(z) * np.sqrt(0.04**2 - x * x)) for x, y, z in points)
    held.load(SceneConfig(object=can, contact_points=points))
    assert held.config.object == can
    assert_allclose(held.look().gaps, -1e-5, atol=1e-6)
    assert_allclose(held.look().points, points, atol=1e-6)
    for name in ("start", "settled"):
        with pytest.raises(UnknownNameError, match=name):
            held.reset(name)  # of the object before
    held.load(config)
    held.keep("here")
    far = tuple((x, y, 6.0 * z) for x, y, z in config.contact_points)
    with pytest.raises(InvalidInputError, match="cannot reach"):
        held.load(SceneConfig(object=ObjectDescription(size=(0.1, 0.1, 0.6)), contact_points=far))
    assert held.config == config
    held.reset("here")
    assert_array_equal(record(held, make_holder()), first)


@pytest.mark.parametrize("push", [1e6, 1e12, 1e308])
def test_a_reset_mends_divergence(
    make_scene, make_holder, engine, push, tmp_path, monkeypatch, capfd
):
    """Bullet clips speeds at 100 m/s; 1e308 makes NaN."""
    monkeypatch.chdir(tmp_path)  # MuJoCo's log lies where it runs
    scene = make_scene(engine=engine, substeps=engine.rate // 250)
    make_holder().settle(scene)
    first = record(scene, make_holder())

    def throw() -> None:
        for _ in range(80):
            scene.advance([1e12] * 12, [push] * 6)
            scene.look()

    for call in (throw, scene.look):  # no stale numbers
        with pytest.raises(SimulationError, match="diverged"):
            call()
    assert capfd.readouterr() == ("", "")
    assert not list(tmp_path.iterdir())
    scene.reset("settled")
    assert_array_equal(record(scene, make_holder()), first)


def resident() -> int:
    """Memory of this process [bytes]; 0 if the system does not tell."""
    status = Path("/proc/self/statm")
    return int(status.read_text().split()[1]) * 4096 if status.exists() else 0


def test_memory_is_flat(held, make_holder):
    """A leaked state takes 97 kB, a leaked body 58 kB."""
    holder = make_holder()
    config = held.config
    sizes = []
    for k in range(120):
        held.reset("settled")
        held.step(holder(held))
        held.look()
        held.keep("settled")
        if k in (29, 119):
            sizes.append(resident())
    for k in range(80):
        points = tuple(
            (x, y, np.sign(z) * (0.045 + 1e-4 * (k % 7))) for x, y, z in config.contact_points
        )
        held.load(
            SceneConfig(
                object=ObjectDescription(size=(0.1, 0.1, 2.0 * points[1][2])), contact_points=points
            )
        )
        if k in (29, 79):
            sizes.append(resident())
    assert sizes[1] - sizes[0] < 1_000_000
    assert sizes[3] - sizes[2] < 1_500_000

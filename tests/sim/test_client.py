"""The connection: silent, closed once, and refusing what would end the process."""

from __future__ import annotations

import copy
import multiprocessing
import pickle
import subprocess
import sys
from collections.abc import Callable

import numpy as np
import pytest
from engines import Client, needs_bullet

from grasp_env.errors import SimulationError
from grasp_env.sim import Scene, SceneConfig
from grasp_env.sim.engine import engine_of


def _torque_sum(_: int) -> float:
    scene = Scene()
    scene.step(scene.look().gravity_torques)
    total = float(scene.look().angles.sum())
    scene.close()
    return total


def test_closing_twice_is_fine() -> None:
    scene = Scene()
    scene.close()
    scene.close()
    with pytest.raises(SimulationError, match="closed"):
        scene.look()


@pytest.mark.parametrize("name", ["reset", "look", "keep", "change_object"])
def test_use_after_close(name: str) -> None:
    scene = Scene()
    scene.look()
    scene.close()
    with pytest.raises(SimulationError, match="closed"):
        getattr(scene, name)(*{"change_object": (0.3,)}.get(name, ()))
    with pytest.raises(SimulationError, match="closed"):
        scene.step(np.zeros(12))


@needs_bullet
def test_window_without_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    for display in (None, ":9876"):
        if display is None:
            monkeypatch.delenv("DISPLAY", raising=False)
        else:
            monkeypatch.setenv("DISPLAY", display)
        with pytest.raises(SimulationError, match="display"):
            Client(gui=True)


@pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy, pickle.dumps])
def test_a_simulation_is_not_copied(make_scene: Callable[..., Scene], duplicate: Callable[[Scene], object]) -> None:
    with pytest.raises(SimulationError, match="copied"):
        duplicate(make_scene())


def test_nothing_is_printed() -> None:
    code = f"""
from grasp_env.sim import ENGINES, Scene, SceneConfig
Scene(SceneConfig(engine=ENGINES[{engine_of().name!r}]())).close()"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")


@pytest.mark.parametrize("method", ["fork", "spawn"])
@pytest.mark.filterwarnings("ignore:This process.*multi-threaded:DeprecationWarning")
def test_scenes_in_other_processes(method: str) -> None:
    with multiprocessing.get_context(method).Pool(1) as pool:
        assert pool.map(_torque_sum, range(2)) == [_torque_sum(0)] * 2


def test_two_scenes_do_not_touch_each_other() -> None:
    first, second = Scene(), Scene(SceneConfig(gravity=(0.0, 0.0, 0.0)))
    second.step(np.zeros(12))
    before = second.look().angles.copy()
    first.step(np.ones(12))
    assert np.array_equal(second.look().angles, before)
    first.close()
    second.step(np.zeros(12))
    second.close()

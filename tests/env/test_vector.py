"""Many environments: in one process, in several, spawned and forked; the same bits everywhere; memory that does not grow."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from grasp_env.env.env import FourFingerGrasp

ENV = "grasp_env:FourFingerGrasp-v0"
RANDOM = {"disturbance": "random"}
OBJECTS = {"randomize": ("shape", "size", "mass", "friction")}
ROUND = {"shape": "sphere", "disturbance": "random"}
NOISY = {"disturbance": "random", "sensors.pose_noise": 1e-5, "controller.force_noise": 0.01, "sensors.delay": 0.004}


def rollout(env: gym.Env[Any, Any], seed: int, steps: int = 10) -> bytes:
    """The bits of what an episode shows."""
    obs, info = env.reset(seed=seed)
    rows = [obs]
    numbers = [info["object_mass"], info["object_friction"], info["object_size"]]
    for _ in range(steps):
        obs, reward, _, _, info = env.step(np.zeros(6, dtype=np.float32))
        rows.append(obs)
        numbers += [reward, info["objective"], info["force_error"]]
    return np.array(rows).tobytes() + np.array(numbers).tobytes()


def make(settings: dict[str, Any]) -> Callable[[], gym.Env[Any, Any]]:
    return lambda: gym.make(ENV, **settings)


def _send(queue: Any, settings: list[dict[str, Any]]) -> None:
    """Runs in another process."""
    answers = []
    for one in settings:
        env = gym.make(ENV, **one)
        answers.append(rollout(env, 3))
        env.close()
    queue.put(answers)


@pytest.mark.parametrize("start", ["spawn", "fork"])
def test_same_bits_in_another_process(start):
    settings = [RANDOM, ROUND, OBJECTS, NOISY]
    context = multiprocessing.get_context(start)
    queue = context.Queue()
    process = context.Process(target=_send, args=(queue, settings))
    process.start()
    other = queue.get(timeout=300)
    process.join(timeout=30)
    for one, bits in zip(settings, other, strict=True):
        env = gym.make(ENV, **one)
        assert rollout(env, 3) == bits, one
        env.close()


@pytest.mark.parametrize(
    "settings", [{}, RANDOM, ROUND, OBJECTS, NOISY, {"task": "payload", "disturbance": "tilting_gravity"}]
)
def test_same_bits_whatever_came_before(settings):
    env = FourFingerGrasp(**settings)
    first = rollout(env, 3)
    for seed in range(20):
        env.reset(seed=seed)
        env.step(np.full(6, 0.7, dtype=np.float32))
    env.reset(seed=0, options={"wrench": [0.0, 0.0, 0.0, 0.0, 0.0, 4.0]})
    while not env.step(np.zeros(6, dtype=np.float32))[2]:  # lost
        pass
    assert rollout(env, 3) == first
    assert rollout(env, 3) == first
    env.close()


def test_objects_of_a_seed():
    """New ones at each reset, the same for a seed; a reset without seed goes on."""
    env = FourFingerGrasp(**OBJECTS)
    seen = []
    for seed in (1, None, None, 1, None, None):
        info = env.reset(seed=seed)[1]
        item = env.scene.config.object
        told = info["object_shape"], info["object_mass"], info["object_friction"]
        assert told == (item.shape, item.mass, item.friction)
        assert info["touching"].all()
        seen.append(item)
    env.close()
    assert seen[:3] == seen[3:]
    assert len(set(seen)) == 3


RANGES = {"shape": True, "size": (0.08, 0.11), "mass": (0.1, 0.3), "friction": (0.4, 0.7)}


@pytest.mark.parametrize("name", RANGES)
def test_only_what_is_named_is_drawn(name):
    """Another shape has another size."""
    env, items = FourFingerGrasp(randomize={name: RANGES[name]}), []
    for seed in range(6):
        env.reset(seed=seed)
        items.append(env.scene.config.object)
    env.close()
    drawn = {key for key in RANGES if len({getattr(item, key) for item in items}) > 1}
    assert name in drawn <= {name, "size"} if name == "shape" else drawn == {name}
    assert all(0.1 <= item.mass <= 0.3 and 0.4 <= item.friction <= 0.7 for item in items)


def _vector_rows(kind: str) -> np.ndarray:
    """(4, 2, size) observations of two environments with seeds 3 and 4, and closes them."""
    makers, zero = [make(RANDOM)] * 2, np.zeros((2, 6), dtype=np.float32)
    name, _, start = kind.partition(" ")
    envs: Any
    if name in ("sync", "async"):
        envs = gym.vector.AsyncVectorEnv(makers, context=start) if start else gym.vector.SyncVectorEnv(makers)
        first = envs.reset(seed=[3, 4])[0]
    else:
        envs = SubprocVecEnv(makers, start_method=start) if start else DummyVecEnv(makers)
        envs.seed(3)
        first = envs.reset()
    rows = [first.copy(), *(envs.step(zero)[0].copy() for _ in range(3))]
    envs.close()
    return np.array(rows)


@pytest.mark.parametrize(
    "kind",
    ["sync", "async fork", "async spawn", "sb3", "sb3 fork", pytest.param("sb3 spawn", marks=pytest.mark.slow)],
)
def test_vector_environments_agree_with_single_ones(kind):
    rows = _vector_rows(kind)
    for place, seed in enumerate((3, 4)):
        env = gym.make(ENV, **RANDOM)
        single = [env.reset(seed=seed)[0]] + [env.step(np.zeros(6, dtype=np.float32))[0] for _ in range(3)]
        env.close()
        assert np.array(single).tobytes() == rows[:, place].tobytes()


def _resident() -> int:
    """Memory of this process [bytes]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def _step(env: FourFingerGrasp, seed: int) -> None:
    env.reset(seed=seed)
    env.step(np.zeros(6, dtype=np.float32))


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="the system does not tell the memory of a process")
@pytest.mark.parametrize(
    ("settings", "count", "most"),
    [  # a state or a body that leaks at each reset takes 20 MB or more, an open client 30 MB of which 1 MB is allowed
        (RANDOM, 600, 4_000_000),
        ({"randomize": ("mass", "friction")}, 200, 4_000_000),
        pytest.param(OBJECTS, 600, 4_000_000, marks=pytest.mark.slow),
        (None, 24, 16_000_000),
    ],
    ids=["resets", "masses", "objects", "environments"],
)
def test_memory_is_flat(settings, count, most):
    env, sizes = FourFingerGrasp(**(settings or {})), []
    for seed in range(count):
        _step(env, seed) if settings else FourFingerGrasp().close()
        if seed in (count // 3, count - 1):
            sizes.append(_resident())
    env.close()
    assert sizes[1] - sizes[0] < most

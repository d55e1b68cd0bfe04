"""Many environments: in one process and in several, the same bits everywhere."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from grasp_env.env.env import FourFingerGrasp

ENV = "grasp_env:FourFingerGrasp-v0"
ZERO = np.zeros(6, dtype=np.float32)
RANDOM = {"disturbance": "random"}
OBJECTS = {"randomize": ("shape", "size", "mass", "friction")}
NOISY = {
    "shape": "sphere",
    "disturbance": "random",
    "sensors.pose_noise": 1e-5,
    "motors.noise": 0.01,
    "sensors.delay": 0.004,
}


def rollout(env: gym.Env[Any, Any], seed: int, steps: int = 10) -> bytes:
    """The bits of all that an episode shows."""
    observed, info = env.reset(seed=seed)
    rows = [observed]
    numbers = [info["object_mass"], info["object_friction"], info["object_size"]]
    for _ in range(steps):
        observed, reward, _, _, info = env.step(ZERO)
        rows.append(observed)
        numbers += [reward, info["objective"], info["force_error"]]
    return np.array(rows).tobytes() + np.array(numbers).tobytes()


@pytest.mark.parametrize(
    "settings", [RANDOM, OBJECTS, NOISY, {"task": "payload", "disturbance": "tilting_gravity"}]
)
def test_same_bits_whatever_came_before(settings):
    env = FourFingerGrasp(**settings)
    first = rollout(env, 3)
    objects = [env.scene.config.object]
    for seed in (1, None, 2):
        _, info = env.reset(seed=seed)
        for _ in range(60 if settings.get("task") else 2):  # beyond the growth of the payload
            env.step(np.full(6, 0.7, dtype=np.float32))
        objects.append(env.scene.config.object)
    assert len(set(objects)) == (4 if settings is OBJECTS else 2 if settings.get("task") else 1)
    assert info["object_shape"] == objects[-1].shape
    env.reset(seed=0, options={"wrench": [0.0, 0.0, 0.0, 0.0, 0.0, 4.0]})
    assert settings is OBJECTS or env.scene.config.object == objects[0]  # without the payload
    while not any(env.step(ZERO)[2:4]):  # lost, or the time is up
        pass
    assert rollout(env, 3) == first
    assert rollout(env, 3) == first
    env.close()


def vector_rows(kind: str) -> np.ndarray:
    """Return observations (4, 2, size) of two environments with seeds 3 and 4, and close them."""
    makers = [lambda: gym.make(ENV, **NOISY)] * 2
    zero = np.zeros((2, 6), dtype=np.float32)
    name, _, start = kind.partition(" ")
    envs: Any
    if name in ("sync", "async"):
        envs = (
            gym.vector.AsyncVectorEnv(makers, context=start)
            if start
            else gym.vector.SyncVectorEnv(makers)
        )
        first = envs.reset(seed=[3, 4])[0]
    else:
        envs = SubprocVecEnv(makers, start_method=start) if start else DummyVecEnv(makers)
        envs.seed(3)
        first = envs.reset()
    rows = [first.copy(), *(envs.step(zero)[0].copy() for _ in range(3))]
    envs.close()
    return np.array(rows)


@pytest.mark.parametrize("kind", ["sync", "async fork", "async spawn", "sb3", "sb3 fork"])
def test_vectors_agree_with_single_ones(kind):
    rows = vector_rows(kind)
    for place, seed in enumerate((3, 4)):
        env = gym.make(ENV, **NOISY)
        single = [env.reset(seed=seed)[0]] + [env.step(ZERO)[0] for _ in range(3)]
        env.close()
        assert np.array(single).tobytes() == rows[:, place].tobytes()

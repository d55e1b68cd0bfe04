"""The force loop's pieces: rotation vector, wrench to balance, disturbances."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from grasp_env.config import EnvConfig
from grasp_env.control import ForceLoop, rotation_vector
from grasp_env.disturbance import Disturbance
from grasp_env.grasp.wrench import paper_path
from grasp_env.sim.scene import ObjectState


def state(position=(0, 0, 0), turn=(0, 0, 0), linear=(0, 0, 0), angular=(0, 0, 0)) -> ObjectState:
    rotation = Rotation.from_rotvec(turn)
    return ObjectState(
        np.array(position, float),
        rotation.as_quat(),
        rotation.as_matrix(),
        np.array(linear, float),
        np.array(angular, float),
    )


def test_rotation_vector_against_scipy():
    rng = np.random.default_rng(0)
    for _ in range(200):
        vector = rng.normal(size=3) * rng.uniform(0, 0.9)
        np.testing.assert_allclose(rotation_vector(Rotation.from_rotvec(vector).as_matrix()), vector, atol=1e-12)
    np.testing.assert_allclose(rotation_vector(np.eye(3)), 0.0)


def test_wrench_to_balance_signs():
    loop = ForceLoop(EnvConfig(), "linear_combination")
    still = loop.wrench_to_balance(state(), np.zeros(6))
    np.testing.assert_allclose(still, [0, -0.2 * 9.81, 0, 0, 0, 0])
    # displaced to +x: the grasp must push back, so the wrench it balances points to +x
    assert loop.wrench_to_balance(state(position=(0.01, 0, 0)), np.zeros(6))[0] == 200 * 0.01
    assert loop.wrench_to_balance(state(linear=(0.1, 0, 0)), np.zeros(6))[0] > 0
    assert loop.wrench_to_balance(state(turn=(0, 0, 0.1)), np.zeros(6))[5] > 0
    # gravity stays in the world while the object turns
    turned = loop.wrench_to_balance(state(turn=(0, 0, np.pi / 2)), np.zeros(6))
    np.testing.assert_allclose(turned[:3], [-0.2 * 9.81, 0, 0], atol=1e-12)


def test_disturbances():
    def sample(count: int, **settings) -> np.ndarray:
        source = Disturbance(EnvConfig(**settings), np.random.default_rng(0))
        return np.array([source.at(k) for k in range(count)])

    np.testing.assert_array_equal(sample(3, wrench="constant"), np.tile([1, 0.5, -0.6, -0.1, 0.2, 0], (3, 1)))
    np.testing.assert_allclose(sample(500, wrench="paper_path")[125], 0.1 * paper_path(0.5))
    noise = sample(30_000, wrench="random")
    # 120 s at a correlation time of 0.3 s is about 200 independent draws per axis: 3 sigma is 15 %
    np.testing.assert_allclose(noise[:, :3].std(axis=0), 0.6, rtol=0.2)
    np.testing.assert_allclose(noise[:, 3:].std(axis=0), 0.02, rtol=0.2)
    lag = 75  # one correlation time
    correlation = [np.corrcoef(noise[:-lag, k], noise[lag:, k])[0, 1] for k in range(6)]
    np.testing.assert_allclose(np.mean(correlation), np.exp(-1), atol=0.1)
    assert not sample(4, wrench="none").any()


def test_random_does_not_depend_on_how_it_is_asked():
    one = Disturbance(EnvConfig(wrench="random"), np.random.default_rng(4))
    two = Disturbance(EnvConfig(wrench="random"), np.random.default_rng(4))
    far = one.at(20_000)  # 80 s: beyond any fixed length
    for k in (0, 700, 20_000):
        last = two.at(k)
    np.testing.assert_array_equal(far, last)
    assert not np.array_equal(one.at(20_000), one.at(19_999))

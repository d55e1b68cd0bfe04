"""Disturbances: random wrenches, impulses, tilting gravity, functions of a user."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from grasp_env.config import EnvConfig
from grasp_env.env.env import FourFingerGrasp
from grasp_env.sim import ObjectDescription
from grasp_env.task import Impulses, RandomWrench, TiltingGravity
from grasp_env.task.disturbance import Disturbed, disturb

TICK = 0.004
TIMES = np.arange(501) * TICK


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_the_random_wrench_is_ornstein_uhlenbeck():
    keep = np.exp(-1.0 / 75.0)  # a correlation time of 75 ticks
    noise = rng(3).standard_normal((500, 6)) * np.sqrt(1.0 - keep**2) * np.repeat([0.6, 0.02], 3)
    noise[0] = 0.0
    made = RandomWrench(time=75.0 * TICK)(np.arange(500) * TICK, rng(3), EnvConfig())
    np.testing.assert_allclose(
        made, lfilter([1.0], [1.0, -keep], noise, axis=0), rtol=1e-12, atol=1e-13
    )


@pytest.mark.parametrize("length", [0.1, 0.0005])
def test_impulses_deliver_their_momentum(length):
    wrench = Impulses(2.0, 0.05, length, 0.4)(np.arange(25_000) * TICK, rng(1), EnvConfig())
    assert np.linalg.norm(wrench[:, :3], axis=1).max() <= 2.0 + 1e-9
    assert np.linalg.norm(wrench[:, 3:], axis=1).max() <= 0.05 + 1e-9
    # runs of rows that are not zero are impulses, as long as none starts within the tick after
    # another
    change = np.diff(np.concatenate([[False], wrench.any(axis=1), [False]]).astype(int))
    first = np.flatnonzero(change == 1)
    last = np.flatnonzero(change == -1)
    given = np.array([wrench[a:b].sum(axis=0) * TICK for a, b in zip(first, last, strict=True)])
    sizes = np.linalg.norm(given[:, :3], axis=1)
    assert np.median(sizes) == pytest.approx(2.0 / np.pi * 2.0 * length, rel=1e-9)
    assert np.median(np.linalg.norm(given[:, 3:], axis=1)) == pytest.approx(
        2.0 / np.pi * 0.05 * length, rel=1e-9
    )
    # 100 s at a mean of 0.4 s + length: about 230 of them; 4 sigma of a renewal count
    assert len(first) == pytest.approx(100.0 / (0.4 + length), rel=4.0 / np.sqrt(200))
    direction = given[:, :3] / sizes[:, None]
    np.testing.assert_allclose(direction.mean(axis=0), 0.0, atol=4.0 / np.sqrt(3 * len(first)))


def test_short_waits_start_a_tick_apart():
    """So no row holds more than the momentum of one impulse, and most rows hold that of exactly
    one."""
    wrench = Impulses(2.0, 0.05, 0.1 * TICK, 0.3 * TICK)(
        np.arange(5000) * TICK, rng(2), EnvConfig()
    )
    for part, peak in ((wrench[:, :3], 2.0), (wrench[:, 3:], 0.05)):
        rows = np.linalg.norm(part, axis=1)
        whole = 2.0 / np.pi * peak * 0.1
        assert rows.max() <= whole * (1.0 + 1e-9)  # sums of 5000 impulses are rounded
        assert np.median(rows) == pytest.approx(whole, rel=1e-9)


def test_short_waits_are_not_lengthened():
    """An impulse of 5 ticks and a mean wait of 0.3 ticks: one in 5.3 ticks. Rows within one impulse
    share its direction."""
    wrench = Impulses(2.0, 0.05, 5.0 * TICK, 0.3 * TICK)(
        np.arange(5000) * TICK, rng(2), EnvConfig()
    )
    direction = wrench[:, :3] / np.maximum(np.linalg.norm(wrench[:, :3], axis=1), 1e-300)[:, None]
    # at least two rows lie within an impulse, and one that two impulses share follows
    same = (direction[1:] * direction[:-1]).sum(axis=1) > 1.0 - 1e-12
    count = np.count_nonzero(same[1:] & ~same[:-1]) + same[0]
    # waits of a standard deviation of 0.3 ticks: 4 sigma of their number, and one impulse at the
    # end
    assert count == pytest.approx(5000 / 5.3, abs=4.0 * np.sqrt(5000 / 5.3) * 0.3 / 5.3 + 1.0)


def test_gravity_tilts_from_rest():
    def tilted(seed: int, gravity: tuple[float, ...]) -> np.ndarray:
        settings = EnvConfig().override(gravity=gravity)
        return disturb(TiltingGravity(0.3, 2.0), np.arange(2001) * TICK, rng(seed), settings)[1]

    headings = []
    for seed in range(8):
        falls = tilted(seed, (0.0, -9.81, 0.0))
        np.testing.assert_allclose(np.linalg.norm(falls, axis=1), 9.81)
        np.testing.assert_allclose(falls[0], [0.0, -9.81, 0.0], atol=1e-12)
        assert np.abs(np.diff(falls[:3], axis=0)).max() < 1e-6  # at rest at the start
        tilt = np.arccos(np.clip(-falls[:, 1] / 9.81, -1.0, 1.0))
        assert tilt.max() == pytest.approx(0.3, abs=1e-4)
        assert np.linalg.matrix_rank(falls, tol=1e-9) == 2  # in one plane
        far = falls[np.argmax(tilt)]
        headings.append(np.arctan2(far[2], far[0]))
    assert np.ptp(headings) > 2.0
    assert not tilted(0, (0.0, 0.0, 0.0)).any()
    np.testing.assert_allclose(np.linalg.norm(tilted(0, (1.0, -2.0, 0.5)), axis=1), np.sqrt(5.25))


def gust(times: np.ndarray, rng: np.random.Generator, settings: EnvConfig) -> np.ndarray:
    """A user's own: a push along x from 1 s on, of random size."""
    wrench = np.zeros((len(times), 6))
    wrench[times >= 1.0, 0] = settings.object.mass * rng.uniform(4.0, 5.0)
    return wrench


def test_any_function_is_a_disturbance():
    wrench, gravity = disturb(gust, TIMES, rng(), EnvConfig(object=ObjectDescription(mass=0.5)))
    assert not wrench[:250].any()
    assert (wrench[250:, 0] == 0.5 * rng().uniform(4.0, 5.0)).all()
    assert (gravity == [0.0, -9.81, 0.0]).all()
    sideways = np.tile([1.0, 0.0, 0.0], (501, 1))
    wrench, gravity = disturb(lambda *_: Disturbed(gravity=sideways), TIMES, rng(), EnvConfig())
    assert not wrench.any()
    assert (gravity == sideways).all()
    env = FourFingerGrasp(disturbance=gust, duration=1.2)
    env.reset(seed=3)
    pushes = [env.step(np.zeros(6, np.float32))[4]["wrench"][0] for _ in range(60)]
    env.close()
    assert 0.2 * 4.0 - 0.1 < pushes[-1] - pushes[0] < 0.2 * 5.0 + 0.1


def test_gravity_of_a_disturbance_lasts_one_episode():
    downs = [np.array([0.0, -5.0, 0.0]), np.array([3.0, -9.81, 0.0]), np.array([0.0, -9.81, 0.0])]

    def made(times: np.ndarray, rng: np.random.Generator, settings: EnvConfig) -> Disturbed:
        return Disturbed(gravity=np.tile(downs[0], (len(times), 1)))

    env = FourFingerGrasp(disturbance=made)
    while downs:
        env.reset(seed=0)
        env.step(np.zeros(6, np.float32))
        np.testing.assert_array_equal(env.scene.gravity, downs.pop(0))
    env.close()

"""Disturbances: statistics, momentum, directions, continuity, and what a seed fixes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from grasp_env.config import EnvConfig
from grasp_env.env.env import FourFingerGrasp
from grasp_env.errors import InvalidInputError
from grasp_env.sim import ObjectDescription
from grasp_env.task import DISTURBANCES, Disturbed, Impulses, RandomWrench, SixDirections, TiltingGravity
from grasp_env.task.disturbance import disturb
from grasp_env.task.tasks import PUSH_RAMP

TICK = 0.004
TIMES = np.arange(501) * TICK
G = np.array([0.0, -9.81, 0.0])


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def walk(ticks: int, seed: int) -> np.ndarray:
    """Random wrenches with a correlation time of 75 ticks."""
    return RandomWrench(time=75.0 * TICK)(np.arange(ticks) * TICK, rng(seed), EnvConfig())


def tilted(times: np.ndarray, seed: int, gravity: tuple[float, ...]) -> np.ndarray:
    """Gravity that swings by 0.3 rad with a period of 2 s."""
    return disturb(TiltingGravity(0.3, 2.0), times, rng(seed), EnvConfig().override(gravity=gravity))[1]


def test_ornstein_uhlenbeck_has_its_deviation_and_correlation_time():
    deviation = np.array([0.6, 0.6, 0.6, 0.02, 0.02, 0.02])
    path = walk(250_000, 0)
    assert not path[0].any()
    # 250 000 / (2 * 75) = 1667 independent draws per axis: one sigma of a deviation is 1.7 %
    np.testing.assert_allclose(path.std(axis=0), deviation, rtol=0.06)
    np.testing.assert_allclose(path.mean(axis=0) / deviation, 0.0, atol=4.0 / np.sqrt(1667))
    for lag in (15, 75, 150):
        correlation = [np.corrcoef(path[:-lag, k], path[lag:, k])[0, 1] for k in range(6)]
        np.testing.assert_allclose(correlation, np.exp(-lag / 75.0), atol=0.1)
    np.testing.assert_allclose(np.corrcoef(path.T), np.eye(6), atol=0.1)  # axes are independent


def test_ornstein_uhlenbeck_against_lfilter():
    keep = np.exp(-1.0 / 75.0)
    noise = rng(3).standard_normal((500, 6)) * np.sqrt(1.0 - keep**2) * np.repeat([0.6, 0.02], 3)
    noise[0] = 0.0
    expected = lfilter([1.0], [1.0, -keep], noise, axis=0)
    np.testing.assert_allclose(walk(500, 3), expected, rtol=1e-12, atol=1e-13)
    starts = np.array([walk(76, k)[[1, 75], 0] / 0.6 for k in range(2000)])  # their variance grows
    expected = np.sqrt(1.0 - np.exp(-2.0 * np.array([1, 75]) / 75.0))
    np.testing.assert_allclose(starts.std(axis=0), expected, rtol=0.07)  # 4 sigma of 2000 draws


def test_impulses_deliver_their_momentum_however_short():
    for length in (0.1, 0.004, 0.0005):
        wrench = Impulses(2.0, 0.05, length, 0.4)(np.arange(25_000) * TICK, rng(1), EnvConfig())
        assert np.linalg.norm(wrench[:, :3], axis=1).max() <= 2.0 + 1e-9
        assert np.linalg.norm(wrench[:, 3:], axis=1).max() <= 0.05 + 1e-9
        # runs of rows that are not zero are impulses, as long as none starts within the tick after another
        busy = np.concatenate([[False], wrench.any(axis=1), [False]])
        first, last = np.flatnonzero(np.diff(busy.astype(int)) == 1), np.flatnonzero(np.diff(busy.astype(int)) == -1)
        given = np.array([wrench[a:b].sum(axis=0) * TICK for a, b in zip(first, last, strict=True)])
        sizes = np.linalg.norm(given[:, :3], axis=1)
        assert np.median(sizes) == pytest.approx(2.0 / np.pi * 2.0 * length, rel=1e-9)
        assert np.median(np.linalg.norm(given[:, 3:], axis=1)) == pytest.approx(2.0 / np.pi * 0.05 * length, rel=1e-9)
        # 100 s at a mean of 0.4 s + length: about 230 of them; 4 sigma of a renewal count
        assert len(first) == pytest.approx(100.0 / (0.4 + length), rel=4.0 / np.sqrt(200))
        direction = given[:, :3] / sizes[:, None]
        np.testing.assert_allclose(direction.mean(axis=0), 0.0, atol=4.0 / np.sqrt(3 * len(first)))


def test_impulses_without_waits_end():
    wrench = Impulses(1.0, 0.0, 1e-9, 1e-9)(TIMES[:500], rng(), EnvConfig())
    assert wrench.shape == (500, 6)
    assert np.isfinite(wrench).all()
    assert not wrench[:, 3:].any()


def test_gravity_tilts_about_a_horizontal_axis_from_rest():
    times = np.arange(2001) * TICK
    headings = []
    for seed in range(20):
        falls = tilted(times, seed, (0.0, -9.81, 0.0))
        np.testing.assert_allclose(np.linalg.norm(falls, axis=1), 9.81)
        np.testing.assert_allclose(falls[0], [0.0, -9.81, 0.0], atol=1e-12)
        assert np.abs(np.diff(falls[:3], axis=0)).max() < 1e-6  # no rate at the start
        tilt = np.arccos(np.clip(-falls[:, 1] / 9.81, -1.0, 1.0))
        assert tilt.max() == pytest.approx(0.3, abs=1e-4)
        np.testing.assert_allclose(np.linalg.matrix_rank(falls, tol=1e-9), 2)  # in one plane
        far = falls[np.argmax(tilt)]
        headings.append(np.arctan2(far[2], far[0]))
    assert np.ptp(headings) > 2.0
    assert not tilted(times, 0, (0.0, 0.0, 0.0)).any()
    sloped = tilted(times, 0, (1.0, -2.0, 0.5))
    np.testing.assert_allclose(np.linalg.norm(sloped, axis=1), np.sqrt(5.25))


def test_six_pushes_in_order_with_short_ramps():
    times = np.arange(3251) * TICK  # 13 s
    push = SixDirections().push(times, TICK, 0.2)
    expected = 2.0 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [0, 0, 0]])
    for k, force in enumerate(expected):
        inside = (times > 2.0 * k + PUSH_RAMP) & (times < 2.0 * (k + 1) - 1e-9)
        np.testing.assert_allclose(push[inside], np.tile(force, (inside.sum(), 1)), atol=1e-12)
    assert not push[0].any()
    # the steepest ramp turns 4 N within 50 ms, at most 15 / 8 of the mean rate
    assert np.linalg.norm(np.diff(push, axis=0), axis=1).max() < 4.0 * 15.0 / 8.0 * TICK / PUSH_RAMP * 1.001
    short = SixDirections(push_time=0.1).push(times, TICK, 0.2)  # a ramp of 25 ms
    np.testing.assert_allclose(short[round(0.09 / TICK)], [2.0, 0.0, 0.0], atol=1e-12)
    assert np.isfinite(short).all()


def gust(times: np.ndarray, rng: np.random.Generator, settings: EnvConfig) -> np.ndarray:
    """A user's own: a push along x from 1 s on, as strong as drawn."""
    wrench = np.zeros((len(times), 6))
    wrench[times >= 1.0, 0] = settings.object.mass * rng.uniform(4.0, 5.0)
    return wrench


def test_every_disturbance_but_none_acts_and_says_what_it_does() -> None:
    for name, rule in DISTURBANCES.items():
        wrench, gravity = disturb(rule(), TIMES, rng(), EnvConfig())
        assert wrench.shape == (501, 6)
        assert gravity.shape == (501, 3)
        assert (wrench.any() or not (gravity == G).all()) == (name != "none")
        assert rule.__doc__


def test_any_function_is_a_disturbance() -> None:
    wrench, gravity = disturb(gust, TIMES, rng(), EnvConfig(object=ObjectDescription(mass=0.5)))
    assert not wrench[:250].any()
    assert (wrench[250:, 0] == 0.5 * rng().uniform(4.0, 5.0)).all()
    assert (gravity == G).all()
    sideways = np.tile([1.0, 0.0, 0.0], (501, 1))
    wrench, gravity = disturb(lambda *_: Disturbed(gravity=sideways), TIMES, rng(), EnvConfig())
    assert not wrench.any()
    assert (gravity == sideways).all()
    env = FourFingerGrasp(disturbance=gust, duration=1.2)
    env.reset(seed=3)
    pushes = [env.step(np.zeros(6, np.float32))[4]["wrench"][0] for _ in range(60)]
    env.close()
    assert 0.2 * 4.0 - 0.1 < pushes[-1] - pushes[0] < 0.2 * 5.0 + 0.1


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (np.zeros((501, 3)), r"gives.*\(501, 6\), got \(501, 3\)"),
        (np.zeros(6), r"gives.*\(501, 6\), got \(6,\)"),
        (np.full((501, 6), np.nan), "gives.*finite"),
        (np.full((501, 6), 1e60), "gives.*within"),
        ("wind", "gives.*numbers"),
        (None, "gives.*None.*return"),
        (Disturbed(gravity=np.zeros((500, 3))), r"gives.*\(501, 3\), got \(500, 3\)"),
        (Disturbed(gravity=np.full((501, 3), 1e60)), "gives.*within"),
    ],
    ids=str,
)
def test_what_a_disturbance_returns_is_checked(returned: object, message: str) -> None:
    def gives(*_: object) -> object:
        return returned

    with pytest.raises(InvalidInputError, match=message):
        disturb(gives, TIMES, rng(), EnvConfig())  # type: ignore[arg-type]


def test_a_disturbance_that_fails_is_named() -> None:
    def still(times: np.ndarray) -> np.ndarray:
        return np.zeros((len(times), 6))

    with pytest.raises(
        InvalidInputError, match=r"still fails with TypeError: .*takes \(times, rng, settings\)"
    ) as caught:
        disturb(still, TIMES, rng(), EnvConfig())  # type: ignore[arg-type]
    assert isinstance(caught.value.__cause__, TypeError)

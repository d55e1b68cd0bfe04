"""The paper's wrenches by hand, and the distributions of the samplers."""

from __future__ import annotations

import numpy as np
import pytest

from grasp_env.grasp import wrench


def test_the_papers_wrenches_by_hand():
    half = np.sqrt(0.5)
    # [cos, cos^2, 8 cos^2(t/2) - 5, 0.2 sin, 0.2 cos, sin^2(t/2)] of pi t
    by_hand = {
        0.0: [1.0, 1.0, 3.0, 0.0, 0.2, 0.0],
        0.25: [half, 0.5, 4.0 * (1.0 + half) - 5.0, 0.2 * half, 0.2 * half, 0.5 * (1.0 - half)],
        0.5: [0.0, 0.0, -1.0, 0.2, 0.0, 0.5],
        1.0: [-1.0, 1.0, -5.0, 0.0, -0.2, 1.0],
    }
    np.testing.assert_allclose(
        wrench.paper_path(np.array(list(by_hand))), list(by_hand.values()), atol=1e-14
    )
    assert wrench.paper_path(2.0) == pytest.approx(by_hand[0.0])
    assert wrench.PAPER_CONSTANT == (1.0, 0.5, -0.6, -0.1, 0.2, 0.0)
    np.testing.assert_array_equal(wrench.constant(np.arange(6.0), 2), [np.arange(6.0)] * 2)


def test_ball_is_filled_and_not_left():
    sample = wrench.sample_ball(np.random.default_rng(0), 20_000, 2.0, 0.05)
    for part, radius in ((sample[:, :3], 2.0), (sample[:, 3:], 0.05)):
        norms = np.linalg.norm(part, axis=1) / radius
        assert norms.max() <= 1.0 + 1e-12
        # uniform in a ball: (|x| / r)^3 is uniform on (0, 1); four standard errors of its mean and
        # of the axes' means
        assert abs((norms**3).mean() - 0.5) < 4.0 / np.sqrt(12.0 * 20_000)
        assert np.abs(part.mean(axis=0) / radius).max() < 4.0 * np.sqrt(0.2 / 20_000)


def test_magnitudes_are_log_uniform_in_range():
    sample = wrench.sample_magnitudes(np.random.default_rng(1), 20_000, 0.1, 20.0)
    scaled = sample / np.repeat([1.0, 0.05], 3)
    sizes = np.linalg.norm(scaled, axis=1)
    np.testing.assert_allclose(wrench.magnitude(sample), sizes, rtol=1e-14)
    logs = np.log(sizes / 0.1) / np.log(200.0)
    assert logs.min() >= -1e-12
    assert logs.max() <= 1.0 + 1e-12
    assert abs(logs.mean() - 0.5) < 4.0 / np.sqrt(12.0 * 20_000)
    # a component of a uniform point on the 6-sphere has variance 1/6
    variance = ((scaled / sizes[:, None]) ** 2).mean(axis=0)
    assert np.abs(variance - 1.0 / 6.0).max() < 4.0 * 0.25 / np.sqrt(20_000)


def test_path_stays_in_the_ball_and_moves_three_percent_a_step():
    path = wrench.sample_path(np.random.default_rng(2), 3000, 0.03)
    for part, radius in ((path[:, :3], wrench.FORCE_RADIUS), (path[:, 3:], wrench.MOMENT_RADIUS)):
        assert np.linalg.norm(part, axis=1).max() <= radius * (1.0 + 1e-12)
        step = np.linalg.norm(np.diff(part, axis=0), axis=1) / radius
        # reflection only shortens; a uniform point of a ball lies 3/4 of the radius out in the mean
        assert step.max() <= 0.03 * (1.0 + 1e-9)
        assert step.mean() == pytest.approx(0.75 * 0.03, rel=0.05)

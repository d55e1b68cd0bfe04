"""Contact frames, G and its inverse at every condition number, and what counts as rank 6, with
torsion and without."""

from __future__ import annotations

import _core_test as insides
import numpy as np
import pytest
from oracles import geometry as oracle
from samples import Sample, random_contacts, sample, thinned, with_frictionless

from grasp_env.core import _core

EPS = 2.0**-52
GOOD, REFUSED, RANK_LOST, NEEDS_TORSION = range(4)


@pytest.mark.parametrize("close", [None, 1.0, 1e-3, 1e-6])
def test_frames_are_the_written_rule(close):
    """close: the distance of a given tangent from the normal."""
    rng = np.random.default_rng(1)
    for n in oracle.directions():
        along = None if close is None else n + close * rng.standard_normal(3)
        found = insides.frame(n, along)
        np.testing.assert_allclose(found, oracle.frame(n, along), atol=4e-15 / (close or 1.0))
        np.testing.assert_allclose(found.T @ found, np.eye(3), atol=4e-15)
        np.testing.assert_array_equal(found[:, 0], n)
        if close:  # made again from its own tangent it keeps its bits
            np.testing.assert_array_equal(insides.frame(n, found[:, 1]), found)


def check(s: Sample, tolerance: float) -> None:
    """Compare all arrays of placed contacts with the oracle; `tolerance` of G^+ is relative to its
    largest entry."""
    found = s.placement.arrays
    assert s.placement.verdict == GOOD
    size = 1.0 + np.abs(s.positions).max()
    np.testing.assert_allclose(found["frames"], s.frames, atol=4e-15)
    np.testing.assert_allclose(
        found["matrix"], oracle.grasp_matrix(s.positions, s.frames), atol=8e-15 * size
    )
    np.testing.assert_array_equal(found["divisor"], s.divisor)
    # moments about the centre, divided by the length: positions far away have fewer digits left
    np.testing.assert_allclose(
        found["rows"], s.rows, rtol=0, atol=1e-14 * np.abs(s.unit).max() * size
    )
    inverse = found["inverse"]
    basis = found["orthonormal"]
    np.testing.assert_allclose(inverse, s.inverse, rtol=0, atol=tolerance * np.abs(s.inverse).max())
    near = tolerance * max(1.0, np.abs(inverse).max())
    np.testing.assert_allclose(found["rows"] @ inverse, np.eye(6), rtol=0, atol=near)
    np.testing.assert_allclose(basis @ basis.T, np.eye(6), atol=tolerance)
    of_force = found["rows"] * np.where(np.isfinite(s.divisor), s.divisor, 0.0).reshape(-1)
    np.testing.assert_allclose(
        of_force @ basis.T @ basis, of_force, rtol=0, atol=tolerance * np.abs(of_force).max()
    )


@pytest.mark.parametrize("kind", ["hard", "frictionless"])
@pytest.mark.parametrize("count", [3, 4, 7, 8, 17, 50])
def test_contacts_of_good_condition(count, kind):
    s = sample(count, kind)
    check(s, 1e-12 / oracle.rank_ratio(s.rows) ** 2)


def nearly_on_a_line(count: int, thin: float) -> Sample:
    return thinned(random_contacts(np.random.default_rng(count), count), thin)


@pytest.mark.parametrize("count", [3, 4, 16])
@pytest.mark.parametrize("thin", [1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7])
def test_contacts_nearly_on_a_line(count, thin):
    """The core inverts by the normal equations, by two factors or by rotations."""
    s = nearly_on_a_line(count, thin)
    ratio = oracle.rank_ratio(s.unit @ oracle.grasp_matrix(s.positions, s.frames))
    # rounding of G itself moves its inverse by 1 / ratio, the normal equations by its square
    check(s, 100.0 * EPS / ratio ** (2 if ratio > 1e-3 else 1))


def first(s: Sample, keep: int) -> Sample:
    return Sample(s.positions[:keep], s.normals[:keep], s.scale[:keep], s.weights[:keep])


def test_rank_lost():
    five = random_contacts(np.random.default_rng(1), 5)
    lost = [nearly_on_a_line(count, thin) for count in (3, 9) for thin in (0.0, 1e-9)]
    # the last has rank 5
    lost += [first(five, 1), first(five, 2), with_frictionless(five, slice(None))]
    assert {s.placement.verdict for s in lost} == {RANK_LOST}


@pytest.mark.parametrize(
    ("off", "verdict"),
    [
        (1e-7, GOOD),
        (9e-3, GOOD),
        (-9e-3, GOOD),
        (0.011, REFUSED),
        (-0.011, REFUSED),
        (np.nan, REFUSED),
    ],
)
def test_normals_have_unit_length(off, verdict):
    s = sample(4)
    placed = insides.place(s.positions, s.normals * (1.0 + off), s.scale, s.weights)
    assert placed.verdict == verdict
    if verdict == GOOD:
        np.testing.assert_allclose(
            np.linalg.norm(placed.arrays["frames"][:, :, 0], axis=1), 1.0, atol=4e-16
        )


@pytest.mark.parametrize("far", [0.0, 1e3])
def test_neither_origin_nor_size_matters(far):
    s = sample(5)
    for size in (1e-3, 1e3):
        moved = insides.place(size * s.positions + far * size, s.normals, s.scale, s.weights)
        # up to the digits of positions that the distance takes
        expected = s.placement.arrays["rows"]
        np.testing.assert_allclose(
            moved.arrays["rows"], expected, rtol=0, atol=1e-13 * (1.0 + 30.0 * far)
        )


def test_cones_are_round_and_of_slope_one():
    """(o / mu_o)^2 + (t / mu_t)^2 <= n^2 becomes |(o, t)| <= u, with u = sqrt(mu_o mu_t) n."""
    friction = np.array([[0.4, 0.4], [0.2, 0.9], [0.0, 0.5]])
    scale = np.empty((3, 3))
    _core.cone_scale(friction, scale)
    mean = np.sqrt(0.2 * 0.9)
    np.testing.assert_allclose(
        scale, [[0.4, 1, 1], [mean, mean / 0.2, mean / 0.9], [1, 0, 0]], rtol=4 * EPS
    )


# --- soft contacts


def soft(s: Sample, which: list[int]) -> tuple[insides.Placement, float]:
    """Contacts of which some transmit torsion, and the ratio of singular values with it."""
    gamma = np.zeros(s.count)
    turns = np.zeros((6, len(which)))
    gamma[which], turns[3:] = 0.01, s.normals[which].T
    forces = oracle.grasp_matrix(s.positions, s.frames) * (s.scale > 0.0).reshape(-1)
    ratio = oracle.rank_ratio(s.unit @ np.column_stack([forces, turns]))
    return insides.place(s.positions, s.normals, s.scale, s.weights, torsion=gamma), ratio


def test_torsion_makes_up_for_rank_that_forces_lack():
    five = random_contacts(np.random.default_rng(8), 5)
    two = first(five, 2)
    smooth = with_frictionless(five, slice(None))
    line = np.array([[0.0, 0.0, -0.02], [0.0, 0.0, 0.02]])
    # cannot turn about the line
    across = Sample(line, np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]), two.scale, two.weights)
    for s, which, verdict in (
        (sample(5), [0, 3], GOOD),
        (two, [0, 1], NEEDS_TORSION),
        (two, [1], NEEDS_TORSION),
        (two, [], RANK_LOST),
        (across, [0, 1], RANK_LOST),
        (first(five, 1), [0], RANK_LOST),
        (smooth, list(range(5)), NEEDS_TORSION),
    ):
        placed, ratio = soft(s, which)
        assert (placed.verdict, ratio > 1e-8) == (verdict, verdict != RANK_LOST)
        if verdict != RANK_LOST:
            np.testing.assert_allclose(placed.arrays["rows"], s.rows, rtol=0, atol=1e-12)


def test_a_doubtful_rank_with_torsion_is_left_to_the_singular_values():
    """Two contacts on a line, whose normals lean away from it by an angle."""
    for lean in 10.0 ** np.arange(-12.0, 0.0, 0.25):
        normals = np.array([[1.0, 0.0, lean], [-1.0, 0.0, lean]]) / np.hypot(1.0, lean)
        line = np.array([[0.3, 0.1, -0.02], [0.3, 0.1, 0.02]])
        placed, ratio = soft(
            Sample(line, normals, np.tile([0.5, 1.0, 1.0], (2, 1)), np.ones((2, 2))), [0, 1]
        )
        if not 0.9e-8 < ratio < 1.1e-8:
            assert placed.verdict == (NEEDS_TORSION if ratio > 1e-8 else RANK_LOST), ratio

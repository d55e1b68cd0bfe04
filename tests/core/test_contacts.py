"""Frames, G and its inverse, in every way `Contacts::place` makes them; internal forces that follow moving contacts."""

from __future__ import annotations

import _core_test as insides
import numpy as np
import pytest
from oracles import geometry as oracle
from samples import Sample, random_contacts, sample, thinned, with_frictionless

EPS = 2.0**-52
GOOD, REFUSED, RANK_LOST, NEEDS_TORSION = range(4)
SWITCH = 0.9


def directions() -> np.ndarray:
    """Uniform, the six axes, and both sides of the switch of the tangents; unit length to rounding."""
    rng = np.random.default_rng(0)
    sides = [
        (s * x, a) for x in SWITCH + np.array([-1e-9, 0.0, 1e-9]) for s in (1.0, -1.0) for a in rng.uniform(0, 6.3, 5)
    ]
    around = [[x, np.sqrt(1 - x * x) * np.cos(a), np.sqrt(1 - x * x) * np.sin(a)] for x, a in sides]
    every = np.concatenate([rng.standard_normal((300, 3)), np.eye(3), -np.eye(3), around])
    return every / np.linalg.norm(every, axis=1)[:, None]


def test_frames_are_the_written_rule() -> None:
    for n in directions():
        found = insides.frame(n)
        # near |n_x| = 0.9 the projection divides by 0.44 at least
        np.testing.assert_allclose(found, oracle.frame(n), atol=4e-15)
        np.testing.assert_allclose(found.T @ found, np.eye(3), atol=3e-15)
        np.testing.assert_array_equal(found[:, 0], n)


@pytest.mark.parametrize("close", [1.0, 1e-3, 1e-6])
def test_frames_along_a_tangent(close: float) -> None:
    rng = np.random.default_rng(1)
    for n in directions()[:60]:
        along = n + close * rng.standard_normal(3)
        found = insides.frame(n, along)
        np.testing.assert_allclose(found.T @ found, np.eye(3), atol=4e-15)
        np.testing.assert_allclose(found, oracle.frame(n, along), atol=4e-15 / close)
        # made again from its own tangent it keeps its bits
        np.testing.assert_array_equal(insides.frame(n, found[:, 1]), found)


def check(s: Sample, tolerance: float) -> None:
    """All arrays of contacts that are placed; `tolerance` is that of G^+ relative to its largest entry."""
    found = s.placement.arrays
    assert s.placement.verdict == GOOD
    np.testing.assert_allclose(found["frames"], s.frames, atol=4e-15)
    size = 1.0 + np.abs(s.positions).max()
    np.testing.assert_allclose(found["matrix"], oracle.grasp_matrix(s.positions, s.frames), atol=8e-15 * size)
    np.testing.assert_allclose(found["cone_matrix"], s.cone_matrix, atol=3e-14 * size)
    np.testing.assert_array_equal(found["divisor"], s.divisor)
    rows = found["rows"]
    # moments about the centre, divided by the length: what is left of the digits of positions far away
    shift = np.abs(s.unit).max()
    np.testing.assert_allclose(rows, s.rows, rtol=0, atol=1e-14 * shift * size)
    inverse = found["inverse"]
    np.testing.assert_allclose(inverse, s.inverse, rtol=0, atol=tolerance * np.abs(s.inverse).max())
    np.testing.assert_allclose(rows @ inverse, np.eye(6), rtol=0, atol=tolerance * max(1.0, np.abs(inverse).max()))
    basis = found["orthonormal"]
    np.testing.assert_allclose(basis @ basis.T, np.eye(6), atol=tolerance)
    of_force = rows * np.where(np.isfinite(s.divisor), s.divisor, 0.0).reshape(-1)
    np.testing.assert_allclose(of_force @ basis.T @ basis, of_force, rtol=0, atol=tolerance * np.abs(of_force).max())


@pytest.mark.parametrize("kind", ["hard", "frictionless"])
@pytest.mark.parametrize("count", [*range(3, 18), 50])
def test_contacts_of_good_condition(count: int, kind: str) -> None:
    s = sample(count, kind)
    check(s, 1e-12 / oracle.rank_ratio(s.rows) ** 2)


def first(s: Sample, keep: int) -> Sample:
    return Sample(s.positions[:keep], s.normals[:keep], s.scale[:keep], s.weights[:keep])


WELL = 1e-6
"""The bound of the rank above which the core inverts G G^T as it is."""


def nearly_on_a_line(rng: np.random.Generator, count: int, thin: float) -> Sample:
    return thinned(random_contacts(rng, count), thin)


@pytest.mark.parametrize("count", [3, 4, 7, 16])
def test_contacts_nearly_on_a_line(count: int) -> None:
    """All ways to invert: the normal equations, two factors, rotations."""
    ways = set()
    for thin in (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7):
        s = nearly_on_a_line(np.random.default_rng(count), count, thin)
        of_force = s.unit @ oracle.grasp_matrix(s.positions, s.frames)
        bound, ratio = insides.rank_bound(of_force), oracle.rank_ratio(of_force)
        assert bound > insides.CLEAR_RANK or thin < 0.05
        assert not bound > insides.CLEAR_RANK or thin > 5e-6
        # rounding of G itself moves its inverse by 1 / ratio, that of G G^T by its square
        check(s, 100.0 * EPS / ratio ** (2 if bound > WELL else 1))
        ways.add((bound > WELL, bound > insides.CLEAR_RANK))
    assert ways == {(True, True), (False, True), (False, False)}


def test_rank_lost() -> None:
    for count in (3, 4, 9):
        for thin in (0.0, 1e-9, 1e-12):
            assert nearly_on_a_line(np.random.default_rng(count), count, thin).placement.verdict == RANK_LOST
    for keep in (1, 2):  # none at all: see test_boundary
        assert first(random_contacts(np.random.default_rng(0), 4), keep).placement.verdict == RANK_LOST
    # normal forces alone, of five contacts: rank 5
    five = random_contacts(np.random.default_rng(1), 5)
    assert with_frictionless(five, slice(None)).placement.verdict == RANK_LOST


def test_numbers_that_are_none_are_refused() -> None:
    base = random_contacts(np.random.default_rng(2), 4)
    for which in ("positions", "normals"):
        for bad in (np.nan, np.inf, -np.inf):
            for k in range(12):
                arrays = {"positions": base.positions.copy(), "normals": base.normals.copy()}
                arrays[which].reshape(-1)[k] = bad
                assert base.placement.place(**arrays) == REFUSED
    assert base.placement.place(base.positions, base.normals) == GOOD
    check(base, 1e-11)  # and what was refused has left nothing behind


def test_normals_are_of_unit_length_or_refused() -> None:
    base = random_contacts(np.random.default_rng(3), 4)
    for off, verdict in ((1e-7, GOOD), (2e-6, REFUSED), (-2e-6, REFUSED), (-1.0, REFUSED)):
        made = insides.place(base.positions, base.normals * (1.0 + off), base.scale, base.weights)
        assert made.verdict == verdict
        if verdict == GOOD:
            np.testing.assert_allclose(np.linalg.norm(made.arrays["frames"][:, :, 0], axis=1), 1.0, atol=4e-16)


@pytest.mark.parametrize("far", [0.0, 1.0, 1e3])
def test_where_the_origin_is_and_how_large_the_object_do_not_matter(far: float) -> None:
    base = sample(5)
    rows = base.placement.arrays["rows"]
    for size in (1e-3, 1.0, 1e3):
        moved = insides.place(size * base.positions + far * size, base.normals, base.scale, base.weights)
        # the digits of positions that the distance takes
        np.testing.assert_allclose(moved.arrays["rows"], rows, rtol=0, atol=1e-13 * (1.0 + 30.0 * far))


@pytest.mark.parametrize("tangents", [False, True])
@pytest.mark.parametrize("chosen", [[0, 1, 2, 3, 4, 5, 6], [6, 2, 3], [0, 2, 4, 5], [5, 4, 1, 0, 2]])
def test_some_of_the_contacts_are_as_if_there_were_no_others(chosen: list[int], tangents: bool) -> None:
    s = with_frictionless(random_contacts(np.random.default_rng(6), 7), slice(3, 4))
    gamma = np.linspace(0.0, 0.06, 7)
    given = s.positions, s.normals, s.scale, s.weights, s.normals[:, [1, 2, 0]] if tangents else None, gamma
    every = insides.place(*given)
    wanted = insides.place(*(None if a is None else a[chosen] for a in given))
    part = insides.place(*given)
    for others in ([1, 2, 4, 6], [0], []):  # whatever it was before
        part.select(every, others)
        assert part.verdict == REFUSED
        assert part.place(s.positions[others], s.normals[others]) == (GOOD if len(others) > 3 else RANK_LOST)
    part.select(every, chosen)
    assert part.place(s.positions[chosen], s.normals[chosen]) == wanted.verdict
    for name, numbers in part.arrays.items():
        if name != "inverse" or wanted.verdict == GOOD:
            np.testing.assert_array_equal(numbers, wanted.arrays[name], err_msg=name)


@pytest.mark.skipif(not insides.counts_allocations, reason="the sanitizers have an operator new of their own")
@pytest.mark.parametrize("thin", [1.0, 1e-4, 1e-7, 1e-9])
@pytest.mark.parametrize("soft", [False, True])
def test_neither_placing_nor_choosing_allocates(thin: float, soft: bool) -> None:
    """Whichever way the inverse is found."""
    s = nearly_on_a_line(np.random.default_rng(7), 6, thin)
    along = s.normals[:, [1, 2, 0]] if soft else None
    every = insides.place(s.positions, s.normals, s.scale, s.weights, along, np.full(6, 0.01) if soft else None)
    parts = [list(range(6)), [0, 1, 2], [5, 3, 1, 0], [0, 1], [2], []]
    assert every.allocations(parts, 1000) == 0


# soft contacts


def soft(s: Sample, which: list[int]) -> insides.Placement:
    gamma = np.zeros(s.count)
    gamma[which] = 0.01
    return insides.place(s.positions, s.normals, s.scale, s.weights, None, gamma)


def rank_with_torsion(s: Sample, which: list[int]) -> float:
    turns = np.zeros((6, len(which)))
    turns[3:] = s.normals[which].T
    forces = oracle.grasp_matrix(s.positions, s.frames) * (s.scale > 0.0).reshape(-1)
    return oracle.rank_ratio(s.unit @ np.column_stack([forces, turns]))


def test_torsion_where_the_forces_have_rank_six_changes_nothing() -> None:
    s = sample(5)
    made = soft(s, [0, 3])
    assert made.verdict == GOOD
    assert made.clear
    for name, numbers in s.placement.arrays.items():
        if name != "torsion":
            np.testing.assert_array_equal(made.arrays[name], numbers)


def test_what_torsion_makes_up_for() -> None:
    base = random_contacts(np.random.default_rng(8), 5)
    two = first(base, 2)
    for which, verdict in (([0, 1], NEEDS_TORSION), ([1], NEEDS_TORSION), ([], RANK_LOST)):
        made = soft(two, which)
        assert (rank_with_torsion(two, which) > 1e-8) == (verdict == NEEDS_TORSION)
        assert made.verdict == verdict
        assert made.clear == (verdict == NEEDS_TORSION)
        np.testing.assert_allclose(made.arrays["rows"], two.rows, rtol=0, atol=1e-12)  # all but the inverse is there
    # a torsion along the line of both points turns nothing else; across it, it cannot turn them about it
    line = np.array([[0.0, 0.0, -0.02], [0.0, 0.0, 0.02]])
    across = Sample(line, np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]), two.scale, two.weights)
    assert soft(across, [0, 1]).verdict == RANK_LOST
    # one contact has four dimensions, frictionless ones with torsion two
    assert soft(first(base, 1), [0]).verdict == RANK_LOST
    smooth = with_frictionless(base, slice(None))
    assert smooth.placement.verdict == RANK_LOST
    assert soft(smooth, list(range(5))).verdict == NEEDS_TORSION


def test_a_doubtful_rank_with_torsion_is_left_to_the_singular_values() -> None:
    """Two contacts on a line, whose normals lean away from it by an angle."""
    doubts = 0
    for lean in 10.0 ** np.arange(-12.0, 0.0, 0.25):
        normals = np.array([[1.0, 0.0, lean], [-1.0, 0.0, lean]]) / np.hypot(1.0, lean)
        line = np.array([[0.3, 0.1, -0.02], [0.3, 0.1, 0.02]])
        s = Sample(line, normals, np.tile([0.5, 1.0, 1.0], (2, 1)), np.ones((2, 2)))
        made, ratio = soft(s, [0, 1]), rank_with_torsion(s, [0, 1])
        if 0.9e-8 < ratio < 1.1e-8:
            continue
        assert made.verdict == (NEEDS_TORSION if ratio > 1e-8 else RANK_LOST), ratio
        assert not made.clear or ratio > 1e-6
        doubts += made.verdict == NEEDS_TORSION and not made.clear
    assert doubts > 3


def test_contacts_from_friction_and_torsion() -> None:
    s, rng = sample(4), np.random.default_rng(9)
    one, each, two = np.array([0.4]), rng.uniform(0.2, 1.0, 4), rng.uniform(0.2, 1.0, (4, 2))
    for mu in (one, each, two, np.array([0.4, 0.0, 0.5, 0.6])):
        made = insides.contacts_from(s.positions, s.normals, mu, np.array([0.0, 0.01, 0.0, 0.02]))
        two = np.broadcast_to(mu if mu.ndim > 1 else mu[:, None], (4, 2))
        mean = np.sqrt(two.prod(axis=1))
        with np.errstate(invalid="ignore"):
            scale = np.where(mean[:, None] > 0.0, np.column_stack([mean, mean[:, None] / two]), [1.0, 0.0, 0.0])
        assert made.verdict == GOOD
        np.testing.assert_allclose(made.arrays["scale"], scale, rtol=4 * EPS)
        np.testing.assert_array_equal(made.arrays["torsion"], [0.0, 0.01, 0.0, 0.02])
        other = insides.contacts_from(s.positions, s.normals, np.array([0.7]), np.zeros(0))
        other.set_friction(mu)
        assert other.place(s.positions, s.normals) == GOOD
        for name in ("scale", "divisor", "rows", "inverse"):
            np.testing.assert_array_equal(other.arrays[name], made.arrays[name])
    up = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    pinch = -0.02 * up, up, np.array([0.5])
    assert insides.contacts_from(*pinch, np.array([0.005, 0.005])).verdict == NEEDS_TORSION
    for gamma, said in (([0.0, 0.0], "rank"), ([0.1], "torsion"), ([0.1, np.nan], "torsion"), ([0.1, -0.1], "torsion")):
        with pytest.raises(ValueError, match=said):
            insides.contacts_from(*pinch, np.array(gamma))

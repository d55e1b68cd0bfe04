"""What starts are made of: the combination of the 12-basis, turned frames, the tangent correction, the best of a segment."""

from __future__ import annotations

import numpy as np
import pytest
from oracles import newton, starts
from oracles import phi as oracle
from samples import EACH, Sample, moved, sample, wrenches

from grasp_env.core import _core

SOME = (3, 4, 5, 8, 9)
KINDS = ("hard", "frictionless")
each_lane = pytest.mark.parametrize("lanes", EACH)
each_count = pytest.mark.parametrize("count", SOME)


def starter(lanes: int, s: Sample, moved: Sample | None = None):
    """With the basis of `s`, on the contacts of `moved`."""
    made = EACH[lanes]((moved or s).placement)
    made.set_basis(s.basis, s.frames)
    return made


@each_lane
@pytest.mark.parametrize("kind", KINDS)
@each_count
def test_the_combination_is_equations_33_and_34(lanes: int, kind: str, count: int) -> None:
    s, rng = sample(count, kind), np.random.default_rng(count)
    made, printed = starter(lanes, s), np.empty(3 * count)
    for size in (0.0, 1e-12, 1.0, 100.0):
        for w in wrenches(rng, 8, size):
            near = 1e-14 * np.abs(s.basis).max() * (1.0 + size)
            np.testing.assert_allclose(made.combine(w), newton.combine(s.basis, w), rtol=0, atol=near)
            _core.combine(s.basis, w, True, printed)
            np.testing.assert_allclose(printed, newton.combine(s.basis, w, True), rtol=0, atol=near)


@each_lane
@each_count
def test_turned_forces_are_the_same_vectors(lanes: int, count: int) -> None:
    for kind in KINDS:
        s = sample(count, kind)
        other = moved(s, 0.3)
        x = s.basis[2]
        found = EACH[lanes](other.placement).turned(x, s.frames)
        wanted = starts.turned(x, s.frames, other.frames, s.divisor, s.scale)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-14 * np.abs(x).max())
        same = EACH[lanes](s.placement).turned(x, s.frames)
        np.testing.assert_allclose(same, x, rtol=0, atol=1e-14 * np.abs(x).max())
        # round cones: what is turned stays inside
        ring = Sample(other.positions, other.normals, s.scale * 0.0 + [0.5, 1.0, 1.0], s.weights)
        turned = EACH[lanes](ring.placement).turned(s.rest, s.frames)
        before, after = (np.hypot(a[1::3], a[2::3]) for a in (s.rest, turned))
        assert (after <= before * (1.0 + 1e-14)).all()


@each_lane
@each_count
def test_the_segment_ends_at_the_least_of_a_fine_search(lanes: int, count: int) -> None:
    s, rng = sample(count), np.random.default_rng(count)
    made, between = starter(lanes, s), 0
    for k in range(30):
        w = wrenches(rng, 1)[0]
        safe = newton.combine(s.basis, w)
        x = safe + rng.standard_normal(3 * count) * safe.max() * 10.0 ** rng.uniform(-3, 3)
        if k % 3 == 0:
            x = s.minimum(w)[0] + 1e-3 * rng.standard_normal(3 * count) * safe.max()
        theta, end = made.segment(safe, x)
        _, least = starts.least_on_segment(safe, x, s.weights)
        value, first = oracle.phi(end, s.weights), oracle.phi(safe, s.weights)
        assert 0.0 <= theta <= 1.0
        assert value <= first
        assert value <= oracle.phi(x, s.weights)
        near = 1e-15 * (np.abs(safe).max() + theta * np.abs(x).max())
        np.testing.assert_allclose(end, safe + theta * (x - safe), rtol=0, atol=near)
        # theta to a thousandth: of what the segment gains, the square of that at a smooth minimum
        assert value - least <= 1e-3 * (first - least) + 1e-13 * value
        between += 0.0 < theta < 1.0
    assert between > 3
    for bad in (np.nan, np.inf, -np.inf, 1e13, safe[k := 2]):  # what is no force, and the same one
        theta, end = made.segment(safe, np.where(np.arange(3 * count) == k, bad, safe))
        assert theta == 0.0 or np.isfinite(bad)
        np.testing.assert_array_equal(end, safe)


@each_lane
@each_count
def test_the_combination_on_moved_contacts(lanes: int, count: int) -> None:
    """Carried by the tangent correction; none where that is outside the cones, or so far that Phi doubles."""
    s, ends = sample(count), []

    def carried(size: float, seed: int, w: np.ndarray) -> tuple[Sample, np.ndarray, float]:
        """Contacts there, the force, and Phi as a part of what it was."""
        there, combined = moved(s, size, seed), newton.combine(s.basis, w)
        turned = starts.turned(combined, s.frames, there.frames, s.divisor, s.scale)
        x = newton.tangent_correction(turned, there.rows, there.unit @ w, s.weights)
        return there, x, float(oracle.phi(x, s.weights) / oracle.phi(combined, s.weights))

    for seed, w in enumerate(wrenches(np.random.default_rng(count), 5)):
        near, far = 0.0, 1.0
        for _ in range(30):  # the way to where it leaves the cones, before which Phi grows without bound
            middle = 0.5 * (near + far)
            near, far = (middle, far) if carried(middle, seed, w)[2] < np.inf else (near, middle)
        for size in (0.0, 1e-3, 0.5 * near, near, 2.0 * far):
            there, wanted, grown = carried(size, seed, w)
            found, x = starter(lanes, s, there).combination(w, True)
            assert found == (grown <= 2.0) or grown == pytest.approx(2.0, rel=1e-3)
            ends.append("near" if grown <= 2.0 else "far" if grown < np.inf else "outside")
            if found:
                np.testing.assert_allclose(x, wanted, rtol=0, atol=1e-8 * np.abs(wanted).max())
                left = np.abs(there.rows @ x + there.unit @ w).max()
                assert left <= 1e-12 * (np.abs(x).max() + np.abs(there.unit @ w).max()) * count
    assert min(ends.count(end) for end in ("near", "far", "outside")) > 1

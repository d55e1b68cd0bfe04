"""Newton with soft contacts: against the dense oracle in every layout, starts, allocations, wrong numbers."""

from __future__ import annotations

from dataclasses import dataclass

import _core_test as insides
import numpy as np
import pytest
from oracles import soft as oracle
from samples import COUNTS, Sample, layouts, sample, wrenches

from grasp_env.core import _core

CODES = _core.codes()
CONVERGED, REFUSED = CODES["converged"], CODES["refused"]
FIELDS = _core.record_fields()


@dataclass(frozen=True)
class Soft:
    """Which contacts of a sample are soft.

    Attributes:
        divisor: (N,) torsion in units of its limit / torsion [1 / m]; inf: not soft.
    """

    contacts: Sample
    divisor: np.ndarray

    @property
    def soft(self) -> np.ndarray:
        return self.divisor < np.inf

    @property
    def matrix(self) -> np.ndarray:
        """(6, 4N) of cone coordinates and torsions in units of their limits, unit frame."""
        s = self.contacts
        turn = np.zeros((6, s.count))
        turn[3:] = s.normals.T
        return np.hstack([s.rows, s.unit @ turn / self.divisor])

    def solver(self, layout: tuple[int, int], tolerance: float = 1e-9, limit: int = 300):
        s = self.contacts
        return insides.AnySoft.make(*layout, s.placement, tolerance, limit, self.divisor, s.basis)

    def z(self, row: np.ndarray) -> np.ndarray:
        """(4N,) of a record."""
        s = self.contacts
        v = np.where(self.soft, parts(row, s)[1] * np.where(self.soft, self.divisor, 0.0), 0.0)
        return np.concatenate([parts(row, s)[0] * s.scale.reshape(-1), v])


def parts(row: np.ndarray, s: Sample) -> tuple[np.ndarray, np.ndarray]:
    """Forces (3N,) and torsions (N,) of a record."""
    return row[FIELDS["force"] :][: 3 * s.count], row[FIELDS["force"] + 6 * s.count :]


def softened(s: Sample, *, every: bool = False) -> Soft:
    """Two thirds of the contacts, or all, with fingertips of different patches."""
    rng = np.random.default_rng([3, s.count])
    divisor = s.scale[:, 0] / rng.uniform(0.002, 0.02, s.count)
    if not every:
        divisor[rng.permutation(s.count)[: s.count // 3]] = np.inf
    return Soft(s, divisor)


@pytest.mark.parametrize(("count", "kind"), [*((n, "hard") for n in COUNTS), (6, "frictionless"), (9, "frictionless")])
def test_the_optimum_is_the_oracles(count: int, kind: str) -> None:
    s = sample(count, kind)
    for k, load in enumerate(wrenches(np.random.default_rng(count), 2 if count < 12 else 1, 3.0)):
        problem = softened(s, every=k == 1)
        soft = problem.soft
        w = s.unit @ load
        want = oracle.minimum(s.minimum(load)[0], problem.matrix, w, s.weights, soft)
        least = float(oracle.soft_phi(want, s.weights, soft))
        for layout in layouts(count):
            solver = problem.solver(layout)
            near = solver.solve(1.02 * load)
            row = solver.solve(load)
            given = solver.descend(load, s.minimum(load)[0] / s.divisor.reshape(-1), np.zeros(count))
            # from there, from another wrench's optimum, from a start without torsion and from one that has it
            others = [solver.follow(load, *parts(start, s)) for start in (row, near)]
            for found in (row, given, *others, solver.descend(load, *parts(row, s))):
                z = problem.z(found)
                assert found[FIELDS["code"]] == CONVERGED
                # both know the least to rounding; the core to 1e-9
                assert found[FIELDS["objective"]] == pytest.approx(least, rel=1.1e-9)
                assert float(oracle.soft_phi(z, s.weights, soft)) == pytest.approx(
                    found[FIELDS["objective"]], rel=1e-11
                )
                assert least * (1.0 - 1.1e-9) <= found[FIELDS["lower_bound"]] <= least * (1.0 + 1e-12)
                assert np.abs(problem.matrix @ z + w).max() < 1e-12 * max(np.abs(z).max(), 1.0)
                assert (parts(found, s)[1][~soft] == 0.0).all()


@pytest.mark.parametrize("count", [3, 4, 6, 9])
def test_every_step_is_the_oracles(count: int) -> None:
    """One step from within: the same direction, cut short alike."""
    s = sample(count)
    problem = softened(s)
    load = wrenches(np.random.default_rng(count), 1, 3.0)[0]
    w = s.unit @ load
    for layout in layouts(count):
        for steps in (1, 2, 3):
            before, after = (
                problem.solver(layout, 1e-15, steps - 1).solve(load),
                problem.solver(layout, 1e-15, steps).solve(load),
            )
            here = problem.z(before)
            step = oracle.newton_step(here, problem.matrix, w, s.weights, problem.soft)[0]
            made = problem.z(after) - here
            alpha = float(made @ step) / float(step @ step)
            assert 0.0 < alpha <= 1.0 + 1e-9
            np.testing.assert_allclose(made, alpha * step, atol=1e-9 * np.abs(step).max())


def test_a_bound_is_one_far_from_the_optimum() -> None:
    """Stopped after any number of steps."""
    s = sample(6)
    problem = softened(s)
    load = wrenches(np.random.default_rng(2), 1, 0.3)[0]
    want = oracle.minimum(s.minimum(load)[0], problem.matrix, s.unit @ load, s.weights, problem.soft)
    least = float(oracle.soft_phi(want, s.weights, problem.soft))
    found = [problem.solver((8, 0), 1e-15, limit).solve(load)[FIELDS["lower_bound"]] for limit in range(12)]
    assert max(found) <= least * (1.0 + 1e-12)
    assert sum(bound > 0.0 for bound in found) >= 3


def test_wrong_numbers_are_refused() -> None:
    s = sample(4)
    problem = softened(s, every=True)
    load = wrenches(np.random.default_rng(4), 1, 2.0)[0]
    solver = problem.solver((4, 1))
    good = solver.solve(load)
    force, torsion = parts(good, s)
    for bad in (np.nan, np.inf, 1e13):
        wrong = load.copy()
        wrong[3] = bad
        assert solver.solve(wrong)[FIELDS["code"]] == REFUSED
    for bad in (np.nan, np.inf, -1e300, 1.0):
        off = torsion.copy()
        off[1] = bad
        assert solver.descend(load, force, off)[FIELDS["code"]] == REFUSED
        # a bad memory is forgotten
        assert solver.follow(load, force, off)[FIELDS["code"]] == CONVERGED
    off = force.copy()
    off[0] *= 1.001
    assert solver.descend(load, off, torsion)[FIELDS["code"]] == REFUSED
    np.testing.assert_array_equal(solver.solve(load), good)


@pytest.mark.skipif(not insides.counts_allocations, reason="the sanitizers have an operator new of their own")
@pytest.mark.parametrize("layout", [(4, 1), (8, 0)])
def test_nothing_is_allocated(layout: tuple[int, int]) -> None:
    loads = wrenches(np.random.default_rng(7), 24, 2.0)
    assert softened(sample(4)).solver(layout, 1e-4).allocations(loads, 20_000) == 0

"""`Solution`: one record and what was said of it, read without copies."""

from __future__ import annotations

import gc
import pickle
import sys

import numpy as np
import pytest

from grasp_env.core import Solution, record_fields, record_size
from grasp_env.errors import InvalidInputError
from grasp_env.force import ForceSolution

FORCE = record_fields()["force"]


def made(count: int = 4) -> ForceSolution:
    return ForceSolution(np.arange(float(record_size(count))), "newton", "previous")


@pytest.mark.parametrize("count", [0, 1, 4, 50])
def test_arrays_are_views_of_the_record(count: int) -> None:
    solution = made(count)
    numbers = np.arange(float(record_size(count)))[FORCE:]
    assert solution.n_contacts == count
    np.testing.assert_array_equal(solution.force, numbers[: 3 * count].reshape(count, 3))
    np.testing.assert_array_equal(solution.initial_force, numbers[3 * count : 6 * count].reshape(count, 3))
    np.testing.assert_array_equal(solution.torsion, numbers[6 * count :])
    for view in (solution.force, solution.initial_force, solution.torsion):
        assert not view.flags.writeable
        assert view.dtype == np.float64
        with pytest.raises(ValueError, match="read-only"):
            view[...] = 0.0


def test_a_force_outlives_its_solution() -> None:
    solution = made()
    force, expected = solution.force, solution.force.copy()
    del solution
    gc.collect()
    filler = [np.full(48, -1.0) for _ in range(1000)]  # takes what was freed
    np.testing.assert_array_equal(force, expected)
    assert len(filler) == 1000


def test_nothing_leaks() -> None:
    record, trace = np.zeros(record_size(4)), np.zeros(3)
    before = sys.getrefcount(record), sys.getrefcount(trace)
    for _ in range(100):
        solution = ForceSolution(record, "newton", "given", trace)
        for name in ("force", "initial_force", "torsion", "status", "objective_trace"):
            getattr(solution, name)
        del solution
    assert (sys.getrefcount(record), sys.getrefcount(trace)) == before


@pytest.mark.parametrize(
    "record",
    [
        None,
        [0.0] * 48,
        np.zeros(19),
        np.zeros(47),
        np.zeros((1, 48)),
        np.zeros(48, dtype=np.float32),
        np.zeros(96)[::2],
        np.zeros(48).astype(">f8"),
        np.full(48, 4.0),  # a call that was refused is no solution
        np.full(48, 0.5),
        np.full(48, -1.0),
        np.full(48, np.nan),
        np.full(48, 1e300),
        np.array([0.0, np.nan] + 46 * [0.0]),
    ],
)
def test_only_records_are_taken(record: object) -> None:
    with pytest.raises(InvalidInputError, match="a record must be a C-contiguous float64 array of 20"):
        Solution(record, "newton", "given")  # pyright: ignore[reportArgumentType]


def test_pickled_whole() -> None:
    solution = ForceSolution(
        np.arange(48.0), "conic", "central", np.ones(2), certificate=np.ones(6), limit_multipliers=np.ones(3)
    )
    again = pickle.loads(pickle.dumps(solution))
    assert type(again) is ForceSolution
    for name in ("_record", "method", "initial", "objective_trace", "certificate", "limit_multipliers"):
        np.testing.assert_array_equal(getattr(again, name), getattr(solution, name))

"""`Solution`: one record and what was said of it, read without copies."""

from __future__ import annotations

import gc
import pickle
import sys

import numpy as np
import pytest

from grasp_env.core import Solution, codes, record_fields
from grasp_env.errors import InvalidInputError
from grasp_env.force import ForceSolution

PLACES, CODES = record_fields(), codes()
FORCE = PLACES["force"]


def row(count: int = 4, joints: int = 0, limits: int = 0, **said: float) -> np.ndarray:
    """A record of so many numbers, each of which is its place behind the summary, and what is said in the summary."""
    numbers = np.arange(float(FORCE + 16 * count + joints + limits))
    numbers[:FORCE] = 0.0
    for name, value in (said | {"contacts": count, "joints": joints, "limits": limits}).items():
        numbers[PLACES[name]] = value
    return numbers


def made(count: int = 4, joints: int = 0, limits: int = 0, **said: float) -> ForceSolution:
    return ForceSolution(row(count, joints, limits, **said), "newton", "previous")


@pytest.mark.parametrize(("joints", "limits"), [(0, 0), (12, 24), (3, 0), (0, 5)])
@pytest.mark.parametrize("count", [0, 1, 4, 50])
def test_arrays_are_views_of_the_record(count: int, joints: int, limits: int) -> None:
    solution = made(count, joints, limits)
    numbers = row(count, joints, limits)[FORCE:]
    assert solution.n_contacts == count
    shapes = {
        "force": (count, 3), "initial_force": (count, 3), "torsion": (count,), "frames": (count, 3, 3), "torques": (joints,),
        "limit_multipliers": (limits,),
    }  # fmt: skip
    at = 0
    for name, shape in shapes.items():
        view, size = getattr(solution, name), int(np.prod(shape))
        np.testing.assert_array_equal(view, numbers[at : at + size].reshape(shape))
        assert not view.flags.writeable
        assert view.dtype == np.float64
        with pytest.raises(ValueError, match="read-only"):
            view[...] = 0.0
        at += size
    assert at == len(numbers)


def test_the_summary_is_read_off() -> None:
    said = {
        "iterations": 3, "trials": 5, "objective": 7.5, "lower_bound": 7.25, "residual": 1e-9, "margin": 0.5,
        "limit_excess": 0.125, "replaced": 1,
    }  # fmt: skip
    solution = made(**said)
    names = {"residual": "equilibrium_residual", "margin": "cone_margin", "replaced": "start_replaced"}
    for name, value in said.items():
        assert getattr(solution, names.get(name, name)) == value
    assert type(solution.iterations) is type(solution.trials) is int
    assert solution.start_replaced is True
    numbers = row()
    for name, first in (("wrench", 0.0), ("multipliers", 10.0)):
        numbers[PLACES[name] : PLACES[name] + 6] = first + np.arange(6)
        np.testing.assert_array_equal(getattr(ForceSolution(numbers, "newton", "given"), name), first + np.arange(6))


def test_forces_along_the_axes_of_the_positions() -> None:
    """Columns of the frames, at each contact."""
    rng, numbers = np.random.default_rng(0), row()
    numbers[FORCE:] = rng.standard_normal(len(numbers) - FORCE)
    solution = ForceSolution(numbers, "newton", "given")
    expected = np.einsum("nij,nj->ni", solution.frames, solution.force)
    np.testing.assert_allclose(solution.object_force, expected, rtol=1e-14, atol=1e-15)
    solution.object_force[:] = 0.0  # made anew each time
    assert solution.object_force.any()


@pytest.mark.parametrize("code", ["infeasible", "limits_exceeded"])
def test_a_proof_has_prices_and_an_excess_has_none(code: str) -> None:
    solution = made(4, 2, 4, code=CODES[code])
    assert len(solution.limit_multipliers) == (4 if code == "infeasible" else 0)
    assert (solution.certificate is None) == (code != "infeasible")
    assert made(4, 2, 4).certificate is None


def test_a_force_outlives_its_solution() -> None:
    solution = made()
    force, expected = solution.force, solution.force.copy()
    del solution
    gc.collect()
    filler = [np.full(len(row()), -1.0) for _ in range(1000)]  # takes what was freed
    np.testing.assert_array_equal(force, expected)
    assert len(filler) == 1000


def test_nothing_leaks() -> None:
    record, trace = row(4, 2, 4), np.zeros(3)
    before = sys.getrefcount(record), sys.getrefcount(trace)
    for _ in range(100):
        solution = ForceSolution(record, "newton", "given", trace)
        for name in ("force", "initial_force", "torsion", "frames", "torques", "limit_multipliers", "object_force"):
            getattr(solution, name)
        assert solution.objective_trace is not None
        del solution
    assert (sys.getrefcount(record), sys.getrefcount(trace)) == before


@pytest.mark.parametrize(
    "record",
    [
        None, list(row()), np.zeros(FORCE - 1), np.zeros(0), row()[:-1], np.append(row(), 0.0), row()[None],
        row().astype(np.float32), np.repeat(row(), 2)[::2], row().astype(">f8"),
        *(row(code=CODES[name]) for name in ("refused", "rank_lost")),  # a call that has no answer is no solution
        *(row(code=code) for code in (0.5, -1.0, np.nan, 1e300, 99.0)),
        *(row(iterations=number) for number in (np.nan, -1.0)), *(row(start=start) for start in (0.5, 99.0)),
        *(np.where(np.arange(len(row())) == PLACES[name], number, row())
          for name, number in (("contacts", 5.0), ("joints", 1e300), ("limits", -1.0))),
    ],
)  # fmt: skip
def test_only_records_are_taken(record: object) -> None:
    with pytest.raises(InvalidInputError, match="a record must be a C-contiguous float64 array whose numbers say"):
        Solution(record, "newton", "given")  # pyright: ignore[reportArgumentType]


def test_pickled_whole() -> None:
    solution = ForceSolution(row(4, 12, 24), "conic", "central", np.ones(2))
    again = pickle.loads(pickle.dumps(solution))
    assert type(again) is ForceSolution
    for name in ("_record", "method", "initial", "objective_trace", "frames", "torques", "limit_multipliers"):
        np.testing.assert_array_equal(getattr(again, name), getattr(solution, name))

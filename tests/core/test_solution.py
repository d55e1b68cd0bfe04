"""`Solution`: a record that is read without copies."""

from __future__ import annotations

import pickle
import sys

import numpy as np
import pytest

from grasp_env.core import Solution, codes, record_fields
from grasp_env.errors import InvalidInputError
from grasp_env.force import ForceSolution
from grasp_env.force.solution import Names

PLACES = record_fields()
CODES = codes()
FORCE = PLACES["force"]
NAMES = Names("newton", "previous")


def row(count: int = 4, joints: int = 0, limits: int = 0, **said: float) -> np.ndarray:
    """A record with numbers 0, 1, 2, ... after the summary, whose fields are `said`."""
    numbers = np.arange(float(FORCE + 17 * count + joints + limits))
    numbers[:FORCE] = 0.0
    for name, value in (said | {"contacts": count, "joints": joints, "limits": limits}).items():
        numbers[PLACES[name]] = value
    return numbers


def solution_of(count: int = 4, joints: int = 0, limits: int = 0, **said: float) -> ForceSolution:
    return ForceSolution(row(count, joints, limits, **said), NAMES)


@pytest.mark.parametrize(("joints", "limits"), [(0, 0), (12, 24), (0, 5)])
@pytest.mark.parametrize("count", [0, 4])
def test_arrays_are_views_of_the_record(count, joints, limits):
    solution = solution_of(count, joints, limits)
    numbers = row(count, joints, limits)[FORCE:]
    assert solution.n_contacts == count
    shapes = {
        "force": (count, 3),
        "initial_force": (count, 3),
        "torsion": (count,),
        "frames": (count, 3, 3),
        "friction_used": (count,),
        "torques": (joints,),
        "limit_multipliers": (limits,),
    }
    at = 0
    for name, shape in shapes.items():
        view = getattr(solution, name)
        size = int(np.prod(shape))
        np.testing.assert_array_equal(view, numbers[at : at + size].reshape(shape))
        assert not view.flags.writeable
        assert view.dtype == np.float64
        with pytest.raises(ValueError, match="read-only"):
            view[...] = 0.0
        at += size
    assert at == len(numbers)


def test_the_summary_is_read_off():
    said = {
        "iterations": 3,
        "trials": 5,
        "objective": 7.5,
        "lower_bound": 7.25,
        "residual": 1e-9,
        "margin": 0.5,
        "limit_excess": 0.125,
        "replaced": 1,
    }
    numbers = row(**said)
    numbers[PLACES["wrench"] :][:6], numbers[PLACES["multipliers"] :][:6] = (
        np.arange(6),
        10.0 + np.arange(6),
    )
    solution = ForceSolution(numbers, NAMES)
    names = {
        "residual": "equilibrium_residual",
        "margin": "cone_margin",
        "replaced": "start_replaced",
    }
    assert {name: getattr(solution, names.get(name, name)) for name in said} == said
    assert type(solution.iterations) is type(solution.trials) is int
    np.testing.assert_array_equal(solution.wrench, np.arange(6))
    np.testing.assert_array_equal(solution.multipliers, 10.0 + np.arange(6))
    # along the axes of the positions
    expected = np.einsum("nij,nj->ni", solution.frames, solution.force)
    np.testing.assert_allclose(solution.object_force, expected, rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize("code", ["infeasible", "limits_exceeded"])
def test_a_proof_has_multipliers_and_an_excess_has_none(code):
    solution = solution_of(4, 2, 4, code=CODES[code])
    assert len(solution.limit_multipliers) == (4 if code == "infeasible" else 0)
    assert (solution.certificate is None) == (code != "infeasible")
    assert solution_of(4, 2, 4).certificate is None


def test_views_keep_the_record_alive_and_nothing_leaks():
    record = row(4, 2, 4)
    trace = np.zeros(3)
    before = sys.getrefcount(record), sys.getrefcount(trace)
    for _ in range(100):
        solution = ForceSolution(record, NAMES, trace)
        views = [
            getattr(solution, name)
            for name in ("force", "torsion", "frames", "torques", "limit_multipliers")
        ]
        assert solution.objective_trace is not None
        del solution
        np.testing.assert_array_equal(views[0].reshape(-1), FORCE + np.arange(12.0))
        assert sys.getrefcount(record) > before[0]
        del views
    assert (sys.getrefcount(record), sys.getrefcount(trace)) == before


@pytest.mark.parametrize(
    "record",
    [
        None,
        list(row()),
        np.zeros(FORCE - 1),
        row()[:-1],
        np.append(row(), 0.0),
        row().astype(np.float32),
        np.repeat(row(), 2)[::2],
        *(
            row(code=CODES[name]) for name in ("refused", "rank_lost")
        ),  # a call that has no answer is no solution
        *(row(code=code) for code in (0.5, -1.0, np.nan, 99.0)),
        row(iterations=np.nan),
        row(start=99.0),
        *(
            np.where(np.arange(len(row())) == PLACES[name], number, row())
            for name, number in (("contacts", 5.0), ("joints", 1e300), ("limits", -1.0))
        ),
    ],
)
def test_only_records_are_taken(record):
    with pytest.raises(
        InvalidInputError,
        match="expected the record of a ForceSolution: a C-contiguous float64 row whose header matches its length",
    ):
        Solution(record, NAMES)  # pyright: ignore[reportArgumentType]


def test_pickled_whole():
    solution = ForceSolution(row(4, 12, 24), NAMES, np.ones(2))
    again = pickle.loads(pickle.dumps(solution))
    assert type(again) is ForceSolution
    for name in (
        "_record",
        "method",
        "initial",
        "objective_trace",
        "frames",
        "torques",
        "limit_multipliers",
    ):
        np.testing.assert_array_equal(getattr(again, name), getattr(solution, name))

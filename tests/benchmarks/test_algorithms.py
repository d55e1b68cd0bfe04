"""`python -m benchmarks algorithms`: every algorithm is timed, on problems that end as expected."""

from __future__ import annotations

import pytest

from benchmarks.algorithms import ALGORITHMS, AlgorithmSettings, measured, run
from grasp_env.errors import NotConvergedError


def test_every_algorithm_has_rows():
    rows = run(AlgorithmSettings(wrenches=20, passes=1))
    assert set(rows["method"]) == set(ALGORITHMS)
    assert (rows["microseconds"] > 0.0).all()


def test_a_problem_that_ends_in_another_way_is_an_error(monkeypatch):
    monkeypatch.setattr("benchmarks.algorithms.CONVERGED", -1.0)
    settings = AlgorithmSettings(wrenches=20, passes=1)
    with pytest.raises(NotConvergedError, match="ended in another way"):
        next(measured(settings))

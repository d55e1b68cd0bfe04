"""Every public call with one to three wrong arguments ends in an answer without nan or in one of
the project's errors."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import math
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from malformed.calls import Call, calls
from malformed.values import mistakes

from grasp_env.errors import GraspError, GraspWarning
from grasp_env.force import ForceSolution, ForceSolutions
from grasp_env.quality.closure import ForceClosure

NAMES = list(calls(Path("/nowhere")))


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """The calls; a name that stands where a path belongs becomes a file in a folder of the tests."""
    folder = tmp_path_factory.mktemp("files")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        yield calls(folder)


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    """A wrong path may be a valid one, and is then written to."""
    monkeypatch.chdir(tmp_path)


def numbers(value: Any) -> Iterator[float]:
    """The numbers of an answer; of solutions those that are never nan."""
    if isinstance(value, ForceSolution):
        yield from (
            value.objective,
            value.lower_bound,
            value.equilibrium_residual,
            value.cone_margin,
            *value.force.flat,
        )
    elif isinstance(value, ForceSolutions):
        yield from (*value.force.flat, *value.objective)
    elif isinstance(value, float | np.floating):
        yield float(value)
    elif isinstance(value, np.ndarray) and value.dtype.kind == "f":
        yield from value.flat
    elif isinstance(value, tuple | list):
        for each in value:
            yield from numbers(each)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type | ForceClosure):
        for item in dataclasses.fields(value):
            yield from numbers(getattr(value, item.name))


@pytest.mark.parametrize("name", NAMES)
def test_good_arguments_are_answered(name, table):
    answer = table[name].run(**table[name].good)
    assert not any(number != number for number in numbers(answer))


def spoil(name: str, table: dict[str, Call], data: st.DataObject) -> None:
    call = table[name]
    wrong = data.draw(st.sets(st.sampled_from(sorted(call.good)), min_size=1, max_size=3))
    arguments = call.good | {
        argument: data.draw(mistakes(call.good[argument]), argument) for argument in sorted(wrong)
    }
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        # a thousand metres are a valid grasp that looks wrong
        warnings.simplefilter("ignore", GraspWarning)
        try:
            answer = call.run(**arguments)
        except GraspError as error:
            answer = math.nan if not str(error) else None  # an error without words is as bad as nan
    assert not any(number != number for number in numbers(answer))


CHECKS = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large]


@pytest.mark.parametrize("name", NAMES)
@settings(
    max_examples=10, deadline=None, derandomize=True, suppress_health_check=CHECKS, database=None
)
@given(data=st.data())
def test_wrong_arguments_are_refused_in_words(name, table, data):
    spoil(name, table, data)

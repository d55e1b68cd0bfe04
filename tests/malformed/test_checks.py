"""The checks of arguments: wrong ones are refused in words, right ones converted."""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from grasp_env.errors import InvalidInputError, UnknownNameError
from grasp_env.force import ForceOptimizer, optimize_force
from grasp_env.grasp import Grasp, presets
from grasp_env.inputs.arguments import (
    AllFaults,
    as_array,
    choice,
    flag,
    instance,
    number,
    positive,
    whole,
)
from grasp_env.inputs.ranges import Range

CUBOID = presets.paper_cuboid()
PAPER = np.array([1.0, 0.5, -0.6, -0.1, 0.2, 0.0])


@pytest.mark.parametrize(
    ("value", "told"),
    [
        ("0.4", "they are of type <U3, got '0.4'"),
        (["1", "2"], "they are of type <U1"),
        (np.array([True, False]), "they are of type bool"),
        ([1j, 2.0], "they are of type complex128"),
        (np.ma.masked_array([1.0, 2.0], [True, False]), "masked entries are not numbers"),
        ([None, 1.0], "not all of them are"),
        ({"a": 1.0}, "not all of them are"),
        (["3", 10**30], "not all of them are|they are of type <U"),
        ([True, 10**30], "not all of them are"),
        (np.array(["1", "2"], object), "not all of them are"),
        ([10**400, 1.0], "be finite, got"),
        ([[1.0], [1.0, 2.0]], "inhomogeneous|ragged"),  # the latter before numpy 1.24
        ([1.0, 2.0, 3.0], r"shape \(2,\), got \(3,\)"),
        ([1.0, math.nan], r"be finite, got \[1.0, nan\]"),
        (np.array([1.0, math.inf]), r"be finite, got \[1.0, inf\]"),
        ([-0.5, 1.0], "lie within 0 to 2, got -0.5 in it"),
        ([0.5, 3.0], "lie within 0 to 2, got 3 in it"),
    ],
)
def test_wrong_arrays(value, told):
    with pytest.raises(InvalidInputError, match=told) as caught:
        as_array(value, (2,), "masses", Range(0.0, 2.0))
    assert str(caught.value).startswith("masses must")
    assert len(str(caught.value)) < 1000


def test_right_arrays():
    for good in (
        [1, 2],
        (1.0, 2),
        [Fraction(1), 2],
        np.array([1, 2], np.int8),
        np.array([1, 2], object),
        range(1, 3),
    ):
        found = as_array(good, (2,), "masses")
        assert found.dtype == np.float64
        np.testing.assert_array_equal(found, [1.0, 2.0])
    given = np.array([1.0, 2.0])
    assert not np.shares_memory(as_array(given, (2,), "masses"), given)


WRONG: list[tuple[Callable[[Any], Any], list[Any], str]] = [
    (
        lambda x: positive(x, "tolerance"),
        ["0.4", True, None, 1j, [0.4], math.inf, math.nan, -1.0, 0, 10**400],
        "must be a number > 0|must lie within 1e-300 to",
    ),
    (lambda x: number(x, "share", Range(0.0, 1.0)), ["1", None, math.inf, 2], "within 0 to 1, got"),
    (
        lambda x: whole(x, "count", 0, 10),
        [1.0, "1", True, None, -1, 11],
        "count must be an integer",
    ),
    (lambda x: choice(x, "letter", ("x", "y")), ["a", [], None], "choose one of 'x', 'y'"),
    (lambda x: flag(x, "trace"), [0, "yes", None], "trace must be True or False"),
    (lambda x: instance(x, Grasp, "grasp"), [None, 3, Grasp], "grasp must be a Grasp, got"),
]


@pytest.mark.parametrize(("check", "values", "told"), WRONG)
def test_wrong_values(check, values, told):
    error = UnknownNameError if "choose one" in told else InvalidInputError
    for value in values:
        with pytest.raises(error, match=told):
            check(value)


def test_right_values():
    assert (
        whole(np.int8(3), "count", 0),
        flag(np.False_, "trace"),
        number(Fraction(1, 2), "share"),
    ) == (3, False, 0.5)
    assert (positive(np.array(2.0), "size"), choice(np.str_("x"), "letter", ("x", "y"))) == (
        2.0,
        "x",
    )


def test_all_faults_are_told_at_once():
    with pytest.raises(InvalidInputError) as caught:
        optimize_force(
            CUBOID,
            PAPER,
            method="simplex",
            tolerance="0.4",
            max_iterations=-1,
            force_weight=0.0,
            limits=3,
        )
    for part in (
        "'simplex'",
        "tolerance must",
        "max_iterations must",
        "force_weight must",
        "limits must",
    ):
        assert part in str(caught.value)
    with pytest.raises(InvalidInputError, match=r"positions must .*; normals must"):
        Grasp.from_contacts("here", "there", 0.4)
    with pytest.raises(UnknownNameError), AllFaults() as check:  # one fault keeps its class
        (check(choice, "a", "letter", "b"), check(whole, 1, "count", 0))


@pytest.mark.parametrize("name", ["wrench", "normals", "friction", "contacts"])
def test_a_masked_array_never_loses_its_mask(name):
    """The solver reads plain arrays in place; a subclass is read by `as_array`, which refuses what
    numpy would uncover."""
    optimizer = ForceOptimizer(CUBOID)
    call: dict[str, Any] = {
        "wrench": PAPER,
        "normals": CUBOID.normals,
        "friction": np.full(4, 0.4),
        "contacts": np.ones(4, dtype=bool),
    }
    mask = np.zeros(call[name].shape, dtype=bool)
    mask[:1] = True
    hidden = np.ma.masked_array(call[name], mask)
    with pytest.raises(InvalidInputError, match=f"{name} must be.*masked"):
        optimizer.solve(**call | {name: hidden})
    assert optimizer.solve(**call | {name: np.ma.masked_array(call[name])}).cone_margin > 0.0

"""optimizer.hpp has the results of the Python package, reports what is wrong, and allocates nothing
where it solves."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from building import spoiled, succeed

from grasp_env import core
from grasp_env.errors import InfeasibleStartError, ModelFileError
from grasp_env.force import ForceLimits, optimize_force
from grasp_env.force.solution import STARTS
from grasp_env.grasp import Grasp, presets
from policies import LearnedInitialForce

WRENCH = [1, 0.5, -0.6, -0.1, 0.2, 0]
PRESS = [0.1, 0, -5, 0, 0, 0]
CODES = core.codes()


@pytest.fixture(scope="module")
def said(programs, tmp_path_factory):
    """The lines that the program prints, by the words before the colon."""
    model = LearnedInitialForce.pretrained().export(
        tmp_path_factory.mktemp("front") / "four.model", presets.paper_cuboid()
    )
    return dict(
        line.split(": ", 1) for line in succeed(programs / "front", model, "300").splitlines()
    )


def numbers(line: str) -> dict[str, Any]:
    """A solution for four contacts, from a line."""
    code, start, replaced, objective, excess, *rest = map(float, line.split())
    return {
        "code": code,
        "start": STARTS[int(start)],
        "replaced": replaced,
        "objective": objective,
        "excess": excess,
        "force": np.reshape(rest[:12], (4, 3)),
        "torsion": np.array(rest[12:16]),
        "torques": np.array(rest[16:]),
    }


CUBOID = presets.paper_cuboid()
SOFT = Grasp.from_contacts(
    CUBOID.positions,
    CUBOID.normals,
    [0.5, 0.5, 0.7, 0.5],
    contact_model=["soft", "hard", "soft", "soft"],
    torsional_friction=[0.02, 0, 0.01, 0.01],
)
K = np.arange(96)
SHARED = np.where(K // 4 % 6 < 3, 0.01 * (K * 7 % 5 - 2), 0.5 * (K * 3 % 4 - 1)).reshape(4, 6, 4)
"""Jacobian of four joints that all fingers share and that also turn the tips."""
COMMON = ForceLimits(jacobian=SHARED, torque_limit=0.15, torque_bias=[0.01, -0.02, 0, 0.03])
EXACT = {"tolerance": 1e-9}
CASES: dict[str, tuple[Grasp, list[float], dict[str, Any]]] = {
    "newton": (CUBOID, WRENCH, EXACT),
    "reduced flow": (CUBOID, WRENCH, {"method": "reduced_flow"}),
    "largest": (CUBOID, WRENCH, {"method": "conic", "criterion": "max"}),
    "soft shared": (SOFT, WRENCH, EXACT | {"limits": COMMON}),
    "learned": (CUBOID, WRENCH, EXACT | {"initial": LearnedInitialForce.pretrained()}),
    "open": (Grasp.from_contacts(CUBOID.positions, np.tile([0, 0, 1], (4, 1)), 0.4), PRESS, EXACT),
}


@pytest.mark.parametrize("name", CASES)
def test_results_are_those_of_python(said, name):
    """The same solution from the same start, or an equally good one where Phi is flat."""
    grasp, wrench, options = CASES[name]
    python = optimize_force(grasp, wrench, **options)
    found = numbers(said[name])
    rel, close = (2e-9, 2e-4) if "tolerance" in options else (2e-4, 0.05)
    assert found["code"] == python._record[0]
    assert found["objective"] == pytest.approx(python.objective, rel=rel)
    assert found["excess"] == pytest.approx(python.limit_excess, rel=2e-3, abs=1e-12)
    for name, size in (("force", 1.0), ("torsion", 0.1), ("torques", 1.0)):
        np.testing.assert_allclose(found[name], getattr(python, name), atol=size * close)
    assert python.initial.startswith(found["start"])


@pytest.mark.parametrize(
    ("name", "start", "replaced"),
    [
        ("given", "given", 0),
        ("again", "previous", 0),
        ("forgotten", "internal_force", 0),
        ("no model", "internal_force", 1),
    ],
)
def test_where_calls_begin(said, name, start, replaced):
    found = numbers(said[name])
    expected = numbers(said["newton"])
    assert (found["start"], found["replaced"], found["code"]) == (start, replaced, expected["code"])
    assert found["objective"] == pytest.approx(expected["objective"], rel=2e-9)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("updated there", "made there"),
        ("as before", "limited"),
        ("copied", "limited"),
        ("not updated", "limited"),
        ("after", "limited"),
        ("of many", "newton"),
        ("three touch, one broken", "three touch"),
    ],
)
def test_what_a_call_is_given_holds_for_it_alone(said, one, other):
    """To the last printed digit; and a copy is an independent solver."""
    assert said[one] == said[other]
    assert said["moved"] != said["limited"]


def test_contacts_that_move_have_the_optimum_of_their_place(said):
    """A call begins at the problem's internal force, so both agree to the tolerance of 1e-12, and
    forces to about its root."""
    moved, there = numbers(said["moved"]), numbers(said["made there"])
    assert moved["objective"] == pytest.approx(there["objective"], rel=2e-9)
    assert (moved["code"], moved["start"]) == (there["code"], there["start"])
    for name in ("force", "torques"):
        np.testing.assert_allclose(moved[name], there[name], rtol=1e-6, atol=1e-7)


def test_records_without_a_force_have_a_code_and_hold_zeros(said):
    """An exclamation mark would mean that a number is left."""
    refused, infeasible, rank_lost = (
        str(CODES[name]) for name in ("refused", "infeasible", "rank_lost")
    )
    for what in ("numbers", "sizes", "starts"):
        assert set(said[what].split()) == {refused}
    assert set(said["rank"].split()) == {rank_lost}
    assert set(said["infeasible"].split()) == {infeasible}
    assert said["many"].split() == ["0", refused, "0"]
    answers = {
        "kept": "1",
        "own previous": "0",
        "updated": "1",
        "remembered again": "11",
        "no update": "0 0 0",
        "many after a call elsewhere": "1",
    }
    assert {name: said[name] for name in answers} == answers


@pytest.mark.parametrize(
    ("setup", "words"),
    [
        ("one point", "positions must be finite and different"),
        ("two contacts, flow", "the flows need contacts that balance wrenches of every direction"),
        ("normals", "normals must be as many as positions"),
        ("length", "normals of unit length, to 1 %"),
        ("nan", "positions must be finite"),
        ("friction", "friction must be 0 to 1e12"),
        ("weights", "weights must be finite and > 0"),
        ("nothing", "positions must be three numbers of each contact"),
        ("not placed", "the contacts must be placed"),
        ("jacobian", "the jacobian must be (N, 3, J) or (N, 6, J), and torque_limit (J,)"),
        ("bias", "torque_bias must be (J,), or none"),
        ("limits", "limits of normal forces must be one of each contact, or none"),
        ("no limit", "limits must be numbers >= 0"),
        ("no jacobian", "the jacobian and torque_bias must be finite"),
        ("tolerance", "the tolerance is a part of the objective: at most 1"),
        ("soft flow", "the flows know hard contacts without limits"),
        ("limited flow", "the flows know hard contacts without limits"),
        ("elastic alone", "elastic belongs to limits"),
        ("criterion", "the criterion belongs to conic"),
        ("file", "nowhere is no whole model file: LearnedInitialForce.export writes one"),
        ("model for three", "the model is for another number of contacts"),
    ],
)
def test_setup_names_what_is_wrong(said, setup, words):
    assert words in said[setup]


def test_calls_allocate_nothing(said):
    counted = {
        name.removeprefix("allocations of "): line
        for name, line in said.items()
        if name.startswith("alloc")
    }
    assert not counted.pop("set-up").startswith("0,")  # the counter works
    assert (len(counted), set(counted.values())) == (17, {"0, wrong: 0"})


def test_a_model_comes_back_from_its_file(tmp_path):
    rule = LearnedInitialForce.pretrained()
    grasp = presets.paper_cuboid()
    blob = rule.export(tmp_path / "model", grasp).read_bytes()
    model = core.Model.load(blob)
    assert model is not None
    assert model.save() == blob
    assert {core.Model.load(each) for each in spoiled(blob)} == {None}


def test_a_model_is_not_exported_for_contacts_that_it_does_not_know(tmp_path):
    rule = LearnedInitialForce.pretrained()
    with pytest.raises(InfeasibleStartError, match="knows 4 contacts"):
        rule.export(tmp_path / "model", presets.tripod())
    with pytest.raises(ModelFileError):
        rule.export(tmp_path / "no folder/model", presets.paper_cuboid())
    assert not list(tmp_path.iterdir())

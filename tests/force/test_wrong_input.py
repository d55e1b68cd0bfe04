"""What errors say, rules between arguments, and rules of somebody else's that fail; `malformed` tries what else no call means."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NoReturn

import numpy as np
import pytest
from force.named import NAMED
from problems import GRASPS, PAPER_WRENCH

from grasp_env import errors
from grasp_env.errors import (
    GraspError,
    InfeasibleStartError,
    InfeasibleWrenchError,
    InvalidInputError,
    UnknownNameError,
    UnsupportedProblemError,
)
from grasp_env.force import (
    DESCENTS,
    METHODS,
    RULES,
    ForceLimits,
    ForceOptimizer,
    LinearCombination,
    Objective,
    Status,
    carry_over,
    initial_rule,
    optimize_force,
    optimize_forces,
)
from grasp_env.force.rules import CoreStart
from grasp_env.grasp import Grasp, presets

GRASP, PUSHED, SOFT = presets.paper_cuboid(), NAMED["pushed"].grasp, NAMED["soft"].grasp
SQUEEZE = np.array([[3.0, 0, 0], [1.2, 0, 0], [0.9, 0, 0], [0.9, 0, 0]])
"""Balanced: moments 1.2 * 0.03."""


def solve(**options: Any) -> Any:
    return optimize_force(wrench=PAPER_WRENCH, **{"grasp": GRASP, **options})


@pytest.mark.parametrize(
    ("wrench", "message"),
    [
        (np.zeros(5), r"wrench must have shape \(6,\), got \(5,\)"), (np.zeros((6, 1)), r"shape \(6,\), got \(6, 1\)"),
        (0.0, r"wrench must have shape \(6,\), got \(\)"), (None, "wrench must"), ("down", "wrench must be numbers"),
        ([1.0, 2.0, 3.0, [4.0], 5.0, 6.0], "wrench must be numbers"), (np.ones(6) * 1j, "wrench must"),
        ([0.0, 0.0, np.nan, 0.0, 0.0, 0.0], r"wrench must be finite, got \[0\.0, 0\.0, nan"),
        ([-np.inf, 0.0, 0.0, 0.0, 0.0, 0.0], r"wrench must be finite, got \[-inf"), ([1e13] * 6, "1e\\+12"),
    ],
)  # fmt: skip
@pytest.mark.parametrize(
    "options",
    [{"initial": "phase_one"}, {"initial": "previous"}, {"method": "conic"}, {"limits": ForceLimits(max_normal=50.0)}],
    ids=str,
)
def test_wrench(wrench: object, message: str, options: dict[str, Any]) -> None:
    optimizer = ForceOptimizer(GRASP, **options)
    want = optimizer.solve(PAPER_WRENCH).force
    for call in (optimizer.solve, optimizer.start) if "initial" in options else (optimizer.solve,):
        with pytest.raises(InvalidInputError, match=message):
            call(wrench)
    optimizer.forget()
    np.testing.assert_array_equal(optimizer.solve(PAPER_WRENCH).force, want)  # it works as before


@pytest.mark.parametrize(
    ("error", "options", "told"),
    [
        *((InvalidInputError, {name: odd}, f"{name} must be .*{odd!r}")
          for name in ("tolerance", "force_weight", "barrier_weight") for odd in (0.0, -1.0, np.nan, np.inf, "much")),
        *((InvalidInputError, {"max_iterations": odd}, f"max_iterations must be an integer >= 0, got {odd!r}")
          for odd in (-1, 1.5, np.nan, "ten", None, True)),
        (InvalidInputError, {"barrier_weight": (0.1, np.nan, 0.1, 0.1)}, "barrier_weight must"),
        (InvalidInputError, {"force_weight": [1.0] * 3}, "force_weight"),
        (InvalidInputError, {"force_weight": [1.0] * 3, "grasp": SOFT}, "force_weight"),
        (InvalidInputError, {"optimum": 0.0}, "optimum"), (InvalidInputError, {"elastic": 1}, "elastic must be True or False, got 1"),
        (InvalidInputError, {"elastic": True}, "give limits"), (InvalidInputError, {"grasp": "grasp"}, "a Grasp is needed"),
        (InvalidInputError, {"limits": {"max_normal": 3.0}}, "limits must"),
        (InvalidInputError, {"limits": ForceLimits(max_normal=[3.0, 3.0])}, "max_normal has 2 entries"),
        (InvalidInputError, {"limits": ForceLimits(jacobian=np.zeros((3, 3, 2)), torque_limit=1.0)}, "jacobian must have"),
        (InvalidInputError, {"initial": 3}, "3"), (InvalidInputError, {"initial": {}}, "{}"),
        *((InvalidInputError, {"method": "conic", **given}, next(iter(given))) for given in (
            {"initial": np.ones((4, 3))}, {"initial": "previous"}, {"optimum": 3.0}, {"trace": True}, {"step_rule": 0.1})),
        *((UnknownNameError, {"method": "conic", "criterion": odd}, "criterion") for odd in ("mean", None, ["sum"])),
        (UnknownNameError, {"method": None}, "method"),
        (UnsupportedProblemError, {"criterion": "max"}, "conic"),
        *((UnsupportedProblemError, {"method": flow, **given}, "newton or conic") for flow in ("reduced_flow", "full_flow")
          for given in ({"limits": ForceLimits(max_normal=9.0)}, {"limits": ForceLimits(min_normal=0.1)}, {"grasp": SOFT})),
    ],
)  # fmt: skip
def test_options(error: type[Exception], options: dict[str, Any], told: str) -> None:
    with pytest.raises(error, match=told) as caught:
        solve(**options)
    assert type(caught.value) is error
    assert isinstance(caught.value, ValueError)
    assert len(str(caught.value)) > 20


@pytest.mark.parametrize(
    ("kind", "call", "allowed"),
    [
        ("method", lambda name: solve(method=name), METHODS),
        ("initial-force rule", lambda name: solve(initial=name), (*RULES, "previous")),
        ("initial-force rule", lambda name: ForceOptimizer(GRASP, initial=name), (*RULES, "previous")),
        ("initial-force rule", lambda name: ForceOptimizer(GRASP).solve(PAPER_WRENCH, initial=name), RULES),
        ("initial-force rule", lambda name: ForceOptimizer(GRASP).start(PAPER_WRENCH, initial=name), RULES),
        ("initial-force rule", initial_rule, RULES),
        ("preset", presets.preset, presets.PRESETS),
        ("correction", lambda name: carry_over(GRASP, PAPER_WRENCH, SQUEEZE, Objective(), name), ("tangent", "pseudoinverse")),
    ],
)  # fmt: skip
@pytest.mark.parametrize("name", ["simplex", "", "Newton"])
def test_names(kind: str, call: Callable[[str], object], allowed: tuple[str, ...], name: str) -> None:
    with pytest.raises(UnknownNameError, match=f"^unknown {kind} {name!r}:.* choose one of") as caught:
        call(name)
    assert ("did you mean 'newton'?" in str(caught.value)) == (name == "Newton" and "newton" in allowed)
    assert isinstance(caught.value, KeyError)
    for choice in allowed:
        assert repr(choice) in str(caught.value)


def test_what_is_set_made_or_misspelt() -> None:
    with pytest.raises(InvalidInputError, match=r"made by Grasp\.from_contacts"):
        replace(GRASP, friction=np.full(4, 0.9))
    optimizer = ForceOptimizer(GRASP, initial="previous")
    for odd in (3, "previous", GRASP, Status.OPTIMAL):
        with pytest.raises(InvalidInputError, match="previous must be a ForceSolution or None"):
            optimizer.previous = odd
    told = r"unknown option 'tolerence': did you mean 'tolerance'\? choose one of 'method', 'initial', "
    with pytest.raises(UnknownNameError, match=told):
        optimize_forces(GRASP, PAPER_WRENCH[None], tolerence=1e-3)
    with pytest.raises(InfeasibleStartError, match="previous solution has 5 contacts, the grasp 4"):
        solve(initial=optimize_force(GRASPS["cuboid, 5"], PAPER_WRENCH))


# rules of somebody else's


class Rule:
    """Its parts can be made to fail."""

    name, remembers = "mine", False

    def __call__(self, grasp: Grasp, wrench: np.ndarray) -> Any:
        return CoreStart("single_value")(grasp, wrench)


def ruled(**parts: object) -> Any:
    """Such a rule with other parts."""
    return type("Other", (Rule,), parts)()


def fail(*_: object) -> NoReturn:
    raise LookupError("no table")


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (lambda good: good[:3], r"initial force must have shape \(4, 3\), got \(3, 3\)"),
        (lambda good: good.reshape(-1), r"initial force must have shape \(4, 3\), got \(12,\)"),
        (lambda _: None, "it returned None: does it end in a return"),
        (lambda _: "strong", "initial force must be numbers"),
        (lambda good: np.where(np.eye(4, 3) > 0.0, np.nan, good), "initial force must be finite, got .*nan"),
        (lambda good: good + np.inf, "initial force must be finite, got .*inf"),
        (lambda good: 1.01 * good, r"misses balance by .* N \(G f \+ w = 0.*Repair"),
        (lambda good: -good, "misses balance"),
        (lambda good: good + [[1e-4, 0.0, 0.0]] * 4, "misses balance by 0.000"),
        (np.zeros_like, "misses balance"),
        (lambda good: good - 3.0 * SQUEEZE, r"leaves the friction cones \(margin -.* N\).*Repair"),
    ],
)
def test_a_rule_that_breaks_its_promise(broken: Callable[[np.ndarray], object], message: str) -> None:
    force = broken(LinearCombination()(GRASP, PAPER_WRENCH))
    rule = ruled(__call__=lambda *_: force)
    for call in (solve, lambda initial: ForceOptimizer(GRASP).solve(PAPER_WRENCH, initial=initial)):
        with pytest.raises(InfeasibleStartError, match=f"initial-force rule 'mine'.*{message}"):
            call(initial=rule)
    if isinstance(force, np.ndarray):
        with pytest.raises(InfeasibleStartError, match=message):
            solve(initial=force)


def test_a_force_within_rounding_of_balance_is_taken() -> None:
    good = LinearCombination()(GRASP, PAPER_WRENCH)
    found = solve(initial=ruled(__call__=lambda *_: good * (1.0 + 1e-12)))
    assert (found.status, found.initial) == (Status.OPTIMAL, "mine")
    assert solve(initial=good).initial == "given"
    with pytest.raises(InfeasibleStartError, match="leaves the friction cones"):  # balanced, but P = 0
        optimize_force(GRASP, np.zeros(6), initial=np.zeros((4, 3)))


@pytest.mark.parametrize(
    ("rule", "told"),
    [
        (fail, "'fail' fails with LookupError: no table; a rule takes"),
        (lambda: 1, "fails with TypeError"),
        (ruled(__call__=fail), "'mine' fails with LookupError"),
        (ruled(objective=property(fail)), "'mine' fails with LookupError"),
        (ruled(model=fail), "'mine' fails with LookupError"),
        (ruled(model=lambda *_: 3), "'mine' .*must be a Model, got 3"),
        (ruled(model=lambda *_: None), "'mine' .*must be a Model, got None"),
    ],
)
@pytest.mark.parametrize("method", ["newton", "reduced_flow"])
def test_a_rule_that_fails(rule: Any, told: str, method: str) -> None:
    with pytest.raises(GraspError, match=told):
        solve(method=method, initial=rule)


def test_a_rule_whose_name_fails_is_called_after_its_class() -> None:
    for rule in (ruled(name=property(fail)), ruled(name=3, __eq__=fail, __str__=fail, __repr__=fail)):
        assert solve(initial=rule).initial == "Other"
        with pytest.raises(InfeasibleStartError):
            optimize_force(PUSHED, [0, 0, 1, 0, 0, 0], initial=rule)


# no force at all


@pytest.mark.parametrize("initial", [None, "phase_one", "internal_force", "previous"])
@pytest.mark.parametrize("method", DESCENTS)
def test_an_infeasible_wrench_carries_its_proof(initial: str | None, method: str) -> None:
    lift = np.array([0.0, 0.0, 2.0, 0.0, 0.0, 0.0])  # contacts only push up; nothing pulls down
    with pytest.raises(InfeasibleWrenchError, match=r"\[0\.0, 0\.0, 2\.0, .*certificate.*add contacts") as caught:
        optimize_force(PUSHED, lift, initial=initial, method=method)
    solution = caught.value.solution
    assert (solution.status, solution.method, solution.force.any()) == (Status.INFEASIBLE, method, False)
    np.testing.assert_array_equal(solution.wrench, lift)
    assert NAMED["pushed"].reference().proof(solution.certificate, lift) >= -1e-9
    with pytest.raises(InfeasibleWrenchError):
        solution.raise_for_status()


def test_errors() -> None:
    error = pickle.loads(pickle.dumps(UnknownNameError("method", "newest", ("conic",), "; look again")))
    assert str(error) == "unknown method 'newest': choose one of 'conic'; look again"
    kinds = [each for each in vars(errors).values() if isinstance(each, type) and issubclass(each, Exception)]
    kinds = [each for each in kinds if not issubclass(each, Warning)]
    assert len(kinds) > 5
    assert all(issubclass(each, GraspError) for each in kinds)
    assert issubclass(GraspError, ValueError)

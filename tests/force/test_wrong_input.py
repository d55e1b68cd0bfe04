"""Wrong input raises the project's error, which is also the matching builtin and names what was given."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NoReturn

import numpy as np
import pytest
from problems import GRASPS, PAPER_WRENCH

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

GRASP = presets.paper_cuboid()
SOFT = Grasp.from_contacts(GRASP.positions, GRASP.normals, 0.4, contact_model="soft", torsional_friction=0.005)


@pytest.mark.parametrize(
    ("wrench", "message"),
    [
        (np.zeros(5), r"wrench must have shape \(6,\), got \(5,\)"),
        (np.zeros((6, 1)), r"wrench must have shape \(6,\), got \(6, 1\)"),
        (0.0, r"wrench must have shape \(6,\), got \(\)"),
        (None, "wrench must"),
        ("down", "wrench must be numbers"),
        ([1.0, 2.0, 3.0, [4.0], 5.0, 6.0], "wrench must be numbers"),
        ([0.0, 0.0, np.nan, 0.0, 0.0, 0.0], r"wrench must be finite, got \[0\.0, 0\.0, nan"),
        ([0.0, 0.0, 0.0, np.inf, 0.0, 0.0], r"wrench must be finite, got .*inf"),
        ([-np.inf, 0.0, 0.0, 0.0, 0.0, 0.0], r"wrench must be finite, got \[-inf"),
        (np.full(6, np.nan), "wrench must be finite"),
        ([1e13] * 6, "1e\\+12"),
        (np.full(6, 1e300), "1e\\+12"),
        ({"force": 1.0}, "wrench must"),
        (np.ones(6) * 1j, "wrench must"),
        (np.array([object()] * 6), "wrench must"),
    ],
)
@pytest.mark.parametrize(
    "options",
    [{"initial": "phase_one"}, {"initial": "previous"}, {"method": "conic"}, {"limits": ForceLimits(max_normal=50.0)}],
    ids=str,
)
def test_wrench(wrench: object, message: str, options: dict[str, Any]) -> None:
    optimizer = ForceOptimizer(GRASP, **options)
    want = optimizer.solve(PAPER_WRENCH).force
    with pytest.raises(InvalidInputError, match=message) as caught:
        optimizer.solve(wrench)
    assert isinstance(caught.value, ValueError)
    if "initial" in options:
        with pytest.raises(InvalidInputError, match=message):
            optimizer.start(wrench)
        optimizer.forget()
    np.testing.assert_array_equal(optimizer.solve(PAPER_WRENCH).force, want)  # it works as before


@pytest.mark.parametrize("option", ["tolerance", "force_weight", "barrier_weight"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf, -np.inf, "much", {}])
def test_positive_options(option: str, value: object) -> None:
    with pytest.raises(InvalidInputError, match=f"{option} must be") as caught:
        optimize_force(GRASP, PAPER_WRENCH, **{option: value})
    given = str(value) if isinstance(value, float) else repr(value)
    assert given in str(caught.value)
    assert isinstance(caught.value, ValueError)


@pytest.mark.parametrize("value", [-1, 1.5, 10.0, np.nan, "ten", None])
def test_max_iterations(value: object) -> None:
    with pytest.raises(InvalidInputError, match="max_iterations must be an integer >= 0, got") as caught:
        optimize_force(GRASP, PAPER_WRENCH, max_iterations=value)
    assert repr(value) in str(caught.value)


def test_numpy_integers_are_integers() -> None:
    solution = optimize_force(GRASP, PAPER_WRENCH, max_iterations=np.int64(3), tolerance=1e-9)
    assert (solution.iterations, solution.status) == (3, Status.ITERATION_LIMIT)


@pytest.mark.parametrize(
    ("kind", "call", "allowed"),
    [
        ("method", lambda name: optimize_force(GRASP, PAPER_WRENCH, method=name), METHODS),
        ("initial-force rule", lambda name: optimize_force(GRASP, PAPER_WRENCH, initial=name), (*RULES, "previous")),
        ("initial-force rule", lambda name: ForceOptimizer(GRASP, initial=name), (*RULES, "previous")),
        ("initial-force rule", lambda name: ForceOptimizer(GRASP).solve(PAPER_WRENCH, initial=name), RULES),
        ("initial-force rule", lambda name: ForceOptimizer(GRASP).start(PAPER_WRENCH, initial=name), RULES),
        ("initial-force rule", initial_rule, RULES),
        ("preset", presets.preset, presets.PRESETS),
        (
            "correction",
            lambda name: carry_over(GRASP, PAPER_WRENCH, np.ones((4, 3)), Objective(), name),
            ("tangent", "pseudoinverse"),
        ),
    ],
)
@pytest.mark.parametrize("name", ["simplex", "", "Newton"])
def test_names(kind: str, call: Callable[[str], object], allowed: tuple[str, ...], name: str) -> None:
    with pytest.raises(UnknownNameError, match=f"^unknown {kind} {name!r}:.* choose one of") as caught:
        call(name)
    assert ("did you mean 'newton'?" in str(caught.value)) == (name == "Newton" and "newton" in allowed)
    assert isinstance(caught.value, KeyError)
    assert isinstance(caught.value, ValueError)
    for choice in allowed:
        assert repr(choice) in str(caught.value)


@pytest.mark.parametrize(
    ("error", "options"),
    [
        (UnknownNameError, {"criterion": "mean"}),
        (UnknownNameError, {"criterion": None}),
        (UnknownNameError, {"criterion": ["sum"]}),
        (UnknownNameError, {"method": None}),
        (UnknownNameError, {"initial": "learned"}),
        (UnsupportedProblemError, {"method": "newton", "criterion": "max"}),
        (UnsupportedProblemError, {"method": "reduced_flow", "limits": ForceLimits(max_normal=9.0)}),
        (UnsupportedProblemError, {"method": "full_flow", "limits": ForceLimits(min_normal=0.1)}),
        (UnsupportedProblemError, {"method": "reduced_flow", "grasp": SOFT}),
        (UnsupportedProblemError, {"method": "full_flow", "grasp": SOFT}),
        (InvalidInputError, {"grasp": "grasp"}),
        (InvalidInputError, {"limits": {"max_normal": 3.0}}),
        (InvalidInputError, {"limits": ForceLimits(max_normal=[3.0, 3.0])}),
        (InvalidInputError, {"limits": ForceLimits(jacobian=np.zeros((3, 3, 2)), torque_limit=1.0)}),
        (InvalidInputError, {"initial": np.ones((4, 3))}),
        (InvalidInputError, {"initial": "previous"}),
        (InvalidInputError, {"method": "newton", "initial": 3}),
        (InvalidInputError, {"method": "newton", "initial": {}}),
        (InvalidInputError, {"method": "newton", "barrier_weight": (0.1, np.nan, 0.1, 0.1)}),
        (InvalidInputError, {"method": "newton", "optimum": 0.0}),
        (InvalidInputError, {"optimum": 3.0}),
        (InvalidInputError, {"trace": True}),
        (InvalidInputError, {"step_rule": 0.1}),
        (InvalidInputError, {"max_iterations": True}),
    ],
    ids=str,
)
def test_wrong_options_are_named(error: type[Exception], options: dict[str, Any]) -> None:
    with pytest.raises(error) as caught:
        optimize_force(wrench=PAPER_WRENCH, **{"grasp": GRASP, "method": "conic", **options})
    assert type(caught.value) is error
    assert len(str(caught.value)) > 20


class _Named:
    """A rule with a name of its own, which messages and solutions carry."""

    name = "my rule"

    def __init__(self, force: object) -> None:
        self.force = force

    def __call__(self, grasp: Grasp, wrench: np.ndarray) -> object:
        return self.force


_SQUEEZE = np.array(
    [[3.0, 0.0, 0.0], [1.2, 0.0, 0.0], [0.9, 0.0, 0.0], [0.9, 0.0, 0.0]]
)  # balanced: moments 1.2 * 0.03


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
        (lambda good: good - 3.0 * _SQUEEZE, r"leaves the friction cones \(margin -.* N\).*Repair"),
    ],
    ids=["rows", "flat", "none", "text", "nan", "inf", "scaled", "negative", "slightly off", "zero", "outside"],
)
def test_a_rule_that_breaks_its_promise(broken: Callable[[np.ndarray], object], message: str) -> None:
    force = broken(LinearCombination()(GRASP, PAPER_WRENCH))
    for call in (
        lambda: optimize_force(GRASP, PAPER_WRENCH, initial=_Named(force)),
        lambda: ForceOptimizer(GRASP).solve(PAPER_WRENCH, initial=_Named(force)),
    ):
        with pytest.raises(InfeasibleStartError, match=f"initial-force rule 'my rule'.*{message}") as caught:
            call()
        assert isinstance(caught.value, ValueError)
        assert not isinstance(caught.value, InfeasibleWrenchError)
    if isinstance(force, np.ndarray):
        with pytest.raises(InfeasibleStartError, match=message):
            optimize_force(GRASP, PAPER_WRENCH, initial=force)


class Rule:
    """A rule of somebody else's whose parts can be made to fail."""

    name, remembers = "mine", False

    def __call__(self, grasp: Grasp, wrench: np.ndarray) -> np.ndarray:
        return CoreStart("single_value")(grasp, wrench)


def failing(**parts: object) -> Rule:
    """Such a rule with other parts."""
    return type("Failing", (Rule,), parts)()  # type: ignore[return-value]


def fail(*_: object) -> NoReturn:
    raise LookupError("no table")


@pytest.mark.parametrize(
    ("rule", "told"),
    [
        (fail, "'fail' fails with LookupError: no table; a rule takes"),
        (lambda: 1, "fails with TypeError"),
        (failing(__call__=fail), "'mine' fails with LookupError"),
        (failing(objective=property(fail)), "'mine' fails with LookupError"),
        (failing(model=fail), "'mine' fails with LookupError"),
        (failing(model=lambda *_: 3), "'mine' .*must be a Model, got 3"),
        (failing(model=lambda *_: None), "'mine' .*must be a Model, got None"),
    ],
)
@pytest.mark.parametrize("method", ["newton", "reduced_flow"])
def test_a_rule_that_fails(rule: Any, told: str, method: str) -> None:
    with pytest.raises(GraspError, match=told):
        optimize_force(GRASP, PAPER_WRENCH, method=method, initial=rule)


def test_a_rule_whose_name_fails_is_called_after_its_class() -> None:
    for rule in (failing(name=property(fail)), failing(name=3, __eq__=fail, __str__=fail, __repr__=fail)):
        assert optimize_force(GRASP, PAPER_WRENCH, initial=rule).initial == "Failing"
        with pytest.raises(InfeasibleStartError):  # fingers that only push upwards
            optimize_force(
                Grasp.from_contacts(GRASP.positions, [[0.0, 0.0, 1.0]] * 4, 0.4), [0, 0, 1, 0, 0, 0], initial=rule
            )


def test_a_grasp_is_not_made_by_hand() -> None:
    with pytest.raises(InvalidInputError, match=r"made by Grasp\.from_contacts"):
        replace(GRASP, friction=np.full(4, 0.9))


def test_what_an_optimizer_holds_is_checked_where_it_is_set() -> None:
    optimizer = ForceOptimizer(GRASP, method="newton", initial="previous")
    for odd in (3, "previous", GRASP, Status.OPTIMAL):
        with pytest.raises(InvalidInputError, match="previous must be a ForceSolution or None"):
            optimizer.previous = odd


def test_options_of_a_batch_have_names() -> None:
    with pytest.raises(
        UnknownNameError,
        match=r"unknown option 'tolerence': did you mean 'tolerance'\? choose one of 'method', 'initial', ",
    ):
        optimize_forces(GRASP, PAPER_WRENCH[None], tolerence=1e-3)


def test_a_rule_within_rounding_of_balance_is_taken() -> None:
    good = LinearCombination()(GRASP, PAPER_WRENCH)
    solution = optimize_force(GRASP, PAPER_WRENCH, initial=_Named(good * (1.0 + 1e-12)))
    assert solution.status is Status.OPTIMAL
    assert solution.initial == "my rule"
    assert optimize_force(GRASP, PAPER_WRENCH, initial=good).initial == "given"


def test_no_force_at_no_wrench_is_not_a_start() -> None:
    # balanced, but P = 0
    with pytest.raises(InfeasibleStartError, match="leaves the friction cones"):
        optimize_force(GRASP, np.zeros(6), initial=np.zeros((4, 3)))


def test_a_rule_never_changes_the_wrench_it_was_given_or_the_callers() -> None:
    wrench = PAPER_WRENCH.copy()
    optimize_force(GRASP, wrench)
    np.testing.assert_array_equal(wrench, PAPER_WRENCH)


def test_a_previous_solution_with_another_number_of_contacts() -> None:
    five = optimize_force(GRASPS["cuboid, 5"], PAPER_WRENCH)
    with pytest.raises(InfeasibleStartError, match="previous solution has 5 contacts, the grasp 4"):
        optimize_force(GRASP, PAPER_WRENCH, initial=five)


@pytest.mark.parametrize("initial", [None, "phase_one", "internal_force", "previous"])
@pytest.mark.parametrize("method", DESCENTS)
def test_an_infeasible_wrench_carries_its_proof(initial: str | None, method: str) -> None:
    floor = Grasp.from_contacts([[0.03, 0, 0], [-0.03, 0.02, 0], [-0.02, -0.03, 0]], [[0.0, 0.0, 1.0]] * 3, 0.4)
    lift = np.array([0.0, 0.0, 2.0, 0.0, 0.0, 0.0])  # contacts only push up; nothing pulls down
    with pytest.raises(InfeasibleWrenchError, match=r"\[0\.0, 0\.0, 2\.0, .*certificate.*add contacts") as caught:
        optimize_force(floor, lift, initial=initial, method=method)
    solution = caught.value.solution
    assert solution is not None
    assert solution.status is Status.INFEASIBLE
    assert solution.method == method
    np.testing.assert_array_equal(solution.wrench, lift)
    assert np.isfinite(solution.force).all()
    twist = solution.certificate
    assert twist is not None
    assert twist @ lift > 0.0
    y = (floor.cone_matrix.T @ twist).reshape(-1, 3)
    assert (y[:, 0] >= np.hypot(y[:, 1], y[:, 2])).all()
    with pytest.raises(InfeasibleWrenchError):
        solution.raise_for_status()


@pytest.mark.parametrize("magnitude", [1e-300, 1e-30, 1e-12, 1e6, 1e9])
@pytest.mark.parametrize("method", ["reduced_flow", "newton"])
@pytest.mark.parametrize("initial", ["linear_combination", "single_value", "lagrange"])
def test_extreme_wrenches_end_soon_with_numbers(magnitude: float, method: str, initial: str) -> None:
    try:
        solution = optimize_force(
            GRASP, magnitude * PAPER_WRENCH, method=method, initial=initial, max_iterations=500, trace=True
        )
    except GraspError:
        return
    assert np.isfinite(solution.force).all()
    assert np.isfinite(solution.objective)
    assert not np.isnan([solution.lower_bound, solution.optimality_gap, solution.equilibrium_residual]).any()
    assert solution.cone_margin > 0.0
    assert solution.trials < 500 * 100


def test_errors_travel_between_processes() -> None:
    error = pickle.loads(pickle.dumps(UnknownNameError("method", "newest", ("conic",), "; look again")))
    assert str(error) == "unknown method 'newest': choose one of 'conic'; look again"


def test_every_project_error_is_a_grasp_error() -> None:
    from grasp_env import errors

    classes = [
        c
        for c in vars(errors).values()
        if isinstance(c, type) and issubclass(c, Exception) and not issubclass(c, Warning)
    ]
    assert len(classes) > 5
    assert all(issubclass(c, GraspError) for c in classes)
    assert issubclass(GraspError, ValueError)

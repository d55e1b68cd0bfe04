"""Wrong input and the words of its errors, failing rules, and wrenches that no force balances.

`tests/malformed` tries the rest at random.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from functools import partial
from typing import Any, NoReturn

import numpy as np
import pytest
from force.named import NAMED
from problems import GRASPS, PAPER_WRENCH

from grasp_env import errors
from grasp_env.config.records import SolverSettings
from grasp_env.errors import (
    GraspError,
    InfeasibleStartError,
    InfeasibleWrenchError,
    InvalidInputError,
    UnknownNameError,
    UnsupportedProblemError,
)
from grasp_env.force import (
    AdaptiveStep,
    ArmijoStep,
    BarzilaiBorweinStep,
    FixedStep,
    ForceLimits,
    ForceOptimizer,
    Objective,
    Status,
    joint_torques,
    optimize_force,
    optimize_forces,
)
from grasp_env.force.initial import LinearCombination
from grasp_env.force.options import DESCENTS, METHODS
from grasp_env.force.repair import carry_over
from grasp_env.force.rules import RULES, CoreRule, initial_rule
from grasp_env.grasp import Grasp, presets

GRASP = presets.paper_cuboid()
PUSHED = NAMED["pushed"].grasp
SOFT = NAMED["soft"].grasp
TRIPOD = presets.tripod()
ONES = np.ones((4, 3))
JAC = np.ones((3, 3, 2))
SPUN = np.zeros((4, 3, 2))
TORQUES = ForceLimits(
    jacobian=0.05 * np.random.default_rng(0).standard_normal((4, 3, 5)), torque_limit=5.0
)
RING = np.array([[np.cos(a), np.sin(a), 0.0] for a in np.arange(9) * 2.0 * np.pi / 9])
MANY = Grasp.from_contacts(0.05 * np.tile(RING, (8, 1))[:65], -np.tile(RING, (8, 1))[:65], 0.5)
SQUEEZE = np.array([[3.0, 0, 0], [1.2, 0, 0], [0.9, 0, 0], [0.9, 0, 0]])
"""Balanced: moments 1.2 * 0.03."""


def solve(**options: Any) -> Callable[[], Any]:
    return partial(optimize_force, **{"grasp": GRASP, "wrench": PAPER_WRENCH, **options})


def call(name: str = "solve", **given: Any) -> Callable[[], Any]:
    """A call of an optimizer with torque limits."""
    optimizer = ForceOptimizer(GRASP, limits=TORQUES)
    return partial(getattr(optimizer, name), *([] if name == "update" else [PAPER_WRENCH]), **given)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        # wrenches and options
        (
            solve(wrench=np.zeros(5), initial="phase_one"),
            r"wrench must have shape \(6,\), got \(5,\)",
        ),
        (solve(wrench="down"), "wrench must be numbers"),
        (
            solve(wrench=[0.0, 0.0, np.nan, 0.0, 0.0, 0.0], method="conic"),
            r"wrench must be finite, got \[0\.0, 0\.0, nan",
        ),
        (solve(wrench=[1e13] * 6, limits=ForceLimits(max_normal=50.0)), "1e\\+12"),
        (solve(max_iterations=1.5), "max_iterations must be an integer >= 0, got 1.5"),
        (solve(barrier_weight=(0.1, np.nan, 0.1, 0.1)), "barrier_weight"),
        (solve(force_weight=[1.0] * 3), "force_weight has 3 entries, the grasp 4"),
        (solve(optimum=0.0), "optimum"),
        (solve(elastic=1), "elastic must be True or False, got 1"),
        (solve(elastic=True), "give limits"),
        (solve(grasp="grasp"), "a Grasp is needed"),
        (solve(initial=3), "initial must be a rule's name"),
        (solve(limits={"max_normal": 3.0}), "limits must"),
        (
            solve(limits=ForceLimits(max_normal=[3.0, 3.0])),
            "max_normal has 2 entries, the grasp 4 contacts: give one or 4",
        ),
        (
            solve(limits=ForceLimits(jacobian=JAC, torque_limit=1.0)),
            r"jacobian must have shape \(4, 3, J\)",
        ),
        *(
            (solve(method="conic", **{name: odd}), name)
            for name, odd in (
                ("initial", np.ones((4, 3))),
                ("optimum", 3.0),
                ("trace", True),
                ("step_rule", 0.1),
            )
        ),
        (
            solve(method="conic", barrier_weight=0.1),
            "method 'conic' has no barrier, got barrier_weight=0.1: take method='newton', or leave it out",
        ),
        (
            partial(SolverSettings, method="conic", barrier_weight=0.1),
            "has no barrier, got solver.barrier_weight=0.1",
        ),
        (solve(criterion="max"), "belongs to method 'conic'"),
        (solve(step_rule=FixedStep(0.1)), "step_rule belongs to the flows, got method 'newton'"),
        *(
            (solve(method="reduced_flow", **given), "newton or conic")
            for given in ({"limits": ForceLimits(max_normal=9.0)}, {"grasp": SOFT})
        ),
        (
            solve(method="full_flow", grasp=Grasp.from_contacts(0.05 * RING, -RING, 0.5)),
            "the full flow is dense: at most 8 contacts",
        ),
        (
            solve(initial=optimize_force(GRASPS["cuboid, 5"], PAPER_WRENCH)),
            "previous solution has 5 contacts, the grasp 4",
        ),
        (
            partial(setattr, ForceOptimizer(GRASP), "previous", 3),
            "previous must be a ForceSolution or None",
        ),
        (solve(method="Newton"), "did you mean 'newton'"),
        (partial(AdaptiveStep, grow=0.5), "grow must lie within 1 to"),
        (partial(ArmijoStep, slope=1.0), "slope must lie within .*less than 1"),
        (
            solve(method="reduced_flow", step_rule="exact"),
            r"a FixedStep, ArmijoStep, .* or ExactStep, got 'exact'",
        ),
        # names: each lists the choices
        *(
            (named, f"unknown {kind} 'simplex':.* choose one of .*{re}")
            for kind, re, named in (
                ("method", METHODS[-1], solve(method="simplex")),
                ("initial-force rule", "phase_one", call("start", initial="simplex")),
                ("initial-force rule", [*RULES][-1], partial(initial_rule, "simplex")),
                ("variant", "short", partial(BarzilaiBorweinStep, variant="simplex")),
                (
                    "correction",
                    "tangent",
                    partial(carry_over, GRASP, PAPER_WRENCH, SQUEEZE, Objective(), "simplex"),
                ),
            )
        ),
        # arguments of a call
        *(
            (call(name, **given), message)
            for name in ("solve", "update")
            for given, message in (
                (
                    {"positions": np.zeros((3, 3))},
                    r"positions must have shape \(4, 3\), got \(3, 3\)",
                ),
                ({"normals": 2.0 * GRASP.normals}, "normal"),
                ({"friction": -0.1}, "friction"),
                ({"jacobian": np.zeros((4, 3, 4))}, "jacobian must have 5 joints"),
            )
        ),
        (
            partial(ForceOptimizer(MANY).solve, PAPER_WRENCH, contacts=np.ones(65, bool)),
            "at most 64",
        ),
        (partial(ForceOptimizer(GRASP).solve, PAPER_WRENCH, torque_bias=np.zeros(5)), "torque"),
        (
            partial(ForceOptimizer(GRASP, method="conic").start, PAPER_WRENCH),
            "takes no initial force",
        ),
        # limits and torques
        (
            partial(ForceLimits, min_normal=np.inf),
            "min_normal must lie within 0 to .*one for all or one per contact, got inf",
        ),
        (partial(ForceLimits, [[1.0]]), "min_normal must lie"),
        (
            partial(ForceLimits, max_normal=0),
            "max_normal must lie within .*, or be inf for no limit",
        ),
        (partial(ForceLimits, max_normal="a"), "a number or one per contact"),
        (partial(ForceLimits, 2, [3, 2, 4]), "at contact 1 they are 2 and 2"),
        (partial(ForceLimits, [0, 0], [1, 1, 1]), "min_normal has 2 entries and max_normal 3"),
        (partial(ForceLimits, torque_limit=1), "together, got only torque_limit"),
        (
            partial(ForceLimits, torque_bias=[1.0]),
            "torque_bias without torque limits has no effect",
        ),
        (
            partial(ForceLimits, jacobian=JAC, torque_limit=[1, 1, 1]),
            "torque_limit has 3 entries, the jacobian 2 joints",
        ),
        (
            partial(ForceLimits().slack, TRIPOD, ONES[:3], np.ones(2)),
            r"torsion must have shape \(3,\)",
        ),
        (
            partial(joint_torques, np.zeros((4, 4, 2)), ONES),
            r"jacobian must have shape \(4, 3, J\), \(12, J\) or \(4, 6, J\) .*got \(4",
        ),
        (
            partial(joint_torques, SPUN, ONES, moment=ONES),
            r"moment needs a jacobian of shape \(N, 6, J\)",
        ),
        # batches and Phi
        (partial(optimize_forces, GRASP, np.zeros(6)), "wrenches must have shape"),
        (
            partial(optimize_forces, GRASP, np.zeros((2, 6)), workers=0),
            "workers must be an integer >= 1",
        ),
        (partial(optimize_forces, [GRASP], np.zeros((2, 6))), "as many grasps as wrenches"),
        (
            partial(optimize_forces, GRASP, np.zeros((2, 6)), initial="previous"),
            "no previous solution",
        ),
        (partial(optimize_forces, [GRASP, TRIPOD], np.zeros((2, 6))), "one number of contacts"),
        (partial(optimize_forces, [GRASP, 3], np.zeros((2, 6))), "entry 1 is int"),
        (
            partial(optimize_forces, GRASP, np.zeros((2, 6)), tolerence=1e-3),
            "unknown option 'tolerence': did you mean 'tolerance'",
        ),
        (partial(Objective().gradient, np.ones(6)), "x must lie strictly inside the cones"),
        (partial(Objective().value, np.ones(4)), "x must have 3 numbers for each contact"),
        (partial(Objective().value, np.ones(5)), "x must have 3 numbers for each contact"),
        (partial(Objective().value, np.ones(8), [2]), "x must have 3 numbers for each contact"),
        (partial(Objective().value, np.ones(0), []), "at least one contact"),
        (partial(Objective().value, np.ones(4), [4]), r"tangential must be 0, 1, 2 or 3, got \[4"),
        (partial(Objective().value, np.ones(4), [1.5]), "tangential must be 0, 1, 2 or 3"),
        (partial(Objective().value, np.ones(4), 3), "tangential must"),
        (
            partial(Objective().gradient, np.array([1.0, 0.6, 0.0, 0.9]), [3]),
            "x must lie strictly inside the cones",
        ),
        (
            partial(Objective().of, TRIPOD, ONES[:3], np.zeros(2)),
            r"torsion must have shape \(3,\)",
        ),
    ],
)
def test_wrong_input(call, message):
    with pytest.raises(GraspError, match=message) as caught:
        call()
    kinds = {"unknown": UnknownNameError, "previous solution has": InfeasibleStartError}
    kinds |= dict.fromkeys(
        (
            "belongs to",
            "newton or conic",
            "has no barrier, got barrier_weight",
            "dense",
            "no initial force",
        ),
        UnsupportedProblemError,
    )
    kind = next(
        (kind for words, kind in kinds.items() if words in str(caught.value)), InvalidInputError
    )
    assert type(caught.value) is kind
    assert isinstance(caught.value, ValueError)


@pytest.mark.parametrize(
    "options", [{"initial": "phase_one"}, {"initial": "previous"}, {"method": "conic"}], ids=str
)
def test_an_optimizer_works_after_an_error(options):
    optimizer = ForceOptimizer(GRASP, **options)
    want = optimizer.solve(PAPER_WRENCH).force
    for given in ({"wrench": np.zeros(5)}, {"wrench": PAPER_WRENCH, "positions": np.zeros((4, 3))}):
        with pytest.raises(GraspError):
            optimizer.solve(**given)
    optimizer.forget()
    np.testing.assert_array_equal(optimizer.solve(PAPER_WRENCH).force, want)


# rules that fail


class Rule:
    name, remembers = "mine", False

    def __call__(self, grasp: Grasp, wrench: np.ndarray) -> Any:
        return CoreRule("single_value")(grasp, wrench)


def ruled(**parts: object) -> Any:
    """A rule with other parts."""
    return type("Other", (Rule,), parts)()


def fail(*_: object) -> NoReturn:
    raise LookupError("no table")


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (lambda good: good[:3], r"initial force must have shape \(4, 3\), got \(3, 3\)"),
        (lambda _: None, "it returned None: does it end in a return"),
        (lambda _: "strong", "initial force must be numbers"),
        (lambda good: good + np.inf, "initial force must be finite, got .*inf"),
        (lambda good: 1.01 * good, r"misses balance by .* N \(G f \+ w = 0.*Repair"),
        (lambda good: good + [[1e-4, 0.0, 0.0]] * 4, "misses balance by 0.000"),
        (
            lambda good: good - 3.0 * SQUEEZE,
            r"leaves the friction cones \(cone margin -.* N.*\).*Repair",
        ),
    ],
)
def test_a_rule_that_breaks_its_promise(broken, message):
    good = LinearCombination()(GRASP, PAPER_WRENCH)
    force = broken(good)
    for rule in (
        ruled(__call__=lambda *_: force),
        *([force] if isinstance(force, np.ndarray) else []),
    ):
        with pytest.raises(InfeasibleStartError, match=message):
            solve(initial=rule)()
    # within rounding of balance
    found = solve(initial=ruled(__call__=lambda *_: good * (1.0 + 1e-12)))()
    assert (found.status, found.initial) == (Status.OPTIMAL, "mine")


@pytest.mark.parametrize(
    ("rule", "message"),
    [
        (fail, "'fail' fails with LookupError: no table; a rule takes"),
        (lambda: 1, "fails with TypeError"),
        (ruled(__call__=fail), "'mine' fails with LookupError"),
        (ruled(model=fail), "'mine' fails with LookupError"),
        (ruled(model=lambda *_: 3), "'mine' .*must be a Model, got 3"),
        (ruled(model=lambda *_: None), "'mine' .*must be a Model, got None"),
    ],
)
def test_a_rule_that_fails(rule, message):
    for method in ("newton", "reduced_flow"):
        with pytest.raises(GraspError, match=message):
            solve(method=method, initial=rule)()


# no force at all


@pytest.mark.parametrize("initial", [None, "phase_one", "internal_force", "previous"])
@pytest.mark.parametrize("method", DESCENTS)
def test_an_infeasible_wrench_carries_its_proof(initial, method):
    lift = np.array([0.0, 0.0, 2.0, 0.0, 0.0, 0.0])  # contacts only push up; nothing pulls down
    with pytest.raises(
        InfeasibleWrenchError, match=r"\[0\.0, 0\.0, 2\.0, .*certificate.*add contacts"
    ) as caught:
        optimize_force(PUSHED, lift, initial=initial, method=method)
    solution = caught.value.solution
    assert (solution.status, solution.method, solution.force.any()) == (
        Status.INFEASIBLE,
        method,
        False,
    )
    np.testing.assert_array_equal(solution.wrench, lift)
    assert NAMED["pushed"].reference().proof(solution.certificate, lift) >= -1e-9
    with pytest.raises(InfeasibleWrenchError):
        solution.raise_for_status()


def test_errors_are_of_one_tree_and_survive_pickling():
    error = pickle.loads(
        pickle.dumps(UnknownNameError("method", "newest", ("conic",), "; look again"))
    )
    assert str(error) == "unknown method 'newest': choose one of 'conic'; look again"
    kinds = [
        each
        for each in vars(errors).values()
        if isinstance(each, type) and issubclass(each, Exception)
    ]
    kinds = [each for each in kinds if not issubclass(each, Warning)]
    assert len(kinds) > 5
    assert all(issubclass(each, GraspError) for each in kinds)
    assert issubclass(GraspError, ValueError)

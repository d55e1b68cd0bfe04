"""Step rules: every rule keeps what a flow promises, and takes the steps that its docstring says."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
from oracles import reduced_flow
from oracles.descent import Landscape, descend
from problems import GRASPS, LIGHT, PAPER_WRENCH, STEP_RULES, closure_grasps
from scipy.optimize import minimize_scalar

from grasp_env.errors import InvalidInputError, UnknownNameError
from grasp_env.force import ForceOptimizer, LinearCombination, Objective, OfflineBasis, Status, optimize_force
from grasp_env.force.step_size import (
    AdaptiveStep,
    ArmijoStep,
    BarzilaiBorweinStep,
    ExactStep,
    FixedStep,
    StepRule,
    checked_rule,
)
from grasp_env.grasp import Grasp
from grasp_env.grasp import wrench as wrenches

OBJECTIVE = Objective(1.0, 0.1)
WILD: dict[str, StepRule] = {
    "fixed, huge": FixedStep(1e9),
    "fixed, tiny": FixedStep(1e-15),
    "armijo, huge": ArmijoStep(1e12, shrink=0.9, slope=0.9),
    "armijo, strict": ArmijoStep(1.0, slope=0.999),
    "adaptive, wild": AdaptiveStep(1e6, grow=1e5, shrink=0.99),
    "short, huge": BarzilaiBorweinStep(1e12),
    "long, tiny": BarzilaiBorweinStep(1e-12, shrink=0.01, variant="long"),
    "exact, fine": ExactStep(1e-14),
    "exact, coarse": ExactStep(0.999),
}


def _start(grasp: Grasp, wrench: np.ndarray = LIGHT, squeeze: float = 2.0) -> np.ndarray:
    return grasp.to_cone(LinearCombination(OBJECTIVE)(grasp, wrench) + squeeze * OfflineBasis.of(grasp, OBJECTIVE).rest)


def _land(grasp: Grasp) -> Landscape:
    return reduced_flow.landscape(grasp.cone_matrix, OBJECTIVE.weights(grasp.n_contacts))


@pytest.mark.parametrize("rule", [*STEP_RULES.values(), *WILD.values()], ids=[*STEP_RULES, *WILD])
def test_every_iterate_is_inside_balanced_and_better(rule: StepRule) -> None:
    rng = np.random.default_rng(3)
    for grasp in closure_grasps(10):
        optimizer = ForceOptimizer(grasp, step_rule=rule, barrier_weight=0.1, tolerance=1e-12, max_iterations=80)
        for wrench in (*wrenches.sample_ball(rng, 2), *wrenches.sample_magnitudes(rng, 2, 1e-3, 1e3)):
            solution = optimizer.solve(wrench, trace=True)
            assert solution.status in (Status.OPTIMAL, Status.ITERATION_LIMIT, Status.STALLED)
            assert np.isfinite(solution.force).all()
            assert np.isfinite(solution.objective_trace).all()
            assert len(solution.objective_trace) == solution.iterations + 1
            assert (np.diff(solution.objective_trace) < 0.0).all()
            assert solution.objective_trace[-1] == solution.objective
            x = grasp.to_cone(solution.force).reshape(-1)
            assert OBJECTIVE.value(x) == pytest.approx(solution.objective, rel=1e-9)
            assert solution.trials >= solution.iterations
            assert solution.lower_bound <= solution.objective * (1.0 + 1e-10)
            assert grasp.cone_margin(solution.force) > 0.0
            size = np.abs(solution.initial_force).max() + np.abs(grasp.unit_frame @ wrench).max()
            assert grasp.residual(solution.force, wrench) <= 1e-12 * size


@pytest.mark.parametrize(
    "rule",
    [
        AdaptiveStep(first=1e-15, grow=1.0),
        AdaptiveStep(first=1e12, grow=999_999.0, shrink=0.999),
        AdaptiveStep(grow=float(np.nextafter(1.0, 2.0))),
        ArmijoStep(first=1e12, shrink=0.999, slope=1.0 - 1e-16),
        BarzilaiBorweinStep(first=1e12, shrink=0.999, variant="long"),
        ExactStep(1e-15),
        FixedStep(1e12),
    ],
    ids=str,
)
def test_the_ends_of_the_ranges_end(rule: StepRule) -> None:
    begin = time.perf_counter()
    solution = optimize_force(GRASPS["cuboid, 4"], PAPER_WRENCH, step_rule=rule, max_iterations=200)
    assert solution.status in (Status.OPTIMAL, Status.ITERATION_LIMIT, Status.STALLED)
    assert solution.trials <= 201 * 2500
    assert time.perf_counter() - begin < 5.0  # milliseconds in truth


def _first_steps(rule: StepRule, count: int) -> tuple[list[np.ndarray], list[float]]:
    grasp = GRASPS["cuboid, 4"]
    iterates: list[np.ndarray] = []

    def keep(state: np.ndarray, _value: float, _iterations: int) -> bool:
        iterates.append(state)
        return False

    result = descend(_start(grasp), _land(grasp), keep, rule, count)
    return iterates, result.steps


def test_exact_step_is_the_minimum_along_the_ray() -> None:
    land = _land(GRASPS["cuboid, 4"])
    iterates, steps = _first_steps(ExactStep(1e-9), 6)
    for x, alpha in zip(iterates, steps, strict=False):
        move = land.direction(x)
        best = minimize_scalar(
            lambda a, x=x, move=move: min(land.value(x + a * move), 1e6), bounds=(0.0, 10.0 * alpha), method="bounded",
            options={"xatol": 1e-12},
        )  # fmt: skip
        assert land.value(x + alpha * move) <= best.fun * (1.0 + 1e-12)


def test_armijo_steps_decrease_sufficiently_and_are_the_first_to() -> None:
    land = _land(GRASPS["cuboid, 4"])
    rule = ArmijoStep(first=0.5, shrink=0.5, slope=0.3)
    iterates, steps = _first_steps(rule, 10)
    for x, alpha in zip(iterates, steps, strict=False):
        move = land.direction(x)
        squared = float(land.metric @ move**2)
        enough = lambda a, x=x, move=move, q=squared: land.value(x + a * move) <= land.value(x) - 0.3 * a * q  # noqa: E731
        assert enough(alpha)
        assert alpha == 0.5 or not enough(2.0 * alpha)


def test_barzilai_borwein_steps_are_inverse_curvatures() -> None:
    land = _land(GRASPS["cuboid, 4"])
    for variant in ("long", "short", "alternate"):
        iterates, steps = _first_steps(BarzilaiBorweinStep(1e-3, variant=variant), 10)
        for k in range(1, 9):
            s = iterates[k] - iterates[k - 1]
            y = land.direction(iterates[k - 1]) - land.direction(iterates[k])
            long, short = land.metric @ s**2 / (land.metric @ (s * y)), land.metric @ (s * y) / (land.metric @ y**2)
            expected = {"long": long, "short": short, "alternate": short if k % 2 else long}[variant]
            assert short <= long
            # halved until Phi decreases
            halvings = float(np.log2(expected / steps[k]))
            assert halvings == pytest.approx(round(halvings), abs=1e-6)
            assert halvings > -1e-6


def test_fixed_step_is_fixed_where_it_can_be() -> None:
    assert set(_first_steps(FixedStep(0.01), 50)[1]) == {0.01}
    solution = optimize_force(
        GRASPS["cuboid, 4"], LIGHT, method="reduced_flow", step_rule=FixedStep(0.01), barrier_weight=0.1,
        tolerance=1e-12, max_iterations=50,
    )  # fmt: skip
    assert solution.iterations == solution.trials == 50


@pytest.mark.parametrize(
    ("rule", "given", "message"),
    [
        (FixedStep, {"size": 0.0}, "size must be finite and > 0, got 0.0"),
        (FixedStep, {"size": "big"}, "size must be a number > 0, got 'big'"),
        (ArmijoStep, {"first": float("nan")}, "first must be finite and > 0, got nan"),
        (ArmijoStep, {"shrink": 1.0}, r"shrink must lie in \(0, 1\), got 1.0"),
        (ArmijoStep, {"shrink": 1.0 - 1e-12}, "shrink must lie within 0.001 to 0.999, got 0.999999999999"),
        (AdaptiveStep, {"shrink": 1e-9}, "shrink must lie within 0.001 to 0.999, got 1e-09"),
        (AdaptiveStep, {"grow": float("nan")}, "grow must be a finite factor >= 1, got nan"),
        (ArmijoStep, {"slope": 0.0}, r"slope must lie in \(0, 1\), got 0.0"),
        (AdaptiveStep, {"grow": 0.5}, "grow must be a finite factor >= 1, got 0.5"),
        (AdaptiveStep, {"shrink": "half"}, r"shrink must lie in \(0, 1\), got 'half'"),
        (BarzilaiBorweinStep, {"first": -1.0}, "first must be finite and > 0, got -1.0"),
        (BarzilaiBorweinStep, {"shrink": 2.0}, r"shrink must lie in \(0, 1\), got 2.0"),
        (ExactStep, {"precision": 1.0}, r"precision must lie in \(0, 1\), got 1.0"),
    ],
)
def test_wrong_arguments_say_what_is_allowed(rule: Any, given: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        rule(**given)


def test_wrong_variant_and_wrong_rule() -> None:
    with pytest.raises(UnknownNameError, match="'medium': choose one of 'alternate', 'long', 'short'"):
        BarzilaiBorweinStep(variant="medium")
    with pytest.raises(InvalidInputError, match=r"a FixedStep, ArmijoStep, .* or ExactStep, got 'exact'"):
        checked_rule("exact")
    assert checked_rule(None) == AdaptiveStep()
    assert checked_rule(ExactStep()) == ExactStep()

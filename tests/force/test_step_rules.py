"""Step rules: the compiled loop takes the plain one's steps, and every rule keeps what a flow promises."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from problems import GRASPS, PAPER_WRENCH, closure_grasps, weights
from scipy.optimize import minimize_scalar

from grasp_env.errors import InvalidInputError, UnknownNameError
from grasp_env.force import LinearCombination, Objective, OfflineBasis, full_flow, reduced_flow
from grasp_env.force.descent import descend
from grasp_env.force.flow import FORMS, Flow
from grasp_env.force.flow_kernels import flow as compiled_flow
from grasp_env.force.record import CONVERGED, LIMIT, STALLED
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
LIGHT = np.array([0.3, -0.2, 0.5, 0.01, -0.005, 0.008])
RULES: dict[str, StepRule] = {
    "fixed": FixedStep(0.01),
    "armijo": ArmijoStep(),
    "adaptive": AdaptiveStep(),
    "short": BarzilaiBorweinStep(),
    "long": BarzilaiBorweinStep(variant="long"),
    "alternate": BarzilaiBorweinStep(variant="alternate"),
    "exact": ExactStep(),
    "rough": ExactStep(0.1),
}
WILD: dict[str, StepRule] = {
    "fixed, huge": FixedStep(1e9),
    "fixed, tiny": FixedStep(1e-15),
    "armijo, huge": ArmijoStep(1e200, shrink=0.9, slope=0.9),
    "armijo, strict": ArmijoStep(1.0, slope=0.999),
    "adaptive, wild": AdaptiveStep(1e6, grow=1e5, shrink=0.99),
    "short, huge": BarzilaiBorweinStep(1e300),
    "long, tiny": BarzilaiBorweinStep(1e-200, shrink=0.01, variant="long"),
    "exact, fine": ExactStep(1e-14),
    "exact, coarse": ExactStep(0.999),
}


def _start(grasp: Grasp, wrench: np.ndarray = LIGHT, squeeze: float = 2.0) -> np.ndarray:
    return grasp.to_cone(LinearCombination(OBJECTIVE)(grasp, wrench) + squeeze * OfflineBasis.of(grasp, OBJECTIVE).rest)


@pytest.mark.parametrize("rule", RULES.values(), ids=RULES)
@pytest.mark.parametrize("name", GRASPS)
def test_compiled_steps_are_the_plain_ones(name: str, rule: StepRule) -> None:
    grasp = GRASPS[name]
    iterates: list[np.ndarray] = []
    count = 12  # few enough that no decision hangs on rounding

    def keep(state: np.ndarray, _value: float, _iterations: int) -> bool:
        iterates.append(state)
        return False

    start = _start(grasp)
    plain = descend(start, reduced_flow.landscape(grasp, OBJECTIVE), keep, rule, count)
    flow = Flow(grasp)
    for k, expected in enumerate(iterates):
        x = start.copy()
        code, iterations, trials, value, _ = flow.run(
            weights(x, 1.0, 0.1), x, LIGHT, rule, tolerance=1e-300, max_iterations=k
        )
        assert (code, iterations) == (LIMIT, k)
        np.testing.assert_allclose(x, expected, rtol=0, atol=1e-8 * np.abs(expected).max())
        assert value == pytest.approx(plain.values[k], rel=1e-10)
    assert trials == plain.trials >= count


@pytest.mark.parametrize("rule", RULES.values(), ids=RULES)
def test_the_plain_full_flow_takes_every_rule(rule: StepRule) -> None:
    grasp, start = GRASPS["tripod, uneven"], _start(GRASPS["tripod, uneven"])
    never = lambda state, value, iterations: False  # noqa: E731
    whole = descend(full_flow.start(start), full_flow.landscape(grasp, OBJECTIVE), never, rule, 8)
    reduced = descend(start, reduced_flow.landscape(grasp, OBJECTIVE), never, rule, 8)
    np.testing.assert_allclose(whole.steps, reduced.steps, rtol=1e-6)
    np.testing.assert_allclose(full_flow.cone_coordinates(whole.state), reduced.state, rtol=0, atol=1e-8)


@pytest.mark.parametrize("rule", [*RULES.values(), *WILD.values()], ids=[*RULES, *WILD])
def test_every_iterate_is_inside_balanced_and_better(rule: StepRule) -> None:
    rng = np.random.default_rng(3)
    for grasp in closure_grasps(10):
        flow = Flow(grasp)
        for wrench in (*wrenches.sample_ball(rng, 2), *wrenches.sample_magnitudes(rng, 2, 1e-3, 1e3)):
            start = _start(grasp, wrench, 0.0)
            trace = np.full(81, np.nan)
            x = start.copy()
            w = OBJECTIVE.weights(grasp.n_contacts)
            code, iterations, trials, value, bound = flow.run(
                w, x, wrench, rule, tolerance=1e-12, max_iterations=80, trace=trace
            )
            assert code in (CONVERGED, LIMIT, STALLED)
            assert np.isfinite(x).all()
            assert np.isfinite(trace[: iterations + 1]).all()
            assert (np.diff(trace[: iterations + 1]) < 0.0).all()
            assert trace[iterations] == value
            assert OBJECTIVE.value(x) == pytest.approx(value, rel=1e-12)
            assert trials >= iterations
            assert bound <= value * (1.0 + 1e-10)
            assert grasp.cone_margin(grasp.to_force(x)) > 0.0
            size = np.abs(start).max() + np.abs(wrench[:3]).max() + np.abs(wrench[3:]).max() / grasp.length
            assert grasp.residual(grasp.to_force(x), wrench) <= 1e-10 * size / min(1.0, grasp.length)


@pytest.mark.parametrize("rule", RULES.values(), ids=RULES)
def test_every_rule_converges_with_a_certificate(rule: StepRule) -> None:
    for grasp in GRASPS.values():
        x = _start(grasp)
        code, iterations, _, value, bound = Flow(grasp).run(
            weights(x, 1.0, 0.1), x, LIGHT, rule, tolerance=1e-8, max_iterations=50_000
        )
        assert code == CONVERGED
        assert iterations > 0
        assert bound <= value <= bound * (1.0 + 1e-8)


@pytest.mark.parametrize("rule", [*RULES.values(), WILD["exact, fine"]], ids=[*RULES, "fine"])
def test_it_stalls_where_floating_point_ends(rule: StepRule) -> None:
    grasp = GRASPS["cuboid, 4"]
    x = _start(grasp, PAPER_WRENCH)
    code, _, _, value, bound = Flow(grasp).run(
        OBJECTIVE.weights(4), x, PAPER_WRENCH, rule, tolerance=1e-300, max_iterations=200_000
    )
    assert code == STALLED or (code == CONVERGED and value <= bound)
    assert value == pytest.approx(16.888750549924, rel=1e-9)


@pytest.mark.parametrize("name", [name for name in RULES if name != "fixed"])  # that one does not grow
def test_a_start_at_the_apex_gets_away(name: str) -> None:
    grasp = GRASPS["cuboid, 4"]
    tiny = 1e-7 * _start(grasp, np.zeros(6))
    x = tiny.copy()
    code, iterations, _, value, _ = Flow(grasp).run(
        OBJECTIVE.weights(4), x, np.zeros(6), RULES[name], tolerance=1e-3, max_iterations=20_000
    )
    assert code == CONVERGED
    assert iterations > 0
    assert value < 1e-3 * OBJECTIVE.value(tiny)


def test_one_compiled_loop_for_all_rules_and_forms() -> None:
    grasp = GRASPS["tripod"]
    for form in FORMS:
        for rule in RULES.values():
            x = _start(grasp)
            Flow(grasp, form).run(weights(x, 1.0, 0.1), x, LIGHT, rule, max_iterations=3)
    assert len(compiled_flow.signatures) <= 1


def _first_steps(rule: StepRule, count: int) -> tuple[list[np.ndarray], list[float]]:
    grasp = GRASPS["cuboid, 4"]
    iterates: list[np.ndarray] = []

    def keep(state: np.ndarray, _value: float, _iterations: int) -> bool:
        iterates.append(state)
        return False

    result = descend(_start(grasp), reduced_flow.landscape(grasp, OBJECTIVE), keep, rule, count)
    return iterates, result.steps


def test_exact_step_is_the_minimum_along_the_ray() -> None:
    land = reduced_flow.landscape(GRASPS["cuboid, 4"], OBJECTIVE)
    iterates, steps = _first_steps(ExactStep(1e-9), 6)
    for x, alpha in zip(iterates, steps, strict=False):
        move = land.direction(x)
        best = minimize_scalar(
            lambda a, x=x, move=move: min(land.value(x + a * move), 1e6), bounds=(0.0, 10.0 * alpha), method="bounded",
            options={"xatol": 1e-12},
        )  # fmt: skip
        assert land.value(x + alpha * move) <= best.fun * (1.0 + 1e-12)


def test_armijo_steps_decrease_sufficiently_and_are_the_first_to() -> None:
    land = reduced_flow.landscape(GRASPS["cuboid, 4"], OBJECTIVE)
    rule = ArmijoStep(first=0.5, shrink=0.5, slope=0.3)
    iterates, steps = _first_steps(rule, 10)
    for x, alpha in zip(iterates, steps, strict=False):
        move = land.direction(x)
        squared = float(land.metric @ move**2)
        enough = lambda a, x=x, move=move, q=squared: land.value(x + a * move) <= land.value(x) - 0.3 * a * q  # noqa: E731
        assert enough(alpha)
        assert alpha == 0.5 or not enough(2.0 * alpha)


def test_barzilai_borwein_steps_are_inverse_curvatures() -> None:
    land = reduced_flow.landscape(GRASPS["cuboid, 4"], OBJECTIVE)
    for variant in ("long", "short", "alternate"):
        iterates, steps = _first_steps(BarzilaiBorweinStep(1e-3, variant=variant), 10)
        for k in range(1, 9):
            s = iterates[k] - iterates[k - 1]
            y = land.direction(iterates[k - 1]) - land.direction(iterates[k])
            long, short = land.metric @ s**2 / (land.metric @ (s * y)), land.metric @ (s * y) / (land.metric @ y**2)
            expected = {"long": long, "short": short, "alternate": short if k % 2 else long}[variant]
            assert short <= long
            # halved until Phi decreases
            halvings = np.log2(expected / steps[k])
            assert halvings == pytest.approx(round(halvings), abs=1e-6)
            assert halvings > -1e-6


def test_fixed_step_is_fixed_where_it_can_be() -> None:
    assert set(_first_steps(FixedStep(0.01), 50)[1]) == {0.01}
    grasp = GRASPS["cuboid, 4"]
    x = _start(grasp)
    _, iterations, trials, _, _ = Flow(grasp).run(
        OBJECTIVE.weights(4), x, LIGHT, FixedStep(0.01), tolerance=1e-12, max_iterations=50
    )
    assert iterations == trials == 50


@pytest.mark.parametrize(
    ("rule", "given", "message"),
    [
        (FixedStep, {"size": 0.0}, "size must be finite and > 0, got 0.0"),
        (FixedStep, {"size": "big"}, "size must be a number > 0, got 'big'"),
        (ArmijoStep, {"first": float("nan")}, "first must be finite and > 0, got nan"),
        (ArmijoStep, {"shrink": 1.0}, r"shrink must lie in \(0, 1\), got 1.0"),
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

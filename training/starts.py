"""The comparison of starts on fixed wrenches: trials only, no statistics, no pictures."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable

import numpy as np

from grasp_env.errors import InfeasibleStartError
from grasp_env.force import (
    ForceOptimizer,
    ForceSolution,
    InitialForceRule,
    Objective,
    initial_rule,
)
from grasp_env.force.repair import Correction, carry_over
from grasp_env.grasp import Grasp, wrench
from training.runs import Run

TOLERANCE = 1e-4
Start = Callable[[Grasp, np.ndarray, "ForceSolution | None"], np.ndarray]
"""A start as the comparison sees it: (grasp, wrench, optimum of the wrench before it) -> force."""

LABELS = {
    "single_value": "single value",
    "lagrange": "Lagrange",
    "linear_combination_printed": "12-basis, as printed",
    "linear_combination": "12-basis (the paper, fixed at w = 0)",
    "previous_pseudoinverse": "previous solution, G^+",
    "previous_tangent": "previous solution, tangent",
    "learned_fitted": "learned, fitted in this run",
    "learned_shipped": "learned, shipped",
}
WRENCH_SETS = {
    "ball": "held-out ball: force <= 2 N, moment <= 0.05 N m, independent draws",
    "smooth": "random walk in that ball, 3 % of its radius per step",
    "paper_path": "the paper's W_ext(t), 2 s in 200 samples",
    "constant": "the paper's constant wrench",
}


def wrench_sets(count: int, seed: int) -> dict[str, np.ndarray]:
    """The wrenches (n, 6) of every set; no training set uses these generators."""
    return {
        "ball": wrench.sample_ball(np.random.default_rng([seed, 101]), count),
        "smooth": wrench.sample_path(np.random.default_rng([seed, 102]), count),
        "paper_path": wrench.paper_path(np.arange(200) * 0.01),
        "constant": wrench.constant(np.array(wrench.PAPER_CONSTANT), 1),
    }


def make_starts(objective: Objective, learned: dict[str, InitialForceRule]) -> dict[str, Start]:
    """Every start by its key in `LABELS`."""
    starts: dict[str, Start] = {}
    for name in ("single_value", "lagrange", "linear_combination_printed", "linear_combination"):
        starts[name] = _forget(initial_rule(name, objective))
    for correction in ("pseudoinverse", "tangent"):
        starts[f"previous_{correction}"] = _previous(objective, correction)
    for key, rule in learned.items():
        starts[key] = _forget(rule)
    return starts


def compare(
    grasp: Grasp,
    wrenches: np.ndarray,
    starts: dict[str, Start],
    optimizer: ForceOptimizer,
    tick: Callable[[], None],
) -> dict[str, np.ndarray]:
    """Runs the reduced flow from every start on every wrench to a relative gap of 1e-4 to the Newton optimum.

    Args:
        grasp: the grasp.
        wrenches: (n, 6), in order: "previous" starts from the optimum of the wrench before (of none: skipped).
        starts: see `make_starts`.
        optimizer: the reduced flow, the same step rule for all.
        tick: called once per wrench.

    Returns:
        Arrays "<start>/iterations", "/trials" (int, -1: no start exists), "/start_gap", "/end_gap" (float, nan: no
        start), "/status" (0 optimal, 1 iteration limit, 2 stalled, 3 no start) of shape (n,), "/force" (n, N, 3) the
        start itself, and "optimum/force", "optimum/objective".
    """
    count, n = len(wrenches), grasp.n_contacts
    newton = _newton(grasp, optimizer.objective, 1e-10)
    out = {"optimum/force": np.zeros((count, n, 3)), "optimum/objective": np.zeros(count)}
    for key in starts:
        for column, fill in (("iterations", -1), ("trials", -1), ("status", 3)):
            out[f"{key}/{column}"] = np.full(count, fill)
        for column in ("start_gap", "end_gap"):
            out[f"{key}/{column}"] = np.full(count, np.nan)
        out[f"{key}/force"] = np.full((count, n, 3), np.nan)
    before: ForceSolution | None = None
    for k, w in enumerate(wrenches):
        best = newton.solve(w).raise_for_status()
        out["optimum/force"][k], out["optimum/objective"][k] = best.force, best.objective
        for key, start in starts.items():
            try:
                force = start(grasp, w, before)
            except InfeasibleStartError:
                continue
            solution = optimizer.solve(w, initial=force, optimum=best.objective)
            begin = optimizer.objective.value(grasp.to_cone(force))
            out[f"{key}/iterations"][k] = solution.iterations
            out[f"{key}/trials"][k] = solution.trials
            out[f"{key}/status"][k] = ("optimal", "iteration_limit", "stalled").index(solution.status.value)
            out[f"{key}/start_gap"][k] = max(0.0, begin / best.objective - 1.0)
            out[f"{key}/end_gap"][k] = max(0.0, solution.objective / best.objective - 1.0)
            out[f"{key}/force"][k] = force
        before = best
        tick()
    return out


def traces(
    grasp: Grasp, w: np.ndarray, starts: dict[str, Start], optimizer: ForceOptimizer, before: ForceSolution
) -> dict[str, np.ndarray]:
    """Relative gap of every iterate (to 1e-8) per start on one wrench, for the convergence figure."""
    best = _newton(grasp, optimizer.objective, 1e-12).solve(w)
    fine = ForceOptimizer(
        grasp,
        force_weight=optimizer.objective.force_weight,
        barrier_weight=optimizer.objective.barrier_weight,
        tolerance=1e-8,
        step_rule=optimizer.step_rule,
    )
    out = {}
    for key, start in starts.items():
        try:
            force = start(grasp, w, before)
        except InfeasibleStartError:
            continue
        values = fine.solve(w, initial=force, optimum=best.objective, trace=True).objective_trace
        out[f"{key}/trace"] = np.maximum(values / best.objective - 1.0, 1e-12)
    return out


def time_starts(
    grasp: Grasp, wrenches: np.ndarray, starts: dict[str, Start], optimizer: ForceOptimizer
) -> dict[str, np.ndarray]:
    """Microseconds per public Python call, (n,) each: "<start>/start_us" and "<start>/total_us" (start and flow).

    One warm-up pass over ten wrenches is not counted. Starts take turns on every wrench, so that a noisy moment of
    the machine hits all alike. The whole call stops by its own certified gap, as a user's does.
    """
    out = {}
    for key in starts:
        out[f"{key}/start_us"] = np.full(len(wrenches), np.nan)
        out[f"{key}/total_us"] = np.full(len(wrenches), np.nan)
    newton = _newton(grasp, optimizer.objective, 1e-4)
    optima = [newton.solve(w) for w in wrenches]
    for warm in (True, False):
        for k, w in enumerate(wrenches[:10] if warm else wrenches):
            before = optima[k - 1] if k else None
            for key, start in starts.items():
                begin = time.perf_counter_ns()
                try:
                    force = start(grasp, w, before)
                except InfeasibleStartError:
                    continue
                middle = time.perf_counter_ns()
                optimizer.solve(w, initial=force)
                end = time.perf_counter_ns()
                if not warm:
                    out[f"{key}/start_us"][k] = (middle - begin) / 1e3
                    out[f"{key}/total_us"][k] = (end - begin) / 1e3
    return out


def save(run: Run, name: str, sets: Iterable[tuple[str, dict[str, np.ndarray]]]) -> None:
    """Writes all trials as one .npz with keys "<set>/<start>/<column>"."""
    run.write_arrays(name, {f"{key}/{inner}": value for key, arrays in sets for inner, value in arrays.items()})


def _newton(grasp: Grasp, objective: Objective, tolerance: float) -> ForceOptimizer:
    return ForceOptimizer(
        grasp,
        method="newton",
        force_weight=objective.force_weight,
        barrier_weight=objective.barrier_weight,
        tolerance=tolerance,
    )


def _forget(rule: InitialForceRule) -> Start:
    return lambda grasp, w, before: rule(grasp, w)


def _previous(objective: Objective, correction: Correction) -> Start:
    def start(grasp: Grasp, w: np.ndarray, before: ForceSolution | None) -> np.ndarray:
        if before is None:
            raise InfeasibleStartError("the first wrench has no previous solution")
        return carry_over(grasp, w, before.force, objective, correction)

    return start

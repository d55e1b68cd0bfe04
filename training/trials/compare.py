"""Trials: every start on every case by every method, one run each; no statistics, no pictures."""

from __future__ import annotations

import functools
from collections.abc import Mapping

import numpy as np

from grasp_env import ranges
from grasp_env._check import Array, ContactForces, as_array
from grasp_env.errors import GraspError, InfeasibleStartError
from grasp_env.force import ForceOptimizer, Objective
from grasp_env.grasp import Grasp
from policies import LearnedInitialForce
from training.cases.set_table import SETS
from training.cases.sets import Case, Problem, fixed_cases
from training.cases.starts import DoesNotApply, Start, carried, newton_optimizer, phi_options
from training.runs.words import shortened
from training.trials.arrays import (
    AT,
    BUDGETS,
    FORCES_KEPT,
    LEVELS,
    LIMIT,
    METHODS,
    NO_START,
    NOT_APPLICABLE,
    STATUS,
    TRACE,
    TRACED,
    Trials,
)

REASON = 120
"""Characters of why a start has no force."""
OPTIMUM = 1e-10
"""Relative certified gap of the optima that gaps are taken to."""


def cases_of(name: str, count: int, seed: int) -> list[Case]:
    """The cases of a set of `SETS`, about `count` times its share."""
    info = SETS[name]
    wanted = max(2, round(count * info.share))
    if info.grasp == "fixed":
        return fixed_cases(name, wanted, seed)
    if info.grasp == "recorded":
        from training.cases.recorded import recorded_cases  # the simulator is loaded where it is needed

        return recorded_cases(name, wanted, seed)
    from training.cases.grasps import grasp_cases

    return grasp_cases(name, wanted, seed)


class Solver:
    """The optimizers of a grasp, remembered while cases stay on it."""

    def __init__(self, objective: Objective) -> None:
        self.objective = objective
        self._made: dict[Grasp, dict[str, ForceOptimizer]] = {}
        self._last: tuple[Problem, ContactForces, float] | None = None

    def optimum(self, grasp: Grasp, load: Array) -> tuple[ContactForces, float]:
        """The force (N, 3) of least Phi, and that Phi."""
        if self._last is None or self._last[0][0] is not grasp or not np.array_equal(self._last[0][1], load):
            solution = self._of(grasp)["optimum"].solve(load).raise_for_status()
            self._last = (grasp, load), solution.force, solution.objective
        return self._last[1], self._last[2]

    def gaps(self, method: str, grasp: Grasp, load: Array, start: ContactForces, optimum: float) -> tuple[Array, int]:
        """The relative gap of every iterate (k,) and the code of how the run ended."""
        solution = self._of(grasp)[method].solve(load, initial=start, optimum=optimum, trace=True)
        values = np.maximum(solution.objective_trace / optimum - 1.0, 0.0)
        return values, STATUS.index(solution.status.value)

    def _of(self, grasp: Grasp) -> dict[str, ForceOptimizer]:
        if grasp not in self._made:
            while len(self._made) > 3:
                del self._made[next(iter(self._made))]
            self._made[grasp] = {"optimum": newton_optimizer(grasp, self.objective, OPTIMUM)} | {
                method: ForceOptimizer(
                    grasp,
                    method=method,
                    tolerance=LEVELS[method][-1],
                    max_iterations=LIMIT,
                    **phi_options(self.objective),
                )
                for method in METHODS
            }
        return self._made[grasp]


def compare(
    name: str,
    cases: list[Case],
    starts: Mapping[str, Start],
    models: dict[str, LearnedInitialForce],
    objective: Objective,
) -> Trials:
    """Runs both methods from every start on every case.

    Args:
        name: of the set: decides whether the starts are kept.
        cases: what to solve.
        starts: see `starts.make_starts`.
        models: those whose raw output is looked at, too.
        objective: Phi.

    Returns:
        The arrays of a trials file, n cases, M the most contacts of one; beyond a case's own contacts, and where there is no start, nan:
        "case/n_contacts", "/group", "/event" (n,), "/wrench" (n, 6), "/positions", "/normals" (n, M, 3), "/friction" (n, M),
        "/before" (n, M, 3) the previous optimum in the case's contact frames; "optimum/force" (n, M, 3), "/objective" (n,).
        Per start "<start>/gap" (n,) of Phi, "/margin" and "/residual" (n,) over its largest component, "/reason" (n,) why there is
        none, of models "raw_..." what the network says before the repair, and "/force" (n, M, 3) in the sets of `FORCES_KEPT`.
        Per method and start "<method>/<start>/status" (n,) at a gap of 1e-4, a position in `STATUS`; "/iterations" (n,) to 1e-4 and
        "/iterations_to" (n, levels), -1: never; "/gap_after" (n, budgets), a run that has ended keeps its last gap; of the flow
        "/trace" (TRACED, TRACE + 1) gaps of the iterates.
    """
    most, solver = max(case.grasp.n_contacts for case in cases), Solver(objective)
    out = _blank(cases, most, name, starts, models)
    for k, case in enumerate(cases):
        put = functools.partial(_put, out, k)
        grasp, load, before = case.grasp, case.wrench, None
        if case.before is not None:
            before = carried(case.before[0], solver.optimum(*case.before)[0], grasp, objective)
            put("case/before", before)
        best_force, best = solver.optimum(grasp, load)
        put("optimum/force", best_force)
        put("optimum/objective", best)
        for key, start in starts.items():
            try:
                force = attempt(start, grasp, load, before)
            except (DoesNotApply, GraspError) as error:
                for method in METHODS:
                    put(f"{method}/{key}/status", NOT_APPLICABLE if isinstance(error, DoesNotApply) else NO_START)
                if isinstance(error, GraspError):
                    put(f"{key}/reason", why_none(error))
                continue
            for column, value in zip(QUALITY, quality(grasp, load, force, best, objective), strict=True):
                put(f"{key}/{column}", value)
            if f"{key}/force" in out:
                put(f"{key}/force", force)
            if key in models:
                raw = quality(grasp, load, models[key].raw(grasp, load), best, objective)
                for column, value in zip(QUALITY, raw, strict=True):
                    put(f"{key}/raw_{column}", value)
            for method in METHODS:
                try:
                    run = solver.gaps(method, grasp, load, force, best)
                except (
                    InfeasibleStartError
                ):  # outside, or out of balance by more than rounding: no start of this method
                    put(f"{method}/{key}/status", NO_START)
                    put(f"{key}/reason", "out of balance" if out[f"{key}/margin"][k] > 0.0 else "outside the cones")
                    continue
                for column, value in _run(*run, LEVELS[method]).items():
                    put(f"{method}/{key}/{column}", value)
                if method == METHODS[0] and k < TRACED:
                    put(f"{method}/{key}/trace", _at(run[0], np.arange(TRACE + 1)))
    return out


def attempt(start: Start, grasp: Grasp, load: Array, before: ContactForces | None) -> ContactForces:
    """The force (N, 3) [N] of a start, which may be anybody's.

    Raises:
        DoesNotApply: it knows nothing of this case.
        GraspError: it has none, fails, or returns something else; `why_none` says which.
    """
    try:
        return as_array(start(grasp, load, before), (grasp.n_contacts, 3), "a start", ranges.SIZE)
    except (DoesNotApply, GraspError):
        raise
    except Exception as error:
        raise InfeasibleStartError(str(error)) from error


def why_none(error: GraspError) -> str:
    """Why a start has no force, in a few words; what it raised stands first, before a colon."""
    cause = error.__cause__ if isinstance(error.__cause__, Exception) else error
    if isinstance(cause, InfeasibleStartError):
        return "has none"
    return shortened(f"{type(cause).__name__}: {cause!s}", REASON)


def quality(
    grasp: Grasp, load: Array, force: ContactForces, best: float, objective: Objective
) -> tuple[float, float, float]:
    """Cone margin and balance residual of a force over its largest component, and its gap (inf outside the cones)."""
    size = max(float(np.abs(force).max()), 1e-300)
    gap = objective.value(grasp.to_cone(force)) / best - 1.0
    return grasp.cone_margin(force) / size, grasp.residual(force, load) / size, max(0.0, gap)


QUALITY = ("margin", "residual", "gap")
"""What `quality` gives."""


def _put(out: Trials, k: int, name: str, value: float | str | Array) -> None:
    """A number of case k, or what it has for its own contacts."""
    if isinstance(value, np.ndarray):
        out[name][k, : len(value)] = value
    else:
        out[name][k] = value


def _at(gaps: Array, iterations: np.ndarray) -> Array:
    """The gaps after so many iterations; a run that has ended keeps its last one."""
    return gaps[np.minimum(iterations, len(gaps) - 1)]


def _run(gaps: Array, code: int, levels: tuple[float, ...]) -> dict[str, float | Array]:
    first = np.array([int(np.argmax(gaps <= level)) if gaps[-1] <= level else -1 for level in levels])
    status = 0 if first[AT] >= 0 else max(code, 1)
    after = _at(gaps, np.array(BUDGETS))
    return {"status": status, "iterations": int(first[AT]), "iterations_to": first, "gap_after": after}


def _blank(
    cases: list[Case], most: int, name: str, starts: Mapping[str, Start], models: dict[str, LearnedInitialForce]
) -> Trials:
    """All arrays, with what is known of the cases; the rest -1 or nan."""
    count = len(cases)

    def empty(*shape: int) -> Array:
        return np.full((count, *shape), np.nan)

    out: Trials = {
        "case/n_contacts": np.array([case.grasp.n_contacts for case in cases]),
        "case/wrench": np.array([case.wrench for case in cases]),
        "case/group": np.array([case.group for case in cases]),
        "case/event": np.array([case.event for case in cases]),
        "case/before": empty(most, 3),
        "optimum/force": empty(most, 3),
        "optimum/objective": empty(),
    }
    for column in ("positions", "normals", "friction"):
        out[f"case/{column}"] = empty(most, 3) if column != "friction" else empty(most)
        for k, case in enumerate(cases):
            out[f"case/{column}"][k, : case.grasp.n_contacts] = getattr(case.grasp, column)
    for key in starts:
        for column in (*QUALITY, *(f"raw_{name}" for name in (QUALITY if key in models else ()))):
            out[f"{key}/{column}"] = empty()
        out[f"{key}/reason"] = np.full(count, "", f"U{REASON}")
        if name in FORCES_KEPT:
            out[f"{key}/force"] = empty(most, 3)
        for method in METHODS:
            out[f"{method}/{key}/status"] = np.full(count, NOT_APPLICABLE, np.int8)
            out[f"{method}/{key}/iterations"] = np.full(count, -1)
            out[f"{method}/{key}/iterations_to"] = np.full((count, len(LEVELS[method])), -1)
            out[f"{method}/{key}/gap_after"] = empty(len(BUDGETS))
        out[f"{METHODS[0]}/{key}/trace"] = np.full((min(count, TRACED), TRACE + 1), np.nan, np.float32)
    return out

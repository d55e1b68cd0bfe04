"""References: certified optima by two independent solvers, and their checks for `validate`.

Source 1 is the package (conic for `sum`, newton for `phi`), source 2 Clarabel. `Measure` bounds both. If they do not settle an
optimum of hard contacts without limits, or on request, both algorithms of `exact` replace them.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from itertools import repeat

import numpy as np
from scipy import sparse

from benchmarks.force import exact
from benchmarks.force.bounds import Measure
from benchmarks.force.entrants.clarabel import cones_of, infeasible_of
from benchmarks.force.entrants.forms import Dual, Form, Primal, form
from benchmarks.force.package import grasp_of
from benchmarks.force.problems import Array, Problem, Reference, Session, Track
from grasp_env.errors import GraspError, GraspWarning, InfeasibleWrenchError
from grasp_env.force import ForceOptimizer

GAP = 1e-9
"""Largest (upper - lower) / upper of a source."""
TOLERANCES = (1e-13, 1e-12, 1e-11, 1e-10, 1e-9)
"""Tolerances that the solvers are given one after the other, until the gap is a tenth of `GAP`; the best answer counts."""
AGREEMENT = 1e-8
"""Largest relative distance between the sources."""
ROUNDING = 1e-11
"""Relative change of a bound that is computed anew: sums in another order round differently, and forces beyond the wrench amplify it."""


@dataclass(frozen=True, eq=False)
class Found:
    """The answer of a source to a problem.

    Attributes:
        force, multipliers: (N k,), (6 + L,); the force is nan if the multipliers are a witness.
        lower, upper: bounds by `Measure`; inf if the witness proves that no force exists.
        rest: (N k + 6 + L,) rounding errors of both for results of `exact`, else None.
    """

    force: Array
    multipliers: Array
    lower: float
    upper: float
    rest: Array | None = None

    @property
    def gap(self) -> float:
        """(upper - lower) / upper; 0 where no force exists, inf where nothing is known."""
        if self.lower == np.inf:
            return 0.0
        return (self.upper - self.lower) / self.upper if 0.0 < self.upper < np.inf else np.inf

    @property
    def value(self) -> float:
        """The optimum."""
        return 0.5 * (self.lower + self.upper)


def refer(session: Session, objectives: Sequence[str], digits: str = "double") -> dict[str, Reference]:
    """The references of a session's problems, by objective; a `ValueError` names a problem that is not settled.

    Args:
        session: its references are not read.
        objectives: of the track.
        digits: "double": by the package and Clarabel, and by `exact` where they are not enough; "exact": all by `exact`.
    """
    made = {}
    with ProcessPoolExecutor(2) as pool:
        for name in objectives:
            found: list[tuple[Found, float]] = []
            for m, answer in enumerate(pool.map(_settled, session.problems, repeat(name), repeat(digits), chunksize=4)):
                if isinstance(answer, str):
                    raise ValueError(f"session {session.name!r}, problem {m}, {name}: {answer}")
                found.append(answer)
            made[name] = _reference(found)
    return made


def check(track: Track) -> list[str]:
    """Complaints about the references of a track; objectives, bounds and witnesses are computed anew from force and multipliers."""
    return [
        f"{track.name}, session {session.name!r}, {where}"
        for session in track.sessions
        for where in _complaints(session, track.about["objectives"])
    ]


def _settled(problem: Problem, name: str, digits: str) -> tuple[Found, float] | str:
    """An answer and the optimum by the second source, or what is wrong."""
    wrong = ""
    if digits != "exact":
        sources = []
        for source in (package, clarabel):
            try:
                sources.append(source(problem, name))
            except GraspError as error:
                wrong = f"{source.__name__}: {error}"
        if not wrong:
            wrong = _disagreement(*sources)
            if not wrong:
                return sources[0], sources[1].value
        if problem.width > 3 or len(problem.limit_bound):  # `exact` has hard contacts without limits
            return wrong
    try:
        sources = [_exact(algorithm(problem, name)) for algorithm in (exact.primal, exact.dual)]
    except (ArithmeticError, ValueError) as error:
        return f"{wrong}; exact: {error}".removeprefix("; ")
    return _disagreement(*sources) or (sources[0], sources[1].value)


def _disagreement(first: Found, second: Found) -> str:
    """The reason why two sources do not settle a problem; empty if they do."""
    for which, source in (("first", first), ("second", second)):
        if abs(source.gap) > GAP:
            return f"the {which} source leaves a gap of {source.gap:.1e}: {source.lower!r} to {source.upper!r}"
    if first.value != second.value and not abs(first.value - second.value) <= AGREEMENT * abs(first.value):
        return f"the sources disagree: {first.value!r} and {second.value!r}"
    return ""


def _exact(optimum: exact.Optimum) -> Found:
    """An answer in floats, with what they leave."""
    lower, upper, *numbers = optimum
    (force, few), (multipliers, rest) = map(exact.split, numbers)
    return Found(force, multipliers, float(lower), float(upper), np.concatenate([few, rest]))


def _reference(answers: list[tuple[Found, float]]) -> Reference:
    """The record of a session; rests are there if any problem has one."""
    found = [answer for answer, _ in answers]
    names = ("value", "lower", "upper", "force", "multipliers")
    stacked = {name: np.array([getattr(each, name) for each in found]) for name in names}
    rests = None
    if any(each.rest is not None for each in found):
        none = np.zeros(len(found[0].force) + len(found[0].multipliers))
        rests = np.stack([none if each.rest is None else each.rest for each in found])
    return Reference(**stacked, other=np.array([other for _, other in answers]), rest=rests)


def _complaints(session: Session, objectives: Sequence[str]) -> Iterator[str]:
    """Complaints about a session."""
    problems = session.problems
    for name in objectives:
        reference = session.references.get(name)
        if reference is None:
            yield f"{name}: no references"
            continue
        if len(reference.value) != len(problems):
            yield f"{name}: {len(reference.value)} references of {len(problems)} problems"
            continue
        for m, problem in enumerate(problems):
            yield from (f"problem {m}, {name}: {wrong}" for wrong in _wrong(problem, name, reference, m))


def _wrong(problem: Problem, name: str, reference: Reference, m: int) -> Iterator[str]:
    """Complaints about a reference."""
    value, other, force, multipliers = (
        getattr(reference, each)[m] for each in ("value", "other", "force", "multipliers")
    )
    lower, upper, measure = reference.lower[m], reference.upper[m], Measure.of(problem)
    if value == np.inf:
        if not measure.witness(multipliers) > 0.0:
            yield f"the witness proves nothing: {measure.witness(multipliers):.1e}"
        if not (other == lower == upper == np.inf and np.isnan(force).all()):
            yield "no force exists, but not all bounds are inf and all forces nan"
        return
    if reference.rest is None or not reference.rest[m].any():
        found = (
            measure.lower(name, multipliers),
            measure.upper(name, force, multipliers),
            measure.objective(name, force),
        )
    else:
        low, prices = np.split(reference.rest[m], [len(force)])
        found = exact.measured(problem, name, exact.joined(force, low), exact.joined(multipliers, prices))
    *anew, reached = map(float, found)
    for which, bound, computed in zip(("lower", "upper"), (lower, upper), anew, strict=True):
        if not abs(bound - computed) <= ROUNDING * value:
            yield f"the {which} bound is {computed!r}, stored {bound!r}"
    for what, distance, most in (
        ("the gap between the bounds", upper - lower, GAP),
        ("the distance of the value from the upper bound", value - upper, GAP),
        ("the distance of the value from the objective of the force", value - reached, AGREEMENT),
        ("the distance of the sources", value - other, AGREEMENT),
    ):
        if not abs(distance) <= most * value:
            yield f"{what} is {abs(distance) / value:.1e} of the optimum, more than {most:g}"


def package(problem: Problem, name: str) -> Found:
    """Source 1: `ForceOptimizer`, whose `GraspError` is raised if it refuses the problem."""
    grasp, limits = grasp_of(problem)
    method = "conic" if name == "sum" else "newton"

    def answers() -> Iterator[tuple[Array, Array, bool]]:
        for tolerance in TOLERANCES:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", GraspWarning)  # sizes of a kilometre are intended
                optimizer = ForceOptimizer(grasp, method=method, limits=limits, tolerance=tolerance)
            try:
                solution = optimizer.solve(problem.wrench, contacts=problem.touching)
            except InfeasibleWrenchError as error:
                solution = error.solution
            if solution is None:
                continue
            force = np.column_stack([solution.force, solution.torsion])[:, : problem.width]
            yield (
                force.reshape(-1),
                np.concatenate([solution.multipliers, solution.limit_multipliers]),
                solution.certificate is not None,
            )

    return _best(problem, name, answers())


def clarabel(problem: Problem, name: str) -> Found:
    """Source 2: Clarabel on the conic forms of its entrant, in turn."""
    makes = (Dual, Primal) if name == "sum" else (partial(form, objective=name),)
    return _best(problem, name, (_solved(make(problem), tolerance) for make in makes for tolerance in TOLERANCES))


def _solved(made: Form, tolerance: float) -> tuple[Array, Array, bool]:
    """Force, multipliers, and whether these are a witness."""
    solver = import_module("clarabel")
    settings = solver.DefaultSettings()
    settings.verbose, settings.presolve_enable, settings.max_iter = False, False, 200
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
    settings.tol_infeas_abs = settings.tol_infeas_rel = tolerance
    nothing, matrix = sparse.csc_matrix((len(made.c), len(made.c))), sparse.csc_matrix(made.rows)
    found = solver.DefaultSolver(nothing, made.c, matrix, made.sides, cones_of(solver, made), settings).solve()
    infeasible = found.status == infeasible_of(solver, made)
    force, multipliers, _ = made.answer(np.array(found.x), np.array(found.z), "infeasible" if infeasible else "solved")
    return np.empty(0) if force is None else force.reshape(-1), multipliers, infeasible


def _best(problem: Problem, name: str, answers: Iterable[tuple[Array, Array, bool]]) -> Found:
    """The answer of the least gap, or the first witness that holds."""
    measure = Measure.of(problem)
    none = best = Found(np.full(problem.matrix.shape[1], np.nan), np.zeros(6 + len(measure.bound)), -np.inf, np.inf)
    for force, multipliers, infeasible in answers:
        if infeasible and measure.witness(multipliers) > 0.0:
            return replace(none, multipliers=multipliers, lower=np.inf)
        if infeasible or not (np.isfinite(force).all() and np.isfinite(multipliers).all()):
            continue
        lower, upper = measure.lower(name, multipliers), measure.upper(name, force, multipliers)
        found = Found(force, multipliers, float(lower), float(upper))
        if abs(found.gap) < abs(best.gap):
            best = found
        if abs(best.gap) <= 0.1 * GAP:
            break
    return best

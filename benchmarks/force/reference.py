"""References: certified optima by two independent solvers, and their checks for `validate`.

Source 1 is the package (conic for `sum`, newton for `phi`), source 2 Clarabel. `Measure` bounds both. If they do not settle an
optimum of hard contacts without limits, or on request, both algorithms of `exact` replace them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat

import numpy as np

from benchmarks.force import exact
from benchmarks.force.bounds import Measure
from benchmarks.force.problems import Problem, Reference, Session, Track
from benchmarks.force.sources import GAP, Found, clarabel, package
from grasp_env.errors import GraspError

AGREEMENT = 1e-8
"""Largest relative distance between the sources."""
ROUNDING = 1e-11
"""Relative change of a bound that is computed anew: sums in another order round differently, and forces beyond the wrench amplify it."""


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
    parts = [exact.split(each) for each in (optimum.force, optimum.multipliers)]
    rest = np.concatenate([low for _, low in parts])
    return Found(parts[0][0], parts[1][0], float(optimum.lower), float(optimum.upper), rest)


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

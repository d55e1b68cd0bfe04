"""Validation of stored references, whose bounds and witnesses are computed again."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from mpmath import mp

from benchmarks.force.bounds import Measure
from benchmarks.force.problems import Problem, Reference, Session, Track
from benchmarks.force.references import DIGITS, GAP, exact_measure, numbers

AGREEMENT = 1e-8
"""Largest relative distance of an optimum from its force's objective and another solver's optimum."""
ROUNDING = 1e-11
"""Largest relative change of a bound that is computed again: sums may round in another order, which
large internal forces amplify."""


def check(track: Track) -> list[str]:
    """Return complaints about the references of a track."""
    return [
        f"{track.name}, session {session.name!r}, {complaint}"
        for session in track.sessions
        for complaint in _complaints(session, track.about["objectives"])
    ]


def _complaints(session: Session, objectives: Sequence[str]) -> Iterator[str]:
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
            for fault in _faults(problem, name, reference, m):
                yield f"problem {m}, {name}: {fault}"


def _faults(problem: Problem, name: str, reference: Reference, m: int) -> Iterator[str]:
    names = ("value", "lower", "upper", "force", "multipliers")
    value, lower, upper, force, multipliers = (getattr(reference, field)[m] for field in names)
    other = value if reference.other is None else reference.other[m]
    if not np.isfinite([value, lower, upper]).all():
        margin = Measure.of(problem).witness(multipliers)
        if not margin > 0.0:
            yield f"the witness proves nothing: {margin:.1e}"
        if not (value == other == lower == upper == np.inf and np.isnan(force).all()):
            yield "no force exists, but not all bounds are inf and all forces nan"
        return
    low, high, objective = _measured(problem, name, reference, m)
    for label, bound, computed in (("lower", lower, low), ("upper", upper, high)):
        if not abs(bound - computed) <= ROUNDING * value:
            yield f"the {label} bound is {computed!r}, stored {bound!r}"
    for label, distance, most in (
        ("the gap between the bounds", upper - lower, GAP),
        ("the distance of the value from the upper bound", value - upper, GAP),
        ("the distance of the value from the objective of the force", value - objective, AGREEMENT),
        ("the distance of the value from that of another solver", value - other, AGREEMENT),
    ):
        if not abs(distance) <= most * value:
            yield f"{label} is {abs(distance) / value:.1e} of the optimum, more than {most:g}"


def _measured(
    problem: Problem, name: str, reference: Reference, m: int
) -> tuple[float, float, float]:
    """Return lower bound, upper bound and objective, in many digits if the reference has them."""
    force = reference.force[m]
    multipliers = reference.multipliers[m]
    with mp.workdps(DIGITS):
        if reference.rest is None or not reference.rest[m].any():
            measure = Measure.of(problem)
        else:
            measure = exact_measure(problem)
            low, rest = np.split(reference.rest[m], [len(force)])
            force = numbers(force) + numbers(low)
            multipliers = numbers(multipliers) + numbers(rest)
        bounds = measure.lower(name, multipliers), measure.upper(name, force, multipliers)
        return float(bounds[0]), float(bounds[1]), float(measure.objective(name, force))

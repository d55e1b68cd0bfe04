"""Validation of stored references: bounds and witnesses are computed anew from the problems, forces
and multipliers.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from mpmath import mp

from benchmarks.force.bounds import Measure
from benchmarks.force.problems import Problem, Reference, Session, Track
from benchmarks.force.references import DIGITS, GAP, exact_measure, numbers

AGREEMENT = 1e-8
"""Largest relative distance of the optimum from the objective of the force, and from the optimum by
another solver."""
ROUNDING = 1e-11
"""Relative change of a bound that is computed anew: sums in another order round differently, and
large internal forces amplify it."""


def check(track: Track) -> list[str]:
    """Return complaints about the references of a track."""
    return [
        f"{track.name}, session {session.name!r}, {where}"
        for session in track.sessions
        for where in _complaints(session, track.about["objectives"])
    ]


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
            yield from (
                f"problem {m}, {name}: {wrong}" for wrong in _wrong(problem, name, reference, m)
            )


def _wrong(problem: Problem, name: str, reference: Reference, m: int) -> Iterator[str]:
    """Complaints about a reference."""
    value, lower, upper, force, multipliers = (
        getattr(reference, each)[m] for each in ("value", "lower", "upper", "force", "multipliers")
    )
    other = value if reference.other is None else reference.other[m]
    if not np.isfinite([value, lower, upper]).all():
        margin = Measure.of(problem).witness(multipliers)
        if not margin > 0.0:
            yield f"the witness proves nothing: {margin:.1e}"
        if not (value == other == lower == upper == np.inf and np.isnan(force).all()):
            yield "no force exists, but not all bounds are inf and all forces nan"
        return
    *anew, reached = _measured(problem, name, reference, m)
    for which, bound, computed in zip(("lower", "upper"), (lower, upper), anew, strict=True):
        if not abs(bound - computed) <= ROUNDING * value:
            yield f"the {which} bound is {computed!r}, stored {bound!r}"
    for what, distance, most in (
        ("the gap between the bounds", upper - lower, GAP),
        ("the distance of the value from the upper bound", value - upper, GAP),
        ("the distance of the value from the objective of the force", value - reached, AGREEMENT),
        ("the distance of the value from that of another solver", value - other, AGREEMENT),
    ):
        if not abs(distance) <= most * value:
            yield f"{what} is {abs(distance) / value:.1e} of the optimum, more than {most:g}"


def _measured(
    problem: Problem, name: str, reference: Reference, m: int
) -> tuple[float, float, float]:
    """Lower bound, upper bound and objective of a reference, in many digits if it has them."""
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

"""Trials on random problems: python tests/force/trial.py --family hard --seed 7 --problems 10000 --method newton

Answers are held against Clarabel's and against what the force alone proves. Every problem is one seed's (`generators.py`).
"""

from __future__ import annotations

import argparse
import sys
import warnings
from collections import Counter
from pathlib import Path

import numpy as np

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parents[1])]

from force.clarabel_reference import Reference
from force.generators import FAMILIES, Drawn, problem

from grasp_env.errors import GraspError, InfeasibleWrenchError
from grasp_env.force import ForceSolution, Status, optimize_force

METHODS = {"newton": {}, "sum": {"method": "conic"}, "max": {"method": "conic", "criterion": "max"}}
EDGE = 1e-6
"""The margin, of forces that sum to one, from which a verdict is compared."""
SURE = 1e-4
"""Clarabel's own relative error (`own_error`) up to which it is believed, tenfold."""
BALANCE = 1e-8
"""What an optimal force may miss of balance, relative to wrench and forces up to 1 N."""
WANTED = ("optimal", "infeasible", "exceeded")
ELASTIC = 0.01, 1e-6
"""How far the least excess may be from the least possible: a part, or so much."""


def outcome(p: Drawn, method: str, elastic: bool = False) -> str:
    """What came of a problem in a few words; those with "wrong" must not happen."""
    reference = Reference.of(p.grasp, p.limits)
    elastic = elastic and len(reference.bound) > 0
    cones = Reference.of(p.grasp) if elastic else reference
    options = {**METHODS[method], "limits": p.limits, "elastic": elastic}
    if method == "newton":
        options.update(force_weight=p.weights[0], barrier_weight=p.weights[1])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            found = optimize_force(p.grasp, p.wrench, **options)
    except InfeasibleWrenchError as error:
        margin = cones.margin(p.wrench)
        if margin > EDGE:
            return "wrong: infeasible"
        twist = np.asarray(getattr(error.solution, "certificate", np.zeros(6)))
        # what separates without the limits does so within them
        both = (Reference.of(p.grasp), reference)
        proven = margin > -EDGE or any(each.separates(twist, p.wrench) > 0.0 for each in both)
        return "infeasible" if proven else "wrong: no proof"
    except GraspError as error:
        margin = reference.margin(p.wrench)
        return f"no answer: {type(error).__name__}" if abs(margin) > EDGE else "undecided at the edge"
    except RuntimeWarning:
        return "wrong: warning"
    return _wrong(p, reference, cones, found) or _compared(p, reference, found, method)


def _wrong(p: Drawn, reference: Reference, cones: Reference, found: ForceSolution) -> str:
    """What a force says of itself and is not, computed from the geometry alone; "": nothing."""
    exceeded = found.status is Status.LIMITS_EXCEEDED
    size = float(np.abs(reference.load(p.wrench)).max())
    most = float(np.abs(found.force).max())
    # torsion is known to digits of its limit, and arms about the contacts' centre to those of how far away they are
    bearable = float((reference.gamma * found.force[:, 0]).max()) / reference.length
    away = float(np.abs(p.grasp.positions).max()) / reference.length
    rounding = 1e-13 * most + 4e-15 * bearable + 1e-15 * away * most
    if not (np.isfinite(found.force).all() and np.isfinite(found.torsion).all()):
        return "wrong: not finite"
    held = cones if exceeded else reference
    if found.cone_margin < 0.0 or held.violation(found.force, found.torsion) > 1e-13 * max(most, size):
        return "wrong: outside"
    residual = reference.residual(found.force, found.torsion, p.wrench)
    answered = found.status in (Status.OPTIMAL, Status.LIMITS_EXCEEDED)
    if answered and residual > BALANCE * max(size, min(most, 1.0)) + rounding:
        return "wrong: optimal without balance"
    if abs(reference.excess(found.force, found.torsion) - found.limit_excess) > 1e-9 * (1.0 + found.limit_excess):
        return "wrong: another excess"
    return ""


def _compared(p: Drawn, reference: Reference, found: ForceSolution, method: str) -> str:
    """The objective against Clarabel's, and the bound computed anew."""
    if found.status is Status.LIMITS_EXCEEDED:
        want = reference.least_excess(p.wrench)
        if not np.isfinite(want):
            return "exceeded, unknown"
        near = found.limit_excess <= max((1.0 + ELASTIC[0]) * want, want + ELASTIC[1]) * (1.0 + 1e-6)
        below = found.lower_bound <= want * (1.0 + 1e-5) + 1e-7
        return "exceeded" if near and below else "wrong: not the least excess"
    if method == "newton":
        (least, error), tolerance = reference.least_phi(p.wrench, *p.weights), 1e-4
        value = reference.phi(found.force, found.torsion, *p.weights)
    else:
        best, tolerance = reference.solve(p.wrench, method), 1e-6
        least, error = best.objective, best.error if best.solved else np.inf
        value = float(found.force[:, 0].sum() if method == "sum" else found.force[:, 0].max())
        prices = found.limit_multipliers[len(found.limit_multipliers) - len(reference.bound) :]
        bound, _ = reference.dual_bound(found.multipliers, prices, p.wrench, method)
        if found.status is Status.OPTIMAL and not value - bound <= 1.01 * tolerance * value:
            return "wrong: optimal without its proof"
        # near the loss of closure nu . w and G^T nu are small differences of large terms
        terms = float(np.abs(found.multipliers * p.wrench).sum())
        slack = 1e-9 + 1e-15 * float(np.abs(found.multipliers[:3]).max())
        if found.lower_bound > bound * (1.0 + slack) + 1e-12 * terms:
            return "wrong: bound above its proof"
    far = error < SURE and not abs(value - least) <= max(1.01 * tolerance, 10.0 * error) * abs(least)
    if found.status is Status.OPTIMAL:
        return "wrong: optimal but far" if far else "optimal"
    return f"far: {found.status.value}" if far else f"near or unknown: {found.status.value}"


def trial(
    family: str, seed: int, problems: int, method: str, elastic: bool = False, first: int = 0
) -> tuple[Counter[str], list[str]]:
    """How often each outcome came, and which problems had none that is wanted."""
    counts, notes = Counter(), []
    for index in range(first, first + problems):
        p = problem(family, seed, index)
        came = outcome(p, method, elastic)
        counts[came] += 1
        if came not in WANTED:
            notes.append(f"{family}, seed {seed}, problem {index}, {method}: {p.kind}, {p.grasp.n_contacts}: {came}")
    return counts, notes


def main() -> None:
    """Prints how often what came."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--family", choices=FAMILIES, default="hard")
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--problems", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--method", choices=METHODS, default="newton")
    parser.add_argument("--elastic", action="store_true")
    given = parser.parse_args()
    counts, notes = trial(given.family, given.seed, given.problems, given.method, given.elastic, given.first)
    print("\n".join(notes[:60]))
    for came, number in sorted(counts.items()):
        print(f"{came:40s} {number}")


if __name__ == "__main__":
    main()

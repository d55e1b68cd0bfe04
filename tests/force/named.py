"""The named problems of `problems.json`; `python tests/force/named.py` computes their objectives
again.

Every objective comes from a solve at a tight tolerance and from Clarabel, to relative `digits`. The
command refuses problems on which the two do not agree, and writes the file. If Clarabel has fewer
digits, `digits` is the gap of the certificate, computed from the geometry alone.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parents[1])]

from force.clarabel_reference import Reference

from grasp_env.errors import InfeasibleWrenchError
from grasp_env.force import ForceLimits, ForceSolution, optimize_force
from grasp_env.grasp import Grasp

FILE = Path(__file__).with_name("problems.json")
METHODS: dict[str, dict[str, Any]] = {
    "newton": {"method": "newton", "tolerance": 1e-9},
    "sum": {"method": "conic", "tolerance": 1e-7},
    "max": {"method": "conic", "criterion": "max", "tolerance": 1e-7},
}
"""Options of each method of the file, with the tolerance of the comparisons."""
JUDGED = 1e-6
"""Largest error of Clarabel at which its objective counts; above it, the certificate does."""


@dataclass(frozen=True, eq=False)
class Named:
    """A problem and its known results: status, objective (None: infeasible) and relative digits by
    method; weights are omega and lambda.

    tolerance: a larger one than that of the method, where rounding decides whether that is met.
    """

    name: str
    grasp: Grasp
    wrench: np.ndarray
    limits: ForceLimits | None
    weights: dict[str, Any]
    elastic: bool
    known: dict[str, dict[str, Any]]
    tolerance: float

    def options(self, method: str) -> dict[str, Any]:
        """Keywords of an optimizer."""
        given = {**METHODS[method], "limits": self.limits, "elastic": self.elastic}
        given["tolerance"] = max(given["tolerance"], self.tolerance)
        return {**given, **self.weights} if method == "newton" else given

    def reference(self) -> Reference:
        """The independent constraints."""
        return Reference(self.grasp, self.limits)

    def assert_infeasible(self, found: ForceSolution) -> None:
        """Check the proof of a solution without a force; on the boundary of feasibility no proof
        has digits."""
        reference = self.reference()
        lack = reference.proof(found.certificate, self.wrench, found.limit_multipliers)
        assert lack >= -1e-7 or reference.margin(self.wrench) < 1e-9, (self.name, lack)

    def phi_weights(self) -> tuple[Any, Any]:
        """omega and lambda, one or one each."""
        return self.weights.get("force_weight", 1.0), self.weights.get("barrier_weight", 0.01)


def read(entry: dict[str, Any]) -> Named:
    """Make a problem from its entry in the file."""
    models = {
        "contact_model": entry.get("models", "hard"),
        "torsional_friction": entry.get("torsional_friction"),
    }
    contacts = [entry[name] for name in ("positions", "normals", "friction")]
    grasp = Grasp.from_contacts(*contacts, tangents=entry.get("tangents"), **models)
    limits = entry.get("limits")
    if limits is not None:
        for name in ("max_normal", "torque_limit"):  # null: no limit
            if isinstance(limits.get(name), list):
                limits[name] = [np.inf if each is None else each for each in limits[name]]
        limits = ForceLimits(**limits)
    more = entry.get("weights", {}), entry.get("elastic", False), entry.get("known", {})
    return Named(
        entry["name"],
        grasp,
        np.array(entry["wrench"]),
        limits,
        *more,
        tolerance=entry.get("tolerance", 0.0),
    )


ENTRIES: list[dict[str, Any]] = (
    json.loads(FILE.read_text(encoding="utf-8")) if FILE.exists() else []
)
NAMED = {entry["name"]: read(entry) for entry in ENTRIES}
CASES = [(name, method) for name, problem in NAMED.items() for method in problem.known]


def attempt(call: Callable[[], ForceSolution]) -> ForceSolution:
    """Return the solution, or the one that contains the proof."""
    try:
        return call()
    except InfeasibleWrenchError as error:
        return error.solution  # type: ignore[return-value]


def value(p: Named, method: str, found: ForceSolution, reference: Reference) -> float:
    """Return the objective of a force, from the geometry alone."""
    if found.limit_excess > 0.0:
        return reference.excess(found.force, found.torsion)
    if method != "newton":
        return float(found.force[:, 0].sum() if method == "sum" else found.force[:, 0].max())
    return reference.phi(found.force, found.torsion, *p.phi_weights())


def judged(p: Named, method: str) -> dict[str, Any]:
    """Return status, objective and digits, solved here and by Clarabel; an AssertionError if they
    do not agree."""
    reference = p.reference()
    tight = {"tolerance": 1e-12 if method == "newton" else 1e-9}
    found = attempt(lambda: optimize_force(p.grasp, p.wrench, **(p.options(method) | tight)))
    name = f"{p.name}, {method}"
    if found.certificate is not None:
        p.assert_infeasible(found)
        return {"status": "infeasible"}
    if found.limit_excess > 0.0:
        want = reference.least_excess(p.wrench)
        assert want * (1.0 - 1e-6) <= found.limit_excess <= max(1.01 * want, want + 1e-6), (
            name,
            found,
            want,
        )
        return {"status": "limits_exceeded", "objective": want, "digits": 0.011}
    mine, by = found.objective, "certificate"
    # a bound above the objective shows rounding, too
    digits = abs(mine - found.lower_bound) / mine if mine > 0.0 else 0.0
    if method != "newton":
        bound, _ = reference.dual_bound(
            found.multipliers, found.limit_multipliers, p.wrench, method
        )
        digits = (mine - bound) / mine if mine > 0.0 else 0.0
        best = reference.solve(p.wrench, method)
        want = best.objective
        error = best.error if best.solved else np.inf
    else:
        want, error = reference.least_phi(p.wrench, *p.phi_weights())
    if error < JUDGED:
        by = "Clarabel"
        assert abs(mine - want) <= (digits + 10.0 * error + 1e-12) * abs(want), (
            name,
            mine,
            want,
            error,
        )
    assert digits < 1e-5, (name, digits)
    digits = float(f"{max(digits, 1e-11):.1e}")
    return {"status": "optimal", "objective": float(f"{mine:.13g}"), "digits": digits, "by": by}


def line(value: Any) -> str:
    """JSON of a problem: a line for each entry."""
    rows = [f"  {json.dumps(key)}: {json.dumps(each)}" for key, each in value.items()]
    return "{\n" + ",\n".join(rows) + "\n}"


def write(entries: list[dict[str, Any]]) -> None:
    """Compute the known results of every problem again, and write the file."""
    for entry in entries:
        p = read(json.loads(json.dumps(entry)))
        entry["known"] = {method: judged(p, method) for method in entry.get("known", METHODS)}
        print(p.name, entry["known"])
    FILE.write_text("[\n" + ",\n".join(map(line, entries)) + "\n]\n", encoding="utf-8")


if __name__ == "__main__":
    write(json.loads(FILE.read_text(encoding="utf-8")))

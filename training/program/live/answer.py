"""Solutions for bare contacts, with certificates, or a remedy if no force holds the load."""

from __future__ import annotations

import math
import timeit
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from grasp_env.errors import GraspError, InfeasibleWrenchError
from grasp_env.force import ForceLimits, ForceOptimizer, ForceSolution, Status
from grasp_env.force.initial import InitialForceRule
from grasp_env.force.rules import RULES
from grasp_env.grasp import Grasp
from grasp_env.inputs.arguments import Array

Mood = Literal["good", "warning", "bad"]
STARTS = (*RULES, "previous", "learned")
"""Start rules to choose from; `conic` takes none."""


@dataclass(frozen=True, eq=False)
class Answer:
    """Displayed result for a grasp and a load.

    Attributes:
        mood: severity, which selects the colour.
        status: outcome in a word or two.
        words: explanation of the outcome.
        solution: the forces; None if there are none.
        columns: numbers (N,) of the contacts, by name.
        facts: further facts as text, by name.
        twist: (6,) velocity of the object's origin and angular velocity, of any scale, that prove
            the load infeasible.
    """

    mood: Mood
    status: str
    words: str
    solution: ForceSolution | None = None
    columns: dict[str, Array] = field(default_factory=dict)
    facts: dict[str, str] = field(default_factory=dict)
    twist: Array | None = None


def answer(
    grasp: Grasp,
    wrench: Array,
    method: str = "newton",
    start: str | InitialForceRule = "internal_force",
    barrier_weight: float = 0.01,
    max_normal: float = math.inf,
    previous: ForceSolution | None = None,
) -> Answer:
    """Solve for the contact forces.

    Args:
        grasp: hard contacts of one friction.
        wrench: (6,) external force [N] and moment [N m] on the object, object frame.
        method: name of the method.
        start: start rule, which `conic` ignores.
        barrier_weight: lambda [N^2], which `conic` ignores.
        max_normal: largest normal force of a contact [N]; inf: no limit.
        previous: solution from which the start "previous" starts.

    Raises:
        GraspError: the method does not solve such a problem, or not from this start.

    Example:
        >>> from grasp_env.grasp import presets
        >>> result = answer(presets.paper_cuboid(), np.array([1, 0.5, -0.6, -0.1, 0.2, 0]))
        >>> result.status, result.solution.iterations
        ('held', 5)
    """
    settings: dict[str, Any] = {"method": method, "max_iterations": 5000}
    if method != "conic":
        settings |= {"barrier_weight": barrier_weight, "initial": start}
    if math.isfinite(max_normal):
        settings |= {"limits": ForceLimits(max_normal=max_normal), "elastic": True}
    optimizer = ForceOptimizer(grasp, **settings)
    if previous is not None and len(previous.force) != grasp.n_contacts:
        previous = None

    def solve() -> ForceSolution:
        optimizer.previous = previous
        return optimizer.solve(wrench)

    try:
        solution = solve()
    except InfeasibleWrenchError as error:
        words = "The load moves the object along the red screw; no finger can push against that within its friction cone. "
        words += _remedy(grasp, wrench)
        return Answer("bad", "cannot be held", words, twist=error.solution.certificate)
    margins = grasp.cone_margins(solution.force, solution.torsion)
    columns = {"normal, N": solution.force[:, 0], "margin, N": margins}
    facts = {
        "total normal force": f"{solution.total_normal_force:.2f} N",
        "iterations": f"{solution.iterations} from {solution.initial}",
        "certified gap": f"{100.0 * solution.optimality_gap:.1g} %",
        "optimum within": f"{solution.lower_bound:.6g} … {solution.objective:.6g}",
        "one solve": f"{1e6 * min(timeit.repeat(solve, number=1, repeat=3)):.1f} µs",
    }
    mood: Mood = "good"
    status = "held"
    words = "The fingers balance the load, every force inside its friction cone."
    if solution.status is Status.LIMITS_EXCEEDED:
        mood, status = "bad", "beyond the limit"
        words = (
            f"No force within {max_normal:.3g} N a contact balances this load; the gentlest needs {solution.force[:, 0].max():.3g} N, "
            f"{100.0 * solution.limit_excess:.3g} % more. Lower the load, raise the limit, add friction or a contact."
        )
    elif solution.status is not Status.OPTIMAL:
        mood = "warning"
        status = "held, not optimal"
        words = solution.status.help
    return Answer(mood, status, words, solution, columns, facts)


def _remedy(grasp: Grasp, wrench: Array) -> str:
    """Return advice how to hold the load: the least friction that would, or other contacts."""
    for friction in np.arange(0.05, 2.0, 0.05):
        if friction > grasp.friction[0]:
            with suppress(GraspError):
                ForceOptimizer(grasp.with_friction(friction), method="conic").solve(wrench)
                return f"Friction {friction:.2f} would hold it; or drag a contact to where the object escapes to."
    return "More friction alone does not help: drag a contact to where the object escapes to."

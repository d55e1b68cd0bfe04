"""Output of one solution: a table for the terminal, numbers for JSON."""

from __future__ import annotations

from typing import Any

from grasp_env.force import ForceSolution, Status
from grasp_env.grasp import Grasp

ALWAYS = (
    "wrench",
    "method",
    "initial",
    "iterations",
    "trials",
    "objective",
    "lower_bound",
    "equilibrium_residual",
    "limit_excess",
)
WITH_A_FORCE = (
    "force",
    "torsion",
    "friction_used",
    "optimality_gap",
    "cone_margin",
    "multipliers",
    "total_normal_force",
)
"""Numbers that are null if no force balances the wrench."""


def numbers(solution: ForceSolution, grasp: Grasp, advice: list[str]) -> dict[str, Any]:
    """Return the numbers of a solution and those that certify it, for `write_json`."""
    none = solution.status is Status.INFEASIBLE
    values: dict[str, Any] = {"status": solution.status.value, "advice": advice}
    values |= {name: getattr(solution, name) for name in ALWAYS}
    values |= {name: None if none else getattr(solution, name) for name in WITH_A_FORCE}
    values["force_in_object_frame"] = None if none else grasp.to_object_frame(solution.force)
    if solution.certificate is not None:
        values["separating_twist"] = solution.certificate
    return values


def print_solution(solution: ForceSolution, grasp: Grasp, title: str) -> None:
    """Print forces, status and certificates of a solution."""
    from rich.console import Console
    from rich.table import Table

    columns = ["contact", "normal [N]", "o [N]", "t [N]", "friction used"]
    soft = bool(grasp.models.torsional_friction.any())
    if soft:
        columns.append("torsion [N m]")
    table = Table(*columns, title=f"{title}: {solution.status.value}")
    shares = solution.friction_used
    for k, (force, share) in enumerate(zip(solution.force, shares, strict=True)):
        row = [str(k), *(f"{value:.4f}" for value in force), f"{share:.3f}"]
        if soft:
            row.append(f"{solution.torsion[k]:.6f}")
        table.add_row(*row)
    console = Console(highlight=False)
    console.print(table)
    console.print(
        "each finger's force on the object: normal into it, o and t the two directions of the contact's tangent plane "
        "(Grasp.frames); friction used: at 0.99 the contact slips if the friction is 1 % lower than given (--margin, --preload)"
    )
    console.print(
        f"{solution.method} from {solution.initial}: {solution.iterations} iterations ({solution.trials} trials), "
        f"certified gap {solution.optimality_gap:.1e}, balance residual {solution.equilibrium_residual:.1e} N, "
        f"total normal force {solution.total_normal_force:.3f} N"
    )

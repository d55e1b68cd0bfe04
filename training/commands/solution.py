"""One solution printed: a table for people, numbers for machines."""

from __future__ import annotations

from typing import Any

from grasp_env.force import ForceSolution, Status
from grasp_env.grasp import Grasp


def numbers(solution: ForceSolution, grasp: Grasp, advice: list[str]) -> dict[str, Any]:
    """What a solution says, and what proves it, as JSON has it."""
    none = solution.status is Status.INFEASIBLE
    told: dict[str, Any] = {
        "status": solution.status.value,
        "force": None if none else solution.force.tolist(),
        "force_in_object_frame": None if none else grasp.to_object_frame(solution.force).tolist(),
        "torsion": None if none else solution.torsion.tolist(),
        "wrench": solution.wrench.tolist(),
        "method": solution.method,
        "initial": solution.initial,
        "iterations": solution.iterations,
        "trials": solution.trials,
        "objective": solution.objective,
        "lower_bound": solution.lower_bound,
        "optimality_gap": None if none else solution.optimality_gap,
        "equilibrium_residual": solution.equilibrium_residual,
        "cone_margin": None if none else solution.cone_margin,
        "limit_excess": solution.limit_excess,
        "multipliers": None if none else solution.multipliers.tolist(),
        "total_normal_force": None if none else solution.total_normal_force,
        "advice": advice,
    }
    if solution.certificate is not None:
        told["separating_twist"] = solution.certificate.tolist()
    return told


def print_solution(solution: ForceSolution, grasp: Grasp, title: str) -> None:
    """Prints forces, status and certificates of `solution` to stdout."""
    from rich.console import Console
    from rich.table import Table

    columns = ["contact", "normal [N]", "o [N]", "t [N]", "margin [N]"]
    soft = bool(grasp.models.torsional_friction.any())
    table = Table(*columns, *(["torsion [N m]"] if soft else []), title=f"{title}: {solution.status.value}")
    margins = grasp.cone_margins(solution.force)
    for k, (force, margin, torsion) in enumerate(zip(solution.force, margins, solution.torsion, strict=True)):
        row = [*(f"{value:.4f}" for value in force), f"{margin:.4f}", *([f"{torsion:.6f}"] if soft else [])]
        table.add_row(str(k), *row)
    console = Console(highlight=False)
    console.print(table)
    console.print(
        "each finger's force on the object: normal into it, o and t the two directions of the contact's tangent plane "
        "(Grasp.frames); margin: friction * normal - |(o, t)|"
    )
    console.print(
        f"{solution.method} from {solution.initial}: {solution.iterations} iterations ({solution.trials} trials), "
        f"certified gap {solution.optimality_gap:.1e}, balance residual {solution.equilibrium_residual:.1e} N, "
        f"total normal force {solution.total_normal_force:.3f} N"
    )

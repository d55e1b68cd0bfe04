"""One solution printed: a table for people, JSON for machines."""

from __future__ import annotations

import json
import sys

import numpy as np
from rich.console import Console
from rich.table import Table

from grasp_env.force import ForceSolution
from grasp_env.grasp import Grasp


def print_solution(solution: ForceSolution, grasp: Grasp, title: str, as_json: bool) -> None:
    """Prints forces, status and certificates of `solution` to stdout."""
    if as_json:
        numbers = {
            "force": solution.force.tolist(),
            "torsion": solution.torsion.tolist(),
            "status": solution.status.value,
            "iterations": solution.iterations,
            "trials": solution.trials,
            "objective": solution.objective,
            "optimality_gap": solution.optimality_gap if np.isfinite(solution.optimality_gap) else None,
            "equilibrium_residual": solution.equilibrium_residual,
            "cone_margin": solution.cone_margin,
            "multipliers": solution.multipliers.tolist(),
            "total_normal_force": solution.total_normal_force,
        }
        sys.stdout.write(json.dumps(numbers, allow_nan=False) + "\n")
        return
    columns = ("contact", "normal [N]", "o [N]", "t [N]", "mu n - |tangential| [N]")
    table = Table(*columns, title=f"{title}: {solution.status.value}")
    x = grasp.to_cone(solution.force).reshape(-1, 3)
    for k, (normal, o, t) in enumerate(solution.force):
        margin = x[k, 0] - float(np.hypot(x[k, 1], x[k, 2]))
        table.add_row(str(k), f"{normal:.4f}", f"{o:.4f}", f"{t:.4f}", f"{margin:.4f}")
    console = Console()
    console.print(table)
    console.print(
        f"{solution.method} from {solution.initial}: {solution.iterations} iterations ({solution.trials} trials), "
        f"certified gap {solution.optimality_gap:.1e}, balance residual {solution.equilibrium_residual:.1e} N, "
        f"total normal force {solution.total_normal_force:.3f} N",
        highlight=False,
    )

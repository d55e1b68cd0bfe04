"""What remembers or comes in many: the previous solution, moved contacts, handed-over solutions, batches."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from golden.case import BASIS, TIGHT, Case, named, problem_of, solve
from golden.grasps import FLOOR, GRASPS, LIGHT, PAPER, wrenches
from golden.record import Outcome, of_solution

from grasp_env.force import ForceLimits, ForceOptimizer, optimize_forces
from grasp_env.grasp import Grasp


def _previous() -> list[Case]:
    """The optimizer's memory: along a path, to moved contacts, from another optimizer's solution."""
    path = np.array([PAPER + 0.05 * k * np.array([1.0, -2.0, 1.0, 0.02, -0.03, 0.01]) for k in range(8)])
    out: list[Case] = []
    for method, name in product(("reduced_flow", "newton"), ("cuboid", "5 uneven")):
        options = {"method": method, "initial": "previous"}
        out.append(Case(
            f"{method} from previous by tangent, {name}",
            lambda g=GRASPS[name], o=options: solve(g, path, **o),
        ))  # fmt: skip
        # the starts are functions of optima known to 1e-6
        out.append(Case(
            f"{method} from previous by tangent, {name}, tight",
            lambda g=GRASPS[name], o={**options, "tolerance": 1e-12}: solve(g, path, **o), tight=True, start=BASIS,
        ))  # fmt: skip
    for method, initial in (("reduced_flow", "previous"), ("newton", "previous"), ("newton", None), ("conic", None)):
        options = {"method": method, "initial": initial, "tolerance": TIGHT[method]}
        out.append(Case(f"{method} moved, {initial}, tight", lambda o=options: moved(**o), tight=True))
    for name, limits in (("soft", None), ("cuboid", ForceLimits(max_normal=6.0))):
        options = {"method": "newton", "initial": "previous", "limits": limits, "tolerance": 1e-10}
        out.append(Case(
            f"newton from previous, {name}{', limits' if limits else ''}, tight",
            lambda g=GRASPS[name], o=options: solve(g, path, **o), tight=True,
        ))  # fmt: skip
    for method in ("reduced_flow", "newton"):
        out.append(Case(f"{method} from another optimizer's solution", lambda m=method: _handed(m), start=BASIS))
    return out


def moved(**options: Any) -> list[Outcome]:
    """The contacts walk off by millimetres and come back."""
    rng, grasp = np.random.default_rng(11), GRASPS["4 uneven"]
    optimizer, rows = ForceOptimizer(grasp, **options), []
    steps = [np.zeros((4, 3)), *np.cumsum(1e-3 * rng.standard_normal((4, 4, 3)), axis=0), np.zeros((4, 3))]
    for k, step in enumerate(steps):
        now = Grasp.from_contacts(grasp.positions + step, grasp.normals, grasp.friction)
        problem = problem_of(now, PAPER * (1.0 + 0.1 * k), options)
        rows.append(of_solution(optimizer.solve(problem.wrench, positions=now.positions), problem))
    return rows


def _handed(method: str) -> list[Outcome]:
    grasp, options = GRASPS["cuboid"], {"method": method}
    other = ForceOptimizer(grasp, method="newton", tolerance=1e-12).solve(1.2 * PAPER)
    rows = solve(grasp, PAPER[None], {"initial": other}, **options)
    rows += solve(grasp, np.array([PAPER, LIGHT]), initial=other, **options)
    exact = ForceOptimizer(grasp, method="conic").solve(1.2 * PAPER)
    return rows + solve(grasp, PAPER[None], {"initial": exact}, **options)


def _batches() -> list[Case]:
    """`optimize_forces`: one grasp, many grasps, some of the wrenches impossible."""
    many = wrenches(5, 24)
    grasps = [GRASPS[name] for name in ("cuboid", "4 uneven", "plate", "slippery")] * 3
    lift = np.array([[0, 0, 2.0, 0, 0, 0], [0, 0, -2.0, 0, 0, 0], [0, 0, -1.0, 0.005, 0, 0]])

    def batch(given: Any, wanted: np.ndarray, **options: Any) -> list[Outcome]:
        found = optimize_forces(given, wanted, **options)
        each = [given] * len(wanted) if isinstance(given, Grasp) else given
        return [
            of_solution(found[k], problem_of(each[k], wrench, {"method": "newton", **options}))
            for k, wrench in enumerate(wanted)
        ]

    out: list[Case] = []
    for method in ("newton", "conic", "reduced_flow"):
        for workers in (1, 2):
            out.append(Case(f"batch of {method}, {workers} workers", lambda m=method, k=workers: batch(
                GRASPS["4 uneven"], many, method=m, workers=k)))  # fmt: skip
        out.append(Case(f"batch of {method}, grasps", lambda m=method: batch(grasps, many[:12], method=m)))
    out.append(Case("batch of newton, tight", lambda: batch(GRASPS["5 uneven"], many, tolerance=1e-12), tight=True))
    for method in ("newton", "conic"):
        out.append(Case(f"batch of {method}, limits", lambda m=method: batch(
            GRASPS["cuboid"], many[:6], method=m, limits=ForceLimits(max_normal=6.0))))  # fmt: skip
    out.append(Case("batch on a floor", lambda: batch(FLOOR, lift, method="conic")))
    out.append(Case("batch from single_value", lambda: batch(
        GRASPS["cuboid"], many[:6], method="newton", initial="single_value")))  # fmt: skip
    return out


def cases() -> dict[str, Case]:
    """All of them."""
    return named(_previous(), _batches())

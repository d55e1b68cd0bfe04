"""Every method on every contact, every start, every step rule; the grasps' own arrays and the offline basis."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from golden.case import BASIS, FLOWS, TIGHT, Case, loads, named, solve
from golden.grasps import GRASPS, HARD, LIGHT, NONE, OTHER, PAPER, wrenches
from golden.record import Outcome

from grasp_env.force import (
    AdaptiveStep,
    ArmijoStep,
    BarzilaiBorweinStep,
    ExactStep,
    FixedStep,
    LinearCombination,
    Objective,
    OfflineBasis,
)
from grasp_env.grasp import Grasp, null_space_basis

WANTED = np.array([PAPER, NONE, LIGHT, *wrenches(1, 3)])
TWENTY = 20.0 * PAPER[None]


def _methods() -> list[Case]:
    """Every method on every kind of contact, tight and at its default."""
    out: list[Case] = []
    kinds = (("reduced_flow", "sum"), ("full_flow", "sum"), ("newton", "sum"), ("conic", "sum"), ("conic", "max"))  # fmt: skip
    for (name, grasp), (method, criterion) in product({**HARD, **OTHER}.items(), kinds):
        if method in FLOWS and not grasp.hard:
            continue
        if method == "full_flow" and (grasp.n_contacts > 5 or name == "far"):  # dense; far off it loses balance
            continue
        slow = method in FLOWS and name in ("far", "rough and frictionless")
        few = method == "full_flow" or name in ("16 random", "50 random")
        wanted = loads(name, np.array([NONE, LIGHT]) if slow else WANTED[:4] if few else WANTED)
        options = {"method": method, "criterion": criterion}
        label = f"{method} {criterion}" if method == "conic" else method
        tight = {**options, "tolerance": TIGHT[method]}
        start = BASIS if grasp.hard and method in (*FLOWS, "newton") else np.inf
        # the flow of frictionless contacts drifts out of balance, and says Phi of before it is put right
        honest = 1e-3 if method in FLOWS and name == "frictionless" else 1e-9
        out.append(Case(
            f"{label}, {name}", lambda g=grasp, w=wanted, o=options: solve(g, w, **o), start=start, honest=honest
        ))  # fmt: skip
        if method in FLOWS and name in ("far", "plate"):  # rounding decides after how many thousand steps they end
            continue
        out.append(Case(
            f"{label}, {name}, tight", lambda g=grasp, w=wanted, o=tight: solve(g, w, **o), tight=True, honest=honest
        ))  # fmt: skip
    for method in ("newton", "conic"):
        for name, grasp in {**HARD, **OTHER}.items():
            wanted, options = loads(name, TWENTY), {"method": method, "tolerance": TIGHT[method]}
            out.append(Case(f"{method}, {name}, heavy, tight", lambda g=grasp, w=wanted, o=options: solve(g, w, **o), tight=True))  # fmt: skip
    return out


_SQUEEZE = np.array([[3.0, 0.0, 0.0], [1.2, 0.0, 0.0], [0.9, 0.0, 0.0], [0.9, 0.0, 0.0]])
"""[N] an internal force of the cuboid: 1.2 * 0.03 = 2 * 0.9 * 0.02 N m."""


def least_norm(grasp: Grasp, wrench: np.ndarray) -> np.ndarray:
    """A start for the cuboid, plain numpy: least-norm balance, and a squeeze that keeps it inside the cones."""
    return -np.linalg.lstsq(grasp.matrix, wrench)[0].reshape(-1, 3) + 3.0 * _SQUEEZE


def _starts() -> list[Case]:
    """Every rule that needs no memory; `phase_one` may start anywhere."""
    out: list[Case] = []
    rules = ("linear_combination", "linear_combination_printed", "single_value", "lagrange", "phase_one")
    for method, name, rule in product(("reduced_flow", "newton"), ("cuboid", "3 uneven", "5 uneven", "plate"), rules):
        wanted = np.array([PAPER, NONE, LIGHT, 5.0 * PAPER])
        out.append(Case(
            f"{method} from {rule}, {name}",
            lambda g=GRASPS[name], w=wanted, m=method, r=rule: solve(g, w, method=m, initial=r),
            start=np.inf if rule == "phase_one" else BASIS,
        ))  # fmt: skip
    cuboid, wanted = GRASPS["cuboid"], np.array([PAPER, NONE, LIGHT])
    for method in (*FLOWS, "newton"):
        out.append(Case(
            f"{method} from a callable",
            lambda m=method: solve(cuboid, wanted, method=m, initial=least_norm), start=1e-12,
        ))  # fmt: skip
        out.append(Case(f"{method} from an array", lambda m=method: [
            row for wrench in wanted
            for row in solve(cuboid, wrench[None], {"initial": least_norm(cuboid, wrench)}, method=m)
        ], start=1e-12))  # fmt: skip
        out.append(Case(
            f"{method} from a rule of another Phi",
            lambda m=method: solve(
                cuboid, wanted, method=m, barrier_weight=0.1, initial=LinearCombination(Objective(1.0, 1e-3))
            ),
            start=BASIS,
        ))  # fmt: skip
    return out


STEPS = {
    "fixed": FixedStep(0.02), "fixed, long": FixedStep(1.0), "Armijo": ArmijoStep(), "Armijo, steep": ArmijoStep(1.0, 0.7, 0.3),
    "adaptive": AdaptiveStep(), "adaptive, slow": AdaptiveStep(0.01, 1.2, 0.8), "BB": BarzilaiBorweinStep(),
    "BB, long": BarzilaiBorweinStep(variant="long"), "BB, alternate": BarzilaiBorweinStep(0.1, 0.3, "alternate"),
    "exact": ExactStep(), "exact, rough": ExactStep(0.1),
}  # fmt: skip


def _steps() -> list[Case]:
    """Every step rule, with the value of Phi at every iterate."""
    wanted = np.array([PAPER, LIGHT, wrenches(2, 1)[0]])
    return [
        Case(f"{method}, {rule}, {name}", lambda m=method, r=rule, n=name: solve(
            GRASPS[n], wanted, {"trace": True}, method=m, step_rule=STEPS[r], max_iterations=3000
        ), start=BASIS)
        for method, rule, name in product(FLOWS, STEPS, ("cuboid", "5 uneven", "elliptic"))
    ]  # fmt: skip


def _basis() -> list[Case]:
    """The offline basis, its combinations, and what the grasps themselves compute."""

    def basis(grasp: Grasp, **weights: Any) -> list[Outcome]:
        found = OfflineBasis.compute(grasp, Objective(**weights))
        made = [
            *found.forces,
            found.rest,
            found.combine(PAPER),
            found.combine(LIGHT),
            found.combine(PAPER, printed=True),
        ]
        return [Outcome("force", force=np.column_stack([each, np.zeros(len(each))])) for each in made]

    def shapes(grasp: Grasp) -> list[Outcome]:
        arrays = {
            "frames": grasp.frames, "matrix": grasp.matrix, "cone_matrix": grasp.cone_matrix,
            "torsion_matrix": grasp.torsion_matrix, "unit_frame": grasp.unit_frame,
            "pseudoinverse": grasp.pseudoinverse, "centre": grasp.centre, "length": np.array([grasp.length]),
        }  # fmt: skip
        if grasp.null_dimension and grasp.n_contacts <= 5 and grasp.hard:
            arrays["null_space_basis"] = null_space_basis(grasp)
        return [Outcome("array", name, extra=np.array(array).reshape(-1)) for name, array in arrays.items()]

    out = [Case(f"basis of {name}", lambda g=grasp: basis(g), tight=True, start=BASIS) for name, grasp in HARD.items()
           if grasp.n_contacts <= 8]  # fmt: skip
    out.append(Case("basis of elliptic", lambda: basis(OTHER["elliptic"]), tight=True, start=BASIS))
    out.append(Case("basis, unequal weights", lambda: basis(
        GRASPS["cuboid"], force_weight=(1.0, 2.0, 0.5, 3.0), barrier_weight=(0.01, 0.1, 0.002, 1.0)), tight=True, start=BASIS))  # fmt: skip
    # thirty metres from the origin the pseudo-inverse has three digits less
    out += [Case(f"arrays of {name}", lambda g=grasp: shapes(g), close=1e-10 if name == "far" else 1e-12)
            for name, grasp in GRASPS.items()]  # fmt: skip
    return out


def cases() -> dict[str, Case]:
    """All of them."""
    return named(_methods(), _starts(), _steps(), _basis())

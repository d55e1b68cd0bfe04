"""What has to be refused, by which class and in which words."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from golden.case import Case, named
from golden.grasps import GRASPS, NONE, PAPER
from golden.record import Outcome, attempt

from grasp_env.force import (
    AdaptiveStep,
    ArmijoStep,
    BarzilaiBorweinStep,
    ExactStep,
    FixedStep,
    ForceLimits,
    ForceOptimizer,
    LinearCombination,
    Objective,
    initial_rule,
    optimize_force,
    optimize_forces,
)
from grasp_env.grasp import Grasp, presets
from grasp_env.quality import feasibility

CUBOID, SOFT = GRASPS["cuboid"], GRASPS["soft"]
GOOD = np.array([[9.0, 0.0, 0.0], [3.6, 0.0, 0.0], [2.7, 0.0, 0.0], [2.7, 0.0, 0.0]])
"""[N] balanced at no wrench."""
WRENCHES: dict[str, Any] = {
    "five": np.zeros(5), "column": np.zeros((6, 1)), "number": 0.0, "none": None, "text": "down", "texts": ["a"] * 6,
    "ragged": [1.0, 2.0, 3.0, [4.0], 5.0, 6.0], "nan": [0.0, 0.0, np.nan, 0.0, 0.0, 0.0], "nan array": np.full(6, np.nan),
    "inf": np.array([0.0, 0.0, 0.0, np.inf, 0.0, 0.0]), "minus inf": [-np.inf, 0.0, 0.0, 0.0, 0.0, 0.0],
    "complex": PAPER + 0.0j, "large": 2e12 * PAPER, "huge": np.full(6, 1e300), "objects": np.array([object()] * 6),
}  # fmt: skip
OPTIONS: dict[str, dict[str, Any]] = {
    "method": {"method": "simplex"}, "criterion": {"criterion": "mean"}, "rule": {"initial": "newest"},
    "learned by name": {"initial": "learned"}, "initial": {"initial": 3},
    "most -1": {"max_iterations": -1}, "most 1.5": {"max_iterations": 1.5}, "most True": {"max_iterations": True},
    "tolerance 0": {"tolerance": 0.0}, "tolerance nan": {"tolerance": np.nan}, "tolerance text": {"tolerance": "much"},
    "omega": {"force_weight": -1.0}, "lambda": {"barrier_weight": 0.0}, "lambda inf": {"barrier_weight": np.inf},
    "weights of three": {"force_weight": (1.0, 2.0, 3.0)}, "weights with nan": {"barrier_weight": (0.1, np.nan, 0.1, 0.1)},
    "limits": {"limits": 5.0}, "step rule": {"step_rule": 0.1}, "max with newton": {"method": "newton", "criterion": "max"},
    "conic from a start": {"method": "conic", "initial": "previous"},
    "limits with the flow": {"method": "reduced_flow", "limits": ForceLimits(max_normal=5.0)},
    "limits of three": {"method": "newton", "limits": ForceLimits(max_normal=[5.0, 5.0, 5.0])},
    "basis with limits": {"method": "newton", "limits": ForceLimits(max_normal=5.0), "initial": "linear_combination"},
}  # fmt: skip
STARTS: dict[str, Any] = {
    "three rows": GOOD[:3], "flat": GOOD.reshape(-1), "texts": [["a", "b", "c"]] * 4, "nan": GOOD * np.nan,
    "inf": GOOD + np.inf, "off balance": 1.01 * GOOD + [[0.1, 0, 0]] * 4, "zero": 0.0 * GOOD, "outside": -GOOD,
    "complex": GOOD + 1.0j,
}  # fmt: skip


def _rule(force: Any) -> Callable[..., Any]:
    return lambda grasp, wrench: force


def _calls() -> dict[str, Callable[[], object]]:
    """Other calls that must not be answered."""
    points, normals = CUBOID.positions, CUBOID.normals
    make, jac = Grasp.from_contacts, np.ones((4, 3, 2))
    return {
        "grasp of two": lambda: make(points[:2], normals[:2], 0.4).pseudoinverse,
        "grasp on a line": lambda: make([[0, 0, 0], [0, 0, 0.1], [0, 0, 0.2]], [[1.0, 0, 0]] * 3, 0.4).pseudoinverse,
        "grasp of none": lambda: make(np.empty((0, 3)), np.empty((0, 3)), 0.4).pseudoinverse,
        "grasp with nan": lambda: make(points * np.nan, normals, 0.4),
        "grasp with long normals": lambda: make(points, 2.0 * normals, 0.4),
        "grasp without friction": lambda: make(points, normals, 0.0),
        "grasp with negative friction": lambda: make(points, normals, [-0.1, 0.4, 0.4, 0.4]),
        "grasp of another model": lambda: make(points, normals, 0.4, contact_model="sticky"),
        "grasp, soft without gamma": lambda: make(points, normals, 0.4, contact_model="soft"),
        "grasp, gamma 0": lambda: make(points, normals, 0.4, contact_model="soft", torsional_friction=0.0),
        "grasp, tangent along": lambda: make(points, normals, 0.4, tangents=normals),
        "grasp, three normals": lambda: make(points, normals[:3], 0.4),
        "preset": lambda: presets.preset("fist"),
        "no grasp": lambda: optimize_force("grasp", PAPER),  # type: ignore[arg-type]
        "flow on soft": lambda: optimize_force(SOFT, PAPER, method="reduced_flow"),
        "basis on soft": lambda: optimize_force(SOFT, PAPER, method="newton", initial="linear_combination"),
        "full flow": lambda: optimize_force(SOFT, PAPER, method="full_flow"),
        "start of conic": lambda: ForceOptimizer(CUBOID, method="conic").start(PAPER),
        "conic with a start": lambda: ForceOptimizer(CUBOID, method="conic").solve(PAPER, initial=GOOD),
        "conic with a trace": lambda: ForceOptimizer(CUBOID, method="conic").solve(PAPER, trace=True),
        "optimum 0": lambda: optimize_force(CUBOID, PAPER, optimum=0.0),
        "printed at nothing": lambda: optimize_force(CUBOID, NONE, initial="linear_combination_printed"),
        "unfinished": lambda: optimize_force(CUBOID, PAPER, max_iterations=1).raise_for_status() and None,
        "rule": lambda: initial_rule("newest"),
        "basis without closure": lambda: LinearCombination()(GRASPS["floor"], PAPER),
        "previous of five": lambda: optimize_force(CUBOID, PAPER, initial=optimize_force(GRASPS["5 uneven"], PAPER)),
        "phase one of text": lambda: feasibility(CUBOID, "down"),  # type: ignore[arg-type]
        "objective": lambda: Objective(1.0, "much"),  # type: ignore[arg-type]
        "fixed step": lambda: FixedStep(0.0),
        "adaptive step": lambda: AdaptiveStep(grow=0.5),
        "Armijo step": lambda: ArmijoStep(slope=1.0),
        "BB step": lambda: BarzilaiBorweinStep(variant="longest"),
        "exact step": lambda: ExactStep(0.0),
        "limits crossing": lambda: ForceLimits(min_normal=2.0, max_normal=1.0),
        "limits of nan": lambda: ForceLimits(max_normal=np.nan),
        "half a torque limit": lambda: ForceLimits(jacobian=jac),
        "torque limits of three": lambda: ForceLimits(jacobian=jac, torque_limit=[1.0, 1.0, 1.0]),
        "bias alone": lambda: ForceLimits(torque_bias=[0.0]),
        "batch of previous": lambda: optimize_forces(CUBOID, [PAPER], initial="previous"),
        "batch of five": lambda: optimize_forces(CUBOID, np.zeros((2, 5))),
        "batch with nan": lambda: optimize_forces(CUBOID, np.full((2, 6), np.nan)),
        "batch too large": lambda: optimize_forces(CUBOID, np.full((2, 6), 1e13)),
        "batch of no workers": lambda: optimize_forces(CUBOID, [PAPER], workers=0),
        "batch, two grasps": lambda: optimize_forces([CUBOID, CUBOID], [PAPER]),
        "batch, unequal grasps": lambda: optimize_forces([CUBOID, GRASPS["5 uneven"]], [PAPER, PAPER]),
        "batch of no grasps": lambda: optimize_forces([], np.empty((0, 6))),
        "batch of a text": lambda: optimize_forces(["cuboid"], [PAPER]),  # type: ignore[list-item]
    }  # fmt: skip


def _refusal(call: Callable[[], object]) -> list[Outcome]:
    """The one row: the class and the words of what is raised, or that nothing was."""

    def answered() -> Outcome:
        call()
        return Outcome("answered")

    return [attempt(answered, message=True)]


def cases() -> dict[str, Case]:
    """All of them."""
    out: list[Case] = []
    for name, wrench in WRENCHES.items():
        for method in ("reduced_flow", "newton", "conic"):
            out.append(
                Case(
                    f"wrench {name}, {method}",
                    lambda w=wrench, m=method: _refusal(lambda: ForceOptimizer(CUBOID, method=m).solve(w)),
                )
            )
    for name, options in OPTIONS.items():
        out.append(Case(f"option {name}", lambda o=options: _refusal(lambda: ForceOptimizer(CUBOID, **o).solve(PAPER))))
    for name, start in STARTS.items():
        for kind, given in (("array", start), ("callable", _rule(start))):
            for method in ("reduced_flow", "newton"):
                text = f"start {name}, {kind}, {method}"
                out.append(
                    Case(
                        text,
                        lambda s=given, m=method: _refusal(lambda: optimize_force(CUBOID, NONE, method=m, initial=s)),
                    )
                )
    out += [Case(name, lambda c=call: _refusal(c)) for name, call in _calls().items()]
    return named(out)

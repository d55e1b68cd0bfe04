"""The shipped model as a start: within and beyond their training, on contacts it knows and others, with a memory."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from golden.case import BASIS, Case, named, solve
from golden.grasps import FLOOR, GRASPS, LIGHT, NONE, PAPER, wrenches
from golden.record import Outcome, attempt

from grasp_env.force import Objective
from grasp_env.grasp import Grasp
from policies import LearnedInitialForce

FAR = np.array([100.0 * PAPER, 1e4 * PAPER, 1e-6 * PAPER])
"""Beyond what the model was trained on, from above and from below."""


def started(grasp: Grasp, wanted: np.ndarray, objective: Objective | None = None) -> list[Outcome]:
    """The rule itself, called: forces (N, 3), and whether it was trained on that."""
    rule = LearnedInitialForce.pretrained()
    rule = rule if objective is None else rule.with_objective(objective)

    def call(wrench: np.ndarray) -> Outcome:
        force = rule(grasp, wrench)
        known = "known" if rule.covers(grasp, wrench) else "outside"
        return Outcome("force", f"{rule.name}, {known}", force=np.column_stack([force, np.zeros(len(force))]))

    return [attempt(lambda w=wrench: call(w)) for wrench in wanted]


def solved(grasp: Grasp, wanted: np.ndarray, each: bool, remembers: bool, **options: Any) -> list[Outcome]:
    """An optimizer that always starts from the model (`each`: given to every call anew)."""
    rule = LearnedInitialForce.pretrained(remembers=remembers)
    if each:
        return solve(grasp, wanted, {"initial": rule}, **options)
    return solve(grasp, wanted, initial=rule, **options)


def cases() -> dict[str, Case]:
    """All of them."""
    out: list[Case] = []
    wanted = np.array([PAPER, NONE, LIGHT, *wrenches(31, 12)])
    walk = PAPER + np.cumsum(0.05 * wrenches(32, 10), axis=0)
    known = ("cuboid", "4 uneven")
    for name in (*known, "slippery", "8 random", "soft", "rough and frictionless"):
        for text, loads in ((name, wanted), (f"{name}, far", FAR)):
            out.append(
                Case(
                    f"four_finger itself, {text}",
                    lambda g=GRASPS[name], w=loads: started(g, w),
                    tight=True,
                    start=BASIS,
                )
            )
    weights = Objective(2.0, 0.3)
    out.append(
        Case(
            "four_finger of another Phi",
            lambda: started(GRASPS["cuboid"], wanted, weights),
            tight=True,
            start=BASIS,
        )
    )
    out.append(Case("four_finger on a floor", lambda: started(FLOOR, wanted[:2])))
    loads = np.concatenate([wanted, FAR[:1]])
    for name, method, each in product(known, ("reduced_flow", "newton"), (False, True)):
        text = f"{method} from four_finger{' each time' if each else ''}, {name}"
        out.append(
            Case(
                text,
                lambda g=GRASPS[name], e=each, o=method: solved(g, loads, e, False, method=o),
                start=BASIS,
            )
        )
    for method in ("reduced_flow", "newton"):
        text = f"{method} from four_finger remembering"
        out.append(Case(text, lambda o=method: solved(GRASPS["cuboid"], walk, False, True, method=o)))
        tight = {"method": method, "tolerance": 1e-12}
        out.append(Case(f"{text}, tight", lambda o=tight: solved(GRASPS["cuboid"], walk, False, True, **o), tight=True))
        more = {"method": method, "barrier_weight": (0.01, 0.1, 0.002, 1.0)}
        out.append(
            Case(
                f"{method} from four_finger, weights",
                lambda o=more: solved(GRASPS["cuboid"], wanted, False, False, **o),
                start=BASIS,
            )
        )
    return named(out)

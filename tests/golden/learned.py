"""The shipped models as starts: within and beyond their training, on contacts they know and others, with a memory."""

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

MODELS = ("any_grasp", "four_finger")
FAR = np.array([100.0 * PAPER, 1e4 * PAPER, 1e-6 * PAPER])
"""Beyond what either model was trained on, from above and from below."""


def started(model: str, grasp: Grasp, wanted: np.ndarray, objective: Objective | None = None) -> list[Outcome]:
    """The rule itself, called: forces (N, 3), and whether it was trained on that."""
    rule = LearnedInitialForce.pretrained(model)
    rule = rule if objective is None else rule.with_objective(objective)

    def call(wrench: np.ndarray) -> Outcome:
        force = rule(grasp, wrench)
        known = "known" if rule.covers(grasp, wrench) else "outside"
        return Outcome("force", f"{rule.name}, {known}", force=np.column_stack([force, np.zeros(len(force))]))

    return [attempt(lambda w=wrench: call(w)) for wrench in wanted]


def solved(model: str, grasp: Grasp, wanted: np.ndarray, each: bool, remembers: bool, **options: Any) -> list[Outcome]:
    """An optimizer that always starts from the model (`each`: given to every call anew)."""
    rule = LearnedInitialForce.pretrained(model, remembers=remembers)
    if each:
        return solve(grasp, wanted, {"initial": rule}, **options)
    return solve(grasp, wanted, initial=rule, **options)


def cases() -> dict[str, Case]:
    """All of them."""
    out: list[Case] = []
    wanted = np.array([PAPER, NONE, LIGHT, *wrenches(31, 12)])
    walk = PAPER + np.cumsum(0.05 * wrenches(32, 10), axis=0)
    known = {
        "any_grasp": ("tripod", "cuboid", "4 uneven", "5 uneven", "plate", "far", "elliptic"),
        "four_finger": ("cuboid", "4 uneven"),
    }
    for model in MODELS:
        for name in (*known[model], "slippery", "8 random", "soft", "rough and frictionless"):
            grasp = GRASPS[name]
            loads = wanted if name != "far" else wanted[1:2]
            out.append(
                Case(
                    f"{model} itself, {name}",
                    lambda m=model, g=grasp, w=loads: started(m, g, w),
                    tight=True,
                    start=BASIS,
                )
            )
            out.append(
                Case(
                    f"{model} itself, {name}, far",
                    lambda m=model, g=grasp: started(m, g, FAR[:, :]),
                    tight=True,
                    start=BASIS,
                )
            )
        weights = Objective(2.0, 0.3)
        out.append(
            Case(
                f"{model} of another Phi",
                lambda m=model, o=weights: started(m, GRASPS["cuboid"], wanted, o),
                tight=True,
                start=BASIS,
            )
        )
        out.append(Case(f"{model} on a floor", lambda m=model: started(m, FLOOR, wanted[:2])))
        for name, method, each in product(known[model], ("reduced_flow", "newton"), (False, True)):
            if name in ("far", "plate"):
                continue
            text = f"{method} from {model}{' each time' if each else ''}, {name}"
            loads = np.concatenate([wanted, FAR[:1]])
            out.append(
                Case(
                    text,
                    lambda m=model, g=GRASPS[name], w=loads, e=each, o=method: solved(m, g, w, e, False, method=o),
                    start=BASIS,
                )
            )
        for method in ("reduced_flow", "newton"):
            text = f"{method} from {model} remembering"
            out.append(Case(text, lambda m=model, o=method: solved(m, GRASPS["cuboid"], walk, False, True, method=o)))
            out.append(
                Case(
                    f"{text}, tight",
                    lambda m=model, o=method: solved(m, GRASPS["cuboid"], walk, False, True, method=o, tolerance=1e-12),
                    tight=True,
                )
            )
            more = {"method": method, "barrier_weight": (0.01, 0.1, 0.002, 1.0)}
            out.append(
                Case(
                    f"{method} from {model}, weights",
                    lambda m=model, o=more: solved(m, GRASPS["cuboid"], wanted, False, False, **o),
                    start=BASIS,
                )
            )
    return named(out)

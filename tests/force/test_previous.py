"""Contacts that move near the loss of force closure: a solver that remembers ends as one that does
not.

A sample always, 200,000 problems under `slow`; GRASP_TRIAL_SEED gives those another seed.
"""

from __future__ import annotations

import os
from collections import Counter
from typing import Any

import numpy as np
import pytest
from force.clarabel_reference import Reference
from force.generators import own_joints

from grasp_env.errors import GraspError
from grasp_env.force import ForceLimits, ForceOptimizer, ForceSolution, Status
from grasp_env.grasp import Grasp
from grasp_env.quality import force_closure

# friction of 30 and the like
pytestmark = pytest.mark.filterwarnings("ignore::grasp_env.errors.GraspWarning")

SEED = int(os.environ.get("GRASP_TRIAL_SEED", "20261128"))
KINDS = ("hard", "elliptic", "soft", "mixed", "frictionless")
STEPS = 8
"""Calls of a grasp, each with other contacts and another wrench."""
BALANCED = 1e-8
"""Largest imbalance, relative to the wrench and to forces up to 1 N; the solver itself asks for a
tenth."""
Generator = np.random.Generator
Array = np.ndarray


def contacts(rng: Generator) -> dict[str, Any] | None:
    """Arguments of `Grasp.from_contacts`, with friction within a part of 1e-6 to 0.3 of the least
    that closes; None: none closes."""
    kind = str(rng.choice(KINDS, p=[0.45, 0.2, 0.15, 0.15, 0.05]))
    count = (
        int(rng.integers(9, 13))
        if kind == "frictionless"
        else int(3 + min(8, rng.geometric(0.35) - 1))
    )
    size = 10.0 ** rng.uniform(-2.7, -0.5)
    axes = rng.uniform(0.4, 1.0, 3)
    on = rng.standard_normal((count, 3))
    on /= np.linalg.norm(on, axis=1)[:, None]
    normals = unit(unit(-on / axes) + 0.1 * rng.standard_normal((count, 3)))
    friction = rng.uniform(0.2, 1.2, (count, 2)) * [
        1.0,
        rng.uniform(0.5, 2.0) if kind in ("elliptic", "mixed") else 1.0,
    ]
    names = {
        "mixed": list(rng.choice(["hard", "soft", "frictionless"], count, p=[0.5, 0.3, 0.2])),
        "elliptic": "hard",
    }
    given = {
        "positions": size * on * axes,
        "normals": normals,
        "contact_model": names.get(kind, kind),
        "torsional_friction": size * 10.0 ** rng.uniform(-3.0, 0.0, count),
    }

    def closes(part: float) -> bool:
        try:
            return bool(force_closure(Grasp.from_contacts(friction=part * friction, **given)))
        except GraspError:  # rank lost, or within rounding of the edge
            return False

    if kind == "frictionless":
        return given | {"friction": friction}
    low, high = 1e-3, 30.0
    if not closes(high):
        return None
    for _ in range(22):
        middle = np.sqrt(low * high)
        low, high = (low, middle) if closes(middle) else (middle, high)
    above = rng.random() < 0.8
    part = (
        high * (1.0 + 10.0 ** rng.uniform(-6, -0.5))
        if above
        else low * (1.0 - 10.0 ** rng.uniform(-6, -1))
    )
    return given | {"friction": part * friction}


def unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=1)[:, None]


def options(rng: Generator, count: int, load: float) -> dict[str, Any]:
    """Weights, tolerance and limits of an optimizer; most have the defaults."""
    given: dict[str, Any] = {}
    if rng.random() < 0.2:
        most = load * 10.0 ** rng.uniform(0.0, 3.0)
        limits = {"max_normal": most}
        if rng.random() < 0.5:
            shared = rng.random() < 0.3
            jacobian = (
                0.05 * rng.standard_normal((count, 3, 4)) if shared else own_joints(rng, count)
            )
            limits = {"jacobian": jacobian, "torque_limit": np.full(jacobian.shape[2], 0.05 * most)}
        given = {"limits": ForceLimits(**limits), "elastic": bool(rng.random() < 0.3)}
    if rng.random() < 0.5:
        given |= {
            "force_weight": 10.0 ** rng.uniform(-2, 2),
            "barrier_weight": 10.0 ** rng.uniform(-5, 1),
        }
    if rng.random() < 0.3:
        given["tolerance"] = 1e-6
    return given


def ending(
    optimizer: ForceOptimizer, wrench: Array, now: dict[str, Array]
) -> tuple[str, ForceSolution | None]:
    """The status or the error, and the solution."""
    try:
        found = optimizer.solve(wrench, **now)
    except GraspError as error:
        return type(error).__name__, None
    return found.status.name, found


def fault(
    made: dict[str, Any], wrench: Array, cold: ForceSolution | None, warm: ForceSolution | None
) -> str:
    """Return the first fault of two solutions of one problem, and "" if there is none."""
    reference = Reference(Grasp.from_contacts(**made))
    load = float(np.abs(reference.load(wrench)).max())
    for name, found in (("cold", cold), ("previous", warm)):
        if found is None:
            continue
        left = reference.residual(found.force, found.torsion, wrench)
        most = float(np.abs(found.force).max())
        if left > BALANCED * max(load, min(most, 1.0)) + 1e-13 * most:
            return f"{name} misses balance"
        if not (np.isfinite(found.objective) and found.cone_margin >= 0.0):
            return f"{name} is outside"
    if cold is None or warm is None or {cold.status, warm.status} != {Status.OPTIMAL}:
        return ""
    least = max(cold.lower_bound, warm.lower_bound)
    most = min(cold.objective, warm.objective)
    return "" if least <= most * (1.0 + 1e-9) else "bounds and objectives disagree"


def trial(seed: int, problems: int) -> tuple[Counter[str], list[str]]:
    """Number of each outcome of the cold calls, and what the calls that remember do otherwise."""
    counts = Counter()
    notes = []
    index = 0
    while counts.total() < problems:
        rng = np.random.default_rng([seed, index])
        index = index + 1
        given = contacts(rng)
        if given is None:
            continue
        count = len(given["positions"])
        size = float(np.abs(given["positions"]).max())
        load = 10.0 ** rng.uniform(-1.0, 2.5)
        step = 10.0 ** rng.uniform(-4.0, -1.0)
        settings = options(rng, count, load)
        try:
            grasp = Grasp.from_contacts(**given)
            warm, cold = (
                ForceOptimizer(grasp, initial=start, **settings) for start in ("previous", None)
            )
        except GraspError:  # rank lost
            continue
        moved: dict[str, Array] = {}
        for k in range(STEPS):
            wrench = load * np.append(
                rng.standard_normal(3), size * rng.choice([0.0, 0.1, 1.0]) * rng.standard_normal(3)
            )
            (want, plain), (came, again) = (ending(each, wrench, moved) for each in (cold, warm))
            counts[want] += 1
            why = (
                f"{want} became {came}"
                if want != came
                else fault(given | moved, wrench, plain, again)
            )
            if why:
                notes.append(f"seed {seed}, grasp {index - 1}, step {k}: {why}")
            shift = rng.standard_normal((2, count, 3))
            moved = {
                "positions": given["positions"] + size * step * shift[0],
                "normals": unit(given["normals"] + step * shift[1]),
                "friction": given["friction"]
                * (1.0 + (0.1 * step * rng.standard_normal() if rng.random() < 0.5 else 0.0)),
            }
    return counts, notes


@pytest.mark.parametrize("problems", [3_000, pytest.param(200_000, marks=pytest.mark.slow)])
def test_previous_ends_as_a_cold_call(problems):
    counts, notes = trial(SEED, problems)
    print("\n".join(notes[:50]), *sorted(counts.items()), sep="\n")
    assert not notes
    assert counts["OPTIMAL"] > problems / 3
    assert counts["InfeasibleWrenchError"] > problems / 20
    assert counts["LIMITS_EXCEEDED"] > 0
    assert counts["NotConvergedError"] < problems / 1000

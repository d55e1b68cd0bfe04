"""Never worse than the 12-basis: a rule's Phi against the basis's, on wrenches over six decades."""

from __future__ import annotations

import numpy as np

from grasp_env._check import Array
from grasp_env.errors import InfeasibleStartError
from grasp_env.force import InitialForceRule, Objective, OfflineBasis
from grasp_env.grasp import Grasp, presets
from grasp_env.grasp.wrench import magnitude, sample_magnitudes
from policies import LearnedInitialForce
from training.cases.sets import HELD_OUT
from training.cases.starts import everywhere
from training.data.grasps import EVALUATION
from training.trials.arrays import MAGNITUDES, Trials

RANDOM_GRASPS = {"random_4": 4, "random_3": 3, "random_5": 5}
_GRASPS_EACH = 10


def never_worse(
    rule: InitialForceRule, grasp: Grasp, count: int, seed: int | list[int], objective: Objective | None = None
) -> tuple[Array, Array]:
    """Phi of a rule's start over that of the 12-basis of the same grasp, minus one.

    Args:
        rule: the start.
        grasp: the contacts.
        count: wrenches.
        seed: of the wrenches.
        objective: Phi; None: the rule's own.

    Returns:
        excess (count,), inf where the rule has no strictly feasible start; magnitude (count,) [N].
    """
    phi: Objective = objective or getattr(rule, "objective", Objective())
    loads = sample_magnitudes(np.random.default_rng(seed), count, *MAGNITUDES)
    basis = OfflineBasis.of(grasp, phi)
    learned, paper = np.full((2, count, grasp.n_contacts, 3), np.nan)
    for k, load in enumerate(loads):
        paper[k] = basis.combine(load)
        try:
            learned[k] = rule(grasp, load)
        except InfeasibleStartError:
            continue
    with np.errstate(divide="ignore", invalid="ignore"):
        excess = values(grasp, learned, phi) / values(grasp, paper, phi) - 1.0
    return excess, magnitude(loads)


def values(grasp: Grasp, forces: Array, objective: Objective) -> Array:
    """Phi (n,) of forces (n, N, 3); inf outside the cones and where they are nan."""
    u, o, t = np.moveaxis(forces * grasp.models.cone_scale, -1, 0)
    omega, lam = objective.weights(grasp.n_contacts).T
    d = (u - np.hypot(o, t)) * (u + np.hypot(o, t))
    with np.errstate(divide="ignore", invalid="ignore"):
        total = (3.0 * omega * u + lam * (1.0 / u + 2.0 * u / d)).sum(axis=1)
    return np.where(((u > 0.0) & (d > 0.0)).all(axis=1), total, np.inf)


def guarantee(models: dict[str, LearnedInitialForce], count: int, seed: int) -> Trials:
    """`never_worse` of every model on the fixed grasp, and of the any-grasp model on random grasps too.

    Args:
        models: the saved models.
        count: wrenches per model and grasp set.
        seed: of the evaluation.

    Returns:
        "<start>/<grasp>/excess" and "/magnitude" (about count,).
    """
    out: Trials = {}
    for place, (key, model) in enumerate(models.items()):
        sets: dict[str, list[Grasp]] = {"fixed": [presets.paper_cuboid()]}
        if everywhere(model):
            rng = np.random.default_rng([HELD_OUT, seed, 1 << 23])
            sets |= {
                name: [EVALUATION.closed(rng, n) for _ in range(_GRASPS_EACH)] for name, n in RANDOM_GRASPS.items()
            }
        for name, grasps in sets.items():
            try:
                model(grasps[0], np.zeros(6))
            except InfeasibleStartError:  # a model of other contacts promises nothing here
                continue
            parts = [
                never_worse(model, grasp, max(1, count // len(grasps)), [HELD_OUT, seed, place, k])
                for k, grasp in enumerate(grasps)
            ]
            out[f"{key}/{name}/excess"] = np.concatenate([part[0] for part in parts])
            out[f"{key}/{name}/magnitude"] = np.concatenate([part[1] for part in parts])
    return out

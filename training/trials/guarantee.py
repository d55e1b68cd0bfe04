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
from training.trials.arrays import MAGNITUDES, Trials


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
    """`never_worse` of every model on the fixed grasp.

    Args:
        models: the saved models.
        count: wrenches per model.
        seed: of the evaluation.

    Returns:
        "<start>/fixed/excess" and "/magnitude" (count,).
    """
    out: Trials = {}
    for place, (key, model) in enumerate(models.items()):
        grasp = presets.paper_cuboid()
        try:
            model(grasp, np.zeros(6))
        except InfeasibleStartError:  # a model of other contacts promises nothing here
            continue
        out[f"{key}/fixed/excess"], out[f"{key}/fixed/magnitude"] = never_worse(
            model, grasp, count, [HELD_OUT, seed, place, 0]
        )
    return out

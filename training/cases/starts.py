"""Every start that the evaluation compares, as a function of a grasp, a wrench and the previous optimum."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from grasp_env._check import Array, ContactForces, Wrench
from grasp_env.force import (
    ForceOptimizer,
    ForceSolution,
    InitialForceRule,
    Objective,
    OfflineBasis,
    initial_rule,
    optimize_forces,
)
from grasp_env.force.basis import starter
from grasp_env.force.record import FORCE, record_size
from grasp_env.force.repair import CORRECTIONS, Correction, carry_over
from grasp_env.grasp import Grasp, presets, wrench
from grasp_env.grasp.wrench import MAGNITUDE_LENGTH
from policies import LearnedInitialForce
from training.cases.sets import HELD_OUT

TOLERANCE = 1e-4
Start = Callable[[Grasp, Wrench, "ContactForces | None"], ContactForces]
"""(grasp, wrench, previous optimum in the grasp's contact frames or None) -> force (N, 3) [N]."""

LABELS = {
    "single_value": "single value",
    "lagrange": "Lagrange",
    "linear_combination_printed": "12-basis, as printed",
    "linear_combination": "12-basis (the paper, fixed at w = 0)",
    "basis_tangent": "12-basis, one Newton correction",
    "basis_newton_2": "12-basis, two Newton corrections",
    "basis_newton": "12-basis, four Newton corrections",
    "previous_pseudoinverse": "previous solution, G^+",
    "previous_tangent": "previous solution, tangent",
    "nearest_pseudoinverse": "nearest of 10,000 stored, G^+",
    "nearest_tangent": "nearest of 10,000 stored, tangent",
    "network": "network alone, fixed grasp",
    "network_newton_1": "network, one Newton step",
    "network_newton_2": "network, two Newton steps",
    "learned_fixed": "learned, fixed grasp",
    "learned_any": "learned, any grasp",
    "learned_previous": "learned, with the previous solution",
    "learned_fitted": "learned, fitted in this run",
}
"""Every start, in the order of the tables."""
SHORT = {
    "single_value": "single value",
    "lagrange": "Lagrange",
    "linear_combination_printed": "12-basis, printed",
    "linear_combination": "12-basis",
    "basis_tangent": "12-basis + Newton",
    "basis_newton_2": "12-basis + 2 Newton",
    "basis_newton": "12-basis + 4 Newton",
    "previous_pseudoinverse": "previous, G^+",
    "previous_tangent": "previous, tangent",
    "nearest_pseudoinverse": "nearest, G^+",
    "nearest_tangent": "nearest, tangent",
    "network": "network alone",
    "network_newton_1": "network + Newton",
    "network_newton_2": "network + 2 Newton",
    "learned_fixed": "learned, fixed",
    "learned_any": "learned, any",
    "learned_previous": "learned + previous",
    "learned_fitted": "learned, fitted",
}
"""For legends."""
LEARNED = ("learned_fixed", "learned_any", "learned_previous", "learned_fitted")
MODELS = ("learned_fixed", "learned_any", "learned_fitted")
"""The learned starts that are a saved model."""
SHIPPED = {"learned_fixed": "four_finger", "learned_any": "any_grasp"}
"""Their names in the package."""
COLD = tuple(key for key in LABELS if not key.startswith("previous") and key != "learned_previous")
"""The starts that no previous solution helps."""
STORED = 10_000
STORED_RANGE = (0.1, 20.0)
"""[N] magnitudes of the stored solutions: those that the fixed-grasp model is trained on."""
NEWTON_STEPS = {
    "basis_tangent": ("linear_combination", 1),
    "basis_newton_2": ("linear_combination", 2),
    "basis_newton": ("linear_combination", 4),
    "network_newton_1": ("network", 1),
    "network_newton_2": ("network", 2),
}
"""Starts that are another start after plain Newton steps: four are the control of the any-grasp model's layers, one and two of the
network alone and the 12-basis stand beside each other."""
KEPT = 0.95
"""Part of the way from the 12-basis to the cones at which a network's force outside them is put."""
NEAR_PLACE, NEAR_NORMAL = 0.02, 0.95
"""[m] and cosine by which contacts may differ from the fixed grasp's where what knows that grasp alone applies."""


class DoesNotApply(Exception):
    """The start knows nothing about this grasp, or needs a previous solution: skipped, and counted as such."""


def load_models(fitted: str | Path | None = None) -> dict[str, LearnedInitialForce]:
    """The saved models by start: those that ship with the package, and one fitted in this run.

    Args:
        fitted: where that one lies; None: there is none.
    """
    models = {key: LearnedInitialForce.pretrained(name) for key, name in SHIPPED.items()}
    if fitted is not None:
        models["learned_fitted"] = LearnedInitialForce.load(fitted)
    return models


def make_starts(objective: Objective, models: dict[str, LearnedInitialForce]) -> dict[str, Start]:
    """Every start by its key in `LABELS`.

    Args:
        objective: Phi.
        models: see `load_models`; none: the classical starts alone.
    """
    starts: dict[str, Start] = {}
    for name in ("single_value", "lagrange", "linear_combination_printed", "linear_combination"):
        starts[name] = memoryless(initial_rule(name, objective))
    for correction in CORRECTIONS:
        starts[f"previous_{correction}"] = previous(objective, correction)
    stored = Stored(objective)
    for correction in CORRECTIONS:
        starts[f"nearest_{correction}"] = memoryless(Nearest(stored, correction))
    for key, model in models.items():
        starts[key] = memoryless(model if key == "learned_any" else OnFixedGrasp(model))
    starts |= {key: memoryless(rule) for key, rule in stepped(objective, models).items()}
    if "learned_fixed" in models:
        starts["learned_previous"] = with_memory(models, objective)
    return {key: starts[key] for key in LABELS if key in starts}


def memoryless(rule: InitialForceRule) -> Start:
    """A start that does not look at the previous solution."""
    return lambda grasp, load, before: rule(grasp, load)


def previous(objective: Objective, correction: Correction) -> Start:
    """The previous optimum, corrected to the new balance and repaired."""

    def start(grasp: Grasp, load: Wrench, before: ContactForces | None) -> ContactForces:
        if before is None:
            raise DoesNotApply
        return carry_over(grasp, load, before, objective, correction)

    return start


def with_memory(models: dict[str, LearnedInitialForce], objective: Objective) -> Start:
    """The learned start that also knows the previous solution: of any grasp where there is such a model, else of the fixed one."""
    model = remembering(memory_model(models))
    everywhere = "learned_any" in models

    def start(grasp: Grasp, load: Wrench, before: ContactForces | None) -> ContactForces:
        if not everywhere and not near_fixed(grasp):
            raise DoesNotApply
        return model.start(grasp, load, objective, None if before is None else as_solution(before))[1]

    return start


def memory_model(models: dict[str, LearnedInitialForce]) -> LearnedInitialForce:
    """The model behind "learned_previous"."""
    return models.get("learned_any", models["learned_fixed"])


def remembering(model: LearnedInitialForce) -> LearnedInitialForce:
    """The same model, which also starts from the previous solution where that has less Phi."""
    return type(model)(model.checkpoint, model.objective, True)


def as_solution(force: ContactForces) -> ForceSolution:
    """A force (N, 3) as a previous solution, of which starts read no more than that."""
    record = np.zeros(record_size(len(force)))
    record[FORCE : FORCE + force.size] = force.reshape(-1)
    return ForceSolution(record, "carried", "previous")


def stepped(objective: Objective, models: dict[str, LearnedInitialForce]) -> dict[str, InitialForceRule]:
    """The network of the fixed grasp alone, if there is one, and the starts of `NEWTON_STEPS`, by key."""
    alone: dict[str, InitialForceRule] = {}
    if "learned_fixed" in models:
        alone["network"] = OnFixedGrasp(NetworkAlone(models["learned_fixed"]))
    rules = {"linear_combination": initial_rule("linear_combination", objective), **alone}
    taken = {key: NewtonSteps(rules[rule], objective, n) for key, (rule, n) in NEWTON_STEPS.items() if rule in rules}
    return {**alone, **taken}


class NetworkAlone:
    """What a network says, without a step of any order: put back towards the 12-basis only where it lies outside the cones."""

    def __init__(self, model: LearnedInitialForce) -> None:
        self.model = model

    def __call__(self, grasp: Grasp, load: Wrench) -> ContactForces:
        """See `InitialForceRule`."""
        raw = self.model.raw(grasp, load)
        if grasp.cone_margin(raw) > 0.0:
            return raw
        safe = OfflineBasis.of(grasp, self.model.objective).combine(load)
        way = raw - safe
        _, reach = starter(grasp, self.model.objective).inside(grasp.to_cone(safe), grasp.to_cone(way))
        return safe + min(1.0, KEPT * reach) * way


class NewtonSteps:
    """Another start after a few Newton steps on Phi within balance, each as long as lowers Phi most.

    For a previous optimum one such step is its tangent correction: the others get what it gets.
    """

    def __init__(self, rule: InitialForceRule, objective: Objective, steps: int) -> None:
        self.rule, self.objective, self.steps = rule, objective, steps

    def __call__(self, grasp: Grasp, load: Wrench) -> ContactForces:
        """See `InitialForceRule`."""
        x = grasp.to_cone(self.rule(grasp, load))
        step, multipliers, solver = np.empty_like(x), np.empty(6), starter(grasp, self.objective)
        for _ in range(self.steps):
            if solver.newton_step(load, x, step, multipliers) < 0.0:
                break
            step += x
            solver.segment(x, step)
            x = step.copy()
        force = grasp.to_force(x).reshape(-1)
        # rounding of the steps, which a nearly singular G makes visible
        return (force - grasp.pseudoinverse @ (grasp.matrix @ force + load)).reshape(-1, 3)


class Stored:
    """Optimal forces of the fixed grasp for `STORED` wrenches, to be looked up by the nearest wrench."""

    def __init__(self, objective: Objective) -> None:
        self.objective, self.grasp = objective, presets.paper_cuboid()
        loads = wrench.sample_magnitudes(np.random.default_rng([HELD_OUT, 1 << 20]), STORED, *STORED_RANGE)
        self.forces = optimize_forces(self.grasp, loads, workers=1, **phi_options(objective)).force
        self.tree = KDTree(scaled(loads))

    def nearest(self, load: Wrench) -> ContactForces:
        """The force (N, 3) stored for the wrench nearest to `load` (6,), moments over 0.05 m."""
        return self.forces[int(self.tree.query(scaled(load))[1])]


class Nearest:
    """The nearest stored solution, corrected and repaired; of the fixed grasp and those near it."""

    def __init__(self, stored: Stored, correction: Correction) -> None:
        self.stored = stored
        self.correction: Correction = correction
        self.objective = stored.objective

    def __call__(self, grasp: Grasp, load: Wrench) -> ContactForces:
        """See `InitialForceRule`."""
        if not near_fixed(grasp):
            raise DoesNotApply
        return carry_over(grasp, load, self.stored.nearest(load), self.objective, self.correction)


class OnFixedGrasp:
    """A rule that knows the fixed grasp, where the grasp is that one or near it."""

    def __init__(self, rule: InitialForceRule) -> None:
        self.rule = rule

    def __call__(self, grasp: Grasp, load: Wrench) -> ContactForces:
        """See `InitialForceRule`."""
        if not near_fixed(grasp):
            raise DoesNotApply
        return self.rule(grasp, load)


def near_fixed(grasp: Grasp) -> bool:
    """Whether the contacts are those of `presets.paper_cuboid()`, moved and tilted a little at most."""
    fixed = _FIXED
    return (
        grasp.n_contacts == fixed.n_contacts
        and bool(np.abs(grasp.positions - fixed.positions).max() <= NEAR_PLACE)
        and bool((grasp.normals * fixed.normals).sum(axis=1).min() >= NEAR_NORMAL)
    )


_FIXED = presets.paper_cuboid()


def carried(old: Grasp, force: ContactForces, now: Grasp, objective: Objective) -> ContactForces:
    """A force of the grasp before in the contact frames of the grasp of now.

    Each contact takes the force of the nearest old one within 20 mm, as a vector in the object frame. A finger that was not there
    gets its own optimum of no load, u = sqrt(lambda / omega): strictly inside its cone, unlike no force.

    Args:
        old: the contacts of `force`.
        force: (N, 3) [N].
        now: the contacts of now.
        objective: Phi.
    """
    if old is now:
        return force
    vectors, weights = old.to_object_frame(force), objective.weights(now.n_contacts)
    apart = np.linalg.norm(now.positions[:, None] - old.positions, axis=2)
    out = np.zeros((now.n_contacts, 3))
    out[:, 0] = np.sqrt(weights[:, 1] / weights[:, 0]) / now.friction
    for _ in range(min(apart.shape)):
        here, there = np.unravel_index(int(apart.argmin()), apart.shape)
        if apart[here, there] > NEAR_PLACE:
            break
        out[here] = now.frames[here].T @ vectors[there]
        apart[here], apart[:, there] = np.inf, np.inf
    return out


def newton_optimizer(grasp: Grasp, objective: Objective, tolerance: float) -> ForceOptimizer:
    """Newton on Phi to a relative gap."""
    return ForceOptimizer(grasp, method="newton", tolerance=tolerance, **phi_options(objective))


def phi_options(objective: Objective) -> dict[str, Any]:
    """Phi as keywords of `ForceOptimizer`."""
    return {"force_weight": objective.force_weight, "barrier_weight": objective.barrier_weight}


def scaled(loads: Array) -> Array:
    """Wrenches (..., 6) with moments divided by 0.05 m [N]."""
    return loads / np.repeat([1.0, MAGNITUDE_LENGTH], 3)

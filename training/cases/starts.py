"""Every start that the evaluation compares, as a function of a grasp, a wrench and the previous optimum."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
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
from grasp_env.force.initial import CompiledRule, asked, is_rule
from grasp_env.force.record import FORCE, record_size
from grasp_env.force.repair import Correction, carry_over
from grasp_env.grasp import Grasp, presets, wrench
from grasp_env.grasp.wrench import MAGNITUDE_LENGTH
from policies import LearnedInitialForce
from training.cases import start_table as table
from training.cases.sets import HELD_OUT
from training.cases.start_table import SHIPPED, STARTS

Start = Callable[[Grasp, Wrench, "ContactForces | None"], ContactForces]
"""(grasp, wrench, previous optimum in the grasp's contact frames or None) -> force (N, 3) [N]."""

STORED = 10_000
STORED_RANGE = (0.1, 20.0)
"""[N] magnitudes of the stored solutions: those that the fixed-grasp model is trained on."""
KEPT = 0.95
"""Part of the way from the 12-basis to the cones at which a network's force outside them is put."""
NEAR_PLACE, NEAR_NORMAL = 0.02, 0.95
"""[m] and cosine by which contacts may differ from the fixed grasp's where what knows that grasp alone applies."""


class DoesNotApply(Exception):
    """The start knows nothing about this grasp, or needs a previous solution: skipped, and counted as such."""


def load_models() -> dict[str, LearnedInitialForce]:
    """The models that ship with the package, by start."""
    return {key: LearnedInitialForce.pretrained() for key in SHIPPED}


def models_in(rules: Mapping[str, InitialForceRule]) -> dict[str, LearnedInitialForce]:
    """Those of the rules that are saved models."""
    return {key: rule for key, rule in rules.items() if isinstance(rule, LearnedInitialForce)}


@dataclass(frozen=True)
class Made:
    """A start that has been made.

    Attributes:
        start: it, for trials.
        options: `ForceOptimizer`'s, with which a control loop has it: what is timed.
        rule: it, where it looks at no previous solution.
    """

    start: Start
    options: dict[str, Any]
    rule: InitialForceRule | None = None

    def __call__(self, grasp: Grasp, load: Wrench, before: ContactForces | None) -> ContactForces:
        """The force (N, 3) [N]."""
        return self.start(grasp, load, before)

    @classmethod
    def of(cls, rule: InitialForceRule, timed: str | InitialForceRule | None = None) -> Made:
        """Of a rule that does not look at the previous solution; a control loop may have it by a name, or unguarded."""
        return cls(lambda grasp, load, before: rule(grasp, load), {"initial": timed or rule}, rule)

    @classmethod
    def given(cls, rule: InitialForceRule, objective: Objective) -> Made:
        """Of a saved model, where it knows the grasp, or of a callable of anybody's, whatever that does."""
        compiled = rule if is_rule(rule, CompiledRule) else None

        def start(grasp: Grasp, load: Wrench, before: ContactForces | None) -> ContactForces:
            if isinstance(rule, LearnedInitialForce) and not near_fixed(grasp):
                raise DoesNotApply
            if compiled is None:
                return asked(rule, rule, grasp, load.copy())
            previous = as_solution(before) if compiled.remembers and before is not None else None
            return asked(rule, compiled.start, grasp, load.copy(), objective, previous)[1]

        alone = None if compiled is not None and compiled.remembers else lambda grasp, load: start(grasp, load, None)
        return cls(start, {"initial": rule}, alone)


class Workshop:
    """What starts are made of: Phi, rules by name, and the starts made so far."""

    def __init__(self, objective: Objective, rules: Mapping[str, InitialForceRule]) -> None:
        self.objective, self.rules = objective, rules
        self.models, self.made = models_in(rules), dict[str, Made]()

    @functools.cached_property
    def stored(self) -> Stored:
        """Solved once for all that look a solution up."""
        return Stored(self.objective)


def _named(shop: Workshop, key: str, how: table.Named) -> Made:
    return Made.of(initial_rule(how.name, shop.objective), how.name)


def _previous(shop: Workshop, key: str, how: table.Previous) -> Made:
    correction: Any = how.correction

    def start(grasp: Grasp, load: Wrench, before: ContactForces | None) -> ContactForces:
        if before is None:
            raise DoesNotApply
        return carry_over(grasp, load, before, shop.objective, correction)

    return Made(start, {"initial": "previous", "correction": correction})


def _nearest(shop: Workshop, key: str, how: table.Nearest) -> Made:
    correction: Any = how.correction
    return Made.of(Nearest(shop.stored, correction))


def steps_inside(rule: InitialForceRule) -> bool | None:
    """Whether a given start takes Newton steps before a method begins; None: not known of a callable."""
    return False if isinstance(rule, LearnedInitialForce) else None


def _given(shop: Workshop, key: str, how: table.Given | table.Model) -> Made | None:
    rule = shop.rules.get(key)
    return None if rule is None else Made.given(rule, shop.objective)


def _alone(shop: Workshop, key: str, how: table.Alone) -> Made | None:
    model = shop.models.get(how.model)
    return model and Made.of(OnFixedGrasp(NetworkAlone(model)))


def _stepped(shop: Workshop, key: str, how: table.Stepped) -> Made | None:
    other = shop.made.get(how.start)
    if other is None or other.rule is None:
        return None
    return Made.of(NewtonSteps(other.rule, shop.objective, how.steps))


def _remembering(shop: Workshop, key: str, how: table.Remembering) -> Made | None:
    known = [name for name in how.models if name in shop.models]
    if not known:
        return None
    model = shop.models[known[0]]
    return Made.given(type(model)(model.checkpoint, model.objective, True), shop.objective)


BUILDERS: dict[type, Callable[[Workshop, str, Any], Made | None]] = {
    table.Named: _named, table.Previous: _previous, table.Nearest: _nearest, table.Model: _given, table.Alone: _alone,
    table.Stepped: _stepped, table.Remembering: _remembering, table.Given: _given,
}  # fmt: skip
"""By the class of a row's `how`: the start, None where its model is not there."""


def make_starts(objective: Objective, rules: Mapping[str, InitialForceRule]) -> dict[str, Made]:
    """Every start of `STARTS`, in its order, then those given.

    Args:
        objective: Phi.
        rules: saved models and whatever else was given, by start; starts of models that are not there are left out.
    """
    shop = Workshop(objective, rules)
    for key in (*STARTS, *table.given_in(rules)):
        how = table.row_of(key).how
        made = BUILDERS[type(how)](shop, key, how)
        if made is not None:
            shop.made[key] = made
    return shop.made


def as_solution(force: ContactForces) -> ForceSolution:
    """A force (N, 3) as a previous solution, of which starts read no more than that."""
    record = np.zeros(record_size(len(force)))
    record[FORCE : FORCE + force.size] = force.reshape(-1)
    return ForceSolution(record, "carried", "previous")


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

"""The starts that the comparison knows, one entry of `STARTS` each: what it is called, how it is drawn, how it is made."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from grasp_env._check import ContactForces, Wrench
from grasp_env.force import (
    RULES,
    ForceOptimizer,
    ForceSolution,
    InitialForceRule,
    Objective,
    OfflineBasis,
    initial_rule,
    optimize_force,
    optimize_forces,
)
from grasp_env.force.initial import LearnedRule, call_rule, is_rule
from grasp_env.force.record import CONTACTS, FORCE, record_size
from grasp_env.force.repair import Correction, carry_over
from grasp_env.force.rules import CoreStart
from grasp_env.grasp import Grasp, presets, wrench
from policies import LearnedInitialForce
from training.compare.cases import HELD_OUT, scaled
from training.compare.methods import phi_options

Start = Callable[[Grasp, Wrench, "ContactForces | None"], ContactForces]
"""(grasp, wrench, previous optimum in the grasp's contact frames or None) -> force (N, 3) [N]."""

BASIS = "linear_combination"
"""The paper's start, which the others are compared with."""
STORED = 10_000
STORED_RANGE = (0.1, 20.0)
"""[N] magnitudes of the stored solutions: those on which the model of the fixed grasp is trained."""
KEPT = 0.95
"""Part of the way from the 12-basis to the cones at which a network's force outside them is put."""
NEAR_PLACE, NEAR_NORMAL = 0.02, 0.95
"""[m] and cosine by which contacts may differ from the fixed grasp's where what knows that grasp alone applies."""
_FIXED = presets.paper_cuboid()


class DoesNotApply(Exception):
    """The start knows nothing about this grasp, or needs a previous solution: such cases have no row."""


@dataclass(frozen=True)
class Made:
    """A start that has been made.

    Attributes:
        start: for the trials.
        options: of a `ForceOptimizer` that has it, for the clock; none: it is given the force.
        compiled: whether the core makes it, from the wrench alone.
    """

    start: Start
    options: dict[str, Any]
    compiled: bool = False

    @classmethod
    def of(cls, rule: InitialForceRule, timed: str | InitialForceRule | None = None) -> Made:
        """A rule that does not look at the previous solution; a control loop may have it by a name."""
        return cls(lambda grasp, load, before: rule(grasp, load), {"initial": timed or rule}, timed is not None)


class Workshop:
    """Makes starts: knows Phi, the shipped model, and what a user brings.

    Args:
        objective: Phi.
        given: rules of a user by name, saved models among them.
    """

    def __init__(self, objective: Objective, given: Mapping[str, InitialForceRule] | None = None) -> None:
        self.objective, self.given = objective, dict(given or {})

    @cached_property
    def model(self) -> LearnedInitialForce:
        """The model that ships with the package."""
        return LearnedInitialForce.pretrained()

    @cached_property
    def stored(self) -> Stored:
        """Solved once for all starts that look a solution up."""
        return Stored(self.objective)

    def made(self) -> dict[str, Made]:
        """Every start of `STARTS`, the rules of the package that it does not name, then those of the user."""
        named = {key: STARTS[key].make(self) for key in STARTS}
        own = {key: self.rule(rule(self.objective)) for key, rule in RULES.items() if key not in named}
        return {**named, **own, **{key: self.rule(rule) for key, rule in self.given.items()}}

    def named(self, name: str) -> Made:
        """A start of optimizers by name."""
        rule = initial_rule(name, self.objective) if name in RULES else CoreStart(name, self.objective)
        return Made.of(rule, name)

    def previous(self, correction: Correction) -> Made:
        """The previous solution, corrected to the new balance: as optimizers do it, or by the least change."""

        def start(grasp: Grasp, load: Wrench, before: ContactForces | None) -> ContactForces:
            if before is None:
                raise DoesNotApply
            if correction == "tangent":
                return self._after(grasp, load, before, "previous")
            return carry_over(grasp, load, before, self.objective, correction)

        return Made(start, {"initial": "previous"} if correction == "tangent" else {})

    def _after(
        self, grasp: Grasp, load: Wrench, before: ContactForces, initial: str | InitialForceRule
    ) -> ContactForces:
        """The start of an optimizer that has solved before; the paper's where nothing else can be had."""
        optimizer = ForceOptimizer(grasp, method="reduced_flow", initial=initial, **phi_options(self.objective))
        optimizer.previous = as_solution(grasp, before)
        return optimizer.start(load)

    def nearest(self, correction: Correction) -> Made:
        """The solution stored for the nearest wrench, corrected; on the fixed grasp and those near it."""

        def rule(grasp: Grasp, load: Wrench) -> ContactForces:
            require_near_fixed(grasp)
            return carry_over(grasp, load, self.stored.nearest(load), self.objective, correction)

        return Made.of(rule)

    def stepped(self, rule: InitialForceRule | str, steps: int) -> Made:
        """Another start after a few plain Newton steps: the control for whatever takes such steps inside."""
        return Made.of(
            NewtonSteps(initial_rule(rule, self.objective) if isinstance(rule, str) else rule, self.objective, steps)
        )

    @property
    def network(self) -> InitialForceRule:
        """The network of the shipped model without any step, on the fixed grasp and those near it."""
        alone = NetworkAlone(self.model)

        def rule(grasp: Grasp, load: Wrench) -> ContactForces:
            require_near_fixed(grasp)
            return alone(grasp, load)

        return rule

    def remembering(self) -> Made:
        """The shipped model, which also starts from the previous solution where that has less Phi."""
        return self.rule(type(self.model)(self.model.checkpoint, self.model.objective, True))

    def rule(self, rule: InitialForceRule) -> Made:
        """A saved model, where it knows the grasp, or any callable of a user."""
        remembers = is_rule(rule, LearnedRule) and rule.remembers

        def start(grasp: Grasp, load: Wrench, before: ContactForces | None) -> ContactForces:
            if isinstance(rule, LearnedInitialForce):
                require_near_fixed(grasp)
            if before is None or not remembers:
                return call_rule(rule, rule, grasp, load.copy())
            return self._after(grasp, load, before, rule)

        return Made(start, {"initial": rule}, is_rule(rule, LearnedRule) and not remembers)


@dataclass(frozen=True)
class Row:
    """A start of the comparison.

    Attributes:
        label: for tables.
        short: for charts.
        colour: of its line; no other line has it.
        make: makes it.
        main: whether charts that cannot show all starts show it.
        dashed: whether its line is dashed.
    """

    label: str
    short: str
    colour: str
    make: Callable[[Workshop], Made]
    main: bool = False
    dashed: bool = False


STARTS: dict[str, Row] = {
    "single_value": Row("single value", "single value", "#8a8a8b", lambda shop: shop.named("single_value")),
    "phase_one": Row(
        "phase one, any force inside", "phase one", "#8a9a22", lambda shop: Made.of(initial_rule("phase_one", shop.objective))
    ),
    "lagrange": Row("Lagrange", "Lagrange", "#b3852d", lambda shop: shop.named("lagrange")),
    "linear_combination_printed": Row(
        "12-basis, as printed", "12-basis, printed", "#5fa7e9", lambda shop: shop.named("linear_combination_printed"), dashed=True
    ),
    "internal_force": Row(
        "one internal force (Newton's own)", "internal force", "#6b6b3f", lambda shop: shop.named("internal_force"), main=True
    ),
    BASIS: Row("12-basis (the paper, fixed at w = 0)", "12-basis", "#2f7fd8", lambda shop: shop.named(BASIS), main=True),
    "basis_tangent": Row(
        "12-basis, one Newton correction", "12-basis + Newton", "#1e9ca6", lambda shop: shop.stepped(BASIS, 1)
    ),
    "basis_newton_2": Row(
        "12-basis, two Newton corrections", "12-basis + 2 Newton", "#1a9b7c", lambda shop: shop.stepped(BASIS, 2)
    ),
    "basis_newton": Row(
        "12-basis, four Newton corrections", "12-basis + 4 Newton", "#5a72ca", lambda shop: shop.stepped(BASIS, 4), main=True
    ),
    "previous_pseudoinverse": Row(
        "previous solution, G^+", "previous, G^+", "#74b374", lambda shop: shop.previous("pseudoinverse"), dashed=True
    ),
    "previous_tangent": Row(
        "previous solution, tangent", "previous, tangent", "#2e9a4e", lambda shop: shop.previous("tangent"), main=True
    ),
    "nearest_pseudoinverse": Row(
        "nearest of 10,000 stored, G^+", "nearest, G^+", "#a293d4", lambda shop: shop.nearest("pseudoinverse"), dashed=True
    ),
    "nearest_tangent": Row(
        "nearest of 10,000 stored, tangent", "nearest, tangent", "#8a5fc0", lambda shop: shop.nearest("tangent"), main=True
    ),
    "network": Row("network alone, fixed grasp", "network alone", "#b36cd0", lambda shop: Made.of(shop.network), main=True),
    "network_newton_1": Row(
        "network, one Newton step", "network + Newton", "#c069af", lambda shop: shop.stepped(shop.network, 1)
    ),
    "network_newton_2": Row(
        "network, two Newton steps", "network + 2 Newton", "#8a4faa", lambda shop: shop.stepped(shop.network, 2)
    ),
    "learned_fixed": Row("learned, fixed grasp", "learned, fixed", "#e0463e", lambda shop: shop.rule(shop.model), main=True),
    "learned_previous": Row(
        "learned, with the previous solution", "learned + previous", "#e2489a", lambda shop: shop.remembering(),
        main=True, dashed=True,
    ),
}  # fmt: skip
"""Every start, in the order of the tables."""
GIVEN_COLOURS = ("#aa7454", "#208dbc", "#c8528e", "#6b8b20", "#7c64e4", "#20908b", "#bc6a20", "#7f7f20")
"""Colours of the starts of a user, in turn: a run compares no more of them."""


def row_of(key: str) -> Row:
    """A start's row; one that a user gives is called by its name, a rule of the package by its label.

    Example:
        >>> row_of("lagrange").label, row_of("my_rule").label, row_of("my_rule").main
        ('Lagrange', 'my rule', True)
    """
    if key in STARTS:
        return STARTS[key]
    name = RULES[key].label if key in RULES else key.replace("_", " ")
    return Row(name, name, GIVEN_COLOURS[0], lambda shop: shop.rule(shop.given[key]), main=True, dashed=True)


def as_solution(grasp: Grasp, force: ContactForces) -> ForceSolution:
    """A force (N, 3) as a previous solution, of which starts read no more than that and the frames."""
    record = np.concatenate([np.zeros(record_size(len(force))), grasp.frames.reshape(-1)])
    record[CONTACTS], record[FORCE : FORCE + force.size] = len(force), force.reshape(-1)
    return ForceSolution(record, "carried", "previous")


class NetworkAlone:
    """A network's force without a step of any order, put back towards the 12-basis only where it lies outside the cones."""

    def __init__(self, model: LearnedInitialForce) -> None:
        self.model = model

    def __call__(self, grasp: Grasp, load: Wrench) -> ContactForces:
        """See `InitialForceRule`."""
        raw = self.model.raw(grasp, load)
        if grasp.cone_margin(raw) > 0.0:
            return raw
        safe = OfflineBasis.of(grasp, self.model.objective).combine(load)
        inside, outside = 0.0, 1.0
        for _ in range(40):
            middle = 0.5 * (inside + outside)
            inside, outside = (
                (middle, outside) if grasp.cone_margin(safe + middle * (raw - safe)) > 0.0 else (inside, middle)
            )
        return safe + KEPT * inside * (raw - safe)


class NewtonSteps:
    """Another start after the first steps of Newton.

    For a previous optimum one such step is its tangent correction: the others get what it gets.
    """

    def __init__(self, rule: InitialForceRule, objective: Objective, steps: int) -> None:
        self.rule, self.objective, self.steps = rule, objective, steps

    def __call__(self, grasp: Grasp, load: Wrench) -> ContactForces:
        """See `InitialForceRule`."""
        start, phi = self.rule(grasp, load), phi_options(self.objective)
        return optimize_force(grasp, load, initial=start, max_iterations=self.steps, tolerance=1e-12, **phi).force


class Stored:
    """Optimal forces of the fixed grasp for `STORED` wrenches, to be looked up by the nearest wrench."""

    def __init__(self, objective: Objective) -> None:
        loads = wrench.sample_magnitudes(np.random.default_rng([HELD_OUT, 1 << 20]), STORED, *STORED_RANGE)
        self.forces = optimize_forces(presets.paper_cuboid(), loads, workers=1, **phi_options(objective)).force
        self.tree = KDTree(scaled(loads))

    def nearest(self, load: Wrench) -> ContactForces:
        """The force (N, 3) stored for the wrench nearest to `load` (6,), moments over 0.05 m."""
        return self.forces[int(self.tree.query(scaled(load))[1])]


def require_near_fixed(grasp: Grasp) -> None:
    """Raises `DoesNotApply` unless the contacts are those of `presets.paper_cuboid()`, moved and tilted a little at most."""
    if (
        grasp.n_contacts != _FIXED.n_contacts
        or bool(np.abs(grasp.positions - _FIXED.positions).max() > NEAR_PLACE)
        or bool((grasp.normals * _FIXED.normals).sum(axis=1).min() < NEAR_NORMAL)
    ):
        raise DoesNotApply


def carried(old: Grasp, force: ContactForces, new: Grasp, objective: Objective) -> ContactForces:
    """A force of the grasp before in the contact frames of a new grasp.

    Each contact takes the force of the nearest old one within 20 mm, as a vector in the object frame. A finger that was not there
    gets its own optimum of no load, u = sqrt(lambda / omega): strictly inside its cone, unlike no force.

    Args:
        old: the contacts of `force`.
        force: (N, 3) [N].
        new: the contacts that the force is carried to.
        objective: Phi.
    """
    if old is new:
        return force
    vectors, weights = old.to_object_frame(force), objective.weights(new.n_contacts)
    apart = np.linalg.norm(new.positions[:, None] - old.positions, axis=2)
    out = np.zeros((new.n_contacts, 3))
    out[:, 0] = np.sqrt(weights[:, 1] / weights[:, 0]) / new.friction
    for _ in range(min(apart.shape)):
        here, there = np.unravel_index(int(apart.argmin()), apart.shape)
        if apart[here, there] > NEAR_PLACE:
            break
        out[here] = new.frames[here].T @ vectors[there]
        apart[here], apart[:, there] = np.inf, np.inf
    return out

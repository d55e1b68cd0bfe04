"""Starts of the comparison: label, colour and maker of each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from grasp_env.core import record_size
from grasp_env.force import (
    ForceOptimizer,
    ForceSolution,
    Objective,
    OfflineBasis,
    optimize_force,
    optimize_forces,
)
from grasp_env.force.initial import CompiledRule, InitialForceRule, call_rule
from grasp_env.force.record import CONTACTS, FORCE
from grasp_env.force.repair import Correction, carry_over
from grasp_env.force.rules import RULES, CoreRule, initial_rule
from grasp_env.force.solution import Names
from grasp_env.grasp import Grasp, presets, wrench
from grasp_env.inputs.arguments import Array, ContactForces, Wrench
from policies import LearnedInitialForce
from training.evaluation.compare.cases import HELD_OUT, scaled

Start = Callable[[Grasp, Wrench, "ContactForces | None"], ContactForces]
"""Function (grasp, wrench, previous optimum in contact frames or None) -> force (N, 3) [N]."""

BASIS = "linear_combination"
"""Start of the paper, with which the others are compared."""
STORED = 10_000
STORED_RANGE = (0.1, 20.0)
"""Range of magnitudes of the stored solutions [N], as in the training of the shipped model."""
KEPT = 0.95
"""Share of the way to the cones that is kept of a network's force outside them."""
NEAR_DISTANCE, NEAR_NORMAL = 0.02, 0.95
"""Largest distance [m], and least cosine between normals, of contacts near the fixed grasp."""
_FIXED = presets.paper_cuboid()


class DoesNotApply(Exception):
    """Raised by a start that does not apply to this grasp, or needs a previous solution.

    The case is skipped.
    """


@dataclass(frozen=True)
class ComparedStart:
    """Start that is ready for use.

    Attributes:
        start: function for the trials.
        options: options of a `ForceOptimizer` with this start, for the timing; none: the optimizer
            gets the force.
        compiled: True if the core computes it from the wrench alone.
    """

    start: Start
    options: dict[str, Any]
    compiled: bool = False

    @classmethod
    def of(
        cls, rule: InitialForceRule, timed: str | InitialForceRule | None = None
    ) -> ComparedStart:
        """Make the start of a rule without memory; `timed` replaces the rule in timings."""
        return cls(
            lambda grasp, load, before: rule(grasp, load),
            {"initial": timed or rule},
            timed is not None,
        )


class StartContext:
    """Maker of starts for one Phi; `given` are a user's rules and saved models by name."""

    def __init__(
        self, objective: Objective, given: Mapping[str, InitialForceRule] | None = None
    ) -> None:
        self.objective = objective
        self.given = dict(given or {})

    @cached_property
    def model(self) -> LearnedInitialForce:
        """Shipped model."""
        return LearnedInitialForce.pretrained()

    @cached_property
    def stored(self) -> tuple[Array, KDTree]:
        """Optimal forces (n, N, 3) of the fixed grasp, and a tree of their wrenches."""
        rng = np.random.default_rng([HELD_OUT, 1 << 20])
        loads = wrench.sample_magnitudes(rng, STORED, *STORED_RANGE)
        forces = optimize_forces(_FIXED, loads, workers=1, **vars(self.objective)).force
        return forces, KDTree(scaled(loads))

    def all_starts(self) -> dict[str, ComparedStart]:
        """Make every start of `STARTS`, then the package's other rules, then those of the user."""
        starts = {
            key: entry.make(self) if entry.make else self.by_name(key)
            for key, entry in STARTS.items()
        }
        rules = {key: rule.make(self.objective) for key, rule in RULES.items() if key not in starts}
        return starts | {key: self.rule(rule) for key, rule in {**rules, **self.given}.items()}

    def by_name(self, name: str) -> ComparedStart:
        """Make a start that optimizers know by name."""
        rule = (
            initial_rule(name, self.objective) if name in RULES else CoreRule(name, self.objective)
        )
        return ComparedStart.of(rule, name)

    def previous(self, correction: Correction) -> ComparedStart:
        """Make the previous solution, corrected as optimizers do ("tangent") or least."""

        def start(grasp: Grasp, load: Wrench, before: ContactForces | None) -> ContactForces:
            if before is None:
                raise DoesNotApply
            if correction == "tangent":
                return self._after(grasp, load, before, "previous")
            return carry_over(grasp, load, before, self.objective, correction)

        return ComparedStart(start, {"initial": "previous"} if correction == "tangent" else {})

    def _after(
        self, grasp: Grasp, load: Wrench, before: ContactForces, initial: str | InitialForceRule
    ) -> ContactForces:
        """Return the start of an optimizer that has solved before, or the paper's."""
        optimizer = ForceOptimizer(
            grasp, method="reduced_flow", initial=initial, **vars(self.objective)
        )
        optimizer.previous = as_solution(grasp, before)
        return optimizer.start(load)

    def nearest(self, correction: Correction) -> ComparedStart:
        """Make the corrected stored solution of the nearest wrench, near the fixed grasp."""

        def rule(grasp: Grasp, load: Wrench) -> ContactForces:
            require_near_fixed(grasp)
            forces, tree = self.stored
            nearest = forces[int(tree.query(scaled(load))[1])]
            return carry_over(grasp, load, nearest, self.objective, correction)

        return ComparedStart.of(rule)

    def stepped(self, rule: InitialForceRule | str, steps: int) -> ComparedStart:
        """Make another start followed by a few Newton steps, as a control for learned starts.

        One such step equals the tangent correction of a previous optimum.
        """
        first = initial_rule(rule, self.objective) if isinstance(rule, str) else rule

        def start(grasp: Grasp, load: Wrench) -> ContactForces:
            options = {"initial": first(grasp, load), "max_iterations": steps, "tolerance": 1e-12}
            return optimize_force(grasp, load, **options, **vars(self.objective)).force

        return ComparedStart.of(start)

    @property
    def network(self) -> InitialForceRule:
        """Network of the shipped model without any step, on the fixed grasp and near it."""
        alone = NetworkAlone(self.model)

        def rule(grasp: Grasp, load: Wrench) -> ContactForces:
            require_near_fixed(grasp)
            return alone(grasp, load)

        return rule

    def remembering_model(self) -> ComparedStart:
        """Make the shipped model that starts from the previous solution if that has less Phi."""
        return self.rule(type(self.model)(self.model.checkpoint, self.model.objective, True))

    def rule(self, rule: InitialForceRule) -> ComparedStart:
        """Make the start of a saved model, on grasps it supports, or of any rule."""
        remembers = isinstance(rule, CompiledRule) and rule.remembers

        def start(grasp: Grasp, load: Wrench, before: ContactForces | None) -> ContactForces:
            if isinstance(rule, LearnedInitialForce):
                require_near_fixed(grasp)
            if before is None or not remembers:
                return call_rule(rule, rule, grasp, load.copy())
            return self._after(grasp, load, before, rule)

        return ComparedStart(
            start, {"initial": rule}, isinstance(rule, CompiledRule) and not remembers
        )


@dataclass(frozen=True)
class StartEntry:
    """Description of a start.

    Attributes:
        label: name in tables.
        short: name in charts.
        colour: unique colour of its line.
        make: makes the start; None: its key is a name that optimizers know.
        main: True if charts of a few starts show it.
        dashed: True if its line is dashed.
    """

    label: str
    short: str
    colour: str
    make: Callable[[StartContext], ComparedStart] | None = None
    main: bool = False
    dashed: bool = False


STARTS: dict[str, StartEntry] = {
    "single_value": StartEntry("single value", "single value", "#8a8a8b"),
    "phase_one": StartEntry(
        "phase one, any force inside",
        "phase one",
        "#8a9a22",
        lambda context: ComparedStart.of(initial_rule("phase_one", context.objective)),
    ),
    "lagrange": StartEntry("Lagrange", "Lagrange", "#b3852d"),
    "linear_combination_printed": StartEntry(
        "12-basis, as printed", "12-basis, printed", "#5fa7e9", dashed=True
    ),
    "internal_force": StartEntry(
        "one internal force (Newton's own)", "internal force", "#6b6b3f", main=True
    ),
    BASIS: StartEntry("12-basis (the paper, fixed at w = 0)", "12-basis", "#2f7fd8", main=True),
    "basis_tangent": StartEntry(
        "12-basis, one Newton correction",
        "12-basis + Newton",
        "#1e9ca6",
        lambda context: context.stepped(BASIS, 1),
    ),
    "basis_newton_2": StartEntry(
        "12-basis, two Newton corrections",
        "12-basis + 2 Newton",
        "#1a9b7c",
        lambda context: context.stepped(BASIS, 2),
    ),
    "basis_newton": StartEntry(
        "12-basis, four Newton corrections",
        "12-basis + 4 Newton",
        "#5a72ca",
        lambda context: context.stepped(BASIS, 4),
        main=True,
    ),
    "previous_pseudoinverse": StartEntry(
        "previous solution, G^+",
        "previous, G^+",
        "#74b374",
        lambda context: context.previous("pseudoinverse"),
        dashed=True,
    ),
    "previous_tangent": StartEntry(
        "previous solution, tangent",
        "previous, tangent",
        "#2e9a4e",
        lambda context: context.previous("tangent"),
        main=True,
    ),
    "nearest_pseudoinverse": StartEntry(
        "nearest of 10,000 stored, G^+",
        "nearest, G^+",
        "#a293d4",
        lambda context: context.nearest("pseudoinverse"),
        dashed=True,
    ),
    "nearest_tangent": StartEntry(
        "nearest of 10,000 stored, tangent",
        "nearest, tangent",
        "#8a5fc0",
        lambda context: context.nearest("tangent"),
        main=True,
    ),
    "network": StartEntry(
        "network alone, fixed grasp",
        "network alone",
        "#b36cd0",
        lambda context: ComparedStart.of(context.network),
        main=True,
    ),
    "network_newton_1": StartEntry(
        "network, one Newton step",
        "network + Newton",
        "#c069af",
        lambda context: context.stepped(context.network, 1),
    ),
    "network_newton_2": StartEntry(
        "network, two Newton steps",
        "network + 2 Newton",
        "#8a4faa",
        lambda context: context.stepped(context.network, 2),
    ),
    "learned_fixed": StartEntry(
        "learned, fixed grasp",
        "learned, fixed",
        "#e0463e",
        lambda context: context.rule(context.model),
        main=True,
    ),
    "learned_previous": StartEntry(
        "learned, with the previous solution",
        "learned + previous",
        "#e2489a",
        lambda context: context.remembering_model(),
        main=True,
        dashed=True,
    ),
}
"""All starts, in the order of the tables."""
GIVEN_COLOURS = (
    "#aa7454",
    "#208dbc",
    "#c8528e",
    "#6b8b20",
    "#7c64e4",
    "#20908b",
    "#bc6a20",
    "#7f7f20",
)
"""Colours of a user's starts, in turn; a run compares no more starts than colours."""


def start_info(key: str) -> StartEntry:
    """Return the description of a start; that of a user's start is made from its name.

    Example:
        >>> start_info("lagrange").label, start_info("my_rule").label, start_info("my_rule").main
        ('Lagrange', 'my rule', True)
    """
    if key in STARTS:
        return STARTS[key]
    name = RULES[key].label if key in RULES else key.replace("_", " ")
    return StartEntry(name, name, GIVEN_COLOURS[0], main=True, dashed=True)


def as_solution(grasp: Grasp, force: ContactForces) -> ForceSolution:
    """Return a force (N, 3) as a previous solution; starts read only the force and the frames."""
    unknown = np.full(len(force), np.nan)  # share of the friction
    head = np.zeros(record_size(len(force)))
    record = np.concatenate([head, grasp.frames.reshape(-1), unknown])
    record[CONTACTS] = len(force)
    record[FORCE : FORCE + force.size] = force.reshape(-1)
    return ForceSolution(record, Names("carried", "previous"))


class NetworkAlone:
    """Start rule: a network's force without any step, moved towards the 12-basis into the cones."""

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
            if grasp.cone_margin(safe + middle * (raw - safe)) > 0.0:
                inside = middle
            else:
                outside = middle
        return safe + KEPT * inside * (raw - safe)


def require_near_fixed(grasp: Grasp) -> None:
    """Raise `DoesNotApply` unless the contacts are near those of `presets.paper_cuboid()`."""
    if (
        grasp.n_contacts != _FIXED.n_contacts
        or bool(np.abs(grasp.positions - _FIXED.positions).max() > NEAR_DISTANCE)
        or bool((grasp.normals * _FIXED.normals).sum(axis=1).min() < NEAR_NORMAL)
    ):
        raise DoesNotApply


def carry_force(
    old: Grasp, force: ContactForces, new: Grasp, objective: Objective
) -> ContactForces:
    """Carry a force of one grasp over to the contact frames of another.

    Each contact takes the force (N, 3) [N] of the nearest old contact within 20 mm, as a vector in
    the object frame. A new finger gets its optimum without load, u = sqrt(lambda / omega).
    """
    if old is new:
        return force
    vectors = old.to_object_frame(force)
    weights = objective.weights(new.n_contacts)
    distances = np.linalg.norm(new.positions[:, None] - old.positions, axis=2)
    out = np.zeros((new.n_contacts, 3))
    out[:, 0] = np.sqrt(weights[:, 1] / weights[:, 0]) / new.friction
    for _ in range(min(distances.shape)):
        i, j = np.unravel_index(int(distances.argmin()), distances.shape)
        if distances[i, j] > NEAR_DISTANCE:
            break
        out[i] = new.frames[i].T @ vectors[j]
        distances[i] = distances[:, j] = np.inf
    return out

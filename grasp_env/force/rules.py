"""The start rules by name: those of the paper and its relatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from grasp_env._check import ContactForces, Wrench, choice
from grasp_env.errors import InfeasibleStartError
from grasp_env.force.feasibility import phase_one
from grasp_env.force.initial import InitialForceRule, LinearCombination
from grasp_env.force.objective import Objective, as_objective
from grasp_env.force.optimizer import ForceOptimizer
from grasp_env.grasp.grasp import Grasp


@dataclass(frozen=True)
class SingleValue:
    """f_0 = -G^+ w + k f_rest, k = max(1.1 k_min, 1): the singular-value start (our definition: the paper gives none).

    k_min is the least factor that is strictly feasible, f_rest the optimum at w = 0. The floor of 1 matters only for small
    wrenches, where k_min vanishes and -G^+ w + 1.1 k_min f_rest would have a singular P.

    Attributes:
        objective: the Phi whose optimum at w = 0 it squeezes with.

    Example:
        >>> from grasp_env.grasp import presets
        >>> grasp = presets.paper_cuboid()
        >>> grasp.cone_margin(SingleValue()(grasp, [1, 0.5, -0.6, -0.1, 0.2, 0])) > 0
        True
    """

    objective: Objective = field(default_factory=Objective)

    def __call__(self, grasp: Grasp, wrench: Wrench) -> ContactForces:
        """The start (N, 3) [N]; see the class."""
        return _of_core("single_value", grasp, wrench, self.objective)


@dataclass(frozen=True)
class Lagrange:
    """argmin (f - k n)^T W (f - k n) s.t. G f = -w by multipliers, W = diag(1, 10, 10) (our definition).

    n are the unit normal forces. The solution is affine in k, so the strictly feasible k form an interval, found in
    closed form: k = max(1.1 k_min, the normal force of f_rest), at most the middle of the interval.

    Attributes:
        objective: the Phi whose optimum at w = 0 is f_rest.

    Raises:
        InfeasibleStartError: no k is strictly feasible, which happens on many grasps.

    Example:
        >>> from grasp_env.grasp import presets
        >>> grasp = presets.paper_cuboid()
        >>> grasp.cone_margin(Lagrange()(grasp, [1, 0.5, -0.6, -0.1, 0.2, 0])) > 0
        True
    """

    objective: Objective = field(default_factory=Objective)

    def __call__(self, grasp: Grasp, wrench: Wrench) -> ContactForces:
        """The start (N, 3) [N]; see the class."""
        return _of_core("lagrange", grasp, wrench, self.objective)


@dataclass(frozen=True)
class PhaseOne:
    """The force deepest inside the cones, from an interior-point phase one: slow, needs no force closure.

    Attributes:
        objective: not used; every rule has one.

    Example:
        >>> from grasp_env.grasp import presets
        >>> grasp = presets.paper_cuboid()
        >>> grasp.cone_margin(PhaseOne()(grasp, [1, 0.5, -0.6, -0.1, 0.2, 0])) > 0
        True
    """

    objective: Objective = field(default_factory=Objective)

    def __call__(self, grasp: Grasp, wrench: Wrench) -> ContactForces:
        """The start (N, 3) [N]; see the class."""
        answer = phase_one(grasp, wrench)
        if answer.force is None:
            raise InfeasibleStartError("no force strictly inside the cones balances the wrench")
        return answer.force


def _of_core(name: str, grasp: Grasp, wrench: Wrench, objective: Objective) -> ContactForces:
    """A start that the core makes, where it was not replaced.

    Raises:
        InfeasibleStartError: it has none here.
    """
    objective = as_objective(objective)
    optimizer = ForceOptimizer(grasp, force_weight=objective.force_weight, barrier_weight=objective.barrier_weight)
    force, replaced = optimizer._begin(wrench, initial=name)
    if replaced:
        raise InfeasibleStartError(
            f"the start {name!r} has no force strictly inside the friction cones for this grasp and wrench; "
            "use initial='linear_combination'"
        )
    return force


@dataclass(frozen=True)
class StartRule:
    """An entry of `RULES`: makes the rule for a Phi.

    Attributes:
        label: for people.
        make: Objective -> the rule.
        needs: what the grasp must have: "closure" for the 12-basis, "wrench" where a force for the wrench is enough.
    """

    label: str
    make: Callable[[Objective], InitialForceRule] = field(repr=False)
    needs: str = "closure"

    def __call__(self, objective: Objective) -> InitialForceRule:
        """The rule for that Phi."""
        return self.make(objective)


RULES: dict[str, StartRule] = {
    "linear_combination": StartRule("12-basis (the paper, fixed at w = 0)", LinearCombination),
    "linear_combination_printed": StartRule(
        "12-basis, as printed", lambda objective: LinearCombination(objective, printed=True)
    ),
    "single_value": StartRule("single value", SingleValue),
    "lagrange": StartRule("Lagrange", Lagrange),
    "phase_one": StartRule("phase one, the deepest force", PhaseOne, needs="wrench"),
}
"""The start rules by name; "previous" lives in `ForceOptimizer`, which remembers."""


def initial_rule(name: str, objective: Objective | None = None) -> InitialForceRule:
    """The rule of that name for the given Phi.

    Args:
        name: a key of `RULES`.
        objective: Phi; None: the defaults.

    Raises:
        UnknownNameError: no rule of that name.

    Example:
        >>> initial_rule("single_value")
        SingleValue(objective=Objective(force_weight=1.0, barrier_weight=0.01))
        >>> initial_rule("newest")
        Traceback (most recent call last):
        grasp_env.errors.UnknownNameError: unknown initial-force rule 'newest': choose one of 'linear_combination', \
'linear_combination_printed', 'single_value', 'lagrange', 'phase_one'
    """
    return RULES[choice(name, "initial-force rule", RULES)](as_objective(objective))

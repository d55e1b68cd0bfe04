"""The start rules by name: those of the paper and its relatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

from grasp_env._check import ContactForces, Wrench, choice
from grasp_env.errors import InfeasibleStartError, InfeasibleWrenchError
from grasp_env.force.initial import InitialForceRule, LinearCombination
from grasp_env.force.objective import Objective, as_objective
from grasp_env.force.optimizer import ForceOptimizer
from grasp_env.grasp.grasp import Grasp


@dataclass(frozen=True)
class CoreStart:
    """A start that the core makes, as a rule.

    Attributes:
        name: "single_value": f_0 = -G^+ w + k f_rest, k = max(1.1 k_min, 1), f_rest the optimum at w = 0 and k_min the least factor
            that is strictly feasible (our definition: the paper gives none). The floor of 1 matters for small wrenches only, where
            k_min vanishes and P would be singular. "lagrange": argmin (f - k n)^T W (f - k n) s.t. G f = -w by multipliers,
            W = diag(1, 10, 10), n the unit normal forces (our definition). The solution is affine in k, so the strictly feasible k
            form an interval: k = max(1.1 k_min, the normal force of f_rest), at most its middle; many grasps have none.
            "phase_one": a force inside the cones found by an interior point, which needs no force closure.
        objective: Phi.

    Example:
        >>> from grasp_env.grasp import presets
        >>> grasp = presets.paper_cuboid()
        >>> grasp.cone_margin(CoreStart("single_value")(grasp, [1, 0.5, -0.6, -0.1, 0.2, 0])) > 0
        True
    """

    name: str
    objective: Objective = field(default_factory=Objective)

    def __call__(self, grasp: Grasp, wrench: Wrench) -> ContactForces:
        """The start (N, 3) [N].

        Raises:
            InfeasibleStartError: there is none here.
        """
        phi = as_objective(self.objective)
        optimizer = ForceOptimizer(grasp, force_weight=phi.force_weight, barrier_weight=phi.barrier_weight)
        try:
            force, replaced = optimizer._begin(wrench, initial=self.name)
        except InfeasibleWrenchError:
            raise InfeasibleStartError("no force strictly inside the cones balances the wrench") from None
        if replaced:
            raise InfeasibleStartError(
                f"the start {self.name!r} has no force strictly inside the friction cones for this grasp and wrench; "
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
    "single_value": StartRule("single value", partial(CoreStart, "single_value")),
    "lagrange": StartRule("Lagrange", partial(CoreStart, "lagrange")),
    "phase_one": StartRule("phase one, any force inside", partial(CoreStart, "phase_one"), needs="wrench"),
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
        CoreStart(name='single_value', objective=Objective(force_weight=1.0, barrier_weight=0.01))
        >>> initial_rule("newest")
        Traceback (most recent call last):
        grasp_env.errors.UnknownNameError: unknown initial-force rule 'newest': choose one of 'linear_combination', \
'linear_combination_printed', 'single_value', 'lagrange', 'phase_one'
    """
    return RULES[choice(name, "initial-force rule", RULES)](as_objective(objective))

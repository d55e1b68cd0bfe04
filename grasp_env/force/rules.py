"""The start rules by name: the paper's and related ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

from grasp_env.errors import InfeasibleStartError, InfeasibleWrenchError
from grasp_env.force.initial import InitialForceRule, LinearCombination
from grasp_env.force.objective import Objective, as_objective
from grasp_env.force.optimizer import ForceOptimizer
from grasp_env.grasp.grasp import Grasp
from grasp_env.inputs.arguments import ContactForces, Wrench, choice


@dataclass(frozen=True)
class CoreRule:
    """A start of the core, as a rule.

    The paper names the single-value and the Lagrange start without defining them; the definitions
    here are ours.

    - "single_value": f_0 = -G^+ w + k f_rest with k = max(1.1 k_min, 1), where f_rest is the
      optimum at w = 0 and k_min the least strictly feasible factor, which vanishes with w.
    - "lagrange": argmin (f - k n)^T W (f - k n) s.t. G f = -w, with W = diag(1, 10, 10) and n the
      unit normal forces. The strictly feasible k form an interval, for many grasps an empty one.
      k = max(1.1 k_min, the mean normal force of f_rest), but at most the middle of the interval.
    - "phase_one": a force inside the cones, found by an interior-point method; it needs no force
      closure.

    Attributes:
        name: one of these names, or another name in `STARTS`.
        objective: Phi.

    Example:
        >>> from grasp_env.grasp import presets
        >>> grasp = presets.paper_cuboid()
        >>> grasp.cone_margin(CoreRule("single_value")(grasp, [1, 0.5, -0.6, -0.1, 0.2, 0])) > 0
        True
    """

    name: str
    objective: Objective = field(default_factory=Objective)

    def __call__(self, grasp: Grasp, wrench: Wrench) -> ContactForces:
        """Return the start (N, 3) [N], or raise an `InfeasibleStartError`."""
        phi = as_objective(self.objective)
        optimizer = ForceOptimizer(
            grasp, force_weight=phi.force_weight, barrier_weight=phi.barrier_weight
        )
        try:
            force, replaced = optimizer._start_and_replaced(wrench, self.name)
        except InfeasibleWrenchError:
            raise InfeasibleStartError(
                "no force strictly inside the cones balances the wrench"
            ) from None
        if replaced:
            raise InfeasibleStartError(
                f"the start {self.name!r} has no force strictly inside the friction cones for this grasp and wrench; "
                "use initial='linear_combination'"
            )
        return force


@dataclass(frozen=True)
class RuleEntry:
    """An entry of `RULES`: a label for reports, and a function objective -> rule."""

    label: str
    make: Callable[[Objective], InitialForceRule] = field(repr=False)


RULES: dict[str, RuleEntry] = {
    "linear_combination": RuleEntry("12-basis (the paper, fixed at w = 0)", LinearCombination),
    "linear_combination_printed": RuleEntry(
        "12-basis, as printed", partial(LinearCombination, printed=True)
    ),
    "single_value": RuleEntry("single value", partial(CoreRule, "single_value")),
    "lagrange": RuleEntry("Lagrange", partial(CoreRule, "lagrange")),
    "phase_one": RuleEntry("phase one, any force inside", partial(CoreRule, "phase_one")),
}
"""Start rules by name.

"previous" is not among them: `ForceOptimizer` stores the previous solution."""


def initial_rule(name: str, objective: Objective | None = None) -> InitialForceRule:
    """Return a rule of `RULES` for a Phi (None: the defaults).

    Example:
        >>> initial_rule("single_value")
        CoreRule(name='single_value', objective=Objective(force_weight=1.0, barrier_weight=0.01))
    """
    return RULES[choice(name, "initial-force rule", RULES)].make(as_objective(objective))

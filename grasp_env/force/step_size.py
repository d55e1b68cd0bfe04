"""Step rules of the flows: Phi decreases, and every force stays inside its friction cone.

The paper only asks that alpha_k "guarantee the convergence of the objective function". Every rule
here accepts only points strictly inside the cones with a smaller Phi, and shrinks the step until it
finds one. After a hundred trials of one iteration the step shrinks by at least a half, so every
search ends. The core implements the rules (`flow.hpp`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from grasp_env.errors import InvalidInputError, shown
from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import AllFaults, Array, choice, positive
from grasp_env.inputs.ranges import Range

FIXED, ARMIJO, ADAPTIVE, BARZILAI_BORWEIN, EXACT = range(5)
"""Kinds of rules."""
VARIANTS = ("alternate", "long", "short")
_FRACTION = Range(1e-300, 1.0 - 2.0**-53, "(less than 1)")
_RANGES = {
    "size": ranges.STEP,
    "first": ranges.STEP,
    "grow": Range(1.0, 1e6),
    "shrink": ranges.SHRINK,
    "slope": _FRACTION,
    "precision": _FRACTION,
}


class StepRule(Protocol):
    """The interface of a step rule."""

    def parameters(self) -> Array:
        """Return (5,) kind, first, grow, shrink, decrease for the core."""
        ...


@dataclass(frozen=True)
class _Checked:
    """Base class of the rules: each number lies in its range of `_RANGES`."""

    def __post_init__(self) -> None:
        with AllFaults() as check:
            for name, value in list(vars(self).items()):
                checked = (
                    check(choice, value, name, VARIANTS)
                    if name == "variant"
                    else check(positive, value, name, _RANGES[name])
                )
                object.__setattr__(self, name, checked)


@dataclass(frozen=True)
class FixedStep(_Checked):
    """Constant step, halved within an iteration if it is not accepted.

    Attributes:
        size: alpha [N / force_weight], 1e-15 to 1e12.

    Example:
        >>> from grasp_env.force import optimize_force
        >>> from grasp_env.grasp import presets
        >>> flow = {"method": "reduced_flow", "step_rule": FixedStep(0.05)}
        >>> optimize_force(presets.tripod(), [1, 0, 0, 0, 0, 0], **flow).status.name
        'OPTIMAL'
        >>> FixedStep(0.0)
        Traceback (most recent call last):
        grasp_env.errors.InvalidInputError: size must be a number > 0, got 0.0
    """

    size: float

    def parameters(self) -> Array:
        """See `StepRule`."""
        return np.array([FIXED, self.size, 1.0, 0.5, 0.0])


@dataclass(frozen=True)
class ArmijoStep(_Checked):
    """Backtracking with sufficient decrease (Armijo 1966).

    Attributes:
        first: first trial step of every iteration [N / force_weight].
        shrink: factor, 0.001 to 0.999, after a rejected step.
        slope: fraction in (0, 1) of the predicted decrease alpha |d|^2 that Phi must reach.
    """

    first: float = 0.3
    shrink: float = 0.5
    slope: float = 1e-4

    def parameters(self) -> Array:
        """See `StepRule`."""
        return np.array([ARMIJO, self.first, 1.0, self.shrink, self.slope])


@dataclass(frozen=True)
class AdaptiveStep(_Checked):
    """Accept the first of alpha, alpha * shrink, ..., then multiply alpha by `grow`.

    Attributes:
        first: first trial step of every solve [N / force_weight].
        grow: factor in [1, 1e6) after an accepted step.
        shrink: factor, 0.001 to 0.999, after a rejected step.

    Example:
        >>> from grasp_env.force import ForceOptimizer
        >>> from grasp_env.grasp import presets
        >>> ForceOptimizer(presets.tripod(), method="reduced_flow").step_rule       # the default
        AdaptiveStep(first=0.3, grow=1.5, shrink=0.5)
    """

    first: float = 0.3
    grow: float = 1.5
    shrink: float = 0.5

    def parameters(self) -> Array:
        """See `StepRule`."""
        return np.array([ADAPTIVE, self.first, self.grow, self.shrink, 0.0])


@dataclass(frozen=True)
class BarzilaiBorweinStep(_Checked):
    """Barzilai and Borwein (1988) in the metric of P: inverse curvature, kept monotone.

    Attributes:
        first, shrink: as in `AdaptiveStep`.
        variant: with s the previous step and y the change of the projected gradient, "long" is
            <s, s> / <s, y> and "short" <s, y> / <y, y>; "alternate" is the long one after every
            second step.

    Example:
        >>> from grasp_env.force import optimize_force
        >>> from grasp_env.grasp import presets
        >>> grasp, wrench = presets.paper_cuboid(), [1, 0.5, -0.6, -0.1, 0.2, 0]
        >>> rules = BarzilaiBorweinStep(), AdaptiveStep()
        >>> few, many = (optimize_force(grasp, wrench, method="reduced_flow", step_rule=rule) for rule in rules)
        >>> few.iterations < many.iterations
        True
    """

    first: float = 0.3
    shrink: float = 0.5
    variant: str = "short"

    def parameters(self) -> Array:
        """See `StepRule`; the index of the variant replaces `grow`."""
        return np.array(
            [BARZILAI_BORWEIN, self.first, VARIANTS.index(self.variant), self.shrink, 0.0]
        )


@dataclass(frozen=True)
class ExactStep(_Checked):
    """Exact line search by safeguarded Newton on the derivative of Phi along the ray.

    Attributes:
        precision: fraction in (0, 1) of the slope at alpha = 0 at which the search ends; 0.1 needs
            FEWER iterations than the exact minimum, whose directions zigzag.
    """

    precision: float = 1e-3

    def parameters(self) -> Array:
        """See `StepRule`."""
        return np.array([EXACT, 1.0, 1.0, 0.5, self.precision])


STEP_RULES: tuple[type[Any], ...] = (
    FixedStep,
    ArmijoStep,
    AdaptiveStep,
    BarzilaiBorweinStep,
    ExactStep,
)


def checked_rule(rule: Any) -> StepRule:
    """Return the checked rule, `AdaptiveStep()` for None."""
    if rule is None:
        return AdaptiveStep()
    if not isinstance(rule, STEP_RULES):
        names = [kind.__name__ for kind in STEP_RULES]
        raise InvalidInputError(
            f"step_rule must be None or a {', '.join(names[:-1])} or {names[-1]}, got {shown(rule)}"
        )
    return rule

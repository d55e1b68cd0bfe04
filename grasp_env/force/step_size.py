"""Step rules of the flows: how far along the direction, so that Phi decreases and every force stays inside its cone.

The paper only asks that alpha_k "guarantee the convergence of the objective function". Every rule here accepts only
points strictly inside the cones with a smaller Phi, and halves or shrinks a step until it finds one. A rule is data: the
compiled loop reads `parameters()`, the plain one (`descent.py`) calls `step`; both give the same steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from numbers import Real
from typing import Any, Protocol

import numpy as np

from grasp_env._check import Array, positive
from grasp_env.errors import InvalidInputError, UnknownNameError

FIXED, ARMIJO, ADAPTIVE, BARZILAI_BORWEIN, EXACT = range(5)
"""Kinds, the first parameter of a rule."""
SHORTEST = 1e-10
"""The first trial of an iteration moves x by at least this fraction of its length."""
MOST_TRIALS = 60
"""Of a search for the exact minimum, before it settles for any decrease."""
FLAT, LEAP = 1e-12, 10.0
"""Where <s, y> is below this share of <s, s> / alpha Phi is straight to rounding: the step grows by this factor."""


@dataclass
class Ray:
    """Phi along one step d, as a step rule sees it. Lengths are those of P: |x|^2 = sum 3 u^2 + 2 o^2 + 2 t^2.

    Attributes:
        value: Phi(x + alpha d), +inf outside the cones.
        slope: its derivative; -|d|^2 at alpha = 0.
        curvature: its second derivative.
        here: Phi(x).
        reach: |x|.
        length: |d|.
        past: (alpha, |d|^2, inner product with this d) of the step before; None at the first.
        trials: how often `value` was asked for.
    """

    value: Callable[[float], float]
    slope: Callable[[float], float]
    curvature: Callable[[float], float]
    here: float
    reach: float
    length: float
    past: tuple[float, float, float] | None
    count: int = 0
    trials: int = 0

    def lifted(self, alpha: float) -> float:
        """A step far shorter than x, left from a start near the apex, grows from here instead of stalling."""
        return max(alpha, SHORTEST * self.reach / self.length) if self.length > 0.0 else alpha

    def backtrack(self, alpha: float, shrink: float, decrease: float = 0.0) -> float | None:
        """The first of alpha, alpha * shrink, ... with Phi < Phi(x) - decrease alpha |d|^2; None: rounding ends it."""
        while alpha * self.length > 1e-16 * self.reach:
            self.trials += 1
            trial = self.value(alpha)
            if trial < self.here and trial <= self.here - decrease * alpha * self.length**2:
                return alpha
            alpha *= shrink
        return None


class StepRule(Protocol):
    """What a flow asks of a step rule."""

    def parameters(self) -> Array:
        """(5,) kind, first, grow, shrink, decrease: what the compiled loop reads."""
        ...

    def step(self, ray: Ray) -> float | None:
        """The accepted step along a ray; None when none decreases Phi in floating point."""
        ...


@dataclass(frozen=True)
class FixedStep:
    """Always the same step; halved, for one iteration, where it leaves a cone or does not decrease Phi.

    Attributes:
        size: alpha [N / force_weight].

    Example:
        >>> FixedStep(0.0)
        Traceback (most recent call last):
        grasp_env.errors.InvalidInputError: size must be finite and > 0, got 0.0
    """

    size: float

    def __post_init__(self) -> None:
        positive(self.size, "size")

    def parameters(self) -> Array:
        """See `StepRule`."""
        return np.array([FIXED, self.size, 1.0, 0.5, 0.0])

    def step(self, ray: Ray) -> float | None:
        """See `StepRule`."""
        return ray.backtrack(ray.lifted(self.size), 0.5)


@dataclass(frozen=True)
class ArmijoStep:
    """Backtracking with sufficient decrease (Armijo 1966): Phi falls by `slope` of what its derivative promises.

    Attributes:
        first: the first trial step of every iteration [N / force_weight].
        shrink: factor in (0, 1) after a rejected one.
        slope: share of alpha |d|^2 in (0, 1) by which Phi has to fall.
    """

    first: float = 0.3
    shrink: float = 0.5
    slope: float = 1e-4

    def __post_init__(self) -> None:
        positive(self.first, "first")
        _share("shrink", self.shrink)
        _share("slope", self.slope)

    def parameters(self) -> Array:
        """See `StepRule`."""
        return np.array([ARMIJO, self.first, 1.0, self.shrink, self.slope])

    def step(self, ray: Ray) -> float | None:
        """See `StepRule`."""
        return ray.backtrack(ray.lifted(self.first), self.shrink, self.slope)


@dataclass(frozen=True)
class AdaptiveStep:
    """Accept the first alpha, alpha * shrink, ... that decreases Phi inside the cones; then alpha *= grow.

    Attributes:
        first: the first trial step of every solve [N / force_weight].
        grow: factor >= 1 after an accepted step.
        shrink: factor in (0, 1) after a rejected one.
    """

    first: float = 0.3
    grow: float = 1.5
    shrink: float = 0.5

    def __post_init__(self) -> None:
        positive(self.first, "first")
        if not (isinstance(self.grow, Real) and 1.0 <= self.grow < 1e6):
            raise InvalidInputError(f"grow must be a finite factor >= 1, got {self.grow!r}")
        _share("shrink", self.shrink)

    def parameters(self) -> Array:
        """See `StepRule`."""
        return np.array([ADAPTIVE, self.first, self.grow, self.shrink, 0.0])

    def step(self, ray: Ray) -> float | None:
        """See `StepRule`."""
        alpha = self.first if ray.past is None else ray.past[0] * self.grow
        return ray.backtrack(ray.lifted(alpha), self.shrink)


VARIANTS = ("alternate", "long", "short")


@dataclass(frozen=True)
class BarzilaiBorweinStep:
    """Barzilai and Borwein (1988) in the metric of P: the inverse curvature seen along the step before, kept monotone.

    With s the step before and y the change of the projected gradient: "long" is <s, s> / <s, y>, "short" <s, y> / <y, y>,
    "alternate" the long one after every second step. The first iteration tries `first`.

    Attributes:
        first: the first trial step of every solve [N / force_weight].
        shrink: factor in (0, 1) after a step that left a cone or did not decrease Phi.
        variant: "alternate", "long" or "short".
    """

    first: float = 0.3
    shrink: float = 0.5
    variant: str = "short"

    def __post_init__(self) -> None:
        positive(self.first, "first")
        _share("shrink", self.shrink)
        if self.variant not in VARIANTS:
            raise UnknownNameError("variant", self.variant, VARIANTS)

    def parameters(self) -> Array:
        """See `StepRule`; the variant's number takes the place of `grow`."""
        return np.array([BARZILAI_BORWEIN, self.first, VARIANTS.index(self.variant), self.shrink, 0.0])

    def step(self, ray: Ray) -> float | None:
        """See `StepRule`."""
        alpha = self.first
        if ray.past is not None:
            alpha, squared, mixed = ray.past
            s_y, y_y = squared - mixed, (squared - mixed) + (ray.length**2 - mixed)
            if s_y > FLAT * squared and y_y > 0.0:
                long = self.variant == "long" or (self.variant == "alternate" and ray.count % 2 == 0)
                alpha *= squared / s_y if long else s_y / y_y
            else:
                alpha *= LEAP
        return ray.backtrack(ray.lifted(alpha), self.shrink)


@dataclass(frozen=True)
class ExactStep:
    """Exact line search: Phi along a ray is a rational sum per contact; Newton on its derivative, kept in a bracket.

    Attributes:
        precision: in (0, 1): the search ends where the slope has fallen to this share of the one at alpha = 0. A tenth
            takes FEWER iterations of the flow than the exact minimum, whose directions zigzag.
    """

    precision: float = 1e-3

    def __post_init__(self) -> None:
        _share("precision", self.precision)

    def parameters(self) -> Array:
        """See `StepRule`."""
        return np.array([EXACT, 1.0, 1.0, 0.5, self.precision])

    def step(self, ray: Ray) -> float | None:
        """See `StepRule`."""
        start, squared = ray.curvature(0.0), ray.length**2
        alpha = ray.lifted(squared / start if start > 0.0 else 1.0)
        low, high = 0.0, float("inf")
        for _ in range(MOST_TRIALS):
            ray.trials += 1
            trial = ray.value(alpha)
            guess = -1.0
            slope = float("inf")
            if trial < float("inf"):
                slope = ray.slope(alpha)
                if abs(slope) <= self.precision * squared:
                    break
                guess = alpha - slope / ray.curvature(alpha)
            if slope < 0.0:
                low = alpha
            else:
                high = alpha
            if not low < guess < high:
                guess = 0.5 * (low + high) if high < float("inf") else 2.0 * alpha
            alpha = guess
        else:
            trial = float("inf")
        return alpha if trial < ray.here else ray.backtrack(alpha, 0.5)


STEP_RULES: tuple[type[Any], ...] = (FixedStep, ArmijoStep, AdaptiveStep, BarzilaiBorweinStep, ExactStep)


def checked_rule(rule: Any) -> StepRule:
    """The rule, or AdaptiveStep() for None.

    Raises:
        InvalidInputError: anything else but an instance of one of the rules.

    Example:
        >>> checked_rule(0.1)
        Traceback (most recent call last):
        grasp_env.errors.InvalidInputError: step_rule must be None or a FixedStep, ArmijoStep, AdaptiveStep, BarzilaiBorweinStep or ExactStep, got 0.1
    """
    if rule is None:
        return AdaptiveStep()
    if not isinstance(rule, STEP_RULES):
        names = [each.__name__ for each in STEP_RULES]
        raise InvalidInputError(f"step_rule must be None or a {', '.join(names[:-1])} or {names[-1]}, got {rule!r}")
    return rule


def _share(name: str, value: Any) -> None:
    if not (isinstance(value, Real) and 0.0 < float(value) < 1.0):
        raise InvalidInputError(f"{name} must lie in (0, 1), got {value!r}")

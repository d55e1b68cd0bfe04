"""The plain driver of both flows (Eqs.

12 and 26): direction, step rule, stop. The core's is `flow.hpp`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from grasp_env.force.step_size import ADAPTIVE, BARZILAI_BORWEIN, EXACT, VARIANTS, StepRule

SHORTEST = 1e-10
"""The first trial of an iteration moves x by at least this fraction of its length."""
MOST_TRIALS = 60
"""Largest number of trials of the exact search before any decrease is accepted."""
FLAT, LEAP = 1e-12, 10.0
"""Share of <s, s> / alpha below which <s, y> counts as zero curvature, and the factor by which the
step then grows."""


@dataclass(frozen=True)
class Landscape:
    """Phi on the state of a flow, vec(P) for the full one, VP for the reduced one; +inf outside the
    cones.

    Besides value and gradient it has the second derivative along a move, the projected drive at a
    state, and the weights of the squares in |state|^2, which is |P|_F^2 in both.
    """

    value: Callable[[np.ndarray], float]
    gradient: Callable[[np.ndarray], np.ndarray]
    curvature: Callable[[np.ndarray, np.ndarray], float]
    direction: Callable[[np.ndarray], np.ndarray]
    metric: np.ndarray


@dataclass
class Descent:
    """Record of a descent: `values` holds Phi of every iterate, `steps` every accepted step size."""

    trials: int = 0
    values: list[float] = field(default_factory=list)
    steps: list[float] = field(default_factory=list)

    @property
    def iterations(self) -> int:
        """Accepted steps."""
        return len(self.steps)


@dataclass
class Ray:
    """Phi along one step d, as a step rule sees it.

    Lengths are those of P: |x|^2 = sum 3 u^2 + 2 o^2 + 2 t^2.

    `here` is Phi(x), `past` (alpha, |d|^2, inner product with this d) of the step before, `trials`
    the number of evaluations of Phi.
    """

    land: Landscape
    at: np.ndarray
    move: np.ndarray
    here: float
    past: tuple[float, float, float] | None
    count: int
    trials: int = 0

    def __post_init__(self) -> None:
        self.reach = float(np.sqrt(self.land.metric @ self.at**2))
        self.length = float(np.sqrt(self.land.metric @ self.move**2))

    def value(self, alpha: float) -> float:
        """Phi there; counted."""
        self.trials += 1
        return self.land.value(self.at + alpha * self.move)

    def slope(self, alpha: float) -> float:
        """Its derivative; -|d|^2 at alpha = 0."""
        return float(self.land.gradient(self.at + alpha * self.move) @ self.move)

    def curvature(self, alpha: float) -> float:
        """Its second derivative."""
        return self.land.curvature(self.at + alpha * self.move, self.move)

    def lifted(self, alpha: float) -> float:
        """A step far shorter than x, left from a start near the apex, grows from here instead of
        stalling."""
        return max(alpha, SHORTEST * self.reach / self.length) if self.length > 0.0 else alpha

    def backtrack(self, alpha: float, shrink: float, decrease: float = 0.0) -> float | None:
        """The first of alpha, alpha * shrink, ...

        with Phi < Phi(x) - decrease alpha |d|^2; None: rounding ends it.
        """
        while alpha * self.length > 1e-16 * self.reach:
            trial = self.value(alpha)
            if trial < self.here and trial <= self.here - decrease * alpha * self.length**2:
                return alpha
            alpha *= shrink
        return None


def step(rule: StepRule, ray: Ray) -> float | None:
    """The accepted step along a ray by a rule's numbers; None when none decreases Phi in floating
    point."""
    kind, first, grow, shrink, decrease = rule.parameters()
    if kind == EXACT:
        return _exact(ray, decrease)
    alpha = first
    if kind == ADAPTIVE and ray.past is not None:
        alpha = ray.past[0] * grow
    if kind == BARZILAI_BORWEIN and ray.past is not None:
        alpha, squared, mixed = ray.past
        s_y = squared - mixed
        y_y = (squared - mixed) + (ray.length**2 - mixed)
        variant = VARIANTS[int(grow)]
        if s_y > FLAT * squared and y_y > 0.0:
            long = variant == "long" or (variant == "alternate" and ray.count % 2 == 0)
            alpha *= squared / s_y if long else s_y / y_y
        else:
            alpha *= LEAP
    return ray.backtrack(ray.lifted(alpha), shrink, decrease)


def _exact(ray: Ray, precision: float) -> float | None:
    """Newton on the slope, kept in a bracket, until it is this share of the one at alpha = 0."""
    start = ray.curvature(0.0)
    squared = ray.length**2
    alpha = ray.lifted(squared / start if start > 0.0 else 1.0)
    low = 0.0
    high = float("inf")
    trial = float("inf")
    for _ in range(MOST_TRIALS):
        trial = ray.value(alpha)
        guess = -1.0
        slope = float("inf")
        if trial < float("inf"):
            slope = ray.slope(alpha)
            if abs(slope) <= precision * squared:
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


def followed(
    state: np.ndarray, landscape: Landscape, rule: StepRule, count: int
) -> tuple[Descent, list[np.ndarray]]:
    """Up to `count` steps from vec(P) or VP, strictly inside and balanced, while Phi decreases; and
    all states."""
    metric = landscape.metric
    result = Descent(values=[float(landscape.value(state))])
    states = [state]
    past: tuple[float, np.ndarray] | None = None
    while result.iterations < count:
        at = states[-1]
        move = landscape.direction(states[-1])
        before = past and (past[0], float(metric @ past[1] ** 2), float(metric @ (past[1] * move)))
        ray = Ray(landscape, at, move, result.values[-1], before, result.iterations)
        alpha = step(rule, ray)
        result.trials += ray.trials
        if alpha is None:
            break
        states.append(at + alpha * move)
        result.values.append(float(landscape.value(states[-1])))
        result.steps.append(alpha)
        past = alpha, move
    return result, states

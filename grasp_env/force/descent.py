"""The plain driver of both flows: direction, step rule, stop. The compiled loop is `flow_kernels.flow`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from grasp_env._check import Array
from grasp_env.force.record import CONVERGED, LIMIT, STALLED
from grasp_env.force.step_size import Ray, StepRule


@dataclass(frozen=True)
class Landscape:
    """Phi on the state of a flow: vec(P) for the full one, VP for the reduced one.

    Attributes:
        value: Phi at a state, +inf outside the cones.
        gradient: its gradient.
        curvature: its second derivative at a state along a move.
        direction: the projected drive at a state.
        metric: the weights of the squares in |state|^2, the same length in both: |P|_F^2.
    """

    value: Callable[[Array], float]
    gradient: Callable[[Array], Array]
    curvature: Callable[[Array, Array], float]
    direction: Callable[[Array], Array]
    metric: Array


@dataclass
class Descent:
    """How a descent went. `values` and `steps` hold Phi of every iterate and every accepted step size."""

    state: Array
    code: int = LIMIT
    trials: int = 0
    values: list[float] = field(default_factory=list)
    steps: list[float] = field(default_factory=list)

    @property
    def iterations(self) -> int:
        """Accepted steps."""
        return len(self.steps)


def descend(
    state: Array,
    landscape: Landscape,
    converged: Callable[[Array, float, int], bool],
    rule: StepRule,
    max_iterations: int,
) -> Descent:
    """State <- state + alpha * direction(state) while Phi decreases (paper, Eqs. 12 and 26).

    Args:
        state: vec(P) or VP, strictly inside the cones and balanced.
        landscape: Phi there.
        converged: whether to stop at (state, Phi, accepted steps).
        rule: the step rule.
        max_iterations: the most accepted steps.
    """
    metric = landscape.metric
    result = Descent(state.copy(), values=[landscape.value(state)])
    past: tuple[float, Array] | None = None
    while True:
        if converged(result.state, result.values[-1], result.iterations):
            result.code = CONVERGED
            return result
        if result.iterations >= max_iterations:
            return result
        at, move = result.state, landscape.direction(result.state)
        ray = Ray(
            value=lambda alpha, at=at, move=move: landscape.value(at + alpha * move),
            slope=lambda alpha, at=at, move=move: float(landscape.gradient(at + alpha * move) @ move),
            curvature=lambda alpha, at=at, move=move: landscape.curvature(at + alpha * move, move),
            here=result.values[-1],
            reach=float(np.sqrt(metric @ at**2)),
            length=float(np.sqrt(metric @ move**2)),
            past=past and (past[0], float(metric @ past[1] ** 2), float(metric @ (past[1] * move))),
            count=result.iterations,
        )
        alpha = rule.step(ray)
        result.trials += ray.trials
        if alpha is None:
            result.code = STALLED
            return result
        result.state = at + alpha * move
        result.values.append(landscape.value(result.state))
        result.steps.append(alpha)
        past = alpha, move

"""The plain driver of both flows: direction, trial steps, stop. The compiled loop is `descent_kernels.reduced_flow`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from grasp_env._check import Array
from grasp_env.force.descent_kernels import CONVERGED, LIMIT, SHORTEST, STALLED
from grasp_env.force.step_size import AdaptiveStep


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
    direction: Callable[[Array], Array],
    value: Callable[[Array], float],
    converged: Callable[[Array, float, int], bool],
    rule: AdaptiveStep,
    max_iterations: int,
) -> Descent:
    """State <- state + alpha * direction(state) while Phi decreases (paper, Eqs. 12 and 26).

    Args:
        state: vec(P) for the full flow, VP for the reduced one.
        direction: the projected drive at a state.
        value: Phi at a state, +inf outside the cones.
        converged: whether to stop at (state, Phi, accepted steps).
        rule: the step rule.
        max_iterations: the most accepted steps.
    """
    result = Descent(state.copy(), values=[value(state)])
    alpha = rule.first
    while True:
        current = result.values[-1]
        if converged(result.state, current, result.iterations):
            result.code = CONVERGED
            return result
        if result.iterations >= max_iterations:
            return result
        move = direction(result.state)
        # |vec(P)| and |VP| differ, but their ratio to the step's length is the same to a factor of 2
        length, size = float(np.linalg.norm(move)), float(np.linalg.norm(result.state))
        alpha = max(alpha, SHORTEST * size / length) if length > 0.0 else alpha
        while True:
            if not alpha * length > 1e-16 * size:
                result.code = STALLED
                return result
            result.trials += 1
            candidate = result.state + alpha * move
            trial = value(candidate)
            if trial < current:
                break
            alpha *= rule.shrink
        result.state = candidate
        result.values.append(trial)
        result.steps.append(alpha)
        alpha *= rule.grow

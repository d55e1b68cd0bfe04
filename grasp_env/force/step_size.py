"""The step rule of the flows: any step that stays inside the cones and decreases Phi; grow after, shrink until."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real

from grasp_env._check import positive
from grasp_env.errors import InvalidInputError


@dataclass(frozen=True)
class AdaptiveStep:
    """Accept the first alpha, alpha * shrink, ... that decreases Phi inside the cones; then alpha *= grow.

    The paper only asks that alpha_k "guarantee the convergence of the objective function". `AdaptiveStep(a, grow=1)`
    never grows again and is the constant step wherever that step is admissible.

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
        if not (isinstance(self.shrink, Real) and 0.0 < self.shrink < 1.0):
            raise InvalidInputError(f"shrink must lie in (0, 1), got {self.shrink!r}")

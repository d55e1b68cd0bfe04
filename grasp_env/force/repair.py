"""Repair of a candidate force: balanced, strictly feasible and never worse in Phi than a safe one, by construction."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal
from weakref import WeakKeyDictionary

import numpy as np

from grasp_env import core, ranges
from grasp_env._check import ContactForces, Wrench, as_array, as_wrench, choice
from grasp_env.errors import InfeasibleStartError
from grasp_env.force.basis import OfflineBasis, start_of, starter
from grasp_env.force.objective import Objective, as_objective
from grasp_env.force.solution import GUESS, PREVIOUS
from grasp_env.grasp.grasp import Grasp, as_grasp

SAME = 1e-12
"""Part of the largest component to which two forces are the same."""
Correction = Literal["tangent", "pseudoinverse"]
CORRECTIONS: tuple[Correction, ...] = ("tangent", "pseudoinverse")


@dataclass(frozen=True)
class Repair:
    """Moves a candidate into the cones along the segment to the offline basis' combination.

    The candidate first gets the least-norm correction -G^+ (G f + w), so a candidate that is balanced stays. Then
    the force of least Phi on the segment from the combination (strictly feasible) to it is taken: never worse than
    the paper's start, and never worse than the candidate where that is feasible. Where the combination itself has least Phi,
    nothing is left of the candidate: `start_replaced` tells.

    Attributes:
        objective: Phi.

    Example:
        >>> from grasp_env.grasp import presets
        >>> grasp, wrench = presets.paper_cuboid(), [1, 0.5, -0.6, -0.1, 0.2, 0]
        >>> start = Repair()(grasp, wrench, np.tile([10.0, 0.0, 0.0], (4, 1)))      # no balance
        >>> grasp.residual(start, wrench) < 1e-12, grasp.cone_margin(start) > 0
        (True, True)
    """

    objective: Objective = field(default_factory=Objective)

    def __post_init__(self) -> None:
        object.__setattr__(self, "objective", as_objective(self.objective))

    def __call__(self, grasp: Grasp, wrench: Wrench, candidate: ContactForces) -> ContactForces:
        """(N, 3) repaired force [N]; see the class.

        A candidate that is not finite, or beyond 1e12 N, counts as no candidate: the combination is returned.

        Raises:
            InvalidInputError: the candidate has another shape, or the wrench is not finite.
        """
        force = as_array(candidate, (as_grasp(grasp).n_contacts, 3), "candidate", finite=False)
        return _started(grasp, self.objective, GUESS, as_wrench(wrench), force)


def start_replaced(grasp: Grasp, wrench: Wrench, force: ContactForces) -> bool:
    """Whether a start is the paper's combination, so that nothing is left of the guess that `Repair` was given.

    Without a wrench the combination is the optimum itself, which any good start may be: False then. The combinations of every Phi
    for which this `Grasp` object has a 12-basis are compared: `Repair` makes one, and a start that needed none costs nothing here.
    Rounding counts as the same, 1e-12 of the largest component.

    Args:
        grasp: the contacts.
        wrench: (6,) [N, N m].
        force: (N, 3) the start [N].

    Example:
        >>> from grasp_env.grasp import presets
        >>> grasp, wrench = presets.paper_cuboid(), [1, 0.5, -0.6, -0.1, 0.2, 0]
        >>> guesses = [np.tile([squeeze, 0.0, 0.0], (4, 1)) for squeeze in (1.0, 10.0)]
        >>> [start_replaced(grasp, wrench, Repair()(grasp, wrench, guess)) for guess in guesses]
        [False, True]
    """
    load, start = as_wrench(wrench), as_array(force, (as_grasp(grasp).n_contacts, 3), "force", ranges.SIZE)
    same = SAME * np.abs(start).max()
    return bool(load.any()) and any(
        np.abs(basis.combine(load) - start).max() <= same for basis in OfflineBasis.known(grasp)
    )


def carry_over(
    grasp: Grasp, wrench: Wrench, previous: ContactForces, objective: Objective, correction: Correction = "tangent"
) -> ContactForces:
    """A previous optimum carried to a new grasp and wrench, strictly inside the cones.

    Args:
        grasp: the grasp as it is now.
        wrench: (6,) the wrench to balance now.
        previous: (N, 3) the force that was optimal before [N].
        objective: Phi.
        correction: "pseudoinverse": the least-norm change that restores balance; "tangent": the change that is
            least in the Hessian of Phi at the previous force, which also follows the optimum to first order.

    Returns:
        (N, 3) [N], balanced and strictly inside the cones.

    Raises:
        UnknownNameError: another correction.

    Example:
        >>> from grasp_env.force import optimize_force
        >>> from grasp_env.grasp import presets
        >>> grasp, wrench = presets.paper_cuboid(), np.array([1, 0.5, -0.6, -0.1, 0.2, 0])
        >>> before = optimize_force(grasp, wrench, method="newton")
        >>> start = carry_over(grasp, 1.01 * wrench, before.force, Objective())
        >>> optimize_force(grasp, 1.01 * wrench, initial=start).iterations
        0
    """
    choice(correction, "correction", CORRECTIONS)
    wrench = as_wrench(wrench)
    before = as_array(previous, (as_grasp(grasp).n_contacts, 3), "previous", ranges.SIZE)
    return _started(grasp, as_objective(objective), PREVIOUS if correction == "tangent" else GUESS, wrench, before)


def _started(grasp: Grasp, objective: Objective, start: int, wrench: Wrench, force: ContactForces) -> ContactForces:
    """A start of the core from a force (N, 3) [N] that need be neither balanced nor inside the cones."""
    known = _STARTERS.setdefault(grasp, {})
    if objective not in known:
        known[objective] = starter(grasp, objective)
    made = start_of(known[objective], start, wrench, force)
    if made is None:
        raise InfeasibleStartError(
            f"no force strictly inside the cones was found from there for wrench {wrench.tolist()}"
        )
    return made


_STARTERS: WeakKeyDictionary[Grasp, dict[Objective, core.ForceOptimizer]] = WeakKeyDictionary()

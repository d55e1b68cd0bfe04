"""Repair of a candidate force: balanced, inside the cones, and no worse than a safe force."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args
from weakref import WeakKeyDictionary

import numpy as np

from grasp_env import core
from grasp_env.errors import InfeasibleStartError
from grasp_env.force.basis import OfflineBasis, start_of, starter
from grasp_env.force.objective import Objective, as_objective
from grasp_env.force.solution import GUESS, PREVIOUS
from grasp_env.grasp.grasp import Grasp, as_grasp
from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import ContactForces, Wrench, as_array, as_wrench, choice

SAME_FORCE = 1e-12
"""Relative difference of the largest component up to which two forces count as equal."""
Correction = Literal["tangent", "pseudoinverse"]
CORRECTIONS: tuple[Correction, ...] = get_args(Correction)


@dataclass(frozen=True)
class Repair:
    """Move a candidate into the cones along the segment to the combination of the 12-basis.

    The candidate first receives the least-norm correction -G^+ (G f + w). The result is the force
    of least Phi on the segment from the combination, which is strictly feasible, to the corrected
    candidate. So it is never worse than the paper's start, nor than a feasible candidate. If the
    combination itself has the least Phi, the candidate is discarded; `start_replaced` detects this.

    Attributes:
        objective: Phi.

    Example:
        >>> from grasp_env.grasp import presets
        >>> grasp, wrench = presets.paper_cuboid(), [1, 0.5, -0.6, -0.1, 0.2, 0]
        >>> start = Repair()(grasp, wrench, np.tile([10.0, 0.0, 0.0], (4, 1)))      # not balanced
        >>> grasp.residual(start, wrench) < 1e-12, grasp.cone_margin(start) > 0
        (True, True)
    """

    objective: Objective = field(default_factory=Objective)

    def __post_init__(self) -> None:
        object.__setattr__(self, "objective", as_objective(self.objective))

    def __call__(self, grasp: Grasp, wrench: Wrench, candidate: ContactForces) -> ContactForces:
        """Return the repaired force (N, 3) [N]; the combination if not finite or beyond 1e12 N.

        Raises:
            InvalidInputError: the candidate has another shape, or the wrench is not finite.
        """
        force = as_array(candidate, (as_grasp(grasp).n_contacts, 3), "candidate", finite=False)
        return _repaired(grasp, self.objective, GUESS, as_wrench(wrench), force)


def start_replaced(grasp: Grasp, wrench: Wrench, force: ContactForces) -> bool:
    """True if a start equals the paper's combination, so `Repair` has discarded the candidate.

    For zero wrench the result is False: there the combination is the optimum itself, which any good
    start may reach. The start `force` (N, 3) [N] is compared, to 1e-12 of its largest component,
    with the combination of every 12-basis cached for this `Grasp` object. `Repair` caches one.

    Example:
        >>> from grasp_env.grasp import presets
        >>> grasp, wrench = presets.paper_cuboid(), [1, 0.5, -0.6, -0.1, 0.2, 0]
        >>> guesses = [np.tile([squeeze, 0.0, 0.0], (4, 1)) for squeeze in (1.0, 10.0)]
        >>> [start_replaced(grasp, wrench, Repair()(grasp, wrench, guess)) for guess in guesses]
        [False, True]
    """
    load = as_wrench(wrench)
    start = as_array(force, (as_grasp(grasp).n_contacts, 3), "force", ranges.SIZE)
    rounding = SAME_FORCE * np.abs(start).max()
    return bool(load.any()) and any(
        np.abs(basis.combine(load) - start).max() <= rounding for basis in OfflineBasis.known(grasp)
    )


def carry_over(
    grasp: Grasp,
    wrench: Wrench,
    previous: ContactForces,
    objective: Objective,
    correction: Correction = "tangent",
) -> ContactForces:
    """Carry a previous optimum over to a new grasp and wrench, strictly inside the cones.

    Args:
        grasp, wrench: the current grasp, and wrench (6,) [N, N m].
        previous: (N, 3) the previous optimum [N].
        objective: Phi.
        correction: "pseudoinverse": the least-norm change that restores balance; "tangent": the
            least change in the metric of the Hessian of Phi at the previous force, which follows
            the optimum to first order.

    Returns:
        (N, 3) [N], balanced and strictly inside the cones.

    Raises:
        UnknownNameError: unknown correction.

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
    load = as_wrench(wrench)
    force = as_array(previous, (as_grasp(grasp).n_contacts, 3), "previous", ranges.SIZE)
    start = PREVIOUS if correction == "tangent" else GUESS
    return _repaired(grasp, as_objective(objective), start, load, force)


def _repaired(
    grasp: Grasp, objective: Objective, start: int, wrench: Wrench, force: ContactForces
) -> ContactForces:
    """Return a start of the core from any force (N, 3) [N]."""
    known = _STARTERS.setdefault(grasp, {})
    if objective not in known:
        known[objective] = starter(grasp, objective)
    repaired = start_of(known[objective], start, wrench, force)
    if repaired is None:
        raise InfeasibleStartError(
            f"no force strictly inside the cones was found from this force for wrench {wrench.tolist()}"
        )
    return repaired


_STARTERS: WeakKeyDictionary[Grasp, dict[Objective, core.ForceOptimizer]] = WeakKeyDictionary()

"""Whether a wrench can be balanced: the force deepest inside all limits, or the twist that proves that none is inside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grasp_env import core
from grasp_env._check import Array, ContactForces, Wrench, as_wrench
from grasp_env.errors import NotConvergedError
from grasp_env.force.limits import ForceLimits, LimitNumbers, as_limits
from grasp_env.force.record import CONVERGED, INFEASIBLE
from grasp_env.grasp.grasp import Grasp, as_grasp


@dataclass(frozen=True, eq=False)
class Feasibility:
    """Answer of `feasibility`.

    Attributes:
        force: (N, 3) balanced and strictly inside [N]; None when infeasible.
        torsion: (N,) of soft contacts [N m]; None when infeasible.
        certificate: (6,) a twist v with G_i^T v in every dual cone and v . w >= 0: then v . (G f + w) = 0 forces every
            contact onto the boundary (v . w = 0) or is impossible (v . w > 0). With further limits v . w > -v . G f for
            every force inside them. None when feasible.
        margin: depth inside the limits of forces that sum to one with the wrench's share; <= 0 when infeasible.
    """

    force: ContactForces | None
    torsion: Array | None
    certificate: Array | None
    margin: float

    @property
    def feasible(self) -> bool:
        """Whether a strictly feasible force exists."""
        return self.force is not None


@dataclass(frozen=True, eq=False)
class Deepest:
    """What the core finds.

    Attributes:
        code: CONVERGED, `force` (N, 3) and `torsion` (N,) are strictly inside; INFEASIBLE, none is; else undecided.
        iterations: of the interior point.
        margin: the depth, of forces that sum to one with the wrench's share.
        twist: (6,) that separates where the margin is not above 0, largest component one.
    """

    code: int
    iterations: int
    margin: float
    force: ContactForces
    torsion: Array
    twist: Array


def feasibility(grasp: Grasp, wrench: Wrench, limits: ForceLimits | None = None) -> Feasibility:
    """The force deepest inside all limits that balances a wrench, or the proof that none is inside.

    Maximizes the depth m, with sum u + r = 1 and m <= r: r is the wrench's share, x / r the force, every cone and limit kept with
    slack m. This always has a solution; m > 0 means that x / r is strictly inside.

    Args:
        grasp: the grasp, any contact models.
        wrench: (6,) external wrench [N, N m]; zero asks for an internal force, see `force_closure`.
        limits: further limits.

    Raises:
        NotConvergedError: neither a force nor a proof was found (slow is not infeasible).

    Example:
        >>> from grasp_env.grasp import presets
        >>> feasibility(presets.tripod(), [0.0, 0.0, -1.0, 0.0, 0.0, 0.0]).feasible
        True
    """
    load = as_wrench(wrench)
    found = deepest(as_grasp(grasp), load, as_limits(limits))
    if found.code == CONVERGED:
        return Feasibility(found.force, found.torsion, None, found.margin)
    if found.code == INFEASIBLE:
        return Feasibility(None, None, found.twist, found.margin)
    raise NotConvergedError(
        f"neither a force nor a proof was found for wrench {load.tolist()} (margin {found.margin:.3g} after {found.iterations} "
        "iterations)"
    )


def deepest(grasp: Grasp, wrench: Wrench, limits: ForceLimits | None = None) -> Deepest:
    """The core's answer for checked arguments; see `feasibility`."""
    n = grasp.n_contacts
    given: LimitNumbers = (None, None, None, None, None) if limits is None else limits.given(n)
    solver = core.ForceOptimizer.make(grasp.contacts, None, 1.0, 1.0, *given)
    force, torsion, twist = np.empty((n, 3)), np.empty(n), np.empty(6)
    code, iterations, margin = solver.deepest(wrench, force, torsion, twist)
    return Deepest(code, iterations, margin, force, torsion, twist)

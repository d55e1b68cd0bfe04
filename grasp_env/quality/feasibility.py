"""Feasibility of a wrench: the balanced force with the largest margin, or a separating twist."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from grasp_env import core
from grasp_env.errors import NotConvergedError
from grasp_env.force.limits import ForceLimits, as_limits, core_limits
from grasp_env.force.record import CONVERGED, INFEASIBLE
from grasp_env.grasp.grasp import Grasp, as_grasp
from grasp_env.inputs.arguments import Array, ContactForces, Wrench, as_wrench


@dataclass(frozen=True, eq=False)
class Feasibility:
    """Result of `feasibility`.

    Attributes:
        force: (N, 3) a balanced force strictly inside the cones and limits [N]; None if infeasible.
            Close to the boundary of what contacts and limits can balance, it is balanced to 1e-9 of
            the wrench.
        torsion: (N,) torsions of soft contacts [N m]; None if infeasible.
        certificate: (6,) a twist v with G_i^T v in every dual cone and v . w > 0 (v . w = 0 for a
            zero wrench), so that balance G f + w = 0 is impossible. With limits, v . w > -v . G f
            for every force within them. None if feasible.
        margin: depth inside cones and limits, see `feasibility`; <= 0 if infeasible.
    """

    force: ContactForces | None
    torsion: Array | None
    certificate: Array | None
    margin: float

    @property
    def feasible(self) -> bool:
        """True if a strictly feasible force exists."""
        return self.force is not None


class Deepest(NamedTuple):
    """Result of `deepest`: the fields of `Feasibility` with the code and iterations of the core.

    Attributes:
        code: CONVERGED: `force` and `torsion` are strictly inside cones and limits; INFEASIBLE: no
            force is; others: undecided.
        twist: (6,) the separating twist if the margin is not positive; its largest component is
            one.
    """

    code: int
    iterations: int
    margin: float
    force: ContactForces
    torsion: Array
    twist: Array


def feasibility(grasp: Grasp, wrench: Wrench, limits: ForceLimits | None = None) -> Feasibility:
    """Find the balanced force with the largest margin to cones and limits, or disprove it.

    The core maximises the depth m subject to sum u + r = 1 and m <= r. Here r scales the wrench,
    x / r is the force, and every cone and limit has at least the slack m. If m > 0, x / r is
    strictly inside.

    Args:
        grasp: the contacts, of any models.
        wrench: (6,) external wrench [N, N m]; zero for an internal force, see `force_closure`.
        limits: further limits.

    Raises:
        NotConvergedError: neither a force nor a proof was found.

    Example:
        >>> from grasp_env.grasp import presets
        >>> feasibility(presets.tripod(), [0.0, 0.0, -1.0, 0.0, 0.0, 0.0]).feasible
        True
    """
    load = as_wrench(wrench)
    result = deepest(as_grasp(grasp), load, as_limits(limits))
    if result.code == CONVERGED:
        return Feasibility(result.force, result.torsion, None, result.margin)
    if result.code == INFEASIBLE:
        return Feasibility(None, None, result.twist, result.margin)
    raise NotConvergedError(
        f"neither a force nor a proof was found for wrench {load.tolist()} (margin {result.margin:.3g} after {result.iterations} "
        "iterations)"
    )


def deepest(grasp: Grasp, wrench: Wrench, limits: ForceLimits | None = None) -> Deepest:
    """Return the core's result for checked arguments; see `feasibility`."""
    n = grasp.n_contacts
    solver = core.ForceOptimizer(core.Problem(grasp.contacts, None, core_limits(limits, n)))
    results = np.empty((n, 3)), np.empty(n), np.empty(6)
    return Deepest(*solver.deepest(wrench, *results), *results)

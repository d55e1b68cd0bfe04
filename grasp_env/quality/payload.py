"""The largest load along a direction that contacts and motors hold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from grasp_env.errors import InvalidInputError, NotConvergedError, UnsupportedProblemError
from grasp_env.force.limits import ForceLimits
from grasp_env.force.margin import Margin
from grasp_env.force.optimizer import ForceOptimizer
from grasp_env.force.record import CONVERGED, INFEASIBLE
from grasp_env.grasp.grasp import Grasp
from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import (
    Array,
    ContactForces,
    Wrench,
    as_array,
    as_wrench,
    checked_size,
    positive,
)


@dataclass(frozen=True, eq=False)
class Payload:
    """Result of `payload`; `float(result)` is its load.

    Attributes:
        load: the largest load, in units of `direction`; for a force of length one it is in newtons.
            All loads from zero to this one are held.
        upper: certified upper bound of the load: no force holds more. If the limits leave some
            forces unbounded and rounding leaves multipliers outside a dual cone, the bound holds
            for normal forces of up to 1e4 times those of `force`.
        force: (N, 3) (normal, o, t) contact forces that hold the load [N].
        torsion: (N,) torsions of soft contacts [N m].
        wrench: (6,) the external wrench of this load, `wrench` included [N, N m].
        certificate: (6,) the twist v, [linear; angular] with v . direction = 1, that proves `upper`.
        limit_multipliers: (M,) y >= 0, one for each row A f <= b of the limits (`ForceLimits.rows`).
            G_i^T v + A_i^T y lies in the dual cone of every contact i, so that no load exceeds y . b -
            v . w, with w the wrench at zero load and b the limits of the forces beyond the preload.
        iterations: steps of the interior point.
    """

    load: float
    upper: float
    force: ContactForces
    torsion: Array
    wrench: Wrench
    certificate: Array
    limit_multipliers: Array
    iterations: int

    def __float__(self) -> float:
        return self.load


def payload(
    grasp: Grasp,
    direction: ArrayLike,
    limits: ForceLimits | None = None,
    margin: Margin | float | None = None,
    *,
    wrench: ArrayLike | None = None,
    tolerance: float = 1e-6,
) -> Payload:
    """Return the largest load along `direction` that the contacts hold within all limits.

    It is the supremum of the k >= 0 for which a force inside the friction cones, the margin and the
    limits balances wrench + k direction: a cone program in the forces and k. `wrench` alone, k = 0,
    must be held. The motors' torques include `torque_bias`.

    Args:
        grasp: the contacts, of any models.
        direction: (3,) force at the origin of the contacts' frame, or (6,) screw [force; moment];
            the load is a multiple of it, so give a force the length one for newtons. Its largest
            component is 1e-100 to 1e12.
        limits: limits on normal forces and joint torques. Without them a grasp with force closure
            holds any load.
        margin: how far forces stay inside the friction cones, a `Margin` or its share of friction.
        wrench: (6,) external wrench [N, N m] that acts besides the load, such as the object's
            weight; None: zero.
        tolerance: largest relative difference of load and upper bound, at most 1.

    Raises:
        InfeasibleWrenchError: no force holds `wrench` within the limits, even without load; the
            error has the solution with the proof.
        UnsupportedProblemError: the limits do not bound the load.
        NotConvergedError: neither a load nor a bound was found to the tolerance.
        InvalidInputError: a direction of zero, another shape, a number out of range, or a preload
            that reaches `max_normal`.

    Example:
        >>> from grasp_env.force import ForceLimits
        >>> from grasp_env.grasp import presets
        >>> lift = payload(presets.tripod(), [0, 0, -1], ForceLimits(max_normal=10), margin=0.8)
        >>> round(lift.load, 3), round(lift.upper, 3)   # three contacts with friction 0.5
        (12.0, 12.0)
    """
    solver = ForceOptimizer(grasp, limits=limits, margin=margin)
    along = _screw(direction)
    held = np.zeros(6) if wrench is None else as_wrench(wrench)
    within = positive(tolerance, "tolerance", ranges.TOLERANCE)
    count = grasp.n_contacts
    force, torsion, twist = np.empty((count, 3)), np.empty(count), np.empty(6)
    multipliers = np.empty(len(solver.limit_labels))
    code, iterations, unbounded, load, upper = solver.core.payload(
        along, held, within, force, torsion, twist, multipliers
    )
    if unbounded:
        raise UnsupportedProblemError(
            f"the load along {along.tolist()} is not bounded: contacts and limits hold more than {load:g} of it; give limits that "
            "every force against it reaches, such as ForceLimits(max_normal=...) or torque limits of all fingers"
        )
    if code == INFEASIBLE:
        solver.solve(held)  # raises, with the proof
    if code != CONVERGED:
        raise NotConvergedError(
            f"the load along {along.tolist()} is between {load:.9g} and {upper:.9g} after {iterations} iterations: raise the tolerance "
            f"of {within:g}, or move limits or contacts that hardly hold anything"
        )
    return Payload(load, upper, force, torsion, held + load * along, twist, multipliers, iterations)


def _screw(direction: ArrayLike) -> Array:
    """Return a direction (6,) of a force (3,) or a screw (6,) that is not zero."""
    numbers = checked_size(as_array(direction, None, "direction"), "direction")
    if numbers.shape not in ((3,), (6,)):
        raise InvalidInputError(
            f"direction must be a force (3,) or a screw (6,), got shape {numbers.shape}"
        )
    screw = np.zeros(6)
    screw[: len(numbers)] = numbers
    if not np.abs(screw).max() >= ranges.DIRECTION.low:
        raise InvalidInputError(
            f"the largest component of direction must be {ranges.DIRECTION}, got {screw.tolist()}: give the force or screw of a unit load"
        )
    return screw

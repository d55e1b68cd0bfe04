"""Force closure: whether the fingers can squeeze with every force strictly inside its cone, with a proof either way.

With rank(G) = 6, as of every `Grasp`, such a squeeze exists exactly when every wrench can be balanced (Murray, Li, Sastry
1994, Prop. 5.2; Nguyen 1988). The cones are exact: no pyramids. Turning ALL normals round changes nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grasp_env._check import Array, ContactForces
from grasp_env.core import CLEAR
from grasp_env.errors import NotConvergedError
from grasp_env.force.limits import ForceLimits, as_limits
from grasp_env.force.proof import friction_part, moved
from grasp_env.force.record import CONVERGED, INFEASIBLE
from grasp_env.grasp.advice import advise
from grasp_env.grasp.grasp import Grasp, as_grasp
from grasp_env.quality.feasibility import deepest

PROVEN = 1e-6
"""A twist proves that there is no closure when it leaves the dual cones by at most this part of its largest image."""


@dataclass(frozen=True, eq=False)
class ForceClosure:
    """Answer of `force_closure`; true when closed, and printed as one or two sentences.

    Attributes:
        closed: whether an internal force lies strictly inside all cones (and further limits).
        margin: the largest m such that some internal force with sum u_i = 1 - m has depth m in every cone:
            u_i - |(o, t)_i| >= m and, where soft, u_i - |torsion_i| mu_i / gamma_i >= m, in cone coordinates u = mu * normal.
            No unit, from 0 (no closure) to 1 / (N + 1) (no tangential force needed, all u_i equal). With further limits
            A f <= b: x / r is the force, sum u + r = 1, r >= m and A x + m <= r b, rows of length one; it can be negative.
        force: (N, 3) the witness of closure: an internal force strictly inside [N], sum of mu * normal one (as given by the
            limits, where there are any); None when not closed.
        torsion: (N,) [N m] that goes with it; None when not closed.
        twist: (6,) the witness against closure: v, [linear; angular] with largest component one, such that no contact force
            inside its cone does negative work along v (G_i^T v in every dual cone) and not all do none; then v . G f > 0
            for every f strictly inside, so G f = 0 is impossible. None when closed.
        error: how well the witness was checked. Closed: largest |component| of G f relative to sum |f|. Not closed: how far
            G_i^T v leaves its dual cone, relative to the largest G_i^T v (0: inside all); nan where further limits, not the
            cones, leave no internal force: then the iterations converged to margin < 0, nothing more was checked.
        help: for people.
    """

    closed: bool
    margin: float
    force: ContactForces | None
    torsion: Array | None
    twist: Array | None
    error: float
    help: str

    @property
    def witness(self) -> Array:
        """`force` when closed, else `twist`."""
        found = self.force if self.closed else self.twist
        assert found is not None
        return found

    def __bool__(self) -> bool:
        return self.closed

    def __str__(self) -> str:
        return self.help


def force_closure(grasp: Grasp, limits: ForceLimits | None = None) -> ForceClosure:
    """Whether an internal force lies strictly inside all cones, with the force or the twist that proves the answer.

    Args:
        grasp: the contacts, any models.
        limits: asks for an internal force within these limits too.

    Raises:
        NotConvergedError: neither witness passes its check (margins about 1e-9): undecided, never "no".

    Example:
        >>> from grasp_env.grasp import Grasp, presets
        >>> found = force_closure(presets.tripod())
        >>> bool(found), found.margin, found.force[:, 0]
        (True, 0.25, array([0.667, 0.667, 0.667]))
        >>> palm = presets.paper_cuboid()
        >>> print(force_closure(Grasp.from_contacts(palm.positions, [[0, 0, 1]] * 4, 0.4)))
        no force closure: no contact force inside its cone resists a motion of the object along the twist ...
    """
    as_grasp(grasp)
    limits = as_limits(limits)
    if limits is not None and not (cones := force_closure(grasp)):
        return cones
    found = deepest(grasp, np.zeros(6), limits)
    margin, twist = found.margin, found.twist
    if found.code == CONVERGED:
        # without limits of their own size the forces are of any size: make them sum to one
        sized = limits is not None and bool(limits.rows(grasp).bound.any())
        size = 1.0 if sized else float((grasp.models.cone_scale[:, 0] * found.force[:, 0]).sum())
        force, torsion = found.force / size, found.torsion / size
        error = grasp.residual(force, np.zeros(6), torsion) / float(np.abs(force).sum())
        said = (
            f"force closure: the {grasp.n_contacts} contacts can squeeze with every force strictly inside its limits "
            f"(margin {margin:.3g}, at most {1.0 / (1 + grasp.n_contacts):.3g})"
        )
        return ForceClosure(True, margin, force, torsion, None, error, said)
    if margin <= CLEAR:
        error = _outside(grasp, twist)
        if limits is None and error <= PROVEN:
            return ForceClosure(False, 0.0, None, None, twist, error, _no(grasp, twist))
        if limits is not None and found.code == INFEASIBLE and margin < -CLEAR:
            said = (
                "no internal force within the further limits, although the contacts alone have force closure: widen the "
                "limits (least normal forces against largest torques, or a torque bias)"
            )
            return ForceClosure(False, margin, None, None, twist, float("nan"), said)
    raise NotConvergedError(
        f"force closure is undecided: margin {margin:.3g} after {found.iterations} iterations; this close to losing it a "
        "grasp should not be relied on: move a contact or raise the friction"
    )


def _outside(grasp: Grasp, twist: Array) -> float:
    """How far G_i^T v leaves the dual cones, relative to the largest; >= 0, inf where v moves no contact at all."""
    q = moved(grasp, twist)
    normal, lost = q[:, 0], friction_part(grasp, q)
    largest = float((np.abs(normal) + lost).max())
    return max(0.0, float((lost - normal).max())) / largest if largest > 0.0 else float("inf")


def _no(grasp: Grasp, twist: Array) -> str:
    said = (
        "no force closure: no contact force inside its cone resists a motion of the object along the twist "
        f"{np.array2string(twist, precision=3, suppress_small=True)} (velocity, angular velocity); add a contact that does, "
        "or raise the friction"
    )
    hints = advise(grasp)
    towards = np.einsum("ij,ij->i", grasp.normals, grasp.positions.mean(axis=0) - grasp.positions)
    if (towards < 0.0).all():
        hints.append("turning all normals round gives no force closure either")
    return "; ".join([said, *hints])

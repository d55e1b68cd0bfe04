"""Force closure: an internal force strictly inside all friction cones, or a disproof.

If rank(G) = 6, such an internal force exists exactly if every wrench can be balanced (Murray, Li,
Sastry 1994, Prop. 5.2; Nguyen 1988). Reversing ALL normals does not change the result.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grasp_env.core import CLEAR
from grasp_env.errors import NotConvergedError
from grasp_env.force.limits import ForceLimits, as_limits
from grasp_env.force.proof import contact_motions, least_normal_motions
from grasp_env.force.record import CONVERGED, INFEASIBLE
from grasp_env.grasp.advice import advise
from grasp_env.grasp.grasp import Grasp, as_grasp, transmitted_matrix
from grasp_env.inputs.arguments import Array, ContactForces
from grasp_env.quality.feasibility import deepest

PROVEN = 1e-6
"""Largest violation of the dual cones, relative to the largest G_i^T v, up to which a twist v
disproves closure."""


@dataclass(frozen=True, eq=False)
class ForceClosure:
    """Result of `force_closure`. It is true if closed, and prints as one or two sentences.

    Attributes:
        closed: True if the rank of G is 6 and an internal force lies strictly inside all cones and
            the given limits.
        margin: the largest m such that some internal force with sum u_i = 1 - m has depth m in
            every cone, u_i - |(o, t, v)_i| >= m in the cone coordinates of
            `grasp_env.grasp.contact_model`. It has no unit and lies between 0 (no closure) and
            1 / (N + 1) (no tangential force needed, all u_i equal). With limits A f <= b, the force
            is x / r, sum u + r = 1, r >= m and A x + m <= r b with rows of length one; m can then
            be negative.
        force: (N, 3) the witness of closure: an internal force strictly inside the cones and limits
            [N]. The sum of mu * normal is one, unless limits determine it. None if not closed.
        torsion: (N,) torsions of this force [N m]; None if not closed.
        twist: (6,) the witness against closure: a twist v, [linear; angular], whose largest
            component is one. G_i^T v is in every dual cone, so v . G f > 0 for every f strictly
            inside, and G f = 0 is impossible. If rank(G) < 6, no contact force does any work along
            v. None if closed.
        error: residual of the witness. Closed: largest |component| of G f relative to sum |f|. Not
            closed: largest violation of the dual cones, relative to the largest G_i^T v, or if
            rank(G) < 6, to the terms of G_i^T v. It is nan, and unchecked, if the limits, not the
            cones, exclude internal forces (margin < 0).
        help: the result in words.
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
        """`force` if closed, else `twist`."""
        proof = self.force if self.closed else self.twist
        assert proof is not None
        return proof

    def __bool__(self) -> bool:
        return self.closed

    def __str__(self) -> str:
        return self.help


def force_closure(grasp: Grasp, limits: ForceLimits | None = None) -> ForceClosure:
    """Test a grasp for force closure; the result contains the force or the twist that proves it.

    Args:
        grasp: the contacts, of any models.
        limits: further limits on the internal force.

    Raises:
        NotConvergedError: neither witness passes its check, at margins of about 1e-9.

    Example:
        >>> from grasp_env.grasp import Grasp, presets
        >>> closure = force_closure(presets.tripod())
        >>> bool(closure), closure.margin, closure.force[:, 0]
        (True, 0.25, array([0.667, 0.667, 0.667]))
        >>> palm = presets.paper_cuboid()
        >>> print(force_closure(Grasp.from_contacts(palm.positions, [[0, 0, 1]] * 4, 0.4)))
        no force closure: no contact force inside its cone resists a motion of the object along the
        twist ...
    """
    as_grasp(grasp)
    limits = as_limits(limits)
    if limits is not None and not (cones := force_closure(grasp)):
        return cones
    if grasp.rank < 6:
        return _rank_lost(grasp)
    result = deepest(grasp, np.zeros(6), limits)
    margin, twist = result.margin, result.twist
    if result.code == CONVERGED:
        # without limits the size of the force is arbitrary: normalise it
        sized = limits is not None and bool(limits.rows(grasp).bound.any())
        size = 1.0 if sized else float((grasp.models.cone_scale[:, 0] * result.force[:, 0]).sum())
        force = result.force / size
        torsion = result.torsion / size
        error = grasp.residual(force, np.zeros(6), torsion) / float(np.abs(force).sum())
        text = (
            f"force closure: the {grasp.n_contacts} contacts can squeeze with every force strictly inside its limits "
            f"(margin {margin:.3g}, at most {1.0 / (1 + grasp.n_contacts):.3g})"
        )
        return ForceClosure(True, margin, force, torsion, None, error, text)
    if margin <= CLEAR:
        error = _dual_violation(grasp, twist)
        if limits is None and error <= PROVEN:
            return ForceClosure(False, 0.0, None, None, twist, error, _open_help(grasp, twist))
        if limits is not None and result.code == INFEASIBLE and margin < -CLEAR:
            text = (
                "no internal force within the further limits, although the contacts alone have force closure: widen the "
                "limits (least normal forces against largest torques, or a torque bias)"
            )
            return ForceClosure(False, margin, None, None, twist, float("nan"), text)
    raise NotConvergedError(
        f"force closure is undecided: margin {margin:.3g} after {result.iterations} iterations; this close to losing it a "
        "grasp should not be relied on: move a contact or raise the friction"
    )


def _rank_lost(grasp: Grasp) -> ForceClosure:
    """Return the result for rank(G) < 6."""
    sent = transmitted_matrix(grasp)
    twist = grasp.unit_frame.T @ np.linalg.svd(grasp.unit_frame @ sent)[0][:, -1]
    twist /= np.abs(twist).max()
    twist *= np.sign(twist[np.abs(twist).argmax()])
    terms = float((np.abs(twist) @ np.abs(sent)).max())
    error = float(np.abs(twist @ sent).max()) / terms if terms > 0.0 else 0.0
    text = (
        f"no force closure: rank(G) = {grasp.rank} < 6; no contact force does any work along the twist "
        f"{np.array2string(twist, precision=3, suppress_small=True)} (velocity, angular velocity); add a contact that does, or soft fingertips"
    )
    return ForceClosure(False, 0.0, None, None, twist, error, "; ".join([text, *advise(grasp)]))


def _dual_violation(grasp: Grasp, twist: Array) -> float:
    """Return the violation of the dual cones relative to the largest G_i^T v; inf if that is 0."""
    q = contact_motions(grasp, twist)
    normal = q[:, 0]
    least = least_normal_motions(grasp, q)
    largest = float((np.abs(normal) + least).max())
    return max(0.0, float((least - normal).max())) / largest if largest > 0.0 else float("inf")


def _open_help(grasp: Grasp, twist: Array) -> str:
    text = (
        "no force closure: no contact force inside its cone resists a motion of the object along the twist "
        f"{np.array2string(twist, precision=3, suppress_small=True)} (velocity, angular velocity); add a contact that does, "
        "or raise the friction"
    )
    hints = advise(grasp)
    towards = np.einsum("ij,ij->i", grasp.normals, grasp.positions.mean(axis=0) - grasp.positions)
    if (towards < 0.0).all():
        hints.append("turning all normals round gives no force closure either")
    return "; ".join([text, *hints])

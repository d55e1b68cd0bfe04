"""Grasp-force problems with soft contacts and further limits, as data for the core's `program.hpp`.

Contact i has the variables z_i = (u, o, t, w): cone coordinates, and for soft contacts w = u - v >= 0 where v is the torsion
in units of its limit, abs(v) <= u. Balance is in the unit frame (`Grasp.unit_frame`), so that it means the same wherever the
origin is.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from grasp_env import core
from grasp_env._check import Array, ContactForces, Wrench
from grasp_env.force.limits import ForceLimits
from grasp_env.force.record import record_size
from grasp_env.grasp.grasp import Grasp

CLEAR = core.CLEAR
"""A margin up to this, of one for forces that sum to one, counts as the boundary: no force strictly inside."""


class Deepest(NamedTuple):
    """The force deepest inside all limits.

    Attributes:
        code: CONVERGED, its force is strictly inside; INFEASIBLE, none is, and the twist proves it; else undecided.
        iterations: of the interior-point method.
        margin: its depth, of forces that sum to one with the wrench's share.
        z: (N, 4) [N] the force, strictly inside where code is CONVERGED.
        twist: (6,) the separating twist, largest component one; None where the margin is clear.
    """

    code: int
    iterations: int
    margin: float
    z: Array
    twist: Array | None


class ForceProgram:
    """The constraints of a grasp, and of further limits, ready for any wrench.

    Attributes:
        rows: (M, N, 4) coefficients of all limits besides the cones and w >= 0; given ones scaled to length one.
        bound: (M,) their right sides [N].
        labels: (M,) what each limit is.
    """

    def __init__(self, grasp: Grasp, limits: ForceLimits | None = None, elastic: bool = False) -> None:
        """Elastic: `least_excess` will be asked."""
        self.grasp = grasp
        count = grasp.n_contacts
        gamma, mu = grasp.models.torsional_friction, grasp.models.cone_scale[:, 0]
        self.soft: NDArray[np.bool_] = gamma > 0.0
        self.torsion_divisor = np.where(self.soft, mu / np.where(self.soft, gamma, 1.0), np.inf)
        """Torsion = (u - w) / torsion_divisor."""
        self.frame = grasp.unit_frame
        balance = np.zeros((6, count, 4))
        balance[:, :, :3] = grasp.cone_matrix.reshape(6, count, 3)
        balance[:, :, 3] = grasp.torsion_matrix / self.torsion_divisor
        self.balance = _with_slack(np.einsum("rs,sna->rna", self.frame, balance))
        """(6, N, 4)."""
        self._inverse = np.linalg.pinv(self.balance.reshape(6, -1)).reshape(count, 4, 6)
        soft = np.flatnonzero(self.soft)
        rows, bound = np.zeros((len(soft), count, 4)), np.zeros(len(soft))
        rows[np.arange(len(soft)), soft, 0], rows[np.arange(len(soft)), soft, 3] = -2.0, 1.0
        shares = np.zeros(len(soft))
        labels = [f"torsion of contact {i} >= -torsional_friction * normal" for i in soft]
        if limits is not None:
            given, limited = limits._rows(grasp)
            divisor = np.concatenate([grasp.models.cone_divisor, self.torsion_divisor[:, None]], axis=1)
            rows = np.concatenate([rows, _with_slack(given.matrix.reshape(-1, count, 4) / divisor)])
            bound, shares = np.concatenate([bound, given.bound]), np.concatenate([shares, limited])
            labels.extend(given.labels)
        self.row_size = np.sqrt((rows**2).sum(axis=(1, 2)))
        # torsion's row is u + v as it stands; a torque that no force changes has no length
        self.row_size[: len(soft)] = 1.0
        self.row_size[self.row_size == 0.0] = 1.0
        self.rows = rows / self.row_size[:, None, None]
        self.bound = bound / self.row_size
        self.labels = tuple(labels)
        self.solver = core.Program.make(
            np.ascontiguousarray(self.frame), np.ascontiguousarray(self.balance), np.ascontiguousarray(self.rows), self.bound,
            np.concatenate([grasp.models.cone_divisor, self.torsion_divisor[:, None]], axis=1),
            shares / self.row_size, elastic,
        )  # fmt: skip

    def least_force(
        self, wrench: Wrench, criterion: str = "sum", tolerance: float = 1e-6, max_iterations: int = 100
    ) -> tuple[Array, Array]:
        """The least sum of normal forces, or the least maximum normal force, within all limits: (record, multipliers of the limits).

        Codes: INFEASIBLE, the record's multipliers are the separating twist; REFUSED, neither a force nor a proof was found.
        """
        record, prices = np.empty(record_size(self.grasp.n_contacts)), np.empty(len(self.bound))
        self.solver.least_force(wrench, criterion == "max", tolerance, max_iterations, record, prices)
        return record, prices / self.row_size

    def least_excess(self, wrench: Wrench, max_iterations: int = 100) -> Array:
        """Where no force keeps the limits: the record of the balanced force inside the cones that exceeds them least.

        min t s.t. G x + w = 0, x in the cones, torsion within its friction, A x <= b + t limit, t >= 0, to 1 %.
        What the core's `excess.hpp` does for limits on one contact each, for joints that fingers share and for soft contacts
        too. Code LIMITS_EXCEEDED where it is found; INFEASIBLE: not even the cones balance the wrench.
        """
        record, prices = np.empty(record_size(self.grasp.n_contacts)), np.empty(len(self.bound))
        self.solver.least_excess(wrench, max_iterations, record, prices)
        return record

    def deepest(self, wrench: Wrench, tolerance: float = 1e-7) -> Deepest:
        """The force deepest inside all limits, or the separating twist when nothing is inside.

        max m s.t. G x + r w = 0, x deeper than m in the cones, every other limit kept with slack m, m <= r,
        sum u + r = 1. The homogeneous r makes it bounded, with a solution always. m > 0: x / r is strictly inside.
        m < 0: the multipliers v of balance have G_i^T v inside every dual cone and v . w > 0 (beyond what the other limits
        leave), which no force inside the limits allows.
        """
        z, twist = np.empty((self.grasp.n_contacts, 4)), np.empty(6)
        code, iterations, margin = self.solver.deepest(wrench, tolerance, z, twist)
        return Deepest(code, iterations, margin, z, None if margin > CLEAR else twist)

    def least_phi(
        self,
        wrench: Wrench,
        weights: Array,
        z: Array,
        tolerance: float,
        optimum: float,
        max_iterations: int,
        trace: Array,
    ) -> tuple[Array, Array]:
        """The least Phi from z (N, 4), balanced and strictly inside all limits: (record, multipliers of the limits).

        Args:
            wrench: (6,) external wrench.
            weights: (N, 2) omega and lambda; a limit takes the mean lambda of the contacts that it touches.
            z: (N, 4) the start.
            tolerance: relative gap at which to stop.
            optimum: a known min Phi, or nan for the certified bound.
            max_iterations: most accepted steps.
            trace: (T,) receives Phi of iterates 0..T-1.
        """
        touched = (self.rows != 0.0).any(axis=2)
        touched[~touched.any(axis=1)] = True
        row_weights = touched @ weights[:, 1] / touched.sum(axis=1)
        record, prices = np.empty(record_size(self.grasp.n_contacts)), np.empty(len(self.bound))
        self.solver.least_phi(
            wrench, weights, row_weights, z, optimum, trace, tolerance, max_iterations, record, prices
        )
        return record, prices / self.row_size

    def force(self, z: Array) -> ContactForces:
        """(N, 3) contact forces of z [N]."""
        return z[:, :3] / self.grasp.models.cone_divisor

    def torsion(self, z: Array) -> Array:
        """(N,) torsions of z [N m]."""
        return np.where(self.soft, z[:, 0] - z[:, 3], 0.0) / self.torsion_divisor

    def variables(self, force: ContactForces, torsion: Array | None = None) -> Array:
        """(N, 4) z of forces (N, 3) [N] and torsions (N,) [N m]."""
        z = np.ones((self.grasp.n_contacts, 4))
        z[:, :3] = self.grasp.to_cone(force).reshape(-1, 3)
        if torsion is not None:
            soft = self.soft
            z[soft, 3] = z[soft, 0] - np.asarray(torsion)[soft] * self.torsion_divisor[soft]
        else:
            z[self.soft, 3] = z[self.soft, 0]
        return z

    def slack(self, z: Array) -> float:
        """Least slack of cones, torsion and further limits [N], rows scaled to length one; >= 0 inside."""
        cones = z[:, 0] - np.sqrt(z[:, 1] ** 2 + z[:, 2] ** 2)
        others = self.bound - np.einsum("kia,ia->k", self.rows, z)
        return float(min(cones.min(), z[self.soft, 3].min(initial=np.inf), others.min(initial=np.inf)))

    def balanced(self, z: Array, wrench: Wrench) -> Array:
        """Z with the least-norm change that balances the wrench, cone coordinates."""
        return z - self._inverse @ (np.einsum("rna,na->r", self.balance, z) + self.frame @ wrench)

    def residual(self, z: Array, wrench: Wrench) -> float:
        """Largest |component| of G z + w, moments about the contacts' centre and divided by the grasp's length [N]."""
        return float(np.abs(np.einsum("rna,na->r", self.balance, z) + self.frame @ wrench).max())


def _with_slack(rows: Array) -> Array:
    """Rows (..., 4) in (u, o, t, v) -> in (u, o, t, w), w = u - v."""
    out = rows.copy()
    out[..., 0] += rows[..., 3]
    out[..., 3] = -rows[..., 3]
    return out

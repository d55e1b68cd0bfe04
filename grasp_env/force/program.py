"""Grasp-force problems with soft contacts and further limits, as data for `program_kernels.interior_point`.

Contact i has the variables z_i = (u, o, t, w): cone coordinates, and for soft contacts w = u - v >= 0 where v is the torsion
in units of its limit, abs(v) <= u. Wrenches are scaled to size one and balance is in the unit frame (`Grasp.unit_frame`), so
tolerances mean the same from 1e-6 to 1e4 N and wherever the origin is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grasp_env._check import Array, ContactForces, Wrench
from grasp_env.core import NOTHING
from grasp_env.errors import UnknownNameError
from grasp_env.force.limits import ForceLimits
from grasp_env.force.method import CRITERIA
from grasp_env.force.program_kernels import NEARLY, interior_point
from grasp_env.force.program_newton import general_newton
from grasp_env.force.record import CONVERGED, LIMIT
from grasp_env.grasp.grasp import Grasp

_Structure = tuple[NDArray[np.int64], NDArray[np.int64], Array]
DIVERGED = 1e12
"""Multipliers of a wrench of size one beyond which they say nothing."""
CLEAR = 1e-9
"""A margin up to this, of one for forces that sum to one, counts as the boundary: no force strictly inside."""


@dataclass(frozen=True, eq=False)
class Answer:
    """What the interior-point method found, in the user's units.

    Attributes:
        code: 0 converged, 1 iteration limit, 2 no further progress in floating point.
        z: (N, 4) the variables.
        iterations: of the interior-point method.
        value: the objective [N], or the margin.
        bound: certified lower bound of the objective [N].
        multipliers: (6,) nu of balance.
        limit_multipliers: (M,) >= 0 of the limits, in the order of `ForceProgram.labels`.
        trials: steps tried by the line search.
    """

    code: int
    z: Array
    iterations: int
    value: float
    bound: float
    multipliers: Array
    limit_multipliers: Array
    trials: int = 0


class ForceProgram:
    """The constraints of a grasp, and of further limits, ready for any wrench.

    Attributes:
        rows: (M, N, 4) coefficients of all limits besides the cones and w >= 0; given ones scaled to length one.
        bound: (M,) their right sides [N].
        labels: (M,) what each limit is.
    """

    def __init__(self, grasp: Grasp, limits: ForceLimits | None = None) -> None:
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
        flat = self.balance.reshape(6, -1)
        self._inverse = np.linalg.pinv(flat).reshape(count, 4, 6)
        soft = np.flatnonzero(self.soft)
        rows, bound = np.zeros((len(soft), count, 4)), np.zeros(len(soft))
        rows[np.arange(len(soft)), soft, 0], rows[np.arange(len(soft)), soft, 3] = -2.0, 1.0
        labels = [f"torsion of contact {i} >= -torsional_friction * normal" for i in soft]
        if limits is not None:
            given = limits.rows(grasp)
            divisor = np.concatenate([grasp.models.cone_divisor, self.torsion_divisor[:, None]], axis=1)
            rows = np.concatenate([rows, _with_slack(given.matrix.reshape(-1, count, 4) / divisor)])
            bound = np.concatenate([bound, given.bound])
            labels.extend(given.labels)
        self.row_size = np.sqrt((rows**2).sum(axis=(1, 2)))
        # torsion's row is u + v as it stands; a torque that no force changes has no length
        self.row_size[: len(soft)] = 1.0
        self.row_size[self.row_size == 0.0] = 1.0
        self.rows = rows / self.row_size[:, None, None]
        self.bound = bound / self.row_size
        self.labels = tuple(labels)
        self._price = 1.0 / grasp.models.cone_divisor[:, 0]
        self._first, self._touched, self._values = _by_contact(np.concatenate([self.balance, self.rows]))

    def least_force(
        self, wrench: Wrench, criterion: str = "sum", tolerance: float = 1e-6, max_iterations: int = 100
    ) -> Answer:
        """The least sum of normal forces, or the least maximum normal force, within all limits.

        A wrench that nothing balances ends with a code other than 0; ask `deepest` then.

        Raises:
            UnknownNameError: unknown criterion.
        """
        if criterion not in CRITERIA:
            raise UnknownNameError("criterion", criterion, CRITERIA)
        count = self.grasp.n_contacts
        size = self._size(wrench)
        unit = self.frame @ wrench / size
        if np.abs(unit).max() < NOTHING and (self.bound >= 0.0).all():
            return Answer(CONVERGED, np.zeros((count, 4)), 0, 0.0, 0.0, np.zeros(6), np.zeros(len(self.bound)))
        right = np.concatenate([-unit, self.bound / size])
        cost = np.zeros((count, 4))
        if criterion == "max":
            # one more limit a contact, normal - t <= 0, with t shared
            largest = np.zeros((count, count, 4))
            largest[np.arange(count), np.arange(count), 0] = self._price
            structure = _by_contact(np.concatenate([self.balance, self.rows, largest]))
            coupling = np.concatenate([np.zeros((len(right), 1)), -np.ones((count, 1))])
            right = np.concatenate([right, np.zeros(count)])
            state, info = self._run(structure, coupling, right, 6, cost, np.ones(1), tolerance, max_iterations)
        else:
            cost[:, 0] = self._price
            structure = self._first, self._touched, self._values
            state, info = self._run(
                structure, np.zeros((len(right), 0)), right, 6, cost, np.zeros(0), tolerance, max_iterations
            )
        z = self._balanced(state.z, unit)
        if -NEARLY * size < self.slack(size * z) < 0.0:  # the last digits; nan is neither
            z = self._inwards(size * z, wrench) / size
        normals = self._price * z[:, 0]
        value = float(normals.sum() if criterion == "sum" else normals.max())
        if not np.abs(state.y).max() < DIVERGED:
            # no bound: the multipliers run away, as they do where nothing balances the wrench
            return Answer(
                max(int(info[0]), LIMIT),
                size * z,
                int(info[1]),
                size * value,
                0.0,
                np.zeros(6),
                np.zeros(len(self.bound)),
            )
        bound, nu, multipliers = self._certified(state.y, cost, criterion, unit, size)
        return Answer(int(info[0]), size * z, int(info[1]), size * value, size * bound, self.frame.T @ nu, multipliers)

    def deepest(self, wrench: Wrench, tolerance: float = 1e-7) -> tuple[Answer, Array | None]:
        """The force deepest inside all limits, and the separating twist when nothing is inside.

        max m s.t. G x + r w = 0, x deeper than m in the cones, every other limit kept with slack m, m <= r,
        sum u + r = 1. The homogeneous r makes it bounded, with a solution always. m > 0: x / r is strictly inside.
        m < 0: the multipliers v of balance have G_i^T v inside every dual cone and v . w > 0 (beyond what the other limits
        leave), which no force inside the limits allows.

        Returns:
            (answer, twist): `value` of the answer is m, its z the force, strictly inside where m > 0; twist (6,) or None.
        """
        count, limits = self.grasp.n_contacts, len(self.bound)
        size = self._size(wrench)
        unit = self.frame @ wrench / size
        inward = np.zeros((count, 4))
        inward[:, 0], inward[:, 3] = 1.0, self.soft
        total = np.zeros((1, count, 4))
        total[0, :, 0] = 1.0
        structure = _by_contact(np.concatenate([self.balance, total, self.rows, np.zeros((1, count, 4))]))
        # shared variables (m, r); x = x' + m inward with x' in the cones
        coupling = np.zeros((8 + limits, 2))
        coupling[:6, 0], coupling[:6, 1] = np.einsum("rna,na->r", self.balance, inward), unit
        coupling[6] = count, 1.0
        coupling[7:-1, 0] = np.einsum("rna,na->r", self.rows, inward) + 1.0
        coupling[7:-1, 1] = -self.bound / size
        coupling[-1] = 1.0, -1.0
        right = np.zeros(8 + limits)
        right[6] = 1.0
        state, info = self._run(
            structure, coupling, right, 7, np.zeros((count, 4)), np.array([-1.0, 0.0]), tolerance, 200, 0.1 * CLEAR
        )
        margin, part = float(state.t[0]), float(state.t[1])
        z = state.z + margin * inward
        if not wrench.any() and not self.bound.any():
            z = self._balanced(z, unit)  # homogeneous: of any size
        elif part > 0.0:
            z = self._balanced(z / part, unit)
        twist = None
        if not margin > CLEAR:
            twist = self.frame.T @ state.y[:6]
            twist = twist / max(float(np.abs(twist).max()), 1e-300)
        nothing = np.zeros(limits)
        return Answer(int(info[0]), size * z, int(info[1]), margin, margin, -self.frame.T @ state.y[:6], nothing), twist

    def least_phi(
        self,
        wrench: Wrench,
        weights: Array,
        z: Array,
        tolerance: float,
        optimum: float,
        max_iterations: int,
        trace: Array,
    ) -> Answer:
        """The least Phi from z (N, 4), balanced and strictly inside all limits; see `program_newton`.

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
        row_weights = np.concatenate([np.zeros(6), touched @ weights[:, 1] / touched.sum(axis=1)])
        right = np.concatenate([-self.frame @ wrench, self.bound])
        z, y = z.copy(), np.zeros(len(right))
        code, iterations, trials, value, bound = general_newton(
            self._first, self._touched, self._values, right, 6, self._inverse, weights, row_weights, self.soft, tolerance, optimum,
            max_iterations, z, y, trace,
        )  # fmt: skip
        z = self._balanced(z, self.frame @ wrench)
        return Answer(code, z, iterations, value, bound, -self.frame.T @ y[:6], y[6:] / self.row_size, trials)

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
        return self._balanced(z, self.frame @ wrench)

    def residual(self, z: Array, wrench: Wrench) -> float:
        """Largest |component| of G z + w, moments about the contacts' centre and divided by the grasp's length [N]."""
        return float(np.abs(np.einsum("rna,na->r", self.balance, z) + self.frame @ wrench).max())

    def _inwards(self, z: Array, wrench: Wrench) -> Array:
        """Z mixed with as little of the deepest force as takes the rounding of its last digits out of the limits."""
        deepest, twist = self.deepest(wrench)
        outside, inside = -self.slack(z), self.slack(deepest.z)
        if twist is not None or not inside > 0.0:
            return z
        part = min(1.0, 1.1 * outside / (outside + inside))
        return (1.0 - part) * z + part * deepest.z

    def _size(self, wrench: Wrench) -> float:
        """What forces must be of [N]: the wrench's size, or that of the limits that ask for force."""
        size = max(float(np.abs(self.frame @ wrench).max()), float(-self.bound.min(initial=0.0)))
        return size if size > NOTHING else 1.0

    def _balanced(self, z: Array, unit: Array) -> Array:
        """Takes the last digits of G z + w off z, least norm."""
        return z - self._inverse @ (np.einsum("rna,na->r", self.balance, z) + unit)

    def _certified(self, y: Array, cost: Array, criterion: str, unit: Array, size: float) -> tuple[float, Array, Array]:
        """Multipliers on the segment to interior ones, exactly feasible: (dual value, nu, multipliers of the limits).

        Feasible: s = c + C^T y in the dual cones (w's part >= 0), y >= 0 on the limits. y = 0 is, with s = c; with
        criterion "max" equal shares of the largest force are.
        """
        count = self.grasp.n_contacts
        prices = np.maximum(y[6 : 6 + len(self.bound)], 0.0)
        start = cost.copy()
        if criterion == "max":
            share = np.maximum(y[6 + len(self.bound) :], 0.0)
            cost = cost.copy()
            cost[:, 0] = self._price * share / max(float(share.sum()), 1e-300)
            start[:, 0] = self._price / count
        end = cost + np.einsum("rna,r->na", self.balance, y[:6]) + np.einsum("kna,k->na", self.rows, prices)
        theta = 1.0
        for k in range(count):
            theta = min(theta, _part_inside(start[k, :3], end[k, :3]))
            if self.soft[k] and end[k, 3] < 0.0:
                # w has no price to move away from: raise its row's multiplier, at the expense of u
                row = int(self.soft[:k].sum())
                raised = -end[k, 3] / self.rows[row, k, 3]
                prices[row] += raised
                end[k] += raised * self.rows[row, k]
                theta = min(theta, _part_inside(start[k, :3], end[k, :3]))
        value = theta * (float(y[:6] @ unit) - float(prices @ self.bound) / size)
        return max(value, 0.0), -theta * y[:6], theta * prices / self.row_size

    def _run(
        self, structure: _Structure, coupling: Array, right: Array, equal: int, cost: Array,
        shared_cost: Array, tolerance: float, limit: int, absolute: float = 1e-14,
    ) -> tuple[_State, Array]:  # fmt: skip
        count = self.grasp.n_contacts
        state = _State(
            np.tile([1.0, 0.0, 0.0, 1.0], (count, 1)),
            np.zeros(len(shared_cost)),
            np.concatenate([np.zeros(equal), np.ones(len(right) - equal)]),
            np.tile([1.0, 0.0, 0.0, 1.0], (count, 1)),
        )
        slack, info = np.maximum(1.0, right), np.zeros(6)
        interior_point(
            *structure, coupling, right, equal, cost, shared_cost, self.soft, tolerance, absolute, limit,
            state.z, state.t, state.y, state.s, slack, info,
        )  # fmt: skip
        return state, info


@dataclass(frozen=True, eq=False)
class _State:
    z: Array
    t: Array
    y: Array
    s: Array


def _with_slack(rows: Array) -> Array:
    """Rows (..., 4) in (u, o, t, v) -> in (u, o, t, w), w = u - v."""
    out = rows.copy()
    out[..., 0] += rows[..., 3]
    out[..., 3] = -rows[..., 3]
    return out


def _by_contact(rows: Array) -> _Structure:
    """Rows (m, N, 4) as (first (N + 1,), touched (K,), values (K, 4)): contact after contact, without zeros."""
    contacts, touched = np.nonzero((rows != 0.0).any(axis=2).T)
    first = np.searchsorted(contacts, np.arange(rows.shape[1] + 1)).astype(np.int64)
    return first, touched.astype(np.int64), np.ascontiguousarray(rows[touched, contacts])


def _part_inside(first: Array, last: Array) -> float:
    """Largest theta <= 1 with (1 - theta) first + theta last in the cone; `first` is in it."""
    if last[0] >= np.hypot(last[1], last[2]):
        return 1.0
    move = last - first
    a = move[0] ** 2 - move[1] ** 2 - move[2] ** 2
    b = first[0] * move[0] - first[1] * move[1] - first[2] * move[2]
    c = first[0] ** 2 - first[1] ** 2 - first[2] ** 2
    root = np.sqrt(max(b * b - a * c, 0.0))
    return float(min(1.0, c / (root - b))) if root - b > 0.0 else 0.0

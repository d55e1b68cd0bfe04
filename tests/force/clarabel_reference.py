"""An independent reference: the cone program of any grasp from positions, normals and friction,
solved by Clarabel.

Frames and G are those of the oracles, about the centre of the contacts, moments divided by their
length.

    min c . x   s.t.  G f + w = 0,  n >= sqrt((o / mu_o)^2 + (t / mu_t)^2 + (tau / gamma)^2),  A f
    <= b

without the parts that a contact does not transmit.
"""

from __future__ import annotations

from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from oracles import geometry
from scipy import sparse

from grasp_env.force import ForceLimits
from grasp_env.grasp import Grasp

with suppress(ImportError):
    import clarabel

Array = np.ndarray
Weight = float | Array
SOLVED = ("Solved", "AlmostSolved")


class Optimum(NamedTuple):
    """Clarabel's objective [N], its own relative error (see `own_error`), and whether it reports
    success."""

    objective: float
    error: float
    solved: bool


class Reference:
    """The constraints of a grasp and its limits, for any wrench."""

    def __init__(self, grasp: Grasp, limits: ForceLimits | None = None) -> None:
        points = np.array(grasp.positions)
        normals = np.array(grasp.normals)
        names = np.array(grasp.models.names)
        self.count = count = len(points)
        self.frames = np.array(
            [geometry.frame(*each) for each in zip(normals, grasp.frames[:, :, 1], strict=True)]
        )
        self.centre, self.length, _ = geometry.unit_frame(points)
        self.mu = np.where((names != "frictionless")[:, None], grasp.models.friction, 0.0)
        self.gamma = np.where(names == "soft", grasp.models.torsional_friction, 0.0)
        # columns (n, o, t, tau) of each contact
        self.matrix = np.zeros((6, count, 4))
        self.matrix[:, :, :3] = geometry.grasp_matrix(
            (points - self.centre) / self.length, self.frames
        ).reshape(6, count, 3)
        self.matrix[3:, :, 3] = normals.T / self.length
        self.transmits = np.column_stack(
            [np.ones(count), *[self.mu[:, 0] > 0.0] * 2, self.gamma > 0.0]
        ).astype(float)
        self.matrix *= self.transmits
        self.rows, self.bound, self.limited = self._limits(limits)

    def _limits(self, limits: ForceLimits | None) -> tuple[Array, Array, Array]:
        """A (M, N, 4), b (M,) in the documented order (least normals, largest normals, each joint's
        two torques), and each limit (M,)."""
        rows: list[Array] = []
        bound: list[float] = []
        limited: list[float] = []
        if limits is not None:
            least = np.broadcast_to(np.asarray(limits.min_normal), (self.count,))
            most = np.broadcast_to(np.asarray(limits.max_normal), (self.count,))
            for sign, values in ((-1.0, least), (1.0, most)):
                for k in np.flatnonzero((values > 0.0) & (values < np.inf)):
                    rows.append(sign * np.eye(4 * self.count)[4 * k].reshape(-1, 4))
                    bound.append(sign * values[k])
                    limited.append(values[k])
            if limits.jacobian is not None:
                given = np.asarray(limits.jacobian)
                given = given.reshape(self.count, -1, given.shape[-1])
                jac = np.zeros((self.count, 4, given.shape[-1]))
                jac[:, :3] = self.frames.transpose(0, 2, 1) @ given[:, :3]
                if given.shape[1] == 6:
                    jac[:, 3] = (self.frames[:, None, :, 0] @ given[:, 3:])[:, 0]
                for j, most_torque in enumerate(np.asarray(limits.torque_limit)):
                    for sign in (1.0, -1.0):
                        if np.isfinite(most_torque):
                            rows.append(sign * jac[:, :, j] * self.transmits)
                            bound.append(most_torque - sign * np.asarray(limits.torque_bias)[j])
                            limited.append(most_torque)
        return np.array(rows).reshape(-1, self.count, 4), np.array(bound), np.array(limited)

    def load(self, wrench: Array) -> Array:
        """The wrench about the centre, moments divided by the length [N]."""
        moment = wrench[3:] - np.cross(self.centre, wrench[:3])
        return np.concatenate([wrench[:3], moment / self.length])

    def residual(self, force: Array, torsion: Array, wrench: Array) -> float:
        """Largest |component| of G f + w about the centre, moments divided by the length [N]."""
        f = np.column_stack([force, torsion])
        return float(np.abs(np.einsum("rna,na->r", self.matrix, f) + self.load(wrench)).max())

    def violation(self, force: Array, torsion: Array) -> float:
        """Largest violation of cones and limits [N]; limits divided by their row's length, and what
        a contact does not transmit by one."""
        friction = np.column_stack([self.mu, self.gamma])
        parts = np.column_stack([force[:, 1:], torsion]) / np.where(friction > 0.0, friction, 1.0)
        inside = force[:, 0] - np.sqrt((parts**2).sum(axis=1))
        size = np.sqrt((self.rows**2).sum(axis=(1, 2)))
        excess = -self.room(force, torsion) / np.where(size > 0.0, size, 1.0)
        return float(max(-inside.min(), excess.max(initial=-np.inf)))

    def room(self, force: Array, torsion: Array) -> Array:
        """(M,) slack of each limit."""
        return self.bound - np.einsum("kna,na->k", self.rows, np.column_stack([force, torsion]))

    def excess(self, force: Array, torsion: Array) -> float:
        """Largest excess of a limit as a fraction of it; 0 within all."""
        return float((-self.room(force, torsion) / self.limited).max(initial=0.0))

    def _scaled(self) -> tuple[Array, Array]:
        """mu of cone coordinates u = mu n (N,), and the size of a unit of (u, o, t, v) as (n, o, t,
        tau) (N, 4), 0: not transmitted."""
        mu_o, mu_t = self.mu.T
        mu = np.where(mu_o > 0.0, np.sqrt(mu_o * mu_t), 1.0)
        return mu, np.array([1.0 / mu, mu_o / mu, mu_t / mu, self.gamma / mu]).T

    def _cone(self, force: Array, torsion: Array) -> tuple[Array, Array]:
        """u (N,) and the length of (o, t, v) (N,) in cone coordinates."""
        mu, sizes = self._scaled()
        parts = np.column_stack([force[:, 1:], torsion])
        parts = parts * self.transmits[:, 1:] / np.where(sizes > 0.0, sizes, 1.0)[:, 1:]
        return mu * force[:, 0], np.sqrt((parts**2).sum(axis=1))

    def _row_sizes(self) -> Array:
        """(M,) length of each limit's row in cone coordinates, in which Phi measures the distance
        to it."""
        length = np.sqrt(((self.rows * self._scaled()[1]) ** 2).sum(axis=(1, 2)))
        return np.where(length > 0.0, length, 1.0)

    def _weights(self, omega: Weight, lam: Weight) -> tuple[Array, Array, Array]:
        """omega and lambda of each contact (N,), and lambda of each limit (M,): the mean of the
        contacts whose forces it counts."""
        both = np.broadcast_to(omega, self.count)
        lambdas = np.broadcast_to(lam, self.count)
        touched = (self.rows != 0.0).any(axis=2)
        touched[~touched.any(axis=1)] = True  # a torque that no force changes: all contacts
        return both, lambdas, (touched @ lambdas) / touched.sum(axis=1)

    def phi(self, force: Array, torsion: Array, omega: Weight = 1.0, lam: Weight = 0.01) -> float:
        """Phi by the eigenvalues of P and the distances to limits; +inf outside.

        With k tangential parts of length s, P has the eigenvalues u - s, u + s and, k - 1 times, u;
        with none it is u.
        """
        prices, lambdas, of_rows = self._weights(omega, lam)
        u, s = self._cone(force, torsion)
        room = self.room(force, torsion) / self._row_sizes()
        if min((u - s).min(), u.min(), room.min(initial=1.0)) <= 0.0:
            return np.inf
        total = 3.0 * float(prices @ u) + float((of_rows / room).sum())
        for i, parts in enumerate(self._tangential()):
            values = [u[i]] if parts == 0 else [u[i] - s[i], u[i] + s[i], *[u[i]] * (parts - 1)]
            total += lambdas[i] * float((1.0 / np.array(values)).sum())
        return total

    def _tangential(self) -> list[int]:
        """k of each contact: 0 without friction, 2 hard or elliptic, 3 soft."""
        return [int(each) for each in self.transmits[:, 1:].sum(axis=1)]

    def cone_margin(self, force: Array, torsion: Array) -> float:
        """Least of u - |(o, t, v)| over the contacts, in cone coordinates [N]."""
        u, s = self._cone(force, torsion)
        return float((u - s).min())

    def dual_bound(
        self, nu: Array, prices: Array, wrench: Array, criterion: str = "sum", omega: Weight = 1.0
    ) -> tuple[float, float]:
        """(certified lower bound, theta): multipliers nu (6,) about the origin and prices (M,) of
        the limits, scaled by theta <= 1.

        The objective is the sum or the largest of omega times normal force. With a = c - G^T nu +
        A^T prices in the dual cone a_n >= sqrt((mu_o a_o)^2 + (mu_t a_t)^2 + (gamma a_tau)^2) of
        every contact, -nu . w - prices . b bounds the objective. theta < 1: the multipliers given
        are not dual feasible.
        """
        at_centre = self._at_centre(nu)
        prices = np.maximum(prices, 0.0)
        g, least = self._pull(at_centre, -prices)
        need = (g[:, 0] + least) / np.broadcast_to(omega, self.count)
        most = float(need.max()) if criterion == "sum" else float(np.maximum(need, 0.0).sum())
        theta = 1.0 if most <= 1.0 else 1.0 / most
        # nu . w with the moments where they are smallest
        value = -float(at_centre @ self.load(wrench)) - float(prices @ self.bound)
        return theta * value, theta

    def proof(self, twist: Array, wrench: Array, prices: Array | None = None) -> float:
        """Return the least slack of a proof of infeasibility, relative to its terms; >= 0 is a
        proof, up to rounding.

        q = G^T v + A^T y must lie in every dual cone, and v . w - y . b >= 0.
        """
        y = np.zeros(len(self.bound)) if prices is None or not len(prices) else prices
        v = self._at_centre(twist)
        load = self.load(wrench)
        q, need = self._pull(v, y)
        size = max(np.abs(q).max(), np.abs(self.rows * y[:, None, None]).max(initial=0.0))
        terms = float(np.abs(v * load).sum()) + abs(float(y @ self.bound))
        short = (float(v @ load) - float(y @ self.bound)) / (terms or 1.0)
        return min(float((q[:, 0] - need).min()) / size, short, float(y.min(initial=0.0)))

    def _pull(self, v: Array, y: Array) -> tuple[Array, Array]:
        """q = G^T v + A^T y (N, 4), and the least normal components (N,) of it in the dual cones."""
        q = np.einsum("rna,r->na", self.matrix, v) + np.einsum("kna,k->na", self.rows, y)
        friction = np.column_stack([self.mu, self.gamma])
        return q, np.sqrt(((friction * q[:, 1:]) ** 2).sum(axis=1))

    def _at_centre(self, twist: Array) -> Array:
        """A twist or multipliers (6,) about the origin, about the centre and per length."""
        return np.concatenate(
            [twist[:3] + np.cross(twist[3:], self.centre), twist[3:] * self.length]
        )

    def _program(
        self, wrench: Array, width: int
    ) -> tuple[float, list[Array], list[Array], list[Any]]:
        """The size of the wrench, and rows A x + s = b of balance, then of components that are
        zero, then all inequalities, for x = (n, o, t, tau) of each contact over that size and
        `width - 4N` others."""
        load = self.load(np.asarray(wrench, dtype=float))
        size = float(np.abs(load).max()) or 1.0
        balance = np.zeros((6, width))
        balance[:, : 4 * self.count] = self.matrix.reshape(6, -1)
        each = np.eye(width)
        fixed = each[np.flatnonzero(self.transmits.reshape(-1) == 0.0)]
        linear = [-each[4 * k] for k, parts in enumerate(self._tangential()) if parts == 0]
        lengths = np.sqrt((self.rows**2).sum(axis=(1, 2)))
        lengths[lengths == 0.0] = 1.0
        rest = np.zeros(width - 4 * self.count)
        rows = [
            np.concatenate([row.reshape(-1) / length, rest])
            for row, length in zip(self.rows, lengths, strict=True)
        ]
        bound = np.concatenate([np.zeros(len(linear)), self.bound / size / lengths])
        blocks: list[Array] = [balance, fixed, np.array([*linear, *rows]).reshape(-1, width)]
        right: list[Array] = [-load / size, np.zeros(len(fixed)), bound]
        cones: list = [clarabel.ZeroConeT(6), clarabel.ZeroConeT(len(fixed))]
        cones.append(clarabel.NonnegativeConeT(len(bound)))
        friction = np.column_stack([self.mu, self.gamma])
        for k in np.flatnonzero(self._tangential()):
            parts = np.flatnonzero(friction[k] > 0.0)
            across = [each[4 * k + 1 + a] / friction[k, a] for a in parts]
            blocks.append(-np.array([each[4 * k], *across]))
            right.append(np.zeros(1 + len(parts)))
            cones.append(clarabel.SecondOrderConeT(1 + len(parts)))
        kept = [k for k in range(len(blocks)) if len(blocks[k])]
        return size, *([part[k] for k in kept] for part in (blocks, right, cones))

    def solve(
        self, wrench: Array, criterion: str = "sum", tolerance: float = 1e-11, omega: Weight = 1.0
    ) -> Optimum:
        """The least sum, or largest, of omega times normal force."""
        width = 4 * self.count + (criterion == "max")
        cost = np.zeros(width)
        size, blocks, right, cones = self._program(wrench, width)
        if criterion == "max":
            cost[-1] = 1.0
            blocks.append(
                np.broadcast_to(omega, self.count)[:, None] * np.eye(width)[: 4 * self.count : 4]
                - cost
            )
            right.append(np.zeros(self.count))
            cones.append(clarabel.NonnegativeConeT(self.count))
        else:
            cost[: 4 * self.count : 4] = omega
        matrix = np.vstack(blocks)
        sides = np.concatenate(right)
        found = _run(cost, matrix, sides, cones, tolerance)
        return Optimum(
            size * found.obj_val, own_error(found, cost, matrix, sides), str(found.status) in SOLVED
        )

    def least_excess(self, wrench: Array) -> float:
        """The least possible excess of a limit: one more variable t, every limit raised by t of
        itself; nan: unsolved."""
        width = 4 * self.count + 1
        size, blocks, right, cones = self._program(wrench, width)
        lengths = np.sqrt((self.rows**2).sum(axis=(1, 2)))
        linear = next(k for k, cone in enumerate(cones) if "Nonnegative" in type(cone).__name__)
        blocks[linear][-len(lengths) :, -1] = -self.limited / size / lengths
        rows = np.vstack(blocks)
        found = _run(np.eye(width)[-1], rows, np.concatenate(right), cones, 1e-9)
        return found.obj_val if str(found.status) in SOLVED else float("nan")

    def payload(self, direction: Array, wrench: Array) -> float:
        """The largest k for which a force balances wrench + k direction; nan: unsolved."""
        width = 4 * self.count + 1
        size, blocks, right, cones = self._program(wrench, width)
        blocks[0][:, -1] = self.load(np.asarray(direction, dtype=float))
        found = _run(-np.eye(width)[-1], np.vstack(blocks), np.concatenate(right), cones, 1e-10)
        return -size * found.obj_val if str(found.status) in SOLVED else float("nan")

    def least_torque(self, wrench: Array, rows: Array, bias: Array) -> float:
        """The least |rows f + bias| of a balanced force, rows (J, N, 4) [m], bias (J,) [N m]."""
        width = 4 * self.count + 1
        size, blocks, right, cones = self._program(wrench, width)
        unit = float(np.abs(rows).max())
        norm = np.zeros((1 + len(bias), width))
        norm[0, -1] = -1.0
        norm[1:, :-1] = -rows.reshape(len(bias), -1) / unit
        blocks.append(norm)
        right.append(np.concatenate([[0.0], bias / size / unit]))
        cones.append(clarabel.SecondOrderConeT(1 + len(bias)))
        matrix = np.vstack(blocks)
        sides = np.concatenate(right)
        for tolerance in (1e-10, 1e-8):  # on some processors one problem stops before the first
            found = _run(np.eye(width)[-1], matrix, sides, cones, tolerance)
            if str(found.status) in SOLVED:
                return unit * size * found.obj_val
        return float("nan")

    def least_phi(
        self, wrench: Array, omega: Weight = 1.0, lam: Weight = 0.01
    ) -> tuple[float, float]:
        """(min Phi, Clarabel's own relative error; inf: unsolved), every term as second-order
        cones.

        2u/(u^2 - s^2) <= y where u (u - z) >= s^2 and y z >= 2; 1/u <= r where u r >= 1, counted k -
        1 times, once of frictionless contacts, which have no y; 1/room <= y where room y >= 1.
        """
        count = self.count
        load = self.load(np.asarray(wrench, dtype=float))
        prices, lambdas, of_rows = self._weights(omega, lam)
        price = float(prices.mean())
        # forces are about that, and Phi its price
        unit = max(float(np.abs(load).max()), np.sqrt(float(lambdas.max()) / price))
        roots = np.sqrt(lambdas / price) / unit
        row_roots = np.sqrt(of_rows / price) / unit
        mu, sizes = self._scaled()
        tangential = self._tangential()
        # variables: (n, o, t, tau) of each contact, then (r, y, z) of each, y of each limit
        begins = np.cumsum([4 * count, 3 * count, len(self.bound)])
        width = int(begins[-1])
        each = np.eye(width)
        cost = np.zeros(width)
        cost[: 4 * count : 4] = 3.0 * mu * prices / price
        fixed = [*np.flatnonzero(self.transmits.reshape(-1) == 0.0)]
        for k, parts in enumerate(tangential):
            fixed += [begins[0] + 3 * k + a for a in (1, 2)] if parts == 0 else []
        zero = np.concatenate([np.zeros((6, width)), each[fixed]])
        zero[:6, : 4 * count] = self.matrix.reshape(6, -1)
        blocks = [zero]
        right = [np.concatenate([-load / unit, np.zeros(len(fixed))])]
        cones = [clarabel.ZeroConeT(len(zero))]

        def rotated(
            a: Array, b: Array, others: list[Array], constant: float = 0.0, shift: float = 0.0
        ) -> None:
            """(a + shift) b >= |others|^2 + constant^2."""
            rows = [-(a + b), -(a - b), *(-2.0 * c for c in others), np.zeros(width)]
            offset = np.zeros(len(rows))
            offset[:2], offset[-1] = shift, 2.0 * constant
            blocks.append(np.array(rows))
            right.append(offset)
            cones.append(clarabel.SecondOrderConeT(len(rows)))

        for k, parts in enumerate(tangential):
            u = mu[k] * each[4 * k]
            r, y, z = begins[0] + 3 * k + np.arange(3)
            cost[r] = roots[k] * abs(parts - 1)
            rotated(u, each[r], [], np.sqrt(roots[k]))
            if parts == 0:
                continue
            across = [each[4 * k + a] / sizes[k, a] for a in (1, 2, 3) if sizes[k, a] > 0.0]
            cost[y] = roots[k]
            rotated(u, u - each[z], across)
            rotated(each[y], each[z], [], np.sqrt(2.0 * roots[k]))
        for m, length in enumerate(self._row_sizes()):
            row = np.zeros(width)
            row[: 4 * count] = -self.rows[m].reshape(-1) / length
            at = begins[1] + m
            cost[at] = row_roots[m]
            rotated(row, each[at], [], np.sqrt(row_roots[m]), self.bound[m] / unit / length)
        matrix = np.vstack(blocks)
        sides = np.concatenate(right)
        # almost solved, it may miss balance by 1e-6 of the wrench, which between contacts 1e-6
        # apart is worth a hundredth of Phi
        for tolerance in (1e-10, 1e-8):
            found = _run(cost, matrix, sides, cones, tolerance)
            if str(found.status) == "Solved":
                return price * unit * found.obj_val, own_error(found, cost, matrix, sides)
        return float("nan"), np.inf

    def margin(self, wrench: Array) -> float:
        """Return the depth of a force of total one inside all cones and limits; < 0: infeasible;
        nan: unsolved.

        max m  s.t.  G f + r w = 0,  f deeper than m in its cones, b r - A f >= m, r >= m,  sum n +
        r = 1.
        """
        width = 4 * self.count + 2
        _, blocks, right, cones = self._program(wrench, width)
        # every inequality is b - A x >= 0: b moves to r's column and m shrinks the first row of
        # every cone
        for k, cone in enumerate(cones):
            if "Second" in type(cone).__name__:
                blocks[k][0, -2] = 1.0
            elif "Nonnegative" in type(cone).__name__:
                blocks[k][:, -2:] = np.column_stack([np.ones(len(right[k])), -right[k]])
                right[k] = np.zeros(len(right[k]))
        each = np.eye(width)
        blocks[0][:, -1] = -right[0]
        right[0] = np.zeros(6)
        total = each[-1].copy()
        total[: 4 * self.count : 4] = 1.0
        rows = np.vstack([total, *blocks, each[-2] - each[-1]])
        kinds = [clarabel.ZeroConeT(1), *cones, clarabel.NonnegativeConeT(1)]
        found = _run(-each[-2], rows, np.concatenate([[1.0], *right, [0.0]]), kinds, 1e-10)
        return -found.obj_val if str(found.status) in SOLVED else float("nan")


def own_error(found: Any, cost: Array, matrix: Array, right: Array) -> float:
    """Return Clarabel's own relative error: its gap, and its residuals times their prices.

    Its own residuals are relative to the largest numbers: forces of 1e6 N hide 4 mN in them, which
    cost 50 % at the edge of closure.
    """
    x, s, z = (np.array(each) for each in (found.x, found.s, found.z))
    missed = np.abs(matrix @ x + s - right) @ np.abs(z) + np.abs(matrix.T @ z + cost) @ np.abs(x)
    return (abs(found.obj_val - found.obj_val_dual) + float(missed)) / max(
        abs(found.obj_val), 1e-300
    )


def _run(cost: Array, matrix: Array, right: Array, cones: list, tolerance: float):
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.presolve_enable = False
    settings.max_iter = 200
    settings.tol_gap_abs = 1e-14
    settings.tol_gap_rel = tolerance
    settings.tol_feas = tolerance
    settings.reduced_tol_gap_abs = 1e-9
    settings.reduced_tol_gap_rel = 1e-8
    settings.reduced_tol_feas = 1e-8
    settings.tol_ktratio = 1e-8
    settings.reduced_tol_ktratio = 1e-6
    nothing = sparse.csc_matrix((len(cost), len(cost)))
    return clarabel.DefaultSolver(
        nothing, cost, sparse.csc_matrix(matrix), right, cones, settings
    ).solve()

"""An independent reference: the cone program of any grasp from positions, normals and friction, solved by Clarabel.

Nothing here reads the package's matrices: frames follow the paper's rule, moments are taken about the centre of the contacts.

    min c . x   s.t.  G f + w = 0,  n >= hypot(o / mu_o, t / mu_t),  n >= abs(tau) / gamma,  A f <= b
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from scipy import sparse

from grasp_env.errors import RankDeficientGraspError
from grasp_env.force import ForceLimits
from grasp_env.grasp import Grasp

Array = np.ndarray
SOLVED = ("Solved", "AlmostSolved")
KINDS = ("hard", "elliptic", "soft", "frictionless", "mixed")


@dataclass(frozen=True)
class Optimum:
    """Clarabel's answer.

    Attributes:
        objective, lower: primal and dual objective [N].
        error: how far Clarabel itself may be off: relative gap, and residuals times their prices.
        force: (N, 4) normal, o, t, torsion.
        multipliers: (6,) nu of balance about the object origin: d objective / dw = -nu.
        solved: whether Clarabel reports success.
        infeasible: whether it reports a proof of infeasibility.
    """

    objective: float
    lower: float
    error: float
    force: Array
    multipliers: Array
    solved: bool
    infeasible: bool


def contact_frames(normals: Array, tangents: Array | None = None) -> Array:
    """(N, 3, 3) with columns n, o, t: o is the projection of e_x, of e_y where n is within 26 degrees of e_x."""
    frames = np.empty((len(normals), 3, 3))
    for k, n in enumerate(normals):
        along = np.eye(3)[1 if abs(n[0]) > 0.9 else 0] if tangents is None else tangents[k]
        o = along - n * (n @ along)
        o = o - n * (n @ o)
        o /= np.linalg.norm(o)
        frames[k] = np.column_stack([n, o, np.cross(n, o)])
    return frames


class Reference:
    """The constraints of a grasp and its limits, for any wrench."""

    def __init__(self, grasp: Grasp, limits: ForceLimits | None = None, tangents: Array | None = None) -> None:
        points, normals = np.array(grasp.positions), np.array(grasp.normals)
        self.count = count = len(points)
        self.centre = points.mean(axis=0)
        self.length = float(np.sqrt(((points - self.centre) ** 2).sum() / count))
        self.frames = frames = contact_frames(normals, tangents)
        names = np.array(grasp.models.names)
        self.mu = np.where((names != "frictionless")[:, None], grasp.models.friction, 0.0)
        self.gamma = np.where(names == "soft", grasp.models.torsional_friction, 0.0)
        # columns (n, o, t, tau) of each contact, moments about the centre divided by the length
        matrix = np.zeros((6, count, 4))
        arms = (points - self.centre) / self.length
        matrix[:3, :, :3] = frames.transpose(1, 0, 2)
        matrix[3:, :, :3] = np.cross(arms[:, :, None], frames, axisa=1, axisb=1, axisc=1).transpose(1, 0, 2)
        matrix[3:, :, 3] = normals.T / self.length
        transmits = np.ones((count, 4))
        transmits[:, 1:3] = self.mu > 0.0
        transmits[:, 3] = self.gamma > 0.0
        self.transmits = transmits
        self.matrix = matrix * transmits
        self.rows, self.bound = self._limits(limits)

    def _limits(self, limits: ForceLimits | None) -> tuple[Array, Array]:
        """A (M, N, 4), b (M,) in the documented order: least normals, largest normals, each joint's two torques."""
        rows: list[Array] = []
        bound: list[float] = []
        if limits is not None:
            least = np.broadcast_to(np.asarray(limits.min_normal), (self.count,))
            most = np.broadcast_to(np.asarray(limits.max_normal), (self.count,))
            for sign, values in ((-1.0, least), (1.0, most)):
                for k, value in enumerate(values):
                    if 0.0 < value < np.inf:
                        row = np.zeros((self.count, 4))
                        row[k, 0] = sign
                        rows.append(row)
                        bound.append(sign * value)
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
        return np.array(rows).reshape(-1, self.count, 4), np.array(bound)

    def load(self, wrench: Array) -> Array:
        """The wrench about the centre, moments divided by the length [N]."""
        moment = wrench[3:] - np.cross(self.centre, wrench[:3])
        return np.concatenate([wrench[:3], moment / self.length])

    def residual(self, force: Array, torsion: Array, wrench: Array) -> float:
        """Largest |component| of G f + w about the centre, moments divided by the length [N]."""
        f = np.column_stack([force, torsion])
        return float(np.abs(np.einsum("rna,na->r", self.matrix, f) + self.load(wrench)).max())

    def violation(self, force: Array, torsion: Array) -> float:
        """Largest violation of cones, torsion bounds and limits [N]; limits divided by their row's length."""
        n, o, t = force.T
        mu_o, mu_t = self.mu.T
        rough = mu_o > 0.0
        inside = np.where(
            rough, n - np.hypot(o / np.where(rough, mu_o, 1.0), t / np.where(rough, mu_t, 1.0)), n - np.hypot(o, t)
        )
        soft = self.gamma > 0.0
        spin = np.where(soft, n - np.abs(torsion) / np.where(soft, self.gamma, 1.0), n - np.abs(torsion))
        f = np.column_stack([force, torsion])
        size = np.sqrt((self.rows**2).sum(axis=(1, 2)))
        excess = (np.einsum("kna,na->k", self.rows, f) - self.bound) / np.where(size > 0.0, size, 1.0)
        return float(max(-inside.min(), -spin.min(), excess.max(initial=-np.inf)))

    def dual_bound(self, nu: Array, prices: Array, wrench: Array, criterion: str = "sum") -> tuple[float, float]:
        """(certified lower bound, theta): multipliers nu (6,) about the origin and prices (M,) of the limits, scaled by theta <= 1.

        With a = c - G^T nu + A^T prices in the dual cone a_n >= hypot(mu_o a_o, mu_t a_t) + gamma abs(a_tau) of every contact,
        -nu . w - prices . b bounds the objective. theta < 1: the multipliers given are not dual feasible.
        """
        at_centre = np.concatenate([nu[:3] + np.cross(nu[3:], self.centre), nu[3:] * self.length])
        prices = np.maximum(prices, 0.0)
        g = np.einsum("rna,r->na", self.matrix, at_centre) - np.einsum("kna,k->na", self.rows, prices)
        need = g[:, 0] + np.hypot(self.mu[:, 0] * g[:, 1], self.mu[:, 1] * g[:, 2]) + self.gamma * np.abs(g[:, 3])
        most = float(need.max()) if criterion == "sum" else float(np.maximum(need, 0.0).sum())
        theta = 1.0 if most <= 1.0 else 1.0 / most
        # nu . w with the moments where they are smallest
        value = -float(at_centre @ self.load(wrench)) - float(prices @ self.bound)
        return theta * value, theta

    def separates(self, twist: Array, wrench: Array) -> float:
        """How far a twist v separates the wrench: (v . w + least v . G f) / (size of v . w); > 0 proves infeasibility.

        Without limits the least is 0 where G_i^T v is in every dual cone, -inf elsewhere; the violation of the dual cones relative
        to v is then returned, negative. With limits the least is found by Clarabel.
        """
        v = np.concatenate([twist[:3] + np.cross(twist[3:], self.centre), twist[3:] * self.length])
        v = v / np.abs(v).max()
        load = self.load(wrench)
        work = float(v @ load) / float(np.abs(load).max(initial=1e-300))
        g = np.einsum("rna,r->na", self.matrix, v)
        inside = g[:, 0] - np.hypot(self.mu[:, 0] * g[:, 1], self.mu[:, 1] * g[:, 2]) - self.gamma * np.abs(g[:, 3])
        if not len(self.bound):
            return min(work, float(inside.min())) if inside.min() < 0.0 else work
        size = float(np.abs(load).max()) or 1.0
        blocks, right, cones = self._cones(4 * self.count, size)
        found = _run(g.reshape(-1), np.vstack(blocks), np.concatenate(right), cones, 1e-10)
        if "PrimalInfeasible" in str(found.status):
            return np.inf  # no force keeps the limits at all: every twist separates
        # where Clarabel stops short of its own 1e-10, a closed gap will do
        closed = str(found.status) in SOLVED or abs(found.obj_val - found.obj_val_dual) < 1e-6 * abs(found.obj_val)
        return work + found.obj_val_dual if closed else -np.inf

    def _cones(self, width: int, size: float) -> tuple[list[Array], list[Array], list]:
        """Rows A x + s = b of everything but balance, for x = (n, o, t, tau) of each contact and `width - 4N` others."""
        clarabel = import_module("clarabel")
        blocks: list[Array] = []
        right: list[Array] = []
        cones: list = []
        fixed = np.flatnonzero(self.transmits.reshape(-1) == 0.0)
        if len(fixed):
            rows = np.zeros((len(fixed), width))
            rows[np.arange(len(fixed)), fixed] = 1.0
            blocks.append(rows)
            right.append(np.zeros(len(fixed)))
            cones.append(clarabel.ZeroConeT(len(fixed)))
        linear: list[Array] = []
        for k in range(self.count):
            if self.gamma[k] > 0.0:
                for sign in (1.0, -1.0):
                    row = np.zeros(width)
                    row[4 * k], row[4 * k + 3] = -1.0, sign / self.gamma[k]
                    linear.append(row)
            if self.mu[k, 0] == 0.0:
                row = np.zeros(width)
                row[4 * k] = -1.0
                linear.append(row)
        bound = [0.0] * len(linear)
        for row, value in zip(self.rows, self.bound, strict=True):
            length = np.sqrt((row**2).sum()) or 1.0
            linear.append(np.concatenate([row.reshape(-1) / length, np.zeros(width - 4 * self.count)]))
            bound.append(value / size / length)
        if linear:
            blocks.append(np.array(linear))
            right.append(np.array(bound))
            cones.append(clarabel.NonnegativeConeT(len(linear)))
        for k in np.flatnonzero(self.mu[:, 0] > 0.0):
            rows = np.zeros((3, width))
            rows[0, 4 * k], rows[1, 4 * k + 1], rows[2, 4 * k + 2] = -1.0, -1.0 / self.mu[k, 0], -1.0 / self.mu[k, 1]
            blocks.append(rows)
            right.append(np.zeros(3))
            cones.append(clarabel.SecondOrderConeT(3))
        return blocks, right, cones

    def solve(self, wrench: Array, criterion: str = "sum", tolerance: float = 1e-11) -> Optimum:
        """The least sum, or largest, of the normal forces."""
        clarabel = import_module("clarabel")
        wrench = np.asarray(wrench, dtype=float)
        load = self.load(wrench)
        size = float(np.abs(load).max()) or 1.0
        width = 4 * self.count + (criterion == "max")
        cost = np.zeros(width)
        blocks, right, cones = self._cones(width, size)
        balance = np.zeros((6, width))
        balance[:, : 4 * self.count] = self.matrix.reshape(6, -1)
        blocks, right = [balance, *blocks], [-load / size, *right]
        cones = [clarabel.ZeroConeT(6), *cones]
        if criterion == "max":
            cost[-1] = 1.0
            rows = np.zeros((self.count, width))
            rows[np.arange(self.count), 4 * np.arange(self.count)] = 1.0
            rows[:, -1] = -1.0
            blocks.append(rows)
            right.append(np.zeros(self.count))
            cones.append(clarabel.NonnegativeConeT(self.count))
        else:
            cost[: 4 * self.count : 4] = 1.0
        matrix, load = np.vstack(blocks), np.concatenate(right)
        found = _run(cost, matrix, load, cones, tolerance)
        x, nu = np.array(found.x), -np.array(found.z)[:6]
        nu = np.concatenate([nu[:3] - np.cross(nu[3:] / self.length, self.centre), nu[3:] / self.length])
        return Optimum(
            size * found.obj_val,
            size * found.obj_val_dual,
            own_error(found, cost, matrix, load),
            size * x[: 4 * self.count].reshape(-1, 4),
            nu,
            str(found.status) in SOLVED,
            "PrimalInfeasible" in str(found.status),
        )

    def margin(self, wrench: Array) -> float:
        """How deep a force of total one (with the wrench's share) lies inside everything; < 0: infeasible; nan: unsolved.

        max m  s.t.  G f + r w = 0,  f deeper than m in its cones, b r - A f >= m, r >= m,  sum n + r = 1.
        """
        clarabel = import_module("clarabel")
        load = self.load(np.asarray(wrench, dtype=float))
        size = float(np.abs(load).max()) or 1.0
        width = 4 * self.count + 2
        blocks, right, cones = self._cones(width, size)
        # every inequality is b - A x >= 0: b moves to r's column and m shrinks the first row of every cone
        for k, cone in enumerate(cones):
            rows = blocks[k]
            if "Zero" in type(cone).__name__:
                continue
            if "Second" in type(cone).__name__:
                rows[0, -2] = 1.0
            else:
                rows[:, -2] = 1.0
                rows[:, -1] = -right[k]
                right[k] = np.zeros(len(rows))
        balance = np.zeros((7, width))
        balance[:6, : 4 * self.count] = self.matrix.reshape(6, -1)
        balance[:6, -1] = load / size
        balance[6, : 4 * self.count : 4] = 1.0
        balance[6, -1] = 1.0
        last = np.zeros((1, width))
        last[0, -2], last[0, -1] = 1.0, -1.0
        cost = np.zeros(width)
        cost[-2] = -1.0
        found = _run(
            cost,
            np.vstack([balance, *blocks, last]),
            np.concatenate([np.eye(7)[6], *right, [0.0]]),
            [clarabel.ZeroConeT(7), *cones, clarabel.NonnegativeConeT(1)],
            1e-10,
        )
        return -found.obj_val if str(found.status) in SOLVED else float("nan")


def own_error(found: Any, cost: Array, matrix: Array, right: Array) -> float:
    """How far Clarabel itself may be off, relative to its objective: its gap, what it misses of each row at the row's price, and of
    each variable's price at that variable.

    Its own residuals are relative to the largest numbers: forces of 1e6 N hide 4 mN in them, which cost 50 % at the edge of closure.
    """
    x, s, z = (np.array(each) for each in (found.x, found.s, found.z))
    missed = np.abs(matrix @ x + s - right) @ np.abs(z) + np.abs(matrix.T @ z + cost) @ np.abs(x)
    return (abs(found.obj_val - found.obj_val_dual) + float(missed)) / max(abs(found.obj_val), 1e-300)


def _run(cost: Array, matrix: Array, right: Array, cones: list, tolerance: float):
    clarabel = import_module("clarabel")
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.presolve_enable = False
    settings.max_iter = 200
    settings.tol_gap_abs, settings.tol_gap_rel, settings.tol_feas = 1e-14, tolerance, tolerance
    settings.reduced_tol_gap_abs, settings.reduced_tol_gap_rel, settings.reduced_tol_feas = 1e-9, 1e-8, 1e-8
    settings.tol_ktratio, settings.reduced_tol_ktratio = 1e-8, 1e-6
    width = len(cost)
    solver = clarabel.DefaultSolver(
        sparse.csc_matrix((width, width)), cost, sparse.csc_matrix(matrix), right, cones, settings
    )
    return solver.solve()


def random_grasp(rng: np.random.Generator, kind: str, flat: float = 1.0, most: int = 20) -> Grasp:
    """Contacts on an ellipsoid or a box of 1 mm to 10 m away from the origin; normals off by some degrees; friction 0.1 to 1.2.

    Args:
        rng: the generator.
        kind: of `KINDS`; frictionless grasps have nine contacts or more.
        flat: the third axis relative to the others; small: nearly coplanar.
        most: contacts, but for three grasps in a hundred of 50 or 100 (where `most` is 20 or more).
    """
    count = int(rng.integers(2 if kind == "soft" else 3, most + 1))
    if most >= 20 and rng.random() < 0.03:
        count = int(rng.choice([50, 100]))
    if kind == "frictionless":
        count = max(count, 9)
    size = 10.0 ** rng.uniform(-3.0, 1.0)
    axes = size * rng.uniform(0.4, 1.0, 3) * (1.0, 1.0, flat)
    if rng.random() < 0.5:
        directions = rng.standard_normal((count, 3))
        positions = directions / np.linalg.norm(directions, axis=1)[:, None] * axes
        normals = -positions / axes**2
    else:
        face, side = rng.integers(0, 3, count), rng.choice([-1.0, 1.0], count)
        positions, normals = rng.uniform(-1.0, 1.0, (count, 3)), np.zeros((count, 3))
        positions[np.arange(count), face], normals[np.arange(count), face] = side, -side
        positions = positions * axes
    normals = normals / np.linalg.norm(normals, axis=1)[:, None] + 0.1 * rng.standard_normal((count, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    shape = (count, 2) if kind in ("elliptic", "mixed") else count
    names = {"mixed": list(rng.choice(["hard", "soft", "frictionless"], count)), "elliptic": "hard"}
    return Grasp.from_contacts(
        positions + size * rng.uniform(-2.0, 2.0, 3),
        normals,
        rng.uniform(0.1, 1.2, shape),
        contact_model=names.get(kind, kind),
        torsional_friction=size * 10.0 ** rng.uniform(-3.0, 0.0, count),
    )


def some_grasp(rng: np.random.Generator, kind: str, most: int = 20) -> Grasp:
    """`random_grasp`, drawn again where its G has not rank 6 (frictionless contacts among few)."""
    while True:
        with suppress(RankDeficientGraspError):
            return random_grasp(rng, kind, most=most)


def random_wrench(rng: np.random.Generator, grasp: Grasp, least: float = 1e-6, most: float = 1e4) -> Array:
    """A wrench of `least` to `most` newtons at the centre of the contacts, with or without a moment about it."""
    size = 10.0 ** rng.uniform(np.log10(least), np.log10(most))
    force = size * rng.standard_normal(3)
    moment = size * grasp.length * rng.choice([0.0, 0.1, 1.0]) * rng.standard_normal(3)
    return np.concatenate([force, moment + np.cross(grasp.positions.mean(axis=0), force)])


def random_limits(rng: np.random.Generator, grasp: Grasp, size: float) -> ForceLimits:
    """Normal forces and torques of joints that couple all contacts, tight to loose for wrenches of `size` newtons."""
    count, given = grasp.n_contacts, {}
    if rng.random() < 0.6:
        given["max_normal"] = size * 10.0 ** rng.uniform(-0.7, 1.0, count if rng.random() < 0.5 else None)
    if rng.random() < 0.5:
        given["min_normal"] = 0.3 * np.min(given.get("max_normal", size)) * rng.uniform()
    if rng.random() < 0.6:
        joints = int(rng.integers(1, 7))
        given["jacobian"] = grasp.length * rng.standard_normal((count, int(rng.choice([3, 6])), joints))
        given["torque_limit"] = size * grasp.length * 10.0 ** rng.uniform(-0.3, 1.5, joints)
        if rng.random() < 0.5:
            given["torque_bias"] = 0.1 * given["torque_limit"] * rng.uniform(-1.0, 1.0, joints)
    return ForceLimits(**given)

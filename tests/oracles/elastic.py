"""The force inside the cones that nearly balances a wrench, where contacts cannot; one that exceeds
limits least, where it must."""

from __future__ import annotations

import numpy as np
from oracles.boundary import longest_step
from oracles.phi import gradient, hessian, phi
from scipy.optimize import minimize


def elastic(
    x: np.ndarray, matrix: np.ndarray, wrench: np.ndarray, weights: np.ndarray, softness: float
) -> np.ndarray:
    """argmin Phi(x) + |G x + w|^2 / (2 softness), (3N,), by dense Newton from x strictly inside the
    cones."""

    def value(x: np.ndarray) -> float:
        missed = matrix @ x + wrench
        return phi(x, weights) + float(missed @ missed) / (2.0 * softness)

    for _ in range(300):
        slope = gradient(x, weights) + matrix.T @ (matrix @ x + wrench) / softness
        step = -np.linalg.solve(hessian(x, weights) + matrix.T @ matrix / softness, slope)
        if -slope @ step < 1e-16 * value(x):
            break
        alpha = min(1.0, 0.9 * longest_step(x, step))
        while alpha > 1e-12 and not value(x + alpha * step) < value(x):
            alpha *= 0.5
        x = x + alpha * step
    return x


def spread_matrix(positions: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(6, 4N) wrench of forces (N, 3) in the positions' frame, then of torsions (N,); moments about
    the centre, over the spread."""
    arms = positions - positions.mean(0)
    moments = np.concatenate(
        [np.cross(arm, axis)[:, None] for arm in arms for axis in np.eye(3)], 1
    )
    turns = np.concatenate([np.zeros((3, len(arms))), normals.T])
    matrix = np.concatenate([np.concatenate([np.tile(np.eye(3), len(arms)), moments]), turns], 1)
    matrix[3:] /= np.sqrt((arms**2).sum(1).mean())
    return matrix


def spread_wrench(positions: np.ndarray, wrench: np.ndarray) -> np.ndarray:
    """The wrench (6,) in the units of `spread_matrix`."""
    arms = positions - positions.mean(0)
    moment = wrench[3:] - np.cross(positions.mean(0), wrench[:3])
    return np.concatenate([wrench[:3], moment / np.sqrt((arms**2).sum(1).mean())])


def penalised(
    given: dict[str, np.ndarray], answer: np.ndarray, softness: float = 0.0
) -> np.floating:
    """The function that an elastic force minimises, of one problem with the names of `grasp_force`
    and isotropic friction.

    The answer is forces (N, 3) in the frame of the positions, then torsions (N,). Normals have
    length one. With a softness, missing balance costs |G f + w|^2 / (2 softness). The value is a
    long double if the numbers are.
    """
    normals = given["normals"]
    count = len(normals)
    friction = given["friction"][:, 0]
    mu = np.where(friction > 0.0, friction, 1.0)
    gamma = given.get("torsional_friction", np.zeros(count))
    omega = given.get("force_weight", np.full(count, 1.0))
    lam = given.get("barrier_weight", np.full(count, 0.01))
    force = answer[: 3 * count].reshape(count, 3)
    torsion = answer[3 * count :]
    pressure = (force * normals).sum(1)
    total = answer.dtype.type(0.0)
    for i in range(count):
        u = mu[i] * pressure[i]
        square = answer.dtype.type(0.0)
        parts = 0  # tangential: two of friction, one of torsion
        if friction[i] > 0.0:
            square += ((force[i] - pressure[i] * normals[i]) ** 2).sum()
            parts += 2
        if gamma[i] > 0.0:
            square += (mu[i] / gamma[i] * torsion[i]) ** 2
            parts += 1
        s = np.sqrt(square)
        if not s < u:
            return np.float64(np.inf)
        total += 3.0 * omega[i] * u + lam[i] * ((parts - 1) / u + 2.0 * u / ((u - s) * (u + s)))
    if "max_normal" in given:
        total += sum(map(_barrier, given["max_normal"] - pressure, 1.0 / mu, lam, omega))
    for j in range(given["jacobian"].shape[2] if "jacobian" in given else 0):
        lever = given["jacobian"][:, :3, j]
        turn = np.zeros(count)
        if given["jacobian"].shape[1] == 6:
            turn = (given["jacobian"][:, 3:, j] * normals).sum(1)
        along = (lever * normals).sum(1)
        across = np.where(friction > 0.0, (lever**2).sum(1) - along**2, 0.0)
        sizes = (along / mu) ** 2 + across + (gamma * turn / mu) ** 2
        touched = sizes > 0.0
        torque = (lever * force).sum() + (turn * torsion).sum()
        for sign in (1.0, -1.0):
            room = given["torque_limit"][j] - sign * torque
            total += _barrier(
                room, np.sqrt(sizes.sum()), lam[touched].mean(), omega[touched].mean()
            )
    if softness:
        missed = spread_matrix(given["positions"], normals) @ answer + spread_wrench(
            given["positions"], given["wrench"]
        )
        total += (missed**2).sum() / (2.0 * softness)
    return total


def _barrier(
    room: np.floating, size: np.floating, weight: np.floating, omega: np.floating
) -> np.floating | float:
    """The elastic barrier of a limit a .

    z <= bound, `room` away from it; the row has the length `size` in (u, o, t, v).

    Below 0.1 sqrt(weight / omega), weight / slack goes on as a parabola with the same value, slope
    and curvature.
    """
    if not np.isfinite(room):
        return 0.0
    slack = room / size
    edge = 0.1 * np.sqrt(weight / omega)
    below = min(slack - edge, 0.0) / edge
    return weight / max(slack, edge) * (1.0 - below + below**2)


def excess(force: np.ndarray, normals: np.ndarray, most: np.ndarray) -> float:
    """Sum of the squared excesses of the normal forces [N^2]."""
    return float((np.maximum((force * normals).sum(1) - most, 0.0) ** 2).sum())


def least_excess(
    force: np.ndarray, normals: np.ndarray, friction: float, most: np.ndarray, balance: np.ndarray
) -> np.ndarray | None:
    """Another force of least `excess` in the cones with the wrench balance (6, 3N) @ force, by
    SLSQP from `force`; None: not found."""

    def room(flat: np.ndarray) -> np.ndarray:
        pressure = (flat.reshape(force.shape) * normals).sum(1)
        across = ((flat.reshape(force.shape) - pressure[:, None] * normals) ** 2).sum(1)
        return np.concatenate([(friction * pressure) ** 2 - across, pressure])

    def missed(flat: np.ndarray) -> np.ndarray:
        return balance @ (flat - force.ravel())

    def cost(flat: np.ndarray) -> float:
        return excess(flat.reshape(force.shape), normals, most)

    rules = [{"type": "ineq", "fun": room}, {"type": "eq", "fun": missed}]
    found = minimize(
        cost, force.ravel(), constraints=rules, method="SLSQP", options={"maxiter": 300}
    )
    good = room(found.x).min() > -1e-6 and np.abs(missed(found.x)).max() < 1e-6
    return found.x.reshape(force.shape) if good else None

"""Phase one: a force strictly inside the cones that balances a wrench, or the twist that proves there is none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grasp_env._check import Array, ContactForces, Wrench, as_wrench
from grasp_env.errors import NotConvergedError
from grasp_env.grasp.grasp import Grasp

_GAP = 1e-9
"""Below this scaled margin a wrench counts as balanced only on the boundary of the cones."""


@dataclass(frozen=True)
class Feasibility:
    """Answer of `phase_one`.

    Attributes:
        force: (N, 3) balanced and strictly inside [N]; None when infeasible.
        certificate: (6,) a twist v with G_i^T v in every dual cone and v . w >= 0: then v . (G f + w) = 0 forces every
            contact onto the boundary (v . w = 0) or is impossible (v . w > 0). None when feasible.
    """

    force: ContactForces | None
    certificate: Array | None

    @property
    def feasible(self) -> bool:
        """Whether a strictly feasible force exists."""
        return self.force is not None


def phase_one(grasp: Grasp, wrench: Wrench) -> Feasibility:
    """Min s s.t. G x + r w = 0, x_i + s e inside cone i, r + s > 0, s > -1, sum (u_i + s) + r + s = 1.

    The homogeneous variable r and the last equation make the set bounded whatever the grasp: s < 0 proves that x / r
    is strictly feasible; multipliers of a centred iterate with a positive dual value prove that nothing is. About thirty
    dense (3N + 9) Newton steps: meant for set-up and for errors, not for a control loop.

    Args:
        grasp: the grasp.
        wrench: (6,) external wrench; zero asks for a strictly interior internal force (force closure).

    Raises:
        NotConvergedError: neither a force nor a proof after 400 steps (slow is not infeasible).

    Example:
        >>> from grasp_env.grasp import presets
        >>> phase_one(presets.tripod(), np.zeros(6)).feasible
        True
    """
    wrench = as_wrench(wrench)
    scale = np.concatenate([np.ones(3), np.full(3, grasp.length)])
    g = grasp.cone_matrix / scale[:, None]
    cones = g.shape[1]
    w = wrench / scale
    norm = float(np.abs(w).max())
    loaded = norm > 0.0
    e = np.concatenate([np.tile([1.0, 0.0, 0.0], grasp.n_contacts), np.ones(int(loaded))])
    columns = np.column_stack([g, w / norm]) if loaded else g
    size = len(e)
    y, s = e / float(e @ e), 1.0 / float(e @ e)
    kkt = np.zeros((size + 8, size + 8))
    kkt[size + 1 : size + 7, :size] = columns
    kkt[size + 1 : size + 7, size] = -columns @ e
    kkt[size + 7, :size] = e
    kkt[: size + 1, size + 1 :] = -kkt[size + 1 :, : size + 1].T
    weight = 1.0
    for _ in range(400):
        gradient, hessian = _barrier(y, cones)
        kkt[:size, :size] = hessian
        kkt[size, size] = 1.0 / (s + 1.0) ** 2
        right = np.concatenate([gradient, [weight - 1.0 / (s + 1.0)], columns @ (y - s * e), [e @ y - 1.0]])
        step = np.linalg.solve(kkt, -right)
        dy, ds, multipliers = step[:size], float(step[size]), step[size + 1 :] / weight
        decrement = float(dy @ hessian @ dy) + ds * ds * kkt[size, size]
        alpha = 1.0 if decrement < 0.05 else 1.0 / (1.0 + decrement**0.5)
        y, s = y + alpha * dy, s + alpha * ds
        if decrement >= 0.05:
            continue
        gap = (2 * grasp.n_contacts + 2) / weight
        if s < -gap:  # interior, and deep compared with how deep it can be
            x = y - s * e
            return Feasibility(grasp.to_force(x[:cones] * (norm / x[-1] if loaded else 1.0)), None)
        dual = -multipliers @ kkt[size + 1 :, :size]
        blocks = dual[:cones].reshape(-1, 3)
        in_dual_cones = (blocks[:, 0] >= np.hypot(blocks[:, 1], blocks[:, 2])).all() and (dual[cones:] >= 0.0).all()
        if (in_dual_cones and multipliers[6] > 0.0) or gap < _GAP:
            twist = -multipliers[:6] / scale
            return Feasibility(None, twist / max(float(np.abs(twist).max()), 1e-300))
        weight *= 8.0
    raise NotConvergedError(f"phase one found neither a force nor a proof for wrench {wrench.tolist()} in 400 steps")


def _barrier(y: Array, cones: int) -> tuple[Array, Array]:
    """Gradient and Hessian of -sum log(u^2 - o^2 - t^2) - log r at y = (cones..., r)."""
    blocks = y[:cones].reshape(-1, 3)
    signed = blocks * np.array([1.0, -1.0, -1.0])
    d = np.einsum("ij,ij->i", blocks, signed)[:, None]
    slopes = -2.0 * signed / d
    gradient = np.concatenate([slopes.reshape(-1), -1.0 / y[cones:]])
    hessian = np.diag(np.concatenate([np.zeros(cones), 1.0 / y[cones:] ** 2]))
    for k, (slope, scale) in enumerate(zip(slopes, d[:, 0], strict=True)):
        block = np.outer(slope, slope) - np.diag([2.0, -2.0, -2.0]) / scale
        hessian[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = block
    return gradient, hessian

"""The paper's contribution: the flow on the 3N force components, VP_{k+1} = VP_k + alpha_k Q_bar VWP_k (Eqs. 18-26).

The compiled loop is `flow_kernels.flow`; the functions here are its plain twin and make Q_bar.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grasp_env._check import Array
from grasp_env.force.descent import Landscape
from grasp_env.force.full_flow import projector
from grasp_env.force.objective import Objective
from grasp_env.grasp.grasp import Grasp

METRIC = np.array([3.0, 2.0, 2.0])
"""|P|_F^2 = 3 u^2 + 2 o^2 + 2 t^2 per contact."""


def picked_rows(count: int) -> NDArray[np.int_]:
    """Eq. 19, zero-based, for N = `count` contacts: the rows of Q that move u, o and t of each contact.

    Printed for four contacts as m = 39 floor((i-1)/3) + 2^(2^(i - 3 floor((i-1)/3) - 1)) - 1, one-based; 39 is
    9N + 3. Rows 1, 3 and 15 = 12 + 3 of a block are its entries (1, 1), (3, 1) and (3, 2).

    Example:
        >>> picked_rows(4)[:6] + 1
        array([ 1,  3, 15, 40, 42, 54])
    """
    block, line = np.divmod(np.arange(3 * count), 3)
    offset = np.where(line == 2, 3 * count + 3, 2 ** (2**line) - 1)
    return (9 * count + 3) * block + offset - 1


def picked_columns(count: int) -> NDArray[np.int_]:
    """Eq. 21, zero-based: the columns n, n + 1, n + 2 of Q that meet the 3 x 3 blocks of VWP, (9N,).

    Printed for four contacts as n = 39 floor((j-1)/3) + 12 (j - 3 floor((j-1)/3) - 1) + 1, one-based.
    """
    block, line = np.divmod(np.arange(3 * count), 3)
    first = (9 * count + 3) * block + 3 * count * line
    return (first[:, None] + np.arange(3)).reshape(-1)


def picked_projector(grasp: Grasp) -> Array:
    """Q_bar (3N, 9N), picked from the dense Q by Eqs. 19-21: 12 x 36 for four fingers."""
    q = projector(grasp)
    return q[np.ix_(picked_rows(grasp.n_contacts), picked_columns(grasp.n_contacts))]


def reduced_projector(grasp: Grasp) -> Array:
    """The same Q_bar (3N, 9N) in closed form, without the dense Q: microseconds instead of a millisecond.

    With S: (u, o, t) -> vec of its P block and D = S^T S = diag(3, 2, 2), the projector on the affine space is
    S Pi S^T, Pi = D^-1 - D^-1 G^T (G D^-1 G^T)^-1 G D^-1; its picked rows are Pi S^T.
    """
    g = grasp.cone_matrix.copy()
    g[3:] /= grasp.length  # the projector does not depend on the unit of moments, its rounding does
    count = grasp.n_contacts
    weight = 1.0 / np.tile(METRIC, count)
    scaled = g * weight
    pi = np.diag(weight) - scaled.T @ np.linalg.solve(scaled @ g.T, scaled)
    blocks = pi.reshape(3 * count, count, 3)
    q_bar = np.zeros((3 * count, count, 9))
    q_bar[:, :, 0] = q_bar[:, :, 4] = q_bar[:, :, 8] = blocks[:, :, 0]
    q_bar[:, :, 2] = q_bar[:, :, 6] = blocks[:, :, 1]
    q_bar[:, :, 5] = q_bar[:, :, 7] = blocks[:, :, 2]
    return q_bar.reshape(3 * count, 9 * count)


def flow_vector(x: Array, objective: Objective) -> Array:
    """VWP (9N,): the blocks P_i^-1 W_i P_i^-1 - W_p at VP = x, column by column (Eqs. 22-25)."""
    parts = []
    for (u, o, t), (omega, lam) in zip(x.reshape(-1, 3), objective.weights(len(x) // 3), strict=True):
        inverse = np.linalg.inv(np.array([[u, 0.0, o], [0.0, u, t], [o, t, u]]))
        block = lam * inverse @ inverse - omega * np.eye(3)
        parts.append(block.reshape(-1, order="F"))
    return np.concatenate(parts)


def landscape(grasp: Grasp, objective: Objective) -> Landscape:
    """What the plain descent walks on: VP and Q_bar."""
    q_bar = reduced_projector(grasp)

    def curvature(x: Array, move: Array) -> float:
        steps = move.reshape(-1, 3)
        return float(np.einsum("ni,nij,nj->", steps, objective.hessian(x), steps))

    return Landscape(
        value=objective.value,
        gradient=objective.gradient,
        curvature=curvature,
        direction=lambda x: q_bar @ flow_vector(x, objective),
        metric=np.tile(METRIC, grasp.n_contacts),
    )

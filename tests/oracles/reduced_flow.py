"""The paper's contribution: the flow on the 3N force components, VP_{k+1} = VP_k + alpha_k Q_bar
VWP_k (Eqs. 18-26).

matrix is G (6, 3N) in cone coordinates, weights as for `full_flow.py`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from oracles.descent import Landscape
from oracles.full_flow import matrix_weights, projector
from oracles.phi import gradient, hessian, phi

METRIC = np.array([3.0, 2.0, 2.0])
"""|P|_F^2 = 3 u^2 + 2 o^2 + 2 t^2 per contact."""


def picked_rows(count: int) -> NDArray[np.int_]:
    """Eq.

    19, zero-based, for N = `count` contacts: the rows of Q that move u, o and t of each contact.

    Printed for four contacts as m = 39 floor((i-1)/3) + 2^(2^(i - 3 floor((i-1)/3) - 1)) - 1,
    one-based; 39 is 9N + 3. Rows 1, 3 and 15 = 12 + 3 of a block are its entries (1, 1), (3, 1) and
    (3, 2).
    """
    block, line = np.divmod(np.arange(3 * count), 3)
    offset = np.where(line == 2, 3 * count + 3, 2 ** (2**line) - 1)
    return (9 * count + 3) * block + offset - 1


def picked_columns(count: int) -> NDArray[np.int_]:
    """Eq.

    21, zero-based: the columns n, n + 1, n + 2 of Q that meet the 3 x 3 blocks of VWP, (9N,).

    Printed for four contacts as n = 39 floor((j-1)/3) + 12 (j - 3 floor((j-1)/3) - 1) + 1,
    one-based.
    """
    block, line = np.divmod(np.arange(3 * count), 3)
    first = (9 * count + 3) * block + 3 * count * line
    return (first[:, None] + np.arange(3)).reshape(-1)


def picked_projector(matrix: np.ndarray) -> np.ndarray:
    """Q_bar (3N, 9N), picked from the dense Q by Eqs. 19-21: 12 x 36 for four fingers."""
    count = matrix.shape[1] // 3
    return projector(matrix)[np.ix_(picked_rows(count), picked_columns(count))]


def reduced_projector(matrix: np.ndarray) -> np.ndarray:
    """The same Q_bar (3N, 9N) in closed form, without the dense Q.

    With S: (u, o, t) -> vec of its P block and D = S^T S = diag(3, 2, 2), the projector on the
    affine space is S Pi S^T, Pi = D^-1 - D^-1 G^T (G D^-1 G^T)^-1 G D^-1; its picked rows are Pi
    S^T.
    """
    count = matrix.shape[1] // 3
    weight = np.tile(1.0 / METRIC, count)
    scaled = matrix * weight
    pi = np.diag(weight) - scaled.T @ np.linalg.solve(scaled @ matrix.T, scaled)
    blocks = pi.reshape(3 * count, count, 3)
    q_bar = np.zeros((3 * count, count, 9))
    q_bar[:, :, 0] = q_bar[:, :, 4] = q_bar[:, :, 8] = blocks[:, :, 0]
    q_bar[:, :, 2] = q_bar[:, :, 6] = blocks[:, :, 1]
    q_bar[:, :, 5] = q_bar[:, :, 7] = blocks[:, :, 2]
    return q_bar.reshape(3 * count, 9 * count)


def flow_vector(x: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """VWP (9N,): the blocks P_i^-1 W_i P_i^-1 - W_p at VP = x, column by column (Eqs. 22-25)."""
    parts = []
    for (u, o, t), (omega, lam) in zip(x.reshape(-1, 3), matrix_weights(weights), strict=True):
        inverse = np.linalg.inv(np.array([[u, 0.0, o], [0.0, u, t], [o, t, u]]))
        block = lam * inverse @ inverse - omega * np.eye(3)
        parts.append(block.reshape(-1, order="F"))
    return np.concatenate(parts)


def landscape(matrix: np.ndarray, weights: np.ndarray) -> Landscape:
    """Return Phi on VP with the closed-form projector, for the plain descent."""
    q_bar = reduced_projector(matrix)
    return Landscape(
        value=lambda x: float(phi(x, weights)),
        gradient=lambda x: gradient(x, weights),
        curvature=lambda x, move: float(move @ hessian(x, weights) @ move),
        direction=lambda x: q_bar @ flow_vector(x, weights),
        metric=np.tile(METRIC, len(weights)),
    )

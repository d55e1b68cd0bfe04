"""The full linearly constrained gradient flow on vec(P) (paper, Eqs. 6-12): dense.

matrix is G (6, 3N) in cone coordinates, weights (N, 3) those of `phi.py`, (N, 2) those of hard
contacts. P of a frictionless contact is u times the identity.
"""

from __future__ import annotations

import numpy as np


def constraints(matrix: np.ndarray) -> np.ndarray:
    """A of Eq. 9: 6N structure rows (A_1, Eq. 6) over 6 balance rows (A_2, Eq. 8), (6N + 6, 9 N^2).

    vec stacks columns. The structure rows of block i say: the two zeros, the two equalities of the
    diagonal, the two symmetries. The balance rows read u, o, t at the entries (1, 1), (3, 1) and
    (3, 2) of each block, so that A vec(P) = [0; -w] with w the external wrench (Eq. 2).
    """
    size = matrix.shape[1]
    count = size // 3
    structure = np.zeros((6 * count, size * size))
    balance = np.zeros((6, size * size))
    for block in range(count):

        def entry(row: int, column: int, block: int = block) -> int:
            return (3 * block + column) * size + 3 * block + row

        rows = structure[6 * block : 6 * block + 6]
        rows[0, entry(0, 1)] = 1.0
        rows[1, entry(1, 0)] = 1.0
        for line, (plus, minus) in enumerate(
            (((0, 0), (1, 1)), ((0, 0), (2, 2)), ((2, 0), (0, 2)), ((2, 1), (1, 2))), 2
        ):
            rows[line, entry(*plus)] = 1.0
            rows[line, entry(*minus)] = -1.0
        for column, place in enumerate(((0, 0), (2, 0), (2, 1))):
            balance[:, entry(*place)] = matrix[:, 3 * block + column]
    return np.concatenate([structure, balance])


def projector(matrix: np.ndarray) -> np.ndarray:
    """Q = I - A^T (A A^T)^-1 A, (9 N^2, 9 N^2): 144 x 144 for four fingers (Eq. 11)."""
    a = constraints(matrix)
    return np.eye(a.shape[1]) - a.T @ np.linalg.solve(a @ a.T, a)


def start(x: np.ndarray) -> np.ndarray:
    """vec(P_0) of cone coordinates (3N,)."""
    whole = np.zeros((len(x), len(x)))
    for k, (u, o, t) in enumerate(x.reshape(-1, 3)):
        whole[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = [[u, 0.0, o], [0.0, u, t], [o, t, u]]
    return whole.reshape(-1, order="F")


def matrix_weights(weights: np.ndarray) -> np.ndarray:
    """(N, 2) omega and lambda of W_p and W_i.

    tr P^-1 counts 1/u of a frictionless contact three times, Phi once.
    """
    out = np.array(weights[:, :2], dtype=float)
    if weights.shape[1] == 3:
        assert np.isin(weights[:, 2], (-1.0, 1.0)).all()
        out[:, 1] /= np.where(weights[:, 2] < 0.0, 3.0, 1.0)
    return out


def drive(state: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """vec(P^-1 W_i P^-1 - W_p) at vec(P)."""
    inverse = np.linalg.inv(_matrix(state))
    omega, lam = np.repeat(matrix_weights(weights), 3, axis=0).T
    return (inverse * lam @ inverse - np.diag(omega)).reshape(-1, order="F")


def cone_coordinates(state: np.ndarray) -> np.ndarray:
    """VP (3N,) of vec(P): the entries (1, 1), (3, 1), (3, 2) of each block (Eq. 18)."""
    matrix = _matrix(state)
    i = np.arange(0, len(matrix), 3)
    return np.stack([matrix[i, i], matrix[i + 2, i], matrix[i + 2, i + 1]], axis=1).reshape(-1)


def _matrix(state: np.ndarray) -> np.ndarray:
    size = round(len(state) ** 0.5)
    return state.reshape(size, size, order="F")

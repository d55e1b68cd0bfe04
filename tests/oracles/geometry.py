"""Contact frames, the grasp matrix and its least-norm inverse (paper, Sec. II)."""

from __future__ import annotations

import numpy as np


def frame(normal: np.ndarray, along: np.ndarray | None = None) -> np.ndarray:
    """(3, 3) columns (n, o, t): o the projection of `along` on the tangent plane, of e_x (e_y where
    |n_x| > 0.9) without one."""
    n = normal / np.linalg.norm(normal)
    axis = np.eye(3)[1 if abs(n[0]) > 0.9 else 0] if along is None else along
    o = axis - n * (axis @ n)
    o = o - n * (o @ n)  # once more: what rounding left where `along` is close to n
    o = o / np.linalg.norm(o)
    return np.stack([n, o, np.cross(n, o)], axis=1)


def directions() -> np.ndarray:
    """Uniform, the six axes, and both sides of the switch of the tangents; unit length to rounding."""
    rng = np.random.default_rng(0)
    sides = [
        (s * x, a)
        for x in 0.9 + np.array([-1e-9, 0.0, 1e-9])
        for s in (1.0, -1.0)
        for a in rng.uniform(0, 6.3, 5)
    ]
    around = [[x, np.sqrt(1 - x * x) * np.cos(a), np.sqrt(1 - x * x) * np.sin(a)] for x, a in sides]
    every = np.concatenate([rng.standard_normal((200, 3)), np.eye(3), -np.eye(3), around])
    return every / np.linalg.norm(every, axis=1)[:, None]


def grasp_matrix(positions: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """G (6, 3N): a column is the force and the moment p x force of a unit force along n, o or t."""
    columns = [
        np.concatenate([axis, np.cross(p, axis)])
        for p, axes in zip(positions, frames, strict=True)
        for axis in axes.T
    ]
    return np.array(columns).T


def unit_frame(positions: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """Centre, length [m] (root mean square distance from it) and the map (6, 6): wrench -> force,
    moment there / length."""
    centre = positions.mean(axis=0)
    length = float(np.sqrt(((positions - centre) ** 2).sum(axis=1).mean()))
    shift = np.eye(6)
    for k, axis in enumerate(np.eye(3)):
        shift[3:, k] = -np.cross(centre, axis)
    shift[3:] /= length if length > 0.0 else 1.0
    return centre, length, shift


def least_norm_inverse(matrix: np.ndarray) -> np.ndarray:
    """G^+ by the singular values of G, (columns, 6)."""
    u, s, vt = np.linalg.svd(matrix, full_matrices=False)
    return (vt.T / s) @ u.T


def rank_ratio(matrix: np.ndarray) -> float:
    """Least over largest of six singular values."""
    s = np.linalg.svd(matrix, compute_uv=False)
    return float(s[5] / s[0]) if len(s) == 6 and s[0] > 0.0 else 0.0


def internal_dimensions(
    positions: np.ndarray, normals: np.ndarray, models: list[str]
) -> tuple[int, int]:
    """Dimensions of the forces that make no wrench, and of the forces and torsions that make none.

    A rough contact sends forces along the object's axes, since any three will do, a frictionless
    one along its normal alone.
    """
    centre, length, _ = unit_frame(positions)
    forces = list[np.ndarray]()
    torsions = list[np.ndarray]()
    for arm, n, model in zip((positions - centre) / (length or 1.0), normals, models, strict=True):
        axes = [n] if model == "frictionless" else np.eye(3)
        forces += [np.concatenate([axis, np.cross(arm, axis)]) for axis in axes]
        torsions += [np.concatenate([np.zeros(3), n])] if model == "soft" else []

    def nullity(rows: list[np.ndarray]) -> int:
        s = np.linalg.svd(np.array(rows), compute_uv=False)
        return len(rows) - int((s > 1e-8 * s[0]).sum())

    return nullity(forces), nullity(forces + torsions)


def polar_basis(directions: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Orthonormal internal forces closest to `directions` (3N, 3N - 6): the polar factor of their
    projection."""
    internal = np.linalg.svd(matrix)[2][6:].T
    u, _, vt = np.linalg.svd(internal @ (internal.T @ directions), full_matrices=False)
    return u @ vt

"""Labelled wrenches: the optimum of Phi for each, and the metric in which missing it costs Phi."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from grasp_env._compile import compiled
from grasp_env.errors import NotConvergedError
from grasp_env.force import Objective, OfflineBasis
from grasp_env.force.kernels import cholesky, inverse_hessian
from grasp_env.force.lanes import CONSTANTS, options, pack_into
from grasp_env.force.newton_kernels import GIVEN, newton
from grasp_env.force.record import BOUND, FORCE, OBJECTIVE
from grasp_env.force.start_kernels import combine
from grasp_env.grasp import Grasp, null_space_basis
from grasp_env.grasp.wrench import sample_magnitudes


@dataclass(frozen=True)
class Dataset:
    """Wrenches with their optima.

    Attributes:
        wrenches: (B, 6) [N, N m].
        friction: (B,).
        coordinates: (B, K) null-space coordinates of the optimum [N].
        metric: (B, K, K) upper factors R: |R (z - z*)|^2 is the relative gap of Phi to second order.
        least: (B,) min Phi [N].
    """

    wrenches: np.ndarray
    friction: np.ndarray
    coordinates: np.ndarray
    metric: np.ndarray
    least: np.ndarray

    def __len__(self) -> int:
        return len(self.wrenches)


def generate(
    grasp: Grasp,
    reference: np.ndarray,
    objective: Objective,
    rng: np.random.Generator,
    count: int,
    magnitudes: tuple[float, float],
    frictions: tuple[float, float],
    workers: int = 2,
) -> Dataset:
    """Samples and labels `count` wrenches with the compiled Newton solver (relative gap 1e-10).

    Args:
        grasp: the contacts; its friction is replaced.
        reference: see `null_space_basis`.
        objective: Phi.
        rng: source of every sample.
        count: how many.
        magnitudes: [N] range of |(force, moment / 0.05 m)|, log-uniform.
        frictions: range, uniform.
        workers: threads (the kernel releases the GIL).

    Raises:
        NotConvergedError: a label missed 1e-6, which would train on a wrong answer.
    """
    wrenches = sample_magnitudes(rng, count, *magnitudes)
    friction = rng.uniform(*frictions, count)
    # a force inside the narrowest cones is inside all: one basis serves every friction
    basis = OfflineBasis.of(grasp.with_friction(frictions[0]), objective).cone_forces
    null_space = null_space_basis(grasp, reference)
    coordinates = np.empty((count, null_space.shape[1]), np.float32)
    metric = np.empty((count, null_space.shape[1], null_space.shape[1]), np.float32)
    least = np.empty(count)

    def work(part: slice) -> float:
        return _label(
            wrenches[part],
            friction[part],
            grasp.unit_frame @ grasp.matrix,
            grasp.pseudoinverse @ np.linalg.inv(grasp.unit_frame),
            null_space,
            basis,
            frictions[0],
            objective.weights(grasp.n_contacts),
            options(grasp, 1e-10, 200),
            coordinates[part],
            metric[part],
            least[part],
        )

    edges = np.linspace(0, count, workers + 1).astype(int)
    with ThreadPoolExecutor(workers) as pool:
        worst = max(pool.map(work, (slice(a, b) for a, b in pairwise(edges))))
    if worst > 1e-6:
        raise NotConvergedError(f"a training label has a relative gap of {worst:.2g}")
    return Dataset(wrenches, friction, coordinates, metric, least)


@compiled
def _label(
    wrenches, friction, matrix, pseudoinverse, null_space, basis, basis_friction, weights, options, coordinates, metric,
    least,
):  # fmt: skip
    size, dimension = null_space.shape
    x = np.empty(size)
    cone_matrix = np.empty((6, size))
    blocks = np.empty((size // 3, 3, 3))
    reduced = np.empty((dimension, dimension))
    scaled = np.empty((size, dimension))
    nothing = np.empty(0)
    divisor, inverse = np.ones((size // 3, 3)), np.empty((size, 6))
    constants = np.empty(((size // 3 + 3) // 4, 4 * CONSTANTS))
    record = np.empty(FORCE + 7 * (size // 3))
    worst = 0.0
    for sample in range(wrenches.shape[0]):
        mu = friction[sample]
        combine(basis, wrenches[sample], False, x)
        for j in range(size):
            ratio = mu if j % 3 == 0 else 1.0
            if j % 3 == 0:
                x[j] /= basis_friction  # the start, as a force
                divisor[j // 3, 0] = mu
            for i in range(6):
                cone_matrix[i, j] = matrix[i, j] / ratio
                inverse[j, i] = pseudoinverse[j, i] * ratio
            for k in range(dimension):
                scaled[j, k] = null_space[j, k] * ratio
        pack_into(cone_matrix, inverse, x, divisor, weights, constants)
        newton(constants, null_space, GIVEN, x, wrenches[sample], weights, options, record, nothing)
        value, bound = record[OBJECTIVE], record[BOUND]
        worst = max(worst, (value - bound) / bound)
        least[sample] = value
        for j in range(size):
            x[j] = record[FORCE + j] * (mu if j % 3 == 0 else 1.0)
        inverse_hessian(x, weights, blocks)
        reduced[:] = 0.0
        for c in range(size // 3):
            hessian = np.linalg.inv(blocks[c])
            for a in range(dimension):
                for b in range(dimension):
                    for row in range(3):
                        for column in range(3):
                            reduced[a, b] += scaled[3 * c + row, a] * hessian[row, column] * scaled[3 * c + column, b]
        cholesky(reduced)
        root = np.sqrt(0.5 / value)
        for a in range(dimension):
            total = 0.0
            for j in range(size):
                total += null_space[j, a] * (x[j] / mu if j % 3 == 0 else x[j])
            coordinates[sample, a] = total
            for b in range(dimension):
                metric[sample, a, b] = reduced[b, a] * root if b >= a else 0.0
    return worst

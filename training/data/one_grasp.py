"""Labelled wrenches: the optimum of Phi for each, and the metric of the relative gap near it."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from grasp_env.errors import NotConvergedError
from grasp_env.force import Objective, optimize_forces
from grasp_env.grasp import Grasp
from grasp_env.grasp.null_space import null_space_basis
from grasp_env.grasp.wrench import MAGNITUDE_LENGTH, sample_ball, sample_magnitudes
from grasp_env.inputs.arguments import Array

LABEL_GAP, LABEL_ITERATIONS = 1e-10, 200
BALL = 0.7
"""Share of the wrenches from the ball on which starts are compared."""
LEAN = 0.3
"""The density of frictions is 1 -+ LEAN at the ends: more where the flow takes more steps."""
CHUNK = 4096
"""Samples whose metric is computed at once."""


@dataclass(frozen=True)
class Source:
    """Distribution of the wrenches on a grasp.

    Attributes:
        grasp: the contacts; its mean friction is replaced.
        magnitudes: range of the wrenches' norm in the grasp's unit frame [N], log-uniform.
        frictions: range of the mean friction coefficient.
        paper: True for the paper's ball, about the object's origin; else a ball of that size in the
            grasp's unit frame.
    """

    grasp: Grasp
    magnitudes: tuple[float, float]
    frictions: tuple[float, float]
    paper: bool

    def ball(self, rng: np.random.Generator, count: int) -> Array:
        """Draw wrenches (count, 6) of the ball."""
        wrenches = sample_ball(rng, count)
        return wrenches if self.paper else self._from_unit(wrenches)

    def draw(
        self, rng: np.random.Generator, count: int, groups: int, ball: float = BALL
    ) -> tuple[np.ndarray, np.ndarray]:
        """Draw about `count` wrenches (B, 6) and their frictions (B,), equal within a group.

        Args:
            rng: source of every sample.
            count: number of wrenches; each group has at least one.
            groups: number of frictions, each from its own part of the range.
            ball: share of the wrenches that are drawn from the ball.
        """
        per = max(1, count // groups)
        low, high = self.frictions
        share = (np.arange(groups) + rng.random(groups)) / groups
        root = np.sqrt((1.0 - LEAN) ** 2 + 4.0 * LEAN * share)
        friction = low + (high - low) * (root - (1.0 - LEAN)) / (2.0 * LEAN)
        wrenches = self._from_unit(sample_magnitudes(rng, groups * per, *self.magnitudes))
        inside = self.ball(rng, groups * per)
        wrenches = np.where(rng.random(groups * per)[:, None] < ball, inside, wrenches)
        return wrenches, friction.repeat(per)

    def _from_unit(self, wrenches: Array) -> Array:
        """Transform wrenches (B, 6) of the unit frame, moments over 0.05 m, to the object frame."""
        scaled = wrenches / np.repeat([1.0, MAGNITUDE_LENGTH], 3)
        return scaled @ np.linalg.inv(self.grasp.unit_frame).T


def with_mean_friction(grasp: Grasp, friction: float) -> Grasp:
    """Scale all friction coefficients of a grasp, so that their mean is `friction`."""
    return grasp.with_friction(grasp.models.friction * (friction / float(grasp.friction.mean())))


@dataclass(frozen=True)
class Dataset:
    """Wrenches with their optima.

    Attributes:
        wrenches: (B, 6) [N, N m].
        friction: (B,).
        coordinates: (B, K) null-space coordinates of the optimum [N].
        metric: (B, K, K) upper factors R: |R (z - z*)|^2 is the relative gap of Phi to second
            order.
        least: (B,) min Phi [N].
    """

    wrenches: np.ndarray
    friction: np.ndarray
    coordinates: np.ndarray
    metric: np.ndarray
    least: np.ndarray

    def __len__(self) -> int:
        return len(self.wrenches)


def label(
    grasp: Grasp,
    reference: np.ndarray,
    objective: Objective,
    wrenches: np.ndarray,
    friction: np.ndarray,
    workers: int = 2,
) -> Dataset:
    """Label wrenches (B, 6) [N, N m] by Newton's method to a relative gap of 1e-10.

    The mean frictions are (B,). For `reference` see `null_space_basis`; `workers` are threads.

    Raises:
        NotConvergedError: a label has a relative gap above 1e-6.
    """
    count = len(wrenches)
    grasps = {mu: with_mean_friction(grasp, mu) for mu in np.unique(friction).tolist()}
    options = {
        "tolerance": LABEL_GAP,
        "max_iterations": LABEL_ITERATIONS,
        "workers": workers,
        **vars(objective),
    }
    solutions = optimize_forces([grasps[mu] for mu in friction.tolist()], wrenches, **options)
    null_space = null_space_basis(grasp, reference)
    dimension = null_space.shape[1]
    metric = np.empty((count, dimension, dimension), np.float32)
    force = solutions.force.reshape(count, -1)
    least = solutions.objective
    bound = solutions.lower_bound
    with np.errstate(divide="ignore", invalid="ignore"):
        worst = np.where(bound > 0.0, least / bound - 1.0, np.inf).max(initial=0.0)
    if not worst <= 1e-6:
        raise NotConvergedError(f"a training label has a relative gap of {worst:.2g}")

    def work(begin: int) -> None:
        chunk = slice(begin, begin + CHUNK)
        scales = np.array([grasps[mu].models.cone_scale for mu in friction[chunk].tolist()])
        metric[chunk] = _metric(force[chunk], scales, null_space, objective, least[chunk])

    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(work, range(0, count, CHUNK)))
    return Dataset(wrenches, friction, (force @ null_space).astype(np.float32), metric, least)


def _metric(
    force: Array, scales: Array, null_space: Array, objective: Objective, least: Array
) -> Array:
    """Return upper factors (B, K, K) of the Hessian of Phi over 2 min Phi.

    It is in null-space coordinates, at the optimal forces (B, 3N) [N].

    `scales` (B, N, 3) are those of cone coordinates, `null_space` is (3N, K), `least` (B,) min Phi.
    """
    samples, contacts = scales.shape[:2]
    x = force * scales.reshape(samples, -1)
    # all contacts at once: the Hessian is linear in lambda
    blocks = Objective(1.0, 1.0).hessian(x.reshape(-1)).reshape(samples, contacts, 3, 3)
    blocks *= objective.weights(contacts)[:, 1, None, None]
    scaled = (scales.reshape(samples, -1, 1) * null_space).reshape(samples, contacts, 3, -1)
    reduced = np.einsum("bcra,bcrs,bcsk->bak", scaled, blocks, scaled, optimize=True)
    lower = np.linalg.cholesky(reduced * (0.5 / least)[:, None, None])
    return lower.transpose(0, 2, 1)

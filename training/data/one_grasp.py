"""Labelled wrenches: the optimum of Phi for each, and the metric of the relative gap near it."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from grasp_env import core
from grasp_env.errors import NotConvergedError, SimulationError
from grasp_env.force import Objective, optimize_forces
from grasp_env.grasp import Grasp
from grasp_env.grasp.null_space import null_space_basis
from grasp_env.grasp.wrench import MAGNITUDE_LENGTH, sample_ball, sample_magnitudes
from grasp_env.inputs.arguments import Array, unit_vectors
from policies.places import Places
from training.data.grasps import closes

LABEL_GAP, LABEL_ITERATIONS = 1e-10, 200
BALL = 0.7
"""Share of the wrenches from the ball on which starts are compared."""
LEAN = 0.3
"""The density of frictions is 1 -+ LEAN at the ends: more where the flow takes more steps."""
SMOOTH = 0.3
"""Deviation of a wrench from the played one that it is drawn from, in their standard deviations."""
CHUNK = 4096
"""Samples whose metric is computed at once."""
MOVED = 3e-3
"""Largest displacement of a contact on the object [m]."""
_TRIES = 100


@dataclass(frozen=True)
class Drawn:
    """Wrenches in groups; a group shares its contacts.

    Attributes:
        grasps: (F,) contacts.
        moves: (F, 2N) their displacements, see `policies.places.Places`; (F, 0) if they stay.
        wrenches: (F, B, 6) [N, N m].
    """

    grasps: list[Grasp]
    moves: Array
    wrenches: Array

    @property
    def friction(self) -> Array:
        """Mean friction coefficients (F,)."""
        return np.array([float(grasp.friction.mean()) for grasp in self.grasps])


@dataclass(frozen=True)
class Source:
    """Distribution of the wrenches and the contacts.

    Attributes:
        grasp: the contacts; its mean friction is replaced.
        magnitudes: range of the wrenches' norm in the grasp's unit frame [N], log-uniform.
        frictions: range of the mean friction coefficient.
        paper: True for the paper's ball, about the object's origin; else a ball of that size in the
            grasp's unit frame.
        played: (B, 6) wrenches of an environment instead of a ball.
        surface: the object on which the contacts move by at most `MOVED`; None: they stay.
    """

    grasp: Grasp
    magnitudes: tuple[float, float]
    frictions: tuple[float, float]
    paper: bool
    played: Array | None = None
    surface: core.Surface | None = None

    def ball(self, rng: np.random.Generator, count: int) -> Array:
        """Draw wrenches (count, 6) of the ball, or near those played."""
        if self.played is not None:
            chosen = self.played[rng.integers(len(self.played), size=count)]
            return chosen + SMOOTH * self.played.std(axis=0) * rng.standard_normal((count, 6))
        wrenches = sample_ball(rng, count)
        return wrenches if self.paper else self._from_unit(wrenches)

    def draw(self, rng: np.random.Generator, count: int, groups: int, ball: float = BALL) -> Drawn:
        """Draw wrenches and contacts; the arguments are those of `loads`."""
        wrenches, friction = self.loads(rng, count, groups, ball)
        grasps = [with_mean_friction(self.grasp, mu) for mu in friction.tolist()]
        moves = np.zeros((groups, 0))
        if self.surface is not None:
            places = Places.of(self.grasp, MOVED)
            grasps = [moved(rng, grasp, self.surface) for grasp in grasps]
            moves = np.array([places(grasp) for grasp in grasps])
        return Drawn(grasps, moves, wrenches)

    def loads(
        self, rng: np.random.Generator, count: int, groups: int, ball: float = BALL
    ) -> tuple[Array, Array]:
        """Draw about `count` wrenches (F, B, 6) and their frictions (F,).

        Args:
            rng: source of every sample.
            count: number of wrenches; each group has at least one.
            groups: number of groups; each has a friction from its own part of the range.
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
        return wrenches.reshape(groups, per, 6), friction

    def _from_unit(self, wrenches: Array) -> Array:
        """Transform wrenches (B, 6) of the unit frame, moments over 0.05 m, to the object frame."""
        scaled = wrenches / np.repeat([1.0, MAGNITUDE_LENGTH], 3)
        return scaled @ np.linalg.inv(self.grasp.unit_frame).T


def moved(rng: np.random.Generator, grasp: Grasp, surface: core.Surface) -> Grasp:
    """Move each contact by at most `MOVED` on the object, so that the grasp still closes.

    Raises:
        SimulationError: it closes with none of many moves.
    """
    for _ in range(_TRIES):
        way = unit_vectors(rng.standard_normal(grasp.positions.shape))
        points = grasp.positions + MOVED * rng.random((grasp.n_contacts, 1)) * way
        found = [surface.nearest(point) for point in points]
        positions, normals = (
            np.array([one[0] for one in found]),
            np.array([one[1] for one in found]),
        )
        there = Grasp.from_contacts(positions, normals, grasp.friction)
        if closes(there):
            return there
    raise SimulationError(
        f"none of {_TRIES} grasps with contacts moved by {1e3 * MOVED:g} mm closes: give more friction"
    )


def with_mean_friction(grasp: Grasp, friction: float) -> Grasp:
    """Scale all friction coefficients of a grasp, so that their mean is `friction`."""
    return grasp.with_friction(grasp.models.friction * (friction / float(grasp.friction.mean())))


@dataclass(frozen=True)
class Dataset:
    """Optima of wrenches in groups.

    Attributes:
        coordinates: (F, B, K) null-space coordinates of the optimum [N].
        metric: (F, B, K, K) upper factors R: |R (z - z*)|^2 is the relative gap of Phi to second
            order.
        least: (F, B) min Phi [N].
    """

    coordinates: np.ndarray
    metric: np.ndarray
    least: np.ndarray


def label(drawn: Drawn, reference: np.ndarray, objective: Objective, workers: int = 2) -> Dataset:
    """Label wrenches by Newton's method to a relative gap of 1e-10.

    For `reference` see `null_space_basis`; `workers` are threads.

    Raises:
        NotConvergedError: a label has a relative gap above 1e-6.
    """
    groups, per = drawn.wrenches.shape[:2]
    options = {
        "tolerance": LABEL_GAP,
        "max_iterations": LABEL_ITERATIONS,
        "workers": workers,
        **vars(objective),
    }
    repeated = [grasp for grasp in drawn.grasps for _ in range(per)]
    solutions = optimize_forces(repeated, drawn.wrenches.reshape(-1, 6), **options)
    dimension = reference.shape[1]
    force = solutions.force.reshape(groups, per, -1)
    least = solutions.objective.reshape(groups, per)
    bound = solutions.lower_bound.reshape(groups, per)
    with np.errstate(divide="ignore", invalid="ignore"):
        worst = np.where(bound > 0.0, least / bound - 1.0, np.inf).max(initial=0.0)
    if not worst <= 1e-6:
        raise NotConvergedError(f"a training label has a relative gap of {worst:.2g}")
    metric = np.empty((groups, per, dimension, dimension), np.float32)
    coordinates = np.empty((groups, per, dimension), np.float32)

    def work(group: int) -> None:
        grasp = drawn.grasps[group]
        null_space = null_space_basis(grasp, reference)
        coordinates[group] = force[group] @ null_space
        for begin in range(0, per, CHUNK):
            chunk = slice(begin, begin + CHUNK)
            metric[group, chunk] = _metric(
                force[group, chunk],
                grasp.models.cone_scale,
                null_space,
                objective,
                least[group, chunk],
            )

    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(work, range(groups)))
    return Dataset(coordinates, metric, least)


def _metric(
    force: Array, scale: Array, null_space: Array, objective: Objective, least: Array
) -> Array:
    """Return upper factors (B, K, K) of the Hessian of Phi over 2 min Phi.

    It is in null-space coordinates, at the optimal forces (B, 3N) [N].

    `scale` (N, 3) is that of cone coordinates, `null_space` is (3N, K), `least` (B,) min Phi [N].
    """
    samples, contacts = len(force), len(scale)
    x = force * scale.reshape(-1)
    # all contacts at once: the Hessian is linear in lambda
    blocks = Objective(1.0, 1.0).hessian(x.reshape(-1)).reshape(samples, contacts, 3, 3)
    blocks *= objective.weights(contacts)[:, 1, None, None]
    scaled = (scale.reshape(-1, 1) * null_space).reshape(contacts, 3, -1)
    reduced = np.einsum("cra,bcrs,csk->bak", scaled, blocks, scaled, optimize=True)
    lower = np.linalg.cholesky(reduced * (0.5 / least)[:, None, None])
    return lower.transpose(0, 2, 1)

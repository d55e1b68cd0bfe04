"""Labelled starts on many grasps: wrenches, two starts each (12-basis, carried previous solution) and the least Phi."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from grasp_env import core
from grasp_env._check import Array
from grasp_env.errors import NotConvergedError
from grasp_env.force import Objective
from grasp_env.force.basis import core_contacts
from grasp_env.force.record import BOUND, FORCE, OBJECTIVE, record_size
from grasp_env.grasp import Grasp
from policies.newton_layers import Problems
from training.data.grasps import basis_of, random_grasps, shaken

OBJECTIVE_LEARNED = Objective()
UNIT = float(np.sqrt(OBJECTIVE_LEARNED.weights(1)[0, 1] / OBJECTIVE_LEARNED.weights(1)[0, 0]))
"""[N] what the layers measure forces in: sqrt(lambda / omega)."""
MAGNITUDES, TINY, TINY_SHARE = (0.1, 30.0), (1e-3, 0.1), 0.1
"""[N] |wrench in the unit frame|, log-uniform in the first range or, for that share, in the second."""
ONE_SIDED = 0.3
"""Share of wrenches that are mostly force or mostly moment."""
JUMPS = (0.01, 2.0)
"""How far away the previous wrench was, in magnitudes, log-uniform."""
TWINS = 0.2
"""Share of grasps with a twin whose contacts lie elsewhere: half of the previous solutions on it belong to the twin."""
LABEL_GAP, ACCEPTED_GAP, LABEL_ITERATIONS = 1e-10, 1e-7, 300
MOST_CONTACTS = 5


@dataclass(frozen=True)
class Pool:
    """Samples on grasps; forces and Phi in units of `UNIT`, cone coordinates, contacts padded to five.

    Attributes:
        rows: (G, 6, 5, 3) G of every grasp in the unit frame.
        mask: (G, 5) 1 for contacts.
        rest: (G, 5, 3) optimum without a wrench.
        grasp: (M,) which grasp a sample is on.
        wrench: (M, 6) in the unit frame.
        starts: {"basis", "carried"}: (M, 5, 3) balanced forces strictly inside the cones.
        least: (M,) min Phi.
        refused: samples that were dropped because their label did not converge.
    """

    rows: Tensor
    mask: Tensor
    rest: Tensor
    grasp: Tensor
    wrench: Tensor
    starts: dict[str, Tensor]
    least: Tensor
    refused: int

    def __len__(self) -> int:
        return len(self.least)

    def problems(self, samples: Tensor) -> Problems:
        """What `NewtonLayers` reads, for some samples."""
        grasp = self.grasp[samples]
        return Problems(self.rows[grasp], self.mask[grasp], self.rest[grasp])


def make_pool(rng: np.random.Generator, grasps: int, samples: int, contacts: Sequence[int] = (3, 4, 5)) -> Pool:
    """Draws grasps and samples on them, and labels these.

    Args:
        rng: source of all numbers.
        grasps: how many, twins included.
        samples: how many are drawn; see `label`.
        contacts: numbers of contacts to draw.
    """
    made, partner = _with_twins(rng, grasps, contacts)
    index = rng.integers(0, len(made), samples)
    wrench, before = _wrenches(rng, samples)
    twin = np.where(rng.random(samples) < 0.5, partner[index], index)
    return label(made, index, wrench, twin, before)


def label(
    made: list[tuple[Grasp, Array]],
    index: np.ndarray,
    wrench: Array,
    before_index: np.ndarray | None = None,
    before: Array | None = None,
) -> Pool:
    """Labels samples with Newton; those whose label misses a relative gap of 1e-7 are dropped and counted.

    Args:
        made: grasps with their bases (13, 3N).
        index: (M,) the grasp of each sample.
        wrench: (M, 6) in its unit frame [N].
        before_index, before: grasp and wrench of the previous solution; None: the same.

    Raises:
        NotConvergedError: one sample in a hundred was dropped, so something is wrong.
    """
    samples = len(index)
    twin = index if before_index is None else before_index
    before = wrench if before is None else before
    counts = np.array([grasp.n_contacts for grasp, _ in made])
    frames = np.linalg.inv(np.array([grasp.unit_frame for grasp, _ in made]))
    basis_start, carried = np.zeros((2, samples, MOST_CONTACTS, 3))
    least, gap = np.empty(samples), np.empty(samples)
    loads = np.einsum("bij,bj->bi", frames[index], wrench)
    earlier = np.einsum("bij,bj->bi", frames[twin], before)
    solvers = [_solver(grasp, basis) for grasp, basis in made]
    for count in np.unique(counts):
        chosen = np.flatnonzero(counts[index] == count)
        missed, records = np.empty(len(chosen)), np.empty((2, len(chosen), record_size(int(count))))
        _each(solvers, twin[chosen], earlier[chosen], None, records[0])
        missed = _gaps(records[0])
        _each(solvers, index[chosen], loads[chosen], records[0], records[1])
        least[chosen], gap[chosen] = records[1][:, OBJECTIVE], np.maximum(_gaps(records[1]), missed)
        scales = np.array([grasp.models.cone_scale for grasp, _ in made if grasp.n_contacts == count])
        place = np.cumsum(counts == count) - 1
        initial = records[1][:, FORCE + 3 * count : FORCE + 6 * count].reshape(-1, count, 3)
        carried[chosen, :count] = initial * scales[place[index[chosen]]] / UNIT
        for sample in chosen:
            core.combine(made[index[sample]][1], loads[sample], False, start := np.empty(3 * count))
            basis_start[sample, :count] = start.reshape(-1, 3) / UNIT
    kept = np.flatnonzero(gap <= ACCEPTED_GAP)
    if len(kept) < 0.99 * samples:
        raise NotConvergedError(f"{samples - len(kept)} of {samples} labels have a relative gap over {ACCEPTED_GAP:g}")
    rows = np.zeros((len(made), 6, MOST_CONTACTS, 3))
    mask, rest = np.zeros((len(made), MOST_CONTACTS)), np.zeros((len(made), MOST_CONTACTS, 3))
    for k, (grasp, basis) in enumerate(made):
        count = grasp.n_contacts
        rows[k, :, :count] = (grasp.unit_frame @ grasp.cone_matrix).reshape(6, count, 3)
        mask[k, :count] = 1.0
        rest[k, :count] = basis[12].reshape(count, 3) / UNIT
    arrays = (rows, mask, rest, index[kept], wrench[kept], basis_start[kept], carried[kept], least[kept] / UNIT)
    a, b, c, d, e, f, g, h = (torch.from_numpy(array) for array in arrays)
    return Pool(a, b, c, d, e, {"basis": f, "carried": g}, h, samples - len(kept))


def _with_twins(
    rng: np.random.Generator, count: int, contacts: Sequence[int]
) -> tuple[list[tuple[Grasp, Array]], np.ndarray]:
    """(grasp, basis) pairs and the position of each grasp's twin, or its own."""
    made: list[tuple[Grasp, Array]] = []
    partner: list[int] = []
    while len(made) < count:
        pair = random_grasps(rng, 1, OBJECTIVE_LEARNED, contacts)
        if rng.random() < TWINS and len(made) + 1 < count:
            twin = shaken(rng, pair[0][0], 0.008, 0.15)
            basis = basis_of(twin, OBJECTIVE_LEARNED)
            pair += [(twin, basis)] if basis is not None else []
        here = len(made)
        made += pair
        partner += [here] if len(pair) == 1 else [here + 1, here]
    return made, np.array(partner)


def _wrenches(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    """(count, 6) wrenches in the unit frame and those before them [N]."""

    def direction() -> Array:
        out = rng.standard_normal((count, 6))
        kind, small = rng.random(count), np.exp(rng.uniform(np.log(0.01), np.log(0.3), count))
        out[kind < 0.5 * ONE_SIDED, 3:] *= small[kind < 0.5 * ONE_SIDED, None]
        last = kind > 1.0 - 0.5 * ONE_SIDED
        out[last, :3] *= small[last, None]
        return out / np.sqrt((out**2).sum(1, keepdims=True))

    def log_uniform(low: float, high: float) -> Array:
        return np.exp(rng.uniform(np.log(low), np.log(high), (count, 1)))

    size = np.where(rng.random((count, 1)) < TINY_SHARE, log_uniform(*TINY), log_uniform(*MAGNITUDES))
    wrench = direction() * size
    return wrench, wrench + direction() * size * log_uniform(*JUMPS)


def _solver(grasp: Grasp, basis: Array) -> core.Newton:
    solver = core.Newton.make(core_contacts(grasp, OBJECTIVE_LEARNED), LABEL_GAP, LABEL_ITERATIONS)
    solver.set_basis(basis)
    return solver


def _each(
    solvers: list[core.Newton], places: np.ndarray, wrenches: Array, previous: Array | None, records: Array
) -> None:
    """Solves sample k on grasp places[k] into records[k], from the 12-basis or from the force of previous[k]."""
    for place in np.unique(places):
        chosen = np.flatnonzero(places == place)
        found = np.empty((len(chosen), records.shape[1]))
        solvers[place].solve_many(wrenches[chosen], None if previous is None else previous[chosen], found)
        records[chosen] = found


def _gaps(records: Array) -> Array:
    """Relative gaps; inf without a positive bound."""
    bound = records[:, BOUND]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(bound > 0.0, (records[:, OBJECTIVE] - bound) / bound, np.inf)

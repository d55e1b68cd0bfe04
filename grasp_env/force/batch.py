"""Many wrenches, many grasps: the core's solvers over arrays, on all cores, with the bits of one call at a time."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grasp_env import ranges
from grasp_env._check import Array, as_array, as_list, as_text, checked_size, choice, is_a, together, whole
from grasp_env.errors import InfeasibleWrenchError, InvalidInputError, NotConvergedError, shown
from grasp_env.force.methods import Conic, Newton
from grasp_env.force.optimizer import ForceOptimizer
from grasp_env.force.record import (
    BOUND,
    CODE,
    CONVERGED,
    FORCE,
    ITERATIONS,
    MARGIN,
    MULTIPLIERS,
    OBJECTIVE,
    RESIDUAL,
    STALLED,
    WRENCH,
    record_size,
)
from grasp_env.force.solution import STATUSES, ForceSolution, Status
from grasp_env.grasp.grasp import Grasp


class ForceSolutions(Sequence[ForceSolution]):
    """Solutions of a batch: arrays over M problems; `solutions[k]` is the k-th as a `ForceSolution`.

    Attributes:
        records: (M, 20 + 7N) one row per problem, see `record.py`.
        method: the method's name.
        initial: the name of the start rule.
    """

    def __init__(self, records: Array, method: str, initial: str, proofs: dict[int, ForceSolution]) -> None:
        self.records, self.method, self.initial = records, method, initial
        self._proofs = proofs

    def __len__(self) -> int:
        return len(self.records)

    def __getitem__(self, index: Any) -> Any:
        """The solution at an integer, a `ForceSolutions` at a slice."""
        if isinstance(index, slice):
            chosen = range(len(self))[index]
            proofs = {k: self._proofs[m] for k, m in enumerate(chosen) if m in self._proofs}
            return ForceSolutions(self.records[index], self.method, self.initial, proofs)
        position = range(len(self))[index]
        if position in self._proofs:
            return self._proofs[position]
        return ForceSolution(self.records[position], self.method, self.initial)

    def __iter__(self) -> Iterator[ForceSolution]:
        return (self[k] for k in range(len(self)))

    @property
    def n_contacts(self) -> int:
        """N."""
        return (self.records.shape[1] - FORCE) // 7

    @property
    def force(self) -> Array:
        """(M, N, 3) N: normal, o, t in each contact's frame."""
        n = self.n_contacts
        return self.records[:, FORCE : FORCE + 3 * n].reshape(-1, n, 3)

    @property
    def torsion(self) -> Array:
        """(M, N) N m."""
        return self.records[:, FORCE + 6 * self.n_contacts :]

    @property
    def wrench(self) -> Array:
        """(M, 6) the wrenches that are balanced [N, N m]."""
        return self.records[:, WRENCH : WRENCH + 6]

    @property
    def multipliers(self) -> Array:
        """(M, 6) nu of balance."""
        return self.records[:, MULTIPLIERS : MULTIPLIERS + 6]

    @property
    def codes(self) -> NDArray[np.int_]:
        """(M,) 0 optimal, 1 iteration limit, 2 stalled, 3 infeasible, 5 limits exceeded: keys of `STATUSES`."""
        return self.records[:, CODE].astype(int)

    @property
    def optimal(self) -> NDArray[np.bool_]:
        """(M,) whether the status is OPTIMAL."""
        return self.records[:, CODE] == CONVERGED

    @property
    def iterations(self) -> NDArray[np.int_]:
        """(M,) accepted steps."""
        return self.records[:, ITERATIONS].astype(int)

    @property
    def objective(self) -> Array:
        """(M,) Phi, or the normal forces' sum or maximum [N]; inf where infeasible."""
        return self.records[:, OBJECTIVE]

    @property
    def lower_bound(self) -> Array:
        """(M,) dual bounds."""
        return self.records[:, BOUND]

    @property
    def equilibrium_residual(self) -> Array:
        """(M,) largest |component| of G f + w, moments divided by the grasp's length [N]."""
        return self.records[:, RESIDUAL]

    @property
    def cone_margin(self) -> Array:
        """(M,) least distance to a cone's surface [N], cone coordinates."""
        return self.records[:, MARGIN]

    def counts(self) -> dict[Status, int]:
        """How many problems ended how.

        Example:
            >>> import numpy as np
            >>> from grasp_env.grasp import presets
            >>> batch = optimize_forces(presets.tripod(), np.zeros((3, 6)), method="conic")
            >>> {status.value: count for status, count in batch.counts().items()}
            {'optimal': 3}
        """
        codes, numbers = np.unique(self.codes, return_counts=True)
        return {STATUSES[c]: int(n) for c, n in zip(codes.tolist(), numbers, strict=True)}

    def __repr__(self) -> str:
        ends = ", ".join(f"{count} {status.value}" for status, count in self.counts().items())
        return f"ForceSolutions({len(self)} x {self.n_contacts} contacts, {self.method}: {ends})"


def optimize_forces(
    grasps: Grasp | Sequence[Grasp],
    wrenches: ArrayLike,
    *,
    method: str = "newton",
    workers: int | None = None,
    **options: Any,
) -> ForceSolutions:
    """Grasp forces for many wrenches and one grasp, or as many grasps.

    One grasp with hard contacts and force closure runs `newton` and the flows (from the 12-basis) and `conic` without Python between
    the problems; every other combination loops over `ForceOptimizer`. Either way the numbers are those of single calls.

    Args:
        grasps: one grasp for all wrenches, or M grasps of one number of contacts.
        wrenches: (M, 6) external wrenches on the object [N, N m], object frame.
        method: as in `optimize_force`.
        workers: threads, 1 to 1024; None: one per core. The core releases the GIL.
        options: further keywords of `ForceOptimizer` (initial by name or rule, limits, weights, tolerance, ...).

    Returns:
        All solutions; a wrench that nothing balances has the status INFEASIBLE instead of raising.

    Raises:
        InvalidInputError: wrong shapes, numbers that are not finite, grasps of different sizes.

    Example:
        >>> import numpy as np
        >>> from grasp_env.grasp import presets, wrench
        >>> batch = optimize_forces(presets.paper_cuboid(), wrench.sample_ball(np.random.default_rng(0), 100))
        >>> batch.force.shape, bool(batch.optimal.all())
        ((100, 4, 3), True)
    """
    loads, given = together(
        lambda: checked_size(as_array(wrenches, (None, 6), "wrenches"), "wrenches"),
        lambda: None if workers is None else whole(workers, "workers", 1, ranges.WORKERS),
    )
    threads = min(given or os.cpu_count() or 1, max(1, len(loads)))
    known = ForceOptimizer.__init__.__kwdefaults__ or {}
    for name in options:
        choice(name, "option", known)
    initial = options.get("initial")
    if as_text(initial) == "previous" or is_a(initial, ForceSolution):
        raise InvalidInputError("a batch has no previous solution: leave initial out, or give a rule")
    if is_a(grasps, Grasp):
        optimizer = ForceOptimizer(grasps, method=method, **options)
        records = np.empty((len(loads), record_size(grasps.n_contacts)))
        run = _compiled_run(optimizer)
        if run is not None:
            _over_parts(lambda part: run(loads[part], records[part]), len(loads), threads)
            # what the compiled call could not finish gets a second, slower look
            unfinished = np.flatnonzero(records[:, CODE] != CONVERGED)
        else:
            unfinished = np.arange(len(loads))
        proofs: dict[int, ForceSolution] = {}
        name = "linear_combination" if optimizer._method.takes_start else "central"
        for k in unfinished:
            optimizer.previous = None
            name = _one(optimizer, loads[k], records[k], int(k), proofs) or name
        return ForceSolutions(records, method, name, proofs)
    each = as_list(grasps)
    if each is None:
        raise InvalidInputError(f"grasps must be one Grasp or a list of them, got {shown(grasps)}")
    return _many_grasps(each, loads, method, threads, options)


def _many_grasps(
    grasps: list[Grasp], loads: Array, method: str, threads: int, options: dict[str, Any]
) -> ForceSolutions:
    if len(grasps) != len(loads):
        raise InvalidInputError(f"as many grasps as wrenches are needed, got {len(grasps)} and {len(loads)}")
    for k, grasp in enumerate(grasps):
        if not is_a(grasp, Grasp):
            raise InvalidInputError(f"grasps must be Grasp objects, entry {k} is {type(grasp).__name__}")
    sizes = {grasp.n_contacts for grasp in grasps}
    if len(sizes) > 1:
        raise InvalidInputError(f"grasps of one number of contacts are needed in a batch, got {sorted(sizes)}")
    if not grasps:
        raise InvalidInputError("at least one grasp is needed to know the number of contacts")
    records = np.empty((len(loads), record_size(grasps[0].n_contacts)))
    proofs: dict[int, ForceSolution] = {}
    names: list[str] = []

    def work(part: slice) -> None:
        for k in range(part.start, part.stop):
            optimizer = ForceOptimizer(grasps[k], method=method, **options)
            name = _one(optimizer, loads[k], records[k], k, proofs)
            names.extend([name] if name else [])

    _over_parts(work, len(loads), threads)
    return ForceSolutions(records, method, names[0] if names else "none", proofs)


def _one(
    optimizer: ForceOptimizer, load: Array, record: Array, position: int, proofs: dict[int, ForceSolution]
) -> str | None:
    """Solves one problem into `record`; an infeasible one keeps its proof. Returns the name of the start."""
    try:
        solution = optimizer.solve(load)
    except (InfeasibleWrenchError, NotConvergedError) as error:
        found = getattr(error, "solution", None)
        if found is None:  # undecided: one problem does not cost the others
            record[:] = 0.0
            record[CODE], record[OBJECTIVE], record[BOUND], record[RESIDUAL] = STALLED, np.inf, -np.inf, np.inf
            record[WRENCH : WRENCH + 6] = load
            return None
        solution = found
    record[:] = solution._record
    if optimizer.settings.limits is not None or solution.status is Status.INFEASIBLE:
        proofs[position] = solution
    return None if solution.status is Status.INFEASIBLE else solution.initial


def _compiled_run(optimizer: ForceOptimizer) -> Callable[[Array, Array], None] | None:
    method = optimizer._method
    if isinstance(method, Conic):
        return method.solver.solve_many
    if isinstance(method, Newton) and optimizer._loop is not None and optimizer._loop.name == "linear_combination":
        solver = method.solver
        return lambda loads, records: solver.solve_many(loads, None, records)
    return None


def _over_parts(work: Callable[[slice], None], count: int, threads: int) -> None:
    edges = np.linspace(0, count, threads + 1).astype(int)
    parts = [slice(int(a), int(b)) for a, b in pairwise(edges)]
    if threads == 1:
        work(parts[0])
        return
    with ThreadPoolExecutor(threads) as pool:
        for _ in pool.map(work, parts):
            pass

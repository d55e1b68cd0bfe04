"""Many wrenches, many grasps: the core's solvers over arrays, on all cores; the answers of one call at a time."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grasp_env import core, ranges
from grasp_env._check import Array, as_array, as_list, as_text, checked_size, choice, is_a, together, whole
from grasp_env.errors import InfeasibleWrenchError, InvalidInputError, NotConvergedError, shown
from grasp_env.force.hard_methods import NO_TRACE
from grasp_env.force.method import CONIC_ITERATIONS, proven
from grasp_env.force.objective import Objective
from grasp_env.force.optimizer import ForceOptimizer
from grasp_env.force.record import (
    BOUND,
    CODE,
    CONVERGED,
    FORCE,
    INFEASIBLE,
    ITERATIONS,
    LIMITS_EXCEEDED,
    MARGIN,
    MULTIPLIERS,
    OBJECTIVE,
    RESIDUAL,
    STALLED,
    WRENCH,
    record_size,
)
from grasp_env.force.solution import STATUSES, ForceSolution, Priced, Status
from grasp_env.grasp.grasp import Grasp


class ForceSolutions(Sequence[ForceSolution]):
    """Solutions of a batch: arrays over M problems; `solutions[k]` is the k-th as a `ForceSolution`.

    Attributes:
        records: (M, 20 + 7N) one row per problem, see `record.py`.
        method: the method's name.
        initial: the name of the start rule. (A single call also says where a wrench is outside a learned one's training
            range, or where the combination took the place of what a network predicted.)
    """

    def __init__(
        self,
        records: Array,
        method: str,
        initial: str,
        known: dict[int, ForceSolution] | None = None,
        priced: Array | Priced = NO_TRACE,
    ) -> None:
        """Of records that somebody filled.

        Args:
            records, method, initial: see the attributes.
            known: those that are more than their row of numbers.
            priced: what prices the limits of the others; empty: they have none.
        """
        self.records, self.method, self.initial = records, method, initial
        self._known, self._priced = known or {}, priced

    def __len__(self) -> int:
        return len(self.records)

    def __getitem__(self, index: Any) -> Any:
        """The solution at an integer, a `ForceSolutions` at a slice."""
        if isinstance(index, slice):
            chosen = range(len(self))[index]
            known = {k: self._known[m] for k, m in enumerate(chosen) if m in self._known}
            return ForceSolutions(self.records[index], self.method, self.initial, known, self._priced)
        position = range(len(self))[index]
        if position in self._known:
            return self._known[position]
        record = self.records[position]
        if record[CODE] == INFEASIBLE:
            return proven(record, self.method, self.initial).solution
        return ForceSolution(record, self.method, self.initial, NO_TRACE, None, self._priced)

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

    `newton` and `conic` on hard contacts with force closure take problems side by side in the vector registers, also from learned
    starts; the flows, `newton` within limits and with soft contacts run without Python between the problems; every other combination
    loops over `ForceOptimizer`. Answers are those of single calls (converged forces to 1e-9 of them) and do not depend on `workers`.

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
        lambda: checked_size(as_array(wrenches, (None, 6), "wrenches", copy=False), "wrenches"),
        lambda: None if workers is None else whole(workers, "workers", 1, ranges.WORKERS),
    )
    threads = given or os.cpu_count() or 1
    known = ForceOptimizer.__init__.__kwdefaults__ or {}
    for name in options:
        choice(name, "option", known)
    initial = options.get("initial")
    if as_text(initial) == "previous" or is_a(initial, ForceSolution):
        raise InvalidInputError("a batch has no previous solution: leave initial out, or give a rule")
    if is_a(grasps, Grasp):
        return _one_grasp(ForceOptimizer(grasps, method=method, **options), loads, threads)
    each = as_list(grasps)
    if each is None:
        raise InvalidInputError(f"grasps must be one Grasp or a list of them, got {shown(grasps)}")
    return _many_grasps(_checked_grasps(each, loads), loads, method, threads, options)


def _one_grasp(optimizer: ForceOptimizer, loads: Array, threads: int) -> ForceSolutions:
    records = np.empty((len(loads), record_size(optimizer.grasp.n_contacts)))
    method, loop = optimizer._method, optimizer._loop
    name = loop.name if loop is not None else "linear_combination" if method.takes_start else "central"
    unfinished = np.arange(len(loads))
    if loop is not None and loop.many is not None and not loop.remembers:
        many = loop.many
        _over_parts(lambda part: many(loads[part], None, records[part]), len(loads), CHUNK, threads)
        unfinished = _unfinished(records)
    known: dict[int, ForceSolution] = {}
    for k in unfinished:
        optimizer.previous = None
        name = _one(optimizer, loads[k], records[k], int(k), known) or name
    return ForceSolutions(records, optimizer.method, name, known, getattr(method, "priced", NO_TRACE))


def _checked_grasps(grasps: list[Any], loads: Array) -> list[Grasp]:
    if len(grasps) != len(loads):
        raise InvalidInputError(f"as many grasps as wrenches are needed, got {len(grasps)} and {len(loads)}")
    if not grasps:
        raise InvalidInputError("at least one grasp is needed to know the number of contacts")
    if set(map(type, grasps)) != {Grasp}:
        for k, grasp in enumerate(grasps):
            if not is_a(grasp, Grasp):
                raise InvalidInputError(f"grasps must be Grasp objects, entry {k} is {type(grasp).__name__}")
    sizes = {grasp.contacts.count for grasp in grasps}
    if len(sizes) > 1:
        raise InvalidInputError(f"grasps of one number of contacts are needed in a batch, got {sorted(sizes)}")
    return grasps


def _many_grasps(
    grasps: list[Grasp], loads: Array, method: str, threads: int, options: dict[str, Any]
) -> ForceSolutions:
    first = ForceOptimizer(grasps[0], method=method, **options)
    records = np.empty((len(loads), record_size(grasps[0].n_contacts)))
    solve = _compiled_grasps(first, options.get("initial"))
    unfinished = np.arange(len(loads))
    name = "linear_combination" if first._method.takes_start else "central"
    if solve is not None:
        name = INTERNAL if first._method.takes_start else "central"
        contacts = [grasp.contacts for grasp in grasps]
        keys = np.fromiter(map(id, contacts), np.int64, len(grasps))
        order = np.argsort(keys, kind="stable")  # a grasp's problems one after the other
        news = np.flatnonzero(np.diff(keys[order], prepend=0))
        begins, distinct = np.append(news, len(grasps)), [contacts[k] for k in order[news].tolist()]

        def work(part: slice) -> None:
            mine = order[begins[part.start] : begins[part.stop]]
            first = (begins[part.start : part.stop + 1] - begins[part.start]).astype(np.float64)
            found = np.empty((len(mine), records.shape[1]))
            solve(distinct[part], first, loads[mine], found)
            records[mine] = found

        _over_parts(work, len(distinct), GRASPS, threads)
        unfinished = _unfinished(records)
    known: dict[int, ForceSolution] = {}
    for k in unfinished:
        name = _one(ForceOptimizer(grasps[k], method=method, **options), loads[k], records[k], int(k), known) or name
    return ForceSolutions(records, method, name, known)


INTERNAL = "internal"
"""The name of the start that one internal force gives."""


def _compiled_grasps(
    optimizer: ForceOptimizer, initial: Any
) -> Callable[[list[core.Contacts], Array, Array, Array], None] | None:
    """(contacts, where the problems of each begin, their wrenches, their records) -> None: the core's call, if it serves them.

    Soft contacts are REFUSED there.
    """
    settings, count = optimizer.settings, optimizer.grasp.n_contacts
    if settings.limits is not None:
        return None
    if settings.method == "newton" and initial is None:
        weights, limit, call = settings.objective.weights(count), settings.max_iterations, core.newton_grasps
    elif settings.method == "conic" and settings.criterion == "sum":
        limit = min(settings.max_iterations, CONIC_ITERATIONS)
        weights, call = Objective().weights(count), core.conic_grasps
    else:
        return None
    return lambda contacts, first, loads, records: call(
        contacts, weights, first, settings.tolerance, limit, loads, records
    )


def _unfinished(records: Array) -> NDArray[np.intp]:
    """Which of what the core wrote gets a second, slower look."""
    codes = records[:, CODE]
    return np.flatnonzero((codes != CONVERGED) & (codes != INFEASIBLE) & (codes != LIMITS_EXCEEDED))


def _one(
    optimizer: ForceOptimizer, load: Array, record: Array, position: int, known: dict[int, ForceSolution]
) -> str | None:
    """Solves one problem into `record`; what is more than that is `known`. Returns the name of the start."""
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
    special = solution.status is Status.INFEASIBLE or solution.start_replaced
    if special or optimizer.settings.limits is not None:
        known[position] = solution
    return None if special else solution.initial


CHUNK, GRASPS = 4096, 256
"""Problems, and grasps, of one call of the core: of whatever many threads, so that answers do not depend on those."""


def _over_parts(work: Callable[[slice], None], count: int, size: int, threads: int) -> None:
    """work(part) for all of `count`, `size` at a time, on so many threads; an error or an interrupt ends all after their part."""
    parts = iter([slice(k, min(k + size, count)) for k in range(0, count, size)])

    def take() -> None:
        for part in parts:  # a list's iterator hands each of them to one thread
            work(part)

    threads = min(threads, -(-count // size))
    if threads <= 1:
        take()
        return
    with ThreadPoolExecutor(threads) as pool:
        try:
            for done in [pool.submit(take) for _ in range(threads)]:
                done.result()
        finally:
            for _ in parts:  # nothing is left where all went well
                pass

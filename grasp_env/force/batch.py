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
from grasp_env.force.objective import Objective
from grasp_env.force.optimizer import ForceOptimizer, names_of
from grasp_env.force.record import (
    BOUND,
    CODE,
    CONTACTS,
    CONVERGED,
    FORCE,
    ITERATIONS,
    MARGIN,
    MULTIPLIERS,
    OBJECTIVE,
    OUTSIDE,
    REPLACED,
    RESIDUAL,
    START,
    UNDECIDED,
    WRENCH,
)
from grasp_env.force.solution import STATUSES, ForceSolution, Status, start_name
from grasp_env.grasp.grasp import Grasp


class ForceSolutions(Sequence[ForceSolution]):
    """Solutions of a batch: arrays over M problems; `solutions[k]` is the k-th as a `ForceSolution`.

    Attributes:
        records: (M, ...) one row per problem, see `record.py`.
        method: the method's name.
    """

    def __init__(self, records: Array, method: str, names: Sequence[str], asked: str) -> None:
        """Of records that somebody filled.

        Args:
            records, method: see the attributes.
            names: of each start, in the order of `STARTS`.
            asked: the name of the start that was asked for.
        """
        self.records, self.method, self._names, self._asked = records, method, names, asked

    def __len__(self) -> int:
        return len(self.records)

    def __getitem__(self, index: Any) -> Any:
        """The solution at an integer, a `ForceSolutions` at a slice."""
        if isinstance(index, slice):
            return ForceSolutions(self.records[index], self.method, self._names, self._asked)
        record = self.records[range(len(self))[index]]
        return ForceSolution(record, self.method, self._name(record))

    def _name(self, record: Array) -> str:
        return start_name(self._names[int(record[START])], self._asked, bool(record[REPLACED]), bool(record[OUTSIDE]))

    @property
    def initial(self) -> str:
        """The name of the first problem's start; `solutions[k].initial` is that of each."""
        return self._name(self.records[0]) if len(self) else self._asked

    def __iter__(self) -> Iterator[ForceSolution]:
        return (self[k] for k in range(len(self)))

    @property
    def n_contacts(self) -> int:
        """N."""
        return int(self.records[0, CONTACTS]) if len(self) else 0

    @property
    def force(self) -> Array:
        """(M, N, 3) N: normal, o, t in each contact's frame."""
        n = self.n_contacts
        return self.records[:, FORCE : FORCE + 3 * n].reshape(len(self), n, 3)

    @property
    def torsion(self) -> Array:
        """(M, N) N m."""
        n = self.n_contacts
        return self.records[:, FORCE + 6 * n : FORCE + 7 * n]

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
        """(M,) 0 optimal, 1 iteration limit, 2 stalled, 3 infeasible, 5 limits exceeded, 7 undecided: keys of `STATUSES`."""
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
    grasps: Grasp | Sequence[Grasp], wrenches: ArrayLike, *, workers: int | None = None, **options: Any
) -> ForceSolutions:
    """Grasp forces for many wrenches and one grasp, or as many grasps.

    Newton and `conic` on hard contacts take problems side by side in the vector registers; everything else runs one problem after the
    other, without Python between them unless a rule is Python's. Answers are those of single calls (converged forces to 1e-9 of them)
    and do not depend on `workers`.

    Args:
        grasps: one grasp for all wrenches, or M grasps of one number of contacts.
        wrenches: (M, 6) external wrenches on the object [N, N m], in the frame of the positions.
        workers: threads, 1 to 1024; None: one per core. The core releases the GIL.
        options: the keywords of `ForceOptimizer`, with its defaults; a batch has no previous solution.

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
    loads, threads = checked_batch(wrenches, workers)
    known = ForceOptimizer.__init__.__kwdefaults__ or {}
    for name in options:
        choice(name, "option", known)
    initial = options.get("initial")
    if as_text(initial) == "previous" or is_a(initial, ForceSolution):
        raise InvalidInputError("a batch has no previous solution: leave initial out, or give a rule")
    if is_a(grasps, Grasp):
        return solve_many(ForceOptimizer(grasps, **options), loads, threads)
    each = as_list(grasps)
    if each is None:
        raise InvalidInputError(f"grasps must be one Grasp or a list of them, got {shown(grasps)}")
    return _many_grasps(_checked_grasps(each, loads), loads, threads, options)


def checked_batch(wrenches: ArrayLike, workers: int | None) -> tuple[Array, int]:
    """(M, 6) wrenches and the number of threads.

    Raises:
        InvalidInputError: they are none.
    """
    loads, given = together(
        lambda: checked_size(as_array(wrenches, (None, 6), "wrenches", copy=False), "wrenches"),
        lambda: None if workers is None else whole(workers, "workers", 1, ranges.WORKERS),
    )
    return loads, given or os.cpu_count() or 1


def solve_many(optimizer: ForceOptimizer, loads: Array, threads: int) -> ForceSolutions:
    """All wrenches (M, 6) on the contacts of an optimizer, none of which knows the others."""
    records = np.empty((len(loads), optimizer.core.size))
    if optimizer.compiled:
        _over_parts(lambda part: optimizer.core.solve_many(loads[part], records[part]), len(loads), CHUNK, threads)
    else:
        for load, record in zip(loads, records, strict=True):
            optimizer.forget()
            _solve_one(optimizer, load, record)
    return ForceSolutions(records, optimizer.method, *names_of(optimizer.initial, optimizer.options))


def _solve_one(optimizer: ForceOptimizer, load: Array, record: Array) -> None:
    """One problem into its row; what ends without a force costs the others nothing."""
    try:
        record[:] = optimizer.solve(load)._record
    except (InfeasibleWrenchError, NotConvergedError) as error:
        found = getattr(error, "solution", None)
        if found is None:
            record[:] = 0.0
            record[CODE], record[OBJECTIVE], record[BOUND], record[CONTACTS] = (
                UNDECIDED,
                np.inf,
                -np.inf,
                optimizer.grasp.n_contacts,
            )
            record[WRENCH : WRENCH + 6] = load
        else:
            record[:] = found._record


def _checked_grasps(grasps: list[Any], loads: Array) -> list[Grasp]:
    if len(grasps) != len(loads):
        raise InvalidInputError(f"as many grasps as wrenches are needed, got {len(grasps)} and {len(loads)}")
    if not grasps:
        raise InvalidInputError("at least one grasp is needed to know the number of contacts")
    if set(map(type, grasps)) != {Grasp}:
        for k, grasp in enumerate(grasps):
            if not is_a(grasp, Grasp):
                raise InvalidInputError(f"grasps must be Grasp objects, entry {k} is {type(grasp).__name__}")
    sizes = {contacts.count for contacts in map(_contacts, grasps)}
    if len(sizes) > 1:
        raise InvalidInputError(f"grasps of one number of contacts are needed in a batch, got {sorted(sizes)}")
    return grasps


def _contacts(grasp: Grasp) -> core.Contacts:
    return grasp.contacts


def _many_grasps(grasps: list[Grasp], loads: Array, threads: int, options: dict[str, Any]) -> ForceSolutions:
    first = ForceOptimizer(grasps[0], **options)
    records = np.empty((len(loads), first.core.size))
    solve = _compiled_grasps(first, options.get("initial"))
    unfinished = np.arange(len(loads))
    if solve is not None:
        keys = np.fromiter(map(id, grasps), np.int64, len(grasps))
        order = np.argsort(keys, kind="stable")  # a grasp's problems one after the other
        news = np.flatnonzero(np.diff(keys[order], prepend=0))
        begins, distinct = np.append(news, len(grasps)), [grasps[k].contacts for k in order[news].tolist()]

        def work(part: slice) -> None:
            mine = order[begins[part.start] : begins[part.stop]]
            counts = begins[part.start : part.stop + 1] - begins[part.start]
            found = np.empty((len(mine), records.shape[1]))
            solve(distinct[part], counts.astype(np.float64), loads[mine], found)
            records[mine] = found

        _over_parts(work, len(distinct), GRASPS, threads)
        unfinished = np.flatnonzero(records[:, CODE] != CONVERGED)
    for k in unfinished:
        _solve_one(ForceOptimizer(grasps[k], **options), loads[k], records[k])
    return ForceSolutions(records, first.method, *names_of(first.initial, first.options))


def _compiled_grasps(
    optimizer: ForceOptimizer, initial: Any
) -> Callable[[list[core.Contacts], Array, Array, Array], None] | None:
    """(contacts, where the problems of each begin, their wrenches, their records) -> None: the core's call, if it serves them."""
    options, count = optimizer.options, optimizer.grasp.n_contacts
    if optimizer.limits is not None or not (initial is None or as_text(initial) == "internal_force"):
        return None
    if options.method == "newton":
        weights, call = options.objective.weights(count), core.newton_grasps
    elif options.method == "conic" and options.criterion == "sum":
        weights, call = Objective().weights(count), core.conic_grasps
    else:
        return None
    return lambda contacts, begins, loads, records: call(
        contacts, weights, begins, options.tolerance, options.max_iterations, loads, records
    )


CHUNK, GRASPS = 4096, 512
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

"""Solutions of many problems as arrays, and the threads that compute them."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grasp_env.errors import InfeasibleWrenchError, NotConvergedError
from grasp_env.force import record as at
from grasp_env.force.margin import ShiftedProblem
from grasp_env.force.solution import STATUSES, ForceSolution, Names, Status
from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import AllFaults, Array, as_array, checked_size, whole


class ForceSolutions(Sequence[ForceSolution]):
    """Solutions of M problems as arrays; `solutions[k]` is the k-th as a `ForceSolution`.

    The arrays are documented there; `names` are those that the solutions show.

    Attributes:
        records: (M, K) one row of numbers per problem, see `record.py`.
    """

    def __init__(self, records: Array, names: Names) -> None:
        self.records, self._names = records, names

    def __len__(self) -> int:
        return len(self.records)

    def __getitem__(self, index: Any) -> Any:
        """Return the solution at an integer, a `ForceSolutions` at a slice."""
        if isinstance(index, slice):
            return ForceSolutions(self.records[index], self._names)
        return ForceSolution(self.records[range(len(self))[index]], self._names)

    @property
    def method(self) -> str:
        """The method's name."""
        return self._names.method

    @property
    def initial(self) -> str:
        """The name of the first problem's start; `solutions[k].initial` is that of each."""
        return self._names.initial(self.records[0]) if len(self) else self._names.requested

    def __iter__(self) -> Iterator[ForceSolution]:
        return (self[k] for k in range(len(self)))

    @property
    def n_contacts(self) -> int:
        """Number of contacts N."""
        return int(self.records[0, at.CONTACTS]) if len(self) else 0

    @property
    def force(self) -> Array:
        """(M, N, 3) [N]."""
        n = self.n_contacts
        return self.records[:, at.FORCE : at.FORCE + 3 * n].reshape(len(self), n, 3)

    @property
    def torsion(self) -> Array:
        """(M, N) [N m]."""
        n = self.n_contacts
        return self.records[:, at.FORCE + 6 * n : at.FORCE + 7 * n]

    @property
    def friction_used(self) -> Array:
        """(M, N) share of the given friction that each force uses."""
        n = self.n_contacts
        return self.records[:, at.FORCE + 16 * n : at.FORCE + 17 * n]

    @property
    def wrench(self) -> Array:
        """(M, 6) [N, N m]."""
        return self.records[:, at.WRENCH : at.WRENCH + 6]

    @property
    def multipliers(self) -> Array:
        """(M, 6) nu of balance."""
        return self.records[:, at.MULTIPLIERS : at.MULTIPLIERS + 6]

    @property
    def codes(self) -> NDArray[np.int_]:
        """(M,) keys of `STATUSES`.

        0 optimal, 1 iteration limit, 2 stalled, 3 infeasible, 5 limits exceeded, 7 undecided.
        """
        return self.records[:, at.CODE].astype(int)

    @property
    def optimal(self) -> NDArray[np.bool_]:
        """(M,) True if the status is OPTIMAL."""
        return self.records[:, at.CODE] == at.CONVERGED

    @property
    def iterations(self) -> NDArray[np.int_]:
        """(M,) accepted steps."""
        return self.records[:, at.ITERATIONS].astype(int)

    @property
    def objective(self) -> Array:
        """(M,) objectives; inf without a force."""
        return self.records[:, at.OBJECTIVE]

    @property
    def lower_bound(self) -> Array:
        """(M,) dual bounds."""
        return self.records[:, at.BOUND]

    @property
    def equilibrium_residual(self) -> Array:
        """(M,) residuals of balance [N]."""
        return self.records[:, at.RESIDUAL]

    @property
    def cone_margin(self) -> Array:
        """(M,) margins to the cones [N]."""
        return self.records[:, at.MARGIN]

    def counts(self) -> dict[Status, int]:
        """Return the number of problems with each status.

        Example:
            >>> import numpy as np
            >>> from grasp_env.force import optimize_forces
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


def checked_batch(wrenches: ArrayLike, workers: int | None) -> tuple[Array, int]:
    """Return the checked wrenches (M, 6) and the number of threads."""
    with AllFaults() as check:
        loads = check(
            lambda: checked_size(as_array(wrenches, (None, 6), "wrenches", copy=False), "wrenches")
        )
        threads = os.cpu_count() or 1
        if workers is not None:
            threads = check(whole, workers, "workers", 1, ranges.WORKERS)
    return loads, threads


def solve_many(optimizer: Any, loads: Array, threads: int) -> ForceSolutions:
    """Solve for all wrenches (M, 6) on the contacts of an optimizer, independently of each other."""
    records = np.empty((len(loads), optimizer.core.size))
    if optimizer.core_finds_start:

        def work(chunk: slice) -> None:
            optimizer.core.solve_many(loads[chunk], records[chunk])

        over_parts(work, len(loads), CHUNK, threads)
    else:
        for load, record in zip(loads, records, strict=True):
            optimizer.forget()
            solve_one(optimizer, load, record)
    return ForceSolutions(records, optimizer.names)


def solve_one(optimizer: Any, load: Array, record: Array) -> None:
    """Solve one problem into its row; if infeasible or undecided, the row has no force."""
    try:
        solution = optimizer.solve(load)
    except (InfeasibleWrenchError, NotConvergedError) as error:
        solution = error.solution
    if solution is not None:
        record[:] = solution._record
        return
    count, limits = optimizer.grasp.n_contacts, len(optimizer.limit_labels)  # a rule raised it
    preload = optimizer.margin.preloads(count)
    record[:] = 0.0
    record[at.CODE], record[at.OBJECTIVE], record[at.BOUND] = at.UNDECIDED, np.inf, -np.inf
    record[at.CONTACTS], record[at.LIMITS] = count, limits
    record[at.JOINTS] = len(record) - at.FORCE - 17 * count - limits
    record[at.WRENCH : at.WRENCH + 6] = load
    shifted = ShiftedProblem.of(optimizer.grasp, load, preload)
    record[at.WRENCH_WITH_PRELOAD : at.WRENCH_WITH_PRELOAD + 6] = shifted.wrench


CHUNK = 4096
"""Number of problems per call of the core; fixed, so that results do not depend on `threads`."""


def over_parts(work: Callable[[slice], None], count: int, size: int, threads: int) -> None:
    """Call work(slice) for slices of `size` out of `count` on several threads.

    An error or an interrupt stops all of them after their slice.
    """
    if count <= size:
        if count:
            work(slice(0, count))
        return
    chunks = iter([slice(k, min(k + size, count)) for k in range(0, count, size)])

    def take() -> None:
        for chunk in chunks:  # the iterator of a list is thread-safe: each slice goes to one thread
            work(chunk)

    threads = min(threads, -(-count // size))
    if threads <= 1:
        take()
        return
    with ThreadPoolExecutor(threads) as pool:
        try:
            for task in [pool.submit(take) for _ in range(threads)]:
                task.result()
        finally:
            for _ in chunks:  # after an error: leave no slice for the other threads
                pass

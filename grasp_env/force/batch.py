"""Grasp forces for many wrenches and many grasps, on all processor cores."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from grasp_env import core
from grasp_env.errors import InvalidInputError, shown
from grasp_env.force.many import ForceSolutions, checked_batch, over_parts, solve_many, solve_one
from grasp_env.force.optimizer import ForceOptimizer
from grasp_env.force.record import CODE, CONVERGED
from grasp_env.force.solution import ForceSolution
from grasp_env.grasp.grasp import Grasp
from grasp_env.inputs.arguments import Array, choice


def optimize_forces(
    grasps: Grasp | Sequence[Grasp],
    wrenches: ArrayLike,
    *,
    workers: int | None = None,
    **options: Any,
) -> ForceSolutions:
    """Optimise the grasp forces for many wrenches, on one grasp or on one grasp each.

    Newton and `conic` on hard contacts solve several problems at once in the vector registers.
    Everything else runs problem by problem in the core, unless the start rule is a Python function.
    Each problem has the status of a single call, and an objective that agrees within the tolerance:
    in the registers sums are taken in another order, so a solve may end a step earlier or later. No
    result depends on `workers`.

    Args:
        grasps: one grasp for all wrenches, or M grasps with equal numbers of contacts.
        wrenches: (M, 6) external wrenches [N, N m], as in `optimize_force`.
        workers: number of threads, 1 to 1024; None: one per processor core. The core releases the
            GIL.
        options: the keywords of `ForceOptimizer`, with its defaults; a batch has no previous
            solution.

    Returns:
        All solutions. A wrench that no force balances has the status INFEASIBLE; nothing is raised.

    Raises:
        InvalidInputError: wrong shapes, numbers that are not finite, grasps with different numbers
            of contacts.

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
    if isinstance(initial, ForceSolution) or (isinstance(initial, str) and initial == "previous"):
        raise InvalidInputError(
            "a batch has no previous solution: leave initial out, or give a rule"
        )
    if isinstance(grasps, Grasp):
        return solve_many(ForceOptimizer(grasps, **options), loads, threads)
    if not isinstance(grasps, list | tuple):
        raise InvalidInputError(f"grasps must be one Grasp or a list of them, got {shown(grasps)}")
    return _many_grasps(_checked_grasps(list(grasps), loads), loads, threads, options)


def _checked_grasps(grasps: list[Any], loads: Array) -> list[Grasp]:
    if len(grasps) != len(loads):
        raise InvalidInputError(
            f"as many grasps as wrenches are needed, got {len(grasps)} and {len(loads)}"
        )
    if not grasps:
        raise InvalidInputError("at least one grasp is needed to know the number of contacts")
    for k, grasp in enumerate(grasps):
        if not isinstance(grasp, Grasp):
            raise InvalidInputError(
                f"grasps must be Grasp objects, entry {k} is {type(grasp).__name__}"
            )
    sizes = {grasp.contacts.count for grasp in grasps}
    if len(sizes) > 1:
        raise InvalidInputError(
            f"grasps of one number of contacts are needed in a batch, got {sorted(sizes)}"
        )
    return grasps


def _many_grasps(
    grasps: list[Grasp], loads: Array, threads: int, options: dict[str, Any]
) -> ForceSolutions:
    first = ForceOptimizer(grasps[0], **options)
    records = np.empty((len(loads), first.core.size))
    solve = _compiled_grasps(first, options.get("initial"))
    unfinished = np.arange(len(loads))
    if solve is not None:
        keys = np.fromiter(map(id, grasps), np.int64, len(grasps))
        order = np.argsort(keys, kind="stable")  # the problems of each grasp follow each other
        firsts = np.flatnonzero(np.diff(keys[order], prepend=0))
        begins = np.append(firsts, len(grasps))
        distinct = [grasps[k].contacts for k in order[firsts].tolist()]

        def work(chunk: slice) -> None:
            chosen = order[begins[chunk.start] : begins[chunk.stop]]
            counts = begins[chunk.start : chunk.stop + 1] - begins[chunk.start]
            rows = np.empty((len(chosen), records.shape[1]))
            solve(distinct[chunk], counts.astype(np.float64), loads[chosen], rows)
            records[chosen] = rows

        over_parts(work, len(distinct), GRASPS, threads)
        unfinished = np.flatnonzero(records[:, CODE] != CONVERGED)
    for k in unfinished:
        solve_one(ForceOptimizer(grasps[k], **options), loads[k], records[k])
    return ForceSolutions(records, first.names)


def _compiled_grasps(
    optimizer: ForceOptimizer, initial: Any
) -> Callable[[list[core.Contacts], Array, Array, Array], None] | None:
    """Return the core's solver for many grasps, or None if it does not support the options."""
    options = optimizer.options
    count = optimizer.grasp.n_contacts
    first = initial is None or (isinstance(initial, str) and initial == "internal_force")
    if optimizer.limits is not None or not first:
        return None
    if options.method == "newton":
        call = core.newton_grasps
    elif options.method == "conic" and options.criterion == "sum":
        call = core.conic_grasps
    else:
        return None
    weights = options.objective.weights(count)
    stop = options.tolerance, options.max_iterations
    margin = optimizer.margin
    return lambda contacts, begins, loads, records: call(
        contacts, weights, begins, stop, loads, records, margin
    )


GRASPS = 512
"""Number of grasps per call of the core, fixed as `CHUNK` is."""

"""Timers of the benchmarks: per problem, best of several passes; the compiled ones take the time inside the loop."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit

from grasp_env._check import Array
from grasp_env.force import ForceOptimizer
from grasp_env.force.conic_kernels import conic
from grasp_env.force.newton_kernels import BASIS, newton

WARM_UP = 20
"""Calls before the clock starts."""
_clock = ctypes.CDLL(None).clock_gettime
_clock.argtypes, _clock.restype = (ctypes.c_int, ctypes.c_void_p), ctypes.c_int
_MONOTONIC = 1


def python_times(solve: Callable[[Array], object], wrenches: Array, passes: int) -> Array:
    """(n,) seconds per call of `solve` from Python, best of `passes`."""
    loads = [w.copy() for w in wrenches]
    for w in loads[:WARM_UP]:
        solve(w)
    best = np.full(len(loads), np.inf)
    for _ in range(passes):
        for k, w in enumerate(loads):
            begin = time.perf_counter_ns()
            solve(w)
            best[k] = min(best[k], time.perf_counter_ns() - begin)
    return best * 1e-9


def compiled_times(optimizer: ForceOptimizer, wrenches: Array, passes: int, records: Array) -> Array:
    """(n,) seconds per compiled call of a `conic` or `newton` optimizer, start and certificates included.

    Args:
        optimizer: on hard contacts with force closure.
        wrenches: (n, 6).
        passes: best of so many.
        records: (n, 20 + 7N) receives the solutions.
    """
    method: Any = optimizer._method
    loads, best = wrenches.copy(), np.full(len(wrenches), np.inf)
    clock = np.zeros(2, dtype=np.int64)
    if optimizer.method == "conic":
        arguments = (method.constants, method.options)
        _conic_times(*arguments, loads[:WARM_UP], 1, records, best, clock)
        _conic_times(*arguments, loads, passes, records, best, clock)
    else:
        arguments = (method.constants, method.basis, method.weights, method.options)
        _newton_times(*arguments, loads[:WARM_UP], 1, records, best, clock)
        _newton_times(*arguments, loads, passes, records, best, clock)
    return best * 1e-9


# a ctypes pointer cannot be cached on disk: these compile in every process that benches
@njit(nogil=True)
def _conic_times(constants, options, wrenches, passes, records, best, clock):
    best[:] = np.inf
    for _ in range(passes):
        for k in range(wrenches.shape[0]):
            _clock(_MONOTONIC, clock.ctypes)
            begin = clock[0] * 1_000_000_000 + clock[1]
            conic(constants, wrenches[k], options, records[k])
            _clock(_MONOTONIC, clock.ctypes)
            best[k] = min(best[k], clock[0] * 1_000_000_000 + clock[1] - begin)


@njit(nogil=True)
def _newton_times(constants, basis, weights, options, wrenches, passes, records, best, clock):
    nothing = np.empty(0)
    best[:] = np.inf
    for _ in range(passes):
        for k in range(wrenches.shape[0]):
            _clock(_MONOTONIC, clock.ctypes)
            begin = clock[0] * 1_000_000_000 + clock[1]
            newton(constants, basis, BASIS, nothing, wrenches[k], weights, options, records[k], nothing)
            _clock(_MONOTONIC, clock.ctypes)
            best[k] = min(best[k], clock[0] * 1_000_000_000 + clock[1] - begin)

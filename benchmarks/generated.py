"""QOCOGEN: C code generated for the dual form of N contacts, compiled here, called by ctypes and timed in C."""

from __future__ import annotations

import contextlib
import ctypes
import io
import os
import shutil
import subprocess
import tempfile
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

import numpy as np
from scipy import sparse

from benchmarks.problem import WARM_UP, Solver, dual_form
from grasp_env._check import Array, Wrench
from grasp_env._files import digest
from grasp_env.grasp import Grasp

OURS = Path(__file__).with_name("generated.c")
LIBRARIES = Path(__file__).parents[1] / "build/qocogen"
"""Where libraries of this machine (-march=native) are kept."""
PLAIN = ("-O3", "-march=native")
FAST = ("-Ofast", "-flto=auto", "-march=native")
COST_SCALE = 0.3
"""On c; the forces stay the same. QOCOGEN has no scaling of its own for free, and its line search of five bisections
gives up on steps below 1/32: this factor halves such failures or better and costs no time, more bisections do."""


class Generated(Solver):
    """A generated solver with the data of one grasp.

    The code depends on N alone: A^T counts as dense, and each grasp brings its own numbers. A library is compiled
    once per N and flags, and found again in `LIBRARIES`. `refinements` are the
    steps of iterative refinement of each linear solve (QOCOGEN's default: 1).
    """

    def __init__(self, grasp: Grasp, flags: tuple[str, ...] = PLAIN, refinements: int = 1) -> None:
        count = grasp.n_contacts
        self._library = ctypes.CDLL(str(library(count, flags)))
        self._library.peer_size.restype = ctypes.c_size_t
        self._work = np.zeros(self._library.peer_size() // 8 + 1)  # doubles, for the alignment
        self._force = np.zeros(3 * count)
        matrix = np.ascontiguousarray(grasp.cone_matrix)  # the columns of A^T one after the other, zeros included
        bound = COST_SCALE * dual_form(grasp)[1]
        self._library.peer_setup(_pointer(self._work), _pointer(matrix), _pointer(bound), refinements)

    def solve(self, wrench: Wrench) -> Array:
        """See `Solver`."""
        load = np.ascontiguousarray(wrench, dtype=np.float64)
        solved = self._library.peer_solve(_pointer(self._work), _pointer(load), _pointer(self._force))
        return self._force.copy() if solved else np.full_like(self._force, np.nan)

    def times(self, wrenches: Array, passes: int) -> Array:
        """See `Solver`, but both the loop and the clock are in C: no Python call is paid."""
        loads, best = np.ascontiguousarray(wrenches, dtype=np.float64), np.empty(len(wrenches))
        self._library.peer_times(
            _pointer(self._work), _pointer(loads), len(loads), passes, WARM_UP, _pointer(self._force), _pointer(best)
        )
        return best


def compiler() -> str | None:
    """The C compiler's path: $CC, gcc, clang or cc."""
    names = (os.environ.get("CC"), "gcc", "clang", "cc")
    return next((found for name in names if name and (found := shutil.which(name))), None)


def library(count: int, flags: tuple[str, ...] = PLAIN) -> Path:
    """The shared library for `count` contacts in `LIBRARIES`, generated and compiled if it is not there.

    Raises:
        RuntimeError: there is no compiler, or it fails.
    """
    command = compiler()
    if command is None:
        raise RuntimeError("no C compiler: install gcc or clang, or set CC")
    key = digest("\0".join([version("qocogen"), command, *flags, OURS.read_text()]).encode())[:12]
    path = LIBRARIES / f"qocogen_{count}_{key}.so"
    if path.exists():
        return path
    LIBRARIES.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=LIBRARIES) as scratch:
        _generate(count, scratch)
        sources = [Path(scratch, "code", f"{name}.c") for name in ("qoco_custom", "cone", "utils", "ldl", "kkt")]
        built = Path(scratch, "built.so")
        # GCC links -Ofast with code that makes the whole process flush small numbers to zero: compiled with it, linked without
        objects = [Path(scratch, f"{source.stem}.o") for source in (*sources, OURS)]
        steps = [
            [*flags, f"-I{scratch}/code", "-fPIC", "-c", str(source), "-o", str(target)]
            for source, target in zip((*sources, OURS), objects, strict=True)
        ]
        steps.append(
            [*(flag for flag in flags if flag != "-Ofast"), "-shared", "-o", str(built), *map(str, objects), "-lm"]
        )
        for options in steps:
            answer = subprocess.run([command, *options], capture_output=True, text=True, check=False, timeout=300)
            if answer.returncode:
                raise RuntimeError(f"{command} {' '.join(flags)} fails: {answer.stderr.strip()[:300]}")
        built.replace(path)  # whole or not at all, for two runs that share the folder
    return path


def _generate(count: int, folder: str) -> None:
    """Writes the code for a dense A^T into folder/code; random numbers, lest a cancellation look like a zero."""
    dense = np.random.default_rng(0).uniform(0.5, 1.5, (3 * count, 6))
    with contextlib.redirect_stdout(io.StringIO()):
        import_module("qocogen").generate_solver(
            n=6, m=3 * count, p=0, P=None, c=np.ones(6), A=None, b=None, G=sparse.csc_matrix(dense), h=np.ones(3 * count),
            l=0, nsoc=count, q=np.full(count, 3), output_dir=folder, name="code",
        )  # fmt: skip


def _pointer(array: Array) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)

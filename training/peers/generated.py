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

from grasp_env._check import Array, Wrench
from grasp_env._files import digest
from training.peers.problem import WARM_UP, dual_form

OURS = Path(__file__).with_name("generated.c")
PLAIN = ("-O3", "-march=native")
FAST = ("-Ofast", "-flto=auto", "-march=native")
COST_SCALE = 0.3
"""On c; the forces stay the same. QOCOGEN has no scaling of its own for free, and its line search of five bisections
gives up on steps below 1/32: this factor halves such failures or better and costs no time, more bisections do."""


class Generated:
    """A generated solver with the data of one grasp.

    The code depends on N alone: A^T counts as dense, and each grasp brings its own numbers. A library is compiled
    once per N and flags, and found again in `folder`, which must belong to one machine (-march=native).

    Args:
        cone_matrix: A, (6, 3N).
        cost: c, (N,).
        folder: where libraries are kept.
        flags: for the compiler.
        refinements: steps of iterative refinement per linear solve (QOCOGEN's default: 1).
    """

    def __init__(
        self, cone_matrix: Array, cost: Array, folder: Path, flags: tuple[str, ...] = PLAIN, refinements: int = 1
    ) -> None:
        self._library = ctypes.CDLL(str(library(len(cost), folder, flags)))
        self._library.peer_size.restype = ctypes.c_size_t
        self._work = np.zeros(self._library.peer_size() // 8 + 1)  # doubles, for the alignment
        self._force = np.zeros(3 * len(cost))
        matrix = np.ascontiguousarray(cone_matrix)  # the columns of A^T one after the other, zeros included
        bound = dual_form(cone_matrix, COST_SCALE * cost)[1]
        self._library.peer_setup(_pointer(self._work), _pointer(matrix), _pointer(bound), refinements)

    def solve(self, wrench: Wrench) -> Array:
        """See `Solver`."""
        load = np.ascontiguousarray(wrench, dtype=np.float64)
        solved = self._library.peer_solve(_pointer(self._work), _pointer(load), _pointer(self._force))
        return self._force.copy() if solved else np.full_like(self._force, np.nan)

    def times(self, wrenches: Array, repeats: int) -> Array:
        """As `best_times`, but both the loop and the clock are in C: no Python call is paid."""
        loads, best = np.ascontiguousarray(wrenches, dtype=np.float64), np.empty(len(wrenches))
        self._library.peer_times(
            _pointer(self._work), _pointer(loads), len(loads), repeats, WARM_UP, _pointer(self._force), _pointer(best)
        )
        return best


def compiler() -> str | None:
    """The C compiler's path: $CC, gcc, clang or cc."""
    names = (os.environ.get("CC"), "gcc", "clang", "cc")
    return next((found for name in names if name and (found := shutil.which(name))), None)


def refusal(flags: tuple[str, ...]) -> str | None:
    """Why no library can be built with `flags`; None: it can."""
    command = compiler()
    if command is None:
        return "no C compiler: install gcc or clang, or set CC"
    with tempfile.TemporaryDirectory() as scratch:
        source = Path(scratch, "probe.c")
        source.write_text("#include <math.h>\ndouble probe(double x) { return sqrt(x); }\n")
        answer = _compile(command, flags, [source], Path(scratch, "probe.so"))
    return f"{command} {' '.join(flags)} fails: {answer.stderr.strip()[:300]}" if answer.returncode else None


def library(count: int, folder: Path, flags: tuple[str, ...] = PLAIN) -> Path:
    """The shared library for `count` contacts in `folder`, generated and compiled if it is not there.

    Raises:
        RuntimeError: there is no compiler, or it fails.
    """
    command = compiler()
    if command is None:
        raise RuntimeError(refusal(flags))
    key = digest("\0".join([version("qocogen"), command, *flags, OURS.read_text()]).encode())[:12]
    path = folder / f"qocogen_{count}_{key}.so"
    if path.exists():
        return path
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        _generate(count, scratch)
        sources = [Path(scratch, "code", f"{name}.c") for name in ("qoco_custom", "cone", "utils", "ldl", "kkt")]
        built = Path(scratch, "built.so")
        answer = _compile(command, (*flags, f"-I{scratch}/code"), [*sources, OURS], built)
        if answer.returncode:
            raise RuntimeError(f"{command} cannot compile the generated solver: {answer.stderr[:2000]}")
        built.replace(path)  # whole or not at all, for two runs that share the folder
    return path


def _generate(count: int, folder: str) -> None:
    """Writes the code for a dense A^T into folder/code; random numbers, lest a cancellation look like a zero."""
    dense = np.random.default_rng(0).uniform(0.5, 1.5, (3 * count, 6))
    with contextlib.redirect_stdout(io.StringIO()):
        import_module("qocogen").generate_solver(
            n=6,
            m=3 * count,
            p=0,
            P=None,
            c=np.ones(6),
            A=None,
            b=None,
            G=sparse.csc_matrix(dense),
            h=np.ones(3 * count),
            l=0,
            nsoc=count,
            q=np.full(count, 3),
            output_dir=folder,
            name="code",
        )


def _compile(
    command: str, flags: tuple[str, ...], sources: list[Path], target: Path
) -> subprocess.CompletedProcess[str]:
    arguments = [command, *flags, "-fPIC", "-shared", "-o", str(target), *map(str, sources), "-lm"]
    return subprocess.run(arguments, capture_output=True, text=True, check=False)


def _pointer(array: Array) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)

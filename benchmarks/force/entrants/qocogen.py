"""QOCOGEN: C code generated for a form's pattern, compiled here, called and timed in C."""

from __future__ import annotations

import contextlib
import ctypes
import io
import tempfile
from functools import cache
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

import numpy as np
from scipy import sparse

from benchmarks.force.build import cached, compiler, execute
from benchmarks.force.entrant import Library, Task
from benchmarks.force.entrants import forms

OURS = Path(__file__).with_name("qocogen.c")
HEADERS = Path(__file__).parents[1]
SIZE = 10.0
"""Length to which the wrench is scaled, as `forms.SIZE`: 30 takes 0.6 iterations more, 3 gives less
accurate forces."""


class Description(ctypes.Structure):
    """`Description` of qocogen.c."""

    _fields_ = (
        *((name, ctypes.c_int) for name in ("form", "refinements", "count_a", "count_g")),
        *((name, ctypes.c_void_p) for name in ("columns_a", "rows_a", "columns_g", "rows_g")),
        ("size", ctypes.c_double),
    )


class Qocogen(Library):
    """A generated solver, whose code depends on the form's pattern alone."""

    name = "qocogen"
    note = (
        "C, generated for the dual form (phi and many limits: primal), -O3 -march=native, its default tolerances (1e-7). "
        "A failed solve is repeated with a finer line search. It detects no infeasibility, and reports some such wrenches as solved. "
        "Reviewer's note: the call is timed in C, those of the packages for Python include their wrappers."
    )
    flags: tuple[str, ...] = ("-O3", "-march=native")
    refinements = 1
    """Steps of iterative refinement of each linear solve."""

    def __init__(self) -> None:
        """Start without a library, which depends on the session."""

    def setup(self, task: Task) -> None:
        """See `Entrant`."""
        self.close()
        form = forms.form(task.first, task.objective)
        self.open(str(library(form, self.flags)), "qocogen")
        blocks = np.split(form.pattern, [form.equations])
        # columns and rows of the numbers of A and G
        self._places = [np.array(block.T.nonzero(), dtype=np.int32) for block in blocks]
        kind = (forms.Dual, forms.Primal, forms.Barrier).index(type(form))
        starts = [place[axis].ctypes.data for place in self._places for axis in (0, 1)]
        counts = [place.shape[1] for place in self._places]
        self._library.qocogen_describe(
            ctypes.byref(Description(kind, self.refinements, *counts, *starts, SIZE))
        )
        super().setup(task)


class QocogenFast(Qocogen):
    """QOCOGEN with -Ofast -flto and without iterative refinement."""

    name = "qocogen_fast"
    note = "qocogen with -Ofast -flto and no iterative refinement of its linear solves."
    flags = ("-Ofast", "-flto=auto", "-march=native")
    refinements = 0


def library(form: forms.Form, flags: tuple[str, ...]) -> Path:
    """Return the library for a form's pattern, generated and compiled if it does not exist."""
    command = compiler("CC", "gcc", "clang", "cc")
    sizes = f"{form.pattern.shape} {form.equations} {form.nonneg} {form.cones}"
    key = "\0".join([*_versions(), command, *flags, sizes]).encode()
    key += np.packbits(form.pattern.astype(bool)).tobytes()

    def make(built: Path) -> None:
        with tempfile.TemporaryDirectory() as scratch:
            _generate(form, scratch)
            names = ("qoco_custom", "cone", "utils", "ldl", "kkt")
            sources = [*(Path(scratch, "code", f"{name}.c") for name in names), OURS]
            # GCC links -Ofast with code that makes the whole process flush small numbers to zero:
            # compiled with it, linked without
            objects = [str(Path(scratch, f"{source.stem}.o")) for source in sources]
            compiled = [command, *flags, f"-I{scratch}/code", f"-I{HEADERS}", "-fPIC", "-c"]
            for source, target in zip(sources, objects, strict=True):
                execute([*compiled, str(source), "-o", target])
            links = [flag for flag in flags if flag != "-Ofast"]
            execute([command, *links, "-shared", "-o", str(built), *objects, "-lm"])

    return cached("qocogen", key, make)


@cache
def _versions() -> tuple[str, ...]:
    return version("qocogen"), OURS.read_text(), (HEADERS / "force.h").read_text()


def _generate(form: forms.Form, folder: str) -> None:
    """Write the code into folder/code.

    Numbers that change are random, so that no cancellation looks like a zero.
    """
    rows = form.rows if isinstance(form, forms.Barrier) else np.zeros(form.pattern.shape)
    random = np.random.default_rng(0).uniform(0.5, 1.5, form.pattern.shape)
    matrix = np.where(form.pattern & (rows == 0.0), random, rows)
    p = form.equations
    with contextlib.redirect_stdout(io.StringIO()):
        import_module("qocogen").generate_solver(
            n=len(form.c),
            m=len(form.sides) - p,
            p=p,
            P=None,
            c=form.c,
            A=sparse.csc_matrix(matrix[:p]) if p else None,
            b=form.sides[:p],
            G=sparse.csc_matrix(matrix[p:]),
            h=form.sides[p:],
            l=form.nonneg,
            nsoc=len(form.cones),
            q=np.array(form.cones),
            output_dir=folder,
            name="code",
        )

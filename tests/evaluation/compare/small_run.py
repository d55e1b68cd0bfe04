"""One small run of `grasp evaluate` for the tests of comparison and report."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from functools import cache
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

from training.evaluation.compare import comparison, scenarios
from training.evaluation.compare.cases import SETS, make_cases
from training.evaluation.compare.comparison import StartsConfig
from training.evaluation.results.run import Run
from training.program.cli import main

CONFIG = StartsConfig(wrenches=6, timed=3, repeats=2, episodes=2, steps=5)
NAMES = ("constant", "ball", "smooth", "random_4", "six_decades", "ball_frictions")
HOLDS = ("gravity", "random")
OWN = """
import threading
from dataclasses import dataclass
from grasp_env.force.initial import LinearCombination

@dataclass
class Sometimes:
    limit: float = 0.0
    def __call__(self, grasp, wrench):
        if wrench[0] > self.limit:
            raise ArithmeticError("not to the right")
        return LinearCombination()(grasp, wrench)

def outside(grasp, wrench):
    return -(grasp.pseudoinverse @ wrench).reshape(-1, 3)

two = 2
held = threading.Lock().acquire
"""


@contextmanager
def shrunk(names: tuple[str, ...] = NAMES, holds: tuple[str, ...] = HOLDS) -> Iterator[None]:
    """Leave a few sets with six cases each, a few scenarios and one start of the environment."""
    with (
        patch.object(comparison, "SETS", {name: SETS[name] for name in names}),
        patch.object(comparison, "make_cases", lambda *given: make_cases(*given)[:6]),
        patch.object(
            comparison, "HOLDS_OF_STARTS", {name: scenarios.HOLDS_OF_STARTS[name] for name in holds}
        ),
        patch.object(comparison, "HELD_WITH", {"linear_combination": "linear_combination"}),
    ):
        yield


@cache
def own_file() -> Path:
    """A user's file with starts."""
    path = Path(tempfile.mkdtemp()) / "my_rules.py"
    atexit.register(shutil.rmtree, path.parent, ignore_errors=True)
    path.write_text(OWN)
    return path


@cache
def small_run() -> SimpleNamespace:
    """Run the command once in this process; return the run's folder, the words of the command,
    stdout and stderr."""
    out = own_file().parent
    own = own_file()
    words = ["evaluate", "--quick", "--on", "inline", "--out", str(out), "--name", "small"]
    for name in ("wrenches", "timed", "repeats", "episodes", "steps"):
        words += [f"--{name}", str(getattr(CONFIG, name))]
    for given in (f"sometimes={own}:Sometimes", f"outside={own}:outside"):
        words += ["--start", given]
    printed = StringIO()
    errors = StringIO()
    with (
        shrunk(),
        patch.multiple(comparison, _QUICK={}, WARM_UP=2),
        redirect_stdout(printed),
        redirect_stderr(errors),
    ):
        assert main(words) == 0, errors.getvalue()
    return SimpleNamespace(
        folder=Run(out / "small"), words=words, out=printed.getvalue(), err=errors.getvalue()
    )

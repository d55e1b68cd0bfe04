"""What the files of a run hold, for those that write them and those that read them. Imports numpy only."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from training.cases.set_table import TOLERANCE

METHODS = ("reduced_flow", "newton")
LEVELS = {"reduced_flow": tuple(10.0**-k for k in range(1, 7)), "newton": tuple(10.0**-k for k in range(1, 9))}
"""Relative gaps to the optimum whose first iteration is noted; a run ends at the last."""
BUDGETS = (0, 1, 2, 5, 10, 20)
"""Iterations after which the gap is noted."""
LIMIT = 5000
"""Most iterations of a run."""
STATUS = ("optimal", "iteration_limit", "stalled", "no_start", "not_applicable")
NO_START, NOT_APPLICABLE = 3, 4
TRACED, TRACE = 60, 300
"""Cases of a set whose gaps are kept, and iterations."""
FORCES_KEPT = ("constant", "paper_path", "smooth")
"""Sets whose starts are kept themselves."""
AT = LEVELS["reduced_flow"].index(TOLERANCE)
"""Its position in `LEVELS`."""
MAGNITUDES = (1e-3, 1e3)
"""[N] least and largest |(force, moment / 0.05 m)| of the wrenches on which a guarantee is counted, log-uniform."""
ROUNDING = 1e-10
"""Relative excess of Phi that two ways to sum it make."""

PATH_SCALE = 0.1
"""Of W_ext(t) in the roll-outs."""
SCENARIOS: dict[str, dict[str, Any]] = {
    "gravity": {"disturbance": "none"},
    "constant": {"disturbance": "constant"},
    "paper_path": {"disturbance": "paper_path", "disturbance_scale": PATH_SCALE},
    "random": {"disturbance": "random"},
    "late": {"disturbance": "random", "wrench_delay": 1},
    "unknown": {"disturbance": "random", "wrench": "none"},
    "impulses": {"disturbance": "impulses", "randomise": ("shape", "size", "mass", "friction")},
}
SCENARIO_LABELS = {
    "gravity": "gravity alone",
    "constant": "gravity + the paper's constant wrench",
    "paper_path": f"gravity + W_ext(t) x {PATH_SCALE:g}",
    "random": "gravity + random wrench (Ornstein-Uhlenbeck, 0.6 N / 0.02 N m per axis)",
    "late": "the same random wrench, told to the controller 4 ms late",
    "unknown": "the same random wrench, not told to the controller: pose feedback alone",
    "impulses": "gravity + impacts (half sines of 5 N / 0.1 N m, 0.05 s) on random objects",
}
HOLD_SCENARIOS = ("gravity", "constant", "paper_path")
RANDOM_SCENARIOS = ("random", "late", "unknown", "impulses")
Trials = dict[str, np.ndarray]


def starts_in(trials: Trials, method: str = METHODS[0]) -> Iterator[str]:
    """The starts that a trials file holds for a method, in its order."""
    return (name.split("/")[1] for name in trials if name.startswith(f"{method}/") and name.endswith("/status"))


def worse(excess: np.ndarray) -> np.ndarray:
    """(n,) whether a start's Phi over that of the basis's, minus one, is too large, or missing."""
    return ~(excess <= ROUNDING)

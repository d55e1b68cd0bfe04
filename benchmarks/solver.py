"""Our solvers beside others', on the same problems: microseconds, gap, balance, violation, failures."""

from __future__ import annotations

from functools import partial

import numpy as np

from benchmarks.peers import PEERS, Peer
from benchmarks.problem import Solver, achieved, best_times, compiled_times, problems
from benchmarks.settings import Benchmark, Effort, tick
from grasp_env._check import Array, Wrench
from grasp_env.force import ForceOptimizer, Objective, Status
from grasp_env.grasp import Grasp
from training.results.table import join, pd

SLOW_CONTACTS, SLOW_PASSES = 5, 2
"""Most contacts, and all calls of a problem, of a slow peer."""


class Ours(Solver):
    """One of our methods; the time is that of the compiled call, or of `ForceOptimizer.solve`."""

    def __init__(self, grasp: Grasp, method: str, tolerance: float, compiled: bool) -> None:
        self._optimizer = ForceOptimizer(grasp, method=method, tolerance=tolerance)
        self._compiled = compiled

    def solve(self, wrench: Wrench) -> Array:
        """See `Solver`."""
        grasp, solution = self._optimizer.grasp, self._optimizer.solve(wrench)
        good = solution.status is Status.OPTIMAL
        return grasp.to_cone(solution.force) if good else np.full(3 * grasp.n_contacts, np.nan)

    def times(self, wrenches: Array, passes: int) -> Array:
        """See `Solver`."""
        if self._compiled:
            return compiled_times(self._optimizer, wrenches, passes)[0]
        return best_times(self._optimizer.solve, wrenches, passes)


def _ours(setting: str, method: str, tolerance: float, compiled: bool) -> Peer:
    build = partial(Ours, method=method, tolerance=tolerance, compiled=compiled)
    return Peer(f"ours: {setting}, certificate included, to {tolerance:.0e}", build, against="")


CONTESTANTS = {
    "conic": _ours("the compiled call", "conic", 1e-6, True),
    "conic_python": _ours("ForceOptimizer.solve", "conic", 1e-6, False),
    "newton": _ours("another problem, Phi; the compiled call", "newton", 1e-8, True),
    "newton_python": _ours("another problem, Phi; ForceOptimizer.solve", "newton", 1e-8, False),
} | PEERS


def run(settings: Effort) -> pd.DataFrame:
    """Times all solvers in rounds, one after the other, and checks their answers.

    Returns:
        A row for each solver and problem; `ratio` is its time over that of ours which is called in the same way.
    """
    missing: dict[str, str] = {}
    parts = []
    for count in settings.contacts:
        made = problems(settings.seed, count, settings.wrenches)
        solvers: dict[str, list[Solver]] = {}
        for name, peer in CONTESTANTS.items():
            if name in missing or (peer.slow and count > SLOW_CONTACTS):
                continue
            tick(f"{count} contacts: building {name}")
            try:
                solvers[name] = [peer.build(grasp) for grasp, _ in made]
            except ImportError as error:
                missing[name] = f"{error}: pip install {peer.package}"
            except RuntimeError as error:
                missing[name] = str(error)
        best = {name: np.full(settings.wrenches, np.inf) for name in solvers}
        for turn in range(settings.rounds):
            for name, each in solvers.items():
                slow = CONTESTANTS[name].slow
                if slow and turn > 0:
                    continue
                tick(f"{count} contacts, round {turn + 1} of {settings.rounds}: {name}")
                passes = SLOW_PASSES if slow else settings.passes
                taken = [solver.times(loads, passes) for solver, (_, loads) in zip(each, made, strict=True)]
                best[name] = np.minimum(best[name], np.concatenate(taken))
        for name, each in solvers.items():
            tick(f"{count} contacts: checking {name}")
            checks = [check(*pair, solver, "newton" in name) for solver, pair in zip(each, made, strict=True)]
            rows = pd.concat(checks, ignore_index=True).assign(method=name, contacts=count)
            against = CONTESTANTS[name].against
            ratio = best[name] / best[against] if against else None
            parts.append(rows.assign(problem=rows.index, microseconds=1e6 * best[name], ratio=ratio))
    parts.append(pd.DataFrame([{"method": name, "reason": reason} for name, reason in missing.items()]))
    return join(parts)


def check(grasp: Grasp, loads: Array, solver: Solver, phi: bool) -> pd.DataFrame:
    """Gap, balance and violation of a solver's answers for wrenches (n, 6), and which failed.

    The gap is taken to a dual bound that needs no trust in the solver that found it: of Phi, or of the sum of normal forces.
    """
    answers = np.array([solver.solve(wrench) for wrench in loads])
    objective, balance, violation = achieved(grasp, loads, answers)
    if phi:
        objective = np.array([Objective().value(answer) for answer in answers])
    exact = ForceOptimizer(grasp, method="newton" if phi else "conic", tolerance=1e-12 if phi else 1e-10)
    gap = np.abs(objective / np.array([exact.solve(wrench).lower_bound for wrench in loads]) - 1.0)
    return pd.DataFrame({"gap": gap, "balance": balance, "violation": violation, "failed": ~np.isfinite(gap)})


BENCHMARK = Benchmark(
    run,
    Effort((3, 4, 5, 8, 16, 50), wrenches=1000, rounds=6, passes=4),
    quick={"wrenches": 80, "rounds": 2, "passes": 2},
    shown=(
        "microseconds_median", "microseconds_p99", "ratio_median", "ratio_low", "ratio_high", "failed_sum", "gap_max", "balance_max",
        "violation_max",
    ),
    words={name: peer.setting for name, peer in CONTESTANTS.items()},
)  # fmt: skip

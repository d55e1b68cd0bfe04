"""Our solvers beside others', side by side on the same problems: microseconds, gap, violation, failures."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from grasp_env._check import Array
from grasp_env.force import ForceOptimizer, optimize_forces
from grasp_env.force.record import CODE, FORCE, record_size
from grasp_env.grasp import Grasp
from training import peers
from training.bench.grasps import problems
from training.bench.timing import Effort, compiled_times
from training.peers.problem import best_times
from training.runs import provenance

EFFORT = Effort((3, 4, 5, 8, 16, 50), wrenches=1000, rounds=6, passes=4)
OURS = {
    "conic": "ours: the compiled call, start and certificate included, to 1e-6",
    "conic_python": "ours: ForceOptimizer.solve from Python, certificate included, to 1e-6",
    "newton": "ours: another problem, Phi; the compiled call from the 12-basis, to 1e-8",
    "newton_python": "ours: the same through ForceOptimizer.solve",
}


@dataclass(frozen=True)
class Row:
    """One solver on one number of contacts.

    Attributes:
        key, label: the solver.
        count: contacts.
        times: (n,) seconds, best pass of every problem.
        gap: (n,) objective over a dual bound, minus one; nan where it failed. (Of `newton`: of Phi.)
        balance: (n,) |G f + w| relative to the wrench.
        violation: (n,) how far outside the cones, relative to the forces; 0 inside.
    """

    key: str
    label: str
    count: int
    times: Array
    gap: Array
    balance: Array
    violation: Array

    def numbers(self) -> dict[str, Any]:
        """What a table shows."""
        micro, good = self.times * 1e6, np.isfinite(self.gap)
        return {
            "solver": self.key,
            "label": self.label,
            "contacts": self.count,
            "problems": len(micro),
            "failed": int((~good).sum()),
            "p50_us": float(np.median(micro)),
            "p99_us": float(np.percentile(micro, 99)),
            "gap_max": float(np.abs(self.gap[good]).max(initial=0.0)),
            "balance_max": float(np.nanmax(self.balance, initial=0.0)),
            "violation_max": float(np.nanmax(self.violation, initial=0.0)),
        }


def solver(
    effort: Effort = EFFORT, folder: Path = Path("runs/bench"), tick: Callable[[str], None] = lambda text: None
) -> dict[str, Any]:
    """Times all solvers in rounds, one after the other.

    Args:
        effort: how much (SLSQP: two calls).
        folder: where generated C code is compiled and kept.
        tick: told what runs.

    Returns:
        {"rows": [...], "batches": [...], "ratios": {...}, "missing": {...}, provenance...}.
    """
    here = peers.available(folder)
    missing = {peer.name: peer.reason for peer in here if isinstance(peer, peers.MissingPeer)}
    rivals = [peer for peer in here if isinstance(peer, peers.Peer)]
    rows, batches = [], []
    for count in effort.sizes:
        parts = problems(effort.seed, count, effort.wrenches)
        contestants: dict[str, list[tuple[Callable[[int], Array], Callable[[], Array]]]] = {}
        together: dict[str, list[Callable[[], Array]]] = {}
        labels = dict(OURS)
        for grasp, loads in parts:
            for key, pair in _ours(grasp, loads).items():
                contestants.setdefault(key, []).append(pair)
            together.setdefault("conic", []).append(_our_batch(grasp, loads))
            cost = 1.0 / grasp.friction
            for peer in rivals:
                if peer.most_contacts is not None and count > peer.most_contacts:
                    continue
                tick(f"{count} contacts: building {peer.name}")
                made = peer.build(grasp.cone_matrix, cost)
                labels[peer.name] = f"{peer.package} {peer.version}: {peer.setting}"
                contestants.setdefault(peer.name, []).append(_rival(made, loads))
                if isinstance(made, peers.BatchSolver) and peer.name == peer.package:
                    made.prepare(len(loads))
                    together.setdefault(peer.name, []).append(partial(made.solve_many, loads))
        best: dict[str, list[Array]] = {key: [np.full(len(loads), np.inf) for _, loads in parts] for key in contestants}
        for turn in range(effort.rounds):
            for key, pairs in contestants.items():
                if key == "slsqp" and turn > 0:
                    continue
                tick(f"{count} contacts, round {turn + 1} of {effort.rounds}: {key}")
                for k, (timed, _) in enumerate(pairs):
                    best[key][k] = np.minimum(best[key][k], timed(2 if key == "slsqp" else effort.passes))
        tick(f"{count} contacts: batches")
        batches += _batches(count, together, effort.rounds * effort.passes)
        for key, pairs in contestants.items():
            tick(f"{count} contacts: checking {key}")
            checks = [
                _check(grasp, loads, answer(), key) for (grasp, loads), (_, answer) in zip(parts, pairs, strict=True)
            ]
            gap, balance, violation = (np.concatenate(column) for column in zip(*checks, strict=True))
            rows.append(Row(key, labels[key], count, np.concatenate(best[key]), gap, balance, violation).numbers())
    return {
        "kind": "solver",
        "settings": effort.settings(),
        "rows": rows,
        "batches": batches,
        "ratios": ratios(rows),
        "missing": missing,
        "load": os.getloadavg(),
        "provenance": provenance(),
    }


def ratios(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """How many times faster we are: the comparisons that the project is measured by."""
    median = {(row["solver"], row["contacts"]): row for row in rows}
    out = []
    for name, ours, theirs in (
        ("compiled conic against QOCOGEN's C", "conic", "qocogen"),
        ("conic from Python against Clarabel", "conic_python", "clarabel"),
        ("conic from Python against QOCO", "conic_python", "qoco"),
        ("conic from Python against Moreau", "conic_python", "moreau"),
        ("compiled newton against QOCOGEN's C", "newton", "qocogen"),
    ):
        for (key, count), row in median.items():
            if key == ours and (theirs, count) in median:
                other = median[theirs, count]
                out.append({"comparison": name, "contacts": count, "ratio_p50": other["p50_us"] / row["p50_us"],
                            "our_p99_over_their_p50": row["p99_us"] / other["p50_us"]})  # fmt: skip
    return out


def _ours(grasp: Grasp, loads: Array) -> dict[str, tuple[Callable[[int], Array], Callable[[], Array]]]:
    records = np.empty((len(loads), record_size(grasp.n_contacts)))
    out = {}
    for method, tolerance in (("conic", 1e-6), ("newton", 1e-8)):
        optimizer = ForceOptimizer(grasp, method=method, tolerance=tolerance)

        def compiled(passes: int, optimizer: ForceOptimizer = optimizer) -> Array:
            return compiled_times(optimizer, loads, passes, records)

        def python(passes: int, optimizer: ForceOptimizer = optimizer) -> Array:
            return best_times(optimizer.solve, loads, passes)

        def answers(optimizer: ForceOptimizer = optimizer) -> Array:
            return np.array([_cone(grasp, optimizer.solve(w)._record) for w in loads])

        out[method], out[f"{method}_python"] = (compiled, answers), (python, answers)
    return out


def _our_batch(grasp: Grasp, loads: Array) -> Callable[[], Array]:
    """`optimize_forces` on all cores, which sets up the grasp in every call."""
    return lambda: optimize_forces(grasp, loads, method="conic", tolerance=1e-6).force


def _batches(count: int, together: dict[str, list[Callable[[], Array]]], passes: int) -> list[dict[str, Any]]:
    """Solves per second of one call for all wrenches of a grasp, the best of `passes`, the solvers taking turns."""
    best = {key: np.full(len(calls), np.inf) for key, calls in together.items()}
    solved: dict[str, list[Array]] = {}
    for _ in range(passes):
        for key, calls in together.items():
            solved[key] = []
            for k, call in enumerate(calls):
                begin = time.perf_counter()
                solved[key].append(call())
                best[key][k] = min(best[key][k], time.perf_counter() - begin)
    sizes = {key: [len(answers) for answers in each] for key, each in solved.items()}
    return [
        {
            "solver": key, "contacts": count, "batch": max(sizes[key]), "per_second": sum(sizes[key]) / float(best[key].sum()),
            "failed": int(sum(np.isnan(answers.reshape(len(answers), -1)).any(axis=1).sum() for answers in solved[key])),
        }
        for key in together
    ]  # fmt: skip


def _cone(grasp: Grasp, record: Array) -> Array:
    if record[CODE] != 0.0:
        return np.full(3 * grasp.n_contacts, np.nan)
    return grasp.to_cone(record[FORCE : FORCE + 3 * grasp.n_contacts])


def _rival(made: peers.Solver, loads: Array) -> tuple[Callable[[int], Array], Callable[[], Array]]:
    return lambda passes: made.times(loads, passes), lambda: np.array([made.solve(w) for w in loads])


def _check(grasp: Grasp, loads: Array, answers: Array, key: str) -> tuple[Array, Array, Array]:
    """(gap, balance, violation): the gap is taken to a dual bound that needs no trust in the solver that found it."""
    measured = peers.achieved(grasp.cone_matrix, 1.0 / grasp.friction, loads, answers)
    if key.startswith("newton"):
        own = ForceOptimizer(grasp, method="newton", tolerance=1e-8)
        exact = ForceOptimizer(grasp, method="newton", tolerance=1e-12)
        reached = np.array([own.solve(w).objective for w in loads])
        gap = np.where(np.isfinite(measured.objective), reached, np.nan)
    else:
        exact = ForceOptimizer(grasp, method="conic", tolerance=1e-10)
        gap = measured.objective
    gap = gap / np.array([exact.solve(w).lower_bound for w in loads]) - 1.0
    size = np.abs(answers).max(axis=1)
    return gap, measured.balance / np.abs(loads).max(axis=1), measured.violation / size

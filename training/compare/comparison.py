"""`grasp evaluate`: every start on every set of cases by every method, roll-outs of the hand, and times, as rows."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from rich.console import Console

from grasp_env._check import ContactForces
from grasp_env.force import ForceOptimizer, InitialForceRule, Objective
from grasp_env.grasp import presets
from policies.learned import PRETRAINED
from training.compare.cases import SETS, make_cases
from training.compare.given import METHODS, Given
from training.compare.holds import HOLDS_OF_STARTS, hold_of_start
from training.compare.starts import Made, Workshop, phi_options
from training.compare.trial import problem_of, trials
from training.results.bars import progress
from training.results.run import Run, check_counts
from training.results.shards import map_shards
from training.results.table import join, pd, table

WARM_UP = 20
"""Calls of every kind that are not counted."""
TIMED_SET = "ball"
MODEL = "model"
"""Case of the row about the shipped model."""
HELD_WITH = {"single_value": "single_value", "linear_combination": "linear_combination", "previous_tangent": "previous"}
"""Starts of the roll-outs besides the shipped model and a user's, and what the environment calls them."""
_QUICK = {"wrenches": 50, "timed": 50, "repeats": 3, "episodes": 1}


@dataclass(frozen=True)
class StartsConfig:
    """Settings of the comparison of starts.

    Attributes:
        wrenches: number of cases of a full set of wrenches; the other sets have their share of it.
        timed: number of wrenches whose calls are timed.
        repeats: how often each of those calls is timed.
        episodes: of each random scenario of the roll-outs, per start.
        steps: of each roll-out, at 50 per second.
        seed: of everything held out.
        quick: a small version that ends within a minute and says that it is quick.
    """

    wrenches: int = 1000
    timed: int = 500
    repeats: int = 7
    episodes: int = 10
    steps: int = 100
    seed: int = 0
    quick: bool = False

    def __post_init__(self) -> None:
        counts = ("wrenches", "timed", "repeats", "episodes", "steps")
        check_counts(self, {**dict.fromkeys(counts, 1), "seed": 0})

    def resolved(self) -> StartsConfig:
        """The settings in force: `quick` shrinks everything but the protocol."""
        least = {name: min(getattr(self, name), value) for name, value in _QUICK.items()}
        return replace(self, **least) if self.quick else self


@dataclass(frozen=True)
class Shard:
    """A part of the comparison, for a worker: a set of cases, or the roll-outs of a scenario from a start."""

    name: str
    config: StartsConfig
    given: Given
    objective: Objective


def run(
    config: StartsConfig,
    given: Given | None = None,
    folder: Run | None = None,
    *,
    on: str = "processes",
    workers: int = 0,
    console: Console | None = None,
) -> tuple[pd.DataFrame, dict[str, Any]]:
    """The rows of the comparison, and what the run folder should say of it.

    Args:
        config: what is compared.
        given: starts and solvers of a user.
        folder: keeps finished shards; None: nothing is kept.
        on: where the shards run, see `map_shards`. Times are measured in this process alone.
        workers: see `map_shards`.
        console: for the progress bar.
    """
    config, given, objective = config.resolved(), given or Given.of(), Objective()
    shards = {name: Shard(name, config, given, objective) for name in plan(given)}
    keep = folder and folder.folder / "shards"
    mapped = map_shards(work, shards, on=on, workers=workers, keep=keep, label="comparing starts", console=console)
    timed = time_calls(config, given, objective, console)
    rows = join([mapped.rows.merge(timed, "left", ["case", "problem", "start", "method"]), _shipped()])
    rows = rows.sort_values("case", kind="stable", key=lambda cases: cases.map(_place), ignore_index=True)
    about = {
        "kind": "starts",
        "settings": asdict(config),
        "quick": config.quick,
        "given": dict(given.names),
        "objective": {"force_weight": objective.force_weight, "barrier_weight": objective.barrier_weight},
        "map": mapped.about,
    }
    return rows, about


def _place(case: str) -> int:
    """The place of a case in the table: the sets in their order, the roll-outs, the model."""
    return [*SETS, *(f"hold_{name}" for name in HOLDS_OF_STARTS), MODEL].index(case)


def _shipped() -> pd.DataFrame:
    """The cost of the shipped model: processor time of its training, and the size of its files."""
    stem = PRETRAINED / "four_finger"
    card = Workshop(Objective()).model.checkpoint.card
    size = sum(path.stat().st_size for path in stem.parent.glob(f"{stem.name}.*"))
    cpu = card.get("cpu_seconds", card.get("seconds"))
    return table([{"case": MODEL, "start": "learned_fixed", "cpu_seconds": cpu, "bytes": size}])


def plan(given: Given) -> list[str]:
    """The shards, longest first: "holds/<scenario>/<start>" and "<set>"."""
    rules, _ = given.unpack()
    sets = sorted(SETS, key=lambda name: -SETS[name].share * SETS[name].cost)
    holds = [
        f"holds/{scenario}/{start}" for scenario in HOLDS_OF_STARTS for start in (*HELD_WITH, "learned_fixed", *rules)
    ]
    return sets + holds


def work(shard: Shard) -> pd.DataFrame:
    """The rows of a shard, in a worker."""
    config = shard.config
    rules, solvers, made = _made(shard.given, shard.objective)
    if shard.name.startswith("holds/"):
        _, scenario, start = shard.name.split("/")
        rule = HELD_WITH.get(start) or rules.get(start) or Workshop(shard.objective).model
        return table(hold_of_start(scenario, start, rule, config.episodes, config.seed, config.steps))
    which = SETS[shard.name]
    starts = {key: one for key, one in made.items() if not which.starts or key in which.starts or key in rules}
    cases = make_cases(shard.name, config.wrenches, config.seed)
    rows = trials(shard.name, cases, starts, solvers if which.solved else {}, shard.objective, which.solved)
    return table({**row, "seed": config.seed} for row in rows)


@cache
def _made(
    given: Given, objective: Objective
) -> tuple[Mapping[str, InitialForceRule], Mapping[str, Any], dict[str, Made]]:
    rules, solvers = given.unpack()
    return rules, solvers, Workshop(objective, rules).made()


def time_calls(config: StartsConfig, given: Given, objective: Objective, console: Console | None) -> pd.DataFrame:
    """Microseconds of every start and solver on wrenches of the ball: best of the repeats, the starts taking turns.

    A block of one start's calls in a row is what a control loop that does nothing else pays: its code and data are in the cache.
    The previous solution is that of the wrench before, as in a loop. A call that raises has no time.

    Returns:
        Columns case, problem, start, method, microseconds (the whole public call), start_microseconds (the start alone).
    """
    _, solvers, made = _made(given, objective)
    cases = make_cases(TIMED_SET, config.wrenches, config.seed)[: config.timed]
    grasp, phi = presets.paper_cuboid(), phi_options(objective)
    newton = ForceOptimizer(grasp, method="newton", **phi)
    optima = [newton.solve(case.wrench).force for case in cases]
    calls: dict[tuple[str | None, str], tuple[Callable[[int], object], Callable[[int], object] | None]] = {}
    for key, start in made.items():

        def alone(k: int, start: Made = start) -> ContactForces:
            return start.start(grasp, cases[k].wrench, optima[k - 1])

        for method in METHODS:
            loop = ForceOptimizer(grasp, method=method, **start.options, **phi)
            force = None if start.options else alone
            calls[key, method] = (
                lambda k, loop=loop, force=force: loop.solve(cases[k].wrench, initial=force and force(k)),
                alone if method == METHODS[0] else None,
            )
    for key, solver in solvers.items():
        problems = [problem_of(grasp, case.wrench, objective) for case in cases]
        calls[None, key] = lambda k, solver=solver, problems=problems: solver.solve(problems[k]), None
    best = {who: np.full((2, len(cases)), np.inf) for who in calls}
    collecting = gc.isenabled()
    try:
        with progress(console) as bar:
            for turn in bar.track(range(-1, config.repeats), description="timing calls"):
                gc.collect()
                gc.disable()
                for who, both in calls.items():
                    for place, call in enumerate(both):
                        if call is not None:
                            _time(call, best[who][place], len(cases) if turn >= 0 else 0)
    finally:
        if collecting:
            gc.enable()
    return table(
        {
            "case": TIMED_SET, "problem": k, "start": start, "method": method, "microseconds": total[k],
            "start_microseconds": best[start, METHODS[0]][1][k] if start is not None else np.nan,
        }
        for (start, method), (total, _) in ((who, best[who]) for who in calls) for k in range(len(cases))
    ).replace(np.inf, np.nan)  # fmt: skip


def _time(call: Callable[[int], object], best: np.ndarray, count: int) -> None:
    """Warms up, then calls on the first `count` problems; `best` (n,) keeps the shortest time [us]."""
    for k in range(WARM_UP):
        with suppress(Exception):  # a user's rule: its errors are counted in the trials
            call(k % len(best))
    for k in range(count):
        begin = time.perf_counter_ns()
        try:
            call(k)
        except Exception:
            continue
        best[k] = min(best[k], (time.perf_counter_ns() - begin) / 1e3)

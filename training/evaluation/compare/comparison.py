"""Comparison of starts (`grasp evaluate`): solves, roll-outs of the hand, and times, as rows."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from grasp_env.force import Objective
from grasp_env.force.initial import InitialForceRule
from grasp_env.grasp import Grasp
from grasp_env.inputs.arguments import ContactForces
from policies.learned import PRETRAINED
from training.evaluation.compare.cases import SETS, make_cases
from training.evaluation.compare.given import Given
from training.evaluation.compare.holds import HOLDS_OF_STARTS, hold_of_start
from training.evaluation.compare.methods import FLOW, METHODS, optimizer
from training.evaluation.compare.starts import ComparedStart, StartContext
from training.evaluation.compare.trial import TOLERANCE, trials
from training.evaluation.results.bars import progress
from training.evaluation.results.run import Run, check_counts
from training.evaluation.results.shards import map_shards
from training.evaluation.results.table import join, pd, table

Call = Callable[[int], object]
"""Function of the number of a problem, to be timed."""
WARM_UP = 20
"""Warm-up calls before each timing."""
TIMED_SETS = ("ball", "ball_frictions")
MODEL = "model"
"""Case of the row about the shipped model."""
HELD_WITH = {
    "single_value": "single_value",
    "linear_combination": "linear_combination",
    "previous_tangent": "previous",
}
"""Starts of the roll-outs, besides the model and a user's, and their names in the environment."""
_QUICK = {"wrenches": 50, "timed": 50, "repeats": 3, "episodes": 1}


@dataclass(frozen=True)
class StartsConfig:
    """Settings of the comparison of starts.

    Attributes:
        wrenches, timed, repeats, episodes, steps, seed, quick: the options of `grasp evaluate
            starts`.
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
        """Return the settings, with smaller counts if `quick`; the protocol is the same."""
        least = {name: min(getattr(self, name), value) for name, value in _QUICK.items()}
        return replace(self, **least) if self.quick else self


@dataclass(frozen=True)
class Shard:
    """Work for one process: a set of cases, or the roll-outs of a scenario from one start."""

    name: str
    config: StartsConfig
    given: Given
    objective: Objective


def run(
    config: StartsConfig,
    given: Given,
    folder: Run | None = None,
    *,
    on: str = "processes",
    workers: int = 0,
) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Run the comparison; return its rows, and the settings for run.json.

    `folder` keeps finished shards; for `on` and `workers` see `map_shards`, and for times
    `time_calls`.
    """
    config = config.resolved()
    objective = Objective()
    shards = {name: Shard(name, config, given, objective) for name in plan(given)}
    keep = folder and folder.shards
    rows, mapped = map_shards(
        work, shards, on=on, workers=workers, keep=keep, label="comparing starts"
    )
    timed = join([time_calls(name, config, given, objective) for name in TIMED_SETS])
    rows = join([rows.merge(timed, "left", ["case", "problem", "start", "method"]), _shipped()])
    order = [*SETS, *(f"hold_{name}" for name in HOLDS_OF_STARTS), MODEL].index
    rows = rows.sort_values(
        "case", kind="stable", key=lambda cases: cases.map(order), ignore_index=True
    )
    about = {
        "kind": "starts",
        "settings": asdict(config),
        "quick": config.quick,
        "given": dict(given.names),
        "objective": dict(vars(objective)),
        "map": mapped,
    }
    return rows, about


def _shipped() -> pd.DataFrame:
    """Return a row with the processor time of the shipped model's training, and its size."""
    stem = PRETRAINED / "four_finger"
    card = StartContext(Objective()).model.checkpoint.card
    size = sum(path.stat().st_size for path in stem.parent.glob(f"{stem.name}.*"))
    cpu = card.get("cpu_seconds", card.get("seconds"))
    return table([{"case": MODEL, "start": "learned_fixed", "cpu_seconds": cpu, "bytes": size}])


def plan(given: Given) -> list[str]:
    """Return the names of the shards, longest first: "<set>" and "holds/<scenario>/<start>"."""
    rules = given.unpack()
    sets = sorted(SETS, key=lambda name: -SETS[name].share * SETS[name].cost)
    holds = [
        f"holds/{scenario}/{start}"
        for scenario in HOLDS_OF_STARTS
        for start in (*HELD_WITH, "learned_fixed", *rules)
    ]
    return sets + holds


def work(shard: Shard) -> pd.DataFrame:
    """Return the rows of a shard; this runs in a worker."""
    config = shard.config
    rules, starts = _starts(shard.given, shard.objective)
    if shard.name.startswith("holds/"):
        _, scenario, start = shard.name.split("/")
        rule = HELD_WITH.get(start) or rules.get(start) or StartContext(shard.objective).model
        return table(
            hold_of_start(scenario, start, rule, config.episodes, config.seed, config.steps)
        )
    starts = _evaluated(shard.name, starts, rules)
    cases = make_cases(shard.name, config.wrenches, config.seed)
    rows = trials(shard.name, cases, starts, shard.objective, SETS[shard.name].solved)
    return table({**row, "seed": config.seed} for row in rows)


@cache
def _starts(
    given: Given, objective: Objective
) -> tuple[Mapping[str, InitialForceRule], dict[str, ComparedStart]]:
    rules = given.unpack()
    return rules, StartContext(objective, rules).all_starts()


def _evaluated(
    name: str, starts: Mapping[str, ComparedStart], given: Mapping[str, InitialForceRule]
) -> dict[str, ComparedStart]:
    only = SETS[name].starts
    return {key: start for key, start in starts.items() if not only or key in {*only, *given}}


def time_calls(name: str, config: StartsConfig, given: Given, objective: Objective) -> pd.DataFrame:
    """Time every start on wrenches of a set [us]: the best of the repeats; the starts take turns.

    All calls of one start on one grasp are made in a row, so code and data are in the cache as in a
    control loop. The previous solution is that of the wrench before. A call that raises has no
    time.

    Returns:
        Columns case, problem, start, method, microseconds (the whole public call),
        start_microseconds (the start alone) and, of starts that the core makes from the wrench
        alone, compiled_microseconds (the call without Python).
    """
    rules, starts = _starts(given, objective)
    starts = _evaluated(name, starts, rules)
    cases = make_cases(name, config.wrenches, config.seed)[: config.timed]
    blocks: dict[Grasp, list[int]] = {}
    for k, case in enumerate(cases):
        blocks.setdefault(case.grasp, []).append(k)
    optima: list[ContactForces] = [np.empty(0)] * len(cases)
    for grasp, block in blocks.items():
        newton = optimizer(grasp, "newton", objective, TOLERANCE)
        for k in block:
            optima[k] = newton.solve(cases[k].wrench).force
    before = {k: block[i - 1] for block in blocks.values() for i, k in enumerate(block)}
    calls = dict[tuple[str, str], Call]()
    compiled = dict[tuple[str, str], np.ndarray]()
    for key, start in starts.items():

        def alone(k: int, start: ComparedStart = start) -> ContactForces:
            return start.start(cases[k].grasp, cases[k].wrench, optima[before[k]])

        for method in METHODS:
            loops = {
                grasp: optimizer(grasp, method, objective, TOLERANCE, **start.options)
                for grasp in blocks
            }
            force = None if start.options else alone
            calls[key, method] = lambda k, loops=loops, force=force: loops[cases[k].grasp].solve(
                cases[k].wrench, initial=force and force(k)
            )
            if method == FLOW:
                calls[key, "alone"] = alone
            if start.compiled:
                compiled[key, method] = best = np.empty(len(cases))
                for grasp, block in blocks.items():
                    core = loops[grasp].core
                    seconds = np.empty(len(block))
                    records = np.empty((len(block), core.size))
                    loads = np.array([cases[k].wrench for k in block])
                    core.times(loads, 2 + config.repeats, records, seconds)
                    best[block] = 1e6 * seconds
    best_of = {key: np.full(len(cases), np.inf) for key in calls}
    collecting = gc.isenabled()
    try:
        with progress() as bar:
            for turn in bar.track(range(-1, config.repeats), description="timing calls"):
                gc.collect()
                gc.disable()
                for key, call in calls.items():
                    for block in blocks.values():
                        _time(call, best_of[key], block, counted=turn >= 0)
    finally:
        if collecting:
            gc.enable()
    missing = np.full(len(cases), np.nan)
    return table(
        {
            "case": name,
            "problem": k,
            "start": start,
            "method": method,
            "microseconds": total[k],
            "start_microseconds": best_of[start, "alone"][k],
            "compiled_microseconds": compiled.get((start, method), missing)[k],
        }
        for (start, method), total in best_of.items()
        if method in METHODS
        for k in range(len(cases))
    ).replace(np.inf, np.nan)


def _time(call: Call, best: np.ndarray, block: list[int], counted: bool) -> None:
    """Warm up on a block of problems; if `counted`, keep the shortest times [us] in `best` (n,)."""
    for k in range(WARM_UP):
        with suppress(Exception):  # a user's rule may raise; the trials count its errors
            call(block[k % len(block)])
    for k in block if counted else ():
        begin = time.perf_counter_ns()
        try:
            call(k)
        except Exception:
            continue
        best[k] = min(best[k], (time.perf_counter_ns() - begin) / 1e3)

"""`grasp evaluate transfer` and `evaluate env --hands`: every scenario in its engines, a seed in all of them before the next."""

from __future__ import annotations

import time
import warnings
from dataclasses import asdict
from typing import Any

from rich.console import Console

from grasp_env._extras import need
from grasp_env.env.env import FourFingerGrasp
from grasp_env.errors import GraspError
from grasp_env.sim import HandDescription
from training.data.episodes import episode
from training.runs import Run, default_name, provenance
from training.runs.workers import begin
from training.trials.hand_plan import ENGINES, PRESETS, Scenario, hands_plan, transfer_plan
from training.trials.holds import roll_out, run_trial, settings_of
from training.trials.settings import HandsConfig, TransferConfig

CHUNK = 2
"""Seeds a worker is given at a time."""
QUICK_EPISODES = 2
_TIMED, _ROUNDS = 100, 3
"""Agent steps whose rate is told, and how often they are timed."""


def evaluate_transfer(
    config: TransferConfig, console: Console | None = None, plan: list[Scenario] | None = None
) -> Run:
    """The same hands, objects and controllers in both engines; all trials lie in `<out>/<name>` afterwards.

    Args:
        config: the settings.
        console: for the progress; None: stderr.
        plan: instead of `hand_plan.transfer_plan`.

    Raises:
        InvalidInputError: the run is finished, or was begun with other settings.
        MissingExtraError: MuJoCo is not installed.
    """
    need("mujoco")
    hands = config.hands or PRESETS
    made = transfer_plan(hands, QUICK_EPISODES if config.quick else config.episodes) if plan is None else plan
    return _roll_out("transfer", config, made, console)


def evaluate_hands(config: HandsConfig, console: Console | None = None, plan: list[Scenario] | None = None) -> Run:
    """Hands x objects x disturbances; see `evaluate_transfer`."""
    if set(config.engines) - {"bullet"}:
        need("mujoco")
    episodes = QUICK_EPISODES if config.quick else config.episodes
    return _roll_out(
        "hands", config, hands_plan(config.hands, config.engines, episodes) if plan is None else plan, console
    )


def run_chunk(scenario: dict[str, Any], seeds: list[int]) -> list[dict[str, Any]]:
    """The trials of some seeds in all engines of a scenario, for a worker process: what they share is made once."""
    rows = []
    for seed in seeds:
        for engine in scenario["engines"]:
            settings = {"hand": scenario["hand"], **scenario["settings"], **ENGINES[engine]}
            rows.append({"engine": engine, **run_trial(settings, scenario["random_objects"], seed)})
    return rows


def _roll_out(kind: str, config: Any, plan: list[Scenario], console: Console | None) -> Run:
    console = console or Console(stderr=True)
    for name in config.hands:
        _tell_repairs(name, console)
    run = Run.create(config.out, config.name or default_name(kind))
    begun = {"seed": config.seed, "quick": config.quick, "scenarios": [asdict(scenario) for scenario in plan]}
    begin(run, begun, "hands, engines, episodes, seed or settings")
    roll_out(run, plan, CHUNK, run_chunk, config, console)
    settings = {**asdict(config), "name": run.folder.name}
    run.write_json("run.json", {"kind": kind, **provenance(), **begun, "speed": _speeds(plan), "config": settings})
    return run


def _tell_repairs(name: str, console: Console) -> None:
    """Says once what reading a URDF repairs; the workers read it silently.

    Raises:
        InvalidInputError: it cannot be read.
    """
    if not name.endswith(".urdf"):
        return
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        HandDescription.from_urdf(name)
    for warning in told:
        console.print(f"repaired: {warning.message}", highlight=False, soft_wrap=True)


def _speeds(plan: list[Scenario]) -> dict[str, dict[str, float]]:
    """Agent steps per second of every hand in every engine, alone in this process, best of some rounds of its first scenario."""
    first: dict[tuple[str, str], Scenario] = {}
    for scenario in plan:
        for engine in scenario.engines:
            first.setdefault((scenario.hand, engine), scenario)
    out: dict[str, dict[str, float]] = {}
    for (hand, engine), scenario in first.items():
        try:
            env = FourFingerGrasp(config=settings_of({"hand": hand, **scenario.settings, **ENGINES[engine]}))
        except GraspError:
            continue
        rates = []
        for seed in range(_ROUNDS):
            running, begun = episode(env, seed, most=_TIMED), time.perf_counter()
            steps = sum(1 for _ in running)
            rates.append(steps / (time.perf_counter() - begun))
        env.close()
        out.setdefault(hand, {})[engine] = max(rates)
    return out

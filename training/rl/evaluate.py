"""Scores of trained agents beside the paper, the learned start and the previous solution, on the same held-out episodes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from grasp_env.errors import InvalidInputError
from policies import LearnedInitialForce, ZeroPolicy
from policies.agent import TrainedAgent
from policies.agent_files import ACTION_SIZES
from training.report.rl import write_report
from training.rl.score import score
from training.rl.settings import CURVE_SEED, HELD_OUT_SEED, RLConfig
from training.runs import Run, provenance
from training.runs.statistics import iqm_interval, mean_interval, ratio_interval, spread, wilson
from training.runs.workers import progress

PAPER = "zero"
BASELINES = {
    PAPER: "the paper's start (zero policy)",
    "learned": "learned start, shipped",
    "previous": "previous solution",
}
LABELS = {
    "ppo/initial_force": "PPO, adjusts the start",
    "sac/initial_force": "SAC, adjusts the start",
    "ppo/contact_force": "PPO, contact forces, no solver",
    "sac/contact_force": "SAC, contact forces, no solver",
}


def evaluate_runs(
    folders: list[Path], out: Path, episodes: int, quick: bool = False, console: Console | None = None
) -> dict[str, Any]:
    """Scores the agents of all seeds of some runs, writes rl.json, rl.md and learning_curve.png into `out`.

    Args:
        folders: of runs of `grasp rl`.
        out: receives the report; may be one of them.
        episodes: held-out, the same for all.
        quick: said in the report.
        console: for the progress; None: stderr.

    Returns:
        What rl.json holds.
    """
    console = console or Console(stderr=True)
    agents: dict[str, list[TrainedAgent]] = {}
    for folder in folders:
        for seed in sorted(folder.glob("seed-*"), key=lambda path: path.name):
            agent = TrainedAgent.load(seed)
            agents.setdefault(f"{agent.meta['algorithm']}/{agent.meta['action']}", []).append(agent)
    if not agents:
        raise InvalidInputError(f"no trained agent in {', '.join(map(str, folders))}: name folders of `grasp rl`")
    base, seeds = RLConfig().env_settings, range(HELD_OUT_SEED, HELD_OUT_SEED + episodes)
    zero = ZeroPolicy(ACTION_SIZES["initial_force"])
    jobs: list[tuple[str, Any, dict[str, Any], Any]] = [
        (PAPER, zero, base, None),
        ("learned", zero, base, LearnedInitialForce.pretrained()),
        ("previous", zero, {**base, "initial_force": "previous"}, None),
    ]
    for key, several in agents.items():
        jobs += [(key, agent, agent.meta["env_settings"], None) for agent in several]
    trials: dict[str, list[dict[str, np.ndarray]]] = {}
    with progress(console) as bar:
        for key, policy, settings, rule in bar.track(jobs, description="held-out episodes"):
            trials.setdefault(key, []).append(score(policy, settings, seeds, rule))
    curve = score(zero, base, range(CURVE_SEED, CURVE_SEED + RLConfig(**_config(agents)).curve_episodes))
    report = {
        **provenance(),
        "quick": quick,
        "episodes": episodes,
        "held_out_seeds": [seeds[0], seeds[-1]],
        "env_settings": base,
        "rows": {
            key: {"label": {**BASELINES, **LABELS}[key], **_row(several, trials[PAPER][0])}
            for key, several in trials.items()
        },
        "training": {key: [_training(agent) for agent in several] for key, several in agents.items()},
        "curve_of_zero": {
            "iterations": float(curve["iterations"].mean()),
            "length": float(curve["steps"].mean()),
            "return": float(curve["return"].mean()),
        },
    }
    run = Run(out)
    arrays = {
        f"{key}/{place}/{name}": values
        for key, several in trials.items()
        for place, one in enumerate(several)
        for name, values in one.items()
    }
    run.write_arrays("rl_trials.npz", arrays)
    write_report(run, report)
    console.print(f"report: {out / 'rl.md'}")
    return report


def _config(agents: dict[str, list[TrainedAgent]]) -> dict[str, Any]:
    """Of the first agent: its curve was scored on as many episodes."""
    saved = next(iter(agents.values()))[0].meta["config"]
    return {"curve_episodes": int(saved["curve_episodes"])}


def _row(several: list[dict[str, np.ndarray]], paper: dict[str, np.ndarray]) -> dict[str, Any]:
    """One line of the table, from the trials of every seed.

    Args:
        several: one per training seed; baselines have one.
        paper: of the zero policy, the same episodes.
    """
    held = np.concatenate([one["held"] for one in several])
    low, high = wilson(int(held.sum()), len(held))
    iterations = np.concatenate([one["iterations"] for one in several]).astype(float)
    mine = np.mean([one["mean_iterations"] for one in several], axis=0)
    return {
        "seeds": len(several),
        "held": int(held.sum()),
        "episodes": len(held),
        "held_rate": float(held.mean()),
        "held_low": low,
        "held_high": high,
        "iterations": spread(iterations),
        "iterations_per_seed": [float(np.median(one["iterations"])) for one in several],
        "iterations_against_paper": dict(
            zip(("ratio", "low", "high"), ratio_interval(mine, paper["mean_iterations"]), strict=True)
        ),
        "squeeze": mean_interval(np.concatenate([one["squeeze"] for one in several])),
        "drift_mm": mean_interval(1e3 * np.concatenate([one["drift"] for one in several])),
        "steps": mean_interval(np.concatenate([one["steps"] for one in several])),
        "return": iqm_interval(np.array([one["return"] for one in several])),
    }


def _training(agent: TrainedAgent) -> dict[str, Any]:
    meta = agent.meta
    return {
        "seed": meta["seed"],
        "steps": meta["steps"],
        "seconds": meta["seconds"],
        "cpu_seconds": meta["cpu_seconds"],
        "machine": meta["provenance"]["machine"],
        "config": meta["config"],
        "curve": meta["curve"],
    }

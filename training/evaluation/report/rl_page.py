"""Page of `grasp rl`, as data."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from training.evaluation.report.page import axes, legend_above
from training.evaluation.results.claims import Claim
from training.evaluation.results.statistics import iqm, iqm_interval, ratio_interval
from training.evaluation.results.table import pd, summary
from training.evaluation.results.words import number

AGENTS = {
    "zero": ("zero actions, the solver alone", "#000000"),
    "learned": ("learned start, shipped", "#8fc98f"),
    "previous": ("previous solution", "#8a8a8a"),
    "ppo/initial_force": ("PPO, adjusts the start", "#b3261e"),
    "sac/initial_force": ("SAC, adjusts the start", "#1f5fa8"),
    "ppo/residual": ("PPO, changes the forces", "#d2691e"),
    "sac/residual": ("SAC, changes the forces", "#2a8c82"),
    "ppo/grip": ("PPO, sets the grip", "#a3246e"),
    "sac/grip": ("SAC, sets the grip", "#3d6b21"),
    "ppo/contact_force": ("PPO, contact forces, no solver", "#c08a3e"),
    "sac/contact_force": ("SAC, contact forces, no solver", "#7a4fa3"),
}
"""Label and colour of every policy, in the order of the tables."""
FIXED: dict[str, dict[str, Any]] = {
    r"margin [\d.]+": {"fmt": "o-", "color": "#5a6472", "label": "fixed margins"},
    r"margin [\d.]+, no preload": {
        "fmt": "^--",
        "color": "#9aa3ad",
        "label": "fixed margins, no preload",
    },
    r"squeeze .*": {"fmt": "s:", "color": "#b08d57", "label": "constant squeezes"},
}
"""Look of the fixed grips, by patterns of their names."""
SPEEDS = ("environment alone", "with inference", "with training")
"""Cases measured in steps per second."""
TITLE = "Agents beside the paper's start"
INTRO = (
    "This page compares agents with policies that learn nothing in the environment: the zero policy (the solver alone, from the paper's "
    "start), the shipped learned start and the previous solution, or fixed grips where an agent sets the grip. All of them play the same "
    "held-out episodes, with deterministic actions. The columns are defined at the end of this page."
)
_PAPER = "case == 'held_out' and agent == 'zero'"


def claims(agents: Iterable[str]) -> list[Claim]:
    """Return the claims about agents of these names, to be saved with their run."""
    out = []
    for name in dict.fromkeys(agents):
        label, query = AGENTS[name][0], f"case == 'held_out' and agent == '{name}'"
        if name.endswith("/initial_force"):
            few = f"{label}: fewer iterations than the paper's start"
            out.append(Claim.of(few, query, "mean_iterations_median < 1", _PAPER))
        as_many = f"{label}: holds no less than the paper's start"
        out.append(Claim.of(as_many, query, "held_mean >= 0", _PAPER, difference=True))
    return out


def _environments(rows: pd.DataFrame) -> list[str]:
    return rows["environment"].dropna().unique().tolist()


def _by_agent(rows: pd.DataFrame, case: str, environment: str) -> dict[str, Any]:
    """Return the rows of every agent in one environment, in the order of `AGENTS`."""
    here: Any = rows[(rows["case"] == case) & (rows["environment"] == environment)]
    found = here["agent"].dropna().unique().tolist()
    order = [*(agent for agent in AGENTS if agent in found), *(a for a in found if a not in AGENTS)]
    return {agent: here[here["agent"] == agent] for agent in order}


def label_of(agent: str) -> str:
    """Return an agent's or a baseline's name in words."""
    return AGENTS.get(agent, (agent,))[0]


def place(environment: str) -> str:
    """Return an environment's settings in a few words; the default is a cuboid.

    Example:
        >>> place("UncertainGrasp")
        'UncertainGrasp'
        >>> place('{"shape": "sphere", "hand": {"name": "allegro"}}'), place('{"hand": "leap"}'), place("{}")
        ('sphere, allegro', 'cuboid, leap', 'cuboid')
        >>> place('{"reward": {"force": 0.6}}')
        'cuboid, squeeze costs 0.6'
    """
    if not environment.startswith("{"):
        return environment
    settings = json.loads(environment)
    shape = settings.get("shape") or settings.get("object", {}).get("shape", "cuboid")
    hand = settings.get("hand", "")
    cost = settings.get("reward", {}).get("force")
    words = (str(shape), hand["name"] if isinstance(hand, dict) else hand)
    return ", ".join(filter(None, (*words, cost and f"squeeze costs {cost:g}")))


def squeeze_saved(scores: pd.DataFrame, agent: str) -> float:
    """Return the share of the squeeze that an agent saves against what learns nothing.

    That is the lightest fixed margin, with or without preload, that holds as many episodes, between
    two of them by interpolation; or the zero policy if no fixed margins were played. NaN: no fixed
    margin holds as many or as few, or the zero policy holds more.

    Args:
        scores: summary of the held-out episodes of one environment, its index the agents.
        agent: name of the agent.

    Example:
        >>> force, held = {"commanded_force_mean": [20.0, 10.0, 12.0]}, [1.0, 0.8, 0.9]
        >>> names = ["margin 0.5", "margin 0.7", "ppo/grip"]
        >>> round(squeeze_saved(pd.DataFrame({**force, "held_mean": held}, names), "ppo/grip"), 3)
        0.2
    """
    mine: Any = scores.loc[agent]
    fixed: Any = scores[[str(name).startswith("margin") for name in scores.index]]
    if fixed.empty:
        zero: Any = scores.loc["zero"]
        beside = zero["commanded_force_mean"] if mine["held_mean"] >= zero["held_mean"] else np.nan
    else:
        fixed = fixed.sort_values("commanded_force_mean")
        # the lightest grip that holds as often
        best, first = np.unique(
            np.maximum.accumulate(fixed["held_mean"].to_numpy(float)), return_index=True
        )
        force = fixed["commanded_force_mean"].to_numpy(float)[first]
        beside = np.interp(mine["held_mean"], best, force, np.nan, np.nan)
    return float(1.0 - mine["commanded_force_mean"] / beside)


def _interval(value: float, low: float, high: float) -> str:
    return f"{number(value)} [{number(low)}, {number(high)}]"


def scores_table(rows: pd.DataFrame, summary: pd.DataFrame) -> pd.DataFrame:
    """Make a table of the scores of every policy on the held-out episodes."""
    out = []
    for environment in _environments(rows):
        steps = _by_agent(rows, "held_out", environment)
        last = {agent: mine[mine["held"].notna()] for agent, mine in steps.items()}
        iterations = {
            agent: ends.groupby("seed")["mean_iterations"].mean() for agent, ends in last.items()
        }
        scores: Any = pd.concat([*_by_agent(summary, "held_out", environment).values()])
        scores = scores.set_index("agent")
        for agent, ends in last.items():
            row: Any = scores.loc[agent]
            cells = {
                "environment": place(environment),
                "policy": label_of(agent),
                "training seeds": ends["training_seed"].nunique() or None,
            }
            rates = (f"{number(100.0 * row[f'held_rate_{end}'])} %" for end in ("low", "high"))
            cells["held"] = f"{row['held_sum']:.0f} of {len(ends)} [{', '.join(rates)}]"
            if iterations[agent].notna().all() and "zero" in iterations:  # a solver runs
                counts = (number(row[f"iterations_{name}"]) for name in ("median", "p95", "p99"))
                pairs = (iterations[name].to_numpy(float) for name in (agent, "zero"))
                cells |= {
                    "iterations per step": " / ".join(counts),
                    "of the paper's": _interval(*ratio_interval(*pairs)),
                }
            force = (row[f"commanded_force_{name}"] for name in ("mean", "mean_low", "mean_high"))
            cells |= {
                "squeeze [N]": _interval(*force),
                "squeeze saved [%]": 100.0 * squeeze_saved(scores, agent)
                if "/" in agent
                else np.nan,
                "torque, share of the limit": row["torque_share_mean"],
                "largest drift [mm]": row.get("drift_mean"),
            }
            # training seeds and episodes are drawn anew, so that an agent's interval is over both
            ends = ends.fillna({"training_seed": -1})
            returns = ends.pivot_table("return", "training_seed", "seed").to_numpy(float)
            out.append(cells | {"return": _interval(iqm(returns), *iqm_interval(returns))})
    return pd.DataFrame(out)


def scores_text(rows: pd.DataFrame) -> str:
    """Return the scores of every policy as text, for a terminal."""
    scores = scores_table(rows, summary(rows))
    shown = ["environment", "policy", "held", "squeeze [N]", "squeeze saved [%]", "return"]
    return str(scores[shown].to_string(index=False, na_rep="", float_format=number))  # type: ignore[arg-type]


def training_table(rows: pd.DataFrame, summary: pd.DataFrame) -> pd.DataFrame:
    """Make a table of every training: steps, time, first and last scores."""
    out = []
    for environment in _environments(rows):
        curves = _by_agent(rows, "curve", environment)
        for agent, trained in _by_agent(rows, "training", environment).items():
            for _, row in trained.iterrows():
                curve: Any = curves[agent][curves[agent]["training_seed"] == row["training_seed"]]
                speed = row["training_steps"] / max(row["cpu_seconds"], 1e-9)
                cells = {
                    "environment": place(environment),
                    "agent": label_of(agent),
                    "seed": row["training_seed"],
                    "environment steps": row["training_steps"],
                    "seconds": row["seconds"],
                    "of processor": row["cpu_seconds"],
                    "steps per processor second": round(speed),
                }
                for name, label in (("mean_iterations", "iterations"), ("return", "return")):
                    means = curve.groupby("training_steps")[name].mean().dropna().tolist()
                    ends = f"{number(means[0])} → {number(means[-1])}" if means else None
                    cells[f"{label}, first → last"] = ends
                out.append(cells)
    return pd.DataFrame(out)


def speed_table(rows: pd.DataFrame, summary: pd.DataFrame) -> pd.DataFrame:
    """Make a table of steps per second: environments alone, with an acting and a training agent."""
    out = []
    for environment in _environments(rows):
        for agent, (label, _) in AGENTS.items():
            rates = {
                case: round(means[agent]["per_second_median"].iloc[0])
                for case in SPEEDS
                if agent in (means := _by_agent(summary, case, environment))
            }
            if rates:
                out.append({"environment": place(environment), "agent": label, **rates})
    return pd.DataFrame(out)


def _curves(rows: pd.DataFrame, column: str, label: str, ending: str) -> Figure | None:
    """Draw a mean against environment steps: seeds thin, their mean thick, zero policy dashed."""
    rows = rows.assign(length=rows["step"] + 1)
    curves_of = {name: _by_agent(rows, "curve", name) for name in _environments(rows)}
    shown = {
        name: curves
        for name, curves in curves_of.items()
        if any(agent != "zero" and agent.endswith(ending) for agent in curves)
    }
    if not shown:
        return None
    figure, panels = axes(0.9 + 2.1 * len(shown), rows=len(shown))
    for panel, (environment, curves) in zip(np.atleast_1d(panels), shown.items(), strict=True):
        for agent, scores in curves.items():
            if agent == "zero" or not agent.endswith(ending):
                continue
            name, colour = AGENTS[agent]
            lines = [
                seed.groupby("training_steps")[column].mean()
                for _, seed in scores.groupby("training_seed")
            ]
            for line in lines:
                panel.plot(line, color=colour, linewidth=0.7, alpha=0.55)
            steps = np.linspace(0.0, min(line.index[-1] for line in lines), 60)
            means = [
                np.interp(steps, line.index.to_numpy(float), line.to_numpy(float)) for line in lines
            ]
            panel.plot(steps, np.mean(means, axis=0), color=colour, linewidth=2.2, label=name)
        panel.axhline(
            curves["zero"][column].mean(), color="black", linestyle="--", label=AGENTS["zero"][0]
        )
        panel.set(ylabel=label, xlim=(0, None))
        panel.set_title(place(environment), loc="left", fontsize=9)
        panel.locator_params(axis="x", nbins=5)
    figure.axes[-1].set(xlabel="environment steps")
    legend_above(figure)
    return figure


def front_figure(rows: pd.DataFrame, summary: pd.DataFrame) -> Figure | None:
    """Draw the share of episodes held against the squeeze, where fixed grips were played."""
    scores_of = {name: _by_agent(summary, "held_out", name) for name in _environments(rows)}
    played = {
        name: scores
        for name, scores in scores_of.items()
        if any(agent.startswith("margin") for agent in scores)
    }
    if not played:
        return None
    figure, panels = axes(0.9 + 2.6 * len(played), rows=len(played))
    for panel, (environment, scores) in zip(np.atleast_1d(panels), played.items(), strict=True):
        for kind, look in FIXED.items():
            found = [row for agent, row in scores.items() if re.fullmatch(kind, agent)]
            if not found:
                continue
            fixed = pd.concat(found)
            _plot_rates(panel, fixed.sort_values("commanded_force_mean"), **look)
        for agent, row in scores.items():
            if "/" in agent:
                label, colour = AGENTS[agent]
                _plot_rates(panel, row, fmt="D", color=colour, label=label)
        panel.set(ylabel="held [%]", ylim=(-4, 104), xscale="log")
        low, high = panel.get_xlim()
        forces = [force for force in (2, 5, 10, 20, 40, 80, 160) if low < force < high]
        panel.set_xticks(forces, [str(force) for force in forces])
        panel.minorticks_off()
        panel.set_title(place(environment), loc="left", fontsize=9)
    figure.axes[-1].set(xlabel="mean sum of normal forces [N]")
    legend_above(figure)
    return figure


def _plot_rates(panel: Any, rows: pd.DataFrame, fmt: str, **look: Any) -> None:
    rate, low, high = (
        100.0 * rows[name].to_numpy(float)
        for name in ("held_mean", "held_rate_low", "held_rate_high")
    )
    around = np.maximum([rate - low, high - rate], 0.0)
    force = rows["commanded_force_mean"]
    panel.errorbar(force, rate, around, fmt=fmt, markersize=4, elinewidth=0.9, **look)


_CURVES = "Thin: training seeds. Thick: their mean. Dashed: the zero policy, on the same episodes. All actions are deterministic."
FIGURES = (
    (
        "Held against squeeze",
        "On the held-out episodes, with 95 % intervals (Wilson). A grip farther up and to the left is better.",
        front_figure,
    ),
    (
        "Iterations along the training",
        _CURVES,
        lambda rows, summary: _curves(
            rows, "mean_iterations", "iterations per step, mean", "/initial_force"
        ),
    ),
    (
        "Time held along the training",
        f"Agents without solver. {_CURVES}",
        lambda rows, summary: _curves(
            rows, "length", "steps until the object is lost", "/contact_force"
        ),
    ),
    (
        "Return along the training",
        _CURVES,
        lambda rows, summary: _curves(rows, "return", "return of an episode", ""),
    ),
)
TABLES = (
    (
        "Scores on the held-out episodes",
        "Iterations: median / p95 / p99. Of the paper's: ratio of the medians per episode. Return: "
        "interquartile mean. Squeeze saved: against the lightest fixed margin, with or without preload, that holds as many episodes (between two of them by "
        "interpolation), or against the zero policy where no fixed margins were played. Intervals are 95 %: Wilson for the rate, bootstrap for the rest. Agents see the wrench of the control tick "
        "before; the solver, with the learned start and the previous solution, sees the current one. Agents without solver make no "
        "iterations. The paper's start replaces the shipped learned start on contacts that it does not know.",
        scores_table,
    ),
    (
        "Training, every seed",
        "Seconds are those of training alone, without the scores along the curve, on one thread. If wall and "
        "processor time differ, other programs shared the cores.",
        training_table,
    ),
    (
        "Steps per second",
        "All environments of a training together, on an otherwise idle core: median of three rounds.",
        speed_table,
    ),
)

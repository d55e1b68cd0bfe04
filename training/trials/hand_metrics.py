"""Engines side by side and hands side by side, from saved trials: pure functions, nothing is simulated here."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import comb
from typing import Any

import numpy as np

from training.runs.claims import Claim, claim
from training.runs.statistics import mean_interval
from training.trials.arrays import Trials
from training.trials.hand_plan import ENGINE_LABELS, short_name
from training.trials.hold_findings import hands_found, transfer_found
from training.trials.hold_metrics import Episodes, cell_metrics, failures, paired, rate_text
from training.trials.hold_plan import NOT_STARTED

POINTS = 5.0
"""[%] by which hold rates of the two engines may differ."""
CHANCE = 0.05
"""Least probability of what is called no difference."""
REASONS = {
    "torque limits": "torque",
    "links push each other": "links touch each other",
    "ends of their ranges": "ends of joint ranges",
    "links push the object": "links touch the object",
    "do not touch": "a finger does not touch",
    "miss the weight": "not still in time",
    "palm pose": "no place for the palm",
    "no grasp": "no grasp",
    "push it about": "fingers do not come to rest",
    "cannot reach": "out of reach",
    "reaches tip": "out of reach",
}
"""Words in the message of a hand that did not take hold, and what they mean."""
OWN: dict[str, Callable[[Episodes], Any]] = {
    "force_error": lambda cell: mean_interval(cell.of("force_error", cell.started)),
    "torque_margin": lambda cell: mean_interval(_finite(cell.of("torque_margin", cell.started))),
    "least_margin": lambda cell: _least(cell.of("torque_margin", cell.started)),
    "limited": lambda cell: mean_interval(cell.of("limited", cell.started)),
    "saturated": lambda cell: int((cell.of("saturated", cell.started) > 0.0).sum()),
    "reasons": lambda cell: _reasons(cell.trials),
}
"""Besides `hold_metrics.CELL_METRICS`: contact forces [N], distance of torques from their limits [N m], what did not start."""


def hand_metrics(scenarios: list[dict[str, Any]], trials: dict[str, Trials]) -> dict[str, Any]:
    """All numbers of a report, a row for every scenario and engine.

    Args:
        scenarios: as they were planned.
        trials: by the scenario's name, of all its engines.
    """
    rows, lost = [], []
    for scenario in scenarios:
        played = {engine: _of(trials[scenario["name"]], engine) for engine in scenario["engines"]}
        base = scenario["engines"][0]
        for engine, mine in played.items():
            named = {"scenario": scenario["name"], "hand": short_name(scenario["hand"]), "label": scenario["label"]}
            own = {name: metric(Episodes(mine)) for name, metric in OWN.items()}
            against = None if engine == base else {"base": base, **paired(mine, played[base])}
            if against is not None:
                against["chance"] = chance(against["only_this"], against["only_base"])
            rows.append({**named, "engine": engine, **cell_metrics(mine), **own, "against": against})
            lost += [{**row, "engine": engine} for row in failures(scenario["name"], mine)]
    return {"rows": rows, "failures": lost, "found": hands_found(rows)}


def transfer_metrics(scenarios: list[dict[str, Any]], trials: dict[str, Trials]) -> dict[str, Any]:
    """`hand_metrics` with the claims about engines and what is found of them."""
    metrics = hand_metrics(scenarios, trials)
    rows = metrics["rows"]
    own = {"found": transfer_found(rows), "findings": list(findings(rows)), "claims": list(_transfer_claims(rows))}
    return {**metrics, **own}


def chance(one: int, other: int) -> float:
    """Probability that pairs which differ fall at least as unevenly as `one` to `other` where both are as likely (McNemar, exact).

    Example:
        >>> chance(0, 0), chance(0, 5), round(chance(2, 13), 4)
        (1.0, 0.0625, 0.0074)
    """
    total, few = one + other, min(one, other)
    return min(1.0, 2.0 * sum(comb(total, k) for k in range(few + 1)) / 2.0**total)


def findings(rows: list[dict[str, Any]]) -> Iterator[str]:
    """What is held in one engine and falls in another, beyond chance, and how far what is held drifts; what does not differ."""
    by_engine = {(row["scenario"], row["engine"]): row for row in rows}
    same: list[str] = []
    for row in rows:
        against = row["against"]
        if against is None:
            continue
        base = by_engine[row["scenario"], against["base"]]
        where, mine, theirs = (
            f"{row['hand']}, {row['label']}",
            ENGINE_LABELS[row["engine"]],
            ENGINE_LABELS[base["engine"]],
        )
        if against["chance"] < CHANCE:
            worse = row if row["rate"] < base["rate"] else base
            yield (
                f"{where}: {mine} holds {row['held']} of {row['episodes']}, {theirs} {base['held']}. {against['only_this']} pairs are held "
                f"by the former alone, {against['only_base']} by the latter alone (chance {against['chance']:.1g}). What falls: "
                f"{_told(worse['failures'])}."
            )
        else:
            same.append(f"{where}, {mine} {row['held']} to {base['held']}")
        if _apart(row["max_drift_mm"], base["max_drift_mm"]):
            ours, other = (f"{side['max_drift_mm']['mean']:.2g} mm" for side in (row, base))
            yield f"{where}: what is held drifts by {ours} in {mine}, by {other} in {theirs} (means of the largest)."
    if same:
        yield f"No difference beyond chance ({100 * CHANCE:g} %) in {len(same)} comparisons (held, of as many): {'; '.join(same)}."


def _apart(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether two means have intervals that do not overlap."""
    if one["mean"] is None or other["mean"] is None:
        return False
    return one["low"] > other["high"] or other["low"] > one["high"]


def _transfer_claims(rows: list[dict[str, Any]]) -> Iterator[Claim]:
    for row in rows:
        against = row["against"]
        if row["engine"] == "mujoco" and row["scenario"].endswith(("/objects", "/estimated")):
            difference = against["held"]
            measured = (
                f"{rate_text(row)} in MuJoCo; {100 * difference['mean']:+.1f} [{100 * difference['low']:+.1f}, "
                f"{100 * difference['high']:+.1f}] points against {ENGINE_LABELS[against['base']]}"
            )
            text = f"{row['hand']}, {row['label']}: MuJoCo holds what {ENGINE_LABELS[against['base']]} holds"
            yield claim(text, f"rates within {POINTS:g} points", measured, abs(100 * difference["mean"]) <= POINTS)


def _of(trials: Trials, engine: str) -> Trials:
    return {name: values[trials["engine"] == engine] for name, values in trials.items()}


def _finite(values: np.ndarray) -> np.ndarray:
    return values[np.isfinite(values)]


def _least(values: np.ndarray) -> float | None:
    finite = _finite(values)
    return float(finite.min()) if finite.size else None


def _reasons(trials: Trials) -> dict[str, int]:
    """Why hands did not take hold; several may be true of one."""
    counts: dict[str, int] = {}
    for detail in trials["detail"][np.isin(trials["failure"], NOT_STARTED)].tolist():
        found = {meaning for words, meaning in REASONS.items() if words in detail} or {"something else"}
        for meaning in found:
            counts[meaning] = counts.get(meaning, 0) + 1
    return dict(sorted(counts.items(), key=lambda pair: (-pair[1], pair[0])))


def _told(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} {cause.replace('_', ' ')}" for cause, count in counts.items()) or "nothing"

"""What a comparison found, in three sentences and one more of the starts it was given, from the run's own numbers: nothing is said that they do not say."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from training.cases.set_table import TOLERANCE
from training.cases.start_table import LEARNED, given_in, row_of
from training.runs.words import number, small
from training.trials.arrays import LIMIT
from training.trials.claims import is_cold
from training.trials.ranks import BASIS, FLOW, NETWORK, applies, lacking, numbers

NEWTON = "newton"
CONTROLS = {NETWORK: (BASIS, 0), "network_newton_2": ("basis_newton_2", 2)}
"""Of a start: the 12-basis after as many plain Newton steps as it may take inside, and how many those are."""
SAME = 0.03
"""Part by which two medians of microseconds may differ and still be called the same."""
CLEAR = 1.5
"""Iterations by which one start differs clearly from another; a smaller difference is told with its size."""
CONTROLLED = ("ball", "random_4")
Metrics = dict[str, Any]


def findings(metrics: Metrics) -> list[str]:
    """Who needs the fewest iterations, who the least time, what of it is learned; what was not measured is left out."""
    return [said for part in (_iterations, _time, _learned, _given) if (said := part(metrics))]


def _iterations(metrics: Metrics) -> str:
    rows = metrics["starts"].get(FLOW, {}).get("ball", {})
    found = {key: numbers(rows, key) for key in rows if is_cold(metrics, key) and applies(rows, key)}
    if not found:
        return ""
    first, least = _least(found)
    basis = f"; 12-basis {_pair(found[BASIS])}" if BASIS in found and BASIS not in first else ""
    text = (
        f"Fewest iterations: on {rows[first[0]]['cases']} held-out wrenches of one grasp, without a previous solution, the flow reaches a gap "
        f"of {small(TOLERANCE)} soonest from {_names(first)} (median / p99 {_pair(least)}{basis})"
    )
    stepped = [key for key in first if row_of(key).second_order]
    plain = {key: row for key, row in found.items() if not row_of(key).second_order and key not in given_in(found)}
    if not stepped or not plain:
        return f"{text}."
    best, fewest = _least(plain)
    who = "which" if stepped == first else f"of which {_names(stepped)}"
    verb = "takes" if len(stepped) == 1 else "take"
    return f"{text}, {who} {verb} Newton steps before the count begins; without any, from {_names(best)} ({_pair(fewest)})."


def _time(metrics: Metrics) -> str:
    total = (metrics.get("timing") or {}).get("total", {})
    found = {
        (method, key): row["best"] for method in total for key, row in total[method].items()
        if is_cold(metrics, key) and row["best"]["n"]
    }  # fmt: skip
    if not found:
        return ""
    first = min(found, key=lambda who: (found[who]["median"], found[who]["p99"]))
    text = f"Least time: {_who(first)}, p50 / p99 {_us(found[first])} for the whole certified call from Python, without a previous solution"
    plain = found.get((NEWTON, BASIS))
    models = {*LEARNED, *metrics["run"]["models"]}
    learned = {who: row["median"] for who, row in found.items() if who[1] in models}
    if plain is None or not learned:
        return f"{text}."
    slower = {who: median for who, median in learned.items() if median > (1.0 + SAME) * plain["median"]}
    faster = {who: median for who, median in learned.items() if median < (1.0 - SAME) * plain["median"]}
    rest = [f"{_who(who)} ({number(median)})" for who, median in learned.items() if who not in slower]
    basis = f"plain Newton from the 12-basis, with nothing learned, takes {_us(plain)}"
    if not rest:
        return f"{text}; {basis} and beats every learned start in time, whichever the method ({_range(slower)})."
    if not slower and len(faster) == len(learned):
        return f"{text}; {basis} and is beaten by every learned start, whichever the method ({_range(faster)})."
    over = (
        f"beats every learned start ({_range(slower)}) but {_and(rest)}"
        if slower
        else f"beats no learned start: {_and(rest)}"
    )
    return f"{text}; {basis} and {over}."


def _learned(metrics: Metrics) -> str:
    parts = []
    for key, (control, steps) in CONTROLS.items():
        for name in CONTROLLED if steps else CONTROLLED[:1]:
            rows = metrics["starts"].get(FLOW, {}).get(name, {})
            if not (applies(rows, key) and applies(rows, control)):
                continue
            ours, theirs = numbers(rows, key), numbers(rows, control)
            who = _names([key]) if name == "ball" else f"on {metrics['sets'][name]['label'].partition(',')[0]}"
            after = f" ({steps} steps)" if steps and name == "ball" else ""
            parts.append(f"{who} {_pair(ours)}, control{after} {_pair(theirs)}, {_gain(ours, theirs)}")
    if not parts:
        return ""
    return (
        "What is learned: against a control, the 12-basis after as many plain Newton steps, the iterations that are left are "
        f"{'; '.join(parts)}."
    )


def _gain(ours: dict[str, Any], theirs: dict[str, Any]) -> str:
    """Where one needs fewer iterations than the other; a difference below `CLEAR` has its size."""
    said: dict[str, list[str]] = {}
    for part, where in (("median", "median"), ("p99", "tail")):
        fewer = round(theirs[part] - ours[part], 1)
        if fewer:
            size = "" if abs(fewer) >= CLEAR else f" of {number(abs(fewer))}"
            said.setdefault(f"a {'gain' if fewer > 0 else 'loss'}{size}", []).append(f"in the {where}")
    told = [f"{what} {' and '.join(places)}" for what, places in said.items()]
    return " and ".join(told) + " alone" * (sum(map(len, said.values())) == 1) or "no gain"


def _given(metrics: Metrics) -> str:
    """Each start that the run was given, beside the paper's; where it gave none is counted."""
    rows = metrics["starts"].get(FLOW, {}).get("ball", {})
    total = (metrics.get("timing") or {}).get("total", {}).get(FLOW, {})
    told = []
    for key in given_in(rows):
        row, best = rows[key], total.get(key, {}).get("best", {"n": 0})
        if not row["cases"]:
            continue
        parts = [f"{_pair(row['iterations'])} iterations"] if row["iterations"]["n"] else []
        parts += [_us(best)] if parts and best["n"] else []
        gave = f"gave {lacking(row)} wrenches" if row["no_start"] else ""
        told.append(f"{_names([key])} {_and([text for text in (' and '.join(parts), gave) if text])}")
    if not told:
        return ""
    basis = ""
    if applies(rows, BASIS):
        best = total.get(BASIS, {}).get("best", {"n": 0})
        basis = f"; the 12-basis {_pair(numbers(rows, BASIS))} iterations{f' and {_us(best)}' if best['n'] else ''}"
    return f"Given starts: with the flow, median / p99, {'; '.join(told)}{basis}."


def _least(found: dict[str, dict[str, Any]]) -> tuple[list[str], dict[str, Any]]:
    """The starts of the fewest iterations, and these."""
    least = min((row["median"], row["p99"]) for row in found.values())
    first = [key for key, row in found.items() if (row["median"], row["p99"]) == least]
    return first, found[first[0]]


def _pair(row: dict[str, Any]) -> str:
    median, p99 = (
        f">\xa0{LIMIT}" if row[part] > LIMIT else number(round(row[part], 1 if row[part] < 10 else 0))
        for part in ("median", "p99")
    )
    if row.get("no_start") and row["p99"] > LIMIT:
        return lacking(row) if row["median"] > LIMIT else f"{median}, {lacking(row)}"
    return f"{median}\xa0/\xa0{p99}"


def _us(row: dict[str, Any]) -> str:
    return f"{number(row['median'])}\xa0/\xa0{number(row['p99'])}\xa0µs"


def _range(medians: dict[tuple[str, str], float]) -> str:
    low, high = (number(kind(medians.values())) for kind in (min, max))
    return f"p50 {low} µs" if low == high else f"p50 {low} to {high} µs"


def _who(who: tuple[str, str]) -> str:
    return f"{'Newton' if who[0] == NEWTON else 'the flow'} from {_names(who[1:])}"


def _names(keys: Sequence[str]) -> str:
    return _and([f"“{row_of(key).short}”" for key in keys])


def _and(parts: Sequence[str]) -> str:
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"

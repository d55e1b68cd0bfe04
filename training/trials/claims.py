"""What this project set out to show: each claim with the number asked for, the number measured and the verdict."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from training.cases.set_table import SETS, TOLERANCE
from training.cases.start_table import FITTED, LEARNED, SHIPPED, given_in, row_of
from training.runs.claims import Claim, claim
from training.runs.words import small
from training.trials.arrays import HOLD_SCENARIOS, LIMIT
from training.trials.ranks import BASIS, FLOW, NETWORK, PREVIOUS, applies, lacking

DRIFT_LIMIT = 1.0
"""[mm] the hold criterion."""
METHOD_NAMES = {"reduced_flow": "the flow", "newton": "Newton"}
ALONE: dict[str, float] = {"median": 8, "p99": 60}
"""Iterations of the flow that a network alone may leave."""
FASTER = {"median": 0.85, "p99": 0.95}
"""Time of a certified solve from the network, in parts of Newton's from the 12-basis, whole public call."""
MODEL_BYTES, TRAINING_SECONDS = 2_000_000, 900.0
SMOOTH_LIMITS: dict[str, float] = {"median": 0, "p99": 7}
"""Of the model with the previous solution, on smooth paths."""
BALANCE = 1e-9
"""Largest imbalance of a start, in parts of its largest force."""
Metrics = dict[str, Any]


def claims(metrics: Metrics) -> list[Claim]:
    """All claims."""
    parts = (
        _fixed,
        _smooth,
        _time,
        _fastest,
        _against_newton,
        _models,
        _guarantees,
        _given,
        _holds,
        _references,
    )
    return [row for part in parts for row in part(metrics)]


def _row(metrics: Metrics, name: str, key: str | None) -> dict[str, Any] | None:
    rows = metrics["starts"][FLOW].get(name, {})
    return rows[key] if key is not None and applies(rows, key) else None


def _said(row: dict[str, Any], *names: str) -> str:
    """Iterations in words, with what did not work."""
    steps = row["iterations"]
    text = ", ".join(f"{name} {_count(steps[name])}" for name in names)
    missing = f"; {row['no_start']} of {row['cases']} have no start" if row["no_start"] else ""
    return text + missing


def _count(value: float | None) -> str:
    if value is None:
        return "–"
    return f"> {LIMIT}" if value > LIMIT else f"{value:.3g}"


def _judged(
    text: str,
    row: dict[str, Any] | None,
    limits: dict[str, float],
    *,
    more: str = "",
    said: str = "",
    also: bool = True,
) -> Claim:
    """The claim that iterations stay within limits, and that every case has a start.

    Args:
        text: what is claimed.
        row: of the start; None: not measured.
        limits: largest iterations by percentile.
        more: what else is asked, in words.
        said: what else was measured.
        also: whether that is enough.
    """
    asked = ", ".join(f"{name} <= {limit:g}" if limit else f"{name} 0" for name, limit in limits.items())
    if row is None:
        return claim(text, asked + more, None, None)
    within = all(row["iterations"]["n"] and row["iterations"][name] <= limit for name, limit in limits.items())
    return claim(text, asked + more, _said(row, *limits) + said, row["no_start"] == 0 and within and also)


def _below(ours: float, theirs: float) -> bool:
    return ours < theirs or ours == theirs == 0


def _fixed(metrics: Metrics) -> Iterator[Claim]:
    """What the network of the fixed grasp is worth before any Newton step: what the project was made for."""
    for key in (NETWORK, FITTED):
        row, paper = _row(metrics, "ball", key), _row(metrics, "ball", BASIS)
        if row is not None or key == NETWORK:
            text = f"{row_of(key).label}: iterations of the flow to {TOLERANCE:g}, held-out ball"
            said, inside = "", row is not None and row["margin_min"] > 0
            if row is not None:
                basis = f"; 12-basis: {_said(paper, 'median', 'p99')}" if paper else ""
                said = f"; margin {row['margin_min']:.2g}{basis}"
            yield _judged(text, row, ALONE, more=", every start inside the cones", said=said, also=inside)


def _smooth(metrics: Metrics) -> Iterator[Claim]:
    for name in ("smooth", "trajectories", "rollout_moving"):
        text = f"{row_of('learned_previous').label}: {SETS[name].label}"
        yield _judged(text, _row(metrics, name, "learned_previous"), SMOOTH_LIMITS)


def _time(metrics: Metrics) -> Iterator[Claim]:
    total = metrics["timing"]["total"][FLOW]
    ours, paper = total.get("learned_fixed"), total[BASIS]
    said = met = None
    if ours is not None:
        a, b = ours["best"], paper["best"]
        said = f"p50 {a['median']:.3g} against {b['median']:.3g} us, p99 {a['p99']:.3g} against {b['p99']:.3g} us"
        met = a["median"] <= 0.5 * b["median"] and a["p99"] < b["p99"]
    text = f"inference, repair and flow to {small(TOLERANCE)}, fixed grasp, whole public call, same run"
    yield claim(text, "p50 at most half of the 12-basis's, p99 lower", said, met)


def is_cold(metrics: Metrics, key: str) -> bool:
    """Whether no previous solution helps a start."""
    given = metrics["run"].get("given", {}).get(key, {})
    return not (row_of(key).remembers or given.get("remembers"))


def _fastest(metrics: Metrics) -> Iterator[Claim]:
    """Who is the fastest to a certified solve without a previous solution, whoever it is, and what the network has to do with it."""
    totals = metrics["timing"]["total"]
    rows = {
        (m, key): row["best"]
        for m in totals
        for key, row in totals[m].items()
        if is_cold(metrics, key) and row["best"]["n"]
    }
    ours, paper = (rows.get(("newton", key)) for key in ("learned_fixed", BASIS))
    said = met = None
    if ours is not None and paper is not None:
        first = min(rows, key=lambda who: (rows[who]["median"], rows[who]["p99"]))
        said = "winner: " + "; ".join(
            f"{row_of(key).label}, {METHOD_NAMES[method]}: p50 {rows[method, key]['median']:.3g}, p99 {rows[method, key]['p99']:.3g} us"
            for method, key in dict.fromkeys((first, ("newton", "learned_fixed"), ("newton", BASIS)))
        )
        met = all(ours[q] <= factor * paper[q] for q, factor in FASTER.items())
    text = "fastest certified solve from cold (no previous solution), fixed grasp, whole public call, same run"
    asked = f"the winner named; Newton from the network p50 <= {FASTER['median']:g}, p99 <= {FASTER['p99']:g} of Newton's from the 12-basis"
    yield claim(text, asked, said, met)


def _against_newton(metrics: Metrics) -> Iterator[Claim]:
    """What a model is worth in time: plain Newton from the 12-basis needs nothing learned."""
    totals = metrics["timing"]["total"]
    plain = totals["newton"].get(BASIS, {}).get("best", {"n": 0})
    for key in metrics["run"]["models"]:
        rows = {method: row for method in totals if (row := totals[method].get(key, {}).get("best", {})).get("n")}
        said = met = None
        if rows and plain["n"]:
            said = ", ".join(f"{METHOD_NAMES[method]} {row['median']:.3g}" for method, row in rows.items())
            said += f" against {plain['median']:.3g} us"
            met = min(row["median"] for row in rows.values()) < plain["median"]
        text = f"{row_of(key).label}, by the flow or by Newton: faster than plain Newton from the 12-basis, whole public call"
        yield claim(text, "p50 of the faster below plain Newton's", said, met)


def _models(metrics: Metrics) -> Iterator[Claim]:
    models = metrics["run"]["models"]
    for key in ("learned_fixed", FITTED):
        if key in models:
            seconds = training_seconds(models[key])
            said = None if seconds is None else f"{seconds:.0f} s"
            met = None if seconds is None else seconds <= TRAINING_SECONDS
            yield claim(
                f"{row_of(key).label}: processor time of training",
                f"at most {TRAINING_SECONDS / 60:g} minutes",
                said,
                met,
            )
    size = sum(models[key].get("bytes", 0) for key in SHIPPED if key in models)
    yield claim(
        "shipped models together", f"below {MODEL_BYTES / 1e6:g} MB", f"{size / 1e6:.2f} MB", size < MODEL_BYTES
    )


def training_seconds(card: dict[str, Any]) -> float | None:
    """Processor time of one core that a model was trained, as its card says; None where it does not.

    Example:
        >>> training_seconds({"seconds": 300.0, "cpu_seconds": 240.0}), training_seconds({"seconds": 5.7}), training_seconds({})
        (240.0, 5.7, None)
    """
    return card.get("cpu_seconds", card.get("seconds"))


def _guarantees(metrics: Metrics) -> Iterator[Claim]:
    for key, row in metrics["guarantee"].items():
        low, high = row["magnitudes"]
        text = f"{row_of(key).label}: starts worse in Phi than the 12-basis's, wrenches of {low:g} to {high:g} N"
        yield claim(text, "0", f"{row['worse']} of {row['n']}", row["worse"] == 0, "guarantee")
    for key in dict.fromkeys((*LEARNED, *metrics["run"]["models"])):
        rows = [rows[key] for rows in metrics["starts"][FLOW].values() if key in rows and rows[key]["cases"]]
        margins = [row["margin_min"] for row in rows if row["margin_min"] is not None]
        if margins:
            worse, total = (sum(row["worse_than_basis"][part] for row in rows) for part in ("count", "of"))
            balance = max(row["residual_max"] for row in rows if row["residual_max"] is not None)
            yield claim(
                f"{row_of(key).label}: strictly feasible, balanced and never worse than the 12-basis, all sets",
                f"margin > 0, balance to {small(BALANCE)} of the largest force, 0 worse",
                f"margin {min(margins):.2g}, balance {balance:.1e}, {worse} of {total} worse",
                min(margins) > 0.0 and balance <= BALANCE and worse == 0,
                "guarantee",
            )


def _given(metrics: Metrics) -> Iterator[Claim]:
    """What is asked of every start that a run was given: that there is one."""
    for key in given_in(metrics["starts"][FLOW]["ball"]):
        rows = [rows[key] for rows in metrics["starts"][FLOW].values() if rows[key]["cases"]]
        asked, missing = (sum(row[part] for row in rows) for part in ("cases", "no_start"))
        why: dict[str, int] = {}
        for row in rows:
            for text, count in row["reasons"].items():
                kind = text.partition(": ")[0]
                why[kind] = why.get(kind, 0) + count
        said = ", ".join(f"{count} {kind}" for kind, count in why.items())
        text = f"{row_of(key).label}: a balanced force inside the cones wherever it is asked, all sets"
        measured = f"{missing} of {asked} cases without{f' ({said})' if said else ''}"
        yield claim(text, "0 cases without", measured if asked else None, missing == 0, "given")
        yield _against_basis(metrics, key)


def _against_basis(metrics: dict[str, Any], key: str) -> Claim:
    """What a start is worth beside the paper's, in iterations and in microseconds: as measured."""
    row, paper = _row(metrics, "ball", key), _row(metrics, "ball", BASIS)
    total = (metrics.get("timing") or {}).get("total", {}).get(FLOW, {})
    times = [total.get(one, {}).get("best", {"n": 0}) for one in (key, BASIS)]
    said = met = None
    if row is not None and paper is not None:
        met = bool(row["iterations"]["n"]) and not row["no_start"]
        met = met and row["iterations"]["median"] <= paper["iterations"]["median"]
        said = (
            f"{_said(row, 'median', 'p99')} against {_said(paper, 'median', 'p99')}"
            if row["iterations"]["n"]
            else lacking(row)
        )
        if all(time["n"] for time in times):
            a, b = times
            said += (
                f"; p50 {a['median']:.3g} against {b['median']:.3g} us, p99 {a['p99']:.3g} against {b['p99']:.3g} us"
            )
            met = met and a["median"] <= b["median"]
    text = f"{row_of(key).label} against the 12-basis: iterations of the flow and microseconds of the whole call, held-out ball"
    return claim(text, "in the median no more of either, 0 cases without a start", said, met, "reference")


def _holds(metrics: Metrics) -> Iterator[Claim]:
    for scenario in HOLD_SCENARIOS:
        row = metrics["rollouts"].get(scenario, {}).get(BASIS)
        said = met = None
        if row is not None:
            kept = "kept" if row["contact_always"] else "lost"
            said = f"drift {row['max_drift_mm']:.2g} mm, contacts {kept}"
            met = row["held"] == row["episodes"] and row["contact_always"] and row["max_drift_mm"] < DRIFT_LIMIT
        text = f"the paper's pipeline holds the cuboid, scenario {scenario}"
        yield claim(text, f"drift below {DRIFT_LIMIT:g} mm, no contact lost", said, met)


def _references(metrics: Metrics) -> Iterator[Claim]:
    """Numbers measured before, on the same definitions: this run should come near them."""
    known = (
        ("12-basis, held-out ball", "ball", BASIS, {"median": (32.0, 52.0), "p90": (80.0, 140.0)}, "median 42, p90 110"),
        ("previous solution, G^+, 3 % per step", "smooth", "previous_pseudoinverse", {"median": (1, 7), "p99": (17, 51)}, "median 4, p99 34"),
        ("previous solution, tangent, 3 % per step", "smooth", PREVIOUS, {"median": (0, 0), "p99": (0, 14)}, "median 0, p99 7"),
    )  # fmt: skip
    for text, name, key, ranges, before in known:
        row = _row(metrics, name, key)
        said = None if row is None else _said(row, *ranges)
        met = row and all(low <= row["iterations"][q] <= high for q, (low, high) in ranges.items())
        yield claim(f"{text}, as measured before", f"about {before}", said, bool(met), "reference")

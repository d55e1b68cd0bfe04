"""First of a comparison: where each start wins; what starts and sets are called."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from training.cases.set_table import GROUPS, TOLERANCE
from training.cases.start_table import main_of, row_of
from training.report.page import Cell, Columns, Fold, Section, Table, at, present, pretty
from training.runs.words import number, percent, small
from training.trials.arrays import LIMIT
from training.trials.ranks import lacking

STEPPED = ("linear_combination", "basis_tangent", "basis_newton_2", "network", "network_newton_1", "network_newton_2")
"""The 12-basis and the network of the fixed grasp, each after no, one and two plain Newton steps."""
FEW = 0.01
"""Part of the cases that may lack a start before the start is no candidate for the best: the p99 would leave them out."""


def label(start: str) -> str:
    """What a start is called in tables."""
    return pretty(row_of(start).label)


def short(start: str) -> str:
    """What a start is called in headings and legends."""
    return pretty(row_of(start).short)


def set_label(metrics: dict[str, Any], name: str) -> str:
    """What a set of cases is called."""
    return pretty(at(metrics, "sets", name, "label") or name)


def steps(value: float | None) -> str:
    """Iterations; beyond the limit they never reached the level.

    Example:
        >>> steps(3.0), steps(2.71), steps(40.4), steps(5001.0), steps(None)
        ('3', '2.7', '40', '> 5000', '–')
    """
    if value is None:
        return number(value)
    return f"> {LIMIT}" if value > LIMIT else number(round(value, 1 if value < 10 else 0))


def pair(row: dict[str, Any] | None) -> str:
    """Median / p99 of iterations, where too many cases have no start that instead; a dash where there are none."""
    if at(row, "median") is None:
        return "–"
    never = [bool(at(row, "no_start")) and at(row, part) > LIMIT for part in ("median", "p99")]
    if row is not None and any(never):
        return lacking(row) if never[0] else f"{steps(row['median'])}, {lacking(row)}"
    return f"{steps(at(row, 'median'))} / {steps(at(row, 'p99'))}"


def pair_of(row: dict[str, Any] | None) -> str:
    """`pair` of a start's row; without a single run, on how many cases it gave no start."""
    runs = pair(at(row, "iterations"))
    return lacking(row) or runs if runs == "–" else runs


def starts_of(metrics: dict[str, Any]) -> list[str]:
    """Every start of a run, in its order."""
    sets = (at(metrics, "starts", "reduced_flow") or {}).values()
    return list(dict.fromkeys(key for rows in sets for key in rows))


def wins_section(metrics: dict[str, Any]) -> Section:
    """Set by set: which start needs the fewest iterations."""
    notes = (
        f"Iterations (accepted steps) to a relative gap of {small(TOLERANCE)} in Phi, median / p99; ★ marks the best of a row, by the median, "
        f"then by the p99. † the start does not exist on more than {100 * FEW:g} % of these cases (they are in no percentile), ‡ it "
        "does not apply to a part of them: neither can be the best. A dash: it does not apply there at all, or was not measured.",
        *smooth_text(metrics),
    )
    main = matrix(
        metrics,
        "reduced_flow",
        main_of(starts_of(metrics)),
        f"Reduced flow: iterations to {small(TOLERANCE)}, median / p99",
    )
    everything = [
        matrix(metrics, "reduced_flow", starts_of(metrics), title, group)
        for group, title in _groups(metrics).items()
    ]  # fmt: skip
    blocks = present([main, _winners(metrics), Fold("All starts, one table per kind of case", present(everything))])
    return Section("wins", "Where each start wins", notes, blocks)


def smooth_text(metrics: dict[str, Any]) -> list[str]:
    """What the previous solution leaves to others where cases follow each other smoothly, by this run's numbers."""
    key, names = "previous_tangent", ("smooth", "trajectories", "rollout_moving")
    found = {name: at(metrics, "starts", "reduced_flow", name, key, "iterations") for name in names}
    found = {name: row for name, row in found.items() if at(row, "median") is not None}
    if not found:
        return []
    told = "; ".join(f"{set_label(metrics, name)}: {pair(row)}" for name, row in found.items())
    most = max(row["p99"] for row in found.values())
    left = (
        "there nothing is left to gain"
        if most == 0
        else "there is little left to gain"
        if most < 10
        else "there is something left to gain"
    )
    return [
        f"Where cases follow each other smoothly the previous solution with the tangent correction leaves the flow median / p99 iterations ({told}): {left}. "
        "It is far after a jump, belongs to other contacts after a change of contact, and does not exist on a cold start."
    ]


def matrix(
    metrics: dict[str, Any], method: str, starts: Sequence[str], caption: str, group: str | None = None
) -> Table:
    """A row per set, a column per start, the best of each row marked; starts that no set has are left out."""
    sets = {
        name: rows
        for name, rows in (at(metrics, "starts", method) or {}).items()
        if group is None or at(metrics, "sets", name, "group") == group
    }
    used = [key for key in starts if any(pair_of(at(rows, key)) != "–" for rows in sets.values())]
    out = []
    for name, rows in sets.items():
        ranks = {key: _rank(at(rows, key)) for key in used}
        least = min((rank for rank in ranks.values() if rank is not None), default=None)
        cells = [Cell(_marked(at(rows, key)), "best" if least and ranks[key] == least else "") for key in used]
        out.append([set_label(metrics, name), *cells])
    return Table(caption, ("cases", *(short(key) for key in used)), out if used else [])


def network_section(metrics: dict[str, Any]) -> Section:
    """The network alone beside the 12-basis, both also after the same number of plain Newton steps."""
    rows, timing = at(metrics, "starts", "reduced_flow", "ball"), metrics.get("timing") or {}
    out = []
    for key in STEPPED:
        row = at(rows, key)
        if at(row, "iterations", "median") is None:
            continue
        times = (
            at(timing, "start", key, "best"),
            *(at(timing, "total", method, key, "best") for method in ("reduced_flow", "newton")),
        )
        gap = at(row, "start_gap")
        out.append([
            label(key), pair(at(row, "iterations")), f"{number(at(gap, 'median'), 2)} / {number(at(gap, 'p99'), 2)}",
            *(f"{number(at(time, 'median'))} / {number(at(time, 'p99'))}" for time in times),
        ])  # fmt: skip
    raw = at(rows, "learned_fixed", "raw", "inside")
    notes = (
        "No Newton step, learned or not, helps the network here; it is put back towards the 12-basis's combination only where it lies "
        f"outside the cones{f' (inside before that: {percent(raw)} of these cases)' if raw is not None else ''}. A start after k Newton steps stands beside "
        "the 12-basis after as many, each step as long as lowers Phi most: what the steps do is not what was learned.",
    )
    columns = (
        "start", "flow, iterations", "gap at the start", "start alone [µs]", "with the flow [µs]", "with Newton [µs]",
    )  # fmt: skip
    table = Table(f"Held-out ball, to a relative gap of {small(TOLERANCE)}, median / p99", columns, out)
    return Section("network", "The network alone", notes, present([table]))


def _groups(metrics: dict[str, Any]) -> dict[str, str]:
    """The kinds of cases that this run has, in order, with their headings."""
    kinds = {at(entry, "group") for entry in metrics.get("sets", {}).values()}
    return {group: GROUPS[group] for group in GROUPS if group in kinds}


def _missing(row: dict[str, Any] | None) -> tuple[float, float]:
    """Parts of the cases without a start, and to which it does not apply."""
    cases, absent, skipped = (at(row, key) or 0 for key in ("cases", "no_start", "not_applicable"))
    return absent / max(cases, 1), skipped / max(cases + skipped, 1)


def _rank(row: dict[str, Any] | None) -> tuple[float, float] | None:
    """Less is better; None: no candidate."""
    iterations = at(row, "iterations")
    if at(iterations, "median") is None or max(_missing(row)) > FEW + 0.04 * (_missing(row)[0] == 0):
        return None
    return iterations["median"], iterations["p99"]


def _marked(row: dict[str, Any] | None) -> str:
    text = pair_of(row)
    absent, skipped = _missing(row)
    return text if at(row, "iterations", "median") is None else text + "†" * (absent > FEW) + "‡" * (skipped > 5 * FEW)


def _winners(metrics: dict[str, Any]) -> Table:
    wins = metrics.get("wins", [])
    kinds = {"basis": "12-basis, best control", "previous": "previous solution", "learned": "best learned"}
    kinds |= {"given": "best given"} if any("given" in row for row in wins) else {}
    names = {"basis": "12-basis + Newton"}
    columns: Columns = (
        ("cases", lambda row: pretty(row.get("label") or row["set"])),
        *((heading, lambda row, kind=kind: pair(row.get(kind))) for kind, heading in kinds.items()),
        *((f"which {kind}", lambda row, kind=kind: short(at(row, kind, "start") or "–")) for kind in kinds if kind in ("learned", "given")),
        ("fewest iterations", lambda row: names.get(row["winner"], row["winner"] or "–")),
    )  # fmt: skip
    title = (
        "Learned against the previous solution and the 12-basis, each at its best: the 12-basis with up to four Newton steps that "
        "are not counted, as the learned layers are not; tie: within one iteration"
    )
    return Table.of(title, columns, [(row,) for row in wins])

"""The middle of a report: every set in full, Newton beside the reduced flow, microseconds, feasibility, continuity."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from training.cases.set_table import TOLERANCE
from training.cases.start_table import LEARNED, main_of
from training.report.page import Columns, Fold, Picture, Section, Table, at, present, shown
from training.report.starts import label, matrix, pair, pair_of, set_label, short, starts_of, steps
from training.runs.words import number, percent, small
from training.trials.arrays import LIMIT


def sets_section(metrics: dict[str, Any]) -> Section:
    """Everything measured, a folded part per set."""
    notes = (
        "Cases: those a start applies to. No start: it has no strictly feasible force there (counted, in no percentile). Not done: "
        f"{small(TOLERANCE)} was not reached in {LIMIT} iterations (in the percentiles as more than {LIMIT}). In brackets a 95 % "
        "interval of the median, between order statistics.",
    )
    folds = [_set_fold(metrics, name) for name in metrics.get("sets", {})]
    return Section("sets", "Set by set", notes, present(folds))


def _set_fold(metrics: dict[str, Any], name: str) -> Fold:
    flow, newton = (at(metrics, "starts", method, name) or {} for method in ("reduced_flow", "newton"))
    entry = metrics["sets"][name]
    blocks = present(
        [_iterations(flow, "Reduced flow"), _levels(flow, "Reduced flow"), _budgets(flow), _iterations(newton, "Newton"),
         _levels(newton, "Newton"), _events(metrics, name)]
    )  # fmt: skip
    contacts = "/".join(str(count) for count in entry.get("contacts") or ())
    summary = f"{set_label(metrics, name)} (cases: {number(entry.get('cases'))}, N = {contacts or '–'})"
    return Fold(summary, blocks, [f"The previous solution: {note}." for note in [entry.get("note")] if note])


def _iterations(rows: dict[str, Any], method: str) -> Table:
    caption = f"{method}: iterations to a relative gap of {small(TOLERANCE)}"
    return Table.of(caption, ITERATIONS, [(key, row) for key, row in rows.items() if at(row, "cases")])


def _steps(part: str) -> Callable[[str, Any], str]:
    return lambda key, row: steps(at(row, "iterations", part))


def _interval(row: dict[str, Any] | None) -> str:
    text, low, high = (steps(at(row, key)) for key in ("median", "median_low", "median_high"))
    return text if low == high else f"{text} [{low}, {high}]"


ITERATIONS: Columns = (
    ("start", lambda key, row: label(key)),
    ("cases", shown("cases")),
    ("n/a", shown("not_applicable")),
    ("no start", shown("no_start")),
    ("not done", shown("not_converged")),
    ("median", lambda key, row: _interval(at(row, "iterations"))),
    *((part, _steps(part)) for part in ("p95", "p99", "max")),
    ("starting gap, median", shown("start_gap", "median", digits=2)),
    ("p99", shown("start_gap", "p99", digits=2)),
)
"""Of every start on every set, by every method; see `metrics.PER_START`."""


def _levels(rows: dict[str, Any], method: str) -> Table:
    levels = list(dict.fromkeys(level for row in rows.values() for level in at(row, "iterations_to") or {}))
    out = [
        [label(key), *(pair(at(row, "iterations_to", level)) for level in levels)]
        for key, row in rows.items()
        if at(row, "cases")
    ]
    return Table(f"{method}: iterations to each gap, median / p99", ("start", *levels), out if levels else [])


def _budgets(rows: dict[str, Any]) -> Table:
    budgets = list(dict.fromkeys(count for row in rows.values() for count in at(row, "gap_after") or {}))

    def text(row: dict[str, Any], count: str) -> str:
        median, p95 = (at(row, "gap_after", count, part) for part in ("median", "p95"))
        return "–" if median is None else f"{number(median, 2)} / {number(p95, 2)}"

    out = [[label(key), *(text(row, count) for count in budgets)] for key, row in rows.items() if at(row, "cases")]
    caption = "Reduced flow: relative gap left after so many iterations, median / p95"
    return Table(caption, ("start", *budgets), out if budgets else [])


def _events(metrics: dict[str, Any], name: str) -> Table:
    events = at(metrics, "events", name) or {}
    used = main_of(dict.fromkeys(key for rows in events.values() for key in rows))
    out = []
    for event, rows in events.items():
        count = max((at(row, "cases") or 0 for row in rows.values()), default=0)
        out.append([event or "(none)", number(count), *(pair_of(at(rows, key)) for key in used)])
    caption = f"Reduced flow by event: iterations to {small(TOLERANCE)}, median / p99"
    return Table(caption, ("event", "cases", *(short(key) for key in used)), out)


def newton_section(metrics: dict[str, Any]) -> Section:
    """Newton beside the reduced flow: iterations on the held-out ball, then set by set."""
    flow, newton = (at(metrics, "starts", method, "ball") or {} for method in ("reduced_flow", "newton"))
    both = (("reduced flow", "reduced_flow", flow), ("Newton", "newton", newton))
    columns: Columns = (
        ("start", label),
        *((f"{name}, iterations", lambda key, rows=rows: pair_of(at(rows, key))) for name, _, rows in both),
        *((f"{name} [µs]", lambda key, m=method: _micro(at(metrics, "timing", "total", m, key, "best"))) for name, method, _ in both),
    )  # fmt: skip
    measured = [(key,) for key in flow if any(pair_of(at(rows, key)) != "–" for rows in (flow, newton))]
    table = Table.of(f"Held-out ball, to a relative gap of {small(TOLERANCE)}: median / p99", columns, measured)
    notes = (
        *_saved(flow, newton),
        "Microseconds are whole public Python calls on the fixed grasp.",
    )
    sets = matrix(
        metrics, "newton", main_of(starts_of(metrics)), f"Newton: iterations to {small(TOLERANCE)}, median / p99"
    )
    return Section("newton", "Newton beside the reduced flow", notes, present([table, sets]))


def _saved(flow: dict[str, Any], newton: dict[str, Any]) -> list[str]:
    """What the learned starts spare each method, in the median."""
    told = []
    for key in LEARNED:
        pairs = [
            [at(rows, one, "iterations", "median") for one in ("linear_combination", key)] for rows in (flow, newton)
        ]
        if all(value is not None for values in pairs for value in values):
            (a, b), (c, d) = pairs
            told.append(
                f"{label(key)} spares the flow {number(a - b)} of {number(a)} steps and Newton {number(c - d)} of {number(c)}"
            )
    return [f"In the median, against the 12-basis: {'; '.join(told)}."] if told else []


def _micro(row: dict[str, Any] | None) -> str:
    median, p99 = at(row, "median"), at(row, "p99")
    return "–" if median is None else f"{number(median)} / {number(p99)}"


def timing_section(metrics: dict[str, Any], pictures: list[Picture]) -> Section:
    """Microseconds: the start alone, the whole call, the offline basis and what training costs."""
    timing = metrics.get("timing") or {}
    base = at(timing, "total", "reduced_flow", "linear_combination", "best", "median")

    def ratio(key: str) -> str:
        ours = at(timing, "total", "reduced_flow", key, "best", "median")
        return number(ours / base, 2) if ours is not None and base else "–"

    def table(caption: str, kind: str) -> Table:
        def of(heading: str, *place: str) -> Columns:
            return [
                (text, lambda key, part=part: number(at(timing, *place, key, kind, part)))
                for text, part in ((heading, "median"), ("p99", "p99"))
            ]

        ratios = [("of the 12-basis's", ratio)] if kind == "best" else []
        whole = of("with the flow", "total", "reduced_flow"), of("with Newton", "total", "newton")
        columns = [("start", label), *of("start alone", "start"), *whole[0], *ratios, *whole[1]]
        return Table.of(caption, columns, [(key,) for key in timing.get("start") or {}])

    repeats = timing.get("repeats")
    several = repeats is None or repeats > 1
    repeated = (
        f"Best of {number(repeats)} repeats per wrench; all repeats are in the folded table."
        if several
        else "Each was called once per wrench."
    )
    notes = (
        "Public Python calls on this machine, one thread, warm-up not counted, one start "
        "at a time in blocks that take turns, as in a loop that does nothing else, on "
        f"every wrench ({number(timing.get('wrenches'))} of the held-out ball, fixed grasp). “Start alone” includes inference "
        f"and repair; “with …” is the whole call to a certified gap of {small(TOLERANCE)}; where the solver has the start compiled, as the "
        f"12-basis, it never returns to Python in between and can be shorter than the start alone. {repeated}",
    )
    blocks = present([
        table("Microseconds per call: median, then p99", "best"), *pictures, _break_even(metrics),
        Fold("Every repeat counted", present([table("Microseconds per call, all repeats", "raw")] if several else [])),
    ])  # fmt: skip
    return Section("time", "Microseconds, training time and break-even", notes, blocks)


def _break_even(metrics: dict[str, Any]) -> Table:
    def calls(key: str, row: dict[str, Any]) -> str:
        saved = at(row, "saved_us")
        return "never" if saved is not None and saved <= 0.0 else number(at(row, "calls"))

    columns: Columns = (
        ("start", lambda key, row: label(key)),
        ("training [s]", shown("training_seconds")),
        ("saved per call [µs]", shown("saved_us")),
        ("the 12-basis's own offline work [µs]", shown("basis_offline_us")),
        ("calls until it has paid", calls),
    )
    caption = "Training time, and after how many calls it is won back against the 12-basis (reduced flow)"
    return Table.of(caption, columns, (metrics.get("break_even") or {}).items())


def feasibility_section(metrics: dict[str, Any], pictures: list[Picture]) -> Section:
    """What networks say before and after the repair, the guarantee, and how continuous the starts are."""
    notes = (
        "Raw: what a network says. What a model hands out should be strictly inside the cones and balanced: its repair moves along the "
        "segment to a classical start and keeps the better in Phi; the claims count whether it is. Lower Phi does not always mean fewer steps of the "
        "flow: the guarantee is about Phi.",
        "Continuity, over the steps on both sides of which there is a start: force change per wrench change |df| / |dw| (moments / 0.05 m) along straight paths that cross sign changes of "
        "wrench components, where the 12-basis has kinks. Kink: change of that slope from one step to the next, which does not "
        "shrink with the step where a start has a kink. Jump: |df| across a step 100 times finer at the steepest place; it goes to "
        "zero where the start is continuous.",
    )
    summary, full = _raw(metrics)
    blocks = present(
        [
            summary,
            _reasons(metrics),
            _guarantee(metrics),
            _continuity(metrics),
            *pictures,
            Fold("Raw and repaired, every set", present([full])),
        ]
    )
    return Section("feasibility", "Feasibility, guarantee, continuity", notes, blocks)


def _raw(metrics: dict[str, Any]) -> tuple[Table, Table]:
    """Over all sets, and set by set."""
    by_start: dict[str, list[tuple[str, dict[str, Any]]]] = {}
    for name, rows in (at(metrics, "starts", "reduced_flow") or {}).items():
        for key, row in rows.items():
            if at(row, "cases"):
                by_start.setdefault(key, []).append((name, row))
    columns = (
        "raw inside the cones", "raw gap, median", "raw imbalance, max", "margin, least", "imbalance, max", "worse than the 12-basis",
    )  # fmt: skip
    short_rows, full = [], []
    for key, rows in by_start.items():
        values = {part: [at(row, *part) for _, row in rows if at(row, *part) is not None] for part in _PARTS}
        inside = values["raw", "inside"]
        worse, total = sum(values["worse_than_basis", "count"]), sum(values["worse_than_basis", "of"])
        short_rows.append([
            label(key), f"{percent(min(inside))} to {percent(max(inside))}" if inside else "–",
            number(max(values["raw", "residual_max"], default=None), 2), number(min(values["margin_min",], default=None), 2),
            number(max(values["residual_max",], default=None), 2), f"{worse} of {total}" if total else "–",
        ])  # fmt: skip
        for name, row in rows:
            if at(row, "raw"):
                of = at(row, "worse_than_basis")
                full.append([
                    set_label(metrics, name), label(key), percent(at(row, "raw", "inside")), number(at(row, "raw", "gap", "median"), 2),
                    number(at(row, "raw", "residual_max"), 2), number(at(row, "margin_min"), 2), number(at(row, "residual_max"), 2),
                    f"{of['count']} of {of['of']}" if of else "–",
                ])  # fmt: skip
    brief = ("start", "raw inside the cones, by set", *columns[2:])
    note = "margin and imbalance relative to the largest force"
    return (
        Table(f"Feasibility of every start over all sets ({note})", brief, short_rows),
        Table(f"Raw and repaired, set by set ({note})", ("cases", "start", *columns), full, words=2),
    )


_PARTS = (
    ("raw", "inside"), ("raw", "residual_max"), ("margin_min",), ("residual_max",), ("worse_than_basis", "count"),
    ("worse_than_basis", "of"),
)  # fmt: skip


def _reasons(metrics: dict[str, Any]) -> Table:
    """Why starts have no force, over all sets."""
    counts: dict[tuple[str, str], list[Any]] = {}
    for rows in (at(metrics, "starts", "reduced_flow") or {}).values():
        for key, row in rows.items():
            for text, count in (at(row, "reasons") or {}).items():
                kind, _, message = text.partition(": ")
                entry = counts.setdefault((key, kind), [0, message])
                entry[0] += count
    out = [[label(key), kind, message or "–", number(count)] for (key, kind), (count, message) in counts.items()]
    columns = ("start", "why", "first message", "cases")
    return Table("Cases without a start, over all sets, and why", columns, out, words=3)


def _guarantee(metrics: dict[str, Any]) -> Table:
    out = []
    for key, row in (metrics.get("guarantee") or {}).items():
        low, high = at(row, "magnitudes") or (None, None)
        parts = [("all", row), *(at(row, "grasps") or {}).items()]
        for name, part in parts if len(parts) > 2 else parts[:1]:
            size = f"{number(low)} to {number(high)}" if name == "all" else ""
            name = label(key) if name == "all" else f"… {name.replace('_', ' ')}"
            counts = number(at(part, "n")), number(at(part, "worse")), number(at(part, "excess_max"), 2)
            out.append([name, *counts, size])
    columns = ("start", "wrenches", "worse in Phi", "largest excess of Phi", "magnitudes [N]")
    return Table("Never worse in Phi than the 12-basis: random wrenches over six decades", columns, out)


CONTINUITY: Columns = (
    ("start", lambda key, row: label(key)),
    ("steps", shown("slope", "n")),
    (
        "slope, median",
        lambda key, row: number(at(row, "slope", "median")) if at(row, "slope", "n") != 0 else "no start",
    ),
    ("p99", shown("slope", "p99")),
    ("max", shown("slope", "max")),
    ("kink, p99", shown("kink", "p99")),
    ("max", shown("kink", "max")),
    ("jump, max [N]", shown("jump_max", digits=2)),
)


def _continuity(metrics: dict[str, Any]) -> Table:
    caption = "Continuity of the start along straight wrench paths"
    return Table.of(caption, CONTINUITY, (metrics.get("continuity") or {}).items())

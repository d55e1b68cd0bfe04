"""Page of the comparison of starts, as data."""

from __future__ import annotations

from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from training.evaluation.compare.cases import SETS
from training.evaluation.compare.starts import BASIS, GIVEN_COLOURS, STARTS, start_info
from training.evaluation.compare.trial import ITERATION_LIMIT, PHI_ROUNDING, TOLERANCE
from training.evaluation.report.holds_page import grid, rates_figure
from training.evaluation.report.page import axes, legend_above
from training.evaluation.results.claims import Claim
from training.evaluation.results.table import Rows, chosen, numbers, pd
from training.evaluation.results.words import number, small

TITLE = "Starts of the grasp-force optimisation"
INTRO = (
    "This page compares every start of the optimisation with the paper's combination of twelve offline solutions (the 12-basis), under "
    "the paper's reduced gradient flow and under Newton's method. "
    f"All starts get the same held-out problems, and the flow uses the step rule that suits all of them best. Iterations are accepted steps to a relative gap of "
    f"{small(TOLERANCE)}, failures are counted, and times are those of the whole call from Python, measured alone in one process. "
    "The words are defined at the end of this page, the columns of the table in run.json."
)
WORDS = {
    "Phi": "The objective omega tr P + lambda tr P^-1: squeeze, and a barrier at the friction cones.",
    "gap": "Excess of Phi over its least value, relative to that.",
    "flow": "The paper's reduced gradient flow on Phi, with Barzilai-Borwein steps. `grasp reproduce` compares the step rules, among them the constant one.",
    "start": "The force from which a method begins: it balances the wrench strictly inside the friction cones.",
    "internal force": "The least force that balances the wrench, plus enough of one internal force to bring it inside the cones: Newton's default start.",
    "12-basis": "The paper's start: a non-negative combination of the optimal forces of twelve unit wrenches.",
    "network alone": "The output of the network without any step; outside the cones it is moved towards the 12-basis.",
    "learned, fixed": "The shipped model: the network, its repair, and for Newton the steps that follow in the same compiled call.",
    "previous": "The last solution, carried to the new wrench by a Newton step within balance (tangent) or by the least change (G^+).",
    "ball": SETS["ball"].label,
    "fixed grasp": "The contacts of presets.paper_cuboid(): a thumb against three fingers on a 0.1 m cuboid.",
    "replaced": "The start was discarded for the 12-basis's, from which the optimisation then began.",
    "performance profile": "Share of the problems that a start solves within a factor of the best start on each (Dolan and Moré, 2002).",
    "held": "The object was not dropped and did not move by more than the task allows, to the end of the episode.",
    "median / p99": "The value below which half of the problems, and 99 of 100, lie.",
}

FLOW = "method == 'reduced_flow'"
NEWTON = "method == 'newton'"
_BALL = "case == 'ball'"
_VARIED = "case == 'ball_frictions'"
_PAPER = f"start == '{BASIS}'"
_LEARNED = "start in ['learned_fixed', 'learned_previous']"
_STEADY = f"case in ['hold_gravity', 'hold_constant', 'hold_paper_path'] and {_PAPER}"
_NETWORK = f"{_VARIED} and start == 'network' and {FLOW}"
_SMOOTH = f"case in ['smooth', 'trajectories'] and start == 'learned_previous' and {FLOW}"
_STARTED = f"{_LEARNED} and start_margin_min == start_margin_min"
_INTERNAL = "start == 'internal_force'"
_RIVALS = (
    ("flow", FLOW, "the 12-basis", _PAPER, "compiled", "compiled_microseconds", (0.6, 1.0)),
    (
        "Newton",
        NEWTON,
        "its internal force",
        _INTERNAL,
        "compiled",
        "compiled_microseconds",
        (0.55, 0.75),
    ),
    ("Newton", NEWTON, "its internal force", _INTERNAL, "from Python", "microseconds", (0.75, 0.9)),
)
"""Method and its query, other start and its query, caller, column, limits of median and p99."""
CLAIMS = (
    Claim.of(
        "network alone: median of the flow's iterations, friction varied",
        _NETWORK,
        "iterations_median <= 3",
    ),
    Claim.of(
        "network alone: p99 of the flow's iterations, friction varied",
        _NETWORK,
        "iterations_p99 <= 15",
    ),
    Claim.of(
        "network alone: every start is inside the cones, friction varied (least margin)",
        _NETWORK,
        "start_margin_min > 0",
    ),
    *(
        Claim.of(
            f"network and {name}: {word} time over that from {other}, {caller}",
            f"{_VARIED} and start == 'learned_fixed' and {method}",
            f"{column}_{word} <= {limit}",
            f"{_VARIED} and {start} and {method}",
        )
        for name, method, other, start, caller, column, limits in _RIVALS
        for word, limit in zip(("median", "p99"), limits, strict=True)
    ),
    Claim.of(
        "learned starts: Phi never above the 12-basis's, wrenches of 0.001 to 1000 N (largest excess)",
        f"case == 'six_decades' and {_LEARNED}",
        f"start_excess_max <= {PHI_ROUNDING}",
    ),
    Claim.of(
        "learned starts: Phi never above the 12-basis's, all sets (largest excess)",
        _STARTED,
        f"start_excess_max <= {PHI_ROUNDING}",
    ),
    Claim.of(
        "learned starts: inside the cones, all sets (least margin)",
        _STARTED,
        "start_margin_min > 0",
    ),
    Claim.of(
        "learned starts: balanced, all sets (largest residual over the largest force)",
        _STARTED,
        "start_residual_max <= 1e-9",
    ),
    Claim.of(
        "learned, with the previous solution: median of the flow's iterations on smooth paths",
        _SMOOTH,
        "iterations_median <= 0",
    ),
    Claim.of(
        "learned, with the previous solution: p99 of the flow's iterations on smooth paths",
        _SMOOTH,
        "iterations_p99 <= 7",
    ),
    Claim.of(
        "processor time that trained the shipped model",
        "case == 'model'",
        "cpu_seconds_max <= 1800 s",
    ),
    Claim.of("size of the shipped model", "case == 'model'", "bytes_max <= 2e6 B"),
    Claim.of(
        "the paper's pipeline holds the cuboid: share of the episodes", _STEADY, "held_mean >= 1"
    ),
    Claim.of("the paper's pipeline holds the cuboid: largest drift", _STEADY, "drift_max < 1 mm"),
    Claim.of(
        "the paper's pipeline holds the cuboid: no contact lost (share of the episodes)",
        _STEADY,
        "contact_always_mean >= 1",
    ),
)


def given_claims(name: str) -> list[Claim]:
    """Return the claims about a start of a user."""
    flow = f"start == '{name}' and {FLOW}"
    basis = f"{_BALL} and {_PAPER} and {FLOW}"
    return [
        Claim.of(
            f"{name}: cases without a start, all sets",
            f"{flow} and not case.str.startswith('hold_')",
            "iterations_missing <= 0",
        ),
        Claim.of(
            f"{name}: median of the flow's iterations over that of the 12-basis, held-out ball",
            f"{_BALL} and {flow}",
            "iterations_median <= 1",
            basis,
        ),
        Claim.of(
            f"{name}: median time over that of the 12-basis, held-out ball",
            f"{_BALL} and {flow}",
            "microseconds_median <= 1",
            basis,
        ),
        Claim.of(
            f"{name}: share of the starts that were replaced, held-out ball",
            f"{_BALL} and {flow}",
            "start_replaced_mean <= 0",
        ),
    ]


def colours(starts: list[str]) -> dict[str, str]:
    """Return the colour of every start; those of a user get the reserved colours in turn."""
    colours = {key: start_info(key).colour for key in starts}
    users = [key for key in starts if key not in STARTS]
    return colours | dict(zip(users, cycle(GIVEN_COLOURS), strict=False))


def shown(means: Rows) -> list[str]:
    """Return the starts that charts show: the main ones of the ball, in the order of the table."""
    if "start" not in means.columns:
        return []
    return [key for key in chosen(means, f"{_BALL} and {FLOW}")["start"] if start_info(key).main]


def pair(row: Any, column: str) -> str:
    """Return median / p99 of a column as text; a dash if one is missing.

    Example:
        >>> pair({"iterations_median": 42.0, "iterations_p99": 5001.0}, "iterations")
        '42 / > 5000'
    """
    values = [row.get(f"{column}_{name}", np.nan) for name in ("median", "p99")]
    if not all(isinstance(value, (int, float)) and np.isfinite(value) for value in values):
        return "–"
    limit = ITERATION_LIMIT if column == "iterations" else np.inf
    return " / ".join(f"> {limit}" if value > limit else number(value) for value in values)


def bars(column: str, label: str) -> Any:
    """Return a chart of medians (dots) to p99 (whisker ends) per start, flow above Newton."""

    def draw(rows: Rows, means: Rows) -> Figure | None:
        keys = shown(means)
        if not keys or f"{column}_median" not in means.columns:
            return None
        figure, panel = axes(0.62 + 0.5 * len(keys))
        colour_of = colours(keys)
        ends = [1.0]
        for row_number, key in enumerate(keys):
            for method, name, offset, marker, width in (
                ("reduced_flow", "flow", -0.2, "o", 2.6),
                ("newton", "Newton", 0.2, "D", 1.1),
            ):
                mine = chosen(means, f"{_BALL} and start == '{key}' and method == '{method}'")
                if mine.empty or not np.isfinite(numbers(mine, f"{column}_median")[0]):
                    continue
                row = mine.iloc[0].to_dict()
                low = float(row[f"{column}_median"])
                high = float(row[f"{column}_p99"])
                ends.append(high)
                y = row_number + offset
                colour = colour_of[key]
                panel.plot([low, high], [y, y], color=colour, linewidth=width)
                panel.plot([high], [y], marker="|", markersize=7, color=colour)
                panel.plot([low], [y], marker=marker, markersize=5, color=colour)
                style = {"textcoords": "offset points", "va": "center", "fontsize": 8.5}
                panel.annotate(f"{name} {pair(row, column)}", (high, y), (6, 0), **style)
        panel.set_xscale("symlog", linthresh=1.0, linscale=0.5)
        panel.set_xlim(-0.05, (max(ends) + 2.0) ** 1.6)
        ticks = [0.0, *(10.0**k for k in range(int(np.log10(max(ends) + 2.0)) + 1))]
        panel.set_xticks(ticks, [small(tick) for tick in ticks])
        panel.minorticks_off()
        panel.set(xlabel=label, ylim=(len(keys) - 0.4, -0.6))
        panel.set_yticks(range(len(keys)), [start_info(key).short for key in keys])
        panel.grid(visible=False, axis="y")
        return figure

    return draw


def network_figure(rows: Rows, means: Rows) -> Figure | None:
    """Draw the share of the ball solved against steps of the flow, for network and 12-basis."""
    figure, panel = axes(2.8)
    for key in (BASIS, "basis_tangent", "network", "network_newton_1"):
        steps = numbers(chosen(rows, f"{_BALL} and start == '{key}' and {FLOW}"), "iterations")
        if not len(steps):
            continue
        done = np.sort(np.where(np.isfinite(steps), steps, ITERATION_LIMIT + 1))
        share = np.arange(1, len(done) + 1) / len(done)
        info = start_info(key)
        look = {"linestyle": "--" if "Newton" in info.short else "-", "color": info.colour}
        panel.step(1 + done, share, where="post", label=info.short, **look)
    if not panel.lines:
        return None
    _style_shares(panel, "1 + accepted steps of the flow", 1000)
    legend_above(figure)
    return figure


def _style_shares(panel: Any, label: str, last: int) -> None:
    panel.set(xscale="log", xlabel=label, ylabel="share of the problems", ylim=(0, 1.02))
    ticks = [tick for tick in (1, 10, 100, 1000) if tick <= last]
    panel.set_xticks(ticks, [str(tick) for tick in ticks])


def profile(query: str, column: str, across: str, by: str = "start") -> Any:
    """Return a performance profile: share solved within a factor of the best start."""

    def draw(rows: Rows, means: Rows) -> Figure | None:
        keys = shown(means)
        solves: Rows = chosen(rows, query)
        solves = solves[solves["start"].isin(keys)]
        solves = solves[solves[column].notna()] if column == "microseconds" else solves
        if solves.empty or column not in solves.columns or solves[column].isna().all():
            return None
        counted = column == "iterations"
        # plus one, so that the ratio to a start without steps is finite
        values = numbers(solves, column) + counted
        values[(values > ITERATION_LIMIT + 1) & counted] = np.nan
        name = solves["start"] + (" · " + solves["method"] if by == "both" else "")
        grid: Rows = solves.assign(value=values, name=name).pivot(
            index=["case", "problem"], columns="name", values="value"
        )
        ratio = grid.div(grid.min(axis=1), axis=0).to_numpy()
        figure, panel = axes(3.1)
        factor = np.geomspace(1.0, 100.0, 120)
        colour_of = colours(keys)
        for name, ratios in zip(grid.columns, ratio.T, strict=True):
            key, _, method = str(name).partition(" · ")
            share = [(ratios <= tau * (1 + 1e-12)).mean() for tau in factor]
            style = "--" if start_info(key).dashed else ":" if method == "newton" else "-"
            label = start_info(key).short + (" · Newton" if method == "newton" else "")
            panel.plot(factor, share, style, color=colour_of[key], label=label)
        _style_shares(panel, across, 100)
        panel.set_xlim(1, 100)
        legend_above(figure)
        return figure

    return draw


_SOLVED = {name: cases for name, cases in SETS.items() if cases.solved}
_FIXED = [name for name, cases in _SOLVED.items() if cases.fixed and cases.share > 0]
_OTHER = [name for name, cases in _SOLVED.items() if not cases.fixed]
FIGURES = (
    (
        "Iterations",
        f"Dot: median, whisker: p99. Cases: {SETS['ball'].label}, to a gap of {small(TOLERANCE)}.",
        bars("iterations", "iterations"),
    ),
    (
        "Microseconds",
        "The whole call from Python to a certified gap of 1e-4, best of the repeats, on wrenches of the ball.",
        bars("microseconds", "microseconds of the whole call"),
    ),
    (
        "The network alone against the paper's 12-basis",
        "Share of the held-out ball solved within a number of steps; dashed: after one Newton step.",
        network_figure,
    ),
    (
        "Performance profile, iterations, fixed grasp",
        "The flow on all sets of the fixed grasp; starts that do not apply or fail count as not solved.",
        profile(
            f"case in {_FIXED} and {FLOW}",
            "iterations",
            "1 + iterations over those of the best start",
        ),
    ),
    (
        "Performance profile, iterations, other contacts",
        "The flow on random grasps and on contacts recorded from the hand.",
        profile(
            f"case in {_OTHER} and {FLOW}",
            "iterations",
            "1 + iterations over those of the best start",
        ),
    ),
    (
        "Performance profile, time",
        "Whole calls on the ball, starts and both methods.",
        profile(_BALL, "microseconds", "time over that of the fastest", "both"),
    ),
    (
        "Hold rates",
        "Episodes of the simulated hand that were held, with 95 % intervals.",
        rates_figure,
    ),
)


def hardest_sets(rows: Rows, means: Rows) -> Rows:
    """Make a table of the flow's iterations per set and start, hardest set first."""
    flow = chosen(means, f"{FLOW} and case in {list(SETS)}")
    if flow.empty:
        return flow
    flow = flow.assign(text=[pair(row, "iterations") for row in flow.to_dict("records")])
    main = flow[flow["start"].isin(shown(means))]
    grid = main.pivot(index="case", columns="start", values="text").fillna("–")
    basis = flow[flow["start"] == BASIS].set_index("case")["iterations_p99"]
    grid = grid.reindex(
        index=basis.sort_values(ascending=False).index,
        columns=[key for key in shown(means) if key in grid.columns],
    )
    grid.insert(0, "cases", [SETS[case].label for case in grid.index])
    names = {key: start_info(key).short for key in grid.columns if key != "cases"}
    return grid.rename(columns=names).reset_index(drop=True)


def hardest_problems(rows: Rows, means: Rows) -> Rows:
    """Make a table of the problems on which a main start takes the most iterations."""
    columns = ["case", "problem", "seed", "start", "status", "iterations", "start_gap"]
    solves: Rows = chosen(rows, f"{FLOW} and case in {list(SETS)}")
    solves = solves[solves["start"].isin(shown(means))]
    if solves.empty:
        return solves
    order = solves["iterations"].fillna(ITERATION_LIMIT + 2).astype(float)
    worst = solves.assign(order=order).sort_values("order", ascending=False, kind="stable")
    worst = worst.drop_duplicates(["case", "problem"]).groupby("case", sort=False).head(2)
    return worst.head(12)[columns]


def learned_steps(rows: Rows, means: Rows) -> Rows:
    """Make a table of network and 12-basis, friction varied; for Newton also its own start."""
    by = _by_start(means, _VARIED)
    table = [
        {
            "start": start_info(alone).short,
            "method": label,
            "start gap": pair(by.get((alone, "reduced_flow"), {}), "start_gap"),
            "iterations": pair(by.get((alone, method), {}), "iterations"),
            "compiled call, us": pair(by.get((timed, method), {}), "compiled_microseconds"),
            "from Python, us": pair(by.get((timed, method), {}), "microseconds"),
        }
        for label, method, alone, timed in (
            ("flow", "reduced_flow", BASIS, BASIS),
            ("flow", "reduced_flow", "network", "learned_fixed"),
            ("Newton", "newton", "internal_force", "internal_force"),
            ("Newton", "newton", BASIS, BASIS),
            ("Newton", "newton", "network", "learned_fixed"),
        )
    ]
    return pd.DataFrame(table if (BASIS, "reduced_flow") in by else [])


def newton_first(rows: Rows, means: Rows) -> Rows:
    """Make a table of the flow's iterations after zero, one and two Newton steps."""
    ball = {row["start"]: row for row in chosen(means, f"{_BALL} and {FLOW}").to_dict("records")}
    table = [
        {
            "plain Newton steps first": steps,
            "12-basis": pair(ball.get(a, {}), "iterations"),
            "its gap": pair(ball.get(a, {}), "start_gap"),
            "network": pair(ball.get(b, {}), "iterations"),
            "gap of the network": pair(ball.get(b, {}), "start_gap"),
        }
        for steps, (a, b) in enumerate(
            (
                (BASIS, "network"),
                ("basis_tangent", "network_newton_1"),
                ("basis_newton_2", "network_newton_2"),
            )
        )
    ]
    return pd.DataFrame(table if BASIS in ball else [])


def _by_start(means: Rows, query: str) -> dict[tuple[str, str], dict[str, Any]]:
    return {(row["start"], row["method"]): row for row in chosen(means, query).to_dict("records")}


def all_starts(rows: Rows, means: Rows) -> Rows:
    """Make a table of every start on the ball."""
    by = _by_start(means, _BALL)
    table = []
    for key in dict.fromkeys(start for start, _ in by):
        flow = by.get((key, "reduced_flow"), {})
        newton = by.get((key, "newton"), {})
        table.append(
            {
                "start": start_info(key).label,
                "no start": flow.get("iterations_missing"),
                "replaced": flow.get("start_replaced_sum"),
                "start gap": pair(flow, "start_gap"),
                "flow": pair(flow, "iterations"),
                "Newton": pair(newton, "iterations"),
                "start alone, us": pair(flow, "start_microseconds"),
                "flow, us": pair(flow, "microseconds"),
                "Newton, us": pair(newton, "microseconds"),
            }
        )
    return pd.DataFrame(table)


def failures(rows: Rows, means: Rows) -> Rows:
    """Count the failures of starts by case and reason."""
    failed: Rows = chosen(
        rows, "status in ['no_start', 'stalled', 'iteration_limit'] or held == False"
    )
    if failed.empty:
        return failed
    status = failed["status"]
    failed = failed.assign(
        why=failed["reason"].fillna(failed.get("failure", status)).fillna(status)
    )
    keys = ["case", "start", "method", "why"]
    counts = failed.groupby(keys, dropna=False, sort=False).size().reset_index(name="count")
    return counts.sort_values("count", ascending=False)


TABLES = (
    (
        "The hardest sets first",
        "Iterations of the flow, median / p99. A dash: the start does not apply.",
        hardest_sets,
    ),
    (
        "The hardest problems",
        "The main start that needs the most iterations of the flow on each; case, problem and seed reproduce it.",
        hardest_problems,
    ),
    (
        "The network alone against the paper's 12-basis",
        f"{SETS['ball_frictions'].label}, held out; median / p99. Times are those of the network with its repair.",
        learned_steps,
    ),
    (
        "After Newton steps",
        "Iterations of the flow and gap of the start on the held-out ball, median / p99.",
        newton_first,
    ),
    ("Every start on the ball", "Iterations and microseconds, median / p99.", all_starts),
    ("Hold rates", "Episodes held, and the mean of the measured normal force.", grid),
    ("Failures", "Cases without a start, without an answer, or not held.", failures),
)

"""The study behind `grasp reproduce`: compute, figures, one page. A folder that needs nothing else to be read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from grasp_env.force import Objective
from grasp_env.grasp import presets
from grasp_env.grasp.wrench import FORCE_RADIUS, MOMENT_RADIUS, PAPER_CONSTANT, sample_ball
from training.cases.starts import make_starts
from training.report.page import Picture, Section, Table, png, provenance_section, write_page
from training.report.style import new_figure
from training.runs import Run, default_name, provenance
from training.runs.words import number, small
from training.runs.workers import progress as bar_of
from training.study import study
from training.trials.compare import cases_of, compare
from training.trials.metrics import table_one

COLOURS = ("#8a8a8a", "#c08a3e", "#1f5fa8", "#7fb2e5", "#7a4fa3", "#8fc98f", "#2e8b57", "#b3261e")
METHOD_LABELS = {"phi": "Phi, lambda 0.01", "conic": "exact cones", "linear": "linear program, 8 facets"}


def reproduce(out: Path, quick: bool = False, progress: bool = True) -> dict[str, Any]:
    """Computes the study into `<out>/reproduce-<date>-<time>` and returns its metrics.

    Args:
        out: folder of runs.
        quick: few wrenches and repetitions; the report says so.
        progress: show a progress bar.

    Raises:
        InvalidInputError: the folder cannot be written.
    """
    run = Run.create(out, default_name("reproduce"))
    grasp, count = presets.paper_cuboid(), 20 if quick else 200
    wrenches = sample_ball(np.random.default_rng([0, 101]), count)
    with bar_of(Console(stderr=True, quiet=not progress)) as bar:

        def task(name: str, total: int) -> Callable[[], None]:
            number_of_task = bar.add_task(name, total=total)
            return lambda: bar.advance(number_of_task)

        weights = study.weights_study(grasp, wrenches, task("weights and step rules", study.ROWS))
        times = study.rule_times(grasp, wrenches)
        rates = study.rate_study(grasp, np.array(PAPER_CONSTANT))
        named = {name: presets.preset(name) for name in ("tripod", "paper_cuboid", "five_finger_cuboid")}
        costs = study.cost_study(named, 9 if quick else 41)
        tick, fine = task("forces along W_ext(t)", 6), 0.005 if quick else 0.001
        paths = {name: study.path_study(named[name], fine, tick) for name in ("paper_cuboid", "five_finger_cuboid")}
        table = _table_one()
    metrics = {
        "run": provenance(),
        "quick": quick,
        "wrenches": count,
        "weights": weights,
        "times": times,
        "rates": {key: value for key, value in rates.items() if key != "gaps"},
        "costs": costs,
        "paths": {
            name: {key: value for key, value in path.items() if key not in ("time", "forces")}
            for name, path in paths.items()
        },
        "table_one": table,
        "folder": str(run.folder),
    }
    run.write_arrays("gaps.npz", rates["gaps"])
    for name, path in paths.items():
        run.write_arrays(f"path_{name}.npz", {"time": path["time"], **path["forces"]})
    figures = {
        "weights": (weights_figure(weights), "Iterations, and force above the least, against lambda"),
        "rates": (rates_figure(rates), "Convergence of every step rule"),
        "costs": (costs_figure(costs), "Time against multiplications"),
        **{
            f"path_{name}": (path_figure(path), f"Normal forces along W_ext(t), {name}") for name, path in paths.items()
        },
    }
    pictures = {name: png(run, f"figures/{name}.png", figure, title, "") for name, (figure, title) in figures.items()}
    run.write_json("metrics.json", metrics)
    write_page(run, "What the paper leaves open", quick, sections(metrics, pictures))
    run.write_json("run.json", {**metrics["run"], "quick": quick})
    return metrics


def _table_one() -> dict[str, Any]:
    """Table I as `grasp evaluate` makes it, without learned starts."""
    phi = Objective()
    return table_one(compare("constant", cases_of("constant", 1, 0), make_starts(phi, {}), {}, phi))


def weights_figure(rows: list[dict[str, Any]]) -> Figure:
    """Iterations per rule and force excess against lambda, omega = 1."""
    rows = [row for row in rows if row["omega"] == 1.0]
    lambdas = [row["lambda"] for row in rows]
    figure, (left, right) = new_figure(10.5, 4.2, columns=2)
    for (key, label), colour in zip(study.RULE_LABELS.items(), COLOURS, strict=True):
        medians = [row["rules"][key]["iterations"]["median"] for row in rows]
        left.plot(lambdas, medians, color=colour, marker="o", markersize=3, label=label)
    left.set(
        xscale="log", yscale="log", xlabel="lambda [N$^2$], omega = 1", ylabel="iterations to a gap of 1e-4, median"
    )
    left.legend(fontsize=8, frameon=False)
    for name, style in (("median", "-"), ("p95", "--"), ("max", ":")):
        right.plot(lambdas, [100 * row["excess"][name] for row in rows], style, color=COLOURS[2], label=name)
    right.set(xscale="log", yscale="log", xlabel="lambda [N$^2$], omega = 1")
    right.set_ylabel("normal force above the exact minimum [%]")
    right.legend(fontsize=8, frameon=False)
    return figure


def rates_figure(rates: dict[str, Any]) -> Figure:
    """Gap against iterations per rule, with the predicted rate."""
    figure, axes = new_figure(8.0, 4.4)
    longest = 0
    for (key, label), colour in zip(study.RULE_LABELS.items(), COLOURS, strict=True):
        gaps = rates["gaps"][key]
        label = "fixed, 2 / (L + m)" if key == "fixed" else label
        axes.semilogy(np.arange(len(gaps)), np.maximum(gaps, 1e-12), color=colour, label=label)
        longest = max(longest, len(gaps)) if key == "exact" else longest
    steps = np.arange(longest)
    predicted = rates["rates"]["exact"]["predicted"]
    axes.semilogy(steps, 0.3 * predicted**steps, "k:", label="$((\\kappa - 1)/(\\kappa + 1))^{2k}$")
    axes.set(xlim=(0, 1.3 * longest), ylim=(1e-11, None), xlabel="iteration", ylabel="(Phi - min Phi) / min Phi")
    axes.legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def costs_figure(rows: list[dict[str, Any]]) -> Figure:
    """Measured time against counted multiplications of every form."""
    figure, panels = new_figure(10.5, 4.2, columns=2)
    marks = {3: "v", 4: "o", 5: "s"}
    for panel, column in zip(panels, ("product_ns", "iteration_ns"), strict=True):
        for form, colour in zip(study.FORMS, (COLOURS[0], COLOURS[1], COLOURS[2]), strict=True):
            for row in (row for row in rows if row["form"] == form):
                label = form if row["contacts"] == 4 and column == "product_ns" else None
                panel.plot(row["operations"], row[column], marks[row["contacts"]], color=colour, label=label)
        panel.set(xscale="log", yscale="log", xlabel="multiplications of the product step, counted", ylim=(5, None))
    panels[0].set_ylabel("product step, measured [ns]")
    panels[1].set_ylabel("whole iteration, measured [ns]")
    panels[0].legend(fontsize=8, frameon=False)
    panels[1].annotate("contacts: triangle 3, circle 4, square 5", (0.02, 0.95), xycoords="axes fraction", fontsize=8)
    return figure


def path_figure(path: dict[str, Any]) -> Figure:
    """Normal forces of every finger along W_ext(t): linear program, exact cones, Phi."""
    count = path["forces"]["phi"].shape[1]
    rows = (count + 1) // 2
    figure, grid = new_figure(8.4, 2.4 * rows + 0.8, rows, 2)
    panels = list(np.ravel(grid))
    styles = {"conic": ("-", "black", 2.2), "phi": ("-", COLOURS[3], 1.1), "linear": ("--", COLOURS[7], 1.1)}
    for finger, panel in enumerate(panels[:count]):
        for key, (style, colour, width) in styles.items():
            force = path["forces"][key][:, finger, 0]
            panel.plot(path["time"], force, style, color=colour, linewidth=width, label=METHOD_LABELS[key])
        panel.set_title("thumb" if finger == 0 else f"finger {finger}", fontsize=9)
        panel.set(xlabel="time [s]", ylabel="normal force [N]")
    for panel in panels[count:]:
        panel.set_visible(False)
    handles, names = panels[0].get_legend_handles_labels()
    figure.legend(handles, names, fontsize=8, frameon=False, loc="outside upper center", ncols=3)
    return figure


def sections(metrics: dict[str, Any], pictures: dict[str, Picture]) -> list[Section]:
    """The report, of what `reproduce` saves."""
    notes = (
        "The paper prints neither omega and lambda of Phi = omega tr P + lambda tr P^-1 nor the step size. Here: "
        f"{metrics['wrenches']} held-out wrenches (force up to {FORCE_RADIUS:g} N, moment up to {MOMENT_RADIUS:g} N m), the reference "
        f"grasp, every flow from the 12-basis to a relative gap of {small(study.TOLERANCE)}. Iterations: median (p95).",
        "Excess: total normal force at the optimum of Phi above the least one of the exact cones (conic interior point). Only lambda / "
        "omega matters: omega scales Phi, the iterates are the same in steps of 1 / omega. A larger lambda / omega buys distance from "
        "the cones with squeeze, and well-conditioned steps with it. 'Fixed, tuned' is the longest constant step that is never halved "
        "on twenty of the wrenches: knowledge that no controller has.",
    )
    weights = Table(
        "Weights and step rules", ("omega", "lambda [N^2]", "excess force, median (p95)", *study.RULE_LABELS.values()),
        [
            [number(row["omega"]), number(row["lambda"]), f"{percent_of(row['excess'], 'median')} ({percent_of(row['excess'], 'p95')})",
             *(_steps(row["rules"][key]) for key in study.RULE_LABELS)]
            for row in metrics["weights"]
        ], words=0,
    )  # fmt: skip
    times = Table(
        f"Microseconds of one compiled call, 12-basis to a certified gap of {small(study.TOLERANCE)}, lambda {study.LAMBDA:g}",
        ("rule", "median", "p95", "p99"),
        [
            [study.RULE_LABELS[key], *(number(row[part]) for part in ("median", "p95", "p99"))]
            for key, row in metrics["times"].items()
        ],
    )
    return [
        Section("weights", "Weights and step rules", notes, [weights, pictures["weights"], times]),
        _rates(metrics["rates"], pictures["rates"]),
        _costs(metrics["costs"], pictures["costs"]),
        _paper(metrics["table_one"]),
        _paths(metrics["paths"], pictures),
        provenance_section(metrics["run"]),
    ]


def _rates(rates: dict[str, Any], picture: Picture) -> Section:
    forms = ", ".join(f"{form} {difference:.0e}" for form, difference in rates["forms"].items())
    notes = (
        f"The paper's constant wrench, lambda {study.LAMBDA:g}. On ker G, in the metric of P, the Hessian of Phi at the optimum has "
        f"eigenvalues {number(rates['least_eigenvalue'])} to {number(rates['largest_eigenvalue'])}: condition number "
        f"{number(rates['condition'])}. Factor of the gap per iteration, fitted between 1e-3 and 1e-9; predicted (1 - alpha m)^2 for "
        f"the constant step alpha = {number(rates['fixed_step'])} = 2 / (L + m), at worst ((kappa - 1) / (kappa + 1))^2 for the exact "
        "line search.",
        f"Forms of the flow, largest relative difference of Phi over 40 adaptive iterations (rounding): {forms}.",
    )
    rows = [
        [
            "fixed, 2 / (L + m)" if key == "fixed" else study.RULE_LABELS[key],
            number(row["fitted"]),
            number(row["predicted"]),
        ]
        for key, row in rates["rates"].items()
    ]
    return Section("rates", "Exponential rate", notes, [Table("Rates", ("rule", "fitted", "predicted"), rows), picture])


def _costs(costs: list[dict[str, Any]], picture: Picture) -> Section:
    rows = [
        [
            row["form"],
            str(row["contacts"]),
            str(row["operations"]),
            *(number(row[part]) for part in ("product_ns", "speed_up", "iteration_ns")),
        ]
        for row in costs
    ]
    columns = ("form", "contacts", "multiplications", "product step [ns]", "times faster than full", "iteration [ns]")
    note = (
        "All forms compiled with the same options, medians of calls that take turns; the dense full flow is bound by memory, the "
        "small ones by latency, so times differ less than counts."
    )
    return Section(
        "costs", "Operation counts and time", (note,), [Table("Counted and measured", columns, rows), picture]
    )


def _paper(table: dict[str, Any]) -> Section:
    rows = []
    for key, row in table["rows"].items():
        paper = row["paper"]
        normals = [f"{ours:.2f} ({theirs})" for ours, theirs in zip(row["normals"], paper["normals"], strict=True)]
        sums = [f"{row[part]:.2f} ({paper[part]})" for part in ("sum", "balance")]
        rows.append([key.replace("_", " "), *normals, *sums, f"{number(row['steps'])} ({number(paper['steps'])})"])
    columns = ("start", "1", "2", "3", "4", "sum", "1 - (2 + 3 + 4)", "steps")
    caption = f"Normal forces in N for w = {table['wrench']}, lambda {study.LAMBDA:g}; the paper's in brackets"
    note = (
        "No acceptance test: contact positions, weights, step size and two of the three starts are not printed. What can be compared "
        "is the balance 0.6, the order of the starts, and ratios."
    )
    return Section("paper", "The constant wrench, beside the paper's Table I", (note,), [Table(caption, columns, rows)])


def _paths(paths: dict[str, Any], pictures: dict[str, Picture]) -> Section:
    first = next(iter(paths.values()))
    coarse, fine = 1e3 * first["coarse"], 1e3 * first["fine"]
    columns = (
        "grasp", "method", "excess force, median (max)", f"largest change in {coarse:g} ms [N]", f"in {fine:g} ms",
        f"change of rate, {coarse:g} ms [N/s]", f"{fine:g} ms",
    )  # fmt: skip
    rows = [
        [name.replace("_", " "), METHOD_LABELS[key],
         f"{100 * max(0.0, row['excess']['median']):.2f} % ({100 * row['excess']['max']:.2f} %)",
         *(number(value) for value in (*row["jump"], *row["kink"]))]
        for name, path in paths.items() for key, row in path["methods"].items()
    ]  # fmt: skip
    note = (
        "A change that is ten times less between samples ten times closer is continuous, one that stays or falls less is a jump; a "
        "change of rate that stays or grows is a kink. Where the least force is not unique (five fingers) the exact minimum may jump "
        "too; the optimum of Phi is unique and smooth."
    )
    title = "Linear program beside the continuous forces, along W_ext(t)"
    return Section(
        "paths", title, (note,), [Table(title, columns, rows, words=2), *(pictures[f"path_{name}"] for name in paths)]
    )


def percent_of(row: dict[str, Any], part: str) -> str:
    """A share of a summary in percent."""
    return f"{100 * row[part]:.1f} %"


def _steps(row: dict[str, Any]) -> str:
    steps, missing = row["iterations"], row["not_converged"]
    return f"{number(steps['median'])} ({number(steps['p95'])})" + (f", {missing} not done" if missing else "")

"""The study behind `grasp reproduce`: compute, figures, one page. A folder that needs nothing else to be read."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import Progress

from grasp_env.force import Objective
from grasp_env.grasp import presets
from grasp_env.grasp.wrench import PAPER_CONSTANT, sample_ball
from training.cases.starts import make_starts
from training.runs import Run, default_name, provenance
from training.runs.words import number
from training.study import study
from training.trials.compare import cases_of, compare
from training.trials.metrics import table_one

COLOURS = ("#8a8a8a", "#c08a3e", "#1f5fa8", "#7fb2e5", "#7a4fa3", "#8fc98f", "#2e8b57", "#b3261e")
METHOD_LABELS = {
    "phi": "Phi, lambda 0.01",
    "conic": "exact cones",
    "linear": "linear program, 8 facets",
}


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
    with _progress(progress) as task:
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
        "weights.png": weights_figure(weights),
        "rates.png": rates_figure(rates),
        "costs.png": costs_figure(costs),
        **{f"path_{name}.png": path_figure(path) for name, path in paths.items()},
    }
    for name, figure in figures.items():
        run.write(f"figures/{name}", lambda file, figure=figure: figure.savefig(file, format="png", dpi=130))
        plt.close(figure)
    run.write_json("metrics.json", metrics)
    run.write_text("report.md", "\n".join(report(metrics)) + "\n")
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
    figure, (left, right) = _panels(2, 10.5, 4.2)
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
    figure, (axes,) = _panels(1, 8.0, 4.4)
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
    figure, panels = _panels(2, 10.5, 4.2)
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
    figure, panels = _panels(2 * ((count + 1) // 2), 8.4, 2.4 * ((count + 1) // 2) + 0.8, columns=2)
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


def report(metrics: dict[str, Any]) -> Iterator[str]:
    """The lines of report.md."""
    run, rates = metrics["run"], metrics["rates"]
    yield "# What the paper leaves open\n"
    if metrics["quick"]:
        yield "**QUICK RUN: few wrenches and repetitions. Do not quote.**\n"
    yield f"{run['machine']['processor']}, {run['machine']['cores']} cores; commit {run['commit']}; {run['time']}.\n"
    yield (
        "The paper prints neither omega and lambda of Phi = omega tr P + lambda tr P^-1 nor the step size. Here: "
        f"{metrics['wrenches']} held-out wrenches (force up to 2 N, moment up to 0.05 N m), the reference grasp, every "
        "flow from the 12-basis to a relative gap of 1e-4. Iterations: median (p95).\n"
    )
    yield "## Weights and step rules\n"
    yield from _table(
        ["omega", "lambda [N^2]", "excess force, median (p95)", *study.RULE_LABELS.values()],
        (
            [
                number(row["omega"]),
                number(row["lambda"]),
                f"{100 * row['excess']['median']:.1f} % ({100 * row['excess']['p95']:.1f} %)",
                *(_steps(row["rules"][key]) for key in study.RULE_LABELS),
            ]
            for row in metrics["weights"]
        ),
    )
    yield (
        "\nExcess: total normal force at the optimum of Phi above the least one of the exact cones (conic interior point). "
        "Only lambda / omega matters: omega scales Phi, the iterates are the same in steps of 1 / omega. A larger lambda / omega "
        "buys distance from the cones with squeeze, and well-conditioned steps with it. 'Fixed, tuned' is the longest constant "
        "step that is never halved on twenty of the wrenches: knowledge that no controller has.\n"
    )
    yield "![Weights](figures/weights.png)\n"
    yield "Microseconds of one compiled call, 12-basis to a certified gap of 1e-4, lambda 0.01:\n"
    yield from _table(
        ["rule", "median", "p95", "p99"],
        (
            [study.RULE_LABELS[key], number(row["median"]), number(row["p95"]), number(row["p99"])]
            for key, row in metrics["times"].items()
        ),
    )
    yield "\n## Exponential rate\n"
    yield (
        f"The paper's constant wrench, lambda 0.01. On ker G, in the metric of P, the Hessian of Phi at the optimum has "
        f"eigenvalues {number(rates['least_eigenvalue'])} to {number(rates['largest_eigenvalue'])}: condition number "
        f"{number(rates['condition'])}. Factor of the gap per iteration, fitted between 1e-3 and 1e-9; predicted "
        f"(1 - alpha m)^2 for the constant step alpha = {number(rates['fixed_step'])} = 2 / (L + m), at worst "
        "((kappa - 1) / (kappa + 1))^2 for the exact line search.\n"
    )
    yield from _table(
        ["rule", "fitted", "predicted"],
        (
            [
                "fixed, 2 / (L + m)" if key == "fixed" else study.RULE_LABELS[key],
                number(row["fitted"]),
                number(row["predicted"]),
            ]
            for key, row in rates["rates"].items()
        ),
    )
    yield "\n![Rates](figures/rates.png)\n"
    yield "Forms of the flow, largest relative difference of Phi over 40 adaptive iterations (rounding): " + ", ".join(
        f"{form} {difference:.0e}" for form, difference in rates["forms"].items()
    )
    yield "\n## Operation counts and time\n"
    yield from _table(
        ["contacts", "form", "multiplications", "product step [ns]", "times faster than full", "iteration [ns]"],
        (
            [
                str(row["contacts"]),
                row["form"],
                str(row["operations"]),
                number(row["product_ns"]),
                number(row["speed_up"]),
                number(row["iteration_ns"]),
            ]
            for row in metrics["costs"]
        ),
    )
    yield (
        "\nAll forms compiled with the same options, medians of calls that take turns; the dense full flow is bound by "
        "memory, the small ones by latency, so times differ less than counts.\n"
    )
    yield "![Costs](figures/costs.png)\n"
    yield from _table_one_lines(metrics["table_one"])
    yield from _path_lines(metrics["paths"])


def _table_one_lines(table: dict[str, Any]) -> Iterator[str]:
    yield "## The constant wrench, beside the paper's Table I\n"
    yield f"Normal forces in N for w = {table['wrench']}, lambda 0.01; paper's numbers in brackets.\n"
    yield from _table(
        ["start", "1", "2", "3", "4", "sum", "1 - (2 + 3 + 4)", "steps"],
        (
            [
                key.replace("_", " "),
                *(
                    f"{ours:.2f} ({theirs})"
                    for ours, theirs in zip(row["normals"], row["paper"]["normals"], strict=True)
                ),
                f"{row['sum']:.2f} ({row['paper']['sum']})",
                f"{row['balance']:.2f} ({row['paper']['balance']})",
                f"{number(row['steps'])} ({number(row['paper']['steps'])})",
            ]
            for key, row in table["rows"].items()
        ),
    )
    yield (
        "\nNo acceptance test: contact positions, weights, step size and two of the three starts are not printed. What can be "
        "compared is the balance 0.6, the order of the starts, and ratios.\n"
    )


def _path_lines(paths: dict[str, Any]) -> Iterator[str]:
    yield "## Linear program beside the continuous forces, along W_ext(t)\n"
    first = next(iter(paths.values()))
    coarse, fine = 1e3 * first["coarse"], 1e3 * first["fine"]
    yield from _table(
        [
            "grasp",
            "method",
            "excess force, median (max)",
            f"largest change in {coarse:g} ms [N]",
            f"in {fine:g} ms",
            f"change of rate, {coarse:g} ms [N/s]",
            f"{fine:g} ms",
        ],
        (
            [
                name.replace("_", " "),
                METHOD_LABELS[key],
                f"{100 * max(0.0, row['excess']['median']):.2f} % ({100 * row['excess']['max']:.2f} %)",
                *(number(value) for value in (*row["jump"], *row["kink"])),
            ]
            for name, path in paths.items()
            for key, row in path["methods"].items()
        ),
    )
    yield (
        "\nA change that is ten times less between samples ten times closer is continuous, one that stays or falls less is a "
        "jump; a change of rate that stays or grows is a kink. Where the least force is not unique (five fingers) the exact "
        "minimum may jump too; the optimum of Phi is unique and smooth.\n"
    )
    yield from (f"![{name}](figures/path_{name}.png)" for name in paths)


def _steps(row: dict[str, Any]) -> str:
    steps, missing = row["iterations"], row["not_converged"]
    return f"{number(steps['median'])} ({number(steps['p95'])})" + (f", {missing} not done" if missing else "")


def _table(head: list[str], rows: Iterable[list[str]]) -> Iterator[str]:
    yield "| " + " | ".join(head) + " |"
    yield "|---" * len(head) + "|"
    for row in rows:
        yield "| " + " | ".join(row) + " |"


def _panels(count: int, width: float, height: float, columns: int | None = None) -> tuple[Figure, list[Any]]:
    columns = columns or count
    figure, axes = plt.subplots(count // columns, columns, figsize=(width, height), layout="constrained", squeeze=False)
    for axis in axes.ravel():
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(alpha=0.25)
    return figure, list(axes.ravel())


@contextmanager
def _progress(shown: bool) -> Iterator[Callable[[str, int], Callable[[], None]]]:
    with Progress(console=Console(stderr=True), disable=not shown) as bar:

        def task(name: str, total: int) -> Callable[[], None]:
            number_of_task = bar.add_task(name, total=total)
            return lambda: bar.advance(number_of_task)

        yield task

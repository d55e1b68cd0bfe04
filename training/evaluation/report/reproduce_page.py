"""Page of `grasp reproduce`, as data."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from training.evaluation.report.page import WIDTH, axes, decades, legend_above
from training.evaluation.results.claims import Claim
from training.evaluation.results.table import chosen, pd
from training.evaluation.results.words import number

RULES = {
    "fixed": "fixed, tuned",
    "armijo": "Armijo",
    "adaptive": "adaptive",
    "exact": "exact line search",
    "rough": "line search to a tenth",
    "bb_long": "Barzilai-Borwein, long",
    "bb_short": "Barzilai-Borwein, short",
    "bb_alternate": "Barzilai-Borwein, alternate",
}
COLOURS = ("#8a8a8a", "#c08a3e", "#1f5fa8", "#7fb2e5", "#7a4fa3", "#8fc98f", "#2e8b57", "#b3261e")
METHODS = {
    "conic": ("exact cones", "-", "black", 2.2),
    "phi": ("Phi, lambda 0.01", "-", COLOURS[3], 1.1),
    "linear": ("linear program, 8 facets", "--", COLOURS[7], 1.1),
}
"""Label, line style, colour and width of each method."""
PATHS = ("path_paper_cuboid", "path_five_finger_cuboid")
TITLE = "What the paper leaves open"
INTRO = (
    "The paper prints neither omega and lambda of Phi = omega tr P + lambda tr P^-1 nor the step size; this page varies them. Every "
    "flow runs from the 12-basis to a relative gap of 1e-4 on held-out wrenches on the reference grasp. The columns "
    "are defined at the end of this page."
)
CLAIMS = (
    Claim.of(
        "every step rule converges with all weights", "case == 'weights'", "iterations_missing <= 0"
    ),
    Claim.of(
        "all forms of the flow take the same iterates, up to rounding",
        "case == 'forms'",
        "form_difference_max <= 1e-10",
    ),
    Claim.of(
        "the paper's reduction is faster than the full flow",
        "case == 'costs_product' and form == 'paper'",
        "nanoseconds_median < 1",
        "case == 'costs_product' and form == 'full'",
    ),
    Claim.of(
        "the fewest products are faster than the paper's",
        "case == 'costs_product' and form == 'reduced'",
        "nanoseconds_median < 1",
        "case == 'costs_product' and form == 'paper'",
    ),
    Claim.of(
        "forces of Phi are continuous: between samples ten times closer they change a tenth",
        "method == 'phi' and interval < 0.007",
        "jump_max <= 0.12",
        "method == 'phi' and interval > 0.007",
    ),
)


def _some(rows: pd.DataFrame, query: str) -> Any:
    return chosen(rows, query).dropna(axis=1, how="all")


def weights_figure(rows: pd.DataFrame, summary: pd.DataFrame) -> Figure:
    """Draw the iterations of every rule against lambda, omega = 1."""
    figure, panel = axes(3.6)
    for (rule, label), colour in zip(RULES.items(), COLOURS, strict=True):
        mine = _some(summary, f"case == 'weights' and force_weight == 1 and rule == '{rule}'")
        look = {"color": colour, "markersize": 3, "label": label}
        panel.loglog(mine["barrier_weight"], mine["iterations_median"], "o-", **look)
    panel.set(xlabel="lambda [N^2], omega = 1", ylabel="iterations, median")
    decades(panel.xaxis, -3, 0)
    decades(panel.yaxis, 0, 3)
    legend_above(figure)
    return figure


def excess_figure(rows: pd.DataFrame, summary: pd.DataFrame) -> Figure:
    """Draw the excess of the normal force at the optimum of Phi over the least one, by lambda."""
    figure, panel = axes(2.8)
    excess = _some(summary, "case == 'weights' and force_weight == 1 and rule == 'fixed'")
    for name, style in (("median", "-"), ("p95", "--"), ("max", ":")):
        line = 100.0 * excess[f"force_excess_{name}"]
        panel.loglog(excess["barrier_weight"], line, style, color=COLOURS[2], label=name)
    panel.set(xlabel="lambda [N^2], omega = 1", ylabel="normal force above the least [%]")
    decades(panel.xaxis, -3, 0)
    decades(panel.yaxis, 1, 3)
    legend_above(figure, 3)
    return figure


def rates_figure(rows: pd.DataFrame, summary: pd.DataFrame) -> Figure:
    """Draw the gap of every rule, and the predicted rate of the exact line search."""
    figure, panel = axes(4.4)
    for (rule, label), colour in zip(RULES.items(), COLOURS, strict=True):
        mine = _some(rows, f"case == 'gaps' and rule == '{rule}'")
        label = "fixed, 2 / (L + m)" if rule == "fixed" else label
        panel.semilogy(mine["step"], np.maximum(mine["gap"], 1e-12), color=colour, label=label)
    exact = _some(rows, "case == 'rates' and rule == 'exact'").iloc[0]
    steps = np.arange(len(_some(rows, "case == 'gaps' and rule == 'exact'")))
    kappa = exact["eigenvalue_largest"] / exact["eigenvalue_least"]
    label = f"((κ - 1) / (κ + 1))^2k, κ = {number(kappa)}"
    panel.semilogy(steps, 0.3 * exact["rate_predicted"] ** steps, "k:", label=label)
    panel.set(
        xlim=(0, 1.3 * len(steps)),
        ylim=(1e-11, 2.0),
        xlabel="iteration k",
        ylabel="(Phi - min Phi) / min Phi",
    )
    decades(panel.yaxis, -10, 0, 2)
    figure.legend(fontsize=8, frameon=False, loc="outside lower center", ncols=2)
    return figure


def paths_figure(rows: pd.DataFrame, summary: pd.DataFrame) -> Figure:
    """Draw the normal forces of every finger along W_ext(t), one column per grasp."""
    figure = Figure(figsize=(WIDTH, 7.5), layout="constrained")
    coarse = _some(rows, "interval > 0.007")
    panels: Any = figure.subplots(5, 2)
    for column, case in zip(panels.T, PATHS, strict=True):
        for contact, panel in enumerate(column):
            mine = coarse[(coarse["case"] == case) & (coarse["contact"] == contact)]
            for method, (label, style, colour, width) in METHODS.items():
                line = mine[mine["method"] == method]
                look = {"color": colour, "linewidth": width, "label": label}
                panel.plot(line["time"], line["contact_force"], style, **look)
            panel.set_visible(not mine.empty)
            finger = f"finger {contact}" if contact else "thumb"
            panel.set_title(f"{case[5:].replace('_', ' ')}, {finger}", fontsize=8)
            panel.tick_params(labelsize=8)
    figure.supxlabel("time [s]", fontsize=9)
    figure.supylabel("normal force [N]", fontsize=9)
    legend_above(figure)
    return figure


def weights_table(rows: pd.DataFrame, summary: pd.DataFrame) -> pd.DataFrame:
    """Make a table of the force excess and of every rule's iterations, median (p95), by weights."""
    rules = _some(summary, "case == 'weights'")
    weights = ["force_weight", "barrier_weight"]
    pairs = zip(rules["iterations_median"], rules["iterations_p95"], strict=True)
    cells = [f"{number(median)} ({number(p95)})" for median, p95 in pairs]
    wide = rules.assign(cell=cells).pivot(index=weights, columns="rule", values="cell")[list(RULES)]
    excess = rules.groupby(weights)[["force_excess_median", "force_excess_p95"]].first()
    return excess.join(wide.rename(columns=RULES)).reset_index()


def rules_table(rows: pd.DataFrame, summary: pd.DataFrame) -> pd.DataFrame:
    """Make a table of the times of certified calls from the 12-basis, and of the rates."""
    times, rates = (_some(summary, f"case == '{case}'") for case in ("times", "rates"))
    times = chosen(times, "start == 'linear_combination'")
    columns = [f"microseconds_{name}" for name in ("median", "p90", "p99")]
    columns = ["rule", *columns, "rate_max", "rate_predicted_max"]
    return times.merge(rates, on="rule").replace({"rule": RULES})[columns]


def costs_table(rows: pd.DataFrame, summary: pd.DataFrame) -> pd.DataFrame:
    """Make a table of counted multiplications and measured nanoseconds, medians."""
    keys = ["form", "contacts"]
    product = _some(summary, "case == 'costs_product'")
    full = product[product["form"] == "full"].set_index("contacts")["nanoseconds_median"]
    product["times faster than full"] = (
        product["contacts"].map(full) / product["nanoseconds_median"]
    )
    columns = [*keys, "operations_max", "nanoseconds_median", "times faster than full"]
    iteration = _some(summary, "case == 'costs_iteration'")[[*keys, "nanoseconds_median"]]
    both = product[columns].merge(iteration, on=keys, suffixes=("", "_iteration"))
    return both.merge(_some(summary, "case == 'forms'")[["form", "form_difference_max"]], on="form")


def paper_table(rows: pd.DataFrame, summary: pd.DataFrame) -> pd.DataFrame:
    """Make a table of our normal forces and steps beside the paper's, on its constant wrench."""
    forces = _some(rows, "case in ('table_one', 'table_one_paper')")
    wide = forces.pivot(index=["start", "case"], columns="contact", values="contact_force")
    wide["sum"], wide["1 - (2 + 3 + 4)"] = wide.sum(axis=1), wide[0] - wide[1] - wide[2] - wide[3]
    wide["steps"] = forces.groupby(["start", "case"])["iterations"].first()
    wide = wide.loc[forces["start"].unique()].reset_index()
    wide = wide.rename(columns={k: f"{k + 1} [N]" for k in range(4)})
    return wide.replace({"case": {"table_one": "ours", "table_one_paper": "paper"}})


def paths_table(rows: pd.DataFrame, summary: pd.DataFrame) -> pd.DataFrame:
    """Make a table of the excess force, and of its changes between coarse and fine samples."""
    samples = _some(summary, "interval > 0")
    keys = ["case", "method"]
    wide = samples.pivot(index=keys, columns="interval", values=["jump_max", "kink_max"])
    heads = {"jump_max": "change in {:g} ms [N]", "kink_max": "change of rate in {:g} ms [N/s]"}
    wide.columns = [heads[name].format(1e3 * interval) for name, interval in wide.columns]
    excess = samples.groupby(keys)[["force_excess_median", "force_excess_max"]].first()
    labels = {key: label for key, (label, *_) in METHODS.items()}
    return excess.join(wide).reset_index().replace({"method": labels})


FIGURES = (
    (
        "Iterations",
        "From the 12-basis to a relative gap of 1e-4, by step rule, against lambda.",
        weights_figure,
    ),
    (
        "Squeeze",
        "Excess of the normal force at the optimum of Phi over the least one within the exact cones, against lambda.",
        excess_figure,
    ),
    (
        "Rates",
        "Convergence of every step rule on the paper's constant wrench, lambda 0.01.",
        rates_figure,
    ),
    ("Forces along W_ext(t)", "Normal forces of every finger, per grasp and method.", paths_figure),
)
TABLES = (
    (
        "Weights and step rules",
        "Iterations: median (p95). Excess: total normal force at the optimum of Phi above the least one within the "
        "exact cones. Only lambda / omega matters: omega scales Phi. 'Fixed, tuned' is the longest constant step that is never halved on "
        "twenty of the wrenches; no controller could know it.",
        weights_table,
    ),
    (
        "Step rules",
        "One compiled call, 12-basis to a certified gap of 1e-4, lambda 0.01; and the factor of the gap per "
        "iteration, fitted between 1e-3 and 1e-9. Predicted: (1 - alpha m)^2 for the constant step alpha = 2 / (L + m), at worst "
        "((kappa - 1) / (kappa + 1))^2 for the exact line search, with the Hessian's eigenvalues between m and L.",
        rules_table,
    ),
    (
        "Forms of the flow",
        "All forms are compiled with the same options; medians of calls that take turns. The dense full flow is bound "
        "by memory, the small ones by latency, so times differ less than counts. Difference: of Phi over 40 iterations.",
        costs_table,
    ),
    (
        "The constant wrench, beside the paper's Table I",
        "This is no acceptance test: the paper does not print contact positions, weights, "
        "step size and two of the three starts. The balance of 0.6 N, the order of the starts, and ratios can be compared.",
        paper_table,
    ),
    (
        "Linear program beside the continuous forces, along W_ext(t)",
        "If forces are continuous, their change is ten times smaller between "
        "samples ten times closer; if it stays or falls less, they jump. If the change of rate stays or grows, they have a kink. With five "
        "fingers the least force is not unique, and the exact minimum may jump too; the optimum of Phi is unique and smooth.",
        paths_table,
    ),
)

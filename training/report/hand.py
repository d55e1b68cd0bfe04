"""The hand and the paper in a report: Table I, forces along W_ext(t), and roll-outs."""

from __future__ import annotations

from typing import Any

from training.report.page import Columns, Fold, Picture, Section, Table, at, present, shown
from training.report.starts import label, steps
from training.runs.words import number
from training.trials.arrays import SCENARIO_LABELS


def paper_section(metrics: dict[str, Any], pictures: list[Picture]) -> Section:
    """The constant wrench beside Table I, and the path W_ext(t)."""
    table = metrics.get("table_one") or {}
    rows = []
    for key, row in (table.get("rows") or {}).items():
        paper = row["paper"]
        normals = [
            f"{value:.2f} ({printed:.2f})" for value, printed in zip(row["normals"], paper["normals"], strict=True)
        ]
        rows.append([
            label(key), *normals, f"{row['sum']:.2f} ({paper['sum']:.2f})", f"{row['balance']:.2f} ({paper['balance']:.2f})",
            f"{number(row['steps'])} ({number(paper['steps'])})",
        ])  # fmt: skip
    notes = (
        "Table I of the paper cannot be reproduced: the paper prints neither its contact positions, nor ω, λ or the step size, nor "
        "what its single-value and Lagrange starts are (ours are defined in the package: SingleValue and Lagrange); no placement on opposite faces that was "
        "searched gives its linear-combination row. What can be compared: the balance 0.6 in every row, the order of the starts, "
        "the ratios of steps and sums. Where our order differs, the definitions and the placement differ.",
    )
    columns = ("start", "thumb", "middle", "left", "right", "sum", "thumb − fingers", "steps")
    wrench = ", ".join(f"{value:g}" for value in table.get("wrench") or ())
    caption = f"Normal forces [N] and steps for w = ({wrench}); the paper's in brackets"
    return Section("paper", "The paper's wrenches", notes, present([Table(caption, columns, rows), *pictures]))


def _held(scenario: str, key: str, row: dict[str, Any]) -> str:
    causes = ", ".join(row.get("failures") or ())
    return f"{row['held']} of {row['episodes']}" + (f" ({causes})" if causes else "")


ROLLOUTS: Columns = (
    ("scenario", lambda scenario, key, row: str(SCENARIO_LABELS.get(scenario, scenario))),
    ("start", lambda scenario, key, row: label(key)),
    ("held", _held),
    ("drift, max [mm]", shown("max_drift_mm")),
    ("tilt, max [deg]", shown("max_tilt_deg")),
    ("slip [mm]", shown("max_slip_distance_mm")),
    ("force error, p95 [N]", shown("force_error_p95")),
    ("total normal [N]", shown("total_normal_force_mean")),
    ("peak torque [N m]", shown("peak_torque")),
    ("iterations, median", lambda scenario, key, row: steps(at(row, "iterations", "median"))),
    ("p99", lambda scenario, key, row: steps(at(row, "iterations", "p99"))),
)
"""See `metrics.rollout_metrics`."""


def hand_section(metrics: dict[str, Any], pictures: list[Picture], loops: list[Picture]) -> Section:
    """Roll-outs of the simulated hand."""
    items = [
        (scenario, key, row)
        for scenario, starts in (metrics.get("rollouts") or {}).items()
        for key, row in starts.items()
    ]
    notes = (
        f"Roll-outs of FourFingerGrasp-v0{_settings(at(metrics, 'run', 'rollouts'))}{_full(at(metrics, 'table_one', 'path_normal'))}.",
        "The optimum is the same whatever the start: what differs are the iterations"
        + (
            ", and here also how many episodes are held: see what failed in the table."
            if any(
                len({row["held"] / max(1, row["episodes"]) for row in starts.values()}) > 1
                for starts in (metrics.get("rollouts") or {}).values()
            )
            else ", not what is held."
        ),
    )
    table = Table.of("The simulated hand, per scenario and start", ROLLOUTS, items, words=2)
    return Section(
        "hand",
        "The simulated hand",
        notes,
        present([*loops, *pictures, Fold("Every scenario and start", present([table]))]),
    )


def _full(most: float | None) -> str:
    """Why the path is not followed at its full size."""
    return "" if most is None else f": at full size its optima take up to {number(most)} N of normal force in all"


def _settings(made: dict[str, Any] | None) -> str:
    """The environment's settings, in the numbers of this run; runs of older versions do not say them."""
    if not made:
        return "; W_ext(t) is scaled down"
    return (
        f" ({made['agent_rate']} Hz agent, {made['control_rate']} Hz control, {made['physics_rate']} Hz physics); the solver is told "
        f"{made['friction_margin']:g} of the simulation's friction. W_ext(t) is scaled by {made['path_scale']:g}"
    )

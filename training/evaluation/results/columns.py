"""Columns of all tables of results, with unit, meaning and statistics.

To add a metric, add an entry of `COLUMNS`, and a value under its name in the rows that a comparison
returns.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Kind = Literal["text", "whole", "real", "flag"]


@dataclass(frozen=True)
class Column:
    """Column of a table of results.

    Attributes:
        kind: text, whole (integers), real (floats) or flag (true or false). Values of every kind
            may be missing.
        text: meaning, in one line.
        unit: unit; "" for counts, ratios and text.
        key: True if rows with different values are summarised separately.
        statistics: names of `table.STATISTICS` by which it is summarised.
        timed: True for measured times, which differ from run to run.
    """

    kind: Kind
    text: str
    unit: str = ""
    key: bool = False
    statistics: tuple[str, ...] = ()
    timed: bool = False


def _key(text: str, kind: Kind = "text", unit: str = "") -> Column:
    return Column(kind, text, unit, key=True)


_COUNTED = ("median", "p90", "p95", "p99", "max", "low", "high", "missing")
_TIMED = ("median", "p90", "p99", "mean", "low", "high")
_MEAN = ("mean", "mean_low", "mean_high", "max")

COLUMNS: dict[str, Column] = {
    # keys: rows with equal keys are repetitions of one experiment
    "case": _key("set of problems, scenario or experiment"),
    "hand": _key("name of the hand"),
    "object": _key("name of the object's mesh file"),
    "engine": _key("physics engine and its settings"),
    "controller": _key("controller of the fingers"),
    "environment": _key(
        "settings of the agents' environment as JSON; {} is the default cuboid under a random wrench"
    ),
    "agent": _key("trained policy, or the policy it is compared with"),
    "start": _key("start of the optimisation; empty for a method that takes none"),
    "method": _key("optimisation method, or solver"),
    "rule": _key("step-size rule of the flow"),
    "form": _key("form in which the flow is computed"),
    "friction_margin": _key("friction margin of the controller, if varied", "real"),
    "squeeze": _key("normal force of a constant squeeze, if varied", "real", "N"),
    "force_weight": _key("omega of Phi, if varied", "real"),
    "barrier_weight": _key("lambda of Phi, if varied", "real", "N^2"),
    "interval": _key("time between samples, if varied", "real", "s"),
    "training_steps": _key(
        "environment steps that the agent was trained for, along its learning curve", "whole"
    ),
    "workers": _key("threads or processes", "whole"),
    "contacts": _key("number of contacts, if varied", "whole"),
    "side": _key("checkout that was timed"),
    "objective": _key("objective of the benchmark of forces: sum of the normal forces, or phi"),
    "mode": _key(
        "cold: set up for every problem; persistent: set up once; warm: from the last force"
    ),
    "language": _key("language that calls and times the solver"),
    "division": _key("closed: the solver reads the problem alone; learned; open"),
    "batch": _key("problems in one call; its time is divided by their number", "whole"),
    # repetitions
    "problem": Column("whole", "number of the problem, or of the repetition, within its case"),
    "seed": Column("whole", "seed of the problem or episode"),
    "training_seed": Column("whole", "seed with which the agent was trained"),
    "step": Column("whole", "step of the episode"),
    "group": Column("whole", "path, episode or grasp that the problem belongs to"),
    "contact": Column("whole", "number of the contact; 0: the thumb"),
    "event": Column("text", "event since the problem before, or name of the variant"),
    # the optimisation
    "status": Column(
        "text",
        "outcome: optimal, iteration_limit, stalled, no_start; of the benchmark of forces: solved, failed, infeasible",
    ),
    "reason": Column("text", "reason why there is no start or no answer"),
    "iterations": Column(
        "whole",
        "accepted steps; in comparisons of starts to a relative gap of 1e-4, with 5001 if it is not reached in 5000",
        "",
        False,
        _COUNTED,
    ),
    "iterations_coarse": Column(
        "whole", "accepted steps to a relative gap of 1e-2", "", False, ("median", "p99")
    ),
    "iterations_fine": Column(
        "whole", "accepted steps to a relative gap of 1e-6", "", False, ("median", "p99")
    ),
    "trials": Column(
        "whole",
        "steps tried in the whole run, including rejected ones",
        "",
        False,
        ("median", "p99"),
    ),
    "microseconds": Column(
        "real", "one whole call, best of the repeats", "us", False, _TIMED, timed=True
    ),
    "compiled_microseconds": Column(
        "real", "the same in the core, without Python", "us", False, _TIMED, timed=True
    ),
    "latency": Column(
        "real",
        "time of one call in a real-time loop, for every call",
        "us",
        False,
        ("median", "p99", "p999", "max"),
        timed=True,
    ),
    "step_microseconds": Column(
        "real", "time of the call over its iterations", "us", False, ("median",), timed=True
    ),
    "start_microseconds": Column(
        "real", "the start alone, best of the repeats", "us", False, ("median", "p99"), timed=True
    ),
    "start_gap": Column(
        "real", "relative gap of Phi at the start", "", False, ("median", "p90", "p99")
    ),
    "start_margin": Column(
        "real", "cone margin of the start over its largest component", "", False, ("min",)
    ),
    "start_residual": Column(
        "real", "balance residual of the start over its largest component", "", False, ("max",)
    ),
    "start_excess": Column(
        "real",
        "Phi at the start over Phi at the 12-basis's start, minus one",
        "",
        False,
        ("median", "max"),
    ),
    "start_replaced": Column(
        "flag", "the start was replaced by the 12-basis's", "", False, ("sum", "mean")
    ),
    "start_slope": Column(
        "real",
        "change of the start over change of the wrench since the problem before",
        "",
        False,
        ("median", "p99", "max"),
    ),
    "gap": Column(
        "real", "relative gap of the objective at the answer", "", False, ("median", "p99", "max")
    ),
    "margin": Column(
        "real", "cone margin of the answer over its largest component", "", False, ("min",)
    ),
    "residual": Column(
        "real", "balance residual of the answer over its largest component", "", False, ("max",)
    ),
    "balance": Column(
        "real",
        "balance residual of the answer over the wrench's largest component",
        "",
        False,
        ("max",),
    ),
    "apart": Column(
        "real",
        "relative difference of the objective from that of the earlier checkout, absolute value",
        "",
        False,
        ("max",),
    ),
    "violation": Column(
        "real",
        "violation of the cones by the answer over its largest component",
        "",
        False,
        ("max",),
    ),
    "force_excess": Column(
        "real",
        "relative excess of the total normal force over the least within the exact cones",
        "",
        False,
        ("median", "p95", "max"),
    ),
    "force_difference": Column(
        "real",
        "largest difference of the forces from those of this package's layer, over their largest component",
        "",
        False,
        ("median", "max"),
    ),
    "gradient_difference": Column(
        "real",
        "the same for the gradients, for the input with the largest difference",
        "",
        False,
        ("median", "p99", "max"),
    ),
    "failed": Column("flag", "there is no answer within the tolerances", "", False, ("sum",)),
    "limit_excess": Column(
        "real",
        "largest excess of the answer over a limit, relative to the limit",
        "",
        False,
        ("max",),
    ),
    "solved_coarse": Column(
        "flag",
        "gap, balance, cones and limits are within 1e-4, or the proof of infeasibility holds",
        "",
        False,
        ("sum",),
    ),
    "solved": Column("flag", "the same within 1e-6", "", False, ("sum",)),
    "proved": Column("flag", "the answer's own multipliers prove it to 1e-6", "", False, ("sum",)),
    "wrong": Column("flag", "the verdict is the opposite of the truth", "", False, ("sum",)),
    "calls": Column(
        "whole", "number of calls, of which the shortest time counts", "", False, ("min", "max")
    ),
    "many_microseconds": Column(
        "real",
        "time per problem in one call for a whole session",
        "us",
        False,
        ("median",),
        timed=True,
    ),
    "contact_force": Column("real", "normal force of the contact", "N"),
    "jump": Column(
        "real", "change of the contact's force since the sample before", "N", False, ("max",)
    ),
    "kink": Column(
        "real",
        "change of the rate of the contact's force since the sample before",
        "N/s",
        False,
        ("max",),
    ),
    "rate": Column(
        "real",
        "factor of the gap per iteration, fitted between gaps of 1e-3 and 1e-9",
        "",
        False,
        ("max",),
    ),
    "rate_predicted": Column(
        "real",
        "the same factor predicted from the eigenvalues of the Hessian, for rules with a formula",
        "",
        False,
        ("max",),
    ),
    "eigenvalue_least": Column(
        "real",
        "least eigenvalue of the Hessian of Phi on ker G in the metric of P",
        "1/N",
        False,
        ("min",),
    ),
    "eigenvalue_largest": Column(
        "real", "largest eigenvalue of that Hessian", "1/N", False, ("max",)
    ),
    "step_size": Column("real", "constant step of the flow", "N", False, ("max",)),
    "form_difference": Column(
        "real",
        "largest relative difference of Phi from the reduced form's over 40 iterations",
        "",
        False,
        ("max",),
    ),
    # the simulated hand
    "held": Column(
        "flag",
        "the object was held to the end: in place, without sliding, penetration or link forces beyond the limits",
        "",
        False,
        ("sum", "mean", "rate_low", "rate_high"),
    ),
    "failure": Column("text", "reason why the object was not held; empty if it was held"),
    "detail": Column(
        "text", "message of a hand that did not take hold, or of a solver that failed"
    ),
    "shape": Column("text", "shape of the object"),
    "size_x": Column("real", "size of the object", "m"),
    "size_y": Column("real", "size of the object", "m"),
    "size_z": Column("real", "size of the object", "m"),
    "mass": Column("real", "mass of the object", "kg"),
    "friction": Column("real", "friction coefficient of the object"),
    "redrawn": Column(
        "whole",
        "number of objects drawn before this one for which no grasp was found",
        "",
        False,
        ("sum",),
    ),
    "time": Column(
        "real", "simulated time at the end, or of a sample along a path", "s", False, ("min",)
    ),
    "drift": Column(
        "real",
        "largest distance of the object from where it was grasped, if it was held",
        "mm",
        False,
        (*_MEAN, "p99"),
    ),
    "end_drift": Column("real", "that distance at the end, held or not", "mm"),
    "tilt": Column(
        "real",
        "largest rotation of the object since it was grasped, if it was held",
        "deg",
        False,
        _MEAN,
    ),
    "end_tilt": Column("real", "that angle at the end, held or not", "deg"),
    "slip": Column(
        "real",
        "largest distance that a fingertip slid on the object, if it was held",
        "mm",
        False,
        _MEAN,
    ),
    "end_slip": Column("real", "the same, held or not", "mm"),
    "overlap": Column(
        "real", "largest penetration of a fingertip into the object", "mm", False, ("max",)
    ),
    "normal_force": Column(
        "real", "sum of the normal forces, mean over the episode", "N", False, _MEAN
    ),
    "commanded_force": Column(
        "real", "sum of the commanded normal forces, mean over the episode", "N", False, _MEAN
    ),
    "force_error": Column(
        "real", "measured minus commanded contact force, mean over the episode", "N", False, _MEAN
    ),
    "stray_force": Column(
        "real", "largest contact force of links other than fingertips", "N", False, ("max",)
    ),
    "stray_share": Column("real", "that force as a share of the load", "", False, ("max",)),
    "peak_torque": Column("real", "largest joint torque", "N m", False, ("mean", "max")),
    "torque_share": Column(
        "real",
        "largest joint torque of a step as a share of its limit, mean over the episode",
        "",
        False,
        _MEAN,
    ),
    "torque_margin": Column(
        "real", "least distance of a torque from its limit", "N m", False, ("mean", "min")
    ),
    "limited": Column(
        "whole", "ticks in which a torque limit was active", "", False, ("mean", "sum")
    ),
    "saturated": Column(
        "real", "share of the steps in which a torque was cut", "", False, ("mean", "max")
    ),
    "touching": Column("whole", "fingers in contact at the end"),
    "contact_changes": Column("whole", "contacts lost or made", "", False, ("mean", "max")),
    "contact_always": Column("flag", "every finger touched at every step", "", False, ("mean",)),
    # agents
    "reward": Column("real", "reward of the step"),
    "return": Column(
        "real", "sum of the rewards of an episode, at its last step", "", False, ("iqm",)
    ),
    "mean_iterations": Column(
        "real", "iterations per step, mean over the episode", "", False, ("mean", "median")
    ),
    # speed
    "per_second": Column(
        "real", "solves, steps or resets per second", "1/s", False, ("median", "max"), timed=True
    ),
    "nanoseconds": Column(
        "real", "one step of the computation", "ns", False, ("median",), timed=True
    ),
    "milliseconds": Column("real", "one call", "ms", False, ("median", "mean", "p99"), timed=True),
    "lost": Column(
        "whole", "messages that were sent and did not arrive", "", False, ("sum",), timed=True
    ),
    "unanswered": Column(
        "whole",
        "messages without an answer of their own, because a newer one had arrived",
        "",
        False,
        ("sum",),
        timed=True,
    ),
    "late": Column("whole", "updates after a missed deadline", "", False, ("sum",), timed=True),
    "over_budget": Column(
        "whole", "updates that took longer than their budget", "", False, ("sum",), timed=True
    ),
    "behind": Column(
        "whole",
        "steps that the simulated hand began late, because the machine was busy",
        "",
        False,
        ("sum",),
        timed=True,
    ),
    "ratio": Column(
        "real",
        "time over that of the alternative measured in turn with it",
        "",
        False,
        ("median", "low", "high"),
        timed=True,
    ),
    "solves": Column("whole", "number of problems that the row covers", "", False, ("max",)),
    "failures": Column(
        "whole", "number of those without an answer within the tolerances", "", False, ("max",)
    ),
    "mebibytes": Column("real", "resident memory, or its growth", "MiB", False, ("max",)),
    "bytes": Column("whole", "memory, or size of files", "B", False, ("max",)),
    "seconds": Column("real", "wall time", "s", False, ("max",), timed=True),
    "cpu_seconds": Column("real", "processor time of one core", "s", False, ("max",), timed=True),
    "operations": Column("whole", "multiplications, counted", "", False, ("max",)),
    "force_sum": Column(
        "real", "sum of the normal forces of the start, or of the optimum", "N", False, ("median",)
    ),
}
"""All columns, in the order of the tables."""
KEYS = tuple(name for name, column in COLUMNS.items() if column.key)
TIMES = tuple(name for name, column in COLUMNS.items() if column.timed)

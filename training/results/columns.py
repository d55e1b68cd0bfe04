"""The columns of every table of results: each has its name, unit, meaning and statistics here and nowhere else.

A new metric is a new entry of `COLUMNS`, and a value under its name in the rows that a comparison returns.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Kind = Literal["text", "whole", "real", "flag"]


@dataclass(frozen=True)
class Column:
    """A column of a table of results.

    Attributes:
        kind: text, whole (integers), real (floats) or flag (true or false). Every kind may be missing.
        text: what it is, in one line.
        unit: "" for counts, ratios and text.
        key: whether rows that differ in it are summarised apart.
        statistics: names of `table.STATISTICS` by which it is summarised.
        timed: whether it is a measured time, which differs from run to run.
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
    # what was done: rows of equal keys are repetitions of one experiment
    "case": _key("set of problems, scenario or experiment"),
    "hand": _key("name of the hand"),
    "object": _key("name of the object's mesh file"),
    "engine": _key("physics engine and its settings"),
    "controller": _key("what commands the fingers"),
    "environment": _key("settings of the agents' environment as JSON; {} is the default cuboid under a random wrench"),
    "agent": _key("trained policy, or what stands in its place"),
    "start": _key("start of the optimisation; empty for a method that takes none"),
    "method": _key("optimisation method, or solver"),
    "rule": _key("step-size rule of the flow"),
    "form": _key("form in which the flow is computed"),
    "friction_margin": _key("friction margin of the controller where it is swept", "real"),
    "squeeze": _key("normal force of a constant squeeze where it is swept", "real", "N"),
    "force_weight": _key("omega of Phi where it is swept", "real"),
    "barrier_weight": _key("lambda of Phi where it is swept", "real", "N^2"),
    "interval": _key("time between samples where it is swept", "real", "s"),
    "training_steps": _key("environment steps that the agent was trained for, along its learning curve", "whole"),
    "workers": _key("threads or processes", "whole"),
    "contacts": _key("number of contacts where it is swept", "whole"),
    "side": _key("which checkout was timed"),
    "objective": _key("objective of the benchmark of forces: sum of the normal forces, or phi"),
    "mode": _key("cold: set up for every problem; persistent: set up once; warm: from the last force"),
    "language": _key("language that calls and times the solver"),
    "division": _key("closed: the solver reads the problem alone; learned; open"),
    "batch": _key("problems in one call, whose time is shared out over them", "whole"),
    # which repetition
    "problem": Column("whole", "number of the problem, or of the repetition, within its case"),
    "seed": Column("whole", "seed of the problem or episode"),
    "training_seed": Column("whole", "seed with which the agent was trained"),
    "step": Column("whole", "step of the episode"),
    "group": Column("whole", "path, episode or grasp that the problem belongs to"),
    "contact": Column("whole", "number of the contact; 0: the thumb"),
    "event": Column("text", "what happened since the problem before, or which variant it is"),
    # the optimisation
    "status": Column("text", "how it ended: optimal, iteration_limit, stalled, no_start; feasible or failed for a solver of a user"),
    "reason": Column("text", "why there is no start or no answer"),
    "iterations": Column("whole", "accepted steps; in comparisons of starts to a relative gap of 1e-4, where 5001: not reached in 5000", "", False, _COUNTED),
    "iterations_coarse": Column("whole", "accepted steps to a relative gap of 1e-2", "", False, ("median", "p99")),
    "iterations_fine": Column("whole", "accepted steps to a relative gap of 1e-6", "", False, ("median", "p99")),
    "trials": Column("whole", "steps tried by the whole run, rejected ones included", "", False, ("median", "p99")),
    "microseconds": Column("real", "one whole call, best of the repeats", "us", False, _TIMED, timed=True),
    "compiled_microseconds": Column("real", "the same in the core, without Python", "us", False, _TIMED, timed=True),
    "latency": Column("real", "one call of a loop in real time, every call of it", "us", False, ("median", "p99", "p999", "max"), timed=True),
    "step_microseconds": Column("real", "time of the call over its iterations", "us", False, ("median",), timed=True),
    "start_microseconds": Column("real", "the start alone, best of the repeats", "us", False, ("median", "p99"), timed=True),
    "start_gap": Column("real", "relative gap of Phi at the start", "", False, ("median", "p90", "p99")),
    "start_margin": Column("real", "cone margin of the start over its largest component", "", False, ("min",)),
    "start_residual": Column("real", "balance residual of the start over its largest component", "", False, ("max",)),
    "start_excess": Column("real", "Phi at the start over Phi at the 12-basis's start, minus one", "", False, ("median", "max")),
    "start_replaced": Column("flag", "whether the start was discarded for the 12-basis's", "", False, ("sum", "mean")),
    "start_slope": Column("real", "change of the start over change of the wrench since the problem before", "", False, ("median", "p99", "max")),
    "gap": Column("real", "relative gap of the objective at the answer", "", False, ("median", "p99", "max")),
    "margin": Column("real", "cone margin of the answer over its largest component", "", False, ("min",)),
    "residual": Column("real", "balance residual of the answer over its largest component", "", False, ("max",)),
    "balance": Column("real", "balance residual of the answer over the wrench's largest component", "", False, ("max",)),
    "apart": Column("real", "objective over that of the earlier checkout, minus one, without sign", "", False, ("max",)),
    "violation": Column("real", "violation of the cones by the answer over its largest component", "", False, ("max",)),
    "force_excess": Column("real", "normal force of the answer above the least of the exact cones, as a share", "", False, ("median", "p95", "max")),
    "force_difference": Column("real", "largest difference of the forces from our layer's, over the largest component of those", "", False, ("median", "max")),
    "gradient_difference": Column("real", "the same of the gradients, for the input where it is largest", "", False, ("median", "p99", "max")),
    "failed": Column("flag", "whether there is no answer within the tolerances", "", False, ("sum",)),
    "limit_excess": Column("real", "excess of a limit by the answer as a part of that limit", "", False, ("max",)),
    "solved_coarse": Column("flag", "whether gap, balance, cones and limits are within 1e-4, or the proof that there is no force holds", "", False, ("sum",)),
    "solved": Column("flag", "the same within 1e-6", "", False, ("sum",)),
    "proved": Column("flag", "whether the answer's own multipliers prove it to 1e-6", "", False, ("sum",)),
    "wrong": Column("flag", "whether the verdict is the opposite of the truth", "", False, ("sum",)),
    "calls": Column("whole", "calls of which the least time counts", "", False, ("min", "max")),
    "many_microseconds": Column("real", "time of a problem in one call for all of a session", "us", False, ("median",), timed=True),
    "contact_force": Column("real", "normal force of the contact", "N"),
    "jump": Column("real", "change of the contact's force since the sample before", "N", False, ("max",)),
    "kink": Column("real", "change of the rate of the contact's force since the sample before", "N/s", False, ("max",)),
    "rate": Column("real", "factor of the gap per iteration, fitted between gaps of 1e-3 and 1e-9", "", False, ("max",)),
    "rate_predicted": Column("real", "that factor by the eigenvalues of the Hessian, where there is a formula", "", False, ("max",)),
    "eigenvalue_least": Column("real", "least eigenvalue of the Hessian of Phi on ker G in the metric of P", "1/N", False, ("min",)),
    "eigenvalue_largest": Column("real", "largest one", "1/N", False, ("max",)),
    "step_size": Column("real", "constant step of the flow", "N", False, ("max",)),
    "form_difference": Column("real", "largest relative difference of Phi from the reduced form's over 40 iterations", "", False, ("max",)),
    # the simulated hand
    "held": Column("flag", "whether the object was held to the end: in place, without sliding, overlap or force of links beyond the limits", "", False, ("sum", "mean", "rate_low", "rate_high")),
    "failure": Column("text", "why it was not held; empty where it was"),
    "detail": Column("text", "message of a hand that did not take hold, or of a solver that failed"),
    "shape": Column("text", "shape of the object"),
    "size_x": Column("real", "size of the object", "m"),
    "size_y": Column("real", "size of the object", "m"),
    "size_z": Column("real", "size of the object", "m"),
    "mass": Column("real", "mass of the object", "kg"),
    "friction": Column("real", "friction coefficient of the object"),
    "redrawn": Column("whole", "objects drawn before this one for which no grasp was found", "", False, ("sum",)),
    "time": Column("real", "simulated time at the end; of a sample along a path", "s", False, ("min",)),
    "drift": Column("real", "largest distance of the object from where it was grasped, where it was held", "mm", False, (*_MEAN, "p99")),
    "end_drift": Column("real", "that distance at the end, held or not", "mm"),
    "tilt": Column("real", "largest angle of the object from how it was grasped, where it was held", "deg", False, _MEAN),
    "end_tilt": Column("real", "that angle at the end, held or not", "deg"),
    "slip": Column("real", "furthest that a fingertip slid from where it was on the object, where it was held", "mm", False, _MEAN),
    "end_slip": Column("real", "the same, held or not", "mm"),
    "overlap": Column("real", "largest depth of a fingertip in the object", "mm", False, ("max",)),
    "normal_force": Column("real", "sum of the normal forces, mean over the episode", "N", False, _MEAN),
    "commanded_force": Column("real", "sum of the commanded normal forces, mean over the episode", "N", False, _MEAN),
    "force_error": Column("real", "measured minus commanded contact force, mean over the episode", "N", False, _MEAN),
    "stray_force": Column("real", "largest force by links that are no fingertips", "N", False, ("max",)),
    "stray_share": Column("real", "that force as a share of the load", "", False, ("max",)),
    "peak_torque": Column("real", "largest joint torque", "N m", False, ("mean", "max")),
    "torque_share": Column("real", "largest joint torque of a step as a share of its limit, mean over the episode", "", False, _MEAN),
    "torque_margin": Column("real", "least distance of a torque from its limit", "N m", False, ("mean", "min")),
    "limited": Column("whole", "ticks in which a torque limit was active", "", False, ("mean", "sum")),
    "saturated": Column("real", "share of the steps in which a torque was cut", "", False, ("mean", "max")),
    "touching": Column("whole", "fingers in contact at the end"),
    "contact_changes": Column("whole", "contacts lost or made", "", False, ("mean", "max")),
    "contact_always": Column("flag", "whether every finger touched at every step", "", False, ("mean",)),
    # agents
    "reward": Column("real", "reward of the step"),
    "return": Column("real", "sum of the rewards of an episode, at its last step", "", False, ("iqm",)),
    "mean_iterations": Column("real", "iterations per step, mean over the episode", "", False, ("mean", "median")),
    # speed
    "per_second": Column("real", "solves, steps or resets per second", "1/s", False, ("median", "max"), timed=True),
    "nanoseconds": Column("real", "one step of the computation", "ns", False, ("median",), timed=True),
    "milliseconds": Column("real", "one call", "ms", False, ("median", "mean", "p99"), timed=True),
    "lost": Column("whole", "messages that were sent and did not arrive", "", False, ("sum",), timed=True),
    "unanswered": Column("whole", "messages without an answer of their own, as a newer one had come", "", False, ("sum",), timed=True),
    "late": Column("whole", "updates after a missed deadline", "", False, ("sum",), timed=True),
    "over_budget": Column("whole", "updates that took longer than their budget", "", False, ("sum",), timed=True),
    "behind": Column("whole", "steps that the simulated hand began late, as the machine was busy", "", False, ("sum",), timed=True),
    "ratio": Column("real", "time over that of the comparison measured in turn with it", "", False, ("median", "low", "high"), timed=True),
    "solves": Column("whole", "problems that the row is of", "", False, ("max",)),
    "failures": Column("whole", "those of them without an answer within the tolerances", "", False, ("max",)),
    "mebibytes": Column("real", "resident memory, or its growth", "MiB", False, ("max",)),
    "bytes": Column("whole", "memory, or size of files", "B", False, ("max",)),
    "seconds": Column("real", "wall time", "s", False, ("max",), timed=True),
    "cpu_seconds": Column("real", "processor time of one core", "s", False, ("max",), timed=True),
    "operations": Column("whole", "multiplications, counted", "", False, ("max",)),
    "force_sum": Column("real", "sum of the normal forces of the start, or of the optimum", "N", False, ("median",)),
}  # fmt: skip
"""Every column, in the order of the tables."""
KEYS = tuple(name for name, column in COLUMNS.items() if column.key)
TIMES = tuple(name for name, column in COLUMNS.items() if column.timed)

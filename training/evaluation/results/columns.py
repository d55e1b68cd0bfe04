"""Columns of all tables of results, with unit, meaning and statistics.

To add a metric, add an entry of `COLUMNS`, and a value under its name in the rows that a comparison
returns.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal, get_args

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


def _column(
    kind: Kind, text: str, unit: str = "", statistics: str = "", timed: bool = False
) -> Column:
    return Column(kind, text, unit, False, tuple(statistics.split()), timed)


_text, _whole, _real, _flag = (partial(_column, kind) for kind in get_args(Kind))
_COUNTED = "median p90 p95 p99 max low high missing"
_TIMED = "median p90 p99 mean low high"
_MEAN = "mean mean_low mean_high max"

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
    "problem": _whole("number of the problem, or of the repetition, within its case"),
    "seed": _whole("seed of the problem or episode"),
    "training_seed": _whole("seed with which the agent was trained"),
    "step": _whole("step of the episode"),
    "group": _whole("path, episode or grasp that the problem belongs to"),
    "contact": _whole("number of the contact; 0: the thumb"),
    "event": _text("event since the problem before, or name of the variant"),
    # the optimisation
    "status": _text(
        "outcome: optimal, iteration_limit, stalled, no_start; of the benchmark of forces: solved, failed, infeasible"
    ),
    "reason": _text("reason why there is no start or no answer"),
    "iterations": _whole(
        "accepted steps; in comparisons of starts to a relative gap of 1e-4, with 5001 if it is not reached in 5000",
        statistics=_COUNTED,
    ),
    "iterations_coarse": _whole(
        "accepted steps to a relative gap of 1e-2", statistics="median p99"
    ),
    "iterations_fine": _whole("accepted steps to a relative gap of 1e-6", statistics="median p99"),
    "trials": _whole(
        "steps tried in the whole run, including rejected ones", statistics="median p99"
    ),
    "microseconds": _real("one whole call, best of the repeats", "us", _TIMED, timed=True),
    "compiled_microseconds": _real(
        "the same in the core, without Python", "us", _TIMED, timed=True
    ),
    "latency": _real(
        "time of one call in a real-time loop, for every call",
        "us",
        "median p99 p999 max",
        timed=True,
    ),
    "step_microseconds": _real("time of the call over its iterations", "us", "median", timed=True),
    "start_microseconds": _real(
        "the start alone, best of the repeats", "us", "median p99", timed=True
    ),
    "start_gap": _real("relative gap of Phi at the start", statistics="median p90 p99"),
    "start_margin": _real("cone margin of the start over its largest component", statistics="min"),
    "start_residual": _real(
        "balance residual of the start over its largest component", statistics="max"
    ),
    "start_excess": _real(
        "Phi at the start over Phi at the 12-basis's start, minus one", statistics="median max"
    ),
    "start_replaced": _flag("the start was replaced by the 12-basis's", statistics="sum mean"),
    "start_slope": _real(
        "change of the start over change of the wrench since the problem before",
        statistics="median p99 max",
    ),
    "gap": _real("relative gap of the objective at the answer", statistics="median p99 max"),
    "margin": _real("cone margin of the answer over its largest component", statistics="min"),
    "residual": _real(
        "balance residual of the answer over its largest component", statistics="max"
    ),
    "balance": _real(
        "balance residual of the answer over the wrench's largest component", statistics="max"
    ),
    "apart": _real(
        "relative difference of the objective from that of the earlier checkout, absolute value",
        statistics="max",
    ),
    "violation": _real(
        "violation of the cones by the answer over its largest component", statistics="max"
    ),
    "force_excess": _real(
        "relative excess of the total normal force over the least within the exact cones",
        statistics="median p95 max",
    ),
    "force_difference": _real(
        "largest difference of the forces from those of this package's layer, over their largest component",
        statistics="median max",
    ),
    "gradient_difference": _real(
        "the same for the gradients, for the input with the largest difference",
        statistics="median p99 max",
    ),
    "failed": _flag("there is no answer within the tolerances", statistics="sum"),
    "limit_excess": _real(
        "largest excess of the answer over a limit, relative to the limit", statistics="max"
    ),
    "solved_coarse": _flag(
        "gap, balance, cones and limits are within 1e-4, or the proof of infeasibility holds",
        statistics="sum",
    ),
    "solved": _flag("the same within 1e-6", statistics="sum"),
    "proved": _flag("the answer's own multipliers prove it to 1e-6", statistics="sum"),
    "wrong": _flag("the verdict is the opposite of the truth", statistics="sum"),
    "calls": _whole("number of calls, of which the shortest time counts", statistics="min max"),
    "many_microseconds": _real(
        "time per problem in one call for a whole session", "us", "median", timed=True
    ),
    "contact_force": _real("normal force of the contact", "N"),
    "jump": _real("change of the contact's force since the sample before", "N", "max"),
    "kink": _real(
        "change of the rate of the contact's force since the sample before", "N/s", "max"
    ),
    "rate": _real(
        "factor of the gap per iteration, fitted between gaps of 1e-3 and 1e-9", statistics="max"
    ),
    "rate_predicted": _real(
        "the same factor predicted from the eigenvalues of the Hessian, for rules with a formula",
        statistics="max",
    ),
    "eigenvalue_least": _real(
        "least eigenvalue of the Hessian of Phi on ker G in the metric of P", "1/N", "min"
    ),
    "eigenvalue_largest": _real("largest eigenvalue of that Hessian", "1/N", "max"),
    "step_size": _real("constant step of the flow", "N", "max"),
    "form_difference": _real(
        "largest relative difference of Phi from the reduced form's over 40 iterations",
        statistics="max",
    ),
    # the simulated hand
    "held": _flag(
        "the object was held to the end: in place, without sliding, penetration or link forces beyond the limits",
        statistics="sum mean rate_low rate_high",
    ),
    "failure": _text("reason why the object was not held; empty if it was held"),
    "detail": _text("message of a hand that did not take hold, or of a solver that failed"),
    "shape": _text("shape of the object"),
    "size_x": _real("size of the object", "m"),
    "size_y": _real("size of the object", "m"),
    "size_z": _real("size of the object", "m"),
    "mass": _real("mass of the object", "kg"),
    "friction": _real("friction coefficient of the object"),
    "redrawn": _whole(
        "number of objects drawn before this one for which no grasp was found", statistics="sum"
    ),
    "time": _real("simulated time at the end, or of a sample along a path", "s", "min"),
    "drift": _real(
        "largest distance of the object from where it was grasped, if it was held",
        "mm",
        f"{_MEAN} p99",
    ),
    "end_drift": _real("that distance at the end, held or not", "mm"),
    "tilt": _real(
        "largest rotation of the object since it was grasped, if it was held", "deg", _MEAN
    ),
    "end_tilt": _real("that angle at the end, held or not", "deg"),
    "slip": _real(
        "largest distance that a fingertip slid on the object, if it was held", "mm", _MEAN
    ),
    "end_slip": _real("the same, held or not", "mm"),
    "overlap": _real("largest penetration of a fingertip into the object", "mm", "max"),
    "normal_force": _real("sum of the normal forces, mean over the episode", "N", _MEAN),
    "commanded_force": _real(
        "sum of the commanded normal forces, mean over the episode", "N", _MEAN
    ),
    "force_error": _real(
        "measured minus commanded contact force, mean over the episode", "N", _MEAN
    ),
    "stray_force": _real("largest contact force of links other than fingertips", "N", "max"),
    "stray_share": _real("that force as a share of the load", statistics="max"),
    "peak_torque": _real("largest joint torque", "N m", "mean max"),
    "torque_share": _real(
        "largest joint torque of a step as a share of its limit, mean over the episode",
        statistics=_MEAN,
    ),
    "torque_margin": _real("least distance of a torque from its limit", "N m", "mean min"),
    "limited": _whole("ticks in which a torque limit was active", statistics="mean sum"),
    "saturated": _real("share of the steps in which a torque was cut", statistics="mean max"),
    "touching": _whole("fingers in contact at the end"),
    "contact_changes": _whole("contacts lost or made", statistics="mean max"),
    "contact_always": _flag("every finger touched at every step", statistics="mean"),
    # agents
    "reward": _real("reward of the step"),
    "return": _real("sum of the rewards of an episode, at its last step", statistics="iqm"),
    "mean_iterations": _real(
        "iterations per step, mean over the episode", statistics="mean median"
    ),
    # speed
    "per_second": _real("solves, steps or resets per second", "1/s", "median max", timed=True),
    "nanoseconds": _real("one step of the computation", "ns", "median", timed=True),
    "milliseconds": _real("one call", "ms", "median mean p99", timed=True),
    "lost": _whole("messages that were sent and did not arrive", statistics="sum", timed=True),
    "unanswered": _whole(
        "messages without an answer of their own, because a newer one had arrived",
        statistics="sum",
        timed=True,
    ),
    "late": _whole("updates after a missed deadline", statistics="sum", timed=True),
    "over_budget": _whole(
        "updates that took longer than their budget", statistics="sum", timed=True
    ),
    "behind": _whole(
        "steps that the simulated hand began late, because the machine was busy",
        statistics="sum",
        timed=True,
    ),
    "ratio": _real(
        "time over that of the alternative measured in turn with it",
        statistics="median low high",
        timed=True,
    ),
    "solves": _whole("number of problems that the row covers", statistics="max"),
    "failures": _whole("number of those without an answer within the tolerances", statistics="max"),
    "mebibytes": _real("resident memory, or its growth", "MiB", "max"),
    "bytes": _whole("memory, or size of files", "B", "max"),
    "seconds": _real("wall time", "s", "max", timed=True),
    "cpu_seconds": _real("processor time of one core", "s", "max", timed=True),
    "operations": _whole("multiplications, counted", statistics="max"),
    "force_sum": _real("sum of the normal forces of the start, or of the optimum", "N", "median"),
}
"""All columns, in the order of the tables."""
KEYS = tuple(name for name, column in COLUMNS.items() if column.key)
TIMES = tuple(name for name, column in COLUMNS.items() if column.timed)

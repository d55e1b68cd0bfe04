"""Columns of all tables of results, with unit, meaning and statistics.

To add a metric, add an entry of `COLUMNS`, and its value to the rows of a comparison.
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
        kind: text, whole (integers), real (floats) or flag; any value may be missing.
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
    kind: Kind, text: str, statistics: str = "", unit: str = "", timed: bool = False
) -> Column:
    return Column(kind, text, unit, False, tuple(statistics.split()), timed)


_text, _whole, _real, _flag = (partial(_column, kind) for kind in get_args(Kind))
_time = partial(_real, timed=True)
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
    "part": _key("tuning: chooses the settings of a controller; report: with the chosen settings"),
    "environment": _key(
        "settings of the agents' environment as JSON; {} is the default cuboid under a random wrench"
    ),
    "agent": _key("trained policy, or the policy it is compared with"),
    "start": _key("start of the optimisation; empty for a method that takes none"),
    "method": _key("optimisation method, or solver"),
    "rule": _key("step-size rule of the flow"),
    "form": _key("form in which the flow is computed"),
    "friction_margin": _key("friction margin of the controller, if varied", "real"),
    "preload": _key("preload of the controller, if varied", "real", "N"),
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
        _COUNTED,
    ),
    "iterations_coarse": _whole("accepted steps to a relative gap of 1e-2", "median p99"),
    "iterations_fine": _whole("accepted steps to a relative gap of 1e-6", "median p99"),
    "trials": _whole("steps tried in the whole run, including rejected ones", "median p99"),
    "microseconds": _time("one whole call, best of the repeats", _TIMED, "us"),
    "compiled_microseconds": _time("the same in the core, without Python", _TIMED, "us"),
    "latency": _time(
        "time of one call in a real-time loop, for every call", "median p99 p999 max", "us"
    ),
    "slowdown": _time("ratio of that time to the median of all calls of the solver", "max"),
    "undisturbed": _time(
        "that ratio of a call during which the system did not take the processor away", "max"
    ),
    "interrupted": _flag("the system took the processor away during the call", "sum", timed=True),
    "typical": _time("median of that ratio over all calls with the same problem", "max"),
    "step_microseconds": _time("time of the call over its iterations", "median", "us"),
    "start_microseconds": _time("the start alone, best of the repeats", "median p99", "us"),
    "start_gap": _real("relative gap of Phi at the start", "median p90 p99"),
    "start_margin": _real("cone margin of the start over its largest component", "min"),
    "start_residual": _real("balance residual of the start over its largest component", "max"),
    "start_excess": _real(
        "Phi at the start over Phi at the 12-basis's start, minus one", "median max"
    ),
    "start_replaced": _flag("the start was replaced by the 12-basis's", "sum mean"),
    "start_slope": _real(
        "change of the start over change of the wrench since the problem before", "median p99 max"
    ),
    "gap": _real("relative gap of the objective at the answer", "median p99 max"),
    "margin": _real("cone margin of the answer over its largest component", "min"),
    "residual": _real("balance residual of the answer over its largest component", "max"),
    "balance": _real("balance residual of the answer over the wrench's largest component", "max"),
    "apart": _real(
        "relative difference of the objective from that of the earlier checkout, absolute value",
        "max",
    ),
    "violation": _real("violation of the cones by the answer over its largest component", "max"),
    "force_excess": _real(
        "relative excess of the total normal force over the least within the exact cones",
        "median p95 max",
    ),
    "force_difference": _real(
        "largest difference of the forces from those of this package's layer, over their largest component",
        "median max",
    ),
    "gradient_difference": _real(
        "the same for the gradients, for the input with the largest difference", "median p99 max"
    ),
    "failed": _flag("there is no answer within the tolerances", "sum"),
    "limit_excess": _real(
        "largest excess of the answer over a limit, relative to the limit", "max"
    ),
    "solved_coarse": _flag(
        "gap, balance, cones and limits are within 1e-4, or the proof of infeasibility holds", "sum"
    ),
    "solved": _flag("the same within 1e-6", "sum"),
    "proved": _flag("the answer's own multipliers prove it to 1e-6", "sum"),
    "wrong": _flag("the verdict is the opposite of the truth", "sum"),
    "calls": _whole("number of calls, of which the shortest time counts", "min max"),
    "many_microseconds": _time("time per problem in one call for a whole session", "median", "us"),
    "contact_force": _real("normal force of the contact", unit="N"),
    "jump": _real("change of the contact's force since the sample before", "max", "N"),
    "kink": _real(
        "change of the rate of the contact's force since the sample before", "max", "N/s"
    ),
    "rate": _real("factor of the gap per iteration, fitted between gaps of 1e-3 and 1e-9", "max"),
    "rate_predicted": _real(
        "the same factor predicted from the eigenvalues of the Hessian, for rules with a formula",
        "max",
    ),
    "eigenvalue_least": _real(
        "least eigenvalue of the Hessian of Phi on ker G in the metric of P", "min", "1/N"
    ),
    "eigenvalue_largest": _real("largest eigenvalue of that Hessian", "max", "1/N"),
    "step_size": _real("constant step of the flow", "max", "N"),
    "form_difference": _real(
        "largest relative difference of Phi from the reduced form's over 40 iterations", "max"
    ),
    # the simulated hand
    "held": _flag(
        "the object was held to the end: in place, without sliding, penetration or link forces beyond the limits",
        "sum mean rate_low rate_high",
    ),
    "failure": _text("reason why the object was not held; empty if it was held"),
    "no_start": _flag("the hand did not take hold of the object", "sum"),
    "detail": _text("message of a hand that did not take hold, or of a solver that failed"),
    "shape": _text("shape of the object"),
    "size_x": _real("size of the object", unit="m"),
    "size_y": _real("size of the object", unit="m"),
    "size_z": _real("size of the object", unit="m"),
    "mass": _real("mass of the object", unit="kg"),
    "friction": _real("friction coefficient of the object"),
    "redrawn": _whole(
        "number of objects drawn before this one for which no grasp was found", "sum"
    ),
    "time": _real("simulated time at the end, or of a sample along a path", "min", "s"),
    "drift": _real(
        "largest distance of the object from where it was grasped, if it was held",
        f"{_MEAN} median p90 p99",
        "mm",
    ),
    "end_drift": _real("that distance at the end, held or not", unit="mm"),
    "tilt": _real(
        "largest rotation of the object since it was grasped, if it was held", _MEAN, "deg"
    ),
    "end_tilt": _real("that angle at the end, held or not", unit="deg"),
    "slip": _real(
        "largest distance that a fingertip slid on the object, if it was held", _MEAN, "mm"
    ),
    "end_slip": _real("the same, held or not", "median p90", "mm"),
    "overlap": _real("largest penetration of a fingertip into the object", "max", "mm"),
    "friction_used": _real(
        "largest share of the given friction that an optimised force uses, torsion included", "max"
    ),
    "normal_force": _real("sum of the normal forces, mean over the episode", _MEAN, "N"),
    "commanded_force": _real(
        "sum of the commanded normal forces, mean over the episode", _MEAN, "N"
    ),
    "force_error": _real(
        "measured minus commanded contact force, mean over the episode", _MEAN, "N"
    ),
    "stray_force": _real("largest contact force of links other than fingertips", "max", "N"),
    "stray_share": _real("that force as a share of the load", "max"),
    "peak_torque": _real("largest joint torque", "mean max", "N m"),
    "torque_share": _real(
        "largest joint torque of a step as a share of its limit, mean over the episode", _MEAN
    ),
    "torque_margin": _real("least distance of a torque from its limit", "mean min", "N m"),
    "limited": _whole("ticks in which a torque limit was active", "mean sum"),
    "saturated": _real("share of the steps in which a torque was cut", "mean max"),
    "touching": _whole("fingers in contact at the end"),
    "contact_changes": _whole("contacts lost or made", "mean max"),
    "contact_always": _flag("every finger touched at every step", "mean"),
    # agents
    "reward": _real("reward of the step"),
    "return": _real("sum of the rewards of an episode, at its last step", "iqm"),
    "mean_iterations": _real("iterations per step, mean over the episode", "mean median"),
    # speed
    "per_second": _time("solves, steps or resets per second", "median max", "1/s"),
    "nanoseconds": _time("one step of the computation", "median", "ns"),
    "milliseconds": _time("one call", "median mean p99", "ms"),
    "lost": _whole("messages that were sent and did not arrive", "sum", timed=True),
    "unanswered": _whole(
        "messages without an answer of their own, because a newer one had arrived",
        "sum",
        timed=True,
    ),
    "late": _whole("updates after a missed deadline", "sum", timed=True),
    "over_budget": _whole("updates that took longer than their budget", "sum", timed=True),
    "behind": _whole(
        "steps that the simulated hand began late, because the machine was busy", "sum", timed=True
    ),
    "ratio": _time("time over that of the alternative measured in turn with it", "median low high"),
    "solves": _whole("number of problems that the row covers", "max"),
    "failures": _whole("number of those without an answer within the tolerances", "max"),
    "mebibytes": _real("resident memory, or its growth", "max", "MiB"),
    "bytes": _whole("memory, or size of files", "max", "B"),
    "seconds": _time("wall time", "max", "s"),
    "cpu_seconds": _time("processor time of one core", "max", "s"),
    "operations": _whole("multiplications, counted", "max"),
    "force_sum": _real("sum of the normal forces of the start, or of the optimum", "median", "N"),
}
"""All columns, in the order of the tables."""
KEYS = tuple(name for name, column in COLUMNS.items() if column.key)
TIMES = tuple(name for name, column in COLUMNS.items() if column.timed)

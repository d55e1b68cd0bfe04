"""The measured tables, made of the saved runs: what is kept of each, and one function for each table."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from training.runs.words import number
from training.report.reproduce import RULES as RULE_LABELS
from training.reproduce import LAMBDA
from training.trials.hold_plan import CONTROLLER_LABELS, CONTROLLERS, SCENARIO_LABELS

RESULTS = Path(__file__).parent / "results"

SETS = {
    "ball": "standard ball: force 2 N, moment 0.05 N m",
    "ball_double": "twice that",
    "smooth": "random walk, 3 % a step",
    "paper_path": "W_ext(t), full size",
    "jump_50": "jumps of 50 %",
    "friction": "friction 0.2, 0.7, 0.8",
    "positions": "contacts moved up to 10 mm",
    "random_3": "random grasps, 3 contacts",
    "random_4": "4 contacts",
    "random_5": "5 contacts",
    "rollout_cold": "hand, first solve on a random object",
    "rollout_impulses": "hand, impacts",
    "rollout_changes": "hand, a finger lost, landed, slipped",
}
STARTS = {
    "linear_combination": "12-basis (the paper)",
    "previous_tangent": "previous, tangent",
    "nearest_tangent": "nearest of 10,000, tangent",
    "basis_newton": "12-basis + 4 Newton",
    "learned_fixed": "**four_finger**",
    "learned_any": "**any_grasp**",
}
SOLVERS = {
    "conic": "**ours, `conic`, compiled call**",
    "conic_python": "**ours, `conic`, `ForceOptimizer.solve`**",
    "newton": "ours, `newton` on Phi to 1e-8, compiled",
    "newton_python": "ours, `newton` on Phi, from Python",
    "qocogen_fast": "C: QOCOGEN, -Ofast -flto, no refinement",
    "qocogen": "C: QOCOGEN, -O3 -march=native",
    "qoco": "Python: QOCO, update",
    "clarabel": "Python: Clarabel, update",
    "ecos": "Python: ECOS",
    "moreau": "Python: Moreau",
    "slsqp": "SciPy SLSQP",
}

_KEPT_STARTS = "|".join((*STARTS, "network*", "basis_*"))
_FEW = 20
"""Cases below which a percentile says nothing."""
_LIMIT = 5000
"""Iterations after which a flow of the comparison is cut off."""

_HELD = (
    "name|scenario|controller|swept|hand|label|engine|episodes|held|rate_low|rate_high|normal_force|largest_drift_mm"
)

RUN = ("run|provenance", "command|time|machine|versions|commit", "**")
KEPT: dict[str, tuple[tuple[str, ...], ...]] = {
    "starts": (
        ("starts", "*", "|".join(SETS), _KEPT_STARTS, "cases|no_start|not_converged|not_applicable"),
        ("starts", "*", "|".join(SETS), _KEPT_STARTS, "iterations|start_gap", "median|p99"),
        ("timing", "repeats|wrenches"),
        ("timing", "total", "*", "*", "best", "median|p99"),
        ("claims", "**"),
    ),
    "reproduce": (
        ("wrenches",),
        ("weights", "*", "omega|lambda"),
        ("weights", "*", "rules", "*", "iterations", "median|p99"),
        ("times", "*", "median|p99"),
        ("table_one", "rows", "*", "sum|steps"),
        ("table_one", "rows", "*", "paper", "sum|steps"),
    ),
    "solver": (("rows", "*", "solver|contacts|problems|failed|p50_us|p99_us|gap_max|balance_max|violation_max"),),
    "batch": (("wrenches",), ("rows", "**"), ("peak_gib",)),
    "hold": (("cells", "*", _HELD), ("chosen", "**"), ("claims", "**")),
    "hands": (("rows", "*", _HELD),),
    "transfer": (("rows", "*", _HELD), ("claims", "**")),
    "rl": (
        ("rows", "*", "label|seeds|held|episodes|iterations|iterations_against_paper|return", "**"),
        ("command|time|machine|commit", "**"),
    ),
    "env_speed": (
        ("rows", "*", "method|per_second|ratio_median"),
        ("resets", "**"),
        ("memory", "**"),
        ("claims", "**"),
    ),
}
"""By saved run: paths of keys to keep; `*` is any part of a name, `|` between alternatives, `**` all below."""


@cache
def saved(name: str) -> Any:
    """A saved run."""
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Markdown."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def source(name: str) -> str:
    """What measured it: the last line of a block."""
    found = saved(name)
    run = found.get("run") or found.get("provenance") or found
    machine = run["machine"]
    return (
        f"\n`{run['command']}` at {run['commit']}, {run['time'][:10]}: {machine['processor']}, {machine['cores']} cores, "
        f"Python {machine['python']}."
    )


def pair(part: dict[str, Any] | None, digits: int = 3) -> str:
    """Median / p99; a dash where there is none."""
    return "–" if not part else f"{number(part['median'], digits)} / {number(part['p99'], digits)}"


def iterations(found: dict[str, Any] | None) -> str:
    """Of the flow, median / p99; a dash where the start does not apply or hardly ever does."""
    if not found or found["cases"] - found["not_applicable"] - found["no_start"] < _FEW:
        return "–"
    return " / ".join(f"> {_LIMIT}" if value > _LIMIT else f"{value:.0f}" for value in found["iterations"].values())


def starts() -> str:
    """Iterations of the flow per set of cases."""
    flow = saved("starts")["starts"]["reduced_flow"]
    rows = [[label, *(iterations(flow[case].get(start)) for start in STARTS)] for case, label in SETS.items()]
    return table(["cases", *STARTS.values()], rows) + "\n" + source("starts")


def calls() -> str:
    """The whole public call."""
    total = saved("starts")["timing"]["total"]
    chosen = {key: STARTS[key] for key in ("linear_combination", "previous_tangent", "learned_fixed", "learned_any")}
    chosen["learned_previous"] = "any_grasp, remembering"
    rows = [
        [label, *(pair(total[method][start]["best"]) for method in ("reduced_flow", "newton"))]
        for start, label in chosen.items()
    ]
    return table(["start", "with the reduced flow, us", "with Newton, us"], rows) + "\n" + source("starts")


def network() -> str:
    """The network alone and after plain Newton steps, beside the 12-basis after as many."""
    ball = saved("starts")["starts"]["reduced_flow"]["ball"]
    pairs = [
        ("linear_combination", "network"),
        ("basis_tangent", "network_newton_1"),
        ("basis_newton_2", "network_newton_2"),
    ]
    rows = [
        [str(steps), *(text for key in both for text in (iterations(ball[key]), pair(ball[key]["start_gap"], 2)))]
        for steps, both in enumerate(pairs)
    ]
    return (
        table(["plain Newton steps first", "12-basis", "its gap", "network", "its gap"], rows) + "\n" + source("starts")
    )


def step_rules() -> str:
    """The flow from the 12-basis by every step rule: the comparisons of starts use one of them."""
    weights = saved("reproduce")["weights"]
    usual = next(row for row in weights if (row["omega"], row["lambda"]) == (1.0, LAMBDA))["rules"]
    times = saved("reproduce")["times"]
    rows = [[RULE_LABELS[key], pair(usual[key]["iterations"]), pair(times[key])] for key in RULE_LABELS if key in times]
    columns = ["step rule, median / p99", "iterations", "compiled call, certified to 1e-4, us"]
    return table(columns, rows) + "\n" + source("reproduce")


def table_one() -> str:
    """The paper's Table I beside ours on the reference grasp."""
    rows = []
    for key, row in saved("reproduce")["table_one"]["rows"].items():
        theirs = row["paper"]
        steps = (f"about {theirs['steps']}", number(row["steps"])) if row["steps"] is not None else ("", "")
        rows.append([key.replace("_", " "), number(theirs["sum"]), number(row["sum"]), *steps])
    columns = ["start", "sum of normal forces, paper [N]", "ours [N]", "steps, paper", "ours"]
    return table(columns, rows) + "\n" + source("reproduce")


def solvers() -> str:
    """Against other solvers, by number of contacts."""
    found = {(row["solver"], row["contacts"]): row for row in saved("solver")["rows"]}
    sizes = sorted({count for _, count in found})
    rows = []
    for solver, label in SOLVERS.items():
        cells = (found.get((solver, count)) for count in sizes)
        rows.append([label, *("–" if not row else f"{row['p50_us']:.1f} / {row['p99_us']:.1f}" for row in cells)])
    failed = [f"{SOLVERS[solver].strip('*')} failed on {row['failed']} of {row['problems']} at N = {count}"
              for (solver, count), row in found.items() if row["failed"] and solver in SOLVERS]  # fmt: skip
    ours = [row for row in saved("solver")["rows"] if row["solver"].startswith(("conic", "newton"))]
    told = (
        f"Of ours {sum(row['failed'] for row in ours)} failed, balance within {max(row['balance_max'] for row in ours):.0e} of the "
        f"wrench, cones violated by at most {number(max(row['violation_max'] for row in ours))}. {'; '.join(failed) or 'None failed'}."
    )
    return (
        table(["solver, median / p99 us", *(f"N = {count}" for count in sizes)], rows)
        + f"\n\n{told}\n"
        + source("solver")
    )


def batch() -> str:
    """Solves per second."""
    by = {(row["method"], row["workers"]): row["per_second"] for row in saved("batch")["rows"]}
    methods = dict.fromkeys(method for method, _ in by)
    cores = sorted({workers for _, workers in by})
    rows = [[method, *(f"{by[method, count] / 1e6:.1f}" for count in cores)] for method in methods]
    return (
        table(["million certified solves per second", *(f"{n} core{'s' * (n > 1)}" for n in cores)], rows)
        + "\n"
        + source("batch")
    )


def held(row: dict[str, Any] | None) -> str:
    """Episodes held of those tried, and the squeeze."""
    if not row:
        return "–"
    force = (row.get("normal_force") or {}).get("mean")
    return f"{row['held']} of {row['episodes']}" + ("" if force is None else f" at {number(force)} N")


def hold() -> str:
    """Controllers by scenario; where something was swept, at each one's best."""
    cells = {row["name"]: row for row in saved("hold")["cells"]}
    chosen = saved("hold")["chosen"]
    rows = []
    for scenario in (name for name in SCENARIO_LABELS if any(row["scenario"] == name for row in cells.values())):
        names = [chosen.get(scenario, {}).get(key, f"{scenario}/{key}") for key in CONTROLLERS]
        rows.append([SCENARIO_LABELS[scenario], *(held(cells.get(name)) for name in names)])
    return table(["held", *CONTROLLER_LABELS.values()], rows) + "\n" + source("hold")


def hands() -> str:
    """Hands by object and disturbance, episodes held; the cube and the sphere together."""
    sums: dict[str, dict[str, tuple[int, int]]] = {}
    for row in saved("hands")["rows"]:
        kind = re.sub("^(cube|sphere) of .. mm", "cube and sphere", row["label"])
        before = sums.setdefault(f"`{row['hand']}`", {}).get(kind, (0, 0))
        sums[f"`{row['hand']}`"][kind] = before[0] + row["held"], before[1] + row["episodes"]
    kinds = [
        kind for kind in next(iter(sums.values())) if "gravity" not in kind and kind != "cube and sphere, six pushes"
    ]
    rows = [[hand, *(f"{found[kind][0]} of {found[kind][1]}" for kind in kinds)] for hand, found in sums.items()]
    return table(["hand", *kinds], rows) + "\n" + source("hands")


def rl() -> str:
    """Agents beside the paper's start, the previous solution and the learned start."""
    rows = []
    for key, row in saved("rl")["rows"].items():
        ratio = row["iterations_against_paper"]
        spread = " / ".join(number(row["iterations"][part]) for part in ("median", "p95", "p99"))
        against = f"{ratio['ratio']:.2f} ({ratio['low']:.2f} to {ratio['high']:.2f})"
        if key.endswith("contact_force"):  # no solver, no iterations
            spread = against = "–"
        rows.append(
            [row["label"], f"{row['held']} of {row['episodes']}", spread, against, number(row["return"]["iqm"])]
        )
    columns = ["policy", "held", "iterations, median / p95 / p99", "of the paper's", "return, interquartile mean"]
    return table(columns, rows) + "\n" + source("rl")


def env_speed() -> str:
    """Claims of the environment's benchmark: asked beside measured."""
    return asked("env_speed") + "\n" + source("env_speed")


def asked(name: str) -> str:
    """Claims of a run, the missed ones first."""
    claims = sorted(saved(name)["claims"], key=lambda row: (row["met"] is not False, row["met"] is True))
    said = {True: "yes", False: "**NO**", None: "not measured"}
    rows = [[row["claim"], row["asked"], row["measured"], said[row["met"]]] for row in claims]
    return table(["", "asked", "measured", "met"], rows)


def summary() -> str:
    """What README.md shows: the least that says where this stands, and what was asked beside it."""
    solver = {(row["solver"], row["contacts"]): row for row in saved("solver")["rows"]}
    mine, python, other = (_us(solver[name, 4]) for name in ("conic", "conic_python", "qocogen_fast"))
    total = saved("starts")["timing"]["total"]
    flow, cold, best = (
        pair(total[method][start]["best"])
        for method, start in (
            ("reduced_flow", "linear_combination"),
            ("newton", "linear_combination"),
            ("newton", "learned_fixed"),
        )
    )
    ball = saved("starts")["starts"]["reduced_flow"]["ball"]
    network = next(
        row for row in saved("starts")["claims"] if row["claim"].startswith("network alone, fixed grasp: iterations")
    )
    pipeline = next(row for row in saved("hold")["cells"] if row["name"] == "objects/paper")
    engines = saved("transfer")["claims"]
    steps = min(saved("reproduce")["times"].values(), key=lambda row: row["median"])
    rows = [
        ["exact optimum with its proof, 4 contacts: compiled; from Python", f"{mine}; {python} us", f"fastest peer (generated C): {other} us"],
        ["optimum of Phi from cold, Newton, from Python: 12-basis; network", f"{cold}; {best} us", f"the paper's flow, adaptive steps: {flow} us; with its best step rule, compiled: {pair(steps)} us"],
        ["steps of the paper's flow: 12-basis; network; learned Newton layers",
         "; ".join(iterations(ball[start]) for start in ("linear_combination", "network", "learned_any")), f"network: {network['asked']}"],
        ["random objects held 4 s against a random wrench", held(pipeline), "at least 99 %"],
        ["MuJoCo holds what Bullet holds", f"{sum(row['met'] is True for row in engines)} of {len(engines)} comparisons", "within 5 points"],
        *(["**missed**: " + row["claim"], row["measured"], row["asked"]]
          for name in ("starts", "hold", "transfer", "env_speed") for row in saved(name)["claims"] if row["met"] is False),
    ]  # fmt: skip
    return table(["median / p99", "measured", "asked, or for comparison"], rows) + "\n" + source("starts")


def _us(row: dict[str, Any]) -> str:
    return f"{row['p50_us']:.1f} / {row['p99_us']:.1f}"


TABLES: dict[str, Callable[[], str]] = {
    "starts": starts, "calls": calls, "network": network, "solvers": solvers, "batch": batch, "env_speed": env_speed,
    "step_rules": step_rules, "table_one": table_one, "hold": hold, "hands": hands, "rl": rl, "summary": summary,
    "transfer": lambda: asked("transfer") + "\n" + source("transfer"),
    "starts_claims": lambda: asked("starts") + "\n" + source("starts"),
}  # fmt: skip
